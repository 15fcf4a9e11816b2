"""The search for the parameters of what follows an operator: variable projection from several starts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from bench.base import Floats
from bench.identification.by_name import FitProblem
from bench.identification.fit.least_squares import Fit
from bench.identification.fit.variable_projection import Evidence, Separable, Stage, variable_projection
from bench.identification.timed.parsimony import moving
from bench.models import LinearPart, Regressor, logarithmic_creep, velocities

# Principal columns of the operator in a first search. Source: a choice; the fit of all columns follows.
_FREE = 30

# Rounds of search and constrained fit, and the relative gain of the cost at which they end. Derivation: a parameter
# that means nothing gains more by chance, 2 log(N) / N, on records of fewer than a million rows.
_ROUNDS, _GAIN = 4, 1e-5
# Principal columns in the grid that a search starts from. Source: a choice; with the signal of the operator alone
# they stand for it; the search then has more.
_COARSE = 6
# A search. Source: a choice. Two starts are the deepest valley of the grid and another one. The tolerance is a
# ten-thousandth of the gain at which the rounds end. A search that is cut off goes on in the next round.
_STAGE = Stage(starts=2, tolerance=1e-9, evaluations=40)
COMPARING = Stage(starts=1, tolerance=1e-4, evaluations=40)
"""A search whose end is only compared with others. Derivation: the tolerance is far below the tie of two scores, 2 %.
Source: measured on ten records; from 1e-3 on, other elements win."""


@dataclass(frozen=True)
class _Parameter:
    """A nonlinear parameter: its name, the values to start from, and bounds."""

    name: str
    starts: tuple[float, ...]
    low: float
    high: float


class Following(NamedTuple):
    """What follows an operator and stands beside it, but for the strengths of what stands beside it."""

    part: LinearPart  # delay, lag or resonance, and creep
    drift_time: float  # time constant of a drift that fades, s; 0 for another
    friction_speed: float  # of a friction, input units/s; 0 if there is none

    def respond(self, times: Floats, columns: Floats) -> Floats:
        """Return columns behind the linear part, shape (N, K): the same ones if nothing follows."""
        part = self.part
        is_static = not (part.delay or part.lag[0] or part.creep_times.size)
        return columns if is_static else part.respond(times, columns)[0]


def beside(elements: Sequence[str]) -> list[str]:
    """Return the elements that stand beside the operator, in the order of their columns."""
    return [name for name in ("drift", "fading-drift", "viscous", "friction") if name in elements]


@dataclass(frozen=True, eq=False)
class Responses:
    """The columns of an operator behind what follows it, and those beside it."""

    columns: Floats  # shape (N, K)
    beside: Floats  # shape (N, q)
    cells: int  # number of the first columns that are cells of a density

    @cached_property
    def regressor(self) -> Regressor:
        """All columns, shape (N, K + q)."""
        dense = np.column_stack([self.columns[:, self.cells :], self.beside])
        return Regressor.of_cells(self.columns[:, : self.cells], dense)

    def without_still(self, weights: Floats, skip: int) -> Regressor:
        """Return all columns; those of the operator that hardly change in the fitted rows are 0."""
        moved = np.append(moving(self.columns, weights, skip), np.ones(self.beside.shape[1], dtype=bool))
        return self.regressor if moved.all() else self.regressor.keeping(moved)

    def predict(self, found: Fit) -> Floats:
        """Return the outputs by a fit, shape (N,)."""
        count = self.columns.shape[1]
        operator, beside = found.coefficients[:count], found.coefficients[count:]
        return np.asarray(found.bias + self.columns @ operator + self.beside @ beside)


@dataclass(frozen=True, eq=False)
class Search:
    """Everything but the elements: the measured sequence, and the operator's columns."""

    times: Floats  # shape (N,); s
    static: FitProblem  # the problem of the operator alone
    columns: Floats  # shape (N, K); its regressor
    roots: Floats  # shape (N,); square roots of the weights, 0 for rows left out
    signs: tuple[Literal[1, -1], ...]  # signs of the operator's coefficients that are tried
    smoothing: float = 0.0  # weight of the roughness penalty on the density of the operator, see `fit`
    ridge: float = 0.0  # weight of the penalty on the coefficients of an operator without a density, see `fit_ridge`

    @cached_property
    def elapsed(self) -> Floats:
        """Time since the first row, s, shape (N,)."""
        return np.asarray(self.times - self.times[0])

    @cached_property
    def speeds(self) -> Floats:
        """Velocity of the input, input units/s, shape (N,)."""
        return velocities(self.times, self.static.inputs)

    @cached_property
    def step(self) -> float:
        """Median step of time, s."""
        return float(np.median(np.diff(self.times)))

    @cached_property
    def principal(self) -> Floats:
        """Principal columns of the operator, the strongest first, shape (N, r)."""
        centred = self.columns - self.columns.mean(axis=0)
        strengths, directions = np.linalg.eigh(centred.T @ centred)
        kept = strengths > 1e-10 * strengths[-1]
        return np.ascontiguousarray(self.columns @ directions[:, kept][:, ::-1])

    @cached_property
    def alone(self) -> Found:
        """The operator with nothing behind or beside it."""
        return self.fitted((), np.empty(0), np.empty(0))

    @property
    def span(self) -> float:
        """Length of the record, s."""
        return float(self.elapsed[-1])

    @property
    def creep_span(self) -> tuple[float, float]:
        """Shortest and longest retardation time, s."""
        return 10.0 * self.step, self.span

    def parameters(self, elements: Sequence[str]) -> list[_Parameter]:
        """Return the nonlinear parameters of elements: logarithms of times and damping, delay in steps."""
        shortest, longest, found = math.log(self.step), math.log(self.span), []
        decades = max(1, round(math.log10(self.creep_span[1] / self.creep_span[0])))
        for element in elements:
            if element == "lag":
                starts = tuple(np.linspace(shortest - 1.0, longest - 1.0, 12))
                found.append(_Parameter("lag", starts, shortest - math.log(100.0), longest + 1.0))
            elif element == "resonance":
                low = math.log(2.0 * math.pi) - longest
                high = math.log(20.0 * math.pi) - shortest
                top = math.log(math.pi) - shortest
                starts = (*np.linspace(max(low, top - 6.0), max(low, top), 13), high - 0.5)
                found.append(_Parameter("frequency", starts, low, high))
                found.append(_Parameter("damping", tuple(map(math.log, (0.03, 0.3, 1.0))), math.log(1e-3), 3.4))
            elif element == "delay":
                most = min(0.25 * self.span / self.step, 200.0)
                found.append(_Parameter("delay", (0.3, 1.5, min(6.0, most)), 0.0, most))
            elif element == "creep":
                found.append(_Parameter("creep", (0.02,), 0.0, 3.0))
            elif element == "kelvin-voigt":
                found += [_Parameter(f"creep {k}", (0.02,), 0.0, 3.0) for k in range(decades)]
            elif element == "fading-drift":
                found.append(_Parameter("drift", (longest - 1.0,), longest - 4.6, longest + 2.3))
            elif element == "friction":
                top = math.log(max(float(np.abs(self.speeds).max()), 1e-300))
                found.append(_Parameter("friction", (top - 3.0, top - 1.5), top - 7.0, top + 1.0))
        return found

    def named(self, found: Found) -> dict[str, float]:
        """Return the nonlinear parameters that were found, by name."""
        names = [parameter.name for parameter in self.parameters(found.elements)]
        return dict(zip(names, found.values.tolist(), strict=True))

    def linear(self, parameters: Sequence[_Parameter], values: Floats) -> Following:
        """Return what follows the operator and stands beside it for given parameters."""
        x = {parameter.name: float(value) for parameter, value in zip(parameters, values, strict=True)}
        lag = (math.exp(x["lag"]), 0.0) if "lag" in x else (0.0, 0.0)
        if "frequency" in x:
            lag = (2.0 * math.exp(x["damping"] - x["frequency"]), math.exp(-2.0 * x["frequency"]))
        times, strengths = np.empty(0), np.empty(0)
        if "creep" in x:
            times, strengths = logarithmic_creep(x["creep"], *self.creep_span)
        elif elements := [x[name] for name in x if name.startswith("creep ")]:
            strengths = np.array(elements)
            shortest, longest = self.creep_span
            times = shortest * (longest / shortest) ** ((np.arange(strengths.size) + 0.5) / strengths.size)
        part = LinearPart(self.step * x.get("delay", 0.0), lag, times, strengths)
        return Following(part, *(math.exp(x[name]) if name in x else 0.0 for name in ("drift", "friction")))

    def beside(self, elements: Sequence[str], follows: Following) -> Floats:
        """Return the columns of drift, viscosity and friction, those that are among the elements, shape (N, q)."""
        columns = []
        for element in beside(elements):
            if element == "viscous":
                columns.append(self.speeds)
            elif element == "friction":
                columns.append(np.tanh(self.speeds / follows.friction_speed))
            else:
                time = follows.drift_time
                columns.append(self.elapsed if time == 0.0 else -np.expm1(-self.elapsed / time))
        return np.column_stack(columns) if columns else np.empty((self.times.size, 0))

    def behind(self, follows: Following, columns: Floats, elements: Sequence[str]) -> Responses:
        """Return columns of the operator behind what follows it, shape (N, K), and those beside it."""
        cells = self.static.regressor.base.size
        return Responses(follows.respond(self.times, columns), self.beside(elements, follows), cells)

    def responses(self, elements: Sequence[str], values: Floats) -> Responses:
        """Return the columns of elements for given parameters."""
        follows = self.linear(self.parameters(elements), values)
        return self.behind(follows, self.columns, elements)

    def fitted(
        self, elements: tuple[str, ...], values: Floats, deviations: Floats, start: Fit | None = None
    ) -> Found:
        """Return parameters with the coefficients that belong to them, of the sign that fits better, and the cost."""
        responses, found = self.responses(elements, values), []
        for sign in self.signs:
            fitted, rest = self.fit_and_rest(responses, sign, start)
            found.append(Found(elements, values, fitted, float(rest @ rest), deviations))
        return min(found, key=lambda each: each.cost)

    def fit_and_rest(
        self, responses: Responses, sign: Literal[1, -1], start: Fit | None = None
    ) -> tuple[Fit, Floats]:
        """Return the coefficients of responses, and the weighted residuals, shape (N,)."""
        fitted = self.fit(responses, sign, start=start)
        return fitted, self.roots * (self.static.outputs - responses.predict(fitted))

    def fit(
        self,
        responses: Responses,
        sign: Literal[1, -1],
        weights: Floats | None = None,
        smoothing: float | None = None,
        start: Fit | None = None,
    ) -> Fit:
        """Return the coefficients of responses, those of the operator of one sign.

        Weights and smoothing are those of the search unless others are given.
        """
        counted = self.static.weights if weights is None else weights
        regressor = responses.without_still(counted, self.static.skip)
        problem = replace(self.static, regressor=regressor, orientation=sign, known=None)
        return problem.fit(self.smoothing if smoothing is None else smoothing, counted, self.ridge, start)

    def sign(self, found: Fit) -> Literal[1, -1]:
        """Return the sign of the operator's coefficients that are constrained."""
        signed = found.coefficients[: self.columns.shape[1]][self.static.template.nonnegative()]
        return -1 if (signed < 0.0).any() else 1

    def basis(self, found: Fit) -> Floats:
        """Return the operator's columns over which the search projects, shape (N, r)."""
        if self.smoothing:
            # All cells are free then, and together they would take what follows the operator for hysteresis.
            signal = self.columns @ found.coefficients[: self.columns.shape[1]]
            return np.column_stack([signal, self.principal[:, :_FREE]])
        if self.static.spec.constrained:
            used = found.coefficients[: self.columns.shape[1]] != 0.0
            return self.columns[:, used]
        return self.principal[:, :100]


@dataclass(frozen=True, eq=False)
class Found:
    """Elements with their parameters and the fit."""

    elements: tuple[str, ...]
    values: Floats
    fit: Fit
    cost: float
    deviations: Floats


class _Projected:
    """The problem of a search: what follows a basis of the operator's columns, and what stands beside it."""

    def __init__(self, search: Search, elements: Sequence[str], basis: Floats) -> None:
        self._search, self._elements, self._basis = search, elements, basis
        self._parameters = search.parameters(elements)
        self._creep: dict[float, list[Floats]] = {}

    def problem(self) -> Separable:
        """Return the residuals by the parameters of the elements."""
        return Separable(self._search.static.outputs, self._search.roots, self._columns, self._combine)

    def _columns(self, values: Floats) -> Floats:
        follows = self._search.linear(self._parameters, values)
        return np.column_stack([self._respond(follows), self._search.beside(self._elements, follows)])

    def _combine(self, values: Floats, coefficients: Floats) -> Floats:
        follows, count = self._search.linear(self._parameters, values), self._basis.shape[1]
        signal = (self._basis @ coefficients[:count])[:, None]
        others = self._search.beside(self._elements, follows) @ coefficients[count:]
        return np.asarray(follows.respond(self._search.times, signal)[:, 0] + others)

    def _respond(self, follows: Following) -> Floats:
        """Return the filtered basis; responses of the creep, whose times stay, are kept for the last delay."""
        times, basis, part = self._search.times, self._basis, follows.part
        strengths = part.creep_strengths
        if not strengths.size:
            return follows.respond(times, basis)
        if part.delay not in self._creep:
            # Logarithmic creep has one strength for all.
            shared = [name for name in (p.name for p in self._parameters) if name == "creep"]
            banks = [np.full(strengths.size, 1.0)] if shared else list(np.eye(strengths.size))
            fast = replace(part, creep_strengths=np.zeros(strengths.size)).respond(times, basis)[0]
            self._creep = {
                part.delay: [replace(part, creep_strengths=bank).respond(times, basis)[0] - fast for bank in banks]
            }
        result = replace(part, creep_times=np.empty(0), creep_strengths=np.empty(0)).respond(times, basis)[0]
        for strength, bank in zip(strengths, self._creep[part.delay], strict=False):
            result += strength * bank
        return result


def find_best(
    search: Search,
    elements: tuple[str, ...],
    known: Mapping[str, float],
    rounds: int = _ROUNDS,
    stage: Stage = _STAGE,
) -> Found:
    """Return the parameters of elements that fit best.

    They are searched from the values that are known by name, and from several starts of each other parameter.
    """
    parameters, alone = search.parameters(elements), search.alone.fit
    if any(each.name not in known for each in parameters):
        ends = search_ends(search, elements, known, stage)
        trials = [search.fitted(elements, end.values, end.deviations, end.fit) for end in ends]
        best = min(trials, key=lambda trial: trial.cost)
    else:
        values = np.array([known[each.name] for each in parameters])
        best = search.fitted(elements, values, np.full(values.size, np.inf), alone)
    if not parameters:
        return best
    for _ in range(rounds):
        end = _ends(search, elements, best.fit, search.basis(best.fit), [best.values], stage)[0]
        moved = search.fitted(elements, end.values, end.deviations, best.fit)
        gained = best.cost - moved.cost
        best = moved if gained > 0.0 else replace(best, deviations=moved.deviations)
        if not gained > _GAIN * best.cost:
            break
    return best


def search_ends(
    search: Search, elements: tuple[str, ...], known: Mapping[str, float], stage: Stage = _STAGE
) -> list[Found]:
    """Return the ends of searches over principal columns, with their costs and the fit of the operator alone.

    They start from the best few of a grid, judged with that fit and the principal columns.
    """
    grids = [(known[p.name],) if p.name in known else p.starts for p in search.parameters(elements)]
    before = search.alone.fit
    signal = search.columns @ before.coefficients[: search.columns.shape[1]]
    screen = _Projected(search, elements, np.column_stack([signal, search.principal[:, :_COARSE]])).problem()
    grid = [np.array(point) for point in product(*grids)]
    return _ends(search, elements, before, search.principal[:, :_FREE], grid, stage, screen)


def _ends(
    search: Search,
    elements: tuple[str, ...],
    before: Fit,
    basis: Floats,
    starts: Sequence[Floats],
    stage: Stage,
    screen: Separable | None = None,
) -> list[Found]:
    """Return the ends of searches over the coefficients of a basis, with their costs and the fit before."""
    parameters = search.parameters(elements)
    bounds = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
    ends = variable_projection(
        _Projected(search, elements, basis).problem(),
        starts,
        bounds,
        stages=[stage],
        screen=None if screen is None else screen.residuals,
        # Neighbours end in the same minimum.
        apart=1.0,
    )
    freedom = search.times.size - basis.shape[1] - len(parameters) - 1
    return [
        Found(elements, end.values, before, end.cost, Evidence.of(end.jacobian, end.residuals, freedom).deviations)
        for end in ends
    ]
