"""One thread a line: several instruments are asked at the same time, and one that hangs delays no other.

The devices of a line are asked in turn. While one of them is away, the others are served between two attempts to
reach it, and what it was asked waits for it.
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from bench.base import Clock, DeviceConnectionError
from bench.devices import Device
from bench.execution.station.reconnection import Absence
from bench.rig import LongestAbsence

SAFE, BENCH, LOOK = range(3)
"""Priorities of calls that wait for their line: the safe state, requests of the bench, looks at the interlocks."""

_NAP = 0.02
"""Time after which the calls of a line are looked at again while one of its devices is away, s."""


class NotAskedError(DeviceConnectionError):
    """A device was not asked, as the run has ended or the device is lost."""


@dataclass(frozen=True)
class Result:
    """What came of a call of a device; `was_away` is whether its line was lost and came back meanwhile."""

    device: str
    value: Any
    error: BaseException | None
    was_away: bool


@dataclass(order=True)
class _Call:
    priority: int
    is_away: bool
    number: int
    device: str = field(compare=False)
    since: float = field(compare=False)
    call: Callable[[], Any] = field(compare=False)
    done: Callable[[Result], None] = field(compare=False)


@dataclass
class _Away:
    """A device that is away, and the calls that wait for it."""

    absence: Absence
    waiting: list[_Call]


class LineThreads:
    """The lines of a rig, each with a thread of its own.

    Parameters
    ----------
    devices : mapping of str to Device
        By name.
    lines : mapping of str to str
        Line of each device, by name.
    clock : Clock
        The clock of the run.
    longest : callable
        Returns for how long the line of a device may be away.
    notify : callable
        Called in the thread of a line with the name of a device whose line was away, for how long (s), and why.

    Attributes
    ----------
    late : dict of str to float
        Longest time for which a call has waited for its turn, by device, s.
    """

    def __init__(
        self,
        devices: Mapping[str, Device],
        lines: Mapping[str, str],
        clock: Clock,
        longest: Callable[[str], LongestAbsence],
        notify: Callable[[str, float, str], None],
    ) -> None:
        self._devices = devices
        self._clock = clock
        self._longest = longest
        self._notify = notify
        self._ending = threading.Event()
        self.late = dict.fromkeys(devices, 0.0)
        self._away: dict[str, _Away] = {}
        self._lost: dict[str, str] = {}
        self._numbers = itertools.count()
        queues: dict[str, queue.PriorityQueue[_Call]] = {line: queue.PriorityQueue() for line in lines.values()}
        self._queues = {name: queues[line] for name, line in lines.items()}
        for line, calls in queues.items():
            threading.Thread(target=self._work, args=(calls,), name=f"line {line}", daemon=True).start()

    def submit(self, priority: int, device: str, call: Callable[[], Any], done: Callable[[Result], None]) -> None:
        """Have something done on the line of a device; `done` is called in its thread."""
        # The safe state of those that answer does not wait for one that is silent.
        is_away = device in self._away or device in self._lost
        self._queues[device].put(_Call(priority, is_away, next(self._numbers), device, self._clock.now(), call, done))

    def end(self) -> None:
        """Wait for no line any more: what still waits is dropped but for the safe state."""
        self._ending.set()

    def _work(self, calls: queue.PriorityQueue[_Call]) -> None:
        away: list[str] = []
        while True:
            call = self._next(calls, away)
            before = len(away)
            if call is not None:
                self._serve(call, away)
            # A device that has just been missed has had its turn.
            if away and len(away) == before:
                # One attempt at most between two calls, each device in its turn.
                device = min(away, key=self._due)
                if self._due(device) <= self._clock.now() or self._ending.is_set():
                    self._try_again(device, away)

    def _due(self, device: str) -> float:
        return self._away[device].absence.due

    def _next(self, calls: queue.PriorityQueue[_Call], away: Sequence[str]) -> _Call | None:
        """Return the next call; None after a while if a device has to be looked after."""
        if not away:
            return calls.get()
        with suppress(queue.Empty):
            return calls.get_nowait()
        next_attempt = min(map(self._due, away))
        self._clock.sleep_until(min(next_attempt, self._clock.now() + _NAP))
        return None

    def _serve(self, call: _Call, away: list[str]) -> None:
        """Carry a call out, or let it wait for its device."""
        device, now = call.device, self._clock.now()
        self.late[device] = max(self.late[device], now - call.since)
        try:
            if call.priority != SAFE:
                if self._ending.is_set():
                    raise NotAskedError(device, "was not asked, as the run has ended")
                if device in self._lost:
                    raise NotAskedError(device, f"was not asked, as it is lost ({self._lost[device]})")
                if device in away:
                    self._away[device].waiting.append(call)
                    return
            result = Result(device, call.call(), None, was_away=False)
        except DeviceConnectionError as lost:
            # The safe state opens a line of its own.
            if call.priority == SAFE or self._ending.is_set() or device in self._lost:
                result = Result(device, None, lost, was_away=False)
            else:
                self._miss(call, lost, now, away)
                return
        # An error of a driver, of whatever kind, is the answer to its call; the thread goes on.
        except BaseException as error:
            result = Result(device, None, error, was_away=False)
        _answer(call, result)

    def _miss(self, call: _Call, lost: DeviceConnectionError, since: float, away: list[str]) -> None:
        """Look for the device of a call that has failed; the call began at `since`, s."""
        device = call.device
        try:
            absence = Absence(self._devices[device], lost, self._clock, self._longest(device), since)
        except BaseException as error:
            self._give_up(device, [call], error)
        else:
            self._away[device] = _Away(absence, [call])
            away.append(device)

    def _try_again(self, device: str, away: list[str]) -> None:
        """Try to reach a device; if it is back, carry out what has waited for it."""
        absence, waiting = self._away[device].absence, self._away[device].waiting
        try:
            if self._ending.is_set():
                raise absence.lost
            seconds = absence.try_again()
        except BaseException as error:
            self._return(device, away)
            self._give_up(device, waiting, error)
            return
        if seconds is None:
            return
        self._return(device, away)
        with suppress(Exception):
            self._notify(device, seconds, str(absence.lost))
        for call in waiting:
            try:
                # A set-point that waited for its line may not be sent after the end.
                if self._ending.is_set():
                    raise absence.lost
                result = Result(device, call.call(), None, was_away=True)
            except BaseException as error:
                result = Result(device, None, error, was_away=False)
            _answer(call, result)

    def _return(self, device: str, away: list[str]) -> None:
        away.remove(device)
        del self._away[device]

    def _give_up(self, device: str, waiting: Iterable[_Call], error: BaseException) -> None:
        """Answer what has waited for a device with an error."""
        if isinstance(error, DeviceConnectionError):
            self._lost[device] = str(error)
        for call in waiting:
            _answer(call, Result(device, None, error, was_away=False))


def _answer(call: _Call, result: Result) -> None:
    # The thread is needed for the safe state, whatever becomes of an answer.
    with suppress(Exception):
        call.done(result)
