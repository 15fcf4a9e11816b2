"""Error measures of a model against measured outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks


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


def autocorrelation(residuals: Floats) -> float:
    """Return the correlation of neighbouring residuals, shape (N,) or (N, n): 0 to 0.99, as 1 - it is divided by."""
    total = float(np.sum(residuals**2))
    return min(max(float(np.sum(residuals[1:] * residuals[:-1])) / total, 0.0), 0.99) if total > 0.0 else 0.0


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

    @classmethod
    def of(cls, measured: Floats, predicted: Floats, skip: int = 0) -> Comparison:
        """Return how well predicted outputs, shape (N,), are those measured.

        Between sessions the offset of a sensor moves: the error with and without it are two different numbers. The
        first `skip` samples count neither in errors nor in the offset.

        Raises ValueError if nothing is left after `skip`.
        """
        if not 0 <= skip < measured.size:
            raise ValueError(f"skip: expected 0 <= skip < {measured.size}, got {skip}")
        residuals = measured - predicted
        offset = float(residuals[skip:].mean())
        raw, rezeroed = (measure_errors(measured[skip:], predicted[skip:] + shift) for shift in (0.0, offset))
        return cls(raw, rezeroed, offset, residuals)

    def to_json(self) -> dict[str, Any]:
        """Return errors and offset for programs."""
        return {"raw": self.raw.to_json(), "rezeroed": self.rezeroed.to_json(), "offset": self.offset}
