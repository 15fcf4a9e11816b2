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

Model and thermal lag: Zhang and Yip, "Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles with
Application to Shape Memory Alloy Actuators", Robotics: Science and Systems, 2017; here "Zhang and Yip 2017".
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from bench.control.baselines import saturation
from bench.control.estimators import DisturbanceEstimator
from bench.control.loops import SHORTEST_WAIT
from bench.control.tracking import Command, ControllerBase, check_positive, widened
from bench.control.two_stage_inverse import TwoStageInverse, TwoStageInversion
from bench.controllers import ControllerSetup, ControllerSpec
from bench.errors import DataError
from bench.hysteresis import Reach, TwoStageState, _checks


@dataclass(frozen=True, slots=True)
class ThermalLag:
    """How the temperature of a wire follows its voltage, in terms of the voltage that would hold it.

    With the voltage v that would hold the present temperature, w = v² follows the square of the applied voltage
    V with one time constant, dw/dt = (V² - w) / tau (Zhang and Yip 2017, eqs. 1 and 2, where
    v² = d1 (T - T0) / d2), so that neither heating gain nor ambient temperature needs to be known.

    Parameters
    ----------
    time_constant : float
        tau, s.
    level : float
        w, V², at least 0.

    Raises
    ------
    ValueError
        If the time constant is not positive, the level negative, or either not finite.
    """

    time_constant: float = 5.0
    level: float = 0.0

    def __post_init__(self) -> None:
        check_positive(self, "time_constant")
        if not 0.0 <= self.level < math.inf:
            raise ValueError(f"level: expected a finite number of V², at least 0, got {self.level}")

    @property
    def voltage(self) -> float:
        """The constant voltage that would hold the present temperature, V."""
        return math.sqrt(self.level)

    def advance(self, duration: float, voltage: float) -> ThermalLag:
        """Return the lag after a time (s, at least 0) at a constant voltage, exactly.

        Raises ValueError if the duration is negative or a number is not finite.
        """
        if not 0.0 <= duration < math.inf:
            raise ValueError(f"duration: expected a finite number of s, at least 0, got {duration}")
        final = _checks.number("voltage", voltage) ** 2
        return replace(self, level=final + (self.level - final) * math.exp(-duration / self.time_constant))

    def lead(self, target: float, horizon: float, limits: tuple[float, float]) -> tuple[float, bool]:
        """Return the constant voltage that leads to a target within a time, and whether it had to be clipped.

        Parameters
        ----------
        target : float
            Wanted `voltage` at the end, V, at least 0.
        horizon : float
            Time until then, s; the voltage exceeds its steady value the more, the shorter it is.
        limits : tuple of float
            Least and greatest voltage, V, at least 0.

        Raises
        ------
        ValueError
            If the target is negative, the horizon not positive, the limits are not in order or negative, or a
            number is not finite.
        """
        if not 0.0 <= target < math.inf:
            raise ValueError(f"target: expected a finite number of V, at least 0, got {target}")
        if not 0.0 < horizon < math.inf:
            raise ValueError(f"horizon: expected a positive number of s, got {horizon}")
        low, high = limits
        if not 0.0 <= low <= high < math.inf:
            raise ValueError(f"limits: expected two finite numbers of V, at least 0 and in order, got {limits}")
        square = self.level + (target**2 - self.level) / -math.expm1(-horizon / self.time_constant)
        clipped = min(max(square, low**2), high**2)
        if clipped != square:
            return (low if square < low**2 else high), True
        return math.sqrt(square), False


@dataclass(frozen=True, eq=False)
class Task(ABC):
    """What is controlled, how the model sees it, and how good model and sensor are.

    Parameters
    ----------
    inverse : TwoStageInverse
        The model and its inverse.
    walk_variance, reading_variance : float
        As in `DisturbanceEstimator`, output units squared: the change of the model's error in one period, and the
        noise of one reading.
    slopes : tuple of float
        Range of slopes of the output over the voltage that are believed, see `MuscleClosedLoop`; output units per V,
        of one sign.

    Raises
    ------
    ValueError
        If a variance is not positive, or the slopes are not in order or of the wrong sign.
    """

    inverse: TwoStageInverse
    walk_variance: float
    reading_variance: float
    slopes: tuple[float, float]
    _sign: ClassVar[float]

    def __post_init__(self) -> None:
        check_positive(self, "walk_variance", "reading_variance")
        if min(self._sign * slope for slope in _checks.increasing("slopes", self.slopes).tolist()) <= 0.0:
            raise ValueError(
                f"slopes: expected {'positive' if self._sign > 0 else 'negative'} numbers, got {self.slopes}"
            )

    @abstractmethod
    def advance(self, state: TwoStageState, voltage: float, others: tuple[float, ...]) -> TwoStageState:
        """Return the model's state after it has come to a voltage, with further signals."""

    @abstractmethod
    def output(self, state: TwoStageState) -> float:
        """Return the model's output."""

    @abstractmethod
    def output_range(self) -> tuple[float, float]:
        """Return the range of the model's output."""

    @abstractmethod
    def invert(self, state: TwoStageState, target: float) -> TwoStageInversion:
        """Return what leads the model's output to a target."""


@dataclass(frozen=True, eq=False)
class LengthTask(Task):
    """The length at a measured force, which may change; the one further signal is that force.

    Noise of a load cell of some 0.02 N needs no dead band: the effect of its small reversals on the memory is
    estimated as disturbance, and the errors are the same without it. The default variances are 2e-2 mm² for each
    period, as the error of the model dominates, and noise of 0.01 mm beside rounding to 0.04 mm.
    """

    walk_variance: float = 2e-8
    reading_variance: float = 0.04e-3**2 / 12 + 0.01e-3**2
    slopes: tuple[float, float] = (-2e-3, -1e-3)
    _sign = -1.0

    def advance(self, state: TwoStageState, voltage: float, others: tuple[float, ...]) -> TwoStageState:
        """Return the model's state after force and voltage have come to new values, the force first.

        A missing force is replaced by the last one. Raises ValueError if there is not one further signal.
        """
        if len(others) != 1:
            raise ValueError(f"length task: expected the force as one further signal, got {len(others)}")
        low, high = widened(*self.inverse.model.second.input_range)
        force = others[0] if low <= others[0] <= high else state.force
        return self.inverse.model.step(state, voltage, force)[0]

    def output(self, state: TwoStageState) -> float:
        """Return the model's length."""
        return state.length

    def output_range(self) -> tuple[float, float]:
        """Return the range of the model's length."""
        return self.inverse.model.second.output_range()

    def invert(self, state: TwoStageState, target: float) -> TwoStageInversion:
        """Return what leads the model's length to a target at the present force."""
        return self.inverse.voltage_for_length(state, target)


@dataclass(frozen=True, eq=False)
class ForceTask(Task):
    """The force between fixed ends, without further signals; the default reading variance is for noise of 0.02 N."""

    walk_variance: float = 2e-2
    reading_variance: float = 4e-4
    slopes: tuple[float, float] = (5.0, 10.0)
    _sign = 1.0

    def advance(self, state: TwoStageState, voltage: float, others: tuple[float, ...]) -> TwoStageState:
        """Return the model's state after the voltage has come to a new value; the argument of H2 stays.

        Raises ValueError if there are further signals.
        """
        if others:
            raise ValueError(f"force task: expected no further signals, got {len(others)}")
        return self.inverse.model.move(state, voltage, state.argument)[0]

    def output(self, state: TwoStageState) -> float:
        """Return the model's force."""
        return state.force

    def output_range(self) -> tuple[float, float]:
        """Return the range of the model's force at the resting length."""
        return self.inverse.model.first.output_range()

    def invert(self, state: TwoStageState, target: float) -> TwoStageInversion:
        """Return what leads the model's force to a target."""
        return self.inverse.voltage_for_force(state, target)


@dataclass(frozen=True)
class InverseControlParameters:
    """Parameters of the controllers with a model."""

    time_constant: float = 5.0
    """Thermal time constant of the wire, s (Zhang and Yip 2017: about 5 s)."""
    horizon: float = 2.0
    """Time within which the closed loop would bring the wire to its new temperature, s. Twice the period makes up for
    more than half of the way in each, and leaves room for a time constant that is not quite right."""
    period: float = 1.0
    """Time between two readings, s."""
    duration: float = 20.0
    """Time for each target, s."""

    def __post_init__(self) -> None:
        check_positive(self)


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


class _Modelled(MuscleController):
    """Base of the controllers with a model: its memory, which follows the measured voltage, and the thermal lag."""

    def __init__(
        self,
        task: Task,
        state: TwoStageState | None = None,
        limits: tuple[float, float] | None = None,
        parameters: InverseControlParameters | None = None,
    ) -> None:
        self._parameters = p = parameters or InverseControlParameters()
        model = task.inverse.model
        super().__init__(model.first.input_range, limits, p.period, p.duration)
        self._task = task
        self._state = model.initial_state() if state is None else state
        self._lag = ThermalLag(p.time_constant, self._state.voltage**2)
        self._setpoint = self._clip(self._state.voltage)
        self._plausible_input = widened(*model.first.input_range)
        self._plausible_output = widened(*task.output_range())
        self._time: float | None = None

    @property
    def state(self) -> TwoStageState:
        """Memory of the wire as the controller knows it; its voltage is the one that would hold the temperature."""
        state: TwoStageState = self._state
        return state

    def _take_in(self, t: float, measured_input: float, output: float, others: tuple[float, ...]) -> None:  # noqa: ARG002
        low, high = self._plausible_input
        applied = measured_input if low <= measured_input <= high else self._setpoint
        if self._time is not None:
            self._lag = self._lag.advance(t - self._time, applied)
        self._time = t
        self._state = self._task.advance(self._state, self._lag.voltage, others)

    def _modelled(self) -> float:
        return self._task.output(self._state)

    def _steady(self, target: float) -> float:
        """Return the steady voltage for a target of the model within the limits; note whether it meets the target."""
        found = self._task.invert(self._state, target)
        voltage = self._clip(found.voltage)
        self._reach = found.reach
        if voltage != found.voltage:
            more = (found.voltage > voltage) == (self._task.slopes[0] > 0.0)
            self._reach = Reach.TOO_HIGH if more else Reach.TOO_LOW
        return voltage


class MuscleOpenLoop(_Modelled):
    """Set once for each target the steady voltage of the inverse, without feedback of the output.

    The memory follows the thermal lag, and in the length task the measured force.

    Parameters
    ----------
    task : LengthTask or ForceTask
        What is controlled.
    state : TwoStageState or None
        State of the wire at the first reading, whose voltage holds the temperature that it then has; default
        that after a reset.
    limits : tuple of float or None
        Least and greatest voltage, V, at least 0; default the range of the model.
    parameters : InverseControlParameters or None
        Of the controller; the horizon is not used.

    Raises
    ------
    ValueError
        If the limits do not increase, are negative or have nothing in common with the model's range.
    """

    def _decide(self, output: float, *, first: bool) -> float:  # noqa: ARG002
        return self._steady(self._reference) if first else self._setpoint


class MuscleClosedLoop(_Modelled):
    """Feedforward by the inverse, ahead of the thermal lag; feedback by an estimate of the disturbance.

    At each reading: from the measured voltage the thermal lag gives the steady voltage v of the present temperature,
    with which the model moves on. The disturbance, the measured output less the model's, goes through a Kalman
    filter. The inverse at target less disturbance gives the next v, and the lag the voltage that leads there. As
    temperature and disturbance are computed from measurements and nothing is summed up, nothing winds up while the
    voltage is at a limit.

    Each move of v is that of the inverse, but no more and no less than a slope of the output over v within
    `Task.slopes` would take for the present error. After a reversal a model with cells is flat over part of a cell
    where the wire is not, and elsewhere too steep. There the inverse alone would go to and fro across the flat part
    without end, or hardly correct at all.

    Parameters
    ----------
    task, state, limits, parameters
        As in `MuscleOpenLoop`.
    """

    def __init__(
        self,
        task: Task,
        state: TwoStageState | None = None,
        limits: tuple[float, float] | None = None,
        parameters: InverseControlParameters | None = None,
    ) -> None:
        super().__init__(task, state, limits, parameters)
        self._estimator: DisturbanceEstimator = DisturbanceEstimator(
            walk_variance=task.walk_variance, reading_variance=task.reading_variance
        )

    def _take_in(self, t: float, measured_input: float, output: float, others: tuple[float, ...]) -> None:
        super()._take_in(t, measured_input, output, others)
        low, high = self._plausible_output
        if low <= output <= high:
            self._estimator.update(output - self._modelled())

    def _decide(self, output: float, *, first: bool) -> float:  # noqa: ARG002
        wanted = self._reference - self._estimator.value
        present = self._lag.voltage
        error = wanted - self._modelled()
        least, greatest = sorted(error / slope for slope in self._task.slopes)
        move = min(max(self._steady(wanted) - present, least), greatest)
        return self._lag.lead(self._clip(present + move), self._parameters.horizon, self.limits)[0]


@dataclass(frozen=True)
class ProportionalIntegralParameters:
    """Parameters of the proportional-integral controller.

    Parameters
    ----------
    gain : float
        V² for one output unit of error; negative where the output falls with the voltage.
    integral_time : float
        Time in which a constant error adds as much as the proportional part gives, s.
    period : float
        Time between two readings, s.
    duration : float
        Time for each target, s.
    """

    gain: float
    integral_time: float = 4.0
    period: float = 1.0
    duration: float = 20.0

    def __post_init__(self) -> None:
        check_positive(self, "integral_time", "period", "duration")
        if not math.isfinite(self.gain) or self.gain == 0.0:
            raise ValueError(f"gain: expected a number other than 0, got {self.gain}")


class MuscleProportionalIntegral(MuscleController):
    """Proportional-integral control without a model, for comparison.

    It sets the square of the voltage, in which the temperature is linear, and moves that on from its present
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
        square = self._setpoint**2 + p.gain * (change + error * p.period / p.integral_time)
        self._reach = saturation(square, self._low**2, self._high**2, error)
        return math.sqrt(max(square, 0.0))


LENGTH_GAIN, FORCE_GAIN = -2500.0, 1.0
"""Gains of the proportional-integral control, V²/m and V²/N: the best that were found on the emulated SMA wire.

Its time constant is 5 s, and over 0 to 3 V it moves by 1.5 mm/V and pulls 3.8 N/V. The paper has no control.
"""


def _with_inverse(
    summary: str, controller: Callable[..., MuscleController], task: Callable[[TwoStageInverse], Task]
) -> ControllerSpec:
    def make(setup: ControllerSetup) -> MuscleController:
        try:
            inverse = TwoStageInverse(setup.model.model)
        except ValueError as error:
            raise DataError(f"the two-stage model has no inverse: {error}") from error
        parameters = InverseControlParameters(duration=setup.options["duration"])
        return controller(task(inverse), setup.state, setup.limits, parameters)

    return ControllerSpec(summary, make)


def _with_gain(gain: float) -> ControllerSpec:
    def make(setup: ControllerSetup) -> MuscleController:
        parameters = ProportionalIntegralParameters(gain, duration=setup.options["duration"])
        return MuscleProportionalIntegral(setup.limits, parameters)

    return ControllerSpec("proportional-integral control without a model, for comparison", make)


_OPEN_LOOP = "inverse of the two-stage model, without feedback"
_CLOSED_LOOP = "inverse of the two-stage model, with the disturbance estimated from the measured output"

LENGTH_OPEN_LOOP = _with_inverse(_OPEN_LOOP, MuscleOpenLoop, LengthTask)
LENGTH_CLOSED_LOOP = _with_inverse(_CLOSED_LOOP, MuscleClosedLoop, LengthTask)
LENGTH_PROPORTIONAL_INTEGRAL = _with_gain(LENGTH_GAIN)
FORCE_OPEN_LOOP = _with_inverse(_OPEN_LOOP, MuscleOpenLoop, ForceTask)
FORCE_CLOSED_LOOP = _with_inverse(_CLOSED_LOOP, MuscleClosedLoop, ForceTask)
FORCE_PROPORTIONAL_INTEGRAL = _with_gain(FORCE_GAIN)
