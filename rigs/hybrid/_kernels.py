"""Compiled step of the Kalman filter of the thermal part. Imported on first use only."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from bench.compiled import inner, kernel
from bench.hysteresis._checks import Floats

STATES = 4
READINGS = 3

POINTS = 2 * STATES
"""Sigma points: two for each state; the centre has no weight."""


class Filter(NamedTuple):
    """Constants and state of the filter; mean and covariance are changed in place."""

    mean: Floats
    """Rises of base and tip (K), disturbing heat (W), offset of the deflection (m); shape (4,)."""
    covariance: Floats
    """Of the mean, shape (4, 4)."""
    walk: Floats
    """Variances of the random walk in a step, shape (4,)."""
    reading_noise: Floats
    """Variances of the readings, shape (3,)."""
    network: Floats
    """Step (s), conductances along the beam and from the tip to air (W/K), heat capacities of base and tip (J/K)."""
    bending: Floats
    """Range of the polynomial, low and high (K), its middle and half its width (K)."""
    points: Floats
    seen: Floats
    expected: Floats
    variance: Floats
    factor: Floats
    gain: Floats
    """Room for sigma points, what is read in them, its mean and covariance, a Cholesky factor, and the gain."""
    powers: Floats
    """Of the polynomial of the deflection, highest first."""
    slopes: Floats
    """Of its derivative, likewise."""


_SHAPES = (
    (STATES,),
    (STATES, STATES),
    (STATES,),
    (READINGS,),
    (5,),
    (4,),
    (POINTS, STATES),
    (POINTS, READINGS),
    (READINGS,),
    (READINGS, READINGS),
    (STATES, STATES),
    (STATES, READINGS),
)
"""Of the parts of a filter, up to the polynomial."""

_PLACES = tuple(accumulate((math.prod(shape) for shape in _SHAPES), initial=0))
"""Where each part begins, and at last the polynomial."""


def allocate(powers: int) -> tuple[Floats, Filter]:
    """Return zeros for a filter as one array, and its parts as views; the polynomial has so many powers.

    One array passes into a compiled function within a microsecond, a tuple of many takes ten.
    """
    shapes = (*_SHAPES, (powers,), (powers - 1,))
    sizes = [math.prod(shape) for shape in shapes]
    numbers = np.zeros(sum(sizes))
    parts = np.split(numbers, np.cumsum(sizes)[:-1])
    return numbers, Filter(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))


@inner
def _parts(numbers: Floats) -> Filter:
    """Return the parts of a filter, as `allocate` does."""
    at = _PLACES
    polynomial = numbers[at[12] :]
    powers = (polynomial.size + 1) // 2
    return Filter(
        numbers[at[0] : at[1]],
        numbers[at[1] : at[2]].reshape((STATES, STATES)),
        numbers[at[2] : at[3]],
        numbers[at[3] : at[4]],
        numbers[at[4] : at[5]],
        numbers[at[5] : at[6]],
        numbers[at[6] : at[7]].reshape((POINTS, STATES)),
        numbers[at[7] : at[8]].reshape((POINTS, READINGS)),
        numbers[at[8] : at[9]],
        numbers[at[9] : at[10]].reshape((READINGS, READINGS)),
        numbers[at[10] : at[11]].reshape((STATES, STATES)),
        numbers[at[11] : at[12]].reshape((STATES, READINGS)),
        polynomial[:powers],
        polynomial[powers:],
    )


@inner
def _factorise(matrix: Floats, factor: Floats, scale: float) -> None:
    """Find the Cholesky factor of a multiple of a positive definite matrix, in the lower triangle.

    In plain loops, so that the filter gives the same on every machine, as it would not with the BLAS of numpy.
    """
    for j in range(matrix.shape[0]):
        for i in range(j, matrix.shape[0]):
            total = scale * matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(total) if i == j else total / factor[j, j]


@inner
def _spread(f: Filter) -> None:
    """Find the sigma points of the distribution."""
    # √n standard deviations of n states, so that the centre has no weight: the cubature rule, with equal positive
    # weights and without cancellation.
    _factorise(f.covariance, f.factor, float(STATES))
    for j in range(STATES):
        for i in range(STATES):
            step = f.factor[j, i] if i <= j else 0.0
            f.points[i, j] = f.mean[j] + step
            f.points[STATES + i, j] = f.mean[j] - step


@inner
def _average(points: Floats, mean: Floats) -> None:
    """Find the mean of sigma points."""
    for j in range(mean.size):
        total = 0.0
        for k in range(POINTS):
            total += points[k, j]
        mean[j] = total / POINTS


@inner
def _correlate(first: Floats, mean: Floats, second: Floats, other: Floats, result: Floats) -> None:
    """Find the covariance of sigma points of two quantities with their means."""
    for i in range(mean.size):
        for j in range(other.size):
            total = 0.0
            for k in range(POINTS):
                total += (first[k, i] - mean[i]) * (second[k, j] - other[j])
            result[i, j] = total / POINTS


@inner
def _deflection(rise: float, f: Filter) -> float:
    """Return the deflection (m) at a rise of the tip (K), as `Bending.deflection` does."""
    low, high, middle, half = f.bending
    inside = min(max(rise, low), high)
    x = (inside - middle) / half
    total = 0.0
    for power in f.powers:
        total = total * x + power
    if inside == rise:
        return total
    slope = 0.0
    for each in f.slopes:
        slope = slope * x + each
    beyond: float = total + slope / half * (rise - inside)
    return beyond


@kernel
def predict(constant: float, slope: float, numbers: Floats) -> None:
    """Advance the distribution by a step; the heat into the base is `constant` (W) + `slope` (W/K) times its rise."""
    _predict(constant, slope, _parts(numbers))


@kernel
def predict_and_correct(
    constant: float, slope: float, base: float, tip: float, deflection: float, numbers: Floats
) -> None:
    """Advance as `predict`, then take in rises of base and tip (K) and the deflection (m)."""
    f = _parts(numbers)
    _predict(constant, slope, f)
    _correct(base, tip, deflection, f)


@inner
def _predict(constant: float, slope: float, f: Filter) -> None:
    """Advance the distribution by a step; the heat into the base is `constant` (W) + `slope` (W/K) times its rise."""
    dt, along, air, base_capacity, tip_capacity = f.network
    _spread(f)
    points = f.points
    for k in range(POINTS):
        base, tip, heat = points[k, 0], points[k, 1], points[k, 2]
        flow = (base - tip) * along
        points[k, 0] = base + dt * (constant + slope * base + heat - flow) / base_capacity
        points[k, 1] = tip + dt * (flow - air * tip) / tip_capacity
    _average(points, f.mean)
    _correlate(points, f.mean, points, f.mean, f.covariance)
    for i in range(STATES):
        f.covariance[i, i] += f.walk[i]


@inner
def _correct(base: float, tip: float, deflection: float, f: Filter) -> None:
    """Take in rises of base and tip (K) and the deflection (m)."""
    _spread(f)
    points, seen, expected, variance, factor, gain = f.points, f.seen, f.expected, f.variance, f.factor, f.gain
    for k in range(POINTS):
        seen[k, 0], seen[k, 1] = points[k, 0], points[k, 1]
        seen[k, 2] = _deflection(points[k, 1], f) + points[k, 3]
    _average(seen, expected)
    _correlate(seen, expected, seen, expected, variance)
    for j in range(READINGS):
        variance[j, j] += f.reading_noise[j]
    _correlate(points, f.mean, seen, expected, gain)
    # Each row times the inverse of the variance, by its factor.
    _factorise(variance, factor, 1.0)
    for i in range(STATES):
        for j in range(READINGS):
            for k in range(j):
                gain[i, j] -= gain[i, k] * factor[j, k]
            gain[i, j] /= factor[j, j]
        for j in range(READINGS - 1, -1, -1):
            for k in range(j + 1, READINGS):
                gain[i, j] -= gain[i, k] * factor[k, j]
            gain[i, j] /= factor[j, j]
    for i in range(STATES):
        f.mean[i] += (
            gain[i, 0] * (base - expected[0])
            + gain[i, 1] * (tip - expected[1])
            + gain[i, 2] * (deflection - expected[2])
        )
        for j in range(STATES):
            for k in range(READINGS):
                for m in range(READINGS):
                    f.covariance[i, j] -= gain[i, k] * variance[k, m] * gain[j, m]
