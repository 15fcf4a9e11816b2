"""The likelihood of the errors of a model, by the innovations of a Kalman filter; compiled."""

from __future__ import annotations

import math

import numpy as np

from bench.base import Floats, kernel


@kernel
def deviance(
    errors: Floats,
    slopes: Floats,
    gaps: Floats,
    travels: Floats,
    variances: Floats,
    prior: float,
    wander: float,
    time: float,
    uneven: float,
    length: float,
    drift: float,
) -> float:
    """Return minus twice the logarithm of the likelihood of errors, but for a constant.

    Each is slope × (wander + unevenness) + drift + white noise of the given variance. `gaps` and `travels` are time
    and way of the drive since the row before; `prior` is the variance of the drift before the first. See Harvey,
    Forecasting, Structural Time Series Models and the Kalman Filter, 1989, equations 3.2.3 and 3.4.5.
    """
    state, covariance, gains, seen = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = wander * wander, uneven * uneven, prior
    kept = np.ones(3)
    found = 0.0
    for k in range(errors.size):
        kept[0], kept[1] = math.exp(-gaps[k] / time), math.exp(-travels[k] / length)
        for i in range(3):
            state[i] *= kept[i]
            for j in range(3):
                covariance[i, j] *= kept[i] * kept[j]
        covariance[0, 0] += wander * wander * (1.0 - kept[0] * kept[0])
        covariance[1, 1] += uneven * uneven * (1.0 - kept[1] * kept[1])
        covariance[2, 2] += drift * drift * gaps[k]
        for i in range(3):
            seen[i] = slopes[k] * (covariance[i, 0] + covariance[i, 1]) + covariance[i, 2]
        variance = slopes[k] * (seen[0] + seen[1]) + seen[2] + variances[k]
        innovation = errors[k] - slopes[k] * (state[0] + state[1]) - state[2]
        for i in range(3):
            gains[i] = seen[i] / variance
            state[i] += gains[i] * innovation
        for i in range(3):
            for j in range(3):
                covariance[i, j] -= gains[i] * seen[j]
        found += math.log(variance) + innovation * innovation / variance
    return found
