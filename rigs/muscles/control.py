"""Control of a muscle that a voltage drives, such as a shape-memory-alloy wire: its length or its force.

Two of the three controllers use the two-stage model among voltage, force and length, in open and in closed loop; the
third is proportional-integral, for comparison without a model. Each samples at a fixed period, spends a fixed time at
each target, keeps its state from one target to the next, and serves two tasks: the length under a measured force,
which may change, and the force between fixed ends.

Units are those of the model; the defaults are in metres, newtons and volts.

A reading may be missing (nan, or far beyond the range of the model). A missing voltage is replaced by the last
set-point, a missing force by the last force. Without an output the estimate of the disturbance is kept while the
model goes on, as a wire that is driven ahead of its lag must not be left at that voltage; the controller without a
model holds its set-point.

What a controller knows of a muscle comes from the model and from the dynamics in its file.

Model and thermal lag: Zhang and Yip, "Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles with
Application to Shape Memory Alloy Actuators", Robotics: Science and Systems, 2017; here "Zhang and Yip 2017".
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

from bench.base import ConfigurationError, DataError, checks as _checks
from bench.control import (
    SHORTEST_WAIT,
    Command,
    ControllerBase,
    ControllerSetup,
    ControllerSpec,
    DisturbanceEstimator,
    Trace,
    check_positive,
    saturation,
    tuned,
    widened,
)
from bench.models import IdentifiedDynamics, Reach, ResponseDynamics, SeenInput, TwoStageState, TwoStageStream
from rigs.muscles.tasks import ForceTask, LengthTask, Task
from rigs.muscles.two_stage_inverse import TwoStageInverse

_READINGS_A_LAG = 5.0
"""Readings in one time constant of the muscle."""
_UNSEEN = 1.5
"""Periods between readings, in time constants that would not have been seen: the muscle then follows within one."""
_LEAD = 2.0
"""Periods within which the closed loop would bring the muscle to its new state. Twice the period makes up for more
than half of the way in each, and leaves room for a time constant that is not quite right."""
_NOISES = 5.0
"""Errors of so many standard deviations of a reading are no noise."""
_OVERSHOOT = 0.7
"""Part of an error that has overshot as far as this on the other side; further moves are then half as long."""
_LEAST_PART = 0.25
"""Part of a move to which overshoots reduce it at most."""
_SHORTEST_PERIOD = 0.2
"""Time between two readings where nothing slower is known, s: what a reading of all signals takes."""


@dataclass(frozen=True)
class LagSearch:
    """How a time constant is looked for while a muscle is controlled.

    A muscle in a draught, or another of its kind, has another time constant than the one that was identified. Of
    several, that one is taken with which the model's error changes least from reading to reading: what the wrong
    lag leaves changes whenever the muscle moves, and the error of the model at rest does not.
    """

    factor: float = 1.1
    """Ratio of neighbouring time constants."""
    steps: int = 8
    """Number of time constants above, and of those below the identified one; 0 for that alone."""
    margin: int = 2
    """How many steps above the likeliest the time constant is by which the muscle is led: the model is flat after a
    reversal where the muscle is not, which makes it seem faster than it is."""
    memory: float = 250.0
    """Number of readings after which a change of the error is forgotten."""
    advantage: float = 0.8
    """Part of the squares of its changes below which another time constant takes the place of the present one."""

    def __post_init__(self) -> None:
        check_positive(self, "memory", "advantage")
        if not 1.0 < self.factor < math.inf:
            raise ValueError(f"factor: expected a number above 1, got {self.factor}")
        if self.steps < 0 or self.margin < 0:
            raise ValueError(f"steps, margin: expected at least 0, got {self.steps} and {self.margin}")

    def factors(self) -> list[float]:
        """Return the multiples of the identified time constant that are tried, in order."""
        return [self.factor**k for k in range(-self.steps, self.steps + 1)]


@dataclass(frozen=True)
class InverseControlParameters:
    """Parameters of the controllers with a model."""

    time_constant: float
    """Of the muscle behind its voltage, s; 0 for one that follows at once."""
    period: float
    """Time between two readings, s."""
    horizon: float
    """Time within which the closed loop would bring the muscle to its new state, s."""
    power: float = 2.0
    """Power of the voltage that is lagged: 2 for heat, 1 for a pressure."""
    caution: float = 1.0
    """Factor of the slopes that are believed: the larger, the shorter are the moves of the closed loop."""
    model_error: float = 0.02
    """Change of the model's error within one period, as a part of what the output moves by over the range of the
    voltage: the smaller, the more readings are averaged in closed loop."""
    duration: float = 20.0
    """Time for each target, s."""
    search: LagSearch = field(default_factory=LagSearch)
    """How other time constants are tried in closed loop."""

    def __post_init__(self) -> None:
        check_positive(self, "period", "horizon", "caution", "model_error", "duration")
        if not 0.0 <= self.time_constant < math.inf:
            raise ValueError(f"time_constant: expected a finite number of s, at least 0, got {self.time_constant}")
        if self.power not in (1.0, 2.0):
            raise ValueError(f"power: expected 1 or 2, got {self.power}")

    @classmethod
    def of_dynamics(cls, dynamics: IdentifiedDynamics, duration: float = 20.0) -> InverseControlParameters:
        """Return parameters for a muscle whose dynamics were identified."""
        lag = dynamics.response.lag
        period = max(lag / _READINGS_A_LAG, _UNSEEN * dynamics.fastest, _SHORTEST_PERIOD)
        return cls(lag, period, _LEAD * period, dynamics.response.power, duration=duration)


class MuscleController(ControllerBase, ABC):
    """Base of the controllers: limits, the last set-point, a fixed period and a fixed time at each target."""

    def __init__(
        self, input_range: tuple[float, float], limits: tuple[float, float] | None, period: float, duration: float
    ) -> None:
        super().__init__(input_range, limits)
        if self._low < 0.0:
            raise ValueError(f"limits: expected voltages of at least 0, got {self.limits}")
        self._period = period
        self._samples = max(1, round(duration / period))
        self._sample = 0
        self._start = 0.0
        self._setpoint = self._low

    def aim(self, target: float, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Start towards a new target and return the first command; see `TargetController`.

        The measured input is the voltage (V) that the supply has put out since the last reading. The task may need
        further signals. Raises ValueError if the target is not finite, the time goes back or the number of signals is
        wrong.
        """
        self._reference = _checks.number("target", target)
        self._start, self._sample, self._reach = t, 0, Reach.MET
        return self.update(t, measured_input, output, *others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Take in a reading and return the next command; arguments and errors as `aim`.

        Raises RuntimeError if there is no target yet.
        """
        if math.isnan(self._reference):
            raise RuntimeError("update: expected a target first, by aim")
        self._take_in(t, measured_input, output, others)
        if self._sample == self._samples:
            return Command(self._setpoint, self._period, done=True)
        self._setpoint = self._clip(self._decide(output, first=self._sample == 0))
        self._sample += 1
        # Counted from the beginning, so that one delay does not shift all later samples.
        return Command(self._setpoint, max(SHORTEST_WAIT, self._start + self._sample * self._period - t))

    @abstractmethod
    def _take_in(self, t: float, measured_input: float, output: float, others: tuple[float, ...]) -> None:
        """Take in a reading."""

    @abstractmethod
    def _decide(self, output: float, *, first: bool) -> float:
        """Return the voltage for the coming period, perhaps beyond the limits; `first` after a new target."""


@dataclass
class _Hypothesis:
    """A time constant, and what the model and its error are if it is the muscle's."""

    seen: SeenInput  # the voltage that would hold what the muscle has
    stream: TwoStageStream
    estimator: DisturbanceEstimator
    error: float = math.nan
    """The model's error at the last reading, output units."""
    score: float = 0.0
    """Squares of its changes, with forgetting, output units squared."""


class _Modelled(MuscleController):
    """Base of the controllers with a model: its memory, which follows the measured voltage, and the lag."""

    _searches = False

    def __init__(
        self,
        task: Task,
        parameters: InverseControlParameters,
        state: TwoStageState | None = None,
        limits: tuple[float, float] | None = None,
    ) -> None:
        self._parameters = p = parameters
        model = task.inverse.model
        super().__init__(model.first.input_range, limits, p.period, p.duration)
        self._task = task
        start: TwoStageState = model.initial_state() if state is None else state
        factors = p.search.factors() if self._searches and p.time_constant > 0.0 else [1.0]
        self._hypotheses = [
            _Hypothesis(
                SeenInput(ResponseDynamics(factor * p.time_constant, p.power), start.voltage),
                model.stream(start),
                DisturbanceEstimator(walk_variance=task.walk_variance, reading_variance=task.reading_variance),
            )
            for factor in factors
        ]
        self._likeliest = len(factors) // 2
        self._setpoint = self._clip(start.voltage)
        self._plausible_input = widened(*model.first.input_range)
        self._plausible_output = widened(*task.output_range())
        self._time: float | None = None

    @property
    def state(self) -> TwoStageState:
        """Memory of the muscle as the controller knows it; its voltage is the one that would hold what it has."""
        return self._believed.stream.state

    @property
    def time_constant(self) -> float:
        """Time constant that agrees best with the readings so far, s."""
        return self._hypotheses[self._likeliest].seen.response.lag

    @property
    def _believed(self) -> _Hypothesis:
        """The time constant by which the muscle is led."""
        return self._hypotheses[min(self._likeliest + self._parameters.search.margin, len(self._hypotheses) - 1)]

    def _take_in(self, t: float, measured_input: float, output: float, others: tuple[float, ...]) -> None:
        low, high = self._plausible_input
        # Noise may make a reading of 0 V negative.
        applied = max(measured_input, 0.0) if low <= measured_input <= high else self._setpoint
        passed = 0.0 if self._time is None else t - self._time
        if passed < 0.0:
            raise ValueError(f"t: expected a time not before {self._time}, got {t}")
        self._time = t
        search = self._parameters.search
        least, greatest = self._plausible_output
        for each in self._hypotheses:
            self._task.advance(each.stream, each.seen.take(t, applied), others)
            if least <= output <= greatest:
                error = output - self._task.output(each.stream)
                each.estimator.update(error)
                if passed > 0.0 and not math.isnan(each.error):
                    kept = math.exp(-passed / (search.memory * self._parameters.period))
                    each.score = kept * each.score + (error - each.error) ** 2
                each.error = error
        scores = [each.score for each in self._hypotheses]
        best = scores.index(min(scores))
        if scores[best] < search.advantage * scores[self._likeliest]:
            self._likeliest = best

    def _modelled(self) -> float:
        return self._task.output(self._believed.stream)

    def _steady(self, target: float) -> float:
        """Return the steady voltage for a target of the model within the limits; note whether it meets the target."""
        found = self._task.invert(self.state, target)
        voltage = self._clip(found.voltage)
        self._reach = found.reach
        if voltage != found.voltage:
            more = (found.voltage > voltage) == (self._task.slopes[0] > 0.0)
            self._reach = Reach.TOO_HIGH if more else Reach.TOO_LOW
        return voltage


class MuscleOpenLoop(_Modelled):
    """Set once for each target the steady voltage of the inverse, without feedback of the output.

    The memory follows the lag, and in the length task the measured force.

    Parameters
    ----------
    task : LengthTask or ForceTask
        What is controlled.
    parameters : InverseControlParameters
        Of the controller; horizon and search are not used.
    state : TwoStageState or None
        State of the muscle at the first reading, whose voltage holds what it then has; default that after a reset.
    limits : tuple of float or None
        Least and greatest voltage, V, at least 0; default the range of the model.

    Raises
    ------
    ValueError
        If the limits do not increase, are negative or have nothing in common with the model's range.
    """

    def _decide(self, output: float, *, first: bool) -> float:  # noqa: ARG002
        return self._steady(self._reference) if first else self._setpoint


class MuscleClosedLoop(_Modelled):
    """Feedforward by the inverse, ahead of the lag; feedback by an estimate of the disturbance.

    At each reading: from the measured voltage the lag gives the steady voltage v of what the muscle has at present,
    with which the model moves on. The disturbance, the measured output less the model's, goes through a Kalman
    filter. The inverse at target less disturbance gives the next v, and the lag the voltage that leads there. As v
    and disturbance are computed from measurements and nothing is summed up, nothing winds up while the voltage is at
    a limit.

    Each move of v is that of the inverse, but no more and no less than a slope of the output over v within
    `Task.slopes` would take for the present error. After a reversal a model with cells is flat over part of a cell
    where the muscle is not, and elsewhere too steep. There the inverse alone would go to and fro across the flat part
    without end, or hardly correct at all. Where a move overshoots far, the muscle is steeper than that: further moves
    to the same target are half as long.

    The time constant is that of the parameters at first, and then the one of `LagSearch` that agrees best with the
    readings.

    Parameters
    ----------
    task, parameters, state, limits
        As in `MuscleOpenLoop`.
    """

    _searches = True
    _part = 1.0
    _error = 0.0

    @property
    def trace(self) -> Trace:
        """Internal values at present."""
        modelled, estimator = self._modelled(), self._believed.estimator
        return Trace(self._reference, modelled + estimator.value, estimator.value, estimator.uncertainty)

    def _decide(self, output: float, *, first: bool) -> float:  # noqa: ARG002
        wanted = self._reference - self._believed.estimator.value
        seen = self._believed.seen
        present = seen.value
        error = wanted - self._modelled()
        least, greatest = sorted(error / (self._parameters.caution * slope) for slope in self._task.slopes)
        move = min(max(self._steady(wanted) - present, least), greatest)
        noise = _NOISES * math.sqrt(self._task.reading_variance)
        if first:
            self._part = 1.0
        elif error * self._error < 0.0 and abs(error) > max(_OVERSHOOT * abs(self._error), noise):
            self._part = max(_LEAST_PART, 0.5 * self._part)
        self._error = error
        return seen.lead(self._clip(present + self._part * move), self._parameters.horizon, self.limits)


@dataclass(frozen=True)
class ProportionalIntegralParameters:
    """Parameters of the proportional-integral controller.

    Parameters
    ----------
    gain : float
        V^power for one output unit of error; negative where the output falls with the voltage.
    integral_time : float
        Time in which a constant error adds as much as the proportional part gives, s.
    period : float
        Time between two readings, s.
    power : {1, 2}
        Power of the voltage in which the muscle is about linear: 2 for heat, 1 for a pressure.
    duration : float
        Time for each target, s.
    """

    gain: float
    integral_time: float
    period: float
    power: float = 2.0
    duration: float = 20.0

    def __post_init__(self) -> None:
        check_positive(self, "integral_time", "period", "duration")
        if not math.isfinite(self.gain) or self.gain == 0.0:
            raise ValueError(f"gain: expected a number other than 0, got {self.gain}")
        if self.power not in (1.0, 2.0):
            raise ValueError(f"power: expected 1 or 2, got {self.power}")

    @classmethod
    def of_lag(cls, rise: float, timing: InverseControlParameters) -> ProportionalIntegralParameters:
        """Return parameters that cancel the lag of a muscle and leave a time constant as long as it.

        `rise` is the output units for each V^power, of the sign of the muscle, over the whole range. What follows at
        once has half of its error taken away in each period.
        """
        integral = max(timing.time_constant, 0.5 * timing.period)
        closed = max(timing.time_constant, 2.0 * timing.period)
        return cls(integral / (rise * closed), integral, timing.period, timing.power, timing.duration)


class MuscleProportionalIntegral(MuscleController):
    """Proportional-integral control without a model, for comparison.

    It sets that power of the voltage in which the muscle is about linear, and moves it on from its present
    value, which is within the limits: so it leaves a limit at once when the error turns, and cannot wind up.
    Further signals are ignored.

    Parameters
    ----------
    limits : tuple of float
        Least and greatest voltage, V, at least 0.
    parameters : ProportionalIntegralParameters
        Gain and times.

    Raises
    ------
    ValueError
        If the limits do not increase or are negative.
    """

    def __init__(self, limits: tuple[float, float], parameters: ProportionalIntegralParameters) -> None:
        super().__init__(limits, None, parameters.period, parameters.duration)
        self._parameters = parameters
        self._error: float | None = None
        self._started = False

    def _take_in(self, t: float, measured_input: float, output: float, others: tuple[float, ...]) -> None:  # noqa: ARG002
        if not self._started and math.isfinite(measured_input):
            # The first reading says where the actuator is.
            self._setpoint, self._started = self._clip(measured_input), True

    def _decide(self, output: float, *, first: bool) -> float:  # noqa: ARG002
        if not math.isfinite(output):
            return self._setpoint
        p = self._parameters
        error = self._reference - output
        change = 0.0 if self._error is None else error - self._error
        self._error = error
        level = self._setpoint**p.power + p.gain * (change + error * p.period / p.integral_time)
        self._reach = saturation(level, self._low**p.power, self._high**p.power, error)
        return float(max(level, 0.0) ** (1.0 / p.power))


def _timing(setup: ControllerSetup) -> InverseControlParameters:
    """Return the parameters of a setup: those of the rig, or from the dynamics in the model file."""
    options = dict(setup.options)
    duration = float(options.pop("duration"))
    dynamics = setup.model.dynamics
    if dynamics is None and "time_constant" not in options:
        raise ConfigurationError(
            f"controller {setup.name}: the model file does not say how fast the muscle follows its voltage; identify "
            "it from runs with telemetry, or give the time constant (s) and the power of the voltage (2 for heat, 1 "
            f"for a pressure) in the rig file: [protocols.NAME.tuning.{setup.name}] time_constant = ..., power = ..."
        )
    if dynamics is None:
        given = ResponseDynamics(float(options["time_constant"]), float(options.get("power", 2.0)))
        dynamics = IdentifiedDynamics(response=given)
    try:
        found = tuned(InverseControlParameters.of_dynamics(dynamics, duration), options)
    except ValueError as error:
        raise ConfigurationError(f"controller {setup.name}: {error}") from None
    if duration < found.time_constant + 2.0 * found.period:
        raise ConfigurationError(
            f"duration = {duration:g} s is too short for a muscle of the time constant {found.time_constant:.3g} s; "
            f"give each target {2.0 * found.time_constant + 2.0 * found.period:.2g} s at least"
        )
    return found


def _task(setup: ControllerSetup, kind: type[Task]) -> Task:
    try:
        inverse = TwoStageInverse(setup.model.model)
    except ValueError as error:
        raise DataError(f"the two-stage model has no inverse: {error}") from error
    noise = {} if setup.model.dynamics is None else setup.model.dynamics.noise
    state: TwoStageState = setup.start if setup.start is not None else inverse.model.initial_state()
    return kind.of_model(inverse, state, setup.limits, noise, _timing(setup).model_error)


def _own_error(setup: ControllerSetup, kind: type[Task]) -> float:
    """Return the RMS error that the model leaves by itself, output units."""
    low, high = _task(setup, kind).output_range()
    # The file states errors in percent of the range.
    own = 0.01 * setup.model.provenance.get("errors", {}).get(kind.kind, {}).get("rms", 0.0)
    timing = _timing(setup)
    # What is left of a move at the end of its time, of moves between targets at random.
    left = math.exp(-timing.duration / max(timing.time_constant, SHORTEST_WAIT)) / math.sqrt(6.0)
    return math.hypot(own, left) * (high - low)


def _with_inverse(summary: str, controller: Callable[..., MuscleController], kind: type[Task]) -> ControllerSpec:
    return ControllerSpec(
        summary,
        lambda s: controller(_task(s, kind), _timing(s), s.state, s.limits),
        numbers=_timing,
        # The lead is by a number of periods.
        tunable=("period+horizon", "horizon", "caution", "model_error") if controller is MuscleClosedLoop else (),
        own_error=(lambda s: _own_error(s, kind)) if controller is MuscleOpenLoop else None,
    )


def _without_inverse(kind: type[Task]) -> ControllerSpec:
    def make(setup: ControllerSetup) -> MuscleController:
        timing, task = _timing(setup), _task(setup, kind)
        low, high = setup.limits
        rise = task.rise / (high**timing.power - low**timing.power)
        return MuscleProportionalIntegral(setup.limits, ProportionalIntegralParameters.of_lag(rise, timing))

    return ControllerSpec("proportional-integral control without the inverse of a model, for comparison", make)


_OPEN_LOOP = "inverse of the two-stage model, without feedback"
_CLOSED_LOOP = "inverse of the two-stage model, with the disturbance estimated from the measured output"

LENGTH_OPEN_LOOP = _with_inverse(_OPEN_LOOP, MuscleOpenLoop, LengthTask)
LENGTH_CLOSED_LOOP = _with_inverse(_CLOSED_LOOP, MuscleClosedLoop, LengthTask)
LENGTH_PROPORTIONAL_INTEGRAL = _without_inverse(LengthTask)
FORCE_OPEN_LOOP = _with_inverse(_OPEN_LOOP, MuscleOpenLoop, ForceTask)
FORCE_CLOSED_LOOP = _with_inverse(_CLOSED_LOOP, MuscleClosedLoop, ForceTask)
FORCE_PROPORTIONAL_INTEGRAL = _without_inverse(ForceTask)
