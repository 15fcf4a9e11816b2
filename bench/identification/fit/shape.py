"""Fit of the shape parameters of an operator by variable projection.

Parameters p on which the output depends nonlinearly are varied by bounded nonlinear least squares. For each p the
coefficients x and the bias b follow from the constrained linear problem, so that the residual depends on p alone:
r(p) = y - b(p) - R(p) x(p) (Golub and Pereyra, Inverse Problems 19(2), R1-R26, 2003).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bench.base import Floats
from bench.identification.fit.least_squares import Fit, fit, fit_minimum_norm
from bench.identification.fit.ridge import fit_ridge
from bench.models import Operator, Regressor

# Relative change of parameters, cost and gradient at which a search ends, and its greatest number of steps: of the
# searches from several starts, and of the one that goes on from the best of them.
_COARSE = (1e-3, 30)
_FINE = (1e-8, 100)
# Relative step of the differences: a constrained linear fit is exact to about 1e-12.
_STEP = 1e-6
# Searches are begun from so many starts: those that fit best as they are.
_MOST_SEARCHES = 3
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

    starts = [np.clip(values, low, high) for values in template.shape_starts()]
    if len(starts) > _MOST_SEARCHES:
        costs = [float(np.sum(residuals(values) ** 2)) for values in starts]
        starts = [starts[k] for k in np.argsort(costs, kind="stable")[:_MOST_SEARCHES]]

    def search(values: Floats, tolerance: float, most: int) -> Any:  # noqa: ANN401 - scipy's result
        ends: dict[str, Any] = {"ftol": tolerance, "xtol": tolerance, "gtol": tolerance, "diff_step": _STEP}
        return least_squares(residuals, values, bounds=(low, high), x_scale="jac", max_nfev=most, **ends)

    if len(starts) > 1:
        # Of equal costs the first is taken, so that the result does not depend on rounding alone.
        starts = [min((search(values, *_COARSE) for values in starts), key=lambda end: end.cost).x]
    return template.with_shape(search(starts[0], *_FINE).x.tolist())


def undetermined_shape(operator: Operator[Any]) -> list[str]:
    """Return a warning for each fitted shape parameter that has run to the upper end of its range."""
    shape = operator.shape_parameters()
    return [
        f"{name} = {value:.4g} is at the end of its range: the data do not determine it; measure loops of several "
        "amplitudes, or take another model"
        for name, value, high in zip(shape.names, shape.values, shape.high, strict=True)
        if value >= high - 1e-6 * abs(high)
    ]
