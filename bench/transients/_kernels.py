"""An actuator, step by step on its time grid; compiled."""

from __future__ import annotations

import math

from numba import njit

from bench.hysteresis._checks import Floats

STATE_SIZE = 5
"""Numbers of the state of the drive: position, velocity, lagged, wander, unevenness."""


@njit(cache=True)
def follow(
    state: Floats,
    setpoints: Floats,
    normals: Floats,
    out: Floats,
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

    A frequency of 0 is an actuator that follows at once, a damping of 0 one of first order. Rows of `out`: what
    the actuator did, and that with the lag before the operator, the wander and the unevenness. Rows of `normals` are
    standard normal numbers: for the wander, and for the unevenness.
    """
    decay = math.exp(-step / wander_time)
    kick = wander * math.sqrt(1.0 - decay * decay)
    remains = math.exp(-step / lag) if lag > 0.0 else 0.0
    position, velocity, lagged, drift, place = state[0], state[1], state[2], state[3], state[4]
    # Steps short enough for the pole, whatever the grid.
    inner = max(1, math.ceil(frequency * max(1.0, 2.0 * damping) * step / 0.1))
    h = step / inner
    first = math.exp(-frequency * step)
    for k in range(setpoints.size):
        target = setpoints[k]
        before = position
        if frequency <= 0.0:
            position, velocity = target, 0.0
        elif damping <= 0.0:
            move = (target - position) * (1.0 - first)
            position += min(max(move, -rate * step), rate * step)
        else:
            for _ in range(inner):
                velocity += h * (frequency * frequency * (target - position) - 2.0 * damping * frequency * velocity)
                velocity = min(max(velocity, -rate), rate)
                position += h * velocity
        if lag > 0.0:
            source = position if power == 1.0 else math.copysign(abs(position) ** power, position)
            lagged = source + (lagged - source) * remains
            seen = lagged if power == 1.0 else math.copysign(abs(lagged) ** (1.0 / power), lagged)
        else:
            seen = position
        drift = decay * drift + kick * normals[0, k]
        if uneven > 0.0 and position != before:
            kept = math.exp(-abs(position - before) / uneven_length)
            place = kept * place + uneven * math.sqrt(1.0 - kept * kept) * normals[1, k]
        out[0, k] = position
        out[1, k] = seen + drift + place
    state[0], state[1], state[2], state[3], state[4] = position, velocity, lagged, drift, place


@njit(cache=True)
def creep(slow: Floats, outputs: Floats, step: float, shares: Floats, times: Floats) -> None:
    """Replace outputs by what they are with their slow parts, each a lag of first order; `slow` is their state."""
    for j in range(times.size):
        remains = math.exp(-step / times[j])
        value = slow[j]
        for k in range(outputs.shape[1]):
            value = outputs[0, k] + (value - outputs[0, k]) * remains
            outputs[1, k] += shares[j] * value
        slow[j] = value
