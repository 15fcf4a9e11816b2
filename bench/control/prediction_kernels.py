"""Compiled loop of the predictive follower: an actuator and a lag. Imported on first use only."""

from __future__ import annotations

import math

from numpy import int64
from numpy.typing import NDArray

from bench.base import Floats, Table, kernel


@kernel
def drive(
    start: Floats,
    setpoints: Table,
    source: NDArray[int64],
    steps: Table,
    order: int,
    most: float,
    remains: float,
    power: float,
    positions: Table,
    seen: Table,
) -> tuple[float, float, float]:
    """Write what the drive does, and what the specimen sees of it, after each step; return the last state.

    Rows of `setpoints`, `positions` and `seen` are drives of their own from the same start (position, rate, lagged).
    Step k heeds the set-point `source[k]`. `steps` is the matrix of one exact step of (distance to the set-point,
    rate), and the fastest rate; `most` the farthest move in a step; `remains` the part of the lag's distance that
    remains after one, of the input to `power` (1 or 2).
    """
    x, v, z = start[0], start[1], start[2]
    for b in range(setpoints.shape[0]):
        x, v, z = start[0], start[1], start[2]
        for k in range(source.size):
            target = setpoints[b, source[k]]
            if order == 0:
                x, v = target, 0.0
            else:
                away = x - target
                move = steps[0, 0] * away + steps[0, 1] * v - away
                v = steps[1, 0] * away + steps[1, 1] * v
                if abs(move) > most:
                    move = math.copysign(most, move)
                    v = math.copysign(min(abs(v), steps[2, 0]), move)
                x += move
            if remains > 0.0:
                level = x if power == 1.0 else x * abs(x)
                z = level + (z - level) * remains
                seen[b, k] = z if power == 1.0 else math.copysign(math.sqrt(abs(z)), z)
            else:
                seen[b, k] = x
            positions[b, k] = x
    return x, v, z
