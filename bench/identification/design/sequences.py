"""Design of experiments for Preisach models: sequences that sweep every cell, and what each of them costs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.design.information import (
    Scaling,
    covariance,
    log_determinant,
    mean_variance,
    random_reversals,
)
from bench.models import Preisach


def first_order_reversals(
    levels: ArrayLike, input_range: tuple[float, float] | None = None, *, per_cell: int = 1
) -> Floats:
    """Return set-points of first-order reversal curves on a grid, from positive saturation.

    For each level from the top downwards: down to it in one step, then up again level by level to saturation
    (Mayergoyz 2003, chapter 1). Every pair of levels is measured once, K = M(M+1)/2 readings beside those at the
    reversals; returning to saturation costs M readings that tell nothing new.

    Parameters
    ----------
    levels : array_like, shape (M + 1,)
        Increasing levels, input units: those of the model, or finer.
    input_range : tuple of float or None
        Operating range whose ends are visited once too, for a reversible part; default none.
    per_cell : int
        Set-points on the way from one level to the next, >= 1.

    Returns
    -------
    ndarray, shape (N,)
        Set-points; without an input range and with one set-point per cell N = K + M + 1.

    Raises
    ------
    ValueError
        If the levels do not increase, the range does not contain them, or `per_cell` is not positive.
    """
    grid, ends = _grid(levels, input_range, per_cell)
    top = grid.size - 1
    parts = [np.array([*ends[1:], grid[top]])]
    for j in range(top - 1, -1, -1):
        down = [grid[j]] if j else [grid[0], *ends[:1], *(grid[:1] if ends else ())]
        parts += [np.array(down), _ramp(grid[j:], per_cell)]
    return np.concatenate(parts)


def covering_sequence(
    levels: ArrayLike, input_range: tuple[float, float] | None = None, *, per_cell: int = 1
) -> Floats:
    """Return the shortest sequence that determines every cell of a plane: loops that shrink level by level.

    From positive saturation down to the lowest level, up to the last but one, down to the second, and so on, one
    set-point per level. Call l_a the maximum and l_b the minimum of a loop. The readings on the way down add up
    the density over the rows below a, column by column; one loop further in the same sums are over the rows
    below a - 1, so that their differences are the single cells of row a - 1, and those on the ways up the single
    cells of column b. Each cell is on one of these, hence the regressor has full rank. There are
    K = M(M+1)/2 densities and a bias to be found; the sequence has K + 1 set-points, and no shorter one can do.

    Parameters
    ----------
    levels, input_range, per_cell
        As in `first_order_reversals`; more set-points in a cell average noise.

    Returns
    -------
    ndarray, shape (N,)
        Set-points; N = per_cell * K + 1, and 2 more with an input range.

    Raises
    ------
    ValueError
        If the levels do not increase, the range does not contain them, or `per_cell` is not positive.
    """
    grid, ends = _grid(levels, input_range, per_cell)
    low, high = 0, grid.size - 1
    parts = [np.array([*ends[1:], grid[high]]), _ramp(grid[::-1], per_cell), np.array(ends[:1])]
    rising = True
    while high - low > 1:
        if rising:
            high -= 1
            parts.append(_ramp(grid[low : high + 1], per_cell))
        else:
            low += 1
            parts.append(_ramp(grid[low : high + 1][::-1], per_cell))
        rising = not rising
    return np.concatenate(parts)


def _grid(
    levels: ArrayLike, input_range: tuple[float, float] | None, per_cell: int
) -> tuple[Floats, tuple[float, ...]]:
    """Return the levels, and the ends of the operating range if given."""
    grid = _checks.increasing("levels", levels)
    if per_cell < 1:
        raise ValueError(f"per_cell: expected at least 1, got {per_cell}")
    if input_range is None:
        return grid, ()
    low, high = _checks.increasing("input_range", input_range).tolist()
    if low > grid[0] or high < grid[-1]:
        raise ValueError(f"input_range: expected it to contain [{grid[0]}, {grid[-1]}], got [{low}, {high}]")
    return grid, (low, high)


def _ramp(path: Floats, per_cell: int) -> Floats:
    """Return the set-points after the first of a path, each stretch divided evenly."""
    parts = []
    for start, stop in pairwise(path.tolist()):
        part = start + (stop - start) * np.arange(1, per_cell + 1) / per_cell
        part[-1] = stop
        parts.append(part)
    return np.concatenate(parts)


@dataclass(frozen=True)
class Assessment:
    """What a sequence of set-points tells about a model, and what it costs.

    Parameters
    ----------
    setpoints : int
        Number of set-points N.
    cells, covered : int
        Number of cells K, and of those swept.
    coefficients : int
        Number of coefficients K + q that the bias leaves to be found.
    rank : int
        How many combinations of them the readings determine.
    condition : float
        Condition number of the regressor within that rank, columns centred and scaled to unit norm.
    time : float
        Laboratory time, s.
    log_determinant : float
        log10 det of the information that one hour of the sequence, repeated, gives, in decades per coefficient;
        see `information`. It comes closest to the order of the errors that are left on other inputs, which the
        condition number does not say; infinite if the sequence takes no time.
    prediction_variance : float
        Mean variance of predictions over random reversals after the sequence, in variances of the noise, if the signs
        of the coefficients are not constrained.
    """

    setpoints: int
    cells: int
    covered: int
    coefficients: int
    rank: int
    condition: float
    time: float
    log_determinant: float
    prediction_variance: float


def assess(operator: Preisach, inputs: ArrayLike, *, dwell: float) -> Assessment:
    """Return what a sequence tells about the coefficients of an operator, from negative saturation on.

    The regressor is formed densely, 8 N (K + q) bytes, for its singular values.

    Parameters
    ----------
    operator : Preisach
        Its levels and reversible part say what is to be found; their values do not matter.
    inputs : array_like, shape (N,)
        Set-points.
    dwell : float
        Settling time at each set-point, s, >= 0.

    Raises
    ------
    ValueError
        If a number is out of its range, or the sequence is empty or not finite.
    """
    from scipy.linalg import svdvals

    if not _checks.number("dwell", dwell) >= 0.0:
        raise ValueError(f"dwell: expected a number >= 0, got {dwell}")
    coverage = operator.coverage(inputs)
    matrix = operator.regressor(inputs).dense()
    time = dwell * matrix.shape[0]
    scaling = Scaling.of(operator)
    rows = scaling.scaled(matrix)
    reversals = random_reversals(operator.input_range, float(np.diff(operator.levels).mean()))
    judged = scaling.rows(operator, reversals, operator.saturated_state(-1))
    matrix -= matrix.mean(axis=0)
    norms = np.linalg.norm(matrix, axis=0)
    # A column never swept has but rounding left.
    constant = norms <= 1e-12 * norms.max(initial=0.0)
    matrix[:, constant] = 0.0
    matrix /= np.where(constant, 1.0, norms)
    singular = svdvals(matrix)
    rank = int(np.count_nonzero(singular > max(matrix.shape) * np.finfo(np.float64).eps * singular[0]))
    return Assessment(
        setpoints=matrix.shape[0],
        cells=coverage.swept.size,
        covered=int(coverage.swept.sum()),
        coefficients=matrix.shape[1],
        rank=rank,
        condition=float(singular[0] / singular[rank - 1]) if rank else math.inf,
        time=time,
        log_determinant=log_determinant(rows, 3600.0 / time if time else math.inf),
        prediction_variance=mean_variance(judged, covariance(rows)),
    )
