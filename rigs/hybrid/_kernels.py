"""Compiled parts of the control of the thermal part: model, Kalman filter, heat. Imported on first use only."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from bench.base import Floats, Table, inner, kernel

NETWORK = 13
"""Numbers of a `Network`; the last one is its state."""

STATES = 4
READINGS = 3

POINTS = 2 * STATES
"""Sigma points: two for each state; the centre has no weight."""


class Network(NamedTuple):
    """The thermal network in single numbers; see `rigs.hybrid.estimates.ReducedNetwork`."""

    kelvin: float
    """Temperature of the room, K."""
    seebeck: float
    """Of the cooler, V/K."""
    resistance: float
    """Of the cooler, Ω."""
    along: float
    glue: float
    cooler: float
    """Conductances along the beam, of the glue and of the cooler, W/K."""
    base_air: float
    tip_air: float
    block_air: float
    """Conductances of base, tip and block to the air, W/K."""
    base_capacity: float
    tip_capacity: float
    block_capacity: float
    """Heat capacities, J/K."""
    block: float
    """Rise of the block, K."""


@inner
def _network(n: Floats) -> Network:
    return Network(n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8], n[9], n[10], n[11], n[12])


@inner
def _back(base: float, current: float, n: Network) -> float:
    """Return the rise of the face between cooler and glue, K."""
    pumped = n.seebeck * current
    flow = 0.5 * n.resistance * current**2 - pumped * n.kelvin
    rise: float = (flow + base * n.cooler + n.block * n.glue) / (n.glue + n.cooler + pumped)
    return rise


@kernel
def advance_block(base: float, current: float, dt: float, network: Floats) -> None:
    """Advance the block by dt (s), under the rise of the base (K) and the current (A)."""
    n = _network(network)
    flow = (_back(base, current, n) - n.block) * n.glue - n.block * n.block_air
    network[NETWORK - 1] += dt * flow / n.block_capacity


@kernel
def heat_flow(current: float, network: Floats) -> tuple[float, float]:
    """Return the heat into the base as constant (W) and slope (W/K) of its rise, at a current (A)."""
    n = _network(network)
    pumped = n.seebeck * current
    constant = pumped * n.kelvin + 0.5 * n.resistance * current**2
    slope = pumped - n.cooler
    total = n.glue + n.cooler + pumped
    back = 0.5 * n.resistance * current**2 - pumped * n.kelvin + n.block * n.glue
    return constant + n.cooler * back / total, slope + n.cooler**2 / total - n.base_air


@kernel
def heat_for(rise: float, rate: float, base: float, current: float, network: Floats) -> float:
    """Return the heat from the cooler (W); see `rigs.hybrid.estimates.ReducedNetwork.heat_for`."""
    n = _network(network)
    share = 1.0 + n.tip_air / n.along
    stored = (n.base_capacity * share + n.tip_capacity) * rate
    lost = (n.base_air * share + n.tip_air) * rise
    heat: float = stored + lost + (share * rise - _back(base, current, n)) * n.cooler
    return heat


@kernel
def current_for(heat: float, base: float, network: Floats) -> float:
    """Return the smaller of the currents (A) that give a heat (W) at the rise of the base (K)."""
    n = _network(network)
    pumped = n.seebeck * (n.kelvin + base)
    # Beyond the strongest cooling no current gives the heat: the strongest is returned.
    square = max(pumped * pumped + 2.0 * n.resistance * heat, 0.0)
    current: float = 2.0 * heat / (pumped + math.sqrt(square))
    return current


@kernel
def deflection(rise: float, bending: Floats, powers: Floats, slopes: Floats) -> float:
    """Return the deflection (m) at a rise of the tip (K); `bending` and the rest as in `Filter`."""
    low, high, middle, half = bending
    inside = min(max(rise, low), high)
    x = (inside - middle) / half
    total = 0.0
    for power in powers:
        total = total * x + power
    if inside == rise:
        return total
    beyond: float = total + slope(inside, bending, slopes) * (rise - inside)
    return beyond


@kernel
def slope(rise: float, bending: Floats, slopes: Floats) -> float:
    """Return the deflection per rise (m/K)."""
    low, high, middle, half = bending
    x = (min(max(rise, low), high) - middle) / half
    total = 0.0
    for each in slopes:
        total = total * x + each
    per_rise: float = total / half
    return per_rise


@kernel
def rise_for(wanted: float, table: Table) -> float:
    """Return the rise of the tip (K) for a deflection (m), at most that at the end of the table.

    `table`, shape (2, N), has increasing deflections (m) and their rises (K).
    """
    deflections, rises = table[0], table[1]
    k = np.searchsorted(deflections, wanted, side="right") - 1
    if k < 0 or k + 1 == rises.size:
        end: float = rises[max(k, 0)]
        return end
    per_deflection = (rises[k + 1] - rises[k]) / (deflections[k + 1] - deflections[k])
    rise: float = per_deflection * (wanted - deflections[k]) + rises[k]
    return rise


@kernel
def next_current(
    ahead: float,
    rate: float,
    missing: float,
    base: float,
    current: float,
    fed_back: float,
    settings: Floats,
    network: Floats,
    bending: Floats,
    slopes: Floats,
    table: Table,
) -> tuple[float, float]:
    """Return the current of the coming period (A), and the heat that is fed back over time (W).

    Parameters
    ----------
    ahead, rate : float
        Reference that the heat leads to, m, and its derivative, m/s.
    missing : float
        Reference of now less the estimated deflection, m.
    base, current, fed_back : float
        Rise of the base, K; current (A) and heat fed back over time (W) of the past period.
    settings : numpy.ndarray, shape (4,)
        Heat fed back per missing deflection, W/m; period and time constant of its integral, s; greatest current, A.
    network, bending, slopes, table : numpy.ndarray
        Numbers of the model.
    """
    gain, period, integral_time, most = settings
    rise = rise_for(ahead, table)
    per_rise = slope(rise, bending, slopes)
    heat = heat_for(rise, rate / per_rise, base, current, network)
    # Heat deflects negatively: the sign is that of the slope.
    lacking = math.copysign(gain, per_rise) * missing
    further = fed_back + lacking * period / integral_time
    wanted = current_for(heat + lacking + further, base, network)
    clipped = min(max(wanted, -most), most)
    # At the limit the integral only moves away from it.
    return clipped, further if clipped == wanted or lacking * wanted < 0.0 else fed_back


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
    """Find the Cholesky factor of a multiple of a positive definite matrix, in the lower triangle."""
    # In plain loops, so that the filter gives the same on every machine, as it would not with the BLAS of numpy.
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


@kernel
def predict(current: float, network: Floats, numbers: Floats) -> tuple[float, float]:
    """Advance the distribution by a step at a current (A); return the deflection, m, and its rate, m/s."""
    f = _parts(numbers)
    _predict(current, network, f)
    return _estimate(f)


@kernel
def predict_and_correct(
    current: float, base: float, tip: float, seen_deflection: float, network: Floats, numbers: Floats
) -> tuple[float, float]:
    """Advance as `predict`, take in rises of base and tip (K) and the deflection (m), and return the same."""
    f = _parts(numbers)
    _predict(current, network, f)
    _correct(base, tip, seen_deflection, f)
    return _estimate(f)


@inner
def _estimate(f: Filter) -> tuple[float, float]:
    """Return the estimated deflection, m, and its rate by the model, m/s."""
    here, there = f.mean[0], f.mean[1]
    _, along, air, _, tip_capacity = f.network
    cooling = ((here - there) * along - air * there) / tip_capacity
    value = deflection(there, f.bending, f.powers, f.slopes) + f.mean[3]
    return value, slope(there, f.bending, f.slopes) * cooling


@inner
def _predict(current: float, network: Floats, f: Filter) -> None:
    """Advance the distribution by a step."""
    constant, by_rise = heat_flow(current, network)
    dt, along, air, base_capacity, tip_capacity = f.network
    _spread(f)
    points = f.points
    for k in range(POINTS):
        base, tip, heat = points[k, 0], points[k, 1], points[k, 2]
        flow = (base - tip) * along
        points[k, 0] = base + dt * (constant + by_rise * base + heat - flow) / base_capacity
        points[k, 1] = tip + dt * (flow - air * tip) / tip_capacity
    _average(points, f.mean)
    _correlate(points, f.mean, points, f.mean, f.covariance)
    for i in range(STATES):
        f.covariance[i, i] += f.walk[i]


@inner
def _correct(base: float, tip: float, seen_deflection: float, f: Filter) -> None:
    """Take in rises of base and tip (K) and the deflection (m)."""
    _spread(f)
    points, seen, expected, variance, factor, gain = f.points, f.seen, f.expected, f.variance, f.factor, f.gain
    for k in range(POINTS):
        seen[k, 0], seen[k, 1] = points[k, 0], points[k, 1]
        seen[k, 2] = deflection(points[k, 1], f.bending, f.powers, f.slopes) + points[k, 3]
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
            + gain[i, 2] * (seen_deflection - expected[2])
        )
        for j in range(STATES):
            for k in range(READINGS):
                for m in range(READINGS):
                    f.covariance[i, j] -= gain[i, k] * variance[k, m] * gain[j, m]
