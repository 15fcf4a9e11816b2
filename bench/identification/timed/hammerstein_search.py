"""The search for the parameters of what follows an operator: variable projection from several starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from bench.base import Floats
from bench.identification.by_name import FitProblem
from bench.identification.fit.least_squares import Fit
from bench.identification.fit.shape import fit_operator
from bench.identification.fit.variable_projection import Evidence, Separable, Stage, variable_projection
from bench.identification.timed.parsimony import moving
from bench.models import LinearPart, Regressor, logarithmic_creep, velocities

EVALUATIONS = 40
"""Evaluations of a search. Source: a choice; each element has one or two parameters, and a search that is cut off
goes on in the next round."""

FREE = 30
"""Principal columns of the operator in a first search. Source: a choice; the fit of all columns follows."""

# Rounds of search and constrained fit, and the relative gain of the cost at which they end. Derivation: a parameter
# that means nothing gains more by chance, 2 log(N) / N, on records of fewer than a million rows.
_ROUNDS, _GAIN = 4, 1e-5
# Source: a choice; the deepest valley of the grid, and another.
_STARTS = 2
# Principal columns in the grid that a search starts from. Source: a choice; with the signal of the smaller model they
# stand for the operator; the search then has more.
_COARSE = 6
# Relative change at which a search ends. Derivation: a ten-thousandth of the gain at which rounds end.
_TOLERANCE = 1e-9


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


def beside(elements: Sequence[str]) -> list[str]:
    """Return the elements that stand beside the operator, in the order of their columns."""
    return [name for name in ("drift", "fading-drift", "viscous", "friction") if name in elements]


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
    elapsed: Floats = field(init=False)  # shape (N,); since the first row, s
    speeds: Floats = field(init=False)  # shape (N,); velocity of the input, input units/s
    principal: Floats = field(init=False)  # shape (N, r); principal columns of the regressor
    step: float = field(init=False)  # median step of time, s

    def __post_init__(self) -> None:
        object.__setattr__(self, "elapsed", self.times - self.times[0])
        object.__setattr__(self, "speeds", velocities(self.times, self.static.inputs))
        object.__setattr__(self, "step", float(np.median(np.diff(self.times))))
        centred = self.columns - self.columns.mean(axis=0)
        strengths, directions = np.linalg.eigh(centred.T @ centred)
        kept = strengths > 1e-10 * strengths[-1]
        object.__setattr__(self, "principal", np.ascontiguousarray(self.columns @ directions[:, kept][:, ::-1]))

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

    def responses(self, elements: Sequence[str], values: Floats) -> tuple[Floats, Floats]:
        """Return the filtered columns of the operator, shape (N, K), and those beside it for given parameters."""
        follows = self.linear(self.parameters(elements), values)
        return follows.part.respond(self.times, self.columns)[0], self.beside(elements, follows)

    def fitted(self, elements: tuple[str, ...], values: Floats, deviations: Floats) -> Found:
        """Return parameters with the coefficients that belong to them, of the sign that fits better, and the cost."""
        columns, others = self.responses(elements, values)
        together, found = np.column_stack([columns, others]), []
        for sign in self.signs:
            fitted = self.fit_columns(columns, others, self.static.weights, sign)
            rest = self.roots * (self.static.outputs - fitted.bias - together @ fitted.coefficients)
            found.append(Found(elements, values, fitted, float(rest @ rest), deviations))
        return min(found, key=lambda each: each.cost)

    def fit_columns(
        self,
        columns: Floats,
        others: Floats,
        weights: Floats,
        sign: Literal[1, -1],
        smoothing: float | None = None,
    ) -> Fit:
        """Return the coefficients of filtered columns, those of the operator of one sign, and those beside them."""
        problem, count = self.static, columns.shape[1]
        cells, constrained = problem.regressor.base.size, problem.spec.constrained
        columns = (sign if constrained else 1) * moving(columns, weights, problem.skip)
        regressor = Regressor.of_cells(columns[:, :cells], np.column_stack([columns[:, cells:], others]))
        smoothing = self.smoothing if smoothing is None else smoothing
        found = fit_operator(
            constrained, problem.template, regressor, problem.outputs, weights, problem.skip, smoothing, self.ridge
        )
        turned = found.coefficients.copy()
        turned[:count] *= sign if constrained else 1
        return replace(found, coefficients=turned)

    def sign(self, found: Fit) -> Literal[1, -1]:
        """Return the sign of the operator's coefficients that are constrained."""
        signed = found.coefficients[: self.columns.shape[1]][self.static.template.nonnegative()]
        return -1 if (signed < 0.0).any() else 1

    def basis(self, found: Fit) -> Floats:
        """Return the operator's columns over which the search projects, shape (N, r)."""
        if self.smoothing:
            # All cells are free then, and together they would take what follows the operator for hysteresis.
            signal = self.columns @ found.coefficients[: self.columns.shape[1]]
            return np.column_stack([signal, self.principal[:, :FREE]])
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


class _Responses:
    """The columns of a search: what follows a basis, and what stands beside it."""

    def __init__(self, search: Search, elements: Sequence[str], basis: Floats) -> None:
        self._search, self._elements, self._basis = search, elements, basis
        self._parameters = search.parameters(elements)
        self._creep: dict[float, list[Floats]] = {}

    def problem(self) -> Separable:
        """Return the residuals by the parameters of the elements."""
        return Separable(self._search.static.outputs, self._search.roots, self._columns, self._combine)

    def _columns(self, values: Floats) -> Floats:
        follows = self._search.linear(self._parameters, values)
        return np.column_stack([self._respond(follows.part), self._search.beside(self._elements, follows)])

    def _combine(self, values: Floats, coefficients: Floats) -> Floats:
        follows, count = self._search.linear(self._parameters, values), self._basis.shape[1]
        signal = (self._basis @ coefficients[:count])[:, None]
        others = self._search.beside(self._elements, follows) @ coefficients[count:]
        return np.asarray(follows.part.respond(self._search.times, signal)[0][:, 0] + others)

    def _respond(self, part: LinearPart) -> Floats:
        """Return the filtered basis; responses of the creep, whose times stay, are kept for the last delay."""
        times, basis = self._search.times, self._basis
        strengths = part.creep_strengths
        if not strengths.size:
            return part.respond(times, basis)[0]
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


def find_best(search: Search, elements: tuple[str, ...], before: Found | None = None, rounds: int = _ROUNDS) -> Found:
    """Return the parameters of elements that fit best, found from several starts; `before` is a smaller model."""
    if not search.parameters(elements):
        return search.fitted(elements, np.empty(0), np.empty(0))
    first = find_best(search, ()) if before is None else before
    trials = search_ends(search, elements, first, search.principal[:, :FREE])
    best = min(
        (search.fitted(elements, trial.values, trial.deviations) for trial in trials), key=lambda trial: trial.cost
    )
    for _ in range(rounds):
        basis, stage = search.basis(best.fit), Stage(1, _TOLERANCE, EVALUATIONS)
        end = _ends(search, elements, best.fit, basis, [best.values], stage)[0]
        moved = search.fitted(elements, end.values, end.deviations)
        gained = best.cost - moved.cost
        if gained > 0.0:
            best = moved
        if not gained > _GAIN * best.cost:
            break
    return best


def search_ends(
    search: Search,
    elements: tuple[str, ...],
    before: Found,
    basis: Floats,
    starts: int = _STARTS,
    evaluations: int = EVALUATIONS,
) -> list[Found]:
    """Return the ends of searches over the coefficients of a basis, with their costs and the smaller model's fit.

    They start from the best few of a grid, judged with the fit of the smaller model and the principal columns.
    """
    names = [parameter.name for parameter in search.parameters(before.elements)]
    known = dict(zip(names, before.values.tolist(), strict=True))
    grids = [(known[p.name],) if p.name in known else p.starts for p in search.parameters(elements)]
    signal = search.columns @ before.fit.coefficients[: search.columns.shape[1]]
    screen = _Responses(search, elements, np.column_stack([signal, search.principal[:, :_COARSE]])).problem()
    grid, stage = [np.array(values) for values in product(*grids)], Stage(starts, _TOLERANCE, evaluations)
    return _ends(search, elements, before.fit, basis, grid, stage, screen)


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
        _Responses(search, elements, basis).problem(),
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
