"""Identification of the models among voltage, force and length from their three kinds of series.

Source: Zhang and Yip, "Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles with Application to
Shape Memory Alloy Actuators", Robotics: Science and Systems, 2017; here "Zhang and Yip 2017". The force over the
voltage at resting length gives the first stage, the lengths over voltages under loads and over forces at
voltages together give the second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.choose.cross_validation import compare_smoothing
from bench.identification.fit.cell_layout import CellLayout, PlanesBeside
from bench.identification.fit.least_squares import Certificate, Fit, fit_cells
from bench.identification.measures import Errors, measure_errors
from bench.models import (
    Coupled,
    Linear,
    Operator,
    Preisach,
    Regressor,
    Summed,
    TwoStage,
    TwoStageState,
    uniform_levels,
)

M = TypeVar("M", TwoStage, Summed, Linear)
Kind: TypeAlias = Literal["length-voltage", "length-force"]
Stage: TypeAlias = Operator[Any]
Smoothing: TypeAlias = float | Sequence[float]
"""Weight of the roughness penalty of `fit`, or several to choose from by the errors on blocks left out."""

# Room beyond the greatest force in a plane of forces: the pretension of a reset lowers u by as much. Source: a
# choice; cells that no force reaches stay empty.
_MARGIN = 0.3
_KINDS = ("length-voltage", "length-force")


@dataclass(frozen=True, eq=False)
class Series:
    """Lengths measured after one reset.

    Parameters
    ----------
    kind : {"length-voltage", "length-force"}
        What was varied; errors are measured for each kind.
    voltages, forces, lengths : array_like, shape (N,)
        Samples, quasi-static.
    preparation : sequence of (voltage, force)
        Set-points after the reset and before the first sample, each reached with the force first.

    Raises
    ------
    ValueError
        If the kind is unknown, a number is not finite or the lengths of the sequences differ.
    """

    kind: Kind
    voltages: Floats
    forces: Floats
    lengths: Floats
    preparation: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise ValueError(f"kind: expected {' or '.join(map(repr, _KINDS))}, got {self.kind!r}")
        for name in ("voltages", "forces", "lengths"):
            count = np.size(self.voltages)
            values = _checks.counted(name, getattr(self, name), count, "values, one for each voltage")
            object.__setattr__(self, name, _checks.frozen(values))
        steps = []
        for step in self.preparation:
            if np.shape(step) != (2,):
                raise ValueError(f"preparation: expected pairs of voltage and force, got {step!r}")
            steps.append((_checks.number("preparation", step[0]), _checks.number("preparation", step[1])))
        object.__setattr__(self, "preparation", tuple(steps))

    @classmethod
    def under_load(cls, load: float, voltages: ArrayLike, lengths: ArrayLike) -> Series:
        """Return lengths over the voltage under a dead load that is hung on the cold wire after the reset."""
        values = _checks.samples("voltages", voltages)
        return cls("length-voltage", values, np.full(values.size, _checks.number("load", load)), lengths)  # type: ignore[arg-type]

    @classmethod
    def at_voltage(cls, voltage: float, forces: ArrayLike, lengths: ArrayLike) -> Series:
        """Return lengths over the force at a voltage that is set after the reset, while the force is zero."""
        values, constant = _checks.samples("forces", forces), _checks.number("voltage", voltage)
        held = np.full(values.size, constant)
        return cls("length-force", held, values, lengths, ((0.0, 0.0), (constant, 0.0)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class CoupledIdentification(Generic[M]):
    """An identified model among voltage, force and length, with the evidence for it.

    Parameters
    ----------
    model : TwoStage, Summed or Linear
        The identified model.
    errors : mapping of str to Errors
        Error measures by kind of series; "force-voltage" is that of the first stage (of the line, for a `Linear`)
        and missing for a `Summed`. Percentages refer to the range over all series of a kind (Zhang and Yip 2017,
        eqs. 10 and 11, the latter with the number of samples under the root).
    residuals : mapping of str to ndarray
        Measured minus model, series after series, by the same kinds; force or length units.
    certificates : mapping of str to Certificate
        Optimality, conditioning and coverage of each fit, "first" and "second"; of a `Summed` or `Linear`
        "second" only.
    uncertainties : mapping of str to ndarray
        Standard uncertainties of the coefficients of each fit, by the same names.
    smoothing : mapping of str to float
        Weight of the roughness penalty of each fit, by the same names.
    """

    model: M
    errors: Mapping[str, Errors]
    residuals: Mapping[str, Floats]
    certificates: Mapping[str, Certificate]
    uncertainties: Mapping[str, Floats]
    smoothing: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class FirstStage:
    """An identified first stage of a `TwoStage`.

    Parameters
    ----------
    model : Operator
        Force over the voltage at resting length.
    fit : Fit
        Its coefficients, with the evidence for them.
    smoothing : float
        Weight of the roughness penalty.
    forces, modelled : ndarray, shape (N,)
        Measured forces and those of the stage, force units.
    """

    model: Stage
    fit: Fit
    smoothing: float
    forces: Floats
    modelled: Floats


def identify_first_stage(
    voltages: ArrayLike,
    forces: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    order: int = 20,
    voltage_range: tuple[float, float] = (0.0, 3.0),
    smoothing: Smoothing = 0.0,
    units: tuple[str, str, str] = ("V", "N", "mm"),
) -> FirstStage:
    """Return the first stage H1 of a two-stage model, which needs no lengths.

    Its weights are nonnegative, its offset is free. It starts from its initial state.

    Parameters
    ----------
    voltages, forces : array_like, shape (N,)
        Series at resting length, from the cold wire on. The low end of the voltage range must be
        among the voltages: H1 there fixes where the second stage starts.
    weights : array_like, shape (N,), or None
        Weight per sample, >= 0; default 1. A great one at the first sample holds H1 of the cold wire to what was
        measured there.
    order : int
        Intervals of its Preisach plane.
    voltage_range : tuple of float
        The plane.
    smoothing : float or sequence of float
        Weight of the roughness penalty, see `fit`. Of several the greatest of those with the least error, within 2 %,
        on blocks of the samples left out; see `compare_smoothing`.
    units : tuple of str
        Units of voltage, force and length, for labels.

    Raises
    ------
    ValueError
        If a sequence is wrong or the lowest voltage is missing.
    """
    template = _plane(*voltage_range, order, units[0], units[1])
    v, f = _resting(voltages, forces, template.input_range[0])
    start = template.initial_state()
    held = np.ones(v.size) if weights is None else _checks.samples("weights", weights)
    regressor = template.regressor(v, start)
    found, chosen = _fit(CellLayout.of(regressor.base.size), regressor, f, held, smoothing)
    model = template.with_coefficients(found.coefficients, found.bias)
    return FirstStage(model, found, chosen, f, model.evaluate(v, start))


def identify_second_stage(
    first: FirstStage,
    series: Iterable[Series],
    *,
    operator: Stage | None = None,
    order: int = 20,
    force_limit: float = 11.2,
    pretension: float = 0.3,
    smoothing: Smoothing = 0.0,
    units: tuple[str, str, str] = ("V", "N", "mm"),
) -> CoupledIdentification[TwoStage]:
    """Return the two-stage model of a first stage that fits best.

    H2 is fitted to all series at once, each with its own memory: reset under the pretension, preparation, samples
    (Zhang and Yip 2017, eq. 7). Weights are nonnegative, offsets free.

    Parameters
    ----------
    first : FirstStage
        What `identify_first_stage` found.
    series : iterable of Series
        Measured lengths.
    operator : Operator or None
        H2 before the fit; default a Preisach operator on [-U, U], where U is the greater of `force_limit` and H1's
        greatest output, plus 0.3.
    force_limit : float
        Greatest force expected, force units.
    pretension : float
        Force during resets, force units.
    order, smoothing, units
        As in `identify_first_stage`.

    Raises
    ------
    ValueError
        If there is no series.
    """
    measured = _all(series)
    limit = max(_checks.number("force_limit", force_limit), first.model.output_range()[1]) + _MARGIN
    inner = _plane(-limit, limit, order, units[1], units[2]) if operator is None else operator
    found, inner, chosen = _fit_second(TwoStage(first.model, inner, pretension), measured, smoothing)
    fits = {"first": (first.fit, first.smoothing), "second": (found, chosen)}
    return _identification(TwoStage(first.model, inner, pretension), measured, fits, first.forces, first.modelled)


def identify_linear(
    voltages: ArrayLike,
    forces: ArrayLike,
    series: Iterable[Series],
    *,
    order: int = 20,
    voltage_range: tuple[float, float] = (0.0, 3.0),
    force_limit: float = 11.2,
    pretension: float = 0.3,
    smoothing: Smoothing = 0.0,
    units: tuple[str, str, str] = ("V", "N", "mm"),
) -> CoupledIdentification[Linear]:
    """Return the model with a straight line as first stage (Zhang and Yip 2017, eq. 9), fitted as the two-stage one.

    Slope and offset are the regression line of the force over the voltage. The plane of H5 is [-U, U], where U is the
    greatest of `force_limit` and |u| over all samples, plus 0.3.

    Parameters
    ----------
    voltages, forces, series, order, voltage_range, force_limit, pretension, smoothing, units
        As in `identify_first_stage` and `identify_second_stage`.

    Raises
    ------
    ValueError
        As `identify_first_stage` and `identify_second_stage`, or if the force falls with the voltage.
    """
    measured = _all(series)
    v, f = _resting(voltages, forces, _checks.increasing("voltage_range", voltage_range).item(0))
    middle = v - v.mean()
    slope = float(middle @ f / max(float(middle @ middle), 1e-300))
    offset = float(f.mean() - slope * v.mean())
    greatest = max(float(np.abs(s.forces - slope * s.voltages - offset).max()) for s in measured)
    limit = max(_checks.number("force_limit", force_limit), greatest) + _MARGIN

    def line(stage: Stage) -> Linear:
        return Linear(slope, offset, stage, voltage_range, pretension, units[0])

    template = line(_plane(-limit, limit, order, units[1], units[2]))
    found, inner, chosen = _fit_second(template.two_stage, measured, smoothing)
    return _identification(line(inner), measured, {"second": (found, chosen)}, f, slope * v + offset)


def identify_summed(
    series: Iterable[Series],
    *,
    order: int = 20,
    voltage_range: tuple[float, float] = (0.0, 3.0),
    force_limit: float = 11.2,
    pretension: float = 0.3,
    smoothing: Smoothing = 0.0,
    units: tuple[str, str, str] = ("V", "N", "mm"),
) -> CoupledIdentification[Summed]:
    """Return the difference of two operators that fits best (Zhang and Yip 2017, eq. 8), both fitted at once.

    The plane of H3 is [0, F], where F is the greater of `force_limit` and all forces, plus 0.3; that of H4 is
    `voltage_range`. One offset serves both: it is given to H3.

    Parameters
    ----------
    series, order, voltage_range, force_limit, pretension, smoothing, units
        As in `identify_second_stage`; one weight of the penalty serves both operators.

    Raises
    ------
    ValueError
        As `identify_second_stage`.
    """
    measured = _all(series)
    greatest = max(float(s.forces.max()) for s in measured)
    limit = max(_checks.number("force_limit", force_limit), greatest) + _MARGIN
    by_force = _plane(0.0, limit, order, units[1], units[2])
    by_voltage = _plane(*voltage_range, order, units[0], units[2])
    start = Summed(by_force, by_voltage, pretension).initial_state()
    parts, weights, outputs = [], [], []
    for s in measured:
        v, f = _path(s)
        parts.append(_beside(by_force.regressor(f, start.by_force), by_voltage.regressor(v, start.by_voltage)))
        # The preparation drives the memory and counts for nothing.
        skipped = np.zeros(len(s.preparation))
        weights.append(np.append(skipped, np.ones(s.lengths.size)))
        outputs.append(np.append(skipped, s.lengths))
    cells = by_force.density.size
    layout = PlanesBeside.of_planes(CellLayout.of(cells), CellLayout.of(by_voltage.density.size))
    found, chosen = _fit(layout, _chained(parts), np.concatenate(outputs), np.concatenate(weights), smoothing)
    model = Summed(
        by_force.with_coefficients(found.coefficients[:cells], found.bias),
        by_voltage.with_coefficients(found.coefficients[cells:], 0.0),
        pretension,
    )
    return _identification(model, measured, {"second": (found, chosen)})


def predict_series(model: Coupled[Any], series: Series) -> Floats:
    """Return a model's lengths for the samples of a series, shape (N,), from a reset on."""
    v, f = _path(series)
    return model.evaluate(v, f)[len(series.preparation) :]


def measure_series(model: Coupled[Any], series: Iterable[Series]) -> Errors:
    """Return the errors of a model over several series; percentages refer to the range over all of them.

    Raises ValueError if there is no series.
    """
    measured = _all(series)
    return measure_errors(
        np.concatenate([s.lengths for s in measured]), np.concatenate([predict_series(model, s) for s in measured])
    )


def voltage_steps(count: int = 37) -> Floats:
    """Return a damped oscillation from 0 to 3 V with its longest step as short as `count` samples allow.

    Zhang and Yip 2017, Fig. 5. Raises ValueError if there are fewer samples than the 11 turning points.
    """
    points = np.array([0.0, 3.0, 0.3, 2.7, 0.6, 2.4, 0.9, 2.1, 1.2, 1.8, 1.5])
    travel = np.abs(np.diff(points))
    if count < points.size:
        raise ValueError(f"count: expected at least {points.size}, got {count}")
    steps = np.ones(travel.size, dtype=np.int64)
    # One sample after another goes to the ramp with the longest steps.
    for _ in range(count - points.size):
        steps[np.argmax(travel / steps)] += 1
    ramps = [np.linspace(a, b, n + 1)[1:] for (a, b), n in zip(pairwise(points), steps, strict=True)]
    return np.concatenate([points[:1], *ramps])


def _plane(low: float, high: float, order: int, input_unit: str, output_unit: str) -> Preisach:
    levels = uniform_levels(low, high, order)
    return Preisach(levels, np.zeros(order * (order + 1) // 2), input_unit=input_unit, output_unit=output_unit)


def _all(series: Iterable[Series]) -> tuple[Series, ...]:
    measured = tuple(series)
    if not measured:
        raise ValueError("series: expected at least one, got none")
    return measured


def _resting(voltages: ArrayLike, forces: ArrayLike, lowest: float) -> tuple[Floats, Floats]:
    """Return the checked series at resting length."""
    v = _checks.samples("voltages", voltages)
    f = _checks.counted("forces", forces, v.size, "values, one for each voltage")
    # Otherwise nothing in the data tells the force of the cold wire, on which every u rests.
    if not math.isclose(v.min(), lowest, abs_tol=1e-9):
        raise ValueError(f"voltages: expected a sample at the lowest voltage {lowest}, got {v.min()} at least")
    return v, f


def _path(series: Series) -> tuple[Floats, Floats]:
    """Return voltages and forces of preparation and samples."""
    before = np.array(series.preparation, dtype=np.float64).reshape(-1, 2)
    return np.append(before[:, 0], series.voltages), np.append(before[:, 1], series.forces)


def _fit(
    layout: CellLayout, regressor: Regressor, outputs: Floats, weights: Floats, smoothing: Smoothing
) -> tuple[Fit, float]:
    """Return a fit and the weight of its roughness penalty, chosen by cross-validation if there are several."""
    if not isinstance(smoothing, Sequence):
        chosen = smoothing
    elif layout.order:

        def fit(weight: float, rows: Floats) -> Fit:
            return fit_cells(layout, regressor, outputs, weights=rows * weights, smoothing=weight)

        # A great weight holds the model to a sample; its error counts as that of any other.
        rows = (weights > 0.0).astype(np.float64)
        chosen = compare_smoothing(fit, regressor, outputs, rows, smoothing).smoothest.smoothing
    else:
        # Columns that have no place in a plane have no roughness.
        chosen = 0.0
    return fit_cells(layout, regressor, outputs, weights=weights, smoothing=chosen), chosen


def _fit_second(model: TwoStage, series: Sequence[Series], smoothing: Smoothing) -> tuple[Fit, Stage, float]:
    """Fit the second stage of a model whose first one is known; return fit, stage, and weight of the penalty."""
    start: TwoStageState = model.initial_state()
    parts, weights, outputs = [], [], []
    for s in series:
        path = model.arguments(*_path(s), start)
        parts.append(model.second.regressor(path, start.second))
        # Only the end of each sample's two sub-moves is measured, and nothing of the preparation.
        weight, output = np.zeros(path.size), np.zeros(path.size)
        weight[2 * len(s.preparation) + 1 :: 2] = 1.0
        output[2 * len(s.preparation) + 1 :: 2] = s.lengths
        weights.append(weight)
        outputs.append(output)
    regressor = _chained(parts)
    layout = CellLayout.of(regressor.base.size)
    found, chosen = _fit(layout, regressor, np.concatenate(outputs), np.concatenate(weights), smoothing)
    return found, model.second.with_coefficients(found.coefficients, found.bias), chosen


def _identification(
    model: M,
    series: Sequence[Series],
    fits: Mapping[str, tuple[Fit, float]],
    forces: Floats | None = None,
    line: Floats | None = None,
) -> CoupledIdentification[M]:
    pairs: dict[str, tuple[Floats, Floats]] = {}
    if forces is not None and line is not None:
        pairs["force-voltage"] = forces, line
    for kind in _KINDS:
        chosen = [s for s in series if s.kind == kind]
        if chosen:
            predicted = np.concatenate([predict_series(model, s) for s in chosen])
            pairs[kind] = np.concatenate([s.lengths for s in chosen]), predicted
    return CoupledIdentification(
        model=model,
        errors={kind: measure_errors(*pair) for kind, pair in pairs.items()},
        residuals={kind: measured - predicted for kind, (measured, predicted) in pairs.items()},
        certificates={name: f.certificate for name, (f, _) in fits.items()},
        uncertainties={name: f.uncertainties for name, (f, _) in fits.items()},
        smoothing={name: chosen for name, (_, chosen) in fits.items()},
    )


def _chained(parts: Sequence[Regressor]) -> Regressor:
    """Return the rows of one regressor after those of another, each from its own state."""
    starts, cells, changes = [np.zeros(1, dtype=np.int64)], [], []
    last = parts[0].base
    for r in parts:
        # The first row of a series differs from the last of the one before by all that the reset changes.
        jump = r.base - last
        moved = np.flatnonzero(jump)
        cells += [moved.astype(np.int32), r.cells]
        changes += [jump[moved], r.changes]
        starts.append(r.starts[1:] + starts[-1][-1] + moved.size)
        last = r.base + np.bincount(r.cells, r.changes, minlength=r.base.size)
    return Regressor(
        base=parts[0].base,
        starts=np.concatenate(starts),
        cells=np.concatenate(cells),
        changes=np.concatenate(changes),
        extra=np.ascontiguousarray(np.concatenate([r.extra for r in parts])),
    )


def _beside(plus: Regressor, minus: Regressor) -> Regressor:
    """Return the columns of one regressor and the negative ones of another; the sparse ones first."""
    count = plus.base.size
    rows = np.concatenate([np.repeat(np.arange(r.shape[0]), np.diff(r.starts)) for r in (plus, minus)])
    order = np.argsort(rows, kind="stable")
    return Regressor(
        base=np.append(plus.base, -minus.base),
        starts=plus.starts + minus.starts,
        cells=np.append(plus.cells, (minus.cells + count).astype(np.int32))[order],
        changes=np.append(plus.changes, -minus.changes)[order],
        extra=np.ascontiguousarray(np.hstack([plus.extra, -minus.extra])),
    )
