"""The columns of a regressor as the constrained fit takes them: about their means, of unit norm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule, Floats
from bench.identification.fit.cell_layout import Flags, Indices
from bench.models import Regressor

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from bench.identification.kernels import constrained_fit_kernels as _kernels
    from bench.identification.kernels.constrained_fit_kernels import Columns
    from bench.models import memory_kernels as lists
else:
    lists = DeferredModule("bench.models.kernels.memory_kernels")
    _kernels = DeferredModule("bench.identification.kernels.constrained_fit_kernels")


@dataclass(frozen=True, eq=False)
class ScaledColumns:
    """Columns A about their weighted means and scaled, and a penalty L on the sparse ones of them."""

    changes: Columns  # the sparse columns, K, as differences; see `_kernels`
    # Shape (K,); first values and weighted means of the sparse columns.
    base: Floats
    means: Floats
    norms: Floats  # shape (K + q,); by which all columns are divided
    extra: Floats  # shape (N, q); the dense columns, about their means and scaled already
    weights: Floats  # shape (N,); weight of each sample, W on the diagonal
    total: float  # sum of the weights
    penalty: csr_array | None  # shape (K, K); L, in scaled coefficients

    def model(self, x: Floats) -> Floats:
        """Return A x, shape (N,)."""
        sparse = self.base.size
        chosen = np.flatnonzero(x[:sparse])
        factors = x[chosen] / self.norms[chosen]
        model = _kernels.combination(self.changes, self.base, self.means, chosen, factors, self.weights.size)
        return np.asarray(model + self.extra @ x[sparse:])

    def products(self, residual: Floats) -> Floats:
        """Return AᵀW r of a residual, shape (K + q,)."""
        return np.asarray(_kernels.products(self.changes, self.norms, self.extra, self.weights, self.total, residual))

    def gram_product(self, x: Floats) -> Floats:
        """Return (AᵀWA + L) x, shape (K + q,)."""
        result = self.products(self.model(x))
        if self.penalty is not None:
            sparse = self.base.size
            result[:sparse] += self.penalty @ x[:sparse]
        return result

    def chosen(self, places: Indices) -> ScaledColumns:
        """Return the columns at increasing places."""
        starts, rows, values = self.changes
        sparse = places[places < self.base.size]
        dense = places[sparse.size :] - self.base.size
        lengths = starts[sparse + 1] - starts[sparse]
        ends = np.concatenate([[0], lengths.cumsum()])
        entries = np.repeat(starts[sparse] - ends[:-1], lengths) + np.arange(ends[-1])
        return ScaledColumns(
            changes=(ends, rows[entries], values[entries]),
            base=self.base[sparse],
            means=self.means[sparse],
            norms=self.norms[places],
            extra=np.ascontiguousarray(self.extra[:, dense]),
            weights=self.weights,
            total=self.total,
            penalty=None if self.penalty is None else self.penalty[sparse][:, sparse],
        )


def changing(norms: Floats, scale: Floats, total: float) -> Flags:
    """Return which columns vary by more than the rounding of their means, given norms about these and a total weight.

    `scale` is the size of each column.
    """
    return np.asarray(norms > 1e-11 * np.sqrt(total) * np.maximum(scale, 1e-300))


def mean_square(norms: Floats) -> float:
    """Return the mean square of norms, 1 if there are none."""
    return float((norms**2).mean()) if norms.size else 1.0


def unit_of_penalties(regressor: Regressor, weights: Floats) -> float:
    """Return the mean squared norm about the mean of the columns of cells that change."""
    columns = lists.by_column(regressor.starts, regressor.cells, regressor.changes, regressor.base.size)
    remaining = weights[::-1].cumsum()[::-1].copy()
    norms = _kernels.moments(columns, regressor.base, remaining)[1]
    return mean_square(norms[changing(norms, np.abs(regressor.base), float(remaining[0]))])
