"""Moving the density of a Preisach plane: each hysteron gets other thresholds, none is lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench.base import Floats
from bench.models.operators.preisach import Preisach

_PARTS = 8
"""Parts of a cell along each axis, which move as one.

Derivation: what is moved is right to 1/16 of a cell, half of a part.
"""


def transported(levels: Floats, masses: Floats, move: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> Floats:
    """Return the masses of the cells of a plane after its hysterons have moved.

    Each cell is divided into small squares, whose mass is shared among the cells that they come to lie in. So nothing
    changes without a move, the sum is kept, and the masses are continuous in the move. What would leave the plane
    stays at its edge.

    Parameters
    ----------
    levels : ndarray, shape (M + 1,)
        Increasing levels, input units.
    masses : ndarray, shape (M (M + 1) / 2,)
        Density times area of each cell, in the order of `Preisach.density`; of either sign.
    move : callable
        Of arrays of thresholds α and β, input units: their changes.

    Returns
    -------
    ndarray, shape (M (M + 1) / 2,)
        The masses after the move.
    """
    steps = np.diff(levels)
    rows, columns = np.tril_indices(steps.size)
    part = (np.arange(_PARTS) + 0.5) / _PARTS
    # Of a diagonal cell only the triangle β <= α.
    triangle = np.tri(_PARTS) + np.tri(_PARTS, k=-1)
    share = np.where((rows == columns)[:, None, None], triangle, 1.0) / _PARTS**2
    kept = share > 0.0
    alpha, beta, high, wide, mass = (
        np.broadcast_to(values, share.shape)[kept]
        for values in (
            (levels[rows][:, None] + steps[rows][:, None] * part)[:, :, None],
            (levels[columns][:, None] + steps[columns][:, None] * part)[:, None, :],
            steps[rows][:, None, None],
            steps[columns][:, None, None],
            masses[:, None, None] * share,
        )
    )
    more_alpha, more_beta = move(alpha, beta)
    high, wide = high / (2 * _PARTS), wide / (2 * _PARTS)
    alpha = np.clip(alpha + more_alpha, levels[0] + high, levels[-1] - high)
    beta = np.clip(beta + more_beta, levels[0] + wide, levels[-1] - wide)
    # No hysteron switches off above where it switches on.
    middle = 0.5 * (alpha + beta)
    alpha, beta = np.maximum(alpha, middle), np.minimum(beta, middle)

    result = np.zeros(masses.size)
    for row, share_alpha in _sides(levels, alpha, high):
        for column, share_beta in _sides(levels, beta, wide):
            above, below = np.maximum(row, column), np.minimum(row, column)
            cells = above * (above + 1) // 2 + below
            result += np.bincount(cells, mass * share_alpha * share_beta, minlength=masses.size)
    return result


def _sides(levels: Floats, middle: Floats, half: Floats) -> tuple[tuple[np.ndarray, Floats], ...]:
    """Return the intervals that the two ends of pieces lie in, with the share of each."""
    last = levels.size - 2
    # An end on a level lies on the side of its piece.
    slack = 1e-9 * half
    first = np.clip(np.searchsorted(levels, middle - half + slack, "right") - 1, 0, last)
    second = np.clip(np.searchsorted(levels, middle + half - slack, "right") - 1, 0, last)
    beyond = np.clip((middle + half - levels[second]) / (2.0 * half), 0.0, 1.0)
    beyond = np.where(first == second, 0.0, beyond)
    return (first, 1.0 - beyond), (second, beyond)


def widening(factor: float) -> Callable[[Floats, Floats], tuple[Floats, Floats]]:
    """Return the move that makes each loop `factor` times as wide about its middle."""

    def move(alpha: Floats, beta: Floats) -> tuple[Floats, Floats]:
        more = 0.5 * (factor - 1.0) * (alpha - beta)
        return more, -more

    return move


def widened(operator: Preisach, factor: float) -> Preisach:
    """Return the operator whose hysterons switch `factor` (> 0) times as far apart, about the same middles.

    The plane stays, so that what would come to lie beyond it stays at its edge.
    """
    if factor == 1.0:
        return operator
    areas = operator.cell_areas()
    return replace(operator, density=transported(operator.levels, operator.density * areas, widening(factor)) / areas)
