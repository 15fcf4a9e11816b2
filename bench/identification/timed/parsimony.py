"""What fits of models with time share: size, columns that move, and the criterion by which parts are added."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats

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


def moving(columns: Floats, weights: Floats, skip: int) -> NDArray[np.bool_]:
    """Return which columns, shape (N, K), the rows fitted move; weights, shape (N,), say which rows are.

    What relaxes leaves a trace of each move in all later rows, even if none of those fitted makes it.
    """
    fitted = columns[skip:][weights[skip:] > 0.0]
    return np.asarray(np.ptp(fitted, axis=0) >= _MOVED * np.ptp(columns, axis=0))


def schwarz(cost: float, parameters: int, used: int) -> float:
    """Return the criterion of Schwarz (Annals of Statistics 6, 461, 1978): the model of the least is taken.

    `cost` is the sum of squares over the samples, `parameters` the number of those that not all models have.
    """
    return used * math.log(max(cost, 1e-300)) + parameters * math.log(used)
