"""Choice of the penalties of a fit without sign constraints, by cross-validation over blocks of samples.

A density of either sign is not bounded by its data: differences that the data hardly tell apart are fitted to the
noise, and another input then meets coefficients of any size. Two penalties determine them: on the roughness of the
density and on its size (Tikhonov and Arsenin, Solutions of ill-posed problems, 1977). Their weights are those of the
least error on blocks left out of the fit. Neighbouring samples have nearly the same error, as a model's misfit is no
noise; generalized cross-validation (Golub, Heath and Wahba, Technometrics 21, 215, 1979), which takes the errors as
independent, would hardly smooth at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.base import Floats
from bench.identification.choose.splits import FOLDS, SMOOTHING_BLOCKS
from bench.identification.fit.cell_layout import CellLayout
from bench.identification.fit.least_squares import check_penalties, one_thread
from bench.identification.fit.normal_equations import normal_equations
from bench.identification.fit.scaled_columns import unit_of_penalties
from bench.models import Regressor

SMOOTHING = tuple((10.0 ** np.arange(-6.0, 2.1)).tolist())
"""Weights of the roughness penalty that are tried; see `fit`. Derivation: in units of the data's own weight, from the
square of the rounding of readings of three digits to where the density is flat; decades, as errors tell no less."""
RIDGE = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Weights of the penalty on the size of the density that are tried; see `fit`. Derivation: none of it, and the
decades of the roughness up to where the size costs a tenth of what the data weigh."""

# Samples of a block, as far as there are so many. Derivation: three of four have no neighbour in another block.
_SHORTEST = 8
# The weights belong to the density, not to the plane: they are chosen on one of at most this order. Derivation: it
# has 300 cells, and 315 factorizations of 9 million operations each take about a second.
_FINEST = 24
# Added to the squared norm of each scaled column, so that columns without a penalty may be collinear. Derivation: the
# rounding of sums of some hundred products.
_FLOOR = 1e-13


@dataclass(frozen=True)
class Regularization:
    """Weights of the two penalties, and what cross-validation says of them.

    Attributes
    ----------
    smoothing, ridge : float
        Weights of the roughness and of the size of the density; see `fit`.
    rms : float
        RMS error over blocks left out of the fit, output units; nan if both weights were given.
    spread : float
        Standard error of `rms` from the scatter of the folds.
    training_rms : float
        RMS error over the samples fitted, mean over the folds.
    levels : int or None
        Number of intervals of the plane; None if it was not varied.
    """

    smoothing: float
    ridge: float
    rms: float = math.nan
    spread: float = math.nan
    training_rms: float = math.nan
    levels: int | None = None

    @classmethod
    def of_folds(
        cls, smoothing: float, ridge: float, squares: Floats, counts: Floats, training: Floats
    ) -> Regularization:
        """Return weights with what their fits without each of K folds say.

        Parameters
        ----------
        smoothing, ridge : float
            The weights.
        squares, counts : ndarray, shape (K,)
            Weighted sum of the squared errors over each fold, output units squared, and sum of its weights.
        training : ndarray, shape (K,)
            RMS error of each fit over its own samples, output units.
        """
        by_fold = np.sqrt(squares / counts)
        return cls(
            smoothing,
            ridge,
            rms=float(np.sqrt(squares.sum() / counts.sum())),
            spread=float(np.std(by_fold, ddof=1) / np.sqrt(by_fold.size)),
            training_rms=float(training.mean()),
        )

    def summary(self, unit: str = "") -> str:
        """Return the weights, and the error by which they were chosen, in a line; `unit` starts with a blank."""
        text = f"smoothing {self.smoothing:.2g}, ridge {self.ridge:.2g}"
        if math.isnan(self.rms):
            return text
        return f"{text}; RMS error {self.rms:.4g} ± {self.spread:.2g}{unit} on blocks left out"


def choose_regularization(
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    skip: int,
    smoothing: float | None = None,
    ridge: float | None = None,
) -> Regularization:
    """Return the weights of the least cross-validated error; a weight that is given is kept.

    The samples are cut into 20 blocks, and block b belongs to fold b modulo 5. Of few samples there are fewer blocks,
    of at least 8 samples each as long as each fold has one. The memory runs through all of them. On a fine plane the
    weights are chosen with cells merged two by two until at most 24 levels are left.

    Parameters
    ----------
    regressor : Regressor
        Shape (N, K + q), with cells.
    outputs, weights : ndarray, shape (N,)
        Measured outputs, and weight of each sample.
    skip : int
        Number of first samples left out.
    smoothing, ridge : float or None
        Weights that are given; not both 0.

    Raises
    ------
    ValueError
        If a weight is negative or not finite.
    """
    check_penalties(smoothing or 0.0, ridge or 0.0)
    used = outputs.size - skip
    blocks = min(SMOOTHING_BLOCKS, max(FOLDS, used // _SHORTEST))
    fold = (np.maximum(np.arange(-skip, used), 0) * min(blocks, used) // used) % FOLDS
    layout = CellLayout.of(regressor.base.size)
    coarse, layout, factor, size = _coarse(regressor, layout)
    grams = normal_equations(coarse, outputs, weights, skip, fold, FOLDS)
    # Each fold needs samples that count.
    grams = grams[grams[:, -2, -2] > 0.0]
    if len(grams) < 2:
        return Regularization(smoothing or 0.0, 1.0 if ridge is None else ridge)
    total = grams.sum(axis=0)
    cells = layout.cells.size
    unit = unit_of_penalties(regressor, np.where(np.arange(weights.size) < skip, 0.0, weights))
    rough, plain = np.zeros_like(total), np.zeros_like(total)
    if layout.order:
        rough[:cells, :cells] = factor * unit * layout.roughness.toarray()
    plain[range(cells), range(cells)] = unit * size
    tried = [
        (s, r)
        for s in (SMOOTHING if smoothing is None else (smoothing,))
        for r in (RIDGE if ridge is None else (ridge,))
        if s > 0.0 or r > 0.0
    ]
    counts = grams[:, -2, -2]
    squares, training = np.empty((len(tried), len(grams))), np.empty((len(tried), len(grams)))
    with one_thread():
        for i, (s, r) in enumerate(tried):
            for k, left_out in enumerate(grams):
                squares[i, k], training[i, k] = _errors(total - left_out, left_out, s * rough + r * plain)
    best = int(np.argmin(squares.sum(axis=1)))
    fitted = np.sqrt(training[best] / (counts.sum() - counts))
    return Regularization.of_folds(*tried[best], squares[best], counts, fitted)


def _coarse(regressor: Regressor, layout: CellLayout) -> tuple[Regressor, CellLayout, float, float]:
    """Return the regressor with cells merged until the plane is coarse, its layout, and factors of both penalties."""
    rough, size = 1.0, 1.0
    while layout.order > _FINEST:
        layout, parents = layout.coarser()
        regressor = regressor.merged(parents, layout.cells.size)
        # A Laplacian of twice the step is four times as great, on a quarter of the cells.
        rough, size = 0.25 * rough, 4.0 * size
    return regressor, layout, rough, size


def _errors(training: Floats, held_out: Floats, penalty: Floats) -> tuple[float, float]:
    """Return the sums of squared errors over the samples left out and those fitted."""
    from scipy.linalg.lapack import dposv

    matrix = (training + penalty)[:-1, :-1]
    scale = 1.0 / np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    matrix = scale[:, None] * matrix * scale
    matrix[np.diag_indices_from(matrix)] += _FLOOR
    _, x, info = dposv(matrix, scale * training[:-1, -1], overwrite_a=1)
    if info:
        return np.inf, np.inf
    x *= scale
    combined = np.append(-x, 1.0)
    # Of an exact fit rounding may leave less than nothing.
    left, fitted = (max(float(combined @ gram @ combined), 0.0) for gram in (held_out, training))
    return left, fitted
