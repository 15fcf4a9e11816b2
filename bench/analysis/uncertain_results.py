"""Results of a run with their uncertainty: budgets of its signals, and what is known of the true errors of control.

Three numbers have a name each. *Repeatability* is the standard deviation of readings at one target. *Reproducibility*
is that of what is reached at the same targets in different sessions (`bench.analysis.run_comparison`). *Accuracy* is
how far the true value may be from the target: errors of the readings and uncertainty of the readings together.

Sources: JCGM 100:2008 (GUM); JCGM 101:2008, 5.9 and 7, for the distribution of an RMS error; JCGM 200:2012 (VIM),
2.13, 2.21 and 2.25.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tracking_errors import following_result, loop_results, targets_visited
from bench.base import ConfigurationError, Floats
from bench.protocol import TRACES
from bench.record import Record, Table
from bench.rig import LEVEL, SETPOINT, Budget, Part, UncertainReading, UncertainSignals, rig_of_content

_DRAWS = 20_000
"""Draws of all components. Derivation: the coverage of an interval of 95 % is then good to 0.002."""
_MOST_ROWS = 200
"""Rows that are propagated one by one; of more, so many over the range, between which contributions are straight."""


@dataclass(frozen=True)
class ControlUncertainty:
    """What is known of the true errors of a run under control.

    Attributes
    ----------
    unit : str
        Of all numbers here but shares.
    repeatability : float or None
        Standard deviation of one reading at a target; None where there is one reading a target, or no targets.
    freedom : int
        Its degrees of freedom.
    standard, expanded : ndarray, shape (N,)
        Uncertainty of each error, standard and for 95 %: of each target, or of up to 200 samples over the range.
    rms : float
        RMS of the errors of the readings.
    accuracy : float
        RMS of the true errors that is expected: root of the mean square of errors and uncertainties.
    intervals : mapping of str to (float, float)
        Between which the true `rms`, `max` and `median` of the absolute error are, for 95 %.
    budget : Budget
        Of the error with the largest uncertainty.
    """

    unit: str
    repeatability: float | None
    freedom: int
    standard: Floats
    expanded: Floats
    rms: float
    accuracy: float
    intervals: Mapping[str, tuple[float, float]]
    budget: Budget

    def to_json(self) -> dict[str, Any]:
        """Return it for programs."""
        return {
            "unit": self.unit,
            "level": LEVEL,
            "repeatability": self.repeatability,
            "degrees_of_freedom": self.freedom,
            "accuracy": self.accuracy,
            "true_error": {name: list(ends) for name, ends in self.intervals.items()},
            "u_error": self.standard.tolist(),
            "expanded": self.expanded.tolist(),
            "budget": self.budget.to_json(),
        }


@dataclass(frozen=True)
class RunUncertainty:
    """The uncertainties of a run.

    Attributes
    ----------
    signals : mapping of str to Budget
        Of each measured signal at its reading farthest from 0.
    control : mapping of str to ControlUncertainty
        Of what was controlled, by `tracking`, `following` or `loop`.
    shown : Budget or None
        The budget that is worth showing in full: of the controlled signal, otherwise of the response.
    """

    signals: Mapping[str, Budget]
    control: Mapping[str, ControlUncertainty]
    shown: Budget | None

    @classmethod
    def of(cls, record: Record, steps: Table) -> RunUncertainty:
        """Return them, from the record of a run and its readings."""
        controlled = record.controlled
        signals = signal_budgets(record, steps)
        control = control_uncertainties(record, controlled) if controlled else {}
        response = record.meta.get("slots", {}).get("response", {}).get("signal", "")
        layout = record.meta.get("dashboard") or {}
        names = (controlled, response, layout.get("output", ""), *signals)
        stated = (signals[name] for name in names if name in signals and signals[name].stated)
        shown = next((each.budget for each in control.values()), None) or next(stated, None)
        return cls(signals, control, shown)

    def to_json(self) -> dict[str, Any]:
        """Return them for programs."""
        return {
            "signals": {name: budget.to_json() for name, budget in self.signals.items()},
            **{name: each.to_json() for name, each in self.control.items()},
        }


def rounded(value: float, expanded: float) -> tuple[str, str]:
    """Return a value and its uncertainty as texts: the latter with two significant digits (GUM 7.2.6)."""
    shown = two_digits(expanded)
    return f"{value:.{len(shown.partition('.')[2])}f}", shown


def two_digits(value: float) -> str:
    """Return a positive number with two significant digits, as an uncertainty is given."""
    digits = max(1 - math.floor(math.log10(float(f"{value:.1e}"))), 0) if value else 0
    return f"{value:.{digits}f}"


def uncertain_signals(record: Record) -> UncertainSignals:
    """Return the signals of a run as uncertain numbers, as the rig file of the run states them."""
    units = {signal.name: signal.unit for signal in record.signals}
    meta = record.meta
    if "uncertainty" in (meta.get("rig_content") or {}):
        try:
            file = rig_of_content(meta["rig"], meta["rig_file"], meta["rig_content"])
            return UncertainSignals(file.uncertainty, file.derived, units, file.path)
        except ConfigurationError:
            # Parts of it are not installed here.
            pass
    return UncertainSignals({}, {}, units, str(meta["rig"]))


def measured_signals(record: Record) -> list[str]:
    """Return the signals of a run that were measured or derived: no set-point, and nothing of a protocol's own."""
    own = {trace.name for trace in TRACES}
    return [each.name for each in record.signals if not each.name.endswith(SETPOINT) and each.name not in own]


def signal_budgets(record: Record, steps: Table) -> dict[str, Budget]:
    """Return the budget of each measured signal at its reading farthest from 0; of none that has no reading."""
    signals = uncertain_signals(record)
    found = {}
    for name in measured_signals(record):
        if np.isfinite(steps[name]).any():
            row = int(np.nanargmax(np.abs(steps[name])))
            values = {each.name: float(steps[each.name][row]) for each in record.signals}
            found[name] = signals.reading(name, values).budget()
    return found


def control_uncertainties(record: Record, output: str) -> dict[str, ControlUncertainty]:
    """Return what is known of the true errors of control by `tracking`, `following` and `loop`, as far as there are.

    Parameters
    ----------
    record : Record
        The run.
    output : str
        The controlled signal.
    """
    signals, found = uncertain_signals(record), {}
    if visited := targets_visited(record):
        found["tracking"] = _of_targets(signals, record, output, visited)
    elif (followed := following_result(record, output)) is not None:
        found["following"] = _of_samples(signals, record, output, followed.reference, followed.output)
    elif (loop := loop_results(record, output).get(output)) is not None:
        found["loop"] = _of_samples(signals, record, output, loop.reference, loop.output)
    return {name: each for name, each in found.items() if each is not None}


def _of_targets(
    signals: UncertainSignals, record: Record, output: str, visited: Sequence[tuple[float, float, Floats]]
) -> ControlUncertainty | None:
    names = [signal.name for signal in record.signals]
    column = names.index(output)
    means = np.array([rows.mean(axis=0) for _, _, rows in visited])
    errors = means[:, column] - np.array([target for target, _, _ in visited])
    freedom = sum(len(rows) - 1 for _, _, rows in visited)
    values = [dict(zip(names, row, strict=True)) for row in means.tolist()]
    if not freedom:
        return _control([signals.reading(output, each) for each in values], errors, record.unit(output))
    squares = sum(float(((rows[:, column] - rows[:, column].mean()) ** 2).sum()) for _, _, rows in visited)
    spread = math.sqrt(squares / freedom)
    readings = [
        signals.reading(output, each, noise=False).repeated(
            spread / math.sqrt(len(rows)), freedom, f"mean of {len(rows)} readings, deviation of all targets together"
        )
        for each, (_, _, rows) in zip(values, visited, strict=True)
    ]
    return _control(readings, errors, record.unit(output), spread, freedom)


def _of_samples(
    signals: UncertainSignals, record: Record, output: str, reference: Floats, outputs: Floats
) -> ControlUncertainty | None:
    """Return what is known of the errors of samples, or of 200 of them over the range of the output."""
    chosen = over_range(outputs)
    try:
        readings = [signals.at(output, value) for value in outputs[chosen].tolist()]
    except ConfigurationError:
        # It is derived from several signals.
        return None
    return _control(readings, (outputs - reference)[chosen], record.unit(output))


def over_range(values: Floats, most: int = _MOST_ROWS) -> npt.NDArray[np.intp]:
    """Return the numbers of so many rows at most over the range of values, in their order; of none that is nan."""
    order = np.argsort(values, kind="stable")[: int(np.isfinite(values).sum())]
    return np.asarray(order[np.linspace(0, order.size - 1, min(order.size, most)).round().astype(np.intp)])


def _control(
    readings: Sequence[UncertainReading],
    errors: Floats,
    unit: str,
    repeatability: float | None = None,
    freedom: int = 0,
) -> ControlUncertainty | None:
    budgets = [each.budget() for each in readings]
    if not budgets[0].stated:
        return None
    drawn = np.abs(errors + draw_errors(readings))
    standard = np.array([each.standard for each in budgets])
    of_draws = {
        "rms": np.sqrt((drawn**2).mean(axis=1)),
        "max": drawn.max(axis=1),
        "median": np.median(drawn, axis=1),
    }
    intervals = {name: _interval(each) for name, each in of_draws.items()}
    rms = math.sqrt(float((errors**2).mean()))
    return ControlUncertainty(
        unit=unit,
        repeatability=repeatability,
        freedom=freedom,
        standard=standard,
        expanded=np.array([each.expanded for each in budgets]),
        rms=rms,
        accuracy=math.sqrt(rms**2 + float((standard**2).mean())),
        intervals=intervals,
        budget=budgets[int(np.argmax(standard))],
    )


def _interval(draws: Floats) -> tuple[float, float]:
    low, high = np.quantile(draws, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL]).tolist()
    return low, high


def draw_errors(readings: Sequence[UncertainReading], draws: int = _DRAWS) -> Floats:
    """Return errors of readings, shape (draws, N), drawn from the distributions of their components."""
    rng = np.random.default_rng(0)
    found = np.zeros((draws, len(readings)))
    columns: dict[int, tuple[Part, Floats]] = {}
    for i, reading in enumerate(readings):
        for part, contribution in reading.contributions():
            weights = columns.setdefault(id(part.number), (part, np.zeros(len(readings))))[1]
            weights[i] += contribution
    phases: dict[tuple[str, str], Floats] = {}
    for part, weights in columns.values():
        row = part.row
        if row.distribution == "U":
            phase = rng.uniform(0.0, 2.0 * np.pi, draws)
            if part.angle is not None:
                phase = phases.setdefault((row.signal, row.component), phase) + part.angle
            values = math.sqrt(2.0) * np.sin(phase)
        elif row.distribution == "rectangular":
            values = rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), draws)
        elif row.distribution == "triangular":
            values = rng.triangular(-math.sqrt(6.0), 0.0, math.sqrt(6.0), draws)
        else:
            values = rng.standard_normal(draws) if math.isinf(row.freedom) else rng.standard_t(row.freedom, draws)
        seen = np.flatnonzero(weights)
        found[:, seen] += np.multiply.outer(values, weights[seen])
    return found


def reading_uncertainties(record: Record) -> Callable[[Mapping[str, Floats]], dict[str, Floats]]:
    """Return what gives the standard uncertainties of rows of readings, by the signals of which they are stated.

    It takes columns of all signals, shape (N,), and returns columns in the units of the signals, nan where a reading
    is. Of more than 200 rows those of so many over the range are computed, and the others lie between them.
    """
    signals, names = uncertain_signals(record), [signal.name for signal in record.signals]
    stated = signals.stated(measured_signals(record))

    def columns(rows: Mapping[str, Floats]) -> dict[str, Floats]:
        found = {}
        for name in stated:
            values = rows[name]
            uncertainties = np.full(values.size, np.nan)
            chosen, known = over_range(values), np.isfinite(values)
            if chosen.size:
                each = [
                    signals.reading(name, {key: float(rows[key][row]) for key in names}).standard for row in chosen
                ]
                uncertainties[known] = np.interp(values[known], values[chosen], each)
            found[name] = uncertainties
        return found

    return columns
