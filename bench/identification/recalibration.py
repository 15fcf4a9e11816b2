"""Recalibration: what moved between the session of a model and another one, estimated from measured outputs.

The sensor of another session has another zero, gain and drift, and its input another zero:
y_n = offset + gain f(u_n + input offset) + drift n, with f the model and n the row from 0 on. Offset, gain and drift
follow by linear least squares for each input offset, which is found by a search over one number.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from bench.base import Floats, checks as _checks
from bench.identification.fit.variable_projection import Evidence
from bench.identification.measures import autocorrelation
from bench.models import Operator, TimedSequence

Kind: TypeAlias = Literal["offset", "gain", "drift", "input-offset"]
KINDS: tuple[Kind, ...] = get_args(Kind)

# Part of the operating range by which the input's zero may have moved. Derivation: nine of ten inputs are still
# within the range of the model.
_FARTHEST = 0.1
# Offsets that are tried. Derivation: steps of 0.5 % of the range, half a cell of a plane of a hundred levels, so that
# no minimum lies between them.
_TRIALS = 41
# Condition number of the scaled columns from which they cannot be told apart. Derivation: of readings with six digits
# it leaves one.
_WORST = 1e5


def parse_kinds(text: str) -> tuple[Kind, ...]:
    """Return the kinds of a text such as `offset,gain`.

    Raises ValueError if one is unknown or given twice, or there is none.
    """
    named = [part.strip() for part in text.split(",") if part.strip()]
    found = tuple(kind for kind in KINDS if kind in named)
    if not found or len(found) != len(named):
        raise ValueError(f"recalibrate {text!r}: expected some of {', '.join(KINDS)}, each once, with commas")
    return found


@dataclass(frozen=True)
class Recalibration:
    """What moved between two sessions.

    Parameters
    ----------
    values, uncertainties : mapping of str to float
        By kind, those that were asked for: `offset` in output units, `gain` (1), `drift` in output units a row,
        `input-offset` in input units. Standard uncertainties, with the residuals' correlation in them.
    rows : int
        Number of first rows from which they were estimated.
    rms : float
        RMS error that is left in those rows, output units.
    """

    values: Mapping[Kind, float]
    uncertainties: Mapping[Kind, float]
    rows: int
    rms: float

    def predict(self, operator: Operator[Any] | TimedSequence, inputs: Floats, state: Any = None) -> Floats:  # noqa: ANN401
        """Return the outputs of the model in the other session, shape (N,), output units.

        Parameters
        ----------
        operator : Operator or TimedSequence
            The model, one with time at the times of the rows.
        inputs : ndarray, shape (N,)
            Inputs from the first row of the session on, input units.
        state : object
            State before the first row; None is the initial one.

        Raises
        ------
        ValueError
            If the inputs are empty or not finite.
        """
        plain = operator.evaluate(inputs + self.values.get("input-offset", 0.0), state)
        scaled = self.values.get("offset", 0.0) + self.values.get("gain", 1.0) * plain
        return scaled + self.values.get("drift", 0.0) * np.arange(plain.size)

    def corrected(self, operator: Operator[Any]) -> Operator[Any]:
        """Return the model in the terms of the other session, for control; without the drift.

        Raises ValueError if the gain is not positive, or the input of such a model cannot be shifted.
        """
        gain, offset = self.values.get("gain", 1.0), self.values.get("offset", 0.0)
        if gain <= 0.0:
            raise ValueError(f"gain: expected a positive number, got {gain:g}")
        result = operator
        if gain != 1.0 or offset:
            result = result.with_coefficients(gain * result.coefficients, gain * result.bias + offset)
        moved = self.values.get("input-offset", 0.0)
        return result.shifted(moved) if moved else result

    def texts(self, input_unit: str, output_unit: str) -> tuple[tuple[str, str], ...]:
        """Return each kind with its value, standard uncertainty and unit as text."""
        units: Mapping[Kind, str] = {
            "offset": output_unit,
            "gain": "",
            "drift": f"{output_unit} a row".strip(),
            "input-offset": input_unit,
        }
        return tuple(
            (kind, f"{value:.5g} ± {self.uncertainties[kind]:.2g} {units[kind]}".rstrip())
            for kind, value in self.values.items()
        )

    def to_json(self) -> dict[str, Any]:
        """Return the recalibration for programs: by kind `value` and `uncertainty`, `rows` and `rms`."""
        found: dict[str, Any] = {
            kind: {"value": value, "uncertainty": self.uncertainties[kind]} for kind, value in self.values.items()
        }
        return {**found, "rows": self.rows, "rms": self.rms}


def recalibrate(
    operator: Operator[Any] | TimedSequence,
    inputs: Floats,
    outputs: Floats,
    kinds: Iterable[Kind],
    *,
    rows: int | None = None,
    skip: int = 0,
    state: Any = None,  # noqa: ANN401 - each operator has its own
) -> Recalibration:
    """Return what moved in a session, estimated from its first rows.

    Parameters
    ----------
    operator : Operator or TimedSequence
        The model, one with time at the times of the rows.
    inputs, outputs : array_like, shape (N,)
        The measured sequence from the first row of the session on.
    kinds : iterable of {"offset", "gain", "drift", "input-offset"}
        What is estimated; the others are taken as unchanged.
    rows : int or None
        Number of first rows that are used; None uses all.
    skip : int
        Number of first rows that drive the memory but are left out of the estimate.
    state : object
        State before the first row; None is the operator's initial one.

    Raises
    ------
    ValueError
        If a kind is unknown or given twice, there are none, the lengths differ, the rows are too few, or they do not
        tell the kinds apart.
    """
    wanted = tuple(kinds)
    if not wanted:
        raise ValueError("expected at least one of " + ", ".join(KINDS))
    for kind in wanted:
        if kind not in KINDS:
            raise ValueError(f"expected some of {', '.join(KINDS)}, got {kind!r}")
        if wanted.count(kind) > 1:
            raise ValueError(f"{kind} is given twice")
    u = _checks.samples("inputs", inputs)
    y = _checks.counted("outputs", outputs, u.size, "values, one for each input")
    count = u.size if rows is None else rows
    if not 0 <= skip < count <= u.size or count - skip < 2 * len(wanted) + 3:
        raise ValueError(
            f"rows {skip} to {count} of {u.size} are too few for {len(wanted)} numbers; at least "
            f"{2 * len(wanted) + 3} are needed"
        )
    u, y, numbers = u[:count], y[skip:count], np.arange(skip, count, dtype=np.float64)
    if isinstance(operator, TimedSequence):
        operator = operator.first(count)

    def predicted(moved: float) -> Floats:
        return operator.evaluate(u + moved, state)[skip:]

    linear: list[Kind] = [kind for kind in wanted if kind != "input-offset"]

    def columns(model: Floats) -> Floats:
        by_kind = {"offset": np.ones_like(model), "gain": model, "drift": numbers}
        return np.column_stack([by_kind[kind] for kind in linear]) if linear else np.empty((model.size, 0))

    def solve(moved: float) -> tuple[Floats, Floats, Floats]:
        """Return the linear numbers, the residuals and the model's outputs."""
        model = predicted(moved)
        matrix = columns(model)
        fixed = np.zeros_like(model) if "gain" in linear else model
        found: Floats = np.linalg.lstsq(matrix, y - fixed, rcond=None)[0].astype(np.float64)
        return found, y - fixed - matrix @ found, model

    moved = _best_shift(operator, solve) if "input-offset" in wanted else 0.0
    found, residuals, model = solve(moved)
    jacobian = columns(model)
    if "input-offset" in wanted:
        step = 1e-4 * (operator.input_range[1] - operator.input_range[0])
        slope = (predicted(moved + step) - predicted(moved - step)) / (2.0 * step)
        gain = float(found[linear.index("gain")]) if "gain" in linear else 1.0
        jacobian = np.column_stack([jacobian, gain * slope])
    # In the order of the Jacobian's columns.
    names: list[Kind] = [*linear, *(kind for kind in wanted if kind == "input-offset")]
    values: dict[Kind, float] = dict(zip(names, [*found.tolist(), moved], strict=False))
    errors = dict(zip(names, _uncertainties(jacobian, residuals, names).tolist(), strict=True))
    return Recalibration(
        values={kind: values[kind] for kind in wanted},
        uncertainties={kind: errors[kind] for kind in wanted},
        rows=count,
        rms=float(np.sqrt(np.mean(residuals**2))),
    )


def _best_shift(operator: Operator[Any] | TimedSequence, solve: Any) -> float:  # noqa: ANN401
    """Return the input offset of the least squared residual."""
    from scipy.optimize import minimize_scalar

    def cost(moved: float) -> float:
        residuals = solve(moved)[1]
        return float(residuals @ residuals)

    low, high = operator.input_range
    most = _FARTHEST * (high - low)
    trials = np.linspace(-most, most, _TRIALS)
    best = int(np.argmin([cost(float(trial)) for trial in trials]))
    if best in (0, _TRIALS - 1):
        raise ValueError(
            f"input-offset: at {trials[best]:.3g} {operator.input_unit}, 10 % of the operating range, the rows still "
            "fit better; identify the model again, or use more rows"
        )
    around = (float(trials[best - 1]), float(trials[best + 1]))
    return float(minimize_scalar(cost, bounds=around, method="bounded", options={"xatol": 1e-7 * most}).x)


def _uncertainties(jacobian: Floats, residuals: Floats, names: list[Kind]) -> Floats:
    """Return standard uncertainties; raise ValueError if the columns are not independent."""
    evidence = Evidence.of(jacobian, residuals, residuals.size - len(names))
    apart = f"the rows do not tell {' and '.join(names)} apart"
    if (lost := np.isinf(evidence.deviations)).any():
        raise ValueError(
            f"{apart}: nothing depends on {names[int(np.argmax(lost))]}; use more rows, or fewer numbers"
        )
    if evidence.condition > _WORST:
        raise ValueError(f"{apart} (condition {evidence.condition:.1g}); use more rows, or fewer numbers")
    correlation = autocorrelation(residuals)
    return np.asarray(evidence.deviations * np.sqrt((1.0 + correlation) / (1.0 - correlation)))
