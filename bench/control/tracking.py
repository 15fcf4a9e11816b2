"""Tracking controllers: readings in, the next set-point out; no device, no clock.

Two kinds share one vocabulary. A `TargetController` receives a sequence of targets: `aim` at one, then
`update` with every reading until the `Command` says done, and further while it holds. A `Follower` is called at
a fixed rate with a reference that moves.

Rules for all of them:

* Set-points are clipped to the model's operating range and to `limits`. Integrators stop there too.
* The memory of the hysteresis (`state`) follows the measured input of every call, not the set-point. A controller
  that knows a lag of the response lets it follow the input behind that lag, so that it is right on the way, too.
* A missing reading (nan or infinite) moves nothing: the set-point is held, the script waits for the next
  complete reading, estimators are not updated. A missing output does not keep the memory from following
  the measured input. Controllers with a hysteresis model also take for missing what is further outside the
  model's range than that is wide. The caller decides how long missing readings are tolerated.
* A target that cannot be met is replaced by the closest output, and `reach` says so.
* Between targets the set-point belongs to the controller. After the actuator was moved by other means, make a new
  controller from the memory that it has then.

The inverse and its use in open loop: Zhang, Merced, Sepúlveda, Tan, *Modeling and inverse compensation of
nonmonotonic hysteresis in VO2-coated microactuators*, IEEE/ASME Transactions on Mechatronics, 2013.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Protocol

from bench.base import checks as _checks
from bench.control.estimators import DisturbanceEstimator
from bench.control.model_filters import ModelFilter
from bench.control.overshoot import Overshoot, Passing
from bench.control.tuning import Spans
from bench.models import Inverse, InverseStream, Operator, Reach, ResponseDynamics, SeenInput, Stream

TO_REST = 10.0
"""Time constants in which a specimen comes to rest to the sensor's noise.

Derivation: e⁻¹⁰ is 0.005 % of a move, a tenth of the smallest part that a reading of 0.05 % shows.
"""
_LOOK = 0.25
"""Time between two readings of an input that settles, s.

Derivation: the peak of one that rings at 2 rad/s is within half of it, and seen to 1 − cos 0.25, 3 %.
"""
_LOOK_AT_PEAK = 0.1
"""The same on the way to a peak, s. Derivation: as `_LOOK`, to 0.5 %."""
_STILL = 0.003
"""Part of a move within one such time below which the input stands still.

Derivation: about the peak of an overshoot of 0.6 two readings differ by 0.6 (1 − cos 0.1) at 2 rad/s.
"""
_LONGEST_PART = 100
"""Readings after which to go on without a peak. Derivation: 10 s, half a wave at 0.3 rad/s."""
_SIGNIFICANT = 0.01
"""Part of the range of set-points that a move must have for its overshoot to be learned.

Derivation: five times `LEAST` of a smaller move is less than the tolerance of an arrival, 0.05 %.
"""
_AT_REST = 0.5
"""Rest of a move at which the specimen counts as being at rest, in errors that are close enough.

Derivation: the other half is left to the error of the controller.
"""
_ON_TIME = 1e-6
"""Difference of times that are equal, s. Source: rounding of float64: at 10⁹ s numbers are 1.2e-7 s apart."""
_CLOSE = 1e-9
"""Part of the output's range within which a clipped answer still counts as met.

Source: rounding of float64: sums of 10⁵ cells err by no more than 10⁵ times 2.2e-16, 2e-11.
"""


@dataclass(frozen=True)
class Command:
    """The next set-point of a controller.

    Parameters
    ----------
    setpoint : float
        Input to set now, input units.
    wait : float
        Time until the next reading, s.
    done : bool
        The target is reached as well as this controller can; the set-point is held from now on.
    """

    setpoint: float
    wait: float
    done: bool = False


@dataclass(frozen=True)
class Trace:
    """Internal values of a controller, for the record and the live view; nan where it has none.

    Parameters
    ----------
    reference : float
        Output it is to reach, output units.
    predicted : float
        Output that it believes to have, output units: model and estimated disturbance.
    disturbance : float
        Estimated difference of actuator and identified model, output units.
    uncertainty : float
        Standard deviation of that estimate, output units.
    """

    reference: float = math.nan
    predicted: float = math.nan
    disturbance: float = math.nan
    uncertainty: float = math.nan


class Controller(Protocol):
    """What the record asks of every controller."""

    @property
    def trace(self) -> Trace:
        """Internal values at present."""
        ...

    @property
    def state(self) -> Any:  # noqa: ANN401 - each operator has its own
        """Memory of the actuator as the controller knows it; None if it keeps none."""
        ...

    @property
    def reach(self) -> Reach:
        """Whether the present target or reference can be met."""
        ...


class TargetController(Controller, Protocol):
    """Brings the output to one target after another.

    `aim` and `update` take the time in s, the measured input in input units, one reading of the output, and the
    further signals that the controller needs, if any; `aim` takes the target before them.
    """

    @property
    def aim(self) -> Callable[..., Command]:
        """What starts towards a new target and returns the first command."""
        ...

    @property
    def update(self) -> Callable[..., Command]:
        """What takes in a reading, `Command.wait` after the last or later, and returns the next command."""
        ...


class Follower(Controller, Protocol):
    """Makes the output follow a reference that moves; called at a fixed rate."""

    def update(self, t: float, measured_input: float, output: float, reference: float) -> float:
        """Take in a reading and return the set-point for the coming period.

        Parameters
        ----------
        t : float
            Time, s.
        measured_input : float
            What the input's own sensor says, input units.
        output : float
            One reading of the output.
        reference : float
            Wanted output at the end of the coming period.
        """
        ...


class Sample(NamedTuple):
    """One complete reading: time in s, measured input, output."""

    time: float
    input: float
    output: float


Script = Generator[Command, Sample, None]
"""What a controller does for one target: yields commands, is sent readings, goes on holding for ever."""

Move = Generator[Command, Sample, Sample]
"""A part of a script, which returns its last reading."""


@dataclass(frozen=True)
class Arrival:
    """When an input has arrived at its set-point."""

    tolerance: float  # greatest difference between measured input and set-point, input units
    hold: float = 0.4  # time for which the difference must stay within the tolerance, s
    poll: float = 0.1  # time between two readings, s
    # Time after which to go on without arrival, s. The estimators need none: they go by the measured input.
    patience: float = 15.0

    def __post_init__(self) -> None:
        check_positive(self)

    @classmethod
    def scaled(cls, spans: Spans) -> Arrival:
        """Return the defaults for a model: a tolerance of 0.05 % of the input range."""
        return cls(tolerance=5e-4 * spans.input)


def check_positive(parameters: object, *names: str) -> None:
    """Raise a ValueError that names a field (all number fields, or `names`) that is not positive and finite."""
    for name in names or [field.name for field in fields(parameters)]:  # type: ignore[arg-type]
        value = getattr(parameters, name)
        if isinstance(value, int | float) and not 0.0 < value < math.inf:
            raise ValueError(f"{name}: expected a positive number, got {value}")


class ControllerBase:
    """Base of the controllers: limits, memory, reference, the last set-point, and whether the target can be met.

    Parameters
    ----------
    input_range : tuple of float
        Range of the set-points, input units.
    limits : tuple of float or None
        A narrower range, input units.
    model : Operator or None
        The model whose memory is kept.
    state : object or None
        Memory at the first reading, a state of the model; default the model's initial one.
    adaptation : ModelFilter or None
        What corrects the model while it is used.

    Raises
    ------
    ValueError
        If the limits do not increase or have nothing in common with the range.
    """

    _estimator: DisturbanceEstimator | None = None
    _inverse: Inverse[Any]
    _seen: SeenInput | None = None

    def __init__(
        self,
        input_range: tuple[float, float],
        limits: tuple[float, float] | None = None,
        model: Operator[Any] | None = None,
        state: Any = None,  # noqa: ANN401 - each operator has its own
        adaptation: ModelFilter | None = None,
    ) -> None:
        low, high = _checks.increasing("limits", input_range).tolist()
        if limits is not None:
            least, greatest = _checks.increasing("limits", limits).tolist()
            low, high = max(low, least), min(high, greatest)
            if low >= high:
                raise ValueError(f"limits: expected an overlap with the range {input_range}, got {limits}")
        self._low, self._high = float(low), float(high)
        self._model, self._state = model, state
        self._adaptation = adaptation
        self._memory: Stream[Any] | InverseStream[Any] | None = None
        self._plausible_input = self._plausible_output = (-math.inf, math.inf)
        present = 0.5 * (low + high)
        if model is not None:
            stream = model.stream(state)
            self._memory, self._move = stream, stream.step
            present = model.present_input(stream.state)
            self._plausible_input = widened(*model.input_range)
            least, greatest = model.output_range()
            self._plausible_output = widened(least, greatest)
            self._close = _CLOSE * (greatest - least)
        self._setpoint = self._clip(present)
        self._started = model is not None
        self._reach = Reach.MET
        self._reference = math.nan

    @property
    def trace(self) -> Trace:
        """Internal values at present."""
        modelled, estimator, adaptation = self._modelled(), self._estimator, self._adaptation
        if estimator is None and adaptation is None:
            return Trace(self._reference, modelled)
        disturbance, uncertainty = (0.0, 0.0) if estimator is None else (estimator.value, estimator.uncertainty)
        predicted = modelled + disturbance
        if adaptation is not None:
            disturbance = predicted - adaptation.identified.value(self.state)
            uncertainty = math.hypot(uncertainty, adaptation.uncertainty)
        return Trace(self._reference, predicted, disturbance, uncertainty)

    @property
    def adaptation(self) -> ModelFilter | None:
        """What corrects the model, and the corrected model; None if nothing does."""
        return self._adaptation

    @property
    def state(self) -> Any:  # noqa: ANN401
        """Memory of the actuator as the controller knows it; None if it keeps none."""
        return self._state if self._memory is None else self._memory.state

    @property
    def reach(self) -> Reach:
        """Whether the present target can be met."""
        return self._reach

    @property
    def limits(self) -> tuple[float, float]:
        """Least and greatest set-point, input units."""
        return self._low, self._high

    def _clip(self, setpoint: float) -> float:
        return min(max(setpoint, self._low), self._high)

    def _observe(self, t: float, measured_input: float) -> bool:
        """Move the memory by what the actuator did; return whether there is something to go by."""
        low, high = self._plausible_input
        if not (math.isfinite(measured_input) and low <= measured_input <= high):
            return False
        if self._memory is not None:
            self._move(measured_input if self._seen is None else self._seen.take(t, measured_input))
        if not self._started:
            # Without a memory, the first reading says where the actuator is.
            self._setpoint, self._started = self._clip(measured_input), True
        return True

    def _is_known(self, output: float) -> bool:
        """Return whether there is a plausible reading of the output."""
        low, high = self._plausible_output
        return math.isfinite(output) and low <= output <= high

    def _modelled(self) -> float:
        """Return the model's output after what the actuator did; nan without a model."""
        return math.nan if self._memory is None else self._memory.value

    def _learn(self, output: float) -> None:
        """Have the model corrected by an output that was measured where the actuator has come to."""
        adaptation = self._adaptation
        if adaptation is None or not self._is_known(output):
            return
        state, before = self.state, self._modelled()
        if adaptation.update(state, output):
            self._model = adaptation.model
            self._take(adaptation.model.inverse(self._inverse.policy), state)
            if self._estimator is not None:
                # What the model now explains is no disturbance any more.
                self._estimator.shift(before - self._modelled())

    def _take(self, inverse: Inverse[Any], state: Any) -> None:  # noqa: ANN401
        """Go on with another model and its inverse from a state."""
        self._inverse = inverse
        stream = inverse.operator.stream(state)
        self._memory, self._move = stream, stream.step

    def _way(self, target: float) -> Iterator[float]:
        """Yield the set-points that lead to a target, the last from the memory as it is when it is asked for."""
        first, *rest = self._answer(target)
        yield first
        if rest:
            yield self._answer(target)[-1]

    def _answer(self, target: float) -> tuple[float, ...]:
        found = self._inverse.invert(self.state, target)
        return self._within(found.setpoints, found.reach, target)

    def _within(self, found: tuple[float, ...], reach: Reach, target: float) -> tuple[float, ...]:
        """Return the set-points of an answer within the limits, and note whether they meet the target."""
        setpoints = tuple(self._clip(value) for value in found)
        self._reach = reach
        if setpoints != found and self._model is not None:
            short = target - float(self._model.evaluate(setpoints, self.state)[-1])
            if abs(short) > self._close:
                self._reach = Reach.of(False, short)
        return setpoints


def widened(low: float, high: float) -> tuple[float, float]:
    """Return a range with its own width added at both ends."""
    return 2.0 * low - high, 2.0 * high - low


class Scripted(ControllerBase, ABC):
    """A target controller as a script: a generator that yields commands and is sent readings."""

    _poll = 0.1
    _needs_output = True

    _input = _time = math.nan
    """Of the last complete reading."""
    _script: Script | None = None
    _done = False

    def __init__(
        self,
        input_range: tuple[float, float],
        limits: tuple[float, float] | None = None,
        model: Operator[Any] | None = None,
        state: Any = None,  # noqa: ANN401
        adaptation: ModelFilter | None = None,
        response: ResponseDynamics | None = None,
    ) -> None:
        super().__init__(input_range, limits, model, state, adaptation)
        if response is not None and response.lag > 0.0:
            self._seen = SeenInput(response)
        self._overshoot = Overshoot(_SIGNIFICANT * (self._high - self._low))

    def aim(self, target: float, t: float, measured_input: float, output: float) -> Command:
        """Start towards a new target and return the first command.

        Parameters
        ----------
        target : float
            Wanted output, output units.
        t : float
            Time, s.
        measured_input : float
            What the input's own sensor says, input units; nan if missing.
        output : float
            One reading of the output; nan if missing.

        Raises ValueError if the target is not finite.
        """
        self._reference = _checks.number("target", target)
        self._script, self._done, self._reach = None, False, Reach.MET
        return self.update(t, measured_input, output)

    def update(self, t: float, measured_input: float, output: float) -> Command:
        """Take in a reading and return the next command.

        Raises RuntimeError if there is no target yet.
        """
        if math.isnan(self._reference):
            raise RuntimeError("update: expected a target first, by aim")
        known = self._observe(t, measured_input)
        if not known or (self._needs_output and not self._is_known(output)):
            return Command(self._setpoint, self._poll, self._done)
        reading = Sample(t, measured_input, output)
        self._input, self._time = measured_input, t
        if self._script is None:
            self._script = self._run(self._reference, reading)
            command = next(self._script)
        else:
            command = self._script.send(reading)
        self._done = command.done
        return command

    @abstractmethod
    def _run(self, target: float, reading: Sample) -> Script:
        """Return the script that leads to a target."""

    def _command(self, setpoint: float, wait: float, done: bool = False) -> Command:
        """Return a command whose set-point is within the limits."""
        self._setpoint = self._clip(setpoint)
        return Command(self._setpoint, wait, done)

    def _hold(self, wait: float) -> Script:
        """Hold the set-point for ever."""
        while True:
            yield Command(self._setpoint, wait, done=True)

    def _head_for(self, setpoint: float) -> Generator[Command, Sample, Passing]:
        """Go the first part of the way to a set-point, to the peak there, if the input would overshoot otherwise."""
        start, way = self._input, self._clip(setpoint) - self._input
        share = self._overshoot.share(way)
        if share:
            place = 0.0
            for _ in range(_LONGEST_PART):
                reading = yield self._command(start + way / (1.0 + share), _LOOK_AT_PEAK)
                before, place = place, (reading.input - start) / way
                # At the peak it stands still for a moment.
                if place > 0.5 and place - before < _STILL:
                    break
            self._overshoot.learn(way, place * (1.0 + share) - 1.0)
        return Passing(start, start + way, self._overshoot, in_one=not share)

    def _still_to_come(self, measured_input: float) -> float:
        """Return how far the model's output is from what the input leads to, output units; 0 without a lag."""
        if self._seen is None or self._model is None:
            return 0.0
        return abs(float(self._model.evaluate((measured_input,), self.state)[-1]) - self._modelled())

    def _arrive(self, setpoint: float, arrival: Arrival, at_rest: float = math.inf) -> Move:
        """Return the reading with which the actuator has arrived at a set-point and the output is `at_rest`."""
        passing = yield from self._head_for(setpoint)
        # Clocks start with the first reading: until then readings may have been missing.
        started = since = math.nan
        while True:
            reading = yield self._command(setpoint, arrival.poll)
            passing.note(reading.input)
            if math.isnan(started):
                started = reading.time - arrival.poll
            if abs(reading.input - self._setpoint) < arrival.tolerance:
                since = reading.time if math.isnan(since) else since
            else:
                since = math.nan
            # Times are sums of floats.
            held = reading.time - since >= arrival.hold - 1e-9 and self._still_to_come(reading.input) <= at_rest
            if held or reading.time - started >= arrival.patience:
                passing.learn()
                return reading


class OpenLoopInverse(Scripted):
    """Sets the input that the inverse gives, and waits (Zhang et al. 2013, section V).

    Where the inverse has two elements the actuator is sent to the first, an end of the transition, waits
    there, and then goes to the second, found again from what the actuator really did.

    Parameters
    ----------
    inverse : Inverse
        Exact inverse of the identified model; its `policy` says which answer is taken.
    state : object or None
        Memory of the actuator at the first reading; default that of the model.
    limits : tuple of float or None
        Least and greatest set-point, input units; default the operating range of the model.
    wait : float
        Time for the actuator to settle after each set-point, s.
    adaptation : ModelFilter or None
        What corrects the model by the output after each wait.
    response : ResponseDynamics or None
        Of the specimen: its memory follows the input behind the lag.
    """

    _needs_output = False

    def __init__(
        self,
        inverse: Inverse[Any],
        state: Any = None,  # noqa: ANN401
        limits: tuple[float, float] | None = None,
        *,
        wait: float,
        adaptation: ModelFilter | None = None,
        response: ResponseDynamics | None = None,
    ) -> None:
        if not 0.0 < wait < math.inf:
            raise ValueError(f"wait: expected a positive number of seconds, got {wait}")
        super().__init__(inverse.operator.input_range, limits, inverse.operator, state, adaptation, response)
        self._inverse = inverse
        self._wait = wait

    def _run(self, target: float, reading: Sample) -> Script:  # noqa: ARG002
        for setpoint in self._way(target):
            yield from self._settle(setpoint)
        yield from self._hold(self._poll)

    def _settle(self, setpoint: float) -> Generator[Command, Sample, None]:
        """Go to a set-point and wait there; the input is read meanwhile, so that its extremes are known."""
        started, output = self._time, math.nan
        passing = yield from self._head_for(setpoint)
        while (left := self._wait - (self._time - started)) > _ON_TIME:
            reading = yield self._command(setpoint, left / max(1, round(left / _LOOK)))
            passing.note(reading.input)
            output = reading.output
        passing.learn()
        self._learn(output)


@dataclass(frozen=True)
class CorrectionParameters:
    """Numbers of the closed-loop inverse."""

    # Error below which no further correction is made, output units: a correction that must turn back crosses a loop
    # of the hysteresis, and then may well end further off.
    close_enough: float
    # Variance by which the model's error changes between two corrections, output units squared. Three times the other
    # lets the gain settle at 0.8; results change little over a decade.
    walk_variance: float
    # Variance of one value of the disturbance, output units squared: noise of the sensor, and what the input wanders
    # unseen while it is read.
    reading_variance: float
    arrival: Arrival  # when the actuator has arrived at a set-point
    corrections: int = 4  # greatest number of corrections after the first move

    def __post_init__(self) -> None:
        check_positive(self, "close_enough", "walk_variance", "reading_variance")
        if self.corrections < 0:
            raise ValueError(f"corrections: expected at least 0, got {self.corrections}")

    @classmethod
    def scaled(cls, spans: Spans) -> CorrectionParameters:
        """Return the defaults for a model: 0.25 % of the output range is close, 0.05 % is read."""
        reading = 5e-4 * spans.output
        return cls(2.5e-3 * spans.output, 3.0 * reading**2, reading**2, Arrival.scaled(spans))


class Correcting(Scripted):
    """The moves that `ClosedLoopInverse` consists of and that others fall back to; parameters as there."""

    def __init__(
        self,
        inverse: Inverse[Any],
        state: Any = None,  # noqa: ANN401
        limits: tuple[float, float] | None = None,
        parameters: CorrectionParameters | None = None,
        adaptation: ModelFilter | None = None,
        response: ResponseDynamics | None = None,
    ) -> None:
        super().__init__(inverse.operator.input_range, limits, inverse.operator, state, adaptation, response)
        self._inverse = inverse
        self._correction = parameters = parameters or CorrectionParameters.scaled(Spans.of(inverse.operator))
        self._poll = parameters.arrival.poll
        self._estimator: DisturbanceEstimator = DisturbanceEstimator(
            walk_variance=parameters.walk_variance, reading_variance=parameters.reading_variance
        )

    def _towards(self, target: float) -> Move:
        """Go where the model's output is `target`, through saturation if necessary."""
        arrival, at_rest = self._correction.arrival, _AT_REST * self._correction.close_enough
        for setpoint in self._way(target):
            reading = yield from self._arrive(setpoint, arrival, at_rest)
        return reading

    def _correct(self, target: float) -> Move:
        """Go to the target and correct by the disturbance that is measured where the actuator has come to."""
        reading = yield from self._towards(target - self._estimator.value)
        for _ in range(self._correction.corrections):
            self._learn(reading.output)
            self._estimator.update(reading.output - self._modelled())
            if abs(target - reading.output) <= self._correction.close_enough:
                break
            reading = yield from self._towards(target - self._estimator.value)
        return reading


class ClosedLoopInverse(Correcting):
    """Feedforward by the inverse, feedback by the measured disturbance.

    The disturbance z = y - Ω(ψ) of the measured output y against the model's output Ω of the memory ψ goes
    into a Kalman filter of a random walk, d; each set-point is the inverse at target - d. This is an
    integrator in terms of the model's output, of gain K: with a true local gain of g times the model's the
    error goes on by 1 - K g. As d is measured and not summed up, it cannot wind up at a limit.

    Parameters
    ----------
    inverse : Inverse
        Exact inverse of the identified model.
    state, limits
        As in `OpenLoopInverse`.
    parameters : CorrectionParameters
        Numbers of the loop.
    adaptation : ModelFilter or None
        What corrects the model by the output at each correction.
    response : ResponseDynamics or None
        Of the specimen: its memory follows the input behind the lag, and readings count when it is at rest.
    """

    def _run(self, target: float, reading: Sample) -> Script:  # noqa: ARG002
        yield from self._correct(target)
        yield from self._hold(self._poll)
