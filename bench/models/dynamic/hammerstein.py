"""The Hammerstein model: a hysteresis operator, then delay, lag or resonance, creep; beside it viscosity and drift.

y(t) = bias + T(s) [operator(u) - its bias] + viscous u' + friction tanh(u' / friction speed) + drift(t), with T as in
`linear_parts`. The operator acts at the samples, and its output is a straight line between them. The velocity u' is
the slope of the parabola through a sample and its neighbours; at the last sample, of the line from the one before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.density import Density
from bench.models.documents import Parts
from bench.models.dynamic.linear_inverse import bring_responses
from bench.models.dynamic.linear_parts import FilterState, LinearPart
from bench.models.dynamic.model_with_time import TimedModel, check_sequence
from bench.models.inverses.inverse import Policy
from bench.models.operator import Operator, operator_from_json


class Knots(NamedTuple):
    """What the delay has not yet let through."""

    times: tuple[float, ...]  # since the start of the record, s
    values: tuple[float, ...]  # output of the operator less its bias, output units
    filters: FilterState  # state at the first of these times


class HammersteinState(NamedTuple):
    """Memory of a Hammerstein model.

    Attributes
    ----------
    memory : object
        State of the operator.
    clock : float
        Time of the last sample, s; 0 before the first.
    knots : Knots or None
        What the linear part knows; None before the first sample, at which it then is settled.
    last : float or None
        Input of the last sample; None before the first, or if the model has no viscous part.
    """

    memory: Any
    clock: float = 0.0
    knots: Knots | None = None
    last: float | None = None


@dataclass(frozen=True, eq=False)
class Hammerstein(TimedModel[HammersteinState]):
    """A hysteresis operator followed by a linear part, with viscous terms and a drift beside it.

    Parameters
    ----------
    static : Operator
        The operator; its bias is that of the output.
    linear : LinearPart
        Delay, lag or resonance, and creep.
    drift : float
        Output units / s, counted from the first sample of a record; with `drift_time` the final value, output units.
    drift_time : float
        Time constant of a drift that fades, s; 0 for one that does not.
    viscous : float
        Output units per input unit/s.
    friction : float
        Output units: what a term that saturates with the velocity goes to.
    friction_speed : float
        Velocity by which it is at 76 % (tanh 1), input units/s; > 0 if there is friction.

    Raises
    ------
    ValueError
        If a number is not finite, or `drift_time` or `friction_speed` negative.

    Notes
    -----
    Viscous terms: a Coulomb friction smoothed by tanh, and viscosity, as in models of dampers; Pan et al., A modified
    hyperbolic tangent model of magneto-rheological dampers, and Kwok et al., Smart Mater. Struct. 15, 1112, 2006.
    """

    kind: ClassVar[str] = "hammerstein"
    starts: ClassVar[tuple[str, ...]] = ("negative", "positive", "skip")
    inverse_method: ClassVar[str] = "exact"
    added: ClassVar[tuple[str, ...]] = ("viscous", "friction", "friction_speed")
    parts: ClassVar[Parts] = {"static": operator_from_json, "linear": LinearPart.from_json}

    static: Operator[Any]
    linear: LinearPart
    drift: float = 0.0
    drift_time: float = 0.0
    viscous: float = 0.0
    friction: float = 0.0
    friction_speed: float = 0.0

    def __post_init__(self) -> None:
        for name in ("drift", "drift_time", "viscous", "friction", "friction_speed"):
            object.__setattr__(self, name, _checks.number(name, getattr(self, name)))
        for name in ("drift_time", "friction_speed"):
            if getattr(self, name) < 0.0:
                raise ValueError(f"{name}: expected a number >= 0, got {getattr(self, name)}")
        if self.friction and not self.friction_speed:
            raise ValueError("friction_speed: expected a number > 0, as there is friction; got 0")

    @property
    def is_viscous(self) -> bool:
        """Whether the output depends on the velocity of the input."""
        return bool(self.viscous or self.friction)

    @property
    def input_range(self) -> tuple[float, float]:  # type: ignore[override]
        """Operating range of the operator, input units."""
        return self.static.input_range

    @property
    def input_unit(self) -> str:  # type: ignore[override]
        """Unit of the input."""
        return self.static.input_unit

    @property
    def output_unit(self) -> str:  # type: ignore[override]
        """Unit of the output."""
        return self.static.output_unit

    def densities(self) -> tuple[Density, ...]:
        """Return those of the operator."""
        return self.static.densities()

    def run(
        self, times: ArrayLike, inputs: ArrayLike, state: HammersteinState | None = None
    ) -> tuple[Floats, HammersteinState]:
        """Return the outputs of a sequence, shape (N,), and the state after it; see `TimedModel.run`."""
        clock, sequence = check_sequence(times, inputs=inputs)
        state = self.initial_state() if state is None else state
        values = self.static.evaluate(sequence, state.memory) - self.static.bias
        knots, elapsed = state.knots, _elapsed(clock, state)
        filters, known = None, 0
        if knots is not None:
            values = np.concatenate([knots.values, values])
            filters, known = knots.filters, len(knots.times)
        response = self.linear.respond(elapsed, values[:, None], filters)[0][known:, 0]
        outputs = self.static.bias + response + self.drift_after(elapsed[known:])
        last = None
        if self.is_viscous:
            last = float(sequence[-1])
            before = () if state.last is None else (state.last,)
            moments = elapsed[known - len(before) :] if before else elapsed[known:]
            speeds = velocities(moments, np.concatenate([before, sequence]))[len(before) :]
            outputs = outputs + self.viscous * speeds
            if self.friction:
                outputs = outputs + self.friction * np.tanh(speeds / self.friction_speed)
        memory = self.static.advance(state.memory, sequence)
        return outputs, HammersteinState(memory, float(clock[-1]), self._knots(elapsed, values, filters), last)

    def _knots(self, times: Floats, values: Floats, filters: FilterState | None) -> Knots:
        first = max(int(np.searchsorted(times, times[-1] - self.linear.delay, side="right")) - 1, 0)
        _, (value, rate, crept) = self.linear.respond(times[: first + 1], values[: first + 1, None], filters)
        at_first = FilterState(float(value[0]), float(rate[0]), tuple(crept[:, 0].tolist()))
        return Knots(tuple(times[first:].tolist()), tuple(values[first:].tolist()), at_first)

    def follow(
        self,
        times: ArrayLike,
        targets: ArrayLike,
        state: HammersteinState | None = None,
        policy: Policy = "nearest",
    ) -> Floats:
        """Return the inputs that bring the output to targets, shape (N,); see `TimedModel.follow`.

        A target that needs two inputs at a time, the first at saturation, is given the last of them alone. Behind a
        delay there is no inverse from sample to sample: that of the model `ahead` is for the targets a delay later.

        Raises
        ------
        ValueError
            If the model has viscous terms: what the input does next decides them.
        """
        if self.is_viscous:
            raise ValueError(
                "a model with viscous terms has no inverse: identify one without them, such as with -o dynamics=lag"
            )
        clock, wanted = check_sequence(times, targets=targets)
        state = self.initial_state() if state is None else state
        knots, elapsed = state.knots, _elapsed(clock, state)
        stream, bias = self.static.inverse(policy).stream(state.memory), self.static.bias
        found: list[float] = []

        def bring(value: float) -> float:
            found.append(stream.find(value + bias))
            return stream.move(found[-1]) - bias

        before = None if knots is None else (knots.values[-1], knots.filters)
        responses = wanted - bias - self.drift_after(elapsed[-wanted.size :])
        bring_responses(self.linear, elapsed, responses, before, bring)
        return np.array(found)

    @property
    def delay(self) -> float:
        """Delay of the linear part, s."""
        return self.linear.delay

    def ahead(self, state: HammersteinState) -> tuple[Hammerstein, HammersteinState]:
        """Return the model without the delay and a state of it, the drift advanced; see `TimedModel.ahead`."""
        prompt = replace(self.linear, delay=0.0)
        drift = self.drift * math.exp(-self.delay / self.drift_time) if self.drift_time > 0.0 else self.drift
        later = self.static.bias + float(self.drift_after(np.array([self.delay]))[0])
        static = self.static.with_coefficients(self.static.coefficients, later)
        model = replace(self, static=static, linear=prompt, drift=drift)
        if state.knots is None:
            return model, state
        knots = state.knots
        passed = model._knots(np.array(knots.times), np.array(knots.values), knots.filters)
        return model, state._replace(knots=passed)

    def initial_state(self) -> HammersteinState:
        """Return the initial state of the operator."""
        return HammersteinState(self.static.initial_state())

    def start(self, word: str) -> HammersteinState:
        """Return a saturated state of the operator: "negative" or "positive"."""
        return HammersteinState(self.static.saturated_state({"negative": -1, "positive": 1}[word]))

    def unknown_until(self, inputs: ArrayLike) -> int:
        """Return what the operator does."""
        return self.static.unknown_until(inputs)

    def drift_after(self, elapsed: Floats) -> Floats:
        """Return the drift at times since the start of the record, s; output units, same shape."""
        if self.drift_time > 0.0:
            return np.asarray(-self.drift * np.expm1(-elapsed / self.drift_time))
        return self.drift * elapsed

    def parameters(self) -> Mapping[str, tuple[float, str]]:
        """Return the numbers of the linear part and the drift."""
        found: dict[str, tuple[float, str]] = {}
        first, second = self.linear.lag
        if second > 0.0:
            found["frequency"] = 1.0 / (2.0 * math.pi * math.sqrt(second)), "Hz"
            found["damping ratio"] = 0.5 * first / math.sqrt(second), ""
        elif first > 0.0:
            found["time constant"] = first, "s"
        if self.linear.delay > 0.0:
            found["delay"] = self.linear.delay, "s"
        creep_times, strengths = self.linear.creep_times, self.linear.creep_strengths
        if self.linear.creeps_by_logarithm:
            decades = math.log10(creep_times[1] / creep_times[0])
            found["creep per decade"] = 100.0 * float(strengths[0]) / decades, "%"
        else:
            pairs = zip(creep_times.tolist(), strengths.tolist(), strict=True)
            found |= {f"creep with {time:.3g} s": (100.0 * strength, "%") for time, strength in pairs}
        if self.drift:
            unit = self.output_unit or "output units"
            found["drift"] = self.drift, unit if self.drift_time > 0.0 else f"{unit}/s"
        if self.drift_time > 0.0:
            found["drift time"] = self.drift_time, "s"
        output, velocity = self.output_unit or "output units", f"({self.input_unit or 'input unit'}/s)"
        if self.viscous:
            found["viscosity"] = self.viscous, f"{output}/{velocity}"
        if self.friction:
            found["friction"] = self.friction, output
            found["friction speed"] = self.friction_speed, velocity.strip("()")
        return found

    def at_rest(self, state: HammersteinState) -> tuple[Operator[Any], Any] | None:
        """Return the operator and its state; None behind creep, which goes on."""
        return None if self.linear.creep_times.size else (self.static, state.memory)

    def structure(self) -> Mapping[str, Any]:
        """Return what follows the operator, as `dynamics`."""
        part = self.linear
        elements = {
            "resonance": part.lag[1] > 0.0,
            "lag": part.lag[0] > 0.0 and part.lag[1] == 0.0,
            "delay": part.delay > 0.0,
            "creep": part.creeps_by_logarithm,
            "kelvin-voigt": part.creep_times.size > 0 and not part.creeps_by_logarithm,
            "drift": self.drift != 0.0 and self.drift_time == 0.0,
            "fading-drift": self.drift_time > 0.0,
            "viscous": self.viscous != 0.0,
            "friction": self.friction != 0.0,
        }
        return {"dynamics": ",".join(name for name, is_there in elements.items() if is_there) or "none"}

    def state_to_json(self, state: HammersteinState) -> Any:  # noqa: ANN401
        """Return a state as JSON."""
        knots = state.knots
        return {
            "memory": self.static.state_to_json(state.memory),
            "clock": state.clock,
            "last": state.last,
            "knots": None
            if knots is None
            else {
                "times": list(knots.times),
                "values": list(knots.values),
                "value": knots.filters.value,
                "rate": knots.filters.rate,
                "crept": list(knots.filters.crept),
            },
        }

    def state_from_json(self, document: Any) -> HammersteinState:  # noqa: ANN401
        """Return the state that `state_to_json` wrote.

        Raises ValueError if it is no state of this model.
        """
        memory, clock, found = (_checks.json_field(document, key, "memory") for key in ("memory", "clock", "knots"))
        knots = None
        if found is not None:
            times, values, crept = (
                [_checks.number("memory", each) for each in _checks.json_field(found, key, "memory")]
                for key in ("times", "values", "crept")
            )
            if not times or len(times) != len(values) or len(crept) != self.linear.creep_times.size:
                raise ValueError(f"memory: expected knots and creep of this {self.kind} model")
            value, rate = (
                _checks.number("memory", _checks.json_field(found, key, "memory")) for key in ("value", "rate")
            )
            knots = Knots(tuple(times), tuple(values), FilterState(value, rate, tuple(crept)))
        last = found_last if (found_last := document.get("last")) is None else _checks.number("memory", found_last)
        return HammersteinState(self.static.state_from_json(memory), _checks.number("memory", clock), knots, last)


def velocities(times: Floats, inputs: Floats) -> Floats:
    """Return the velocity at each sample, input units/s, shape (N,), by second-order differences; 0 of one sample."""
    if inputs.size < 2:
        return np.zeros(inputs.size)
    return np.asarray(np.gradient(inputs, times))


def _elapsed(clock: Floats, state: HammersteinState) -> Floats:
    """Return times since the start of the record, s: those of the knots of a state, then those of a sequence."""
    elapsed: Floats = clock - clock[0]
    if state.knots is None:
        return elapsed
    gap = float(clock[0] - state.clock if clock[0] > state.clock else clock[1] - clock[0])
    return np.concatenate([state.knots.times, state.knots.times[-1] + gap + elapsed])
