"""What fits of models with time share: size, columns that move, worth of parameters."""

from __future__ import annotations

import math

import numpy as np

from bench.base import Floats

WORTH = 0.005
"""Part by which something that nobody asked for must lower the RMS error. Source: a choice; a smaller gain shows in
no printed error of two digits."""

# Greatest regressor, numbers; 400 MB. Source: a choice; ten copies fit into 4 GB.
_LARGEST = 50_000_000
# Part of the range of a column that the rows fitted must go through, or its coefficient would be noise. Source: noise
# of 1 % of the range moves it as much.
_MOVED = 0.01


def check_size(rows: int, count: int, fewer: str) -> None:
    """Raise ValueError if a regressor of rows and coefficients is too large; `fewer` names what to give less of."""
    if rows * count > _LARGEST:
        size = 8e-9 * rows * count
        raise ValueError(
            f"{rows} rows and {count} coefficients take {size:.1f} GB; give fewer {fewer}, or every nth row"
        )


def moving(columns: Floats, weights: Floats, skip: int) -> Floats:
    """Return columns, shape (N, K), with those at 0 that the rows fitted hardly move; weights, shape (N,), say which.

    What relaxes leaves a trace of each move in all later rows, even if none of those fitted makes it.
    """
    fitted = columns[skip:][weights[skip:] > 0.0]
    return np.where(np.ptp(fitted, axis=0) >= _MOVED * np.ptp(columns, axis=0), columns, 0.0)


def is_worth(before: float, after: float, parameters: int, used: int, worth: float = WORTH) -> bool:
    """Return whether parameters lower a sum of squares by more than they would by chance.

    Parameters
    ----------
    before, after : float
        The sums of squares, > 0 and >= 0.
    parameters : int
        How many more there are.
    used : int
        Number of samples that count.
    worth : float
        Least part by which they must lower the RMS error, too.
    """
    gain = math.log(max(before, 1e-300)) - math.log(max(after, 1e-300))
    return gain > max(-2.0 * math.log1p(-worth), parameters * chance_of(used))


def chance_of(used: int) -> float:
    """Return by how much a parameter lowers the logarithm of a sum of squares over `used` samples by chance."""
    return 2.0 * math.log(used) / used
