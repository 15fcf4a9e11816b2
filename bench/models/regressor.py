"""The matrix that maps an operator's coefficients to its outputs, kept as sparse row differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks


@dataclass(frozen=True, eq=False)
class Regressor:
    """A regressor of shape (N, K + q): K columns that change only when swept, and q dense ones.

    Row n differs from row n - 1 only in the cells that the input swept between the two samples, so a
    product costs O(N M) instead of O(N M²). A cell may be listed more than once in a row: entries add.

    Parameters
    ----------
    base : ndarray, shape (K,)
        The row of the state before the first sample; K = M(M+1)/2 cells of a Preisach plane, or none.
    starts : ndarray of int64, shape (N + 1,)
        Row n's entries are starts[n] to starts[n + 1].
    cells : ndarray of int32, shape (nnz,)
        Column of each entry.
    changes : ndarray, shape (nnz,)
        Change of that column from the row before.
    extra : ndarray, shape (N, q)
        The dense columns, right of the sparse ones.
    """

    base: Floats
    starts: NDArray[np.int64]
    cells: NDArray[np.int32]
    changes: Floats
    extra: Floats

    @classmethod
    def of_columns(cls, columns: Floats) -> Regressor:
        """Return a regressor of dense columns alone, shape (N, q)."""
        return cls(
            base=np.empty(0),
            starts=np.zeros(columns.shape[0] + 1, dtype=np.int64),
            cells=np.empty(0, dtype=np.int32),
            changes=np.empty(0),
            extra=np.ascontiguousarray(columns),
        )

    @classmethod
    def of_cells(cls, columns: Floats, extra: Floats) -> Regressor:
        """Return a regressor of cells that may change in every row, shape (N, K), and dense columns, shape (N, q)."""
        changes = np.diff(columns, axis=0, prepend=columns[:1])
        changing = changes != 0.0
        return cls(
            base=columns[0].copy(),
            starts=np.append(0, np.cumsum(np.count_nonzero(changing, axis=1))),
            cells=np.nonzero(changing)[1].astype(np.int32),
            changes=changes[changing],
            extra=np.ascontiguousarray(extra),
        )

    def merged(self, parents: NDArray[np.int64], count: int) -> Regressor:
        """Return the regressor whose sparse column p, of `count`, is the sum of the columns c with parents[c] = p."""
        return Regressor(
            base=np.bincount(parents, self.base, minlength=count).astype(np.float64),
            starts=self.starts,
            cells=parents[self.cells].astype(np.int32),
            changes=self.changes,
            extra=self.extra,
        )

    def keeping(self, kept: NDArray[np.bool_]) -> Regressor:
        """Return the regressor with all columns at 0 but those kept, shape (K + q,)."""
        cells = kept[: self.base.size]
        return Regressor(
            base=np.where(cells, self.base, 0.0),
            starts=self.starts,
            cells=self.cells,
            changes=np.where(cells[self.cells], self.changes, 0.0),
            extra=np.where(kept[self.base.size :], self.extra, 0.0),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Samples and coefficients."""
        return self.extra.shape[0], self.base.size + self.extra.shape[1]

    def product(self, coefficients: ArrayLike) -> Floats:
        """Return R @ coefficients, shape (N,).

        Raises ValueError if `coefficients` has not the shape (K + q,) or is not finite.
        """
        from bench.models.kernels import memory_kernels as _kernels

        weights = _checks.counted("coefficients", coefficients, self.shape[1])
        count = self.base.size
        result = self.extra @ weights[count:]
        if count:
            result += self.base @ weights[:count]
            # A copy: for weights that are read-only numba would compile once more.
            result += _kernels.difference_product(self.starts, self.cells, self.changes, weights[:count].copy())
        return result

    def dense(self) -> Floats:
        """Return the whole matrix, shape (N, K + q): 8 N (K + q) bytes."""
        from bench.models.kernels import memory_kernels as _kernels

        result = np.empty(self.shape)
        _kernels.dense_rows(self.starts, self.cells, self.changes, self.base, result)
        result[:, self.base.size :] = self.extra
        return result
