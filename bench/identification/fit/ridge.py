"""Least squares with free signs and a penalty on the size of each coefficient: ridge regression."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats
from bench.identification.fit.least_squares import Certificate, Fit, counted_weights, one_thread
from bench.models import Regressor

# Part of the greatest eigenvalue of a matrix of products below which one is rounding: that of a product is N times
# the unit roundoff, here with N up to 1e3 columns. Source: Higham 2002, section 3.1.
_RANK = 1e3 * np.finfo(np.float64).eps


def fit_ridge(
    regressor: Regressor, outputs: Floats, ridge: float, *, weights: ArrayLike | None = None, skip: int = 0
) -> Fit:
    """Return bias b and x that minimise Σ w (outputs - b - R x)² + ridge Σ w Σ (s x)².

    Here s is the weighted standard deviation of a column, so that units do not matter. The effective number of
    coefficients is Σ λ / (λ + ridge), with the eigenvalues λ of the correlation of the columns.

    Parameters
    ----------
    regressor : Regressor
        Shape (N, q), dense columns alone.
    outputs : ndarray, shape (N,)
        Measured outputs.
    ridge : float
        Weight of the penalty, >= 0; with 0 the least x of standardised columns is returned.
    weights : array_like, shape (N,), or None
        Weight of each sample, >= 0; default 1.
    skip : int
        Number of first samples left out.

    Raises
    ------
    ValueError
        If the penalty is negative, or no sample counts.

    Notes
    -----
    Hastie, Tibshirani and Friedman, The Elements of Statistical Learning, 2009, section 3.4.1.
    """
    if not (np.isfinite(ridge) and ridge >= 0.0):
        raise ValueError(f"ridge: expected a number >= 0, got {ridge}")
    w = counted_weights(regressor.shape[0], weights, skip)
    total, roots = float(w.sum()), np.sqrt(w)
    means, mean = w @ regressor.extra / total, float(w @ outputs / total)
    columns, target = roots[:, None] * (regressor.extra - means), roots * (outputs - mean)
    scales = np.sqrt(np.einsum("ij,ij->j", columns, columns) / total)
    swept = scales > 1e-12 * np.maximum(np.hypot(scales, means), 1e-300)
    # Others become 0, and so do their coefficients.
    scales[~swept] = np.inf
    columns /= scales
    with one_thread():
        values, directions = np.linalg.eigh(columns.T @ columns / total)
    kept = values > _RANK * max(float(values[-1]), 1e-300)
    values, directions = values[kept], directions[:, kept]
    inverse = 1.0 / (values + ridge)
    slope = columns.T @ target / total
    standard = directions @ (inverse * (directions.T @ slope))
    residual = target - columns @ standard
    effective = float(inverse @ values)
    spare = np.count_nonzero(w) - 1.0 - effective
    variance = float(residual @ residual) / total / spare if spare > 0.5 else np.nan
    spread = np.sqrt(variance * (directions**2 @ (inverse**2 * values)))
    left = columns.T @ residual / total - ridge * standard
    kkt = float(np.abs(directions.T @ left).max(initial=0.0)) / max(float(np.linalg.norm(slope)), 1e-300)
    rank = values.size
    certificate = Certificate(
        kkt_residual=kkt,
        passive=rank,
        active=standard.size - rank,
        exchangeable=0 if ridge else max(int(swept.sum()) - rank, 0),
        condition=float(np.sqrt(inverse[0] / inverse[-1])) if rank else 1.0,
        swept=swept,
        iterations=1,
        converged=kkt <= 1e-8,
        effective=effective,
    )
    x = standard / scales
    return Fit(x, mean - float(means @ x), np.where(swept, spread / scales, np.nan), certificate)
