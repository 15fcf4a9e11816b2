"""Fit of the coefficients of an operator, and advice on its shape parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base import Floats
from bench.identification.advice import Advice
from bench.identification.fit.least_squares import Fit, fit, fit_minimum_norm
from bench.identification.fit.ridge import fit_ridge
from bench.models import Operator, Regressor

# Cells of a dense normal matrix. Derivation: 8 B of each pair of them take 0.5 GB.
_MOST_CELLS = 8001


def fit_operator(
    constrained: bool,
    operator: Operator[Any],
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    skip: int,
    smoothing: float,
    ridge: float = 0.0,
    start: Floats | None = None,
) -> Fit:
    """Return the coefficients of an operator, with its signs if constrained, and free ones of columns beside its own.

    Free coefficients of a density without a penalty are those of the least norm. `start` is as for `fit`.
    """
    if not regressor.base.size and not (constrained and operator.nonnegative().any()):
        return fit_ridge(regressor, outputs, ridge, weights=weights, skip=skip)
    if not constrained and not smoothing and not ridge:
        return fit_minimum_norm(regressor, outputs, weights=weights, skip=skip)
    if not constrained and regressor.base.size > _MOST_CELLS:
        raise ValueError(
            f"levels: penalties on a density of either sign take at most {_MOST_CELLS} cells (126 levels), got "
            f"{regressor.base.size}; give fewer levels, or smoothing 0 and ridge 0"
        )
    signs = np.zeros(regressor.shape[1], dtype=bool)
    if constrained:
        own = operator.nonnegative()
        signs[: own.size] = own
    penalties = {"smoothing": smoothing, "ridge": ridge}
    return fit(regressor, outputs, nonnegative=signs, weights=weights, skip=skip, start=start, **penalties)


def undetermined_shape(operator: Operator[Any]) -> list[Advice]:
    """Return advice on each fitted shape parameter that has run to the upper end of its range."""
    shape = operator.shape_parameters()
    return [
        Advice(
            f"{name}-range",
            f"{name} = {value:.4g} is at the end of its range: the data do not determine it",
            "measure loops of several amplitudes, or take another model",
        )
        for name, value, high in zip(shape.names, shape.values, shape.high, strict=True)
        if value >= high - 1e-6 * abs(high)
    ]
