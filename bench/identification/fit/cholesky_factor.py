"""The Cholesky factor of a Gram matrix whose columns come and go."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule, Floats
from bench.identification.fit.cell_layout import Flags, Indices

# An import within a function would take as long as what is done with a few columns.
if TYPE_CHECKING:
    from scipy.linalg import blas, lapack

    from bench.identification.kernels import factor_kernels as _factor_kernels
else:
    blas, lapack = DeferredModule("scipy.linalg.blas"), DeferredModule("scipy.linalg.lapack")
    _factor_kernels = DeferredModule("bench.identification.kernels.factor_kernels")

# A column whose squared distance from the span of the passive ones falls below this part of its squared norm counts
# as dependent on them: Cholesky pivots carry rounding errors of about 1e-13. Only if such columns are all that is
# left to enter, the threshold is lowered step by step. Source: the rounding of sums of a thousand products of numbers
# of 16 digits.
DEPENDENT = (1e-12, 1e-13, 1e-14)
# Right sides that a plain loop solves faster than BLAS, which would copy the factor. Source: a choice; it decides
# time only.
_FEW = 24


class CholeskyFactor:
    """The triangular factor L of the passive Gram block L Lᵀ, kept up to date as columns come and go.

    `half` is the solution of L half = right for the columns' right side: it turns with the factor, so that the
    solution of L Lᵀ x = right takes one pass.

    The rows of L are packed; see `_factor_kernels`.
    """

    def __init__(self) -> None:
        self.packed = np.empty(0)
        self.half = np.empty(0)
        self.size = 0
        self.threshold = DEPENDENT[0]

    @property
    def room(self) -> int:
        """Number of columns that can be appended at a time: those that end the present block."""
        return _factor_kernels.BLOCK - self.size % _factor_kernels.BLOCK

    def _blocks(self, size: int) -> Iterator[tuple[int, int, Floats]]:
        """Yield the first and the last row, exclusive, of each block of so many rows, and the block, a view."""
        for first in range(0, size, _factor_kernels.BLOCK):
            last = min(first + _factor_kernels.BLOCK, size)
            start, width = _factor_kernels.row_start(first), first + _factor_kernels.BLOCK
            # The last row may have no room but for itself.
            whole = self.packed[start : start + (last - first) * width]
            yield first, last, whole.reshape(last - first, width)[:, :last]

    def reserve(self, size: int) -> None:
        """Take memory for so many columns at once."""
        if _factor_kernels.row_start(size) > self.packed.size:
            # In place, and little more: a copy would count in the memory of a large fit.
            self.packed.resize(_factor_kernels.row_start(max(size + 32, 512)), refcheck=False)

    def append(self, rows: Floats, right: Floats) -> Flags:
        """Add at most `room` columns, given their products with the present ones and each other, and right sides.

        The products, shape (more, size + more), are overwritten. Of those of two new columns the lower half counts.

        Return which were added: the others depend on the present ones and those added before them.
        """
        more, old = rows.shape[0], self.size
        cross, square = rows[:, :old], rows[:, old:]
        least = self.threshold * square.diagonal()
        if old:
            self._solve_lower(rows)
            square -= cross @ cross.T
        block, info = lapack.dpotrf(square.T, lower=0, clean=1)
        block = block.T
        good = np.ones(more, dtype=bool)
        # Pivots below the threshold would pass as rounding noise.
        if info or (block.diagonal() ** 2 < least).any():
            block = np.array(np.tril(square), order="C")
            _factor_kernels.factor_independent(block, least, good)
            cross, right = cross[good], right[good]
            block = block[np.ix_(good, good)]
        added = right.size
        if not added:
            return good
        self.reserve(old + added)
        self.half = np.concatenate([self.half, blas.dtrsv(block.T, right - cross @ self.half, trans=1)])
        self.size = old + added
        *_, (first, _, last) = self._blocks(self.size)
        last[old - first :, :old] = cross
        last[old - first :, old:] = block
        return good

    def _solve_lower(self, right: Floats) -> None:
        """Replace right sides, the first `size` of each contiguous row, by the x with L x = right."""
        if right.shape[0] <= _FEW:
            _factor_kernels.solve_lower(self.packed, self.size, right)
            return
        for first, last, block in self._blocks(self.size):
            part = right[:, first:last]
            if first:
                part -= right[:, :first] @ block[:, :first].T
            # Transposed, as BLAS wants it.
            corner = np.ascontiguousarray(block[:, first:]).T
            part[:] = blas.dtrsm(1.0, corner, np.ascontiguousarray(part).T, trans_a=1, overwrite_b=1).T

    def truncate(self, size: int) -> None:
        """Keep the first columns only."""
        self.size = size
        self.half = self.half[:size]

    def delete(self, places: Indices) -> None:
        """Remove the columns at increasing places."""
        for place in places[::-1]:
            _factor_kernels.delete_row(self.packed, self.size, place, self.half)
            self.size -= 1
        self.half = self.half[: self.size]

    def solution(self) -> Floats:
        """Return the solution for the columns' right side."""
        return np.asarray(_factor_kernels.solve_upper(self.packed, self.size, self.half))

    def solve(self, right: Floats) -> Floats:
        """Return the solution for a right side."""
        half = right.copy()
        _factor_kernels.solve_lower(self.packed, self.size, half[None, :])
        return np.asarray(_factor_kernels.solve_upper(self.packed, self.size, half))

    def length(self, places: Indices, values: Floats) -> float:
        """Return the norm in the outputs of a step that is zero but at increasing places."""
        return float(np.linalg.norm(_factor_kernels.combined_rows(self.packed, places, values)))

    def condition(self, norm: float) -> float:
        """Return the condition number of the columns, given the greatest sum of magnitudes over a Gram row."""
        return float(np.sqrt(norm * estimated_norm(self.solve, self.size)))

    def invert(self) -> None:
        """Replace L by its inverse: the factor is used up."""
        for first, last, block in self._blocks(self.size):
            corner, _ = lapack.dtrtri(np.tril(block[:, first:]).T, lower=0)
            if first:
                left = np.zeros((last - first, first))
                for begin, end, above in self._blocks(first):
                    left[:, :end] += block[:, begin:end] @ above
                np.matmul(-corner.T, left, out=block[:, :first])
            block[:, first:] = corner.T

    def inverse_entries(self, first: Indices, second: Indices) -> Floats:
        """Return entries of the inverse of the Gram block, once `invert` was called.

        first[k] <= second[k] <= second[k + 1].
        """
        return np.asarray(_factor_kernels.products_of_columns(self.packed, self.size, first, second))

    def inverse_diagonal(self) -> Floats:
        """Return the diagonal of the inverse of the Gram block, once `invert` was called."""
        result = np.zeros(self.size)
        for _, last, block in self._blocks(self.size):
            result[:last] += np.einsum("ij,ij->j", block, block)
        return result


def estimated_norm(product: Callable[[Floats], Floats], size: int) -> float:
    """Return the greatest sum of magnitudes over a row of a symmetric matrix, estimated from products with vectors.

    As by LAPACK's dlacn2: Higham, ACM Trans. Math. Software 14, 381, 1988. It is never too large.
    """
    if not size:
        return 1.0
    x = product(np.full(size, 1.0 / size))
    estimate, signs, place = float(np.abs(x).sum()), np.zeros(size), -1
    for _ in range(5):
        before, signs = signs, np.where(x > 0.0, 1.0, -1.0)
        if (signs == before).all():
            break
        slope = np.abs(product(signs))
        last, place = place, int(np.argmax(slope))
        if last >= 0 and slope[last] == slope[place]:
            break
        unit = np.zeros(size)
        unit[place] = 1.0
        x = product(unit)
        previous, estimate = estimate, float(np.abs(x).sum())
        if estimate <= previous:
            break
    # Where all of that is cancelled.
    alternating = np.where(np.arange(size) % 2 == 0, 1.0, -1.0) * (1.0 + np.arange(size) / max(size - 1, 1))
    return max(estimate, 2.0 * float(np.abs(product(alternating)).sum()) / (3.0 * size))
