"""Set-point sequences that excite the memory: numbers only, no timing."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from bench.base import Floats, checks as _checks

# Part of the random targets that lie in the transition range. Source: a choice; the specimen changes most there.
_INSIDE = 0.8


def damped_oscillation(low: float, high: float, center: float, half_cycles: int, step: float) -> Floats:
    """Return set-points of one full sweep from low to high, then a decaying oscillation about `center`.

    Extremum n of the oscillation lies at center ± reach (1 - n / half_cycles), where reach is the distance
    from the center to `high` or `low`: nested minor loops down to the center itself, the pattern of Zhang
    et al. 2013, section II-B.

    Parameters
    ----------
    low, high : float
        Ends of the operating range, input units.
    center : float
        Where the oscillation dies out, low < center < high.
    half_cycles : int
        Number of half-cycles after the first sweep, >= 1.
    step : float
        Greatest distance between set-points, > 0; each ramp is divided evenly.

    Raises
    ------
    ValueError
        If the center is not inside the range, or a number is not positive or finite.
    """
    _checks.increasing("low, center, high", [low, center, high])
    if half_cycles < 1:
        raise ValueError(f"half_cycles: expected at least 1, got {half_cycles}")
    extrema = [low, high]
    for n in range(1, half_cycles + 1):
        part = 1.0 - n / half_cycles
        extrema.append(center + part * ((low if n % 2 else high) - center))
    return ramps(extrema, step)


def random_validation(
    rng: np.random.Generator,
    count: int,
    *,
    operating: tuple[float, float],
    transition: tuple[float, float],
    step: float,
) -> Floats:
    """Return `count` set-points on ramps between random targets.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the targets.
    count : int
        Number of set-points, >= 1.
    operating, transition : tuple of float
        Ranges of the targets, input units; four of five lie in the transition range. The sequence starts at the low
        end of the operating range.
    step : float
        Greatest distance between set-points, > 0.

    Raises
    ------
    ValueError
        If a range does not increase, or a number is out of its range.
    """
    _checks.increasing("operating", operating)
    _checks.increasing("transition", transition)
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    parts = [np.array([float(operating[0])])]
    length = 1
    while length < count:
        target = rng.uniform(*(transition if rng.random() < _INSIDE else operating))
        parts.append(ramps([float(parts[-1][-1]), target], step)[1:])
        length += parts[-1].size
    return np.concatenate(parts)[:count]


def ramps(extrema: list[float], step: float) -> Floats:
    """Return set-points on straight ramps through `extrema`, no further apart than `step`.

    Raises ValueError if there are no extrema, a number is not finite, or the step is not positive.
    """
    points = _checks.samples("extrema", extrema)
    if not _checks.number("step", step) > 0.0:
        raise ValueError(f"step: expected a positive number, got {step}")
    parts = [points[:1]]
    for start, stop in pairwise(points.tolist()):
        # A ramp that divides evenly must not gain a set-point by rounding.
        count = max(1, math.ceil(abs(stop - start) / step - 1e-9))
        parts.append(start + (stop - start) * np.arange(1, count + 1) / count)
        parts[-1][-1] = stop
    return np.concatenate(parts)
