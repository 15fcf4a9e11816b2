"""Fit of the coefficients of an operator, and of its shape parameters by variable projection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bench.base import Floats
from bench.identification.advice import Advice
from bench.identification.fit.least_squares import Fit, fit, fit_minimum_norm
from bench.identification.fit.ridge import fit_ridge
from bench.identification.fit.variable_projection import variable_projection
from bench.models import Operator, Regressor

# Relative step of the differences. Derivation: the root of 1e-12, to which a constrained linear fit is exact.
_STEP = 1e-6
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
) -> Fit:
    """Return the coefficients of an operator, with its signs if constrained, and free ones of columns beside its own.

    Free coefficients of a density without a penalty are those of the least norm.
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
    return fit(regressor, outputs, nonnegative=signs, weights=weights, skip=skip, **penalties)


def fit_shape(
    template: Operator[Any],
    constrained: bool,
    start: Callable[[Operator[Any]], Any],
    inputs: Floats,
    outputs: Floats,
    weights: Floats,
    skip: int,
    smoothing: float,
) -> Operator[Any]:
    """Return the operator with the shape parameters that fit best; the operator itself if it has none.

    Parameters
    ----------
    template : Operator
        With the bounds of its shape parameters, and the values to start from.
    constrained : bool
        Whether the signs of the coefficients are constrained.
    start : callable
        Takes an operator; returns its state before the first sample.
    inputs, outputs, weights : ndarray, shape (N,)
        The measured sequence and the weight of each sample.
    skip : int
        Number of first samples left out of the cost.
    smoothing : float
        Weight of the roughness penalty.
    """
    shape = template.shape_parameters()
    if not shape.names:
        return template
    low, high = np.array(shape.low), np.array(shape.high)
    roots = np.sqrt(weights[skip:])

    def residuals(values: Floats) -> Floats:
        operator = template.with_shape(values.tolist())
        regressor = operator.regressor(inputs, start(operator))
        found = fit_operator(constrained, operator, regressor, outputs, weights, skip, smoothing)
        return roots * (outputs - found.bias - regressor.product(found.coefficients))[skip:]

    starts = [np.asarray(values, dtype=np.float64) for values in template.shape_starts()]
    best = variable_projection(residuals, starts, (low, high), step=_STEP)[0]
    return template.with_shape(best.values.tolist())


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
