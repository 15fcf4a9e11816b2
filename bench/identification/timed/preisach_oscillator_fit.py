"""Fit of a Preisach oscillator by output error, in steps that are constrained least-squares problems.

Along a known displacement x the equation of motion m x'' + c x' + F[x] = u is linear in m, c and the coefficients of
F. Behind the response G(s) of the linear oscillator to a force its residual is, to first order, the error of the
simulated output (likewise filtered by Steiglitz and McBride, IEEE Trans. Automatic Control 10(4), 461-464, 1965). The
first displacement is the measured one; then it is that of the simulation, free of noise, and the least-squares
problem is a Gauss-Newton step for the output error, with the signs of the density as constraints and the tangent
stiffness of F in G replaced by the linear one. After each step a search with exact slopes moves m, c, the spring and
one factor for the density.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats
from bench.identification.advice import Advice
from bench.identification.by_name import Identification
from bench.identification.fit.least_squares import Fit, fit
from bench.identification.fit.orientation import NAMES, Orientation
from bench.identification.fit.variable_projection import Stage, variable_projection
from bench.identification.measures import measure_errors
from bench.identification.timed.oscillator_fit import check_record, linear_start
from bench.models import (
    Interpolation,
    LinearPart,
    Preisach,
    PreisachOscillator,
    QuadraticTerm,
    Regressor,
    Start,
    demagnetised,
    uniform_levels,
)

Sign = Literal[1, -1]

# Plane beyond the greatest displacement, and its most cells. Source: a choice; the offset is not yet known; 40 levels
# make 820 cells, each with a simulated response.
_MARGIN, _MOST_LEVELS = 1.05, 40
# A search over a few parameters. Source: a choice; a few steps, as the next round searches again.
_POLISH = Stage(1, 1e-8, 5)
# Steps, halvings of one, and the relative gain of the cost at which they end. Source: a choice; a sixteenth of a step
# that does not help is given up; 1 % of the cost is 0.5 % of the RMS error.
_STEPS, _HALVINGS, _GAIN = 8, 4, 1e-2


class _Path(NamedTuple):
    """A displacement along which the equation of motion is set up, shape (N,) each; `acceleration` if it is known."""

    position: Floats
    velocity: Floats
    acceleration: Floats | None


@dataclass(frozen=True, eq=False)
class _Trial:
    """A model, the path of its simulation, the rest of the output without offset, and the weighted cost."""

    model: PreisachOscillator
    path: _Path
    rest: Floats
    cost: float
    fit: Fit | None = None


@dataclass(frozen=True, eq=False)
class _Search:
    """The measured sequence, and the linear oscillator that stands for the response."""

    times: Floats
    inputs: Floats
    outputs: Floats
    weights: Floats
    skip: int
    start: Start
    linear: Floats

    def simulate(self, model: PreisachOscillator, found: Fit | None = None) -> _Trial:
        """Return the trial of a model, with the offset that fits best."""
        motion, after = model.motion(self.times, self.inputs, self.start)
        position, velocity, force = motion.T
        rest = self.outputs - position
        offset = float(self.weights @ rest / self.weights.sum())
        rest = rest - offset
        bounded = after is not None and np.abs(position).max() < 1e3 * np.ptp(self.outputs)
        cost = float(self.weights @ rest**2) if bounded else np.inf
        acceleration = (self.inputs - model.damping * velocity - force) / model.mass
        path = _Path(position, velocity, acceleration)
        return _Trial(replace(model, offset=offset), path, rest, cost, found)

    def measured(self, offset: float) -> _Path:
        """Return the measured displacement, with the velocity of a spline through it."""
        from scipy.interpolate import CubicSpline

        position = self.outputs - offset
        return _Path(position, np.asarray(CubicSpline(self.times, position)(self.times, 1)), None)

    def respond(self, columns: Floats) -> Floats:
        """Return the response of the linear oscillator to forces, shape (N, K), in output units."""
        mass, damping, stiffness = self.linear.tolist()
        part = LinearPart(lag=(damping / stiffness, mass / stiffness))
        if self.start == "rest":
            return np.asarray(part.respond(self.times, columns)[0] / stiffness)
        count, step = self.times.size, self.times[1] - self.times[0]
        twice = self.times[0] + step * np.arange(2 * count)
        return np.asarray(part.respond(twice, np.concatenate([columns, columns]))[0][count:] / stiffness)

    def step(self, template: PreisachOscillator, path: _Path, rest: Floats, sign: Sign) -> tuple[Fit, Floats]:
        """Return the least-squares problem's solution along a path, and density, spring, c and m."""
        force, still = template.force, demagnetised(template.force.levels)
        memory = still if self.start == "rest" else still.advance(path.position)
        columns = force.regressor(path.position, memory).dense() - force.regressor([0.0], still).dense()
        cells = force.density.size
        filtered = self.respond(np.column_stack([columns, path.velocity, self.inputs]))
        mass, damping, stiffness = self.linear.tolist()
        if path.acceleration is None:
            # The differential equation of the filter itself gives its response to the second derivative.
            inertial = (path.position - stiffness * filtered[:, cells] - damping * filtered[:, cells + 1]) / mass
        else:
            inertial = self.respond(path.acceleration[:, None])[:, 0]
        filtered[:, :cells] *= sign
        nonnegative = np.arange(cells + 3) < cells
        target = filtered[:, -1] - rest
        regressor = Regressor.of_columns(np.column_stack([filtered[:, :-1], inertial]))
        found = fit(regressor, target, nonnegative=nonnegative, weights=self.weights, skip=self.skip)
        turned = found.coefficients.copy()
        turned[:cells] *= sign
        return found, turned


def identify_preisach_oscillator(
    times: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    initial: str | None = None,
    orientation: Orientation = "auto",
    levels: int = 10,
    interpolation: Interpolation = "smooth",
    input_unit: str = "",
    output_unit: str = "",
) -> Identification[PreisachOscillator]:
    """Return the Preisach oscillator whose simulated output fits a measured sequence best.

    Parameters
    ----------
    times, inputs, outputs, weights, skip, initial, interpolation, input_unit, output_unit
        As `identify_bouc_wen_oscillator`.
    orientation : {"auto", "rising", "falling"}
        Sign of the density beside the spring: falling if the force is stiffer after a reversal.
    levels : int
        Number of intervals of the plane, 2 to 40.

    Raises
    ------
    ValueError
        If an option is wrong or the data are unfit.
    """
    clock, u, y, w, starts = check_record(times, inputs, outputs, weights, skip, initial)
    if orientation not in ("auto", "rising", "falling"):
        raise ValueError(f"orientation: expected 'auto', 'rising' or 'falling', got {orientation!r}")
    if not 2 <= levels <= _MOST_LEVELS:
        raise ValueError(f"levels: expected 2 to {_MOST_LEVELS}, got {levels}")
    linear = linear_start(clock, u, y)
    signs: tuple[Sign, ...] = {"auto": (1, -1), "rising": (1,), "falling": (-1,)}[orientation]  # type: ignore[assignment]
    begun: list[tuple[_Search, _Trial, Sign]] = []
    for start in starts:
        search = _Search(clock, u, y, w, skip, start, linear)
        offset = float(y[0]) if start == "rest" else float(np.average(y, weights=w))
        reach = _MARGIN * float(np.abs(y - offset).max())
        force = Preisach(
            uniform_levels(-reach, reach, levels),
            np.zeros(levels * (levels + 1) // 2),
            reversible=QuadraticTerm(linear[2]),
            input_unit=output_unit,
            output_unit=input_unit,
        )
        template = PreisachOscillator(
            linear[0], linear[1], force, offset, (float(u.min()), float(u.max())), interpolation, input_unit,
            output_unit,
        )  # fmt: skip
        try:
            begun.append(_begin(search, template, signs))
        except ValueError:
            # A sequence on uneven times is not known to repeat itself.
            if initial is not None:
                raise
    search, trial, sign = min(begun, key=lambda each: each[1].cost)
    trial = _descend(search, trial, sign)
    if trial.fit is None:
        raise ValueError(
            "inputs and outputs: no restoring force fits better than a linear spring; sample faster, or take "
            "bouc-wen-oscillator"
        )
    predicted = trial.model.evaluate(clock, u, search.start)
    advice = []
    if trial.model.least_slope < 0.0:
        text = "the restoring force falls on a part of its loop, where the response to another input may jump"
        advice.append(Advice("falling-force", text, "give fewer --levels, or take bouc-wen-oscillator"))
    if 3 * trial.fit.certificate.passive > np.count_nonzero(w):
        text = f"{np.count_nonzero(w)} samples are few for {trial.fit.certificate.passive} free coefficients"
        advice.append(Advice("few-samples", text, "give fewer --levels or a longer record"))
    return Identification(
        model_name="preisach-oscillator",
        model=trial.model,
        residuals=y - predicted,
        errors=measure_errors(y[skip:], predicted[skip:]),
        uncertainties=trial.fit.uncertainties,
        certificate=trial.fit.certificate,
        skip=skip,
        initial_state=search.start,
        advice=tuple(advice),
        orientation=NAMES[sign],
    )


def _begin(search: _Search, template: PreisachOscillator, signs: tuple[Sign, ...]) -> tuple[_Search, _Trial, Sign]:
    """Return the search, the trial after the step along the measured displacement, and the sign of its density."""
    linear, path = search.simulate(template), search.measured(template.offset)
    still = np.zeros(path.position.size)
    ends = [(_polish(search, _advance(search, linear, path, still, sign)), sign) for sign in signs]
    best, sign = min(ends, key=lambda each: each[0].cost)
    return search, best, sign


def _descend(search: _Search, best: _Trial, sign: Sign) -> _Trial:
    """Return the trial after steps along simulated displacements."""
    for _ in range(_STEPS):
        cost = best.cost
        best = _polish(search, _advance(search, best, best.path, best.rest, sign))
        if not cost - best.cost > _GAIN * cost:
            break
    return best


def _polish(search: _Search, before: _Trial) -> _Trial:
    """Return the end of a search over m, c, the spring and one factor for the density."""
    model, found = before.model, before.fit
    whole = np.concatenate([model.force.coefficients, [model.damping, model.mass]])
    cells = model.force.density.size
    mass, damping, stiffness = np.abs(search.linear).tolist()
    scales = np.array([stiffness, damping, mass])
    roots = np.sqrt(search.weights)

    def trial(values: Floats) -> _Trial:
        vector = np.concatenate([values[0] * whole[:cells], values[1:] * scales])
        return search.simulate(_with(model, vector), found)

    def residuals(values: Floats) -> Floats:
        at = trial(values)
        return np.asarray(roots * (at.rest if np.isfinite(at.cost) else 1e3 * np.ptp(search.outputs)))

    start = np.concatenate([[1.0], whole[cells:] / scales])
    end = variable_projection(residuals, [start], stages=[_POLISH], central=True)[0].values
    after = trial(end)
    return after if after.cost < before.cost and end[0] > 0.0 else before


def _advance(search: _Search, before: _Trial, path: _Path, rest: Floats, sign: Sign) -> _Trial:
    """Return the trial after a step, shortened until it is better; the one before if none is."""
    model = before.model
    found, aim = search.step(model, path, rest, sign)
    origin = np.concatenate([model.force.coefficients, [model.damping, model.mass]])
    share = 1.0
    for _ in range(_HALVINGS + 1):
        values = origin + share * (aim - origin)
        if values[-1] != 0.0:
            trial = search.simulate(_with(model, values), found)
            if trial.cost < before.cost:
                return trial
        share *= 0.5
    return before


def _with(model: PreisachOscillator, values: Floats) -> PreisachOscillator:
    """Return the model with other coefficients of the force, c and m; the force at rest is 0."""
    force = model.force.with_coefficients(values[:-2], 0.0)
    still = force.value(demagnetised(force.levels))
    return replace(model, force=replace(force, bias=-still), damping=float(values[-2]), mass=float(values[-1]))
