"""Compiled loops of models with time. Imported on first use only, because numba is slow to load."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@njit(cache=True)
def filtered(
    columns: Floats,
    steps: Floats,
    lag: float,
    free: Floats,
    rows: Integers,
    offsets: Floats,
    late: Floats,
    value: Floats,
    rate: Floats,
) -> Floats:
    """Return columns behind 1 / (1 + lag s + a2 s²), exact for inputs that are linear between samples.

    On a ramp of slope m the forced part is v - lag m; what is left decays freely. `value` and `rate`, shape (K,), are
    the filter's state at the first sample, and at the last on return.

    Parameters
    ----------
    columns : ndarray, shape (N, K)
        One column an input.
    steps : ndarray, shape (N - 1,)
        s.
    lag : float
        s.
    free : ndarray, shape (N - 1, 4)
        Free evolution of (value, rate) over each step, row by row.
    rows : ndarray of int64, shape (P,)
        The sample after which an output is wanted, in increasing order; -1 before the first.
    offsets : ndarray, shape (P,)
        How long after that sample, s.
    late : ndarray, shape (P, 2)
        First row of the free evolution over each offset.
    value, rate : ndarray, shape (K,)
        State, input units and input units / s.
    """
    samples, count = columns.shape
    result = np.empty((rows.size, count))
    wanted = 0
    while wanted < rows.size and rows[wanted] < 0:
        for k in range(count):
            result[wanted, k] = value[k]
        wanted += 1
    for n in range(samples):
        last = n == samples - 1
        while wanted < rows.size and rows[wanted] == n:
            for k in range(count):
                slope = 0.0 if last else (columns[n + 1, k] - columns[n, k]) / steps[n]
                left = value[k] - columns[n, k] + lag * slope
                forced = columns[n, k] + slope * (offsets[wanted] - lag)
                result[wanted, k] = forced + late[wanted, 0] * left + late[wanted, 1] * (rate[k] - slope)
            wanted += 1
        if last:
            break
        for k in range(count):
            slope = (columns[n + 1, k] - columns[n, k]) / steps[n]
            left, more = value[k] - columns[n, k] + lag * slope, rate[k] - slope
            value[k] = columns[n + 1, k] - lag * slope + free[n, 0] * left + free[n, 1] * more
            rate[k] = slope + free[n, 2] * left + free[n, 3] * more
    return result
