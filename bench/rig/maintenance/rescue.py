"""Making every instrument of a rig safe, each in whichever state it is."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from bench.base import Clock, DeviceError, Stopwatch
from bench.devices import Actuator
from bench.rig.file import DeviceEntry
from bench.rig.maintenance.locks import port_of
from bench.rig.maintenance.opening import Workplace
from bench.rig.maintenance.safe_state import SAFE

_TRY_AGAIN = 1.0
"""Wall-clock time (s) from the end of a try to the next one, and between two reports."""

_SLICE = 0.1
"""Longest single wait, s, so that an interruption is noticed soon."""

_SENSORS = 3.0
"""Wall-clock time (s) for which a device without an output is waited for."""

UNANSWERED = "has not answered yet"
"""State of a device before its first try has ended."""

MEASURES_ONLY = "measures only"
"""State of a device without an output that could not be reached."""


@dataclass(frozen=True)
class Rescued:
    """What became of a device.

    Attributes
    ----------
    device : str
        Its name.
    state : str
        `safe`, `measures only`, or what went wrong.
    advice : str
        What to do; empty if nothing has to be done.
    """

    device: str
    state: str
    advice: str

    @property
    def is_safe(self) -> bool:
        """Whether the device is known to be safe."""
        return self.state in (SAFE, MEASURES_ONLY)


def rescue(
    place: Workplace, is_ended: Callable[[], bool] = lambda: False, limit: float = math.inf
) -> Iterator[tuple[float, list[Rescued]]]:
    """Bring every device into its safe state, and try again until each is confirmed to be in it.

    The lines are tried in parallel, actuators first on each. A device that is not confirmed is tried again each
    second. One without an output is tried once.

    Parameters
    ----------
    place : Workplace
        The lines.
    is_ended : callable
        Asked several times a second; when it returns True no device is tried again.
    limit : float
        Wall-clock time after which no device is tried again, s.

    Yields
    ------
    seconds : float
        Wall-clock time that it has taken so far.
    found : list of Rescued
        One a device, in the order of the rig file: when one has changed, each second, and at the end.
    """
    tries = _Tries(place)
    stopwatch = Stopwatch()
    last: list[Rescued] = []
    reported = 0.0
    while True:
        is_over = tries.wait(_SLICE)
        seconds, found = stopwatch.seconds(), tries.found()
        is_over = is_over or (seconds >= _SENSORS and all(each.is_safe for each in found))
        if is_over or is_ended() or seconds >= limit:
            break
        if found != last or seconds - reported >= _TRY_AGAIN:
            yield seconds, found
            last, reported = found, seconds
    tries.end()
    yield seconds, found


class _Tries:
    """Threads that make the devices of a workplace safe, one a line, begun at once."""

    def __init__(self, place: Workplace) -> None:
        self._entries = place.entries
        self._states = dict.fromkeys((entry.name for entry in place.entries), UNANSWERED)
        self._ended = threading.Event()
        self._threads = []
        for entries in place.lines.values():
            ordered = sorted(entries, key=lambda entry: not issubclass(entry.driver, Actuator))
            # A line that hangs must not keep the process from its end.
            thread = threading.Thread(target=self._work, args=(ordered, place.clock), daemon=True)
            self._threads.append(thread)
        for thread in self._threads:
            thread.start()

    def wait(self, seconds: float) -> bool:
        """Wait for so long at most; return whether nothing is left to be done."""
        stopwatch = Stopwatch()
        for thread in self._threads:
            thread.join(max(0.0, seconds - stopwatch.seconds()))
        return not any(thread.is_alive() for thread in self._threads)

    def end(self) -> None:
        """Try nothing again."""
        self._ended.set()

    def found(self) -> list[Rescued]:
        """Return what has become of each device so far."""
        return [_judged(entry, self._states[entry.name]) for entry in self._entries]

    def _work(self, entries: list[DeviceEntry], clock: Clock) -> None:
        while entries and not self._ended.is_set():
            for entry in entries:
                self._try(entry, clock)
            entries = [entry for entry in entries if not _judged(entry, self._states[entry.name]).is_safe]
            if entries:
                self._ended.wait(_TRY_AGAIN)

    def _try(self, entry: DeviceEntry, clock: Clock) -> None:
        try:
            entry.driver.rescue(entry.name, entry.settings, clock)
            state = SAFE
        # Nothing may keep the next device from being tried, a defect of a driver included.
        except Exception as error:
            state = (error.text if isinstance(error, DeviceError) else str(error)) or type(error).__name__
        self._states[entry.name] = state


def _judged(entry: DeviceEntry, state: str) -> Rescued:
    if state == SAFE:
        return Rescued(entry.name, SAFE, "")
    if not issubclass(entry.driver, Actuator):
        return Rescued(entry.name, MEASURES_ONLY, "")
    port = port_of(entry.settings)
    advice = f"unplug what {entry.name} drives, or the power supply of the instrument at {port}: it may be on"
    return Rescued(entry.name, state, advice)
