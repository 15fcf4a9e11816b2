"""Runs a protocol on a rig.

For each step: checks the set-points, sends them, ticks through the hold (telemetry, interlocks, faults), takes the
reading, writes the journal, and then notifies the observers. However the run ends, every device is brought into its
safe state, each independently; the outcome is recorded.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from bench.base import (
    AbortError,
    BenchError,
    ConfigurationError,
    ConvergenceError,
    DeviceError,
    InterlockError,
    Interrupts,
    LimitError,
    Pace,
    PacedClock,
    SettleTimeoutError,
)
from bench.control import Command, DriftEstimator, LimitCycleWatch, agility_for
from bench.devices import Arrived, Dwell, Settle, Settled, UntilSteady
from bench.execution import fixed_rate, manual as by_hand
from bench.execution.notify import Notifier
from bench.execution.resumption.interrupted import Interrupted
from bench.execution.resumption.repriming import reprime
from bench.execution.run_at_hand import NOT_AT_WORK, Observer, RunAtHand, RunRecord, traced
from bench.execution.station.interface import Station
from bench.operator import AT_A_PROMPT, NOBODY, RESUME, Question
from bench.protocol import (
    EXPECTED,
    PARAMETER,
    PROMPT,
    ByHand,
    Caution,
    Control,
    FixedRate,
    KeptModel,
    Message,
    Note,
    OpenParameters,
    ParameterChange,
    Phase,
    Plan,
    Prompt,
    ProtocolDefinition,
    ProtocolParameters,
    Reading,
    Step,
)
from bench.record import Lateness
from bench.rig import SAFE, Look, RigDescription


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes
    ----------
    status : str
        `completed`, `aborted` or `failed`.
    reason : str
        Why, when it was not completed.
    steps : int
        Number of finished steps.
    laboratory_seconds : float
        Laboratory time from the start to the safe state.
    own_seconds : float
        The part of it that passed in this process: of a run that is resumed, from there on.
    safe_state : mapping of str to str
        By device: `safe`, or what went wrong.
    error : Exception or None
        What ended the run, when it was not completed.
    pace : Pace or None
        How fast the run went, on a paced clock.
    lateness : mapping of str to mapping
        How late the samples of loops were, by label; see `bench.record.lateness`.
    """

    status: str
    reason: str
    steps: int
    laboratory_seconds: float
    own_seconds: float
    safe_state: Mapping[str, str]
    error: Exception | None
    pace: Pace | None = None
    lateness: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_safe(self) -> bool:
        """Whether every device reached its safe state."""
        return all(state == SAFE for state in self.safe_state.values())


class Engine:
    """Carries protocols out at a station.

    Parameters
    ----------
    station, journal, observers, interrupts, ask, zero, messages
        As of `RunAtHand`.
    changes : iterable of ParameterChange
        Parameters that the run which is repeated had changed, in their order.
    """

    def __init__(
        self,
        station: Station,
        journal: RunRecord,
        observers: Iterable[Observer],
        interrupts: Interrupts,
        ask: Callable[[Question], str] | None = None,
        zero: float | None = None,
        messages: Notifier | None = None,
        changes: Iterable[ParameterChange] = (),
    ) -> None:
        self._station = station
        self._clock = station.clock
        self._journal = journal
        self._interrupts = interrupts
        self._run = RunAtHand(station, journal, observers, interrupts, ask, zero, messages)
        self._changes = deque(changes)
        self._began = self._run.zero
        """Time of the clock at which this process has begun with the run, s."""
        self._patience = station.description.file.safety.patience
        self._work: dict[type[Message], Callable[[Any], Reading]] = {
            Step: self._step,
            Control: self._control,
            FixedRate: partial(fixed_rate.carry_out, self._run),
            Prompt: self._prompt,
            ByHand: partial(by_hand.carry_out, self._run),
        }

    def warn(self, warnings: Iterable[str]) -> None:
        """Record what was accepted at the start only as an operator is present."""
        for text in warnings:
            self._run.event("WARN", "start", text)

    def run(
        self, definition: ProtocolDefinition, parameters: ProtocolParameters, past: Interrupted | None = None
    ) -> Outcome:
        """Carry a protocol out, from its first step to the safe state; return how it ended, with its exception.

        With a past it goes on where its record ends, once the specimen is back where it was.
        """
        if past is not None:
            self._run.zero = past.zero
        self._clock.interrupted = self._interrupts.abort_requested
        if isinstance(self._clock, PacedClock):
            self._clock.restart_pace()
        # What was before the run does not concern it.
        self._clock.suspension(), self._clock.parting()
        error: Exception | None = None
        self._began = self._run.zero if past is None else self._clock.now()
        try:
            self._carry_out(definition, parameters, past)
        # Every exit path leads through the safe state and the end of the record, after any exception.
        except Exception as caught:
            error = caught
        except BaseException as caught:
            error = AbortError(f"ended by {type(caught).__name__}, which the protocol raised")
            error.__cause__ = caught
        finally:
            self._interrupts.acknowledge()
            self._clock.interrupted = lambda: False
            safe_state = self._station.end()
        return self._finish(error, safe_state)

    def _carry_out(
        self, definition: ProtocolDefinition, parameters: ProtocolParameters, past: Interrupted | None
    ) -> None:
        run = self._run
        if past is not None:
            run.phase, run.steps = past.fed.phase, past.fed.next_step
        run.judge(self._clock.now(), self._station.look(Look.GLANCE))
        slots = self._station.description.slots(definition)
        messages = definition.start(parameters, slots) if past is None else past.fed.messages
        run.parameters = OpenParameters(definition, parameters, self._station.description.file.roles)
        waiting = None if past is None else past.fed.message
        reading: Reading | None = None
        try:
            if past is not None and waiting is not None:
                run.expect_ticks("the specimen is brought back")
                reprime(run, past, self._settle_or_raise)
            while True:
                self._station.promise(self._patience, "the protocol computes")
                while self._changes and self._changes[0].step < run.steps:
                    change = self._changes.popleft()
                    definition.change(parameters, change.name, change.value)
                    run.event("WARN", PARAMETER, str(change))
                try:
                    # The first `send` of a generator has to be that of None.
                    message = waiting or messages.send(reading)  # type: ignore[arg-type]
                except StopIteration:
                    return
                run.raise_if_aborted()
                waiting, reading = None, None
                if past is not None:
                    past.fed.check_fresh(message)
                if isinstance(message, Phase):
                    run.phase = message.name
                    run.event("INFO", "phase", message.name)
                elif isinstance(message, Note):
                    run.event("WARN" if isinstance(message, Caution) else "INFO", "note", message.text)
                    if isinstance(message, KeptModel):
                        run.keep_model(message.name, message.content)
                elif type(message) in self._work:
                    run.pause_if_asked()
                    run.expect_ticks("a step is carried out")
                    reading = self._work[type(message)](message)
                else:
                    raise ConfigurationError(f"protocol {definition.name} yielded {message!r}; {EXPECTED}")
        finally:
            # What a protocol does or raises while it is closed must not hide why the run ends.
            with suppress(Exception):
                messages.close()

    def _settle_or_raise(self, settle: Settle) -> None:
        failure = self._settle(settle, self._clock.now())[1]
        if failure is not None:
            raise failure

    def _step(self, step: Step) -> Reading:
        if isinstance(step.settle, UntilSteady):
            self._run.check_signals(step.settle.signal)
        started = self._clock.now()
        self._station.apply(step.setpoints)
        return self._settle_and_read(step.settle, started, started, step.label, step.setpoints)

    def _settle_and_read(
        self, settle: Settle, since: float, started: float, label: str, setpoints: Mapping[str, float]
    ) -> Reading:
        """Settle from `since` on, take the reading and record it, also that of a rule that was not met."""
        settled, failure = self._settle(settle, since)
        reading = self._run.measure_step(started, label, setpoints, settled)
        if failure is not None:
            raise failure
        return reading

    def _control(self, message: Control) -> Reading:
        run = self._run
        wanted = (message.drive, message.response, *message.others)
        run.check_signals(*wanted)
        limits = self._station.description.limits_of(message.actuator)
        low, high = message.limits or (limits.low, limits.high)
        # Before the controller asks for any of them.
        self._station.check({message.actuator: (low, high)})
        started = self._clock.now()
        latest = started + message.timeout
        command: Command | None = None
        watch = LimitCycleWatch(low, high)
        seen: list[float] = []
        lateness = Lateness(None)
        due: float | None = None
        try:
            while True:
                paused = run.pause_if_asked()
                latest += paused
                asked = self._clock.now()
                if due is not None and not paused:
                    lateness.add(asked - due)
                values = run.look(Look.SAMPLE, wanted)
                now = self._clock.now()
                ask = message.task.begin if command is None else message.task.update
                # As it is recorded, so that a resumed run can repeat it to the last bit.
                passed = now - run.zero
                command = ask(passed, *(values[name] for name in wanted))
                trace = message.task.trace
                run.trace = traced(trace)
                values |= run.trace
                run.record_tick(now, values)
                seen.append(passed)
                if command.done:
                    setpoints = {message.actuator: command.setpoint}
                    return run.finish_step(started, message.label, setpoints, values, Settled.CONTROLLED, seen)
                if not low <= command.setpoint <= high:
                    raise LimitError(
                        message.actuator, f"the controller asked for {command.setpoint:g}, beyond {low:g} to {high:g}"
                    )
                if watch.note(command.setpoint, trace.reference):
                    raise ConvergenceError(
                        f"the controller of {message.response} does not converge: within {now - started:.1f} s it "
                        f"sent {message.actuator} {watch.swings} times from one end of its range ({low:g} to "
                        f"{high:g} {limits.unit}) to the other, with a reference that stands at {trace.reference:g} "
                        f"{self._station.description.unit(message.response)}; tune it for "
                        "this specimen, or use another controller"
                    )
                if command.setpoint != self._station.setpoint(message.actuator):
                    self._station.apply({message.actuator: command.setpoint})
                if not command.wait > 0:
                    raise ConfigurationError(f"the controller of {message.response} asked to wait {command.wait} s")
                # From reading to reading: the wait includes the time of the reading.
                end = asked + command.wait
                if end > latest:
                    raise SettleTimeoutError(
                        f"{message.response} did not reach its reference {trace.reference:g} "
                        f"within {message.timeout:g} s"
                    )
                run.hold_until(end, asked)
                due = end
        finally:
            run.trace = NOT_AT_WORK
            if lateness.samples:
                run.keep_lateness(message.label, lateness)

    def _prompt(self, message: Prompt) -> Reading:
        run = self._run
        run.event("INFO", "prompt", message.text)
        started = self._clock.now()
        if self._station.has_operator:
            self._station.operate(message.task, message.value)
        else:
            question = Question(message.text, AT_A_PROMPT, "BY HAND")
            answer = NOBODY if run.ask is None else run.await_answer(run.ask, question)
            if answer == NOBODY:
                raise AbortError(f"no operator is present to do it: {message.text}")
            if answer != RESUME:
                raise AbortError("ended by the operator at a prompt")
        # Kept in any case: it shows what was wrong.
        self._station.apply({})
        reading = self._settle_and_read(message.settle, self._clock.now(), started, PROMPT, {})
        value = reading[message.signal]
        if not message.low <= value <= message.high:
            unit = self._station.description.unit(message.signal)
            raise DeviceError(
                message.signal,
                f"reads {value:.4g} {unit} after the prompt to {message.text[:1].lower()}{message.text[1:]}; "
                f"expected {message.low:g} to {message.high:g} {unit}. Was it done?",
            )
        return reading

    def _settle(self, settle: Settle, started: float) -> tuple[Settled, Exception | None]:
        """Let the rig settle; return how, and what to raise once the reading is recorded."""
        run = self._run
        if isinstance(settle, Dwell):
            run.hold_until(started + settle.seconds, started)
            return Settled.DWELL, None
        if isinstance(settle, Arrived):
            return self._await_arrival(settle, started)
        agility = agility_for(drift=settle.drift, noise=settle.noise, period=run.period)
        estimator = DriftEstimator(noise=settle.noise, agility=agility)
        earliest, latest = started + settle.minimum, started + settle.timeout
        while True:
            run.sleep_until(min(self._clock.now() + run.period, latest))
            values = run.tick()
            latest += run.pause_if_asked()
            now = self._clock.now()
            value = values[settle.signal]
            if not math.isfinite(value):
                raise DeviceError(settle.signal, f"reads {value}, so it cannot become steady")
            estimator.update(now, value)
            if now >= earliest and estimator.is_steady(settle.drift):
                return Settled.STEADY, None
            if now >= latest:
                unit = self._station.description.unit(settle.signal)
                return Settled.NOT_STEADY, SettleTimeoutError(
                    f"{settle.signal} is not steady after {settle.timeout:g} s: it drifts by {estimator.drift:.3g} ± "
                    f"{estimator.uncertainty:.2g} {unit}/s, and {settle.drift:g} {unit}/s is allowed"
                )

    def _await_arrival(self, settle: Arrived, started: float) -> tuple[Settled, Exception | None]:
        run = self._run
        latest = started + settle.timeout
        run.hold_until(started + settle.minimum, started)
        while True:
            arrivals = self._station.arrivals()
            if arrivals.error is not None:
                return Settled.NOT_ARRIVED, arrivals.error
            if not arrivals.waiting:
                return Settled.ARRIVED, None
            if self._clock.now() >= latest:
                names = ", ".join(arrivals.waiting)
                return Settled.NOT_ARRIVED, SettleTimeoutError(f"{names} did not arrive within {settle.timeout:g} s")
            run.sleep_until(min(self._clock.now() + run.period, latest))
            run.tick()
            latest += run.pause_if_asked()

    def _finish(self, error: Exception | None, safe_state: Mapping[str, str]) -> Outcome:
        if error is None:
            status, reason = "completed", ""
        elif isinstance(error, AbortError):
            status, reason = "aborted", str(error)
        else:
            status = "failed"
            reason = str(error) if isinstance(error, BenchError) else f"{type(error).__name__}: {error}"
        now = self._clock.now()
        finished, own = now - self._run.zero, now - self._began
        late = {label: each.to_json() for label, each in self._run.lateness.items()}
        pace = self._clock.pace() if isinstance(self._clock, PacedClock) else None
        try:
            self._run.take_news()
            if error is not None:
                self._run.event("ERROR", "interlock" if isinstance(error, InterlockError) else "error", reason)
            for name, state in safe_state.items():
                ok = state == SAFE
                self._run.event("INFO" if ok else "ERROR", "safe-state", f"{name}: {state}")
            if pace is not None:
                self._run.event("INFO", "clock", str(pace))
            is_well = error is None and all(state == SAFE for state in safe_state.values())
            self._run.event("INFO" if is_well else "WARN", "end", status)
            self._run.finish_messages()
            self._journal.finish(
                status=status, reason=reason, finished=finished, safe_state=safe_state, lateness=late
            )
        # A full disk must not hide whether the devices are safe.
        except Exception as failure:
            why = f"the journal could not be finished: {failure}"
            status, reason, error = "failed", f"{reason}; {why}" if reason else why, error or failure
        return Outcome(status, reason, self._run.steps, finished, own, safe_state, error, pace, late)


def check_before_moving(description: RigDescription, definition: ProtocolDefinition, expected: Plan) -> None:
    """Check the plan of a run against the rig's devices and limits.

    Raises ConfigurationError if the rig lacks something, or a set-point would leave a device's limits; nothing has
    moved.
    """
    rig = description.file.name
    description.check_needs(definition.name, definition.names)
    description.check_needs(definition.name, sorted(expected.watched))
    for device, (low, high) in expected.extremes.items():
        limits = description.limits.get(device)
        if limits is None:
            raise ConfigurationError(f"protocol {definition.name} sets {device}, which rig {rig} cannot set")
        if not (low in limits and high in limits):
            raise ConfigurationError(
                f"protocol {definition.name} would set {device} to between {low:g} and {high:g} {limits.unit}; "
                f"rig {rig} allows {limits}"
            )
