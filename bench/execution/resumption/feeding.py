"""Feeding recorded readings back to a protocol: nothing is sent to a device, and no time passes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NoReturn

import numpy as np

from bench.base import BenchError, ConfigurationError
from bench.control import Playback
from bench.devices import Dwell, Settle
from bench.execution.resumption.corners import corners
from bench.execution.run_at_hand import NOT_AT_WORK
from bench.identification import turning_points
from bench.protocol import (
    PROMPT,
    Control,
    FixedRate,
    Message,
    Messages,
    Note,
    ParameterChange,
    Phase,
    Prompt,
    ProtocolDefinition,
    ProtocolParameters,
    Reading,
    Step,
)
from bench.record import Record, StepRecord, Table
from bench.rig import SETPOINT, Slots

_LEAST_TURN = 0.01
"""Smallest turn under a controller that counts as a corner, as a share of what the actuator went through."""

_AS_BEFORE, _LONG_BEFORE = 10, 120.0
"""Places at the end of the record that are gone through again: so many, and those of the last so many seconds. What
creeps is near to where it was then."""

_FEWEST_VALUES = 3
"""Different set-points from which an actuator is taken for one that is not just switched on and off."""

_LAST_PART = 0.1
"""Share of a long way to a place that is left for the last step."""

_FEWEST_TICKS = 5
"""Periods of the telemetry that a place is held where the run held none."""


_REMARKS = ("phase", "note")
"""Kinds of the events that a protocol's own messages leave."""


@dataclass(frozen=True)
class Place:
    """Where the actuators of a rig stood for a while."""

    setpoints: Mapping[str, float]  # of every actuator that had one by then
    settle: Settle | None  # how the rig settled there; None while a controller moved it
    prompt: Prompt | None  # what had been done by hand last
    seconds: float  # how long the rig stood there, s; 0 while a controller moved it


@dataclass(frozen=True)
class Past:
    """What a run recorded before it died."""

    steps: tuple[StepRecord, ...]  # its finished steps
    remarks: tuple[tuple[str, str], ...]  # kind and text of its phases and notes, in their order
    changes: tuple[ParameterChange, ...]  # parameters that were changed at its pauses, in their order
    names: tuple[str, ...]  # the signals of the record
    units: Mapping[str, str]  # their units
    ticks: Table  # its telemetry
    last: float  # laboratory time of the last row, s

    @classmethod
    def of(cls, record: Record) -> Past:
        """Read a record; raises DataError if it is damaged."""
        steps, events, ticks = tuple(record.step_records()), record.events(), record.telemetry()
        times = [step.finished for step in steps] + [event.t for event in events] + ticks["t"].tolist()
        return cls(
            steps=steps,
            remarks=tuple((event.kind, event.text) for event in events if event.kind in _REMARKS),
            changes=ParameterChange.among((event.kind, event.text) for event in events),
            names=tuple(signal.name for signal in record.signals),
            units={signal.name: signal.unit for signal in record.signals},
            ticks=ticks,
            last=max(times, default=0.0),
        )


@dataclass
class Fed:
    """A protocol that has been fed its past."""

    messages: Messages  # the protocol, which waits for the reading of `message`
    past: Past  # what it was fed
    # Its first message that is not in the record; None if the protocol had come to its end.
    message: Message | None = None
    step: StepRecord | None = None  # the last step that it was fed
    phase: str = ""  # the phase that it is in
    places: list[Place] = field(default_factory=list)  # where the actuators have been, in order
    # Controllers of finished fast loops, whose state is not in the record.
    spent: list[object] = field(default_factory=list)

    @property
    def next_step(self) -> int:
        """The number of the step that comes next."""
        return self.past.steps[-1].step + 1 if self.past.steps else 0

    def way_back(self) -> list[Place]:
        """Return the shortest way to the state in which the record left the specimen, its last place last.

        A place to which the run came by a small step is not jumped at from far, as that would overshoot it: there are
        stops before it. The end is gone through as the run did, so that what creeps is near to where it was.
        """
        if not self.places:
            return []
        end = self._end()
        # Also where nothing was set: something may have been done by hand there.
        found = set(range(end, len(self.places)))
        for actuator in self._actuators:
            path = self._path(actuator)
            first = len(self.places) - len(path)
            found |= {first + i for i in corners(path[: max(0, end + 1 - first)])}
        switches = {name for name in self._actuators if len({*self._path(name)}) < _FEWEST_VALUES}
        way: list[Place] = []
        for i in sorted(found):
            place, own = self.places[i], self.places[i - 1] if i else None
            if way and own is not None:
                stops = _approach(way[-1], own, place, switches)
                way += [replace(place, setpoints={**place.setpoints, **stop}) for stop in stops]
            way.append(place)
        return way

    def _end(self) -> int:
        """Return the place from which on the way back goes through every one."""
        last = len(self.places) - 1
        end, seconds = last, self.places[last].seconds
        while end and (before := self.places[end - 1]).prompt is self.places[last].prompt:
            if last - end >= _AS_BEFORE and (before.settle is None or seconds >= _LONG_BEFORE):
                break
            end -= 1
            seconds += before.seconds
        return end

    @property
    def _actuators(self) -> set[str]:
        return {name for place in self.places for name in place.setpoints}

    def _path(self, actuator: str) -> list[float]:
        """Return where an actuator has been, from its first set-point on."""
        return [place.setpoints[actuator] for place in self.places if actuator in place.setpoints]

    def check_fresh(self, message: Message) -> None:
        """Check that a fast loop does not go on with a controller whose state the record does not hold.

        Raises ConfigurationError if it does.
        """
        if isinstance(message, FixedRate) and any(message.controller is used for used in self.spent):
            raise ConfigurationError(
                f"the fast loop {message.label!r} goes on with a controller of a loop before it, whose state is not "
                "in the record; the run cannot be resumed from here, carry it out again"
            )

    def settle_at(self, place: Place, period: float) -> Settle:
        """Return how to settle at a place: as the run did, or as it did last where a controller moved the rig."""
        if place.settle is not None:
            return place.settle
        rules = [each.settle for each in self.places if each.settle is not None]
        return rules[-1] if rules else Dwell(_FEWEST_TICKS * period)


def feed(definition: ProtocolDefinition, parameters: ProtocolParameters, slots: Slots, past: Past) -> Fed:
    """Start a protocol, and feed it what was recorded of it, up to its last finished step.

    Parameters that were changed at a pause are changed again, each with the reading that it was changed with.
    What it yields on the way has to be what the record says. A finished `Control` is repeated with the readings that
    its controller saw, which brings the controller to where it was; it has to ask for the same set-points. The
    controller of a finished `FixedRate` cannot be rebuilt, as not each sample is recorded; the protocol may not use
    it again, see `Fed.check_fresh`.

    Raises
    ------
    ConfigurationError
        If the protocol does other than the record says, or fails.
    """
    fed = _feed(definition, definition.start(parameters, slots), past, partial(_change, definition, parameters))
    # Those of the step that the run died in are seen with its reading.
    last = -1 if fed.step is None else fed.step.step
    _change(definition, parameters, [each for each in past.changes if each.step > last])
    return fed


def _change(
    definition: ProtocolDefinition, parameters: ProtocolParameters, changes: Sequence[ParameterChange]
) -> None:
    for each in changes:
        definition.change(parameters, each.name, each.value)


def _feed(
    definition: ProtocolDefinition,
    messages: Messages,
    past: Past,
    change: Callable[[Sequence[ParameterChange]], None],
) -> Fed:
    fed = Fed(messages, past)
    steps, remarks, changes = deque(past.steps), deque(past.remarks), deque(past.changes)
    reading: Reading | None = None
    while True:
        try:
            # The first `send` of a generator has to be that of None.
            message = messages.send(reading)  # type: ignore[arg-type]
        except StopIteration:
            message = None
        except BenchError:
            raise
        except Exception as error:
            raise ConfigurationError(
                f"protocol {definition.name} fails with the readings of the record, so it cannot be resumed: "
                f"{type(error).__name__}: {error}"
            ) from error
        reading = None
        if message is None:
            if steps:
                _differs(definition, f"it ends, where the record has step {steps[0].step} ({steps[0].label})")
            return fed
        if isinstance(message, Phase | Note):
            kind, text = ("phase", message.name) if isinstance(message, Phase) else ("note", message.text)
            if isinstance(message, Phase):
                fed.phase = text
            if not remarks:
                if steps:
                    _differs(definition, f"it yields {message!r} before step {steps[0].step}, which is not recorded")
                fed.message = message
                return fed
            if remarks.popleft() != (kind, text):
                _differs(definition, f"it yields {message!r}, which the record does not have there")
            continue
        if steps and not isinstance(message, Message):
            _differs(definition, f"it yields {message!r}")
        # A step that ended its run was not a reading for the protocol: it is done again.
        while steps and _failed(message, steps[0], past.names):
            steps.popleft()
        if not steps:
            if remarks:
                _differs(definition, f"it yields {message!r}, where the record has the {' '.join(remarks[0])!r}")
            fed.message = message
            return fed
        reading = _Feeding(definition, fed, steps.popleft()).reading_of(message)
        while changes and changes[0].step <= reading.step:
            change([changes.popleft()])


def _approach(start: Place, own: Place, end: Place, switches: Collection[str]) -> list[dict[str, float]]:
    """Return where to stop on the way to a place, for the actuators that go further than the run itself did."""
    # First with a tenth of the way left if that is still more than the run's own step, then where the run came from.
    far, near = {}, {}
    for name, value in end.setpoints.items():
        jump = value - start.setpoints.get(name, value)
        step = value - own.setpoints.get(name, value)
        if name in switches or abs(jump) <= abs(step):
            continue
        if _LAST_PART * abs(jump) > abs(step):
            far[name] = value - _LAST_PART * jump
        # A step from the other side is that of a turn: there is none.
        if step * jump > 0:
            near[name] = value - step
    return [stops for stops in (far, near) if stops]


def _failed(message: Message, record: StepRecord, names: Sequence[str]) -> bool:
    """Return whether a step ended its run: it did not settle, or what was prompted for was not done."""
    if isinstance(message, Prompt) and record.label == PROMPT and message.signal in names:
        return not message.low <= record.values[names.index(message.signal)] <= message.high
    return record.settled.failed


def _differs(definition: ProtocolDefinition, how: str) -> NoReturn:
    raise ConfigurationError(
        f"protocol {definition.name} does other than the record says, so it cannot be resumed: {how}; resume with "
        "the protocol and the files that the run was started with"
    )


class _Feeding:
    """Feeds one step back."""

    def __init__(self, definition: ProtocolDefinition, fed: Fed, record: StepRecord) -> None:
        self._definition = definition
        self._fed = fed
        self._record = record
        self._values = NOT_AT_WORK | dict(zip(fed.past.names, record.values, strict=True))

    def reading_of(self, message: Message) -> Reading:
        """Return the recorded reading for a message, after it was compared with the record."""
        record, fed = self._record, self._fed
        if record.phase != fed.phase:
            self._differs(f"is in phase {fed.phase!r}, in the record in {record.phase!r}")
        expected = message.plan().settled
        if expected is not record.settled:
            self._differs(f"is {message!r}, which does not settle as the record says: {record.settled.value}")
        if isinstance(message, Step):
            self._step(message)
        elif isinstance(message, Control):
            self._control(message)
        elif isinstance(message, FixedRate):
            self._loop(message)
        elif isinstance(message, Prompt):
            self._check_label(PROMPT)
            self._add({}, message.settle, message)
        fed.step = record
        return Reading(record.step, record.finished, record.settled, self._values)

    def _step(self, message: Step) -> None:
        self._check_label(message.label)
        asked = {name: float(value) for name, value in message.setpoints.items()}
        if asked != dict(self._record.setpoints):
            self._differs(f"sets {asked}, in the record {dict(self._record.setpoints)}")
        self._add(asked, message.settle)

    def _control(self, message: Control) -> None:
        record, fed = self._record, self._fed
        self._check_label(message.label)
        names = (message.drive, message.response, *message.others)
        setpoint = f"{message.actuator}{SETPOINT}"
        ticks = fed.past.ticks.ticks_of(record)
        rows = self._seen(ticks)
        command = None
        for k, row in enumerate(rows):
            values = {name: float(column[row]) for name, column in ticks.columns.items()}
            if command is not None and values[setpoint] != command.setpoint:
                self._differs(f"has its controller ask for {command.setpoint!r}, in the record {values[setpoint]!r}")
            ask = message.task.update if k else message.task.begin
            try:
                command = ask(values["t"], *(values[name] for name in names))
            except Exception as error:
                self._differs(f"has its controller fail: {type(error).__name__}: {error}")
            if command.done is not (k == len(rows) - 1):
                self._differs(f"has its controller end after {k + 1} readings, in the record after {len(rows)}")
        assert command is not None
        if {message.actuator: command.setpoint} != dict(record.setpoints):
            self._differs(f"has its controller end at {command.setpoint!r}, in the record {dict(record.setpoints)}")
        # The drive's reading is what the specimen saw; a short set-point is not reached.
        units = fed.past.units
        path = ticks[message.drive if units.get(message.drive) == units.get(setpoint) else setpoint]
        low, high = message.limits or (-math.inf, math.inf)
        finite = path[np.isfinite(path)].tolist()
        for i in self._turns(message.actuator, finite):
            self._add({message.actuator: min(max(finite[i], low), high)}, None)
        self._add(record.setpoints, None)

    def _seen(self, ticks: Table) -> list[int]:
        """Return the rows of a step's telemetry that its controller saw."""
        seen = self._record.seen
        if not seen:
            raise ConfigurationError(
                f"step {self._record.step} was under control, and the record does not say which readings its "
                "controller saw (it is of an older version); the run cannot be resumed, carry it out again"
            )
        times = ticks["t"]
        rows = np.searchsorted(times, seen, side="right") - 1
        if not len(times) or not np.array_equal(times[rows], np.array(seen)):
            self._differs("lacks readings that its controller saw: the record is incomplete")
        found: list[int] = rows.tolist()
        return found

    def _loop(self, message: FixedRate) -> None:
        record, fed = self._record, self._fed
        self._check_label(message.label)
        if set(message.actuators) != set(record.setpoints):
            self._differs(f"moves {', '.join(message.actuators)}, in the record {', '.join(record.setpoints)}")
        if not isinstance(message.controller, Playback):
            fed.spent.append(message.controller)
        ticks = fed.past.ticks.ticks_of(record)
        paths = {name: ticks[f"{name}{SETPOINT}"].tolist() for name in message.actuators}
        turns: set[int] = set()
        for name, path in paths.items():
            if all(map(math.isfinite, path)):
                turns.update(self._turns(name, path))
        for i in sorted(turns):
            self._add({name: path[i] for name, path in paths.items() if math.isfinite(path[i])}, None)
        self._add(record.setpoints, None)

    def _turns(self, actuator: str, path: Sequence[float]) -> list[int]:
        """Return where a controller turned; of its many turns, as readings have noise, a specimen remembers these."""
        if not path:
            return []
        been = [place.setpoints[actuator] for place in self._fed.places if actuator in place.setpoints]
        turns: list[int] = turning_points(path, _LEAST_TURN * float(np.ptp([*been, *path]))).tolist()
        return turns

    def _add(self, setpoints: Mapping[str, float], settle: Settle | None, prompt: Prompt | None = None) -> None:
        """Note where the actuators are now; a further wait in the same place makes it longer."""
        places = self._fed.places
        seconds = 0.0 if settle is None else self._record.finished - self._record.started
        if not places:
            places.append(Place(dict(setpoints), settle, prompt, seconds))
            return
        before = places[-1]
        there = {**before.setpoints, **setpoints}
        if there != before.setpoints or prompt is not None:
            places.append(Place(there, settle, prompt or before.prompt, seconds))
        elif isinstance(settle, Dwell) and isinstance(before.settle, Dwell):
            dwell = Dwell(before.settle.seconds + settle.seconds)
            places[-1] = replace(before, settle=dwell, seconds=before.seconds + seconds)

    def _check_label(self, label: str) -> None:
        if label != self._record.label:
            self._differs(f"is labelled {label!r}, in the record {self._record.label!r}")

    def _differs(self, how: str) -> NoReturn:
        _differs(self._definition, f"step {self._record.step} {how}")
