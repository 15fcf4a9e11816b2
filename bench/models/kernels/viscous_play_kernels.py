"""Compiled loops over viscous plays. Imported on first use only, because numba is slow to load."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.base import inner, kernel

Floats = NDArray[np.float64]

# Evaluations of an inverse; false position ends after some ten.
# Derivation: every fourth one halves the bracket; fifty halves leave 2⁻⁵⁰ of it, 1e-15.
_MOST = 200


@inner
def _moved(z: float, before: float, after: float, step: float, threshold: float, lag: float) -> float:
    """Return a play after the input went from `before` to `after` on a straight line: the exact solution.

    lag z' is what x leaves the band z ± threshold by. Without a lag, or in no time (`step` 0), the band is kept.
    """
    if lag == 0.0 or step == 0.0:
        return max(after - threshold, min(after + threshold, z))
    sign = 1.0
    if after < before:
        # Falling inputs are rising ones seen from below.
        sign, z, before, after = -1.0, -z, -before, -after
    speed = (after - before) / step
    behind = speed * lag
    left = step
    outside = before + threshold - z
    if outside < 0.0:
        # Drawn down towards an input that comes to meet it.
        meeting = lag * math.log1p(-outside / behind) if behind > 0.0 else step
        if meeting >= step:
            return sign * (after + threshold - behind - (outside - behind) * math.exp(-step / lag))
        left = step - meeting
        z = before + speed * meeting + threshold
    outside = after - speed * left - threshold - z
    if outside < 0.0:
        if after - threshold <= z:
            return sign * z
        left = min((after - threshold - z) / speed, left)
        outside = 0.0
    return sign * (after - threshold - behind - (outside - behind) * math.exp(-left / lag))


@kernel
def plays(inputs: Floats, steps: Floats, before: float, thresholds: Floats, lags: Floats, state: Floats) -> Floats:
    """Step plays through `inputs`; return their states sample by sample. `state` is changed.

    Parameters
    ----------
    inputs : ndarray, shape (N,)
        A straight line between samples.
    steps : ndarray, shape (N,)
        Time since the sample before, s; 0 at a beginning, at which each play stands as without a lag.
    before : float
        Input before the first sample; without effect at a beginning.
    thresholds, lags, state : ndarray, shape (K,)
        Input units, s, and input units.
    """
    result = np.empty((inputs.size, state.size))
    for n in range(inputs.size):
        for k in range(state.size):
            state[k] = _moved(state[k], before, inputs[n], steps[n], thresholds[k], lags[k])
            result[n, k] = state[k]
        before = inputs[n]
    return result


@kernel
def weighted_plays(
    inputs: Floats, steps: Floats, before: float, thresholds: Floats, lags: Floats, weights: Floats, state: Floats
) -> Floats:
    """Return the weighted sum of what `plays` returns, shape (N,). `state` is changed."""
    result = np.zeros(inputs.size)
    for n in range(inputs.size):
        for k in range(state.size):
            state[k] = _moved(state[k], before, inputs[n], steps[n], thresholds[k], lags[k])
            result[n] += weights[k] * state[k]
        before = inputs[n]
    return result


@inner
def _sum_at(
    x: float, before: float, step: float, thresholds: Floats, lags: Floats, weights: Floats, state: Floats
) -> float:
    total = 0.0
    for k in range(state.size):
        total += weights[k] * _moved(state[k], before, x, step, thresholds[k], lags[k])
    return total


@kernel
def inputs_for(
    targets: Floats,
    steps: Floats,
    before: float,
    low: float,
    high: float,
    thresholds: Floats,
    lags: Floats,
    weights: Floats,
    state: Floats,
) -> Floats:
    """Return the inputs from low to high that bring the weighted sum to targets, shape (N,), or closest to them.

    The sum never falls with the input, so that false position within a bracket finds it (the Illinois method, Dowell
    and Jarratt, BIT 11, 168-174, 1971). Weights >= 0; `state` is changed.
    """
    result = np.empty(targets.size)
    for n in range(targets.size):
        step = steps[n]
        a, b = low, high
        below = _sum_at(a, before, step, thresholds, lags, weights, state) - targets[n]
        above = _sum_at(b, before, step, thresholds, lags, weights, state) - targets[n]
        if below >= 0.0:
            found = a
        elif above <= 0.0:
            found = b
        else:
            found, side = before, 0
            for turn in range(_MOST):
                # Where the slope changes much, halves get there.
                found = 0.5 * (a + b) if turn % 4 == 3 else b - above * (b - a) / (above - below)
                if not a < found < b:
                    break
                rest = _sum_at(found, before, step, thresholds, lags, weights, state) - targets[n]
                if rest == 0.0:
                    break
                if rest < 0.0:
                    a, below = found, rest
                    above, side = (0.5 * above if side < 0 else above), -1
                else:
                    b, above = found, rest
                    below, side = (0.5 * below if side > 0 else below), 1
            found = min(max(found, a), b)
        for k in range(state.size):
            state[k] = _moved(state[k], before, found, step, thresholds[k], lags[k])
        result[n] = before = found
    return result
