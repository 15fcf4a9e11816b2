"""Carries a protocol out on a rig.

For each step: check the set-points, send them, tick through the hold (telemetry, interlocks, faults), take
the reading, write the journal, and only then tell whoever watches. However the run ends, every device is
brought into its safe state, each by itself, and the journal says how that went.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from bench.control.estimators import DriftEstimator
from bench.errors import AbortError, BenchError, ConfigurationError, SettleTimeoutError
from bench.interrupts import Interrupts
from bench.journal import Event, Journal, StepRecord
from bench.protocol import (
    Dwell,
    Note,
    Phase,
    ProtocolDefinition,
    ProtocolParameters,
    Reading,
    Step,
    UntilSteady,
    plan,
)
from bench.rig import Rig
from bench.safety import SAFE, InterlockWatch, make_safe

RESUME = "resume"
ABORT = "abort"


class Observer(Protocol):
    """Watches a run: the dashboard, the progress display. No method may block or raise."""

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
    """

    status: str
    reason: str
    steps: int
    laboratory_seconds: float
    safe_state: Mapping[str, str]
    error: Exception | None

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
        Written before anybody else is told.
    observers : iterable of Observer
        Told after the journal.
    interrupts : Interrupts
        What the operator and the system ask for.
    ask : callable, optional
        Asks the operator at a pause, and returns `resume` or `abort`. Without it a pause is an abort, as
        nobody is there to answer.
    """

    def __init__(
        self,
        rig: Rig,
        journal: Journal,
        observers: Iterable[Observer],
        interrupts: Interrupts,
        ask: Callable[[], str] | None = None,
    ) -> None:
        self._rig = rig
        self._clock = rig.clock
        self._journal = journal
        self._observers = tuple(observers)
        self._interrupts = interrupts
        self._ask = ask
        self._names = tuple(signal.name for signal in rig.signals)
        self._period = rig.file.telemetry.period
        self._watch = InterlockWatch(rig.file.interlocks, {signal.name: signal.unit for signal in rig.signals})
        self._phase = ""
        self._steps = 0

    def run(self, definition: ProtocolDefinition, parameters: ProtocolParameters) -> Outcome:
        """Carry a protocol out, from its first step to the safe state.

        Returns
        -------
        Outcome
            How it ended; nothing that happens on the way is raised.
        """
        start = self._clock.now()
        self._clock.interrupted = self._interrupts.abort_requested
        error: Exception | None = None
        try:
            self._carry_out(definition, parameters)
        # Whatever is raised, every way out leads through the safe state.
        except Exception as caught:
            error = caught
        finally:
            # Also on its way out with something that is not an Exception.
            self._clock.interrupted = lambda: False
            safe_state = make_safe(self._rig.devices.values())
        return self._finish(error, start, safe_state)

    def _carry_out(self, definition: ProtocolDefinition, parameters: ProtocolParameters) -> None:
        self._watch.check(self._clock.now(), self._rig.glance())
        messages = definition.generator(parameters)
        try:
            message = next(messages)
            while True:
                if isinstance(message, Step):
                    self._pause_if_asked()
                    message = messages.send(self._step(message))
                elif isinstance(message, Phase):
                    self._phase = message.name
                    self._event("INFO", "phase", message.name)
                    message = next(messages)
                elif isinstance(message, Note):
                    self._event("INFO", "note", message.text)
                    message = next(messages)
                else:
                    raise ConfigurationError(
                        f"protocol {definition.name} yielded {message!r}; expected a Step, a Phase or a Note"
                    )
        except StopIteration:
            pass
        finally:
            messages.close()

    def _step(self, step: Step) -> Reading:
        started = self._clock.now()
        self._send(step.setpoints)
        self._settle(step.settle, started)
        values = self._rig.measure()
        finished = self._clock.now()
        self._watch.check(finished, values)
        record = StepRecord(
            step=self._steps,
            started=started,
            finished=finished,
            phase=self._phase,
            label=step.label,
            settled=True,
            setpoints=step.setpoints,
            values=tuple(values[name] for name in self._names),
        )
        self._journal.step(record)
        self._steps += 1
        for observer in self._observers:
            observer.step(record)
        return Reading(record.step, finished, record.settled, values)

    def _send(self, setpoints: Mapping[str, float]) -> None:
        actuators = self._rig.actuators
        for name, value in setpoints.items():
            if name not in actuators:
                known = ", ".join(actuators) or "none"
                raise ConfigurationError(f"{name} is no device that takes a set-point; there are: {known}")
            actuators[name].check(value)
        for name, value in setpoints.items():
            actuators[name].set(value)

    def _settle(self, settle: Dwell | UntilSteady, started: float) -> None:
        if isinstance(settle, Dwell):
            self._hold_until(started + settle.seconds, started)
            return
        if settle.signal not in self._names:
            raise ConfigurationError(f"{settle.signal} is no signal of this rig; there are: {', '.join(self._names)}")
        estimator = DriftEstimator(noise=settle.noise, agility=settle.drift)
        earliest, latest = started + settle.minimum, started + settle.timeout
        while True:
            self._sleep_until(min(self._clock.now() + self._period, latest))
            values = self._tick()
            now = self._clock.now()
            estimator.update(now, values[settle.signal])
            if now >= earliest and estimator.is_steady(settle.drift):
                return
            if now >= latest:
                unit = next(signal.unit for signal in self._rig.signals if signal.name == settle.signal)
                raise SettleTimeoutError(
                    f"{settle.signal} is not steady after {settle.timeout:g} s: it drifts by {estimator.drift:.3g} ± "
                    f"{estimator.uncertainty:.2g} {unit}/s, and {settle.drift:g} {unit}/s is allowed"
                )

    def _hold_until(self, end: float, started: float) -> None:
        tick = 1
        while (instant := started + tick * self._period) < end:
            self._sleep_until(instant)
            self._tick()
            tick += 1
        self._sleep_until(end)

    def _sleep_until(self, instant: float) -> None:
        self._raise_if_aborted()
        self._clock.sleep_until(instant)
        self._raise_if_aborted()

    def _tick(self) -> dict[str, float]:
        values = self._rig.glance()
        t = self._clock.now()
        row = tuple(values[name] for name in self._names)
        self._journal.telemetry(t, self._steps, row)
        for observer in self._observers:
            observer.telemetry(t, self._steps, row)
        self._watch.check(t, values)
        return values

    def _raise_if_aborted(self) -> None:
        if self._interrupts.abort_reason is not None:
            raise AbortError(f"ended by {self._interrupts.abort_reason}")

    def _pause_if_asked(self) -> None:
        self._raise_if_aborted()
        if not self._interrupts.pause_requested:
            return
        if self._ask is None:
            raise AbortError("ended by Ctrl-C; nobody is there to be asked whether to resume")
        self._event("WARN", "pause", "paused before the next step, at the operator's wish")
        answer: list[str] = []
        asking = threading.Thread(target=_put, args=(answer, self._ask), name="ask-operator", daemon=True)
        asking.start()
        while asking.is_alive():
            if self._clock.runs_by_itself:
                # Interlocks and watchdogs do not pause.
                self._sleep_until(self._clock.now() + self._period)
                self._tick()
            else:
                asking.join(0.1)
                self._raise_if_aborted()
        self._interrupts.pause_requested = False
        if not answer or answer[0] != RESUME:
            raise AbortError("ended by the operator at a pause")
        self._event("INFO", "resume", "resumed")

    def _event(self, level: str, kind: str, text: str) -> None:
        event = Event(self._clock.now(), level, kind, text)
        self._journal.event(event)
        for observer in self._observers:
            observer.event(event)

    def _finish(self, error: Exception | None, start: float, safe_state: Mapping[str, str]) -> Outcome:
        if error is None:
            status, reason = "completed", ""
        elif isinstance(error, AbortError):
            status, reason = "aborted", str(error)
        else:
            status = "failed"
            reason = str(error) if isinstance(error, BenchError) else f"{type(error).__name__}: {error}"
        finished = self._clock.now()
        if error is not None:
            self._event("ERROR", "error", reason)
        for name, state in safe_state.items():
            ok = state == SAFE
            self._event("INFO" if ok else "ERROR", "safe-state", f"{name}: {state}")
        self._event("INFO" if error is None else "WARN", "end", status)
        self._journal.finish(status=status, reason=reason, finished=finished, safe_state=safe_state)
        return Outcome(status, reason, self._steps, finished - start, safe_state, error)


def check_before_moving(rig: Rig, definition: ProtocolDefinition, parameters: ProtocolParameters) -> None:
    """Run a protocol dry against a rig's needs and limits.

    Raises
    ------
    ConfigurationError
        If the rig lacks something, or a set-point would leave a device's limits; nothing has moved.
    """
    rig.check_needs(definition.name, definition.needs)
    for device, (low, high) in plan(definition, parameters).extremes.items():
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


def _put(answer: list[str], ask: Callable[[], str]) -> None:
    answer.append(ask())
