"""Branches of an input: the monotone moves from one turning point to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks

NOISE = 0.02
"""Moves of at most this part of the range are noise of a measured input. Derivation: six standard deviations, within
which some hundred readings lie, of a noise of 0.33 % of the range."""


def turning_points(inputs: ArrayLike, least: float = 0.0) -> NDArray[np.int64]:
    """Return the samples at which the input turns, with the first and the last sample.

    A reversal of the inputs, shape (N,), by no more than `least` (input units), such as noise, is no turn.

    Raises ValueError if `inputs` is empty, not one-dimensional or not finite.
    """
    u = _checks.samples("inputs", inputs)
    moving = np.flatnonzero(np.append(True, np.diff(u) != 0.0))
    signs = np.sign(np.diff(u[moving]))
    # The last sample of a plateau at an extremum belongs to the branch that ends there.
    ends = moving[1:] - 1
    turns = np.unique([0, *ends[1:][signs[1:] != signs[:-1]], u.size - 1])
    if least <= 0.0 or turns.size < 3:
        return np.asarray(turns, dtype=np.int64)
    return _without_short_moves(u, turns, least)


def turns_beyond_noise(inputs: Floats) -> NDArray[np.int64]:
    """Return the turning points of inputs, shape (N,), without moves of at most `NOISE` of their range."""
    return turning_points(inputs, NOISE * float(np.ptp(inputs)))


def _without_short_moves(u: Floats, turns: NDArray[np.int64], least: float) -> NDArray[np.int64]:
    """Return the turning points that are left when moves of at most `least` are not counted."""
    values = u[turns].tolist()
    kept: list[int] = []
    low = high = 0
    direction = 0
    for k in range(1, len(values)):
        if direction >= 0 and values[k] > values[high]:
            high = k
        if direction <= 0 and values[k] < values[low]:
            low = k
        if direction >= 0 and values[high] - values[k] > least:
            if direction or high:
                kept.append(high)
            direction, low = -1, k
        elif direction <= 0 and values[k] - values[low] > least:
            if direction or low:
                kept.append(low)
            direction, high = 1, k
    # The end of the last move: what follows it is shorter than a move.
    last = high if direction > 0 else low
    chosen = [0, *(k for k in kept if k), *([last] if direction and last else [])]
    result = turns[np.unique(chosen)]
    if result[-1] != u.size - 1:
        result = np.append(result, u.size - 1)
    return result
