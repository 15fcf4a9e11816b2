"""The Cholesky factor of a Gram matrix whose columns come and go."""

from __future__ import annotations

import numpy as np

from bench.hysteresis._checks import Floats
from bench.identification.cell_layout import Flags, Indices

# A column whose squared distance from the span of the passive ones falls below this part of its squared norm
# counts as dependent on them: Cholesky pivots carry rounding errors of about 1e-13. Only if such columns are
# all that is left to enter, the threshold is lowered step by step.
DEPENDENT = (1e-12, 1e-13, 1e-14)
MANY = 256
"""Columns or rows of which a copy is cheap."""
# Right sides that a plain loop solves faster than BLAS, which would copy the factor.
_FEW = 24


class CholeskyFactor:
    """The triangular factor U of the passive Gram block UᵀU, kept up to date as columns come and go.

    `half` is the solution of Uᵀ half = right for the columns' right side: it turns with the factor, so that the
    solution of UᵀU x = right takes one pass.
    """

    def __init__(self) -> None:
        self.upper = np.zeros((0, 0))
        self.half = np.empty(0)
        self.size = 0
        self.threshold = DEPENDENT[0]

    @property
    def compact(self) -> Floats:
        """Lower factor as LAPACK wants it, in the place of the factor itself."""
        size, room = self.size, self.upper.shape[1]
        if room > size:
            flat = self.upper.reshape(-1)
            for row in range(1, size):
                flat[row * size : (row + 1) * size] = flat[row * room : row * room + size]
            self.upper = flat[: size * size].reshape(size, size)
        return self.upper.T

    def _make_room(self, size: int) -> None:
        if size > self.upper.shape[0]:
            room = max(64, size + size // 4)
            grown = np.zeros((room, room))
            grown[: self.size, : self.size] = self.upper[: self.size, : self.size]
            self.upper = grown

    def append(self, cross: Floats, square: Floats, right: Floats) -> Flags | None:
        """Add columns, given their products with the present ones, shape (p, size), with each other, and right sides.

        The first are overwritten, the second in Fortran's order.

        Return which were added: the others depend on the present ones and those added before them. None if there
        are others among many: nothing is added then, and fewer are to be tried.
        """
        from scipy.linalg.blas import dtrsv
        from scipy.linalg.lapack import dpotrf

        from bench.identification import _kernels

        more, old = cross.shape
        squares = np.diag(square).copy()
        rest = np.asfortranarray(square)
        if old and more:
            self._make_room(old + more)
            side = self.upper[:old, old : old + more]
            if more <= _FEW:
                _kernels.solve_lower(self.upper, old, cross)
                side[:] = cross.T
            else:
                side[:] = cross.T
                self._solve_lower(side)
            rest -= side.T @ side
        # Kept for a second try only where that is cheap.
        again = None if more > MANY else rest.copy(order="F")
        block, info = dpotrf(rest, lower=1, clean=1, overwrite_a=1)
        good = np.ones(more, dtype=bool)
        # Pivots below the threshold would pass as rounding noise.
        if info or (np.diag(block) ** 2 < self.threshold * squares).any():
            if again is None:
                return None
            block = np.array(np.tril(again), order="C")
            _kernels.factor_independent(block, self.threshold * squares, good)
            block = block[np.ix_(good, good)]
        added = int(np.count_nonzero(good))
        left = right[good] - (side.T @ self.half)[good] if old and more else right[good]
        self.half = np.concatenate([self.half, dtrsv(block, left, lower=1) if added else left])
        self.size = old + added
        if not old and added > self.upper.shape[0]:
            self.upper = np.ascontiguousarray(block.T)
            return good
        if not old:
            self.size = 0
            self._make_room(added)
            self.size = added
        elif added < more:
            self.upper[:old, old : self.size] = side[:, good]
        self.upper[old : self.size, old : self.size] = block.T
        return good

    def _solve_lower(self, right: Floats) -> None:
        """Replace right sides, shape (size, p), by the x with Uᵀx = right; without a copy of U."""
        from scipy.linalg.blas import dtrsm

        for first in range(0, self.size, MANY):
            block = slice(first, min(first + MANY, self.size))
            if first:
                right[block] -= self.upper[:first, block].T @ right[:first]
            corner = np.asfortranarray(self.upper[block, block].T)
            right[block] = dtrsm(1.0, corner, np.asfortranarray(right[block]), lower=1, overwrite_b=1)

    def truncate(self, size: int) -> None:
        """Keep the first columns only."""
        self.size = size
        self.half = self.half[:size]
        if not size:
            # There is no space for it and its successor.
            self.upper = np.zeros((0, 0))

    def delete(self, places: Indices) -> None:
        """Remove the columns at increasing places."""
        from bench.identification import _kernels

        for place in places[::-1]:
            _kernels.delete_column(self.upper, self.size, place, self.half)
            self.size -= 1
        self.half = self.half[: self.size]

    def solution(self) -> Floats:
        """Return the solution for the columns' right side."""
        from bench.identification import _kernels

        return np.asarray(_kernels.solve_upper(self.upper, self.size, self.half))

    def solve(self, right: Floats) -> Floats:
        """Return the solution for a right side."""
        from bench.identification import _kernels

        half = right.copy()
        _kernels.solve_lower(self.upper, self.size, half[None, :])
        return np.asarray(_kernels.solve_upper(self.upper, self.size, half))

    def length(self, places: Indices, values: Floats) -> float:
        """Return the norm in the outputs of a step that is zero but at increasing places."""
        from bench.identification import _kernels

        return float(_kernels.factored_length(self.upper, self.size, places, values))

    def condition(self, norm: float) -> float:
        """Return the condition number of the columns, given the greatest sum of magnitudes over a Gram row."""
        from scipy.linalg.lapack import dpocon

        if not self.size:
            return 1.0
        reciprocal, _ = dpocon(self.compact, norm, uplo="L")
        return float(np.sqrt(1.0 / max(reciprocal, 1e-300)))

    def inverse_entries(self, rows: Indices, columns: Indices) -> Floats:
        """Return entries of the inverse of the Gram block; the factor is used up."""
        from scipy.linalg.lapack import dtrtri

        from bench.identification import _kernels

        if not self.size:
            return np.zeros(rows.size)
        inverse, _ = dtrtri(self.compact, lower=1, overwrite_c=1)
        self.size = 0
        return np.asarray(_kernels.products_of_rows(inverse.T, rows, columns))
