"""Runs a protocol on a rig.

For each step: checks the set-points, sends them, ticks through the hold (telemetry, interlocks, faults), takes the
reading, writes the journal, and then notifies the observers. However the run ends, every device is brought into its
safe state, each independently; the outcome is recorded.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from bench.clock import Pace, PacedClock
from bench.control.estimators import DriftEstimator, agility_for
from bench.control.loops import BlockController, Floats, SampledController
from bench.control.tracking import Command, Trace
from bench.devices import Actuator, Status
from bench.errors import (
    AbortError,
    BenchError,
    ConfigurationError,
    DeviceError,
    InterlockError,
    LimitError,
    SettleTimeoutError,
)
from bench.interlocks import InterlockWatch
from bench.interrupts import Interrupts
from bench.journal import Event, Journal, StepRecord
from bench.protocol.parameters import ProtocolDefinition, ProtocolParameters
from bench.protocol.plan import EXPECTED, Plan
from bench.protocol.vocabulary import (
    LATENESS,
    TRACES,
    Control,
    FixedRate,
    Message,
    Note,
    Phase,
    Prompt,
    Reading,
    Step,
)
from bench.rig import Rig
from bench.safety import SAFE, make_safe
from bench.settling import Arrived, Dwell, Settle, Settled, UntilSteady

TRACE_NAMES = tuple(signal.name for signal in TRACES)
_NOT_AT_WORK = dict.fromkeys((*TRACE_NAMES, LATENESS.name), math.nan)

RESUME = "resume"
ABORT = "abort"

PROMPT = "prompt"
"""Label of the reading that follows a prompt."""


class Observer(Protocol):
    """Watches a run: the dashboard, the progress display. No method may block; an observer that raises is dropped."""

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """See one tick of a hold; `values` in the order of the rig's signals."""

    def step(self, record: StepRecord) -> None:
        """See a finished step."""

    def event(self, event: Event) -> None:
        """See something that happened."""


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
    safe_state : mapping of str to str
        By device: `safe`, or what went wrong.
    error : Exception or None
        What ended the run, when it was not completed.
    pace : Pace or None
        How fast the run went, on a paced clock.
    """

    status: str
    reason: str
    steps: int
    laboratory_seconds: float
    safe_state: Mapping[str, str]
    error: Exception | None
    pace: Pace | None = None

    @property
    def is_safe(self) -> bool:
        """Whether every device reached its safe state."""
        return all(state == SAFE for state in self.safe_state.values())


class Engine:
    """Carries protocols out on a rig.

    Parameters
    ----------
    rig : Rig
        Connected devices.
    journal : Journal
        Written before any observer is notified.
    observers : iterable of Observer
        Notified after the journal.
    interrupts : Interrupts
        What the operator and the system ask for.
    ask : callable, optional
        Asks the operator a question, and returns `resume` or `abort`. Without it a pause or a prompt aborts the run.
    """

    def __init__(
        self,
        rig: Rig,
        journal: Journal,
        observers: Iterable[Observer],
        interrupts: Interrupts,
        ask: Callable[[str], str] | None = None,
    ) -> None:
        self._rig = rig
        self._clock = rig.clock
        self._journal = journal
        self._observers = tuple(observers)
        self._interrupts = interrupts
        self._ask = ask
        self._names = tuple(signal.name for signal in journal.signals)
        self._trace = _NOT_AT_WORK
        self._period = rig.file.telemetry.period
        self._watch = InterlockWatch(rig.file.interlocks, {signal.name: signal.unit for signal in rig.signals})
        self._phase = ""
        self._steps = 0
        self._work: dict[type[Message], Callable[[Any], Reading]] = {
            Step: self._step,
            Control: self._control,
            FixedRate: self._fixed_rate,
            Prompt: self._prompt,
        }

    def run(self, definition: ProtocolDefinition, parameters: ProtocolParameters) -> Outcome:
        """Carry a protocol out, from its first step to the safe state; return how it ended, with its exception."""
        start = self._clock.now()
        self._clock.interrupted = self._interrupts.abort_requested
        if isinstance(self._clock, PacedClock):
            self._clock.restart_pace()
        self._clock.suspension()  # what was before the run does not concern it
        error: Exception | None = None
        try:
            self._carry_out(definition, parameters)
        # Every exit path leads through the safe state, after any exception.
        except Exception as caught:
            error = caught
        finally:
            # Also on its way out with something that is not an Exception.
            self._clock.interrupted = lambda: False
            safe_state = make_safe(self._rig.devices.values())
        return self._finish(error, start, safe_state)

    def _carry_out(self, definition: ProtocolDefinition, parameters: ProtocolParameters) -> None:
        self._watch.check(self._clock.now(), self._rig.glance())
        messages = definition.start(parameters, self._rig.slots(definition))
        reading: Reading | None = None
        try:
            while True:
                try:
                    # The first `send` of a generator has to be that of None.
                    message = messages.send(reading)  # type: ignore[arg-type]
                except StopIteration:
                    return
                self._raise_if_aborted()
                reading = None
                if isinstance(message, Phase):
                    self._phase = message.name
                    self._event("INFO", "phase", message.name)
                elif isinstance(message, Note):
                    self._event("INFO", "note", message.text)
                elif type(message) in self._work:
                    self._pause_if_asked()
                    reading = self._work[type(message)](message)
                else:
                    raise ConfigurationError(f"protocol {definition.name} yielded {message!r}; {EXPECTED}")
        finally:
            # What a protocol does or raises while it is closed must not hide why the run ends.
            with suppress(Exception):
                messages.close()

    def _step(self, step: Step) -> Reading:
        if isinstance(step.settle, UntilSteady):
            self._check_signals(step.settle.signal)
        started = self._clock.now()
        statuses = self._send(step.setpoints)
        return self._settle_and_read(step.settle, statuses, started, started, step.label, step.setpoints)

    def _settle_and_read(
        self,
        settle: Settle,
        statuses: Sequence[Status],
        since: float,
        started: float,
        label: str,
        setpoints: Mapping[str, float],
    ) -> Reading:
        """Settle from `since` on, take the reading and record it, also that of a rule that was not met."""
        settled, failure = self._settle(settle, statuses, since)
        values = self._values(self._rig.measure)
        self._watch.check(self._clock.now(), values)
        reading = self._finish_step(started, label, setpoints, values, settled)
        if failure is not None:
            raise failure
        return reading

    def _control(self, message: Control) -> Reading:
        wanted = (message.drive, message.response, *message.others)
        self._check_signals(*wanted)
        actuator = self._actuator(message.actuator)
        started = self._clock.now()
        latest = started + message.timeout
        low, high = message.limits or (actuator.limits.low, actuator.limits.high)
        command: Command | None = None
        try:
            while True:
                asked = self._clock.now()
                values = self._values(lambda: self._rig.sample(wanted))
                now = self._clock.now()
                ask = message.task.begin if command is None else message.task.update
                command = ask(now, *(values[name] for name in wanted))
                trace = message.task.trace
                self._trace = _traced(trace)
                values |= self._trace
                self._record_tick(now, values)
                if command.done:
                    setpoints = {message.actuator: command.setpoint}
                    return self._finish_step(started, message.label, setpoints, values, Settled.CONTROLLED)
                if not low <= command.setpoint <= high:
                    raise LimitError(
                        message.actuator, f"the controller asked for {command.setpoint:g}, beyond {low:g} to {high:g}"
                    )
                if command.setpoint != actuator.setpoint:
                    self._send({message.actuator: command.setpoint})
                if not command.wait > 0:
                    raise ConfigurationError(f"the controller of {message.response} asked to wait {command.wait} s")
                # From reading to reading: the wait includes the time of the reading.
                end = asked + command.wait
                if end > latest:
                    raise SettleTimeoutError(
                        f"{message.response} did not reach its reference {trace.reference:g} "
                        f"within {message.timeout:g} s"
                    )
                self._hold_until(end, asked)
        finally:
            self._trace = _NOT_AT_WORK

    def _fixed_rate(self, message: FixedRate) -> Reading:
        if message.block:
            return self._blocks(message)
        assert isinstance(message.controller, SampledController)
        self._check_signals(*message.inputs, *message.watched)
        actuators = [self._actuator(name) for name in message.actuators]
        setpoints = [f"{name}_setpoint" for name in message.actuators]
        read = self._rig.quick_reader((*message.inputs, *message.watched))
        update, inputs = message.controller.update, message.inputs
        period, samples = 1.0 / message.rate, max(1, round(message.duration * message.rate))
        started = self._clock.now()
        values = self._tick()
        start = self._clock.now()
        next_tick = start + self._period
        k = taken = 0
        lateness = latest = 0.0
        try:
            while True:
                due = start + k * period
                # Between the samples of a slow loop interlocks and watchdogs do not wait for the next one.
                while period > self._period and next_tick < due - 1e-6 * self._period:
                    self._sleep_until(next_tick)
                    values = self._tick()
                    next_tick = self._tick_after(next_tick)
                self._sleep_until(due)
                if k == samples:
                    break
                now = self._clock.now()
                values.update(read())
                commands = update(now - start, tuple([values[name] for name in inputs]))
                if len(commands) != len(actuators):
                    raise ConfigurationError(
                        f"the controller of {', '.join(message.actuators)} gave {len(commands)} set-points; "
                        f"expected {len(actuators)}"
                    )
                for name, (low, high), command in zip(message.actuators, message.limits, commands, strict=False):
                    if not low <= command <= high:
                        raise LimitError(name, f"the controller asked for {command:g}, beyond {low:g} to {high:g}")
                changed = [
                    (actuator, command)
                    for actuator, command in zip(actuators, commands, strict=False)
                    if command != actuator.setpoint
                ]
                # None is sent when another is wrong.
                if len(changed) > 1:
                    for actuator, command in changed:
                        actuator.check(command)
                for actuator, command in changed:
                    actuator.set(command)
                values.update(zip(setpoints, commands, strict=False))
                late = now - due
                if late > 0:
                    lateness, latest = lateness + late, max(latest, late)
                if taken % message.record_every == 0:
                    # Without the lateness, which tells the samples from the ticks.
                    self._trace = _traced(message.controller.trace)
                    values.update(self._trace)
                    values[LATENESS.name] = late
                    self._record_tick(now, values)
                taken += 1
                if now >= next_tick:
                    # Everything else: what its watchdogs wait for, and what interlocks look at.
                    values = self._values(self._rig.glance)
                    self._watch.check(self._clock.now(), values)
                    next_tick = self._tick_after(next_tick)
                k += 1
                if (reached := math.floor((self._clock.now() - start) / period)) > k:
                    k = min(samples, reached)
        finally:
            self._trace = _NOT_AT_WORK
        return self._finish_loop(message, started, taken, (lateness, latest), commands)

    def _blocks(self, message: FixedRate) -> Reading:
        """Carry a fixed rate out block by block; see `FixedRate.block`."""
        self._check_signals(*message.inputs, *message.watched)
        actuators = [self._actuator(name) for name in message.actuators]
        setpoints = [f"{name}_setpoint" for name in message.actuators]
        signals = (*message.inputs, *message.watched)
        period, samples = 1.0 / message.rate, max(1, round(message.duration * message.rate))
        controller = message.controller
        assert isinstance(controller, BlockController)
        if message.block * period > self._period:
            raise ConfigurationError(
                f"a block of {message.block} samples takes {message.block * period:g} s; interlocks wait for its "
                f"end, so {self._period:g} s, the telemetry period, is allowed at most"
            )
        play = self._rig.block_player(signals, message.actuators, period)
        started = self._clock.now()
        values = self._tick()
        start = self._clock.now()
        next_tick = start + self._period
        readings: Floats = np.empty((0, len(signals)))
        k = taken = 0
        lateness = latest = 0.0
        try:
            while True:
                due = start + k * period
                self._sleep_until(due)
                if k == samples:
                    break
                now = self._clock.now()
                count = min(message.block, samples - k)
                out: Floats = np.full((count, len(actuators)), math.nan)
                times = (np.arange(k, k + count) * period).astype(np.float64)
                controller.step_block(times, readings[:, : len(message.inputs)], out)
                self._check_block(message, out)
                late = now - due
                readings = play(out) if play is not None else self._sampled(signals, actuators, out, start + times)
                lateness, latest = lateness + count * late, max(latest, late)
                self._trace = _traced(controller.trace)
                for each in range(-taken % message.record_every, count, message.record_every):
                    values.update(self._trace)
                    values.update(zip(signals, readings[each].tolist(), strict=True))
                    values.update(zip(setpoints, out[each].tolist(), strict=True))
                    values[LATENESS.name] = late
                    self._record_tick(float(start + times[each]) + late, values)
                taken += count
                now = self._clock.now()
                if now >= next_tick:
                    values = self._values(self._rig.glance)
                    self._watch.check(now, values)
                    next_tick = self._tick_after(next_tick)
                k = min(samples, max(k + count, math.floor((now - start) / period)))
        finally:
            self._trace = _NOT_AT_WORK
        return self._finish_loop(message, started, taken, (lateness, latest), out[-1].tolist())

    @staticmethod
    def _check_block(message: FixedRate, out: Floats) -> None:
        """Raise `LimitError` unless all set-points of a block are within the limits of the loop."""
        for name, (low, high), column in zip(message.actuators, message.limits, out.T, strict=False):
            if not (allowed := (low <= column) & (column <= high)).all():
                wrong = column[~allowed][0]
                raise LimitError(name, f"the controller asked for {wrong:g}, beyond {low:g} to {high:g}")

    def _sampled(
        self, signals: Sequence[str], actuators: Sequence[Actuator], out: Floats, instants: Floats
    ) -> Floats:
        """Take the samples of a block one by one, as an instrument does that can by itself."""
        # None is sent when another is wrong.
        for actuator, column in zip(actuators, out.T, strict=True):
            for command in column.tolist():
                actuator.check(command)
        read = self._rig.quick_reader(signals)
        rows = []
        for instant, commands in zip(instants.tolist(), out.tolist(), strict=True):
            self._sleep_until(instant)
            values = read()
            rows.append([values[name] for name in signals])
            for actuator, command in zip(actuators, commands, strict=True):
                if command != actuator.setpoint:
                    actuator.set(command)
        return np.array(rows).reshape(len(out), len(signals))

    def _finish_loop(
        self,
        message: FixedRate,
        started: float,
        taken: int,
        lateness: tuple[float, float],
        commands: Sequence[float],
    ) -> Reading:
        """Tell how a loop went, of which the sum and the largest of all lateness are known, and take the reading."""
        samples = max(1, round(message.duration * message.rate))
        total, latest = lateness
        self._event(
            "INFO",
            "loop",
            f"{taken} samples at {message.rate:g} Hz, {samples - taken} left out; late by "
            f"{1e3 * total / taken:.3g} ms on average, {1e3 * latest:.3g} ms at most",
        )
        values = self._values(self._rig.measure)
        self._watch.check(self._clock.now(), values)
        sent = dict(zip(message.actuators, commands, strict=True))
        return self._finish_step(started, message.label, sent, values, Settled.CONTROLLED)

    def _prompt(self, message: Prompt) -> Reading:
        self._event("INFO", "prompt", message.text)
        started = self._clock.now()
        if self._rig.laboratory is not None:
            self._rig.laboratory.operate(message.task, message.value)
        elif self._ask is None:
            raise AbortError(f"no operator is present to do it: {message.text}")
        elif self._await_answer(self._ask, f"{message.text}; then") != RESUME:
            raise AbortError("ended by the operator at a prompt")
        # Kept in any case: it shows what was wrong.
        reading = self._settle_and_read(message.settle, (), self._clock.now(), started, PROMPT, {})
        value = reading[message.signal]
        if not message.low <= value <= message.high:
            unit = next(signal.unit for signal in self._rig.signals if signal.name == message.signal)
            raise DeviceError(
                message.signal,
                f"reads {value:.4g} {unit} after the prompt to {message.text[:1].lower()}{message.text[1:]}; "
                f"expected {message.low:g} to {message.high:g} {unit}. Was it done?",
            )
        return reading

    def _finish_step(
        self,
        started: float,
        label: str,
        setpoints: Mapping[str, float],
        values: Mapping[str, float],
        settled: Settled,
    ) -> Reading:
        finished = self._clock.now()
        record = StepRecord(
            step=self._steps,
            started=started,
            finished=finished,
            phase=self._phase,
            label=label,
            settled=settled,
            setpoints=setpoints,
            values=tuple(values[name] for name in self._names),
        )
        self._journal.step(record)
        self._steps += 1
        self._tell(lambda observer: observer.step(record))
        return Reading(record.step, finished, record.settled, values)

    def _check_signals(self, *names: str) -> None:
        for name in names:
            if name not in self._names:
                raise ConfigurationError(f"{name} is not a signal of this rig; there are: {', '.join(self._names)}")

    def _actuator(self, name: str) -> Actuator:
        actuators = self._rig.actuators
        if name not in actuators:
            known = ", ".join(actuators) or "none"
            raise ConfigurationError(f"{name} is not a device that takes a set-point; there are: {known}")
        return actuators[name]

    def _send(self, setpoints: Mapping[str, float]) -> list[Status]:
        actuators = {name: self._actuator(name) for name in setpoints}
        for name, value in setpoints.items():
            actuators[name].check(value)
        return [actuators[name].set(value) for name, value in setpoints.items()]

    def _settle(self, settle: Settle, statuses: Sequence[Status], started: float) -> tuple[Settled, Exception | None]:
        """Let the rig settle; return how, and what to raise once the reading is recorded."""
        if isinstance(settle, Dwell):
            self._hold_until(started + settle.seconds, started)
            return Settled.DWELL, None
        if isinstance(settle, Arrived):
            return self._await_arrival(settle, statuses, started)
        agility = agility_for(drift=settle.drift, noise=settle.noise, period=self._period)
        estimator = DriftEstimator(noise=settle.noise, agility=agility)
        earliest, latest = started + settle.minimum, started + settle.timeout
        while True:
            self._sleep_until(min(self._clock.now() + self._period, latest))
            values = self._tick()
            now = self._clock.now()
            value = values[settle.signal]
            if not math.isfinite(value):
                raise DeviceError(settle.signal, f"reads {value}, so it cannot become steady")
            estimator.update(now, value)
            if now >= earliest and estimator.is_steady(settle.drift):
                return Settled.STEADY, None
            if now >= latest:
                unit = next(signal.unit for signal in self._rig.signals if signal.name == settle.signal)
                return Settled.NOT_STEADY, SettleTimeoutError(
                    f"{settle.signal} is not steady after {settle.timeout:g} s: it drifts by {estimator.drift:.3g} ± "
                    f"{estimator.uncertainty:.2g} {unit}/s, and {settle.drift:g} {unit}/s is allowed"
                )

    def _await_arrival(
        self, settle: Arrived, statuses: Sequence[Status], started: float
    ) -> tuple[Settled, Exception | None]:
        latest = started + settle.timeout
        self._hold_until(started + settle.minimum, started)
        while True:
            waiting = [status for status in statuses if not status.update()]
            for status in statuses:
                if isinstance(error := status.exception(), Exception):
                    return Settled.NOT_ARRIVED, error
            if not waiting:
                return Settled.ARRIVED, None
            if self._clock.now() >= latest:
                names = ", ".join(status.device for status in waiting)
                return Settled.NOT_ARRIVED, SettleTimeoutError(f"{names} did not arrive within {settle.timeout:g} s")
            self._sleep_until(min(self._clock.now() + self._period, latest))
            self._tick()

    def _hold_until(self, end: float, started: float) -> None:
        tick = 1
        # No tick closer to the end than rounding could bring it: the reading follows there.
        while (instant := started + tick * self._period) < end - 1e-6 * self._period:
            self._sleep_until(instant)
            self._tick()
            tick += 1
        self._sleep_until(end)

    def _sleep_until(self, instant: float) -> None:
        self._raise_if_aborted()
        self._clock.sleep_until(instant)
        self._raise_if_aborted()
        if (seconds := self._clock.suspension()) > 0:
            # The next reading finds what the watchdogs have done meanwhile.
            self._event(
                "WARN",
                "suspended",
                f"the machine was suspended for {seconds:.0f} s: the set-points stood, nothing was recorded, and "
                "watchdogs may have switched outputs off",
            )

    def _tick(self) -> dict[str, float]:
        values = self._values(self._rig.glance)
        self._record_tick(self._clock.now(), values)
        return values

    def _tick_after(self, tick: float) -> float:
        """Return when the tick after one is due; missed ticks are skipped, not caught up."""
        return tick + self._period * (1 + max(0, math.floor((self._clock.now() - tick) / self._period)))

    def _values(self, ask: Callable[[], dict[str, float]]) -> dict[str, float]:
        return ask() | self._trace

    def _record_tick(self, t: float, values: Mapping[str, float]) -> None:
        row = tuple(values[name] for name in self._names)
        self._journal.telemetry(t, self._steps, row)
        self._tell(lambda observer: observer.telemetry(t, self._steps, row))
        self._watch.check(t, values)

    def _raise_if_aborted(self) -> None:
        if self._interrupts.abort_reason is not None:
            raise AbortError(f"ended by {self._interrupts.abort_reason}")

    def _pause_if_asked(self) -> None:
        self._raise_if_aborted()
        if not self._interrupts.pause_requested:
            return
        if self._ask is None:
            raise AbortError("ended by Ctrl-C; no operator is present to resume")
        self._event("WARN", "pause", "paused before the next step, at the operator's wish")
        answer = self._await_answer(self._ask, "paused:")
        self._interrupts.pause_requested = False
        if answer != RESUME:
            raise AbortError("ended by the operator at a pause")
        self._event("INFO", "resume", "resumed")

    def _await_answer(self, ask: Callable[[str], str], question: str) -> str:
        """Have the operator asked, with telemetry and interlocks going on; return the answer."""
        answer: list[str] = []
        asking = threading.Thread(target=lambda: answer.append(ask(question)), name="ask-operator", daemon=True)
        asking.start()
        while asking.is_alive():
            if self._clock.sleep_waits:
                # Interlocks and watchdogs do not pause.
                self._sleep_until(self._clock.now() + self._period)
                self._tick()
            else:
                asking.join(0.1)
                self._raise_if_aborted()
        return answer[0] if answer else ABORT

    def _event(self, level: str, kind: str, text: str) -> None:
        event = Event(self._clock.now(), level, kind, text)
        self._journal.event(event)
        self._tell(lambda observer: observer.event(event))

    def _tell(self, what: Callable[[Observer], None]) -> None:
        for observer in self._observers:
            try:
                what(observer)
            # A terminal or a viewer that is gone must not end a run of hours.
            except Exception as error:
                self._observers = tuple(other for other in self._observers if other is not observer)
                name = type(observer).__name__
                self._event("WARN", "observer", f"{name} was dropped: {type(error).__name__}: {error}")

    def _finish(self, error: Exception | None, start: float, safe_state: Mapping[str, str]) -> Outcome:
        if error is None:
            status, reason = "completed", ""
        elif isinstance(error, AbortError):
            status, reason = "aborted", str(error)
        else:
            status = "failed"
            reason = str(error) if isinstance(error, BenchError) else f"{type(error).__name__}: {error}"
        finished = self._clock.now()
        pace = self._clock.pace() if isinstance(self._clock, PacedClock) else None
        try:
            if error is not None:
                self._event("ERROR", "interlock" if isinstance(error, InterlockError) else "error", reason)
            for name, state in safe_state.items():
                ok = state == SAFE
                self._event("INFO" if ok else "ERROR", "safe-state", f"{name}: {state}")
            if pace is not None:
                self._event("INFO", "clock", str(pace))
            self._event("INFO" if error is None else "WARN", "end", status)
            self._journal.finish(status=status, reason=reason, finished=finished, safe_state=safe_state)
        # A full disk must not hide whether the devices are safe.
        except Exception as failure:
            why = f"the journal could not be finished: {failure}"
            status, reason, error = "failed", f"{reason}; {why}" if reason else why, error or failure
        return Outcome(status, reason, self._steps, finished - start, safe_state, error, pace)


def check_before_moving(rig: Rig, definition: ProtocolDefinition, expected: Plan) -> None:
    """Check the plan of a dry run against the rig's devices and limits.

    Raises ConfigurationError if the rig lacks something, or a set-point would leave a device's limits; nothing has
    moved.
    """
    rig.check_needs(definition.name, definition.names)
    rig.check_needs(definition.name, sorted(expected.watched))
    for device, (low, high) in expected.extremes.items():
        if device not in rig.actuators:
            raise ConfigurationError(
                f"protocol {definition.name} sets {device}, which rig {rig.file.name} cannot set"
            )
        limits = rig.actuators[device].limits
        if not (low in limits and high in limits):
            raise ConfigurationError(
                f"protocol {definition.name} would set {device} to between {low:g} and {high:g} {limits.unit}; "
                f"rig {rig.file.name} allows {limits}"
            )


def _traced(trace: Trace) -> dict[str, float]:
    """Return what a controller thinks, for the record."""
    thoughts = (trace.reference, trace.predicted, trace.disturbance, trace.uncertainty)
    return dict(zip(TRACE_NAMES, thoughts, strict=True)) | {LATENESS.name: math.nan}
