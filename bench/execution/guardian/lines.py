"""One thread a line: several instruments are asked at the same time, and one that hangs delays no other."""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from bench.base import Clock, DeviceConnectionError
from bench.devices import Device
from bench.execution.station.reconnection import reconnect

SAFE, BENCH, LOOK = range(3)
"""Priorities of calls that wait for their line: the safe state, requests of the bench, looks at the interlocks."""


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
    number: int
    device: str = field(compare=False)
    call: Callable[[], Any] = field(compare=False)
    done: Callable[[Result], None] = field(compare=False)


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
        Returns for how long the line of a device may be away, s.
    notify : callable
        Called in the thread of a line with the name of a device whose line was away, for how long (s), and why.
    """

    def __init__(
        self,
        devices: Mapping[str, Device],
        lines: Mapping[str, str],
        clock: Clock,
        longest: Callable[[str], float],
        notify: Callable[[str, float, str], None],
    ) -> None:
        self._devices = devices
        self._clock = clock
        self._longest = longest
        self._notify = notify
        self._ending = threading.Event()
        self._lines = lines
        self._lost: dict[str, str] = {}
        self._numbers = itertools.count()
        queues: dict[str, queue.PriorityQueue[_Call]] = {line: queue.PriorityQueue() for line in lines.values()}
        self._queues = {name: queues[line] for name, line in lines.items()}
        for line, calls in queues.items():
            threading.Thread(target=self._work, args=(calls,), name=f"line {line}", daemon=True).start()

    def submit(self, priority: int, device: str, call: Callable[[], Any], done: Callable[[Result], None]) -> None:
        """Have something done on the line of a device; `done` is called in its thread."""
        self._queues[device].put(_Call(priority, next(self._numbers), device, call, done))

    def end(self) -> None:
        """Wait for no line any more: what still waits is dropped but for the safe state."""
        self._ending.set()

    def _work(self, calls: queue.PriorityQueue[_Call]) -> None:
        while True:
            call = calls.get()
            try:
                result = self._carry(call)
            # An error of a driver, of whatever kind, is the answer to its call; the thread goes on.
            except BaseException as error:
                result = Result(call.device, None, error, was_away=False)
            # The thread is needed for the safe state, whatever becomes of an answer.
            with suppress(Exception):
                call.done(result)

    def _carry(self, call: _Call) -> Result:
        if call.priority != SAFE and self._ending.is_set():
            raise DeviceConnectionError(call.device, "was not asked, as the run has ended")
        line = self._lines[call.device]
        if call.priority != SAFE and line in self._lost:
            # That ends the run: each device of a lost line would take as long again to say so.
            raise DeviceConnectionError(call.device, f"was not asked, as its line is lost ({self._lost[line]})")
        try:
            return Result(call.device, call.call(), None, was_away=False)
        except DeviceConnectionError as lost:
            # The safe state opens a line of its own.
            if call.priority == SAFE or self._ending.is_set():
                raise
            device = self._devices[call.device]
            try:
                seconds = reconnect(device, lost, self._clock, self._longest(call.device), self._ending.is_set)
            except DeviceConnectionError as gone:
                self._lost[line] = str(gone)
                raise
            self._notify(call.device, seconds, str(lost))
            # A set-point that waited for its line may not be sent after the end.
            if self._ending.is_set():
                raise
            return Result(call.device, call.call(), None, was_away=True)
