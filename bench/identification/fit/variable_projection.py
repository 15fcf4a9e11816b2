"""Nonlinear least squares of all fits: bounded, from several starts, with linear coefficients eliminated.

A model y = Φ(p) x + b is linear in coefficients x and bias b, but not in the parameters p. For each p the best x and
b follow from a linear problem, so that the residuals depend on p alone: r(p) = y - b(p) - Φ(p) x(p) (Golub and
Pereyra, Inverse Problems 19(2), R1-R26, 2003). Their derivative is taken in the form of Kaufman (BIT 15, 49-57,
1975): the change of Φ(p) x at fixed x, without what the free coefficients can take over.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from bench.base import Floats
from bench.identification.fit.least_squares import Fit

Residuals: TypeAlias = Callable[[Floats], Floats]
"""Takes parameters, shape (P,); returns weighted residuals, shape (N,)."""

# Step of central differences of parameters of the order of one, such as logarithms. Source: its error is least at the
# cube root of the rounding of a number, 6e-6 (Press et al., Numerical Recipes, 3rd ed. 2007, section 5.7).
_STEP = 1e-5
# Damping d of the products of columns of unit length, and passes of the solution. Derivation: a pass leaves the part
# d / (s² + d) of what lies along a combination of length s. Three passes leave an eighth where s is 1e-6, a millionth
# where it is 1e-5.
_DAMPING, _PASSES = 1e-12, 3
# Part of its range by which a parameter counts as away from 0, at least. Derivation: times a step of 1e-6 it is far
# above the rounding of a number, and below a last printed digit.
_NEAR = 1e-3
# Part of all slopes up to which a parameter has none. Derivation: outputs that do not depend on it differ by their
# rounding, 1e-16, over a step of 1e-5, which makes 1e-11 of the outputs; slopes are some tenfold of these.
_FLAT = 1e-12
# Least length that is divided by. Derivation: its square is still a number.
_LEAST = 1e-150


class Stage(NamedTuple):
    """One stage of a search.

    Attributes
    ----------
    starts : int
        How many of the best starts are searched from.
    tolerance : float
        Relative change of cost and parameters at which a search ends.
    evaluations : int
        Most evaluations of the residuals in a search.
    """

    starts: int
    tolerance: float
    evaluations: int


STAGES = (Stage(3, 1e-3, 30), Stage(1, 1e-8, 100))
"""The usual stages: the best three starts coarsely, the best end finely. Derivation: 1e-8 is the root of the rounding
of a number, below which the cost does not tell parameters apart; 1e-3 is enough to tell which end is the best."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a Jacobian says of the parameters of a fit.

    Attributes
    ----------
    deviations : ndarray, shape (P,)
        Standard deviations, as if the residuals were white; infinite where these do not depend on a parameter.
    condition : float
        Condition number of the Jacobian with its columns scaled to unit norm.
    cosines : ndarray, shape (P,)
        Magnitudes of the cosine between the residuals and each column; 0 is exact optimality.
    """

    deviations: Floats
    condition: float
    cosines: Floats

    @classmethod
    def of(cls, jacobian: Floats, residuals: Floats, count: int) -> Evidence:
        """Return the evidence of a Jacobian, shape (N, P), and residuals of which `count` are free, at least one."""
        norms = np.maximum(np.linalg.norm(jacobian, axis=0), _LEAST)
        scaled = jacobian / norms
        square = float(residuals @ residuals)
        # Of the slopes themselves, as the inverse of their products may have negative variances by rounding.
        spreads = np.sqrt(square / max(count, 1) * np.sum(np.linalg.pinv(scaled) ** 2, axis=1)) / norms
        return cls(
            np.where(norms <= max(_FLAT * float(np.linalg.norm(norms)), _LEAST), np.inf, spreads),
            float(np.linalg.cond(scaled)) if norms.size else 1.0,
            np.abs(scaled.T @ residuals) / max(np.sqrt(square), _LEAST),
        )


@dataclass(frozen=True, eq=False)
class End:
    """Where a search ended."""

    values: Floats  # shape (P,); the parameters
    residuals: Floats  # shape (N,); weighted
    jacobian: Floats  # shape (N, P); their derivative by the parameters
    evaluations: int = 1  # evaluations of the residuals
    converged: bool = True  # whether the tolerance was reached

    @property
    def cost(self) -> float:
        """Weighted sum of squares."""
        return float(self.residuals @ self.residuals)


# Takes right sides, shape (N,) or (N, P); returns the coefficients of least squares, and what they leave.
_Solver: TypeAlias = Callable[[Floats], tuple[Floats, Floats]]


class _Point(NamedTuple):
    """The linear problem at given parameters: the solver for its free columns, and its solution."""

    key: bytes
    solve: _Solver
    coefficients: Floats
    residuals: Floats


class Separable:
    """Residuals of a model that is linear in coefficients and a bias, and their Jacobian.

    Parameters
    ----------
    outputs : ndarray, shape (N,)
        Measured.
    roots : ndarray, shape (N,)
        Square roots of the weights of the samples.
    columns : callable
        Takes parameters, shape (P,); returns Φ, shape (N, K).
    respond : callable or None
        Takes parameters and coefficients, shape (K,); returns Φ x, shape (N,). None multiplies.
    fit : callable or None
        Takes Φ; returns the fit of its coefficients, such as one with signs, whose coefficients of 0 are not free.
        None takes the coefficients of least squares.
    """

    def __init__(
        self,
        outputs: Floats,
        roots: Floats,
        columns: Callable[[Floats], Floats],
        respond: Callable[[Floats, Floats], Floats] | None = None,
        fit: Callable[[Floats], Fit] | None = None,
    ) -> None:
        self._outputs, self._roots, self._columns, self._fit = outputs, roots, columns, fit
        self._respond = respond or (lambda values, coefficients: columns(values) @ coefficients)
        self._at: _Point | None = None

    def coefficients(self, values: Floats) -> Floats:
        """Return coefficients and bias for given parameters, shape (K + 1,)."""
        return self._solve(values).coefficients

    def residuals(self, values: Floats) -> Floats:
        """Return the weighted residuals for given parameters, shape (N,)."""
        return self._solve(values).residuals

    def slopes(self, values: Floats, low: Floats, high: Floats) -> Floats:
        """Return the change of the weighted outputs with each parameter at fixed coefficients, shape (N, P)."""
        coefficients = self._solve(values).coefficients[:-1]

        def respond(moved: Floats) -> Floats:
            return self._roots * self._respond(moved, coefficients)

        return _differences(respond, values, np.full(values.size, _STEP), low, high, central=True)

    def jacobian(self, values: Floats, low: Floats, high: Floats) -> Floats:
        """Return the derivative of the weighted residuals, in the form of Kaufman, shape (N, P)."""
        return -self._solve(values).solve(self.slopes(values, low, high))[1]

    def _solve(self, values: Floats) -> _Point:
        key = values.tobytes()
        if self._at is None or self._at.key != key:
            columns = self._columns(values)
            weighted = self._roots[:, None] * np.column_stack([columns, np.ones(columns.shape[0])])
            target = self._roots * self._outputs
            if self._fit is None:
                solve = _solver(weighted)
                coefficients, rest = solve(target)
            else:
                found = self._fit(columns)
                coefficients = np.append(found.coefficients, found.bias)
                solve = _solver(weighted[:, np.append(found.coefficients != 0.0, True)])
                rest = target - weighted @ coefficients
            self._at = _Point(key, solve, coefficients, rest)
        return self._at


def variable_projection(
    problem: Separable | Residuals,
    starts: Sequence[Floats],
    bounds: tuple[Floats, Floats] | None = None,
    *,
    stages: Sequence[Stage] = STAGES,
    screen: Residuals | None = None,
    apart: float = 0.0,
    step: float = _STEP,
    central: bool = False,
) -> tuple[End, ...]:
    """Return the ends of the searches of the last stage, the best first.

    Each stage searches from the best ends of the one before, by a method of trust regions within bounds (Branch,
    Coleman and Li, SIAM J. Sci. Comput. 21, 1-23, 1999). From one start only the last stage searches. Of equal costs
    the first counts, so that the result does not depend on rounding alone.

    Parameters
    ----------
    problem : Separable or callable
        The residuals. Those of a callable are differentiated by differences.
    starts : sequence of ndarray, shape (P,)
        Parameters to start from; without parameters the residuals are all that is computed.
    bounds : tuple of ndarray, shape (P,)
        Least and greatest parameters; none if None.
    stages : sequence of Stage
        The effort.
    screen : callable or None
        Residuals by which starts are compared; None takes those of the problem.
    apart : float
        Of two starts that differ by no more than this in each parameter, the worse is left out.
    step : float
        Step of the differences of a callable, as part of each parameter, or of a thousandth of its range.
    central : bool
        Whether these differences are central ones.
    """
    low, high = bounds or (np.full(starts[0].size, -np.inf), np.full(starts[0].size, np.inf))
    residuals: Residuals = problem.residuals if isinstance(problem, Separable) else problem
    if not starts[0].size:
        rest = residuals(starts[0])
        return (End(starts[0], rest, np.empty((rest.size, 0))),)
    points = [np.clip(start, low, high) for start in starts]
    if len(points) > stages[0].starts:
        points = _best(screen or residuals, points, stages[0].starts, apart)
    ends: list[End] = []
    for number, stage in enumerate(stages):
        if len(points) > 1 or number + 1 == len(stages):
            searched = [_search(problem, point, low, high, stage, step, central) for point in points[: stage.starts]]
            ends = sorted(searched, key=lambda end: end.cost)
            points = [end.values for end in ends]
    return tuple(ends)


def _best(residuals: Residuals, starts: Sequence[Floats], count: int, apart: float) -> list[Floats]:
    """Return the best few of some starts, none near a better one."""
    costs = [float(np.sum(residuals(values) ** 2)) for values in starts]
    chosen: list[Floats] = []
    for place in np.argsort(costs, kind="stable").tolist():
        if all(np.abs(starts[place] - other).max() > apart for other in chosen) or not apart:
            chosen.append(starts[place])
        if len(chosen) == count:
            break
    return chosen


def _search(
    problem: Separable | Residuals, start: Floats, low: Floats, high: Floats, stage: Stage, step: float, central: bool
) -> End:
    """Return the end of one search."""
    # Here, as it takes a third of a second to load.
    from scipy.optimize import least_squares

    residuals: Residuals = problem.residuals if isinstance(problem, Separable) else problem
    # Free of units, so that the limit of the gradient holds for all outputs.
    unit = max(float(np.linalg.norm(residuals(start))), _LEAST)

    @lru_cache(maxsize=1)
    def at(key: bytes) -> Floats:
        return residuals(np.frombuffer(key)) / unit

    def scaled(values: Floats) -> Floats:
        return at(values.tobytes())

    def jacobian(values: Floats) -> Floats:
        if isinstance(problem, Separable):
            return problem.jacobian(values, low, high) / unit
        # A parameter near 0 still moves by a part of its range, or of one where there is none.
        spans = np.where(np.isfinite(high - low), high - low, 1.0)
        return _differences(scaled, values, step * np.maximum(np.abs(values), _NEAR * spans), low, high, central)

    end = least_squares(
        scaled,
        start,
        jacobian,
        bounds=(low, high),
        x_scale="jac",
        ftol=stage.tolerance,
        xtol=stage.tolerance,
        gtol=float(np.finfo(np.float64).eps),
        max_nfev=stage.evaluations,
    )
    rest, slopes = unit * np.asarray(end.fun), unit * np.asarray(end.jac)
    return End(np.asarray(end.x), rest, slopes, int(end.nfev), bool(end.success))


def _differences(
    function: Residuals, values: Floats, steps: Floats, low: Floats, high: Floats, central: bool
) -> Floats:
    """Return the derivatives of a function by differences within bounds, shape (N, P)."""
    columns, here = [], None if central else function(values)
    for k, step in enumerate(steps.tolist()):
        ends = values.copy(), values.copy()
        ends[0][k], ends[1][k] = max(values[k] - step, low[k]), min(values[k] + step, high[k])
        if here is None:
            columns.append((function(ends[1]) - function(ends[0])) / (ends[1][k] - ends[0][k]))
        else:
            end = ends[1] if values[k] + step <= high[k] else ends[0]
            columns.append((function(end) - here) / (end[k] - values[k]))
    return np.column_stack(columns)


def _solver(columns: Floats) -> _Solver:
    """Return the solver of least squares for columns: normal equations, whose remainder is solved for again."""
    norms = np.maximum(np.linalg.norm(columns, axis=0), _LEAST)
    scaled = columns / norms
    gram = scaled.T @ scaled
    gram.flat[:: gram.shape[0] + 1] += _DAMPING
    factor = np.linalg.inv(np.linalg.cholesky(gram))

    def solve(right: Floats) -> tuple[Floats, Floats]:
        found, rest = np.zeros((columns.shape[1], *right.shape[1:])), right
        for _ in range(_PASSES):
            more = factor.T @ (factor @ (scaled.T @ rest))
            found += more
            rest = rest - scaled @ more
        return (found.T / norms).T, rest

    return solve
