"""Kalman estimators that protocols and controllers share."""

from __future__ import annotations

import math

import numpy as np


class DriftEstimator:
    """Estimates how fast a signal still drifts, from readings at any spacing.

    Parameters
    ----------
    noise : float
        Standard deviation of one reading, in units of the signal.
    agility : float
        Standard deviation by which the drift itself may change in one second, in units/s per √s. Choose the
        drift that still matters: then the estimate forgets a faster past within a few seconds.

    Raises
    ------
    ValueError
        If a parameter is not positive.

    Notes
    -----
    A Kalman filter with the state (value, drift) and white acceleration of spectral density `agility`²
    (Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001,
    section 6.2.2), carried out by filterpy.
    """

    def __init__(self, *, noise: float, agility: float) -> None:
        if not (noise > 0 and agility > 0):
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
            If the reading is not a finite number or its time goes back.
        """
        if not math.isfinite(value):
            raise ValueError(f"value: expected a finite number, got {value}")
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
