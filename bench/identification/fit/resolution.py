"""What the data say of each coefficient: the rank of the regressor, and the diagonal of the resolution matrix.

Swept is not identified: cells that are always swept together have columns in one ratio, and the data only know a
sum of their densities. The resolution matrix maps true coefficients to those found without noise; its diagonal is 1
for a coefficient that the data determine alone, 0 for one that they do not touch, and the sum is the rank, or with
penalties the effective number of coefficients (Menke, Geophysical Data Analysis: Discrete Inverse Theory, 2012,
ch. 4). Signs are left out of account: with them nonnegative coefficients may be determined where the data alone
leave a choice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.base import Floats
from bench.identification.fit.cell_layout import CellLayout
from bench.identification.fit.collapse import LONG, collapse
from bench.identification.fit.least_squares import one_thread
from bench.identification.fit.normal_equations import normal_equations
from bench.models import Regressor

# Coefficients, and samples times their square, up to which it takes about a second. Source: a core carries out some
# 1e10 products of matrices in a second.
_MOST, _WORK = 1330, 2e10


@dataclass(frozen=True, eq=False)
class Resolution:
    """What a sequence tells of each coefficient.

    Attributes
    ----------
    rank : int
        Rank of the regressor about its mean: directions that the data determine. Singular values below about 1e-7
        of the greatest do not count.
    diagonal : ndarray, shape (K + q,)
        Diagonal of the resolution matrix, 0 to 1. Without penalties that of the least-norm solution.
    """

    rank: int
    diagonal: Floats


def resolve(
    regressor: Regressor, weights: Floats, skip: int = 0, smoothing: float = 0.0, ridge: float = 0.0
) -> Resolution | None:
    """Return the resolution of all coefficients by a sequence; None if it would take longer than about a second.

    Parameters
    ----------
    regressor : Regressor
        Shape (N, K + q).
    weights : ndarray, shape (N,)
        Weight of each sample.
    skip : int
        Number of first samples left out.
    smoothing, ridge : float
        Weights of the penalties of `fit`.
    """
    count, cells = regressor.shape[1], regressor.base.size
    if weights.size >= LONG:
        w = np.where(np.arange(weights.size) < skip, 0.0, weights)
        if (short := collapse(regressor, np.zeros(w.size), w)) is not None:
            regressor, weights, skip = short.regressor, short.weights, 0
    if count > _MOST or weights.size * count**2 > _WORK:
        return None
    gram = normal_equations(regressor, np.zeros(weights.size), weights, skip)[0]
    sums, total = gram[:count, count], gram[count, count]
    gram = gram[:count, :count] - np.outer(sums, sums) / total
    squares = np.maximum(gram.diagonal(), 0.0)
    changing = squares > 1e-22 * max(float(squares.max(initial=0.0)), 1e-300)
    unit = float(squares[:cells][changing[:cells]].mean()) if changing[:cells].any() else 1.0
    # Cells keep their ratios; the columns beside them have units of their own.
    scale = np.where(np.arange(count) < cells, 1.0, np.sqrt(unit / np.where(changing, squares, unit)))
    gram = scale[:, None] * gram * scale
    gram[~changing] = 0.0
    gram[:, ~changing] = 0.0
    with one_thread():
        values, vectors = np.linalg.eigh(gram)
        kept = values > count * np.finfo(np.float64).eps * max(float(values.max(initial=0.0)), 1e-300)
        if not smoothing and not ridge:
            diagonal = (vectors[:, kept] ** 2).sum(axis=1)
        else:
            penalty = np.zeros_like(gram)
            layout = CellLayout.of(cells)
            if layout.order:
                penalty[:cells, :cells] = smoothing * unit * layout.roughness.toarray()
            penalty[range(cells), range(cells)] += ridge * unit
            diagonal = np.diagonal(np.linalg.lstsq(gram + penalty, gram, rcond=None)[0])
    return Resolution(int(kept.sum()), np.clip(diagonal, 0.0, 1.0))
