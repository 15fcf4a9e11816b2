"""From measured inputs and outputs to a model, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.hysteresis import (
    DeadZones,
    MemoryCurve,
    Operator,
    Polynomial,
    PolynomialTerm,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    Regressor,
    Reversible,
    ThermalExpansion,
    _checks,
    uniform_levels,
)
from bench.hysteresis._checks import Floats
from bench.hysteresis.prandtl_ishlinskii import PlayState
from bench.identification.inspection import check_data, measure_coverage, swept_cells
from bench.identification.least_squares import (
    Certificate,
    Fit,
    Flags,
    Indices,
    Layout,
    fit,
    fit_minimum_norm,
    fit_on,
)
from bench.identification.measures import Errors, measure_errors

ReversibleKind: TypeAlias = Literal["none", "linear", "quadratic", "polynomial"]
Initial: TypeAlias = Literal["negative", "positive", "skip", "estimate"]

# Least slope of the inverse dead zones, as part of that in the middle: forward it is the greatest.
_LEAST_SLOPE = 0.02


@dataclass(frozen=True, eq=False)
class Identification:
    """An identified model with the evidence for it.

    Parameters
    ----------
    model_name : str
        Key of `MODELS`.
    model : Operator
        The identified operator.
    residuals : ndarray, shape (N,)
        Measured output minus `model.evaluate(inputs, initial_state)` for every sample, the skipped ones too,
        output units.
    errors : Errors
        Measures over the samples after `skip`.
    uncertainties : ndarray, shape (K + q,)
        Standard uncertainty of each coefficient; see `Fit`.
    certificate : Certificate
        Optimality, conditioning and coverage of the fit.
    skip : int
        Number of first samples left out of the cost.
    initial_state : object
        State before the first sample from which the model was fitted.
    warnings : tuple of str
        What is odd about the data or not covered by them.
    """

    model_name: str
    model: Operator[Any]
    residuals: Floats
    errors: Errors
    uncertainties: Floats
    certificate: Certificate
    skip: int
    initial_state: Any = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class ModelSpec:
    """How a model of one name is set up and fitted.

    Parameters
    ----------
    summary : str
        What it is, in one line.
    template : callable
        Takes the inputs and the keyword options of `identify`; returns the operator before the fit.
    constrained : bool
        Whether the coefficients must not be negative; otherwise the least-norm solution is taken.
    """

    summary: str
    template: Callable[..., Operator[Any]]
    constrained: bool


def identify(
    model_name: str,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    smoothing: float = 0.0,
    initial: Initial | None = None,
    **options: Any,  # noqa: ANN401 - each template names and types its own
) -> Identification:
    """Return the model of a given name that fits a measured sequence best in the least-squares sense.

    ==========================  ==============================================================================
    `preisach`                  nonnegative density; options `levels` (20), `plane` (range of the inputs),
                                `reversible` ("none", "linear", "quadratic", or "polynomial" of `degree` 5 unless
                                given), `input_range`
    `preisach-signed`           density of either sign, least norm; options as `preisach`
    `preisach-nonmonotonic`     nonnegative density and thermal term (Zhang et al. 2013, eq. 12); options
                                `levels` (20), `plane` (30, 70), `reference` (20), `input_range`
    `prandtl-ishlinskii`        nonnegative weights of plays; options `plays` (15), `maximum` (half the range of
                                the inputs: thresholds are i maximum / plays), `origin` (0), `dead_zones` (0:
                                number of thresholds of a map after the plays), `input_range`
    `polynomial`                without memory; options `degree` (12), `input_range`
    ==========================  ==============================================================================

    `input_unit` and `output_unit` are options of each.

    The memory before the first sample (`initial`) is one of

    - None: the operator's own initial state, negative saturation for a Preisach model, relaxed for plays;
    - "negative", "positive": saturation at the low or the high end of the operating range;
    - "skip": unknown; the first samples are left out of the cost until the inputs have overwritten every part
      of the memory that they overwrite at all (what they never do is constant, and the bias takes it);
    - "estimate": unknown and estimated, for Preisach models with a nonnegative density. Each cell that is swept
      later on but whose start is unknown gets two nonnegative coefficients instead of one, the density of
      relays that were on and of those that were off: the on-fraction then is free between 0 and 1 and the
      problem stays linear. The staircase that agrees best with these fractions becomes the initial memory, and
      the density is fitted again from there.

    Parameters
    ----------
    model_name : str
        One of the names above, a key of `MODELS`.
    inputs, outputs : array_like, shape (N,)
        The measured sequence, in input and output units.
    weights : array_like, shape (N,), or None
        Weight per sample, >= 0; default 1.
    skip : int
        Number of first samples left out of the cost because their memory is unknown.
    smoothing : float
        Weight of the roughness penalty of `fit`; only for nonnegative densities.
    initial : {"negative", "positive", "skip", "estimate"} or None
        The memory before the first sample, as above.
    **options
        As listed above; `levels` is the number of intervals or the increasing levels themselves.

    Returns
    -------
    Identification
        Model, residuals, errors, certificate and warnings.

    Raises
    ------
    ValueError
        If the name is unknown, an option does not belong to it, or the data are unfit; see `fit`.
    """
    problem = prepare(model_name, inputs, outputs, weights, skip, smoothing, initial, options)
    solution = problem.fit(smoothing)
    model = problem.template.with_coefficients(solution.coefficients, solution.bias)
    predicted = model.evaluate(problem.inputs, problem.state)
    return Identification(
        model_name=model_name,
        model=model,
        residuals=problem.outputs - predicted,
        errors=measure_errors(problem.outputs[problem.skip :], predicted[problem.skip :]),
        uncertainties=solution.uncertainties,
        certificate=solution.certificate,
        skip=problem.skip,
        initial_state=problem.state,
        warnings=problem.warnings(),
    )


@dataclass(frozen=True, eq=False)
class Problem:
    """A measured sequence set up for a model: everything but the smoothing."""

    model_name: str
    inputs: Floats
    outputs: Floats
    weights: Floats
    skip: int
    template: Operator[Any]
    state: Any
    regressor: Regressor

    def fit(self, smoothing: float, weights: Floats | None = None) -> Fit:
        """Return the coefficients for the problem's weights or others."""
        w = self.weights if weights is None else weights
        if MODELS[self.model_name].constrained:
            signs = _signs(self.template, self.regressor)
            return fit(
                self.regressor, self.outputs, nonnegative=signs, weights=w, skip=self.skip, smoothing=smoothing
            )
        return fit_minimum_norm(self.regressor, self.outputs, weights=w, skip=self.skip)

    def warnings(self) -> tuple[str, ...]:
        """Return what is odd about the data or not covered by them."""
        found = check_data(self.inputs, self.outputs)
        if isinstance(self.template, Preisach):
            coverage = measure_coverage(self.template, self.inputs, self.state)
            if coverage.never.size:
                found.append(coverage.summary())
        return tuple(found)


def prepare(
    model_name: str,
    inputs: ArrayLike,
    outputs: ArrayLike,
    weights: ArrayLike | None,
    skip: int,
    smoothing: float,
    initial: Initial | None,
    options: dict[str, Any],
) -> Problem:
    """Return the problem that `identify` solves; its arguments are those of `identify`."""
    if model_name not in MODELS:
        raise ValueError(f"model_name: expected one of {', '.join(sorted(MODELS))}, got {model_name!r}")
    spec = MODELS[model_name]
    sequence = _checks.samples("inputs", inputs)
    measured = _checks.samples("outputs", outputs)
    if measured.size != sequence.size:
        raise ValueError(f"outputs: expected {sequence.size} values, one for each input, got {measured.size}")
    w = np.ones(sequence.size) if weights is None else _checks.samples("weights", weights)
    if initial not in (None, "negative", "positive", "skip", "estimate"):
        raise ValueError(f"initial: expected 'negative', 'positive', 'skip', 'estimate' or None, got {initial!r}")
    if smoothing and not spec.constrained:
        raise ValueError(f"smoothing: {model_name} takes the least-norm solution instead")
    options = dict(options)
    dead_zones = options.pop("dead_zones", 0) if spec.template is _prandtl_ishlinskii else 0
    try:
        template = spec.template(sequence, **options)
    except TypeError as error:
        raise ValueError(f"options of {model_name}: {error}") from None
    state: Any = None
    if initial == "skip":
        skip = max(skip, _unknown_until(template, sequence))
    elif initial == "estimate":
        if not isinstance(template, Preisach) or not spec.constrained:
            raise ValueError(f"initial: 'estimate' needs a nonnegative Preisach density, not {model_name}")
        state = _estimate(template, sequence, measured, w, skip, smoothing)
    elif initial is not None and isinstance(template, Preisach):
        low, high = template.input_range
        negative = initial == "negative"
        state = MemoryCurve((), low, -1) if negative else MemoryCurve((), high, 1)
    elif initial is not None and isinstance(template, PrandtlIshlinskii):
        state = template.saturated_state(-1 if initial == "negative" else 1)
    state = template.initial_state() if state is None else state
    if isinstance(template, PrandtlIshlinskii) and dead_zones:
        template = _with_dead_zones(template, dead_zones, sequence, measured, w, skip, state)
    regressor = template.regressor(sequence, state)
    return Problem(model_name, sequence, measured, w, skip, template, state, regressor)


def _signs(template: Operator[Any], regressor: Regressor) -> Flags:
    """Return which coefficients must not be negative."""
    signs = np.ones(regressor.shape[1], dtype=bool)
    if isinstance(template, Preisach):
        signs[regressor.base.size :] = template.reversible is not None and template.reversible.nonnegative
    return signs


def _unknown_until(template: Operator[Any], inputs: Floats) -> int:
    """Return the first sample from which the inputs have overwritten all the memory that they ever do."""
    top, bottom = np.maximum.accumulate(inputs), np.minimum.accumulate(inputs)
    if isinstance(template, Preisach):
        low, high = float(template.levels[0]), float(template.levels[-1])
    elif isinstance(template, PrandtlIshlinskii):
        low, high = -np.inf, np.inf
    else:
        return 0
    # A relay is known once α <= top or β >= bottom: none that will be switched may be left.
    rising = (top >= min(top[-1], high)) | (bottom <= low)
    falling = (bottom <= max(bottom[-1], low)) | (top >= high)
    return int(np.argmax(rising & falling))


def _estimate(
    template: Preisach, inputs: Floats, outputs: Floats, weights: Floats, skip: int, smoothing: float
) -> MemoryCurve:
    """Return the initial memory that the outputs suggest; see `identify`."""
    low, high = template.input_range
    off = template.regressor(inputs, MemoryCurve((), low, -1))
    on = template.regressor(inputs, MemoryCurve((), high, 1))
    count = off.base.size
    # The first input tells all relays but those around it: α above and β below.
    rows_of, columns_of = np.tril_indices(template.order)
    around = (template.levels[rows_of + 1] > inputs[0]) & (template.levels[columns_of] < inputs[0])
    unknown = np.flatnonzero(around & (swept_cells(off) | swept_cells(on)))
    place = np.full(count, -1)
    place[unknown] = count + np.arange(unknown.size)
    rows = np.concatenate([_rows(off), _rows(on)])
    cells = np.concatenate([off.cells, place[on.cells]])
    changes = np.concatenate([off.changes, on.changes])
    kept = cells >= 0
    order = np.argsort(rows[kept], kind="stable")
    both = Regressor(
        base=np.concatenate([off.base, on.base[unknown]]),
        starts=np.searchsorted(rows[kept][order], np.arange(inputs.size + 1)),
        cells=cells[kept][order].astype(np.int32),
        changes=changes[kept][order],
        extra=off.extra,
    )
    layout = Layout(
        template.order,
        np.concatenate([np.arange(count), unknown]),
        np.repeat([0, 1], [count, unknown.size]),
    )
    signs = np.ones(both.shape[1], dtype=bool)
    signs[: both.base.size] = True
    signs[both.base.size :] = _signs(template, off)[count:]
    x = fit_on(layout, both, outputs, signs, weights, skip, smoothing).coefficients
    # How much more mass was on than off: the staircase should take in what is positive.
    balance = np.zeros(count)
    balance[unknown] = (x[count : count + unknown.size] - x[unknown]) * template.cell_areas()[unknown]
    return _staircase(template, balance, float(inputs[0]))


def _rows(regressor: Regressor) -> Indices:
    """Return the row of each sparse entry."""
    return np.repeat(np.arange(regressor.shape[0]), np.diff(regressor.starts))


def _staircase(template: Preisach, balance: Floats, present: float) -> MemoryCurve:
    """Return the memory at input `present` whose on-region has the greatest sum of `balance`, to whole cells."""
    levels, order = template.levels, template.order
    low = template.input_range[0]
    memory = MemoryCurve((), min(low, present), -1)
    k = int(np.searchsorted(levels, present, side="right")) - 1
    if not 0 <= k < order:
        return memory.step(present)
    plane = np.zeros((order, order))
    plane[np.tril_indices(order)] = balance
    # worth[j, h]: column j on up to level k + h; the staircase must not rise from one column to the next.
    worth = np.zeros((k + 1, order - k + 1))
    np.cumsum(plane[k:, : k + 1].T, axis=1, out=worth[:, 1:])
    best = np.empty_like(worth)
    best[0] = worth[0]
    for j in range(1, k + 1):
        best[j] = worth[j] + np.maximum.accumulate(best[j - 1][::-1])[::-1]
    heights = [int(np.argmax(best[k]))]
    for j in range(k - 1, -1, -1):
        heights.append(heights[-1] + int(np.argmax(best[j, heights[-1] :])))
    heights.reverse()
    for j, height in enumerate(heights):
        if j and height < heights[j - 1]:
            memory = memory.step(float(levels[j]))
        if height and (not j or height < heights[j - 1]):
            memory = memory.step(float(levels[k + height]))
    return memory.step(present)


def _with_dead_zones(
    template: PrandtlIshlinskii,
    count: int,
    inputs: Floats,
    outputs: Floats,
    weights: Floats,
    skip: int,
    state: PlayState,
) -> PrandtlIshlinskii:
    """Return the operator with play weights, and dead zones after the plays whose slopes are still to be fitted.

    After Kuhnen 2003: the error is taken between the plays and the dead zones, plays(u) - S⁻¹(y), which is
    linear in the play weights and the slopes of S⁻¹ together. The slope of the interval that holds the median
    output is 1: a factor can be moved from the plays to the dead zones.
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"dead_zones: expected an integer >= 0, got {count!r}")
    middle = float(np.median(outputs))
    edges = np.linspace(outputs.min(), outputs.max(), count + 2)[1:-1] - middle
    if not (np.diff(edges, prepend=-np.inf) > 0.0).all():
        raise ValueError("outputs: constant; dead zones need outputs that vary")
    shares = DeadZones(edges, np.ones(count + 1)).columns(outputs - middle)
    reference = int(np.searchsorted(edges, 0.0))
    others = np.delete(np.arange(count + 1), reference)
    plain = template.regressor(inputs, state)
    joint = replace(plain, extra=np.ascontiguousarray(np.column_stack([plain.extra, -shares[:, others]])))
    target = shares[:, reference] + _LEAST_SLOPE * shares[:, others].sum(axis=1)
    found = fit(joint, target, weights=weights, skip=skip)
    slopes = np.ones(count + 1)
    slopes[others] = _LEAST_SLOPE + found.coefficients[plain.shape[1] :]
    to_plays = DeadZones(edges, slopes)
    after = DeadZones(to_plays(edges) - found.bias, 1.0 / slopes)
    return replace(template, weights=found.coefficients[: plain.shape[1]], after=after)


def _lattice(levels: int | ArrayLike, plane: tuple[float, float]) -> Floats:
    if isinstance(levels, int | np.integer):
        return uniform_levels(*plane, int(levels))
    return _checks.increasing("levels", levels)


def _operating(inputs: Floats, plane: tuple[float, float], given: tuple[float, float] | None) -> tuple[float, float]:
    """Return the operating range: what was given, else what the inputs and the plane span."""
    if given is not None:
        return given
    return min(float(inputs.min()), plane[0]), max(float(inputs.max()), plane[1])


def _input_span(inputs: Floats, name: str) -> tuple[float, float]:
    low, high = float(inputs.min()), float(inputs.max())
    if low == high:
        raise ValueError(f"inputs: constant at {low}; give {name} or inputs that vary")
    return low, high


def _preisach(
    inputs: Floats,
    *,
    levels: int | ArrayLike = 20,
    plane: tuple[float, float] | None = None,
    reversible: ReversibleKind = "none",
    degree: int | None = None,
    input_range: tuple[float, float] | None = None,
    input_unit: str = "",
    output_unit: str = "",
) -> Preisach:
    if plane is None and isinstance(levels, int | np.integer):
        plane = _input_span(inputs, "plane")
    lattice = _lattice(levels, plane or (0.0, 0.0))
    middle = 0.5 * float(lattice[0] + lattice[-1])
    span = _operating(inputs, (float(lattice[0]), float(lattice[-1])), input_range)
    if degree is not None and reversible != "polynomial":
        raise ValueError(f"degree: belongs to the reversible part 'polynomial', not to {reversible!r}")
    if degree is not None and degree < 1:
        raise ValueError(f"degree: expected at least 1, got {degree}")
    terms: dict[str, Reversible | None] = {
        "none": None,
        "linear": QuadraticTerm(origin=middle),
        "quadratic": QuadraticTerm(quadratic=0.0, origin=middle),
        "polynomial": PolynomialTerm((0.0,) * (5 if degree is None else degree), *span),
    }
    if reversible not in terms:
        raise ValueError(f"reversible: expected one of {', '.join(terms)}, got {reversible!r}")
    return Preisach(
        lattice,
        np.zeros(lattice.size * (lattice.size - 1) // 2),
        reversible=terms[reversible],
        input_range=span,
        input_unit=input_unit,
        output_unit=output_unit,
    )


def _nonmonotonic(
    inputs: Floats,
    *,
    levels: int | ArrayLike = 20,
    plane: tuple[float, float] = (30.0, 70.0),
    reference: float = 20.0,
    input_range: tuple[float, float] | None = None,
    input_unit: str = "°C",
    output_unit: str = "1/m",
) -> Preisach:
    lattice = _lattice(levels, plane)
    ends = float(lattice[0]), float(lattice[-1])
    return Preisach(
        lattice,
        np.zeros(lattice.size * (lattice.size - 1) // 2),
        reversible=ThermalExpansion(low=ends[0], high=ends[1], reference=reference),
        input_range=_operating(inputs, ends, input_range),
        input_unit=input_unit,
        output_unit=output_unit,
    )


def _polynomial(
    inputs: Floats,
    *,
    degree: int = 12,
    input_range: tuple[float, float] | None = None,
    input_unit: str = "",
    output_unit: str = "",
) -> Polynomial:
    if degree < 1:
        raise ValueError(f"degree: expected at least 1, got {degree}")
    span = _input_span(inputs, "input_range") if input_range is None else input_range
    return Polynomial(np.zeros(degree), span, input_unit=input_unit, output_unit=output_unit)


def _prandtl_ishlinskii(
    inputs: Floats,
    *,
    plays: int = 15,
    maximum: float | None = None,
    origin: float = 0.0,
    input_range: tuple[float, float] | None = None,
    input_unit: str = "",
    output_unit: str = "",
) -> PrandtlIshlinskii:
    if plays < 1:
        raise ValueError(f"plays: expected at least 1, got {plays}")
    low, high = _input_span(inputs, "maximum") if maximum is None else (0.0, 2.0 * maximum)
    if high <= low:
        raise ValueError(f"maximum: expected a positive number, got {maximum}")
    return PrandtlIshlinskii(
        0.5 * (high - low) * np.arange(plays) / plays,
        np.zeros(plays),
        origin=origin,
        input_range=_operating(inputs, (np.inf, -np.inf), input_range),
        input_unit=input_unit,
        output_unit=output_unit,
    )


MODELS: dict[str, ModelSpec] = {
    "preisach": ModelSpec("Preisach operator with a nonnegative density", _preisach, constrained=True),
    "preisach-signed": ModelSpec("Preisach operator with a density of either sign", _preisach, constrained=False),
    "preisach-nonmonotonic": ModelSpec(
        "nonnegative Preisach operator and a quadratic thermal term, as for VO2", _nonmonotonic, constrained=True
    ),
    "prandtl-ishlinskii": ModelSpec(
        "Prandtl-Ishlinskii operator with nonnegative weights, and dead zones on request",
        _prandtl_ishlinskii,
        constrained=True,
    ),
    "polynomial": ModelSpec("single-valued polynomial, without memory", _polynomial, constrained=False),
}
