"""Fit of the shape parameters of an operator by variable projection.

Parameters p on which the output depends nonlinearly are varied by bounded nonlinear least squares. For each p the
coefficients x and the bias b follow from the constrained linear problem, so that the residual depends on p alone:
r(p) = y - b(p) - R(p) x(p) (Golub and Pereyra, Inverse Problems 19(2), R1-R26, 2003).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bench.hysteresis import Operator, Regressor
from bench.hysteresis._checks import Floats
from bench.identification.least_squares import Fit, fit, fit_minimum_norm

# Relative change of parameters, cost and gradient at which the search ends.
_TOLERANCE = 1e-10
# Relative step of the differences: a constrained linear fit is exact to about 1e-12.
_STEP = 1e-6
# Cells of a dense normal matrix: 0.5 GB.
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
    """Return the coefficients of an operator: with its signs if constrained, else free.

    Free coefficients without a penalty are those of the least norm.
    """
    if not constrained and not smoothing and not ridge:
        return fit_minimum_norm(regressor, outputs, weights=weights, skip=skip)
    if not constrained and regressor.base.size > _MOST_CELLS:
        raise ValueError(
            f"levels: penalties on a density of either sign take at most {_MOST_CELLS} cells (126 levels), got "
            f"{regressor.base.size}; give fewer levels, or smoothing 0 and ridge 0"
        )
    signs = operator.nonnegative() if constrained else False
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
    # Here, as few operators have a shape and it takes a third of a second to load.
    from scipy.optimize import least_squares

    low, high = np.array(shape.low), np.array(shape.high)
    roots = np.sqrt(weights[skip:])

    def residuals(values: Floats) -> Floats:
        operator = template.with_shape(values.tolist())
        regressor = operator.regressor(inputs, start(operator))
        found = fit_operator(constrained, operator, regressor, outputs, weights, skip, smoothing)
        return roots * (outputs - found.bias - regressor.product(found.coefficients))[skip:]

    options: dict[str, Any] = {"ftol": _TOLERANCE, "xtol": _TOLERANCE, "gtol": _TOLERANCE, "diff_step": _STEP}
    ends = [
        least_squares(residuals, np.clip(values, low, high), bounds=(low, high), x_scale="jac", **options)
        for values in template.shape_starts()
    ]
    # Of equal costs the first is taken, so that the result does not depend on rounding alone.
    return template.with_shape(min(ends, key=lambda end: end.cost).x.tolist())
