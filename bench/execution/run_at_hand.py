"""The run at hand: lets laboratory time pass, takes readings, and writes them down before anybody is notified."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any, Protocol

from bench.base import AbortError, ConfigurationError, Interrupts, closest, format_duration
from bench.control import Trace
from bench.devices import Settled, Signal
from bench.execution.notify import Notifier
from bench.execution.station.interface import Station
from bench.operator import ABORT, AT_A_PAUSE, NOBODY, NOTE, OFF, RESUME, SET, STEP, Question
from bench.protocol import LATENESS, PARAMETER, TRACES, OpenParameters, Reading
from bench.record import Event, Lateness, StepRecord
from bench.rig import Look

TRACE_NAMES = tuple(signal.name for signal in TRACES)
_TRACE_AND_LATENESS = (*TRACE_NAMES, LATENESS.name)
NOT_AT_WORK = dict.fromkeys(_TRACE_AND_LATENESS, math.nan)

_GRACE = 2.0
"""Wall-clock time beyond the next tick by which the station expects to hear from a hold, s."""
_LONG = 600.0
"""Laboratory time after which the end of a run has to be confirmed at a pause, s."""


class RunRecord(Protocol):
    """Where a run is written down before anybody is notified: a `Journal`; a rehearsal keeps less."""

    signals: tuple[Signal, ...]

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Keep one tick of a hold: time from the start of the run in s, step number, one value a signal."""

    def step(self, record: StepRecord) -> None:
        """Keep a finished step."""

    def event(self, event: Event) -> None:
        """Keep something that happened."""

    def keep_model(self, name: str, t: float, content: Mapping[str, Any]) -> None:
        """Keep a model (the content of a model file) whose data reach to a time from the start of the run in s."""

    def take_notices(self) -> list[str]:
        """Return what happened to the record itself since the last call."""

    def finish(
        self,
        *,
        status: str,
        reason: str,
        finished: float,
        safe_state: Mapping[str, str],
        lateness: Mapping[str, object],
    ) -> None:
        """Keep how the run ended, and how late its loops were."""


class Observer(Protocol):
    """Watches a run: the dashboard, the progress display. No method may block; an observer that raises is dropped."""

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """See one tick of a hold; `values` in the order of the rig's signals."""

    def step(self, record: StepRecord) -> None:
        """See a finished step."""

    def event(self, event: Event) -> None:
        """See something that happened."""


class RunAtHand:
    """What all parts of a run share: its station and clock, its record, its observers, and the operator.

    What is recorded and shown counts from the start of the run; all other times are those of the clock.

    Parameters
    ----------
    station : Station
        Connected devices.
    journal : RunRecord
        Written before any observer is notified.
    observers : iterable of Observer
        Notified after the journal.
    interrupts : Interrupts
        What the operator and the system ask for.
    ask : callable, optional
        Asks the operator a question, and returns one of its answers; any other one is `abort`. Without it a pause or
        a prompt aborts the run.
    zero : float, optional
        Time of the clock at which the record begins to count, s; now if not given.
    messages : Notifier, optional
        What sends messages about the run.

    Attributes
    ----------
    period : float
        Laboratory time between two ticks of a hold, s.
    phase : str
        Part of the protocol that is carried out.
    steps : int
        Number of finished steps.
    trace : dict of str to float
        What a controller thinks, for the record.
    zero : float
        Time of the clock at which the record begins to count, s.
    lateness : dict of str to Lateness
        How late the samples of loops were, by label.
    parameters : OpenParameters or None
        The parameters of the protocol, for changes at a pause.
    """

    def __init__(
        self,
        station: Station,
        journal: RunRecord,
        observers: Iterable[Observer],
        interrupts: Interrupts,
        ask: Callable[[Question], str] | None,
        zero: float | None = None,
        messages: Notifier | None = None,
    ) -> None:
        self.station = station
        self.clock = station.clock
        self.period = station.description.file.telemetry.period
        self.names = tuple(signal.name for signal in journal.signals)
        self._row = row_of(self.names)
        self.phase = ""
        self.steps = 0
        self.trace = NOT_AT_WORK
        self.zero = self.clock.now() if zero is None else zero
        self.ask = ask
        self._journal = journal
        self._observers = tuple(observers)
        self._interrupts = interrupts
        self._messages = messages
        self.lateness: dict[str, Lateness] = {}
        self.parameters: OpenParameters | None = None
        self._pause_reason = ""
        self._is_demanded = False
        self._one_step = False
        self._on_again = -math.inf

    def keep_lateness(self, label: str, lateness: Lateness) -> None:
        """Add to what the record says of how late the samples of loops were, by their label."""
        if label in self.lateness:
            self.lateness[label].merge(lateness)
        else:
            self.lateness[label] = lateness

    def expect_ticks(self, what: str) -> None:
        """Promise the station a request with each tick."""
        self.station.promise(self.period + _GRACE, what)

    def look(self, look: Look = Look.GLANCE, wanted: Collection[str] = ()) -> dict[str, float]:
        """Read the signals; return the values together with what a controller thinks."""
        values = self.station.look(look, wanted)
        values.update(self.trace)
        return values

    def tick(self) -> dict[str, float]:
        """Take a quick reading of all signals, record it, and have it judged by the interlocks."""
        values = self.look()
        self.record_tick(self.clock.now(), values)
        return values

    def record_tick(self, t: float, values: Mapping[str, float]) -> None:
        """Record quick readings, and have them judged by the interlocks."""
        row, passed = self._row(values), t - self.zero
        self._journal.telemetry(passed, self.steps, row)
        if self._observers:
            self._tell(lambda observer: observer.telemetry(passed, self.steps, row))
        self.judge(t, values)

    def judge(self, t: float, values: Mapping[str, float]) -> None:
        """Have readings judged by the interlocks; record what happened at the station meanwhile."""
        try:
            self.station.judge(t, values)
        finally:
            self.take_news()
        self._pause_reason = self.station.take_pause() or self._pause_reason
        # Asked for here only, as a fast loop looks at it with each sample.
        self._is_demanded = bool(self._pause_reason) or self.station.is_holding

    def take_news(self) -> None:
        """Record what happened at the station, and to the journal itself, since the last call."""
        for news in self.station.news():
            self.event(news.level, news.kind, news.text)
        for text in self._journal.take_notices():
            self.event("WARN", "journal", text)
        if self._messages is not None:
            for text in self._messages.take_notices():
                self.event("WARN", "notify", text)

    def finish_messages(self) -> None:
        """Wait a moment for messages that are still to be sent, and record what has failed."""
        if self._messages is not None:
            self._messages.finish()
            self.take_news()

    def tick_after(self, tick: float) -> float:
        """Return when the tick after one is due; missed ticks are skipped, not caught up."""
        return tick + self.period * (1 + max(0, math.floor((self.clock.now() - tick) / self.period)))

    def hold_until(self, end: float, started: float) -> None:
        """Let time pass up to an instant, with ticks counted from `started` on."""
        tick = 1
        # No tick closer to the end than rounding could bring it: the reading follows there.
        while (instant := started + tick * self.period) < end - 1e-6 * self.period:
            self.sleep_until(instant)
            self.tick()
            self.pause_if_asked()
            if self._on_again > started:
                # The specimen was without its set-points: it is held for the whole time again.
                end, started, tick = self._on_again + end - started, self._on_again, 0
            tick = max(tick + 1, math.floor((self.clock.now() - started) / self.period))
        self.sleep_until(end)

    def sleep_until(self, instant: float) -> None:
        """Let time pass up to an instant.

        Raises AbortError if the run has to end, and what has tripped the station meanwhile.
        """
        interrupts = self._interrupts
        if interrupts.abort_reason is not None:
            self.raise_if_aborted()
        self.station.sleep_until(instant)
        if interrupts.abort_reason is not None:
            self.raise_if_aborted()
        if (seconds := self.clock.suspension()) > 0:
            # The next reading finds what the watchdogs have done meanwhile.
            self.event(
                "WARN",
                "suspended",
                f"the machine was suspended for {seconds:.0f} s: the set-points stood, nothing was recorded, and "
                "watchdogs may have switched outputs off",
            )
        if (seconds := self.clock.parting()) != 0:
            self.event(
                "WARN",
                "clock",
                f"the time of day was set {'forward' if seconds > 0 else 'back'} by {abs(seconds):.1f} s: the record "
                "goes on counting from the start of the run, and its times of day differ from those of other records "
                "by so much from here on",
            )

    def finish_step(
        self,
        started: float,
        label: str,
        setpoints: Mapping[str, float],
        values: Mapping[str, float],
        settled: Settled,
        seen: Sequence[float] = (),
    ) -> Reading:
        """Write a step down, then notify the observers; a controller was given the ticks of the times `seen`, s."""
        record = StepRecord(
            step=self.steps,
            started=started - self.zero,
            finished=self.clock.now() - self.zero,
            phase=self.phase,
            label=label,
            settled=settled,
            setpoints=setpoints,
            values=self._row(values),
            seen=tuple(seen),
        )
        # What is handed over counts: a record that ends the run, as it was removed, has the step all the same.
        self.steps += 1
        self._journal.step(record)
        if self._one_step:
            self._one_step, self._pause_reason, self._is_demanded = False, "one step", True
        self._tell(lambda observer: observer.step(record))
        return Reading(record.step, record.finished, record.settled, values)

    def measure_step(self, started: float, label: str, setpoints: Mapping[str, float], settled: Settled) -> Reading:
        """Take the reading of a step, have it judged by the interlocks, and finish the step with it."""
        values = self.look(Look.MEASURE)
        self.judge(self.clock.now(), values)
        return self.finish_step(started, label, setpoints, values, settled)

    def event(self, level: str, kind: str, text: str) -> None:
        """Write down that something happened, then notify the observers."""
        event = Event(self.clock.now() - self.zero, level, kind, text)
        self._journal.event(event)
        self._tell(lambda observer: observer.event(event))

    def keep_model(self, name: str, content: Mapping[str, Any]) -> None:
        """Keep a model with the run: a name, and the content of a model file."""
        self._journal.keep_model(name, self.clock.now() - self.zero, content)

    def check_signals(self, *names: str) -> None:
        """Raise ConfigurationError if the rig lacks a signal."""
        for name in names:
            if name not in self.names:
                raise ConfigurationError(f"{name} is not a signal of this rig; {closest(name, self.names)}")

    def raise_if_aborted(self) -> None:
        """Raise AbortError if the operator or the system has asked for the end."""
        if self._interrupts.abort_reason is not None:
            self._interrupts.acknowledge()
            raise AbortError(f"ended by {self._interrupts.abort_reason}")

    @property
    def pause_requested(self) -> bool:
        """Whether the operator or an interlock has asked for a pause, or an interlock holds the set-points."""
        return self._interrupts.pause_requested or self._is_demanded

    def take_pause(self) -> tuple[bool, str]:
        """Return whether the operator or the system asks for a pause, and why an interlock does; each once."""
        asked, self._interrupts.pause_requested = self._interrupts.pause_requested, False
        why, self._pause_reason = self._pause_reason, ""
        return asked, why

    def pause_if_asked(self) -> float:
        """Pause if the operator or an interlock has asked for it; return for how long, s.

        The set-points stand meanwhile; telemetry and interlocks go on. Raises AbortError if the run is to end.
        """
        self.raise_if_aborted()
        if not self.pause_requested:
            return 0.0
        since = self.clock.now()
        self.expect_ticks("the set-points are held")
        while self.station.is_holding:
            self.sleep_until(self.clock.now() + self.period)
            self.tick()
        self._is_demanded = False
        if self._interrupts.pause_requested or self._pause_reason:
            self._pause()
        return self.clock.now() - since

    def _pause(self) -> None:
        why, self._pause_reason = self._pause_reason, ""
        alone = AbortError(f"ended by {why or 'Ctrl-C'}; no operator is present to resume")
        if self.ask is None:
            raise alone
        text = f"paused by {why or 'the operator'}; the set-points stand"
        self.event("WARN", "pause", text)
        off: dict[str, float] = {}
        problem, is_sure = "", False
        while True:
            changeable = {} if self.parameters is None else self.parameters.changeable()
            answer = self.await_answer(self.ask, Question(text, AT_A_PAUSE, "PAUSED", changeable, problem))
            command, _, rest = answer.partition(" ")
            problem = ""
            if command == ABORT and not is_sure and (past := self.clock.now() - self.zero) > _LONG:
                problem = f"the run has taken {format_duration(past)}; answer abort once more to end it"
                is_sure = True
                continue
            is_sure = False
            if command == NOTE:
                self.event("INFO", "remark", rest)
            elif command == SET:
                problem = self._change(rest)
            elif command == OFF:
                off = off or self.switch_off()
                text = (
                    "the outputs are off until the run is resumed, which sends the set-points from before again; a "
                    "specimen with memory is not where it was then: to have it brought back first, end the run and "
                    "use `bench resume`"
                )
            else:
                break
        self._interrupts.pause_requested = False
        if command == NOBODY:
            raise alone
        if command not in (RESUME, STEP):
            raise AbortError("ended by the operator at a pause")
        if off:
            self._switch_on(off)
        self._one_step = command == STEP
        self.event("INFO", "resume", "resumed for one step" if self._one_step else "resumed")

    def _change(self, assignment: str) -> str:
        """Change a parameter of the protocol; return what is wrong with it, empty if it is changed."""
        if self.parameters is None:
            return "this protocol has no parameters"
        name, _, value = assignment.partition("=")
        try:
            change = self.parameters.change(self.steps, name.strip(), value.strip())
        except ConfigurationError as error:
            return str(error)
        self.event("WARN", PARAMETER, str(change))
        return ""

    def switch_off(self) -> dict[str, float]:
        """Switch every output off; return the set-points that there were."""
        setpoints = {name: self.station.setpoint(name) for name in self.station.description.limits}
        self.station.promise(max(self.station.description.devices[name].safe_within for name in setpoints), "rest")
        self.station.rest()
        self.expect_ticks("the outputs are off")
        self.event("WARN", "off", "outputs off: every device is in its safe state until the run is resumed")
        return {name: value for name, value in setpoints.items() if math.isfinite(value)}

    def _switch_on(self, setpoints: Mapping[str, float]) -> None:
        self.station.apply(setpoints)
        self._on_again = self.clock.now()
        self.event(
            "WARN",
            "off",
            "outputs on again, at the set-points from before: a specimen with memory is no longer where the protocol "
            "left it",
        )

    def await_answer(self, ask: Callable[[Question], str], question: Question) -> str:
        """Have the operator asked, with telemetry and interlocks going on; return the answer."""
        self.expect_ticks("the operator is asked")
        answer: list[str] = []
        asking = threading.Thread(target=lambda: answer.append(ask(question)), name="ask-operator", daemon=True)
        asking.start()
        while asking.is_alive():
            if self.clock.sleep_waits:
                # Interlocks and watchdogs do not pause.
                self.sleep_until(self.clock.now() + self.period)
                self.tick()
            else:
                asking.join(0.1)
                self.raise_if_aborted()
        return answer[0] if answer else ABORT

    def _tell(self, what: Callable[[Observer], None]) -> None:
        for observer in self._observers:
            try:
                what(observer)
            # A terminal or a viewer that is gone must not end a run of hours.
            except Exception as error:
                self._observers = tuple(other for other in self._observers if other is not observer)
                name = type(observer).__name__
                self.event("WARN", "observer", f"{name} was dropped: {type(error).__name__}: {error}")


def traced(trace: Trace) -> dict[str, float]:
    """Return what a controller thinks, for the record."""
    thoughts = (trace.reference, trace.predicted, trace.disturbance, trace.uncertainty, math.nan)
    return dict(zip(_TRACE_AND_LATENESS, thoughts, strict=True))


def row_of(names: Sequence[str]) -> Callable[[Mapping[str, float]], tuple[float, ...]]:
    """Return what takes the values of some signals out of those of all, in their order."""
    if len(names) == 1:
        (name,) = names
        return lambda values: (values[name],)
    return itemgetter(*names) if names else lambda _: ()
