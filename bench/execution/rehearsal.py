"""The rehearsal of a run: the protocol on the emulated twin of its rig, on the virtual clock, before anything moves.

Nothing is written to disk. The engine, the station and the interlocks are those of a run; only the record is one that
keeps the extremes of the signals, what was found, and when each step ended.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from bench.base import (
    AbortError,
    ConfigurationError,
    DataError,
    Display,
    Interrupts,
    VirtualClock,
    difference_unit,
    format_duration,
    html_table,
)
from bench.devices import Signal
from bench.execution.engine import Engine, Outcome, check_before_moving
from bench.execution.run_at_hand import Observer
from bench.execution.station.local import LocalStation
from bench.operator import ABORT, RESUME, Question
from bench.protocol import LATENESS, LONGEST, TRACES, Plan, ProtocolDefinition, ProtocolParameters, plan
from bench.record import Event, StepRecord
from bench.rig import SETPOINT, Interlock, Rig, RigDescription, RigFile, shortened_absences

LONGEST_DAYS = 30.0
"""Longest rehearsal, days of laboratory time: a protocol that waits for a reading which never comes ends there."""

_DAY = 86400.0
_MOST_MARKS = 2000
"""Steps whose end is kept, so that the rehearsal of a long run stays small."""


@dataclass(frozen=True)
class Bound:
    """What a signal or set-point may not leave.

    Attributes
    ----------
    by : str
        `device` for the limits of a set-point or of a reading, or `interlock`.
    low, high : float
        In the unit of the signal; infinite where there is none.
    """

    by: str
    low: float
    high: float


@dataclass(frozen=True)
class Extremes:
    """The range that a signal went through.

    Attributes
    ----------
    low, high : float
        Smallest and largest value, in the unit.
    unit : str
        Unit of the signal.
    bounds : tuple of Bound
        What it may not leave.
    display : Display
        How its values are shown.
    """

    low: float
    high: float
    unit: str
    bounds: tuple[Bound, ...]
    display: Display

    @property
    def margin(self) -> float:
        """Distance to the nearest bound, in the unit; negative beyond it, infinite without one."""
        return min((min(self.low - bound.low, bound.high - self.high) for bound in self.bounds), default=math.inf)


@dataclass(frozen=True)
class RehearsalFinding:
    """What happened in a rehearsal beside the steps: an interlock, a warning, an error.

    Attributes
    ----------
    t : float
        Laboratory time from the start, s.
    step : int
        Number of the step that it happened in.
    level, kind, text : str
        As in the events of a journal.
    """

    t: float
    step: int
    level: str
    kind: str
    text: str


@dataclass(frozen=True)
class Rehearsal:
    """What a run will do and touch.

    Attributes
    ----------
    rig, protocol : str
        What was rehearsed.
    twin : str
        Emulated rig that stood in; empty if there is none, and only what no reading decides is known.
    status, reason : str
        How it ended: `completed`, `aborted` or `failed`; `planned` without a twin.
    complete : bool
        Whether steps, seconds and prompts are those of the whole run. Otherwise they are those up to the first
        reading that decides, or up to the failure.
    steps : int
        Number of steps.
    seconds : float
        Laboratory time from the start to the safe state, s.
    at_most : float
        The same, each step counted with its time-out; infinite if readings decide which steps there are.
    prompted : tuple of int
        Numbers of the steps in which the operator is asked to do something by hand.
    extremes : mapping of str to Extremes
        Range by signal and set-point, and by difference of two signals that an interlock watches.
    findings : tuple of RehearsalFinding
        What happened.
    marks : tuple of (int, float)
        Number of finished steps and laboratory time from the start in s, in order.
    shortened : tuple of str
        Which lines may be lost for less than `[safety] reconnect`, and why.
    """

    rig: str
    protocol: str
    twin: str
    status: str
    reason: str
    complete: bool
    steps: int
    seconds: float
    at_most: float
    prompted: tuple[int, ...]
    extremes: Mapping[str, Extremes]
    findings: tuple[RehearsalFinding, ...] = ()
    marks: tuple[tuple[int, float], ...] = ()
    shortened: tuple[str, ...] = ()

    @classmethod
    def of_plan(cls, description: RigDescription, definition: ProtocolDefinition, expected: Plan) -> Self:
        """Return what is known of a run on a rig without a twin."""
        extremes = {
            f"{device}{SETPOINT}": _bounded(f"{device}{SETPOINT}", range_, description)
            for device, range_ in expected.extremes.items()
        }
        return cls(
            rig=description.file.name,
            protocol=definition.name,
            twin="",
            status="planned",
            reason="",
            complete=expected.complete,
            steps=expected.steps,
            seconds=expected.seconds,
            at_most=expected.at_most,
            prompted=expected.prompted,
            extremes=extremes,
            marks=_marks(expected.finished),
            shortened=shortened_absences(description, guarded=not description.file.in_process),
        )

    @property
    def prompts(self) -> int:
        """How often the operator is asked to do something by hand."""
        return len(self.prompted)

    @property
    def is_right(self) -> bool:
        """Whether nothing in it says that the run would not complete."""
        return self.status in ("completed", "planned")

    def _repr_html_(self) -> str:
        heads = ("signal", "lowest", "highest", "unit", "margin")
        rows = [
            (
                name,
                each.display.number(each.low),
                each.display.number(each.high),
                each.display.unit,
                each.display.number(each.margin) if math.isfinite(each.margin) else "",
            )
            for name, each in self.extremes.items()
        ]
        title = f"{self.protocol} on {self.rig}: {self.status}, {self.steps} steps, {format_duration(self.seconds)}"
        return html_table(heads, rows, title)

    def raise_if_wrong(self) -> None:
        """Raise ConfigurationError if the run would not complete."""
        if not self.is_right:
            raise ConfigurationError(
                f"in the rehearsal on {self.twin}, protocol {self.protocol} ends after {self.steps} steps and "
                f"{self.seconds:.0f} s: {self.reason}. Nothing has moved; --no-rehearse runs it all the same"
            )

    def widened(self, expected: Plan) -> Plan:
        """Return a plan with the set-points and prompts of the rehearsal."""
        extremes = dict(expected.extremes)
        for name, found in self.extremes.items():
            if name.endswith(SETPOINT) and (device := name.removesuffix(SETPOINT)):
                low, high = extremes.get(device, (found.low, found.high))
                extremes[device] = (min(low, found.low), max(high, found.high))
        return replace(expected, extremes=extremes, prompted=self.prompted)

    def to_json(self) -> dict[str, Any]:
        """Return it for JSON; what is infinite or unknown is null, and margins stand beside their bounds."""
        return {
            **{key: getattr(self, key) for key in _PLAIN},
            "at_most": _or_none(self.at_most),
            "prompts": self.prompts,
            "prompted": list(self.prompted),
            "extremes": {
                name: {
                    "low": each.low,
                    "high": each.high,
                    "unit": each.unit,
                    "margin": _or_none(each.margin),
                    "bounds": [
                        {"by": bound.by, "low": _or_none(bound.low), "high": _or_none(bound.high)}
                        for bound in each.bounds
                    ],
                }
                for name, each in self.extremes.items()
            },
            "findings": [vars(finding) for finding in self.findings],
            "marks": [[steps, round(seconds, 3)] for steps, seconds in self.marks],
            "shortened": list(self.shortened),
        }


_PLAIN = ("rig", "protocol", "twin", "status", "reason", "complete", "steps", "seconds")


def rehearse(
    definition: ProtocolDefinition,
    parameters: ProtocolParameters,
    twin: RigFile,
    *,
    rig: str,
    seed: int = 0,
    interlock_rate: float | None = None,
    guarded: bool = False,
    interrupts: Interrupts | None = None,
    observers: Iterable[Observer] = (),
) -> Rehearsal:
    """Carry a protocol out on an emulated rig in this process, on the virtual clock, and return how it went.

    Parameters
    ----------
    definition, parameters
        What to carry out.
    twin : RigFile
        The emulated rig, with the limits, interlocks and slots of the rig of the run; see `bench.rig.rehearsal_rig`.
    rig : str
        Name of the rig of the run.
    seed : int
        Seed of everything random in the emulated laboratory.
    interlock_rate : float, optional
        Looks at the interlocks in a laboratory second, Hz, beside those with each reading and each tick.
    guarded : bool
        Whether a guardian will look at the interlocks of the run.
    interrupts : Interrupts, optional
        What the operator and the system ask for; any request ends the rehearsal.
    observers : iterable of Observer
        Notified as in a run.

    Raises
    ------
    ConfigurationError
        If the twin lacks something that the protocol needs, a set-point that no reading decides would leave a
        device's limits, the protocol fails in its plan, or it does not come to an end.
    AbortError
        If it was asked to end.
    """
    interrupts = Interrupts() if interrupts is None else interrupts
    laboratory = Rig(twin, VirtualClock(), seed)
    station = LocalStation(laboratory, interlock_rate)
    try:
        description = station.description
        expected = plan(definition, parameters, description.slots(definition))
        check_before_moving(description, definition, expected)
        kept = _Kept(definition.name, twin.name, description.signals, twin.interlocks)
        answers = _Answers(interrupts)
        outcome = Engine(station, kept, observers, interrupts, answers.answer).run(definition, parameters)
    finally:
        station.close()
        interrupts.finish()
    _raise_if_ended(outcome, answers.ended_by)
    reason = outcome.reason
    if isinstance(outcome.error, KeyError):
        reason = f"the protocol reads {outcome.error}, which the twin does not have"
    return Rehearsal(
        rig=rig,
        protocol=definition.name,
        twin=twin.name,
        status=outcome.status,
        reason=reason,
        complete=outcome.status == "completed",
        steps=outcome.steps,
        seconds=outcome.laboratory_seconds,
        at_most=_at_most(expected, kept.finished, outcome.laboratory_seconds),
        prompted=tuple(kept.prompted),
        extremes=kept.extremes(description),
        findings=tuple(kept.findings),
        marks=_marks(kept.finished),
        shortened=shortened_absences(description, guarded=guarded),
    )


def _raise_if_ended(outcome: Outcome, by: str) -> None:
    """Raise what ends more than the rehearsal: a request to end, a protocol without an end, a wrong file."""
    if by:
        raise AbortError(f"the rehearsal was ended by {by}; nothing has moved")
    if outcome.status == "aborted":
        raise AbortError(f"in the rehearsal: {outcome.reason}; nothing has moved")
    if isinstance(outcome.error, ConfigurationError | DataError):
        raise outcome.error


class _Answers:
    """The answers at the pauses of a rehearsal: each goes on at once, unless the operator has asked for the end."""

    def __init__(self, interrupts: Interrupts) -> None:
        self._interrupts = interrupts
        self._pressed = False

    def answer(self, _: Question) -> str:
        # The engine clears the request.
        self._pressed |= self._interrupts.pause_requested
        return ABORT if self._pressed else RESUME

    @property
    def ended_by(self) -> str:
        """What has asked for the end, also too late to cut it short; empty if nothing has."""
        if self._interrupts.abort_reason is not None:
            return self._interrupts.abort_reason
        return "Ctrl-C" if self._pressed or self._interrupts.pause_requested else ""


class _Kept:
    """What is kept of a rehearsal; a `RunRecord`."""

    def __init__(self, protocol: str, twin: str, signals: Sequence[Signal], interlocks: Iterable[Interlock]) -> None:
        self.signals = (*signals, *TRACES, LATENESS)
        self.finished: list[float] = []
        self.prompted: list[int] = []
        self.findings: list[RehearsalFinding] = []
        self._endless = f"protocol {protocol} does not end in its rehearsal on {twin}, within {{}}"
        self._others = 0
        index = {signal.name: i for i, signal in enumerate(signals)}
        self._differences = {
            each.label: (index[each.signal], index[each.minus], each.unit) for each in interlocks if each.minus
        }
        self._names = [*index, *self._differences]
        self._index = index
        self._low = [math.inf] * len(self._names)
        self._high = [-math.inf] * len(self._names)

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:  # noqa: ARG002 - as of all
        if t > LONGEST_DAYS * _DAY:
            raise ConfigurationError(self._endless.format(f"{LONGEST_DAYS:g} days of laboratory time"))
        self._look(values)

    def step(self, record: StepRecord) -> None:
        self.finished.append(record.finished)
        if len(self.finished) > LONGEST:
            raise ConfigurationError(self._endless.format(f"{LONGEST} steps"))
        self._look(record.values)
        for device, value in record.setpoints.items():
            self._widen(self._index[f"{device}{SETPOINT}"], value)

    def event(self, event: Event) -> None:
        if event.kind == "prompt":
            self.prompted.append(len(self.finished))
        elif event.level != "INFO" and event.kind != "end":
            self.findings.append(RehearsalFinding(event.t, len(self.finished), event.level, event.kind, event.text))
        self._others += 1
        if self._others > LONGEST:
            raise ConfigurationError(self._endless.format(f"{LONGEST} notes"))

    def keep_model(self, name: str, t: float, content: Mapping[str, Any]) -> None:
        pass

    def take_notices(self) -> list[str]:
        return []

    def finish(self, **_: object) -> None:
        pass

    def extremes(self, description: RigDescription) -> dict[str, Extremes]:
        """Return the range of every signal that had a value."""
        return {
            name: _bounded(name, (low, high), description)
            for name, low, high in zip(self._names, self._low, self._high, strict=True)
            if low <= high
        }

    def _look(self, values: Sequence[float]) -> None:
        count = len(self._names) - len(self._differences)
        for i, value in enumerate(values[:count]):
            self._widen(i, value)
        for i, (signal, minus, _) in enumerate(self._differences.values(), count):
            self._widen(i, values[signal] - values[minus])

    def _widen(self, i: int, value: float) -> None:
        # Nan widens nothing.
        if value < self._low[i]:
            self._low[i] = value
        if value > self._high[i]:
            self._high[i] = value


def _bounded(name: str, range_: tuple[float, float], description: RigDescription) -> Extremes:
    """Return the range of a signal with what it may not leave: the limits of its device, and interlocks."""
    locks = [each for each in description.file.interlocks if each.label == name]
    bounds = [
        Bound("interlock", each.low, each.high)
        for each in locks
        if math.isfinite(each.low) or math.isfinite(each.high)
    ]
    limits = description.reading_limits.get(name)
    if name.endswith(SETPOINT):
        limits = description.limits.get(name.removesuffix(SETPOINT))
    if limits is not None:
        bounds.insert(0, Bound("device", limits.low, limits.high))
    signal = description.by_name.get(name) or description.by_name[locks[0].signal]
    low, high = range_
    unit, display = signal.unit, signal.display
    if signal.name != name:
        unit, display = difference_unit(unit), replace(display, unit=difference_unit(display.unit))
    return Extremes(float(low), float(high), unit, tuple(bounds), display)


def _at_most(expected: Plan, finished: Sequence[float], seconds: float) -> float:
    """Return the longest time of a run whose steps are known: each as long as its time-out, or as rehearsed."""
    if not expected.complete or len(expected.latest) != len(finished):
        return math.inf
    rehearsed = [after - before for before, after in zip((0.0, *finished), finished, strict=False)]
    extra = sum(max(0.0, most - took) for most, took in zip(expected.latest, rehearsed, strict=True))
    return seconds + extra


def _marks(finished: Sequence[float]) -> tuple[tuple[int, float], ...]:
    """Return when steps had ended, of a long run not all: number of finished steps, and s from the start."""
    count = len(finished)
    if count <= _MOST_MARKS:
        return tuple(enumerate(finished, 1))
    wanted = sorted({round((i + 1) * count / _MOST_MARKS) for i in range(_MOST_MARKS)})
    return tuple((steps, finished[steps - 1]) for steps in wanted)


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
