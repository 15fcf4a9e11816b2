"""Kalman estimators that protocols and controllers share."""

from __future__ import annotations

import math

import numpy as np


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
    section 6.2.2), carried out by filterpy.
    """

    def __init__(self, *, noise: float, agility: float) -> None:
        if not (0 < noise < math.inf and 0 < agility < math.inf):
            raise ValueError(f"noise, agility: expected positive numbers, got {noise} and {agility}")
        # Half a second of import that only those who settle until steady shall pay.
        from filterpy.kalman import KalmanFilter

        self._filter = KalmanFilter(dim_x=2, dim_z=1)
        self._filter.H = np.array([[1.0, 0.0]])
        self._filter.R = np.array([[noise**2]])
        self._noise = noise
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
            # Nothing is known of the drift; the first reading fixes the value.
            self._filter.P = np.diag([self._noise**2, (1e6 * max(self._noise, self._agility)) ** 2])
        else:
            dt = t - self._time
            if dt < 0:
                raise ValueError(f"t: expected a time not before {self._time}, got {t}")
            self._filter.F = np.array([[1.0, dt], [0.0, 1.0]])
            density = self._agility**2
            self._filter.Q = density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            self._filter.predict()
            self._filter.update(np.array([value]))
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
        return self._readings >= 2 and abs(self.drift) + self.uncertainty <= limit
