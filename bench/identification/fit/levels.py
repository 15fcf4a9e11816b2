"""Levels of a Preisach plane: equally spaced, or closer where the inputs turn."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from bench.base import Floats
from bench.identification.branches import turning_points
from bench.models import uniform_levels

Spacing: TypeAlias = Literal["uniform", "quantiles"]

# Share of the levels that are equally spaced: what lies between the reversals is swept too. Source: a choice; both
# halves count alike.
_UNIFORM_SHARE = 0.5
# Least distance of two levels, as part of the mean distance. Source: a choice; closer levels make cells that hardly
# any input tells apart.
_LEAST = 0.1


def quantile_levels(inputs: Floats, plane: tuple[float, float], count: int) -> Floats:
    """Return levels that lie closer where the inputs turn more often, shape (count + 1,).

    The distribution is half that of the reversals within the plane and half uniform, and no two levels are closer
    than a tenth of their mean distance. Where the memory is decided often, the density is resolved finely.

    Parameters
    ----------
    inputs : ndarray, shape (N,)
        The sequence, input units.
    plane : tuple of float
        The first and the last level, input units.
    count : int
        Number of intervals, >= 1.
    """
    uniform = uniform_levels(*plane, count)
    low, high = plane
    turns = inputs[turning_points(inputs)]
    inside = np.sort(turns[(turns > low) & (turns < high)])
    if not inside.size or count < 2:
        return uniform
    grid = np.linspace(low, high, 64 * count + 1)
    # The jumps of the empirical distribution become ramps between neighbouring reversals.
    share = np.interp(grid, np.concatenate([[low], inside, [high]]), np.linspace(0.0, 1.0, inside.size + 2))
    even = (grid - low) / (high - low)
    mixed = _UNIFORM_SHARE * even + (1.0 - _UNIFORM_SHARE) * share
    levels = np.interp(np.linspace(0.0, 1.0, count + 1), mixed, grid)
    steps = np.maximum(np.diff(levels), _LEAST * (high - low) / count)
    levels = low + np.concatenate([[0.0], np.cumsum(steps)]) * (high - low) / steps.sum()
    levels[-1] = high
    return np.asarray(levels, dtype=np.float64)
