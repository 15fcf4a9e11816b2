"""Error measures of a model against measured outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bench.hysteresis import _checks


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

    def _percent(self, value: float) -> float:
        return 100.0 * value / self.span if self.span > 0.0 else float("nan")


def measure_errors(measured: ArrayLike, predicted: ArrayLike) -> Errors:
    """Return the error measures of `predicted` against `measured`, both of shape (N,).

    Raises
    ------
    ValueError
        If the lengths differ, or a sequence is empty or not finite.
    """
    truth = _checks.samples("measured", measured)
    model = _checks.samples("predicted", predicted)
    if truth.size != model.size:
        raise ValueError(f"predicted: expected {truth.size} values, as many as measured, got {model.size}")
    error = np.abs(truth - model)
    return Errors(
        maximum=float(error.max()),
        rms=float(np.sqrt(np.mean(error**2))),
        average=float(error.mean()),
        span=float(np.ptp(truth)),
    )
