"""Kalman estimators that protocols and controllers share."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule

if TYPE_CHECKING:
    from filterpy import kalman
else:
    kalman = DeferredModule("filterpy.kalman")


def agility_for(*, drift: float, noise: float, period: float) -> float:
    """Return the agility with which a `DriftEstimator` can tell that a drift is below a limit.

    Parameters
    ----------
    drift : float
        The limit, in units of the signal per second.
    noise : float
        Standard deviation of one reading, in units of the signal.
    period : float
        Seconds between two readings.

    Returns
    -------
    float
        Agility in units/s per √s, with which the uncertainty of the drift comes down to about half of the
        limit; never more than the limit itself in one √s, as a faster past is then forgotten soon enough.

    Notes
    -----
    With many readings within the filter's memory its uncertainty tends to √√2 agility^¾ (noise² period)^⅛;
    with few it is what the drift may change within one period, agility √(period/3).
    """
    many = (0.5 / 2**0.25) ** (4 / 3) * (drift / (noise * math.sqrt(period))) ** (1 / 3)
    few = 0.5 / math.sqrt(period)
    return float(drift * min(1.0, many, few))


class DriftEstimator:
    """Estimates how fast a signal still drifts, from readings at any spacing.

    Parameters
    ----------
    noise : float
        Standard deviation of one reading, in units of the signal.
    agility : float
        Standard deviation by which the drift itself may change in one second, in units/s per √s; see
        `agility_for`.

    Raises
    ------
    ValueError
        If a parameter is not a positive finite number.

    Notes
    -----
    A Kalman filter with the state (value, drift) and white acceleration of spectral density `agility`²
    (Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001,
    section 6.2.2).
    """

    def __init__(self, *, noise: float, agility: float) -> None:
        if not (0 < noise < math.inf and 0 < agility < math.inf):
            raise ValueError(f"noise, agility: expected positive numbers, got {noise} and {agility}")
        self._filter = kalman.KalmanFilter(dim_x=2, dim_z=1)
        self._filter.H, self._filter.R = np.array([[1.0, 0.0]]), np.array([[noise**2]])
        # Nothing is known of the drift; the first reading fixes the value.
        self._filter.P = np.diag([noise**2, (1e6 * max(noise, agility)) ** 2])
        self._agility = agility
        self._time: float | None = None
        self._readings = 0

    def update(self, t: float, value: float) -> None:
        """Take in one reading.

        Parameters
        ----------
        t : float
            Time of the reading in s; not before that of the last.
        value : float
            The reading, in units of the signal.

        Raises
        ------
        ValueError
            If the reading or its time is not a finite number, or the time goes back.
        """
        if not math.isfinite(value):
            raise ValueError(f"value: expected a finite number, got {value}")
        if not math.isfinite(t):
            raise ValueError(f"t: expected a finite number, got {t}")
        if self._time is None:
            self._filter.x = np.array([value, 0.0])
        else:
            dt = t - self._time
            if dt < 0:
                raise ValueError(f"t: expected a time not before {self._time}, got {t}")
            walk = self._agility**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            self._filter.predict(F=np.array([[1.0, dt], [0.0, 1.0]]), Q=walk)
            self._filter.update(value)
        self._time = t
        self._readings += 1

    @property
    def drift(self) -> float:
        """The estimated drift, in units/s; nan before two readings."""
        return float(self._filter.x[1]) if self._readings >= 2 else math.nan

    @property
    def uncertainty(self) -> float:
        """Standard deviation of the estimated drift, in units/s; infinite before two readings."""
        return math.sqrt(float(self._filter.P[1, 1])) if self._readings >= 2 else math.inf

    def is_steady(self, limit: float) -> bool:
        """Return whether drift and uncertainty together are within `limit` (units/s)."""
        return abs(self.drift) + self.uncertainty <= limit


class DisturbanceEstimator:
    """Estimates the slowly changing difference between a measured and a predicted output.

    Parameters
    ----------
    walk_variance : float
        Variance q by which the disturbance may change between two updates, output units squared; larger
        than the sensor's part where the model's error changes from place to place.
    reading_variance : float
        Variance r of one update's value, output units squared; of a mean of n readings 1/n of a reading's.
    initial_variance : float or None
        Variance of the disturbance before the first reading, about 0. By default so large that the first
        reading fixes the value.

    Raises
    ------
    ValueError
        If a variance is not a positive finite number.

    Notes
    -----
    A Kalman filter of a random walk: P⁻ = P + q, K = P⁻ / (P⁻ + r),
    d += K (z - d), P = (1 - K) P⁻, with the steady state P⁻ = (q + √(q² + 4 q r)) / 2 (Bar-Shalom, Li,
    Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001). Where a
    controller takes the estimate away from its next target, and the true local gain is g times the
    model's, the error goes on by the factor 1 - K g: stable for 0 < K g < 2.
    """

    def __init__(
        self, *, walk_variance: float, reading_variance: float, initial_variance: float | None = None
    ) -> None:
        if not (0 < walk_variance < math.inf and 0 < reading_variance < math.inf):
            raise ValueError(
                "walk_variance, reading_variance: expected positive numbers, "
                f"got {walk_variance} and {reading_variance}"
            )
        first = 1e9 * (walk_variance + reading_variance) if initial_variance is None else initial_variance
        if not 0 < first < math.inf:
            raise ValueError(f"initial_variance: expected a positive number, got {initial_variance}")
        self._value = 0.0
        self._variance = first
        self._walk, self._noise = walk_variance, reading_variance

    def update(self, value: float | None) -> float:
        """Take in one measured disturbance and return the estimate.

        Parameters
        ----------
        value : float or None
            Measured minus predicted output, output units; None for a missing reading, of which only the
            uncertainty takes note.

        Raises
        ------
        ValueError
            If the value is not finite.
        """
        # A nan would stay in the estimate for ever.
        if value is not None and not math.isfinite(value):
            raise ValueError(f"value: expected a finite number or None, got {value}")
        self._variance += self._walk
        if value is not None:
            gain = self._variance * (1.0 / (self._variance + self._noise))
            self._value += gain * (value - self._value)
            # Joseph's form of (1 - K) P⁻, which stays positive.
            self._variance = (1.0 - gain) * self._variance * (1.0 - gain) + gain * self._noise * gain
        return self._value

    def shift(self, difference: float) -> None:
        """Take note that the prediction fell by a difference (output units), as that of a corrected model does."""
        self._value += difference

    @property
    def value(self) -> float:
        """The estimated disturbance, output units; 0 before the first reading."""
        return self._value

    @property
    def uncertainty(self) -> float:
        """Standard deviation of the estimate, output units."""
        return math.sqrt(self._variance)

    @property
    def gain(self) -> float:
        """The part K, 0 to 1, that the next value will have in the estimate."""
        predicted = self._variance + self._walk
        return predicted / (predicted + self._noise)
