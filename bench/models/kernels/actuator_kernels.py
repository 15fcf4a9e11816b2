"""An actuator, step by step on its time grid; compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats, Table, inner, kernel

STATE_SIZE = 5
"""Numbers of the state of the drive. Derivation: position, velocity, lagged, wander, unevenness."""

_POWERS = 32
"""Powers of two for any number of steps of a grid. Derivation: 2³² steps would be 34 GB."""


@kernel
def move(
    position: float,
    velocity: float,
    setpoints: Floats,
    positions: Floats,
    step: float,
    frequency: float,
    damping: float,
    rate: float,
) -> tuple[float, float]:
    """Move an actuator by as many grid steps as there are set-points; return its last position and velocity.

    A frequency of 0 is one that follows at once, a damping of 0 one of first order. `positions` are those after each
    step.
    """
    if frequency <= 0.0:
        for k in range(setpoints.size):
            position = positions[k] = setpoints[k]
        return position, 0.0
    if damping <= 0.0:
        share = 1.0 - math.exp(-frequency * step)
        most = rate * step
        for k in range(setpoints.size):
            position += min(max((setpoints[k] - position) * share, -most), most)
            positions[k] = position
        return position, velocity
    # Steps short enough for the pole, whatever the grid.
    inner = max(1, math.ceil(frequency * max(1.0, 2.0 * damping) * step / 0.1))
    h = step / inner
    for k in range(setpoints.size):
        target = setpoints[k]
        for _ in range(inner):
            velocity += h * (frequency * frequency * (target - position) - 2.0 * damping * frequency * velocity)
            velocity = min(max(velocity, -rate), rate)
            position += h * velocity
        positions[k] = position
    return position, velocity


@inner
def signed_power(value: float, power: float) -> float:
    """Return |value|^power with the sign of the value."""
    return value if power == 1.0 else math.copysign(abs(value) ** power, value)


@kernel
def hold_back(lagged: float, positions: Floats, seen: Floats, step: float, lag: float, power: float) -> float:
    """Write what an operator behind a lag sees of each position to `seen`; return the last |x|^power.

    `lagged` is the state of the lag before the first.
    """
    if lag <= 0.0:
        # As a loop: numba takes 2 s to compile the assignment of a slice.
        for k in range(positions.size):
            seen[k] = positions[k]
        return lagged
    remains = math.exp(-step / lag)
    for k in range(positions.size):
        source = signed_power(positions[k], power)
        lagged = source + (lagged - source) * remains
        seen[k] = signed_power(lagged, 1.0 / power)
    return lagged


@kernel
def follow(
    state: Floats,
    setpoints: Floats,
    normals: Table,
    out: Table,
    step: float,
    frequency: float,
    damping: float,
    rate: float,
    lag: float,
    power: float,
    wander: float,
    wander_time: float,
    uneven: float,
    uneven_length: float,
) -> None:
    """Move the drive by as many grid steps as there are set-points; write what the operator sees to `out`.

    Actuator and lag are as for `move` and `hold_back`. Rows of `out`: what the actuator did; and that with the
    wander, behind the lag, and with the unevenness. Rows of `normals` are standard normal numbers: for the wander,
    and for the unevenness.
    """
    before, lagged, drift, place = state[0], state[2], state[3], state[4]
    state[0], state[1] = move(state[0], state[1], setpoints, out[0], step, frequency, damping, rate)
    remains = math.exp(-step / lag) if lag > 0.0 else 0.0
    decay = math.exp(-step / wander_time)
    kick = wander * math.sqrt(1.0 - decay * decay)
    for k in range(setpoints.size):
        position = out[0, k]
        drift = decay * drift + kick * normals[0, k]
        if uneven > 0.0 and position != before:
            kept = math.exp(-abs(position - before) / uneven_length)
            place = kept * place + uneven * math.sqrt(1.0 - kept * kept) * normals[1, k]
        before = position
        source = signed_power(position + drift, power)
        lagged = source + (lagged - source) * remains
        out[1, k] = signed_power(lagged, 1.0 / power) + place
    state[2], state[3], state[4] = lagged, drift, place


@kernel
def creep(slow: Floats, outputs: Table, step: float, shares: Floats, times: Floats) -> None:
    """Replace outputs by what they are with their slow parts, each a lag of first order; `slow` is their state."""
    for j in range(times.size):
        remains = math.exp(-step / times[j])
        value = slow[j]
        for k in range(outputs.shape[1]):
            value = outputs[0, k] + (value - outputs[0, k]) * remains
            outputs[1, k] += shares[j] * value
        slow[j] = value


@kernel
def lag_behind(outputs: Floats, step: float, times: Floats, late: Table) -> None:
    """Write outputs behind lags of first order, which begin at rest, to the rows of `late`, one for each time, s."""
    for j in range(times.size):
        remains = math.exp(-step / times[j])
        value = outputs[0]
        for k in range(outputs.size):
            value = (1.0 - remains) * outputs[k] + remains * value
            late[j, k] = value


@kernel
def step_means(changes: Floats, levels: Floats, step: float, means: Floats) -> None:
    """Write the mean of a quantity over each step of a grid of time to `means`.

    It is `levels[0]` at first and `levels[i + 1]` from `changes[i]` on, s.
    """
    at, instant, area, before = 0, 0.0, 0.0, 0.0
    for k in range(means.size + 1):
        edge = step * k
        while at < changes.size and changes[at] <= edge:
            area += levels[at] * (changes[at] - instant)
            instant = changes[at]
            at += 1
        integral = area + levels[at] * (edge - instant)
        if k > 0:
            means[k - 1] = (integral - before) / step
        before = integral


@kernel
def find_holds(
    changes: Floats, levels: Floats, step: float, count: int, starts: NDArray[np.int64], means: Floats
) -> int:
    """Find between which of `count` steps of a grid the mean of a quantity changes; return how often it stands.

    It is `means[i]` from step `starts[i]` on. The quantity is given as for `step_means`.
    """
    found, at, k = 0, 0, 0
    while k < count:
        starts[found] = k
        if at < changes.size and changes[at] < step * (k + 1):
            area, instant = 0.0, step * k
            while at < changes.size and changes[at] < step * (k + 1):
                area += levels[at] * (changes[at] - instant)
                instant = changes[at]
                at += 1
            means[found] = (area + levels[at] * (step * (k + 1) - instant)) / step
            k += 1
        else:
            means[found] = levels[at]
            k = max(int(changes[at] / step), k + 1) if at < changes.size else count
            # As rounded as the ends of steps are.
            while k < count and changes[at] >= step * (k + 1):
                k += 1
            k = min(k, count)
        found += 1
    return found


@inner
def _advance(
    distance: float,
    velocity: float,
    steps: int,
    powers: Floats,
    inner: int,
    step: float,
    frequency: float,
    damping: float,
    rate: float,
) -> tuple[float, float]:
    """Return the distance to a set-point that stands, and the velocity, after some steps of the grid."""
    h = step / inner
    while steps > 0:
        if damping <= 0.0:
            is_linear = abs(distance) * (1.0 - powers[0, 0, 0]) <= rate * step
        else:
            # The energy falls; that of short steps differs by less than a quarter.
            is_linear = 1.5 * (frequency * frequency * distance * distance + velocity * velocity) <= rate * rate
        if is_linear:
            i = 0
            while steps > 0:
                if steps & 1:
                    distance, velocity = (
                        powers[i, 0, 0] * distance + powers[i, 0, 1] * velocity,
                        powers[i, 1, 0] * distance + powers[i, 1, 1] * velocity,
                    )
                steps >>= 1
                i += 1
        elif damping <= 0.0:
            distance -= math.copysign(rate * step, distance)
            steps -= 1
        else:
            for _ in range(inner):
                velocity += h * (frequency * frequency * distance - 2.0 * damping * frequency * velocity)
                velocity = min(max(velocity, -rate), rate)
                distance -= h * velocity
            steps -= 1
    return distance, velocity


@kernel
def move_to_rows(
    position: float,
    starts: NDArray[np.int64],
    setpoints: Floats,
    times: Floats,
    positions: Floats,
    step: float,
    frequency: float,
    damping: float,
    rate: float,
) -> None:
    """Write the positions of an actuator at some rows: those of `move`, and between points of the grid linear ones.

    `setpoints[i]` stands from step `starts[i]` to `starts[i + 1]`. Times of the rows, s, do not fall. As long as the
    rate does not bound the actuator, any number of steps is a power of the linear map that is one.
    """
    inner = max(1, math.ceil(frequency * max(1.0, 2.0 * damping) * step / 0.1))
    h = step / inner
    powers = np.zeros((_POWERS, 2, 2))
    if damping <= 0.0:
        powers[0, 0, 0] = math.exp(-frequency * step)
    else:
        powers[0, 0, 0] = powers[0, 1, 1] = 1.0
        for _ in range(inner):
            for j in range(2):
                powers[0, 1, j] += h * frequency * (frequency * powers[0, 0, j] - 2.0 * damping * powers[0, 1, j])
                powers[0, 0, j] -= h * powers[0, 1, j]
    for i in range(1, _POWERS):
        one = powers[i - 1]
        for j in range(2):
            for k in range(2):
                powers[i, j, k] = one[j, 0] * one[0, k] + one[j, 1] * one[1, k]
    velocity, row = 0.0, 0
    while row < times.size and times[row] <= 0.0:
        positions[row] = position
        row += 1
    for i in range(setpoints.size):
        at, distance = starts[i], setpoints[i] - position
        while row < times.size and times[row] < step * starts[i + 1]:
            before = max(int(times[row] / step), at)
            distance, velocity = _advance(
                distance, velocity, before - at, powers, inner, step, frequency, damping, rate
            )
            at = before
            after, _ = _advance(distance, velocity, 1, powers, inner, step, frequency, damping, rate)
            positions[row] = setpoints[i] - distance + (distance - after) * (times[row] / step - at)
            row += 1
        distance, velocity = _advance(
            distance, velocity, starts[i + 1] - at, powers, inner, step, frequency, damping, rate
        )
        position = setpoints[i] - distance
    positions[row:] = position
