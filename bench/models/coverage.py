"""Which cells of a Preisach plane a sequence of inputs sweeps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats
from bench.models.regressor import Regressor


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which cells of the Preisach plane an excitation sweeps.

    Parameters
    ----------
    swept : ndarray of bool, shape (K,)
        Whether any part of the cell was switched after the first sample.
    never : ndarray of int64, shape (n,)
        The cells never swept, whose density the data do not determine.
    centres : ndarray, shape (n, 2)
        Their centres (β, α), input units; of a diagonal cell that of its triangle.
    """

    swept: NDArray[np.bool_]
    never: NDArray[np.int64]
    centres: Floats

    @classmethod
    def of(cls, regressor: Regressor, levels: Floats) -> Coverage:
        """Return the coverage of a regressor whose sparse columns are the cells between levels, shape (M + 1,)."""
        swept = swept_cells(regressor)
        never = np.flatnonzero(~swept)
        i, j = (index[never] for index in np.tril_indices(levels.size - 1))
        middle, steps = 0.5 * (levels[1:] + levels[:-1]), np.diff(levels)
        shift = np.where(i == j, steps[i] / 6.0, 0.0)
        return cls(swept, never, np.column_stack([middle[j] - shift, middle[i] + shift]))

    @property
    def fraction(self) -> float:
        """Part of the cells that were swept, 0 to 1."""
        return float(self.swept.mean())

    def summary(self) -> str:
        """Return the coverage in a sentence or two."""
        count = self.swept.size
        if not self.never.size:
            return f"all {count} cells swept"
        (beta0, alpha0), (beta1, alpha1) = self.centres.min(axis=0), self.centres.max(axis=0)
        return (
            f"{count - self.never.size} of {count} cells swept ({self.fraction:.0%}); never swept: "
            f"{self.never.size} with centres β from {beta0:g} to {beta1:g}, α from {alpha0:g} to {alpha1:g}"
        )


def swept_cells(regressor: Regressor) -> NDArray[np.bool_]:
    """Return which sparse columns change after the first sample, shape (K,)."""
    swept = np.zeros(regressor.base.size, dtype=bool)
    first = regressor.starts[1]
    cells = regressor.cells[first:]
    # A rectangle may end within rounding of a cell's border.
    largest = np.zeros(regressor.base.size)
    np.maximum.at(largest, cells, np.abs(regressor.changes[first:]))
    swept[largest > 1e-12 * largest.max(initial=0.0)] = True
    return swept
