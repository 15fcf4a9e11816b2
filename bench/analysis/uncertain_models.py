"""What was identified from a run, with its uncertainty: quantities of a model, its predictions, its set-points.

A component that is common to all readings, such as the gain of a sensor, is propagated by a second fit of readings
that it has moved by its standard uncertainty; a drift with a time by fits of readings that it has moved as it may.
What the noise of the readings leaves open is found by fits of readings with other noise: of input and output as the
rig file states it of both, otherwise differences of neighbouring residuals of the output with random signs. The
latter have something of what the model cannot follow, which is the same in each session and stands beside the model
as its error.

Sources: JCGM 100:2008 (GUM), 5.1.3, note 2; J. von Neumann, Annals of Mathematical Statistics 12 (1941), 153, for
noise from differences; C. F. J. Wu, Annals of Statistics 14 (1986), 1261, for random signs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.analysis.uncertain_results import over_range, rounded, uncertain_signals
from bench.base import Floats
from bench.identification import ModelFile
from bench.models import Operator
from bench.record import Record
from bench.rig import OWN, Budget, BudgetRow, Part, UncertainSignals, effective_freedom

_FITS = 20
"""Fits with other noise. Derivation: their deviation has 20 degrees of freedom, and k is 2.09 instead of 1.96."""
_PLACES = 33
"""Values of a signal at which the contributions of its components are computed; between them they are straight."""
PROVENANCE = "uncertainty"
"""Key of the provenance of a model file."""


@dataclass(frozen=True)
class ModelUncertainty:
    """What is known of a model that was identified from a run.

    Attributes
    ----------
    quantities : mapping of str to Budget
        Budgets of its quantities by name, as `quantities_of` has them.
    coefficients : ndarray, shape (K,)
        Standard uncertainties of the coefficients of the model, such as the cells of its density.
    outputs, standard : ndarray, shape (33,)
        Values of the output, and the standard uncertainty that readings share there; both in its unit.
    """

    quantities: Mapping[str, Budget]
    coefficients: Floats
    outputs: Floats
    standard: Floats

    def to_json(self) -> dict[str, Any]:
        """Return it for programs, and for the provenance of a model file."""
        return {
            "quantities": {name: budget.to_json() for name, budget in self.quantities.items()},
            "u_coefficients": self.coefficients.tolist(),
            "outputs": self.outputs.tolist(),
            "standard": self.standard.tolist(),
        }

    def lines(self) -> list[tuple[str, str]]:
        """Return the quantities with their expanded uncertainty, as (name, text) pairs."""
        return [(name, quantity_text(budget)) for name, budget in self.quantities.items() if budget.rows]


def quantity_text(budget: Budget) -> str:
    """Return a quantity with its expanded uncertainty, the coverage factor and the largest component."""
    value, expanded = rounded(budget.value, budget.expanded)
    largest = f"95 %, k = {budget.factor:.2f}, largest part: {budget.rows[0].label}"
    unit = f" {budget.unit}" if budget.unit else ""
    return f"{value} ± {expanded}{unit} ({largest})"


def quantities_of(operator: Operator[Any]) -> dict[str, tuple[float, str]]:
    """Return the quantities of a model that have a name, with their units.

    Of a density they are its sum, and the transition inputs: means of its thresholds, rising and falling, weighted by
    the magnitudes of its cells.
    """
    input_unit, output_unit = operator.input_unit, operator.output_unit
    found: dict[str, tuple[float, str]] = {"output at zero": (operator.bias, output_unit)}
    reversible = getattr(operator, "reversible", None)
    for name in ("k0", "k1"):
        if isinstance(value := getattr(reversible, name, None), float):
            found[name] = value, f"({output_unit})/{input_unit.replace('°C', 'K')}"
    for density in operator.densities():
        title = f"{density.title} " if density.title else ""
        cells = np.nan_to_num(density.values)
        middles = 0.5 * (density.levels[1:] + density.levels[:-1])
        areas = np.outer(np.diff(density.levels), np.diff(density.levels))
        # Of a cell on the diagonal half is there.
        weights = cells * areas * (1.0 - 0.5 * np.eye(middles.size))
        magnitudes = np.abs(weights)
        found[f"{title}density, sum"] = float(weights.sum()), output_unit
        if total := float(magnitudes.sum()):
            found[f"{title}transition, rising"] = float(magnitudes.sum(axis=1) @ middles) / total, input_unit
            found[f"{title}transition, falling"] = float(magnitudes.sum(axis=0) @ middles) / total, input_unit
    shape = operator.shape_parameters()
    found.update({name: (value, "") for name, value in zip(shape.names, shape.values, strict=True)})
    low, high = operator.output_range()
    return found | {"lowest output": (low, output_unit), "highest output": (high, output_unit)}


Quantities = Mapping[str, tuple[float, str]]
"""Values and units by name."""


def propagated(
    signals: UncertainSignals,
    columns: Mapping[str, Floats],
    rows: Mapping[str, Floats],
    times: Floats,
    nominal: Quantities,
    spreads: Mapping[str, Sequence[BudgetRow]],
    refits: Callable[[Sequence[Mapping[str, Floats]]], Sequence[Quantities]],
) -> dict[str, Budget]:
    """Return the budgets of quantities that were identified from readings.

    Parameters
    ----------
    signals : UncertainSignals
        The signals of the run.
    columns : mapping of str to ndarray
        Readings by signal, shape (N,) each.
    rows : mapping of str to ndarray
        Readings of the same run, with those of the signals that they are derived from.
    times : ndarray, shape (N,)
        When they were taken, s.
    nominal : mapping
        What was identified from them.
    spreads : mapping of str to sequence of BudgetRow
        What else leaves each quantity open: the fit, and what acts on the specimen.
    refits : callable
        Identifies the same from other readings, from each of several.
    """
    rng = np.random.default_rng(1)
    parts: dict[str, dict[tuple[str, str], list[BudgetRow]]] = {name: {} for name in nominal}
    # An error that input and output share moves both.
    together: dict[int, tuple[BudgetRow, dict[str, Floats]]] = {}
    for column in signals.stated([*columns]):
        for part, size in _sizes(signals, column, rows, columns[column], shared=True):
            together.setdefault(id(part.number), (part.row, {}))[1][column] = size
    for row, sizes in together.values():
        for name, contribution in _deviations(nominal, refits(_moved(columns, times, row, sizes, rng))).items():
            found = parts[name].setdefault((row.signal, row.component), [])
            found.append(replace(row, contribution=contribution))
    budgets = {}
    for name, (value, unit) in nominal.items():
        # A wave is its sine and its cosine.
        waves = [
            replace(each[0], contribution=math.hypot(*(row.contribution for row in each)))
            for each in parts[name].values()
        ]
        ordered = sorted([*spreads[name], *waves], key=lambda row: -row.contribution)
        kept = tuple(row for row in ordered if row.contribution)
        budgets[name] = Budget(name, unit, value, kept, effective_freedom(kept))
    return budgets


def spread_row(spread: float, unit: str, freedom: float, how: str) -> BudgetRow:
    """Return the component that a fit leaves open: standard deviation, degrees of freedom, and how it was found."""
    return BudgetRow("the model", "fit", "fit", "A", "normal", spread, unit, freedom, spread, f"measured: {how}")


def identified_uncertainty(
    record: Record,
    names: tuple[str, str],
    inputs: Floats,
    outputs: Floats,
    residuals: Floats,
    model: Operator[Any],
    fit: Callable[[Floats, Floats], Operator[Any]],
) -> ModelUncertainty | None:
    """Return the uncertainty of a model of a run; None where the run's rig file states none of the output.

    Parameters
    ----------
    record : Record
        The run.
    names : (str, str)
        Signals of input and output.
    inputs, outputs, residuals : ndarray, shape (N,)
        Readings, and what the model leaves of the outputs.
    model : Operator
        The model that was fitted.
    fit : callable
        Fits other inputs and outputs in the same way.
    """
    signals = uncertain_signals(record)
    if not signals.stated([names[1]]):
        return None
    nominal = quantities_of(model)
    columns = dict(zip(names, (inputs, outputs), strict=True))
    table = record.steps() or record.telemetry()
    rows = {each.name: table[each.name] for each in record.signals}
    # The rows of a run are spread over it.
    times = np.linspace(0.0, np.ptp(table["finished" if "finished" in table.columns else "t"]), inputs.size)
    rng = np.random.default_rng(0)
    squares = np.zeros(model.coefficients.size)

    def refits(others: Sequence[Mapping[str, Floats]]) -> list[Quantities]:
        nonlocal squares
        found = [fit(*(other[name] for name in names)) for other in others]
        squares = squares + np.mean([(other.coefficients - model.coefficients) ** 2 for other in found], axis=0)
        return [quantities_of(other) for other in found]

    own = {
        name: [each for each in _sizes(signals, name, rows, columns[name]) if each[0].row.acts in OWN]
        for name in signals.stated(names)
    }
    if all("noise" in [part.row.acts for part, _ in own.get(name, [])] for name in names):
        noisy = [
            {
                name: values + sum(size * rng.standard_normal(size.size) for _, size in own[name])
                for name, values in columns.items()
            }
            for _ in range(_FITS)
        ]
    else:
        noisy = [{**columns, names[1]: outputs + _noise(residuals, rng)} for _ in range(_FITS)]
    how = f"{_FITS} fits with other noise"
    spreads = {
        name: [spread_row(deviation, nominal[name][1], _FITS, how)]
        for name, deviation in _deviations(nominal, refits(noisy)).items()
    }
    for name, values in columns.items():
        if (room := signals.room([name])) is not None:
            others = refits(_moved(columns, times, room, {name: np.full(values.size, room.contribution)}, rng))
            for quantity, deviation in _deviations(nominal, others).items():
                spreads[quantity].append(replace(room, contribution=deviation))
    quantities = propagated(signals, columns, rows, times, nominal, spreads, refits)
    places = np.linspace(outputs.min(), outputs.max(), _PLACES)
    shared = [size for _, size in _sizes(signals, names[1], rows, places, shared=True)]
    standard = np.sqrt(np.sum(np.square(shared), axis=0))
    return ModelUncertainty(quantities, np.sqrt(squares), places, standard)


def _sizes(
    signals: UncertainSignals, name: str, rows: Mapping[str, Floats], values: Floats, *, shared: bool = False
) -> list[tuple[Part, Floats]]:
    """Return the contribution of each component at values of a signal as it has it in rows, or of each shared one."""
    chosen = over_range(rows[name], _PLACES)
    table = [
        signals.reading(name, {key: float(column[k]) for key, column in rows.items()}).contributions(shared=shared)
        for k in chosen.tolist()
    ]
    return [
        (part, np.interp(values, rows[name][chosen], [row[i][1] for row in table]))
        for i, (part, _) in enumerate(table[0])
    ]


def _moved(
    columns: Mapping[str, Floats],
    times: Floats,
    row: BudgetRow,
    sizes: Mapping[str, Floats],
    rng: np.random.Generator,
) -> list[Mapping[str, Floats]]:
    """Return readings that a component has moved by its standard uncertainty, in several ways if it has a time."""
    courses = np.ones((1, times.size))
    if row.time is not None:
        left = np.exp(-np.diff(times) / row.time)
        courses = rng.standard_normal((_FITS, times.size))
        for k, each in enumerate(left, 1):
            courses[:, k] = each * courses[:, k - 1] + math.sqrt(1.0 - each**2) * courses[:, k]
    return [
        {**columns, **{name: columns[name] + size * course for name, size in sizes.items()}} for course in courses
    ]


def _deviations(nominal: Quantities, others: Sequence[Quantities]) -> dict[str, float]:
    """Return the RMS deviations of quantities that were identified from other readings."""
    return {
        name: math.sqrt(math.fsum((other[name][0] - value) ** 2 for other in others) / len(others))
        for name, (value, _) in nominal.items()
    }


def _noise(residuals: Floats, rng: np.random.Generator) -> Floats:
    """Return noise as large as that of the readings, place by place."""
    differences = np.append(np.diff(residuals), residuals[-1] - residuals[-2]) / math.sqrt(2.0)
    return np.asarray(differences * rng.choice((-1.0, 1.0), differences.size))


def predicted_uncertainty(model: ModelFile, outputs: Floats) -> Floats | None:
    """Return the standard uncertainty of predicted outputs, of their shape; None if the model file has none.

    It is that of the true output: the RMS error of the fit, and what is common to all readings of the sensor.
    """
    known = model.provenance.get(PROVENANCE)
    if not known or (rms := model.provenance.get("rms")) is None:
        return None
    return np.asarray(np.hypot(rms, np.interp(outputs, known["outputs"], known["standard"])))
