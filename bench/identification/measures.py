"""Error measures of a model against measured outputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models import Operator, TimedSequence


@dataclass(frozen=True)
class Errors:
    """How far a model is from what was measured.

    Parameters
    ----------
    maximum : float
        Greatest absolute error, output units.
    rms : float
        Root of the mean squared error, output units.
    average : float
        Mean absolute error, output units.
    span : float
        Range of the measured outputs that percentages refer to, output units.
    """

    maximum: float
    rms: float
    average: float
    span: float

    @property
    def maximum_percent(self) -> float:
        """Greatest absolute error in percent of the output range; NaN if that is zero."""
        return self._percent(self.maximum)

    @property
    def rms_percent(self) -> float:
        """RMS error in percent of the output range; NaN if that is zero."""
        return self._percent(self.rms)

    @property
    def average_percent(self) -> float:
        """Mean absolute error in percent of the output range; NaN if that is zero."""
        return self._percent(self.average)

    def to_json(self) -> dict[str, float]:
        """Return the errors for programs: `max`, `rms`, `average` in output units, and percentages."""
        return {
            "max": self.maximum,
            "rms": self.rms,
            "average": self.average,
            "max_percent": self.maximum_percent,
            "rms_percent": self.rms_percent,
            "average_percent": self.average_percent,
        }

    def _percent(self, value: float) -> float:
        return 100.0 * value / self.span if self.span > 0.0 else float("nan")


def measure_errors(measured: ArrayLike, predicted: ArrayLike) -> Errors:
    """Return the error measures of `predicted` against `measured`, both of shape (N,).

    Raises ValueError if the lengths differ, or a sequence is empty or not finite.
    """
    truth = _checks.samples("measured", measured)
    model = _checks.counted("predicted", predicted, truth.size, "values, as many as measured")
    error = np.abs(truth - model)
    return Errors(
        maximum=float(error.max()),
        rms=float(np.sqrt(np.mean(error**2))),
        average=float(error.mean()),
        span=float(np.ptp(truth)),
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """How one model does on a measured sequence.

    Parameters
    ----------
    raw : Errors
        Errors as they are.
    rezeroed : Errors
        Errors after re-zeroing the sensor: the constant offset that leaves the least RMS error is taken off.
    offset : float
        That offset, the mean of the residuals, output units.
    residuals : ndarray, shape (N,)
        Measured minus model output, raw, output units.
    """

    raw: Errors
    rezeroed: Errors
    offset: float
    residuals: Floats

    def to_json(self) -> dict[str, Any]:
        """Return errors and offset for programs."""
        return {"raw": self.raw.to_json(), "rezeroed": self.rezeroed.to_json(), "offset": self.offset}


def compare(
    models: Mapping[str, Operator[Any] | TimedSequence],
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    states: Mapping[str, Any] | None = None,
    skip: int = 0,
) -> dict[str, Comparison]:
    """Return how well each of several models predicts one measured sequence.

    Between sessions the offset of a sensor moves: the error with and without it are two different numbers.

    Parameters
    ----------
    models : mapping of str to Operator
        The models by name.
    inputs, outputs : array_like, shape (N,)
        The measured sequence.
    states : mapping of str to state, or None
        State before the first sample for models that shall not start from their initial state.
    skip : int
        Number of first samples left out of errors and offset.

    Raises
    ------
    ValueError
        If there is no model, a state belongs to none, the lengths differ, a sequence is empty or not finite, or
        nothing is left after `skip`.
    """
    sequence = _checks.samples("inputs", inputs)
    measured = _checks.counted("outputs", outputs, sequence.size, "values, one for each input")
    if not models:
        raise ValueError("models: expected at least one, got none")
    if not 0 <= skip < sequence.size:
        raise ValueError(f"skip: expected 0 <= skip < {sequence.size}, got {skip}")
    starts = {} if states is None else states
    strangers = sorted(set(starts) - set(models))
    if strangers:
        raise ValueError(f"states: expected names of models, got {', '.join(strangers)}")
    result = {}
    for name, model in models.items():
        predicted = model.evaluate(sequence, starts.get(name))
        residuals = measured - predicted
        offset = float(residuals[skip:].mean())
        result[name] = Comparison(
            raw=measure_errors(measured[skip:], predicted[skip:]),
            rezeroed=measure_errors(measured[skip:], predicted[skip:] + offset),
            offset=offset,
            residuals=residuals,
        )
    return result
