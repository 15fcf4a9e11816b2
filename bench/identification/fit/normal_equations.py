"""Products of the columns of a regressor with each other, by folds of the samples."""

from __future__ import annotations

import numpy as np

from bench.base import Floats
from bench.identification.fit.cell_layout import Indices
from bench.identification.fit.least_squares import one_thread
from bench.models import Regressor

# Samples whose rows are formed at a time. Derivation: of a thousand columns they take 8 MB.
_ROWS = 1024


def normal_equations(
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    skip: int,
    fold: Indices | None = None,
    folds: int = 1,
) -> Floats:
    """Return, for each fold, the weighted products of the columns, of ones and of the outputs with each other.

    Shape (folds, K + q + 2, K + q + 2). Columns and outputs have about their means subtracted, so that little is
    cancelled later. The rows are formed some at a time.

    Parameters
    ----------
    regressor : Regressor
        Shape (N, K + q).
    outputs, weights : ndarray, shape (N,)
        Measured outputs, and weight of each sample.
    skip : int
        Number of first samples left out.
    fold : ndarray of int64, shape (N,), optional
        Fold of each sample, from 0; all are one if not given.
    folds : int
        Number of folds.
    """
    from bench.models import memory_kernels as _kernels

    count = regressor.shape[1] + 2
    cells = regressor.base.size
    result = np.zeros((folds, count, count))
    roots = np.where(np.arange(outputs.size) < skip, 0.0, np.sqrt(weights))
    centre = np.zeros(count)
    row = regressor.base
    for start in range(0, outputs.size, _ROWS):
        chunk = slice(start, min(start + _ROWS, outputs.size))
        dense = np.empty((chunk.stop - start, cells))
        _kernels.dense_rows(
            regressor.starts[start : chunk.stop + 1], regressor.cells, regressor.changes, row.copy(), dense
        )
        row = dense[-1].copy()
        rows = np.column_stack([dense, regressor.extra[chunk], np.ones(len(dense)), outputs[chunk]])
        if not start:
            # Little is then cancelled in what follows.
            centre[:] = rows.mean(axis=0)
            centre[-2] = 0.0
        rows -= centre
        # The product of a matrix with itself takes half the work.
        rows *= roots[chunk, None]
        with one_thread():
            for k in range(folds):
                part = rows if fold is None else rows[fold[chunk] == k]
                result[k] += part.T @ part
    return result
