"""A station whose devices are in this process: emulated ones as a rule."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import NoReturn, TypeVar

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError
from bench.devices import Floats, Status
from bench.execution.station.core import StationCore
from bench.execution.station.interface import Arrivals, News, Station, counted, news_of
from bench.execution.station.reconnection import TRIES, Absence
from bench.rig import InterlockFinding, InterlockWatch, Look, Rig, longest_away, make_safe, raise_if_unsafe

_T = TypeVar("_T")

_SLOW = 0.2
"""Time from which on the answer of a device is late, s."""
_JUST_BEFORE = 10.0
"""Time within which what kept a watchdog from being fed may be the cause of an error, s."""


class LocalStation(Station):
    """A station on a rig of this process, driven by the clock of the run in the caller's thread.

    Parameters
    ----------
    rig : Rig
        Connected devices.
    interlock_rate : float, optional
        Looks at the interlocks in a laboratory second, Hz, beside those with each reading and each tick of the
        telemetry. None for no others: on a virtual clock each look costs as much as a tick.
    """

    def __init__(self, rig: Rig, interlock_rate: float | None = None) -> None:
        self._rig = rig
        self.clock = rig.clock
        self.description = rig.description
        watch = InterlockWatch(rig.file.interlocks, {each.name: each.display for each in rig.signals})
        self._core = StationCore(watch, 1.0 / interlock_rate if interlock_rate else math.inf)
        self._watched = watch.signals
        self._watching = rig.watching(watch.signals)
        self._core.begin(self.clock.now())
        self._statuses: list[Status] = []
        self._news: list[News] = []
        self._safe: Mapping[str, str] | None = None
        self._lost: set[str] = set()
        self._away: set[str] = set()
        self._slow: dict[str, tuple[float, float]] = {}
        """When a device that took long had answered or failed, and how long it took, s."""
        self._longest_away = longest_away(rig.file, rig.devices)

    @property
    def has_operator(self) -> bool:
        """Whether an emulated laboratory does what a prompt asks for."""
        return self._rig.laboratory is not None

    @property
    def is_holding(self) -> bool:
        """Whether an interlock has the set-points stand until its signal is back."""
        return self._core.holding

    def take_pause(self) -> str:
        """Return why an interlock asks for a pause, once; empty if none does."""
        pause, self._core.pause = self._core.pause, ""
        return pause

    def promise(self, seconds: float, why: str) -> None:
        """Promise that each request from now on is followed by the next one within so many seconds."""
        self._core.promise(seconds, why)

    def look(self, look: Look, wanted: Collection[str] = ()) -> dict[str, float]:
        """Read the devices; values by signal name."""
        readers = self._rig.readers(look, wanted)
        lost: set[str] = set()
        for _ in range(TRIES):
            self._lost.clear()
            try:
                values = self._rig.assembled({name: self._ask(name, read) for name, read in readers.items()})
            except DeviceError as error:
                self._raise_blamed(error, lost | self._lost)
            # What other devices gave before a line was back is too old to stand beside it.
            if not self._lost:
                break
            lost |= self._lost
        return values

    def quick_reader(self, wanted: Collection[str]) -> Callable[[], dict[str, float]]:
        """Return a function that takes a quick reading of the devices that some signals come from."""
        read = self._rig.quick_reader(wanted)

        def read_again() -> dict[str, float]:
            try:
                return read()
            except DeviceConnectionError:
                return self.look(Look.PART, wanted)

        return read_again

    def mover(self, actuators: Sequence[str]) -> Callable[[Sequence[float]], None]:
        """Return a function that sends those of some set-points that have changed."""
        devices = [self._rig.actuator(name) for name in actuators]
        core = self._core
        core.arm()

        def move(setpoints: Sequence[float]) -> None:
            if core.over:
                core.raise_if_over()
            changed = []
            # A comprehension would be one call more.
            for each in zip(devices, setpoints, strict=True):
                if each[1] != each[0].setpoint:
                    changed.append(each)
            # None is sent when another is wrong; of one alone `set` sees it by itself.
            if len(changed) > 1:
                for actuator, value in changed:
                    actuator.check(value)
            for actuator, value in changed:
                self._ask(actuator.name, partial(actuator.set, value))

        return move

    def block_player(
        self, inputs: Sequence[str], actuators: Sequence[str], period: float
    ) -> Callable[[Floats], Floats] | None:
        """Return what has an instrument carry out blocks of samples by itself; None if none can."""
        self._core.arm()
        return self._rig.block_player(inputs, actuators, period)

    def check(self, setpoints: Mapping[str, Sequence[float]]) -> None:
        """Raise LimitError if a device does not take one of its set-points; nothing is sent."""
        self._rig.check(setpoints)

    def apply(self, setpoints: Mapping[str, float]) -> None:
        """Send set-points; all are checked before any is sent."""
        self._core.raise_if_over()
        self.check({name: (value,) for name, value in setpoints.items()})
        self._core.arm()
        self._statuses = []
        for name, value in setpoints.items():
            self._statuses.append(self._ask(name, partial(self._rig.actuator(name).set, value)))

    def rest(self) -> None:
        """Bring every device into its safe state for a while."""
        self._core.raise_if_over()
        raise_if_unsafe(self._made_safe())

    def tare(self, device: str) -> None:
        """Make the present force of a load cell read zero."""
        self._ask(device, self._rig.load_cell(device).tare)

    def setpoint(self, device: str) -> float:
        """Return the set-point that was last sent to a device; nan before the first."""
        return self._rig.actuator(device).setpoint

    def arrivals(self) -> Arrivals:
        """Ask the devices that were sent set-points last how far they have come."""
        waiting = [status.device for status in self._statuses if not self._ask(status.device, status.ask)]
        errors = (status.exception() for status in self._statuses)
        return Arrivals(tuple(waiting), next((each for each in errors if isinstance(each, Exception)), None))

    def judge(self, t: float, values: Mapping[str, float]) -> None:
        """Judge readings that were recorded by the interlocks."""
        core = self._core
        self._note(core.judge(t, values))
        if core.cause is not None:
            raise core.cause

    def sleep_until(self, instant: float) -> None:
        """Let laboratory time pass up to an instant, s; looks at the interlocks that are due on the way are taken."""
        while (due := self._core.due()) < instant and not self.clock.interrupted():
            self.clock.sleep_until(due)
            now = self.clock.now()
            self._core.advance(now)
            if self._core.look_due(now):
                self._note(self._core.judge(now, self.look(Look.PART, self._watched), self._rig.setpoints))
            self._raise_if_tripped()
        self.clock.sleep_until(instant)

    def operate(self, task: str, value: float) -> None:
        """Have done by hand, in an emulated laboratory, what a prompt asks for."""
        if self._rig.laboratory is None:
            raise ConfigurationError("there is no emulated laboratory that could do it")
        self._rig.laboratory.operate(task, value)

    def news(self) -> list[News]:
        """Return what happened since the last call, oldest first."""
        if not self._news:
            return []
        news, self._news = self._news, []
        return news

    def end(self) -> Mapping[str, str]:
        """Bring every device into its safe state; return by device `safe`, or what went wrong."""
        self._core.end()
        if self._safe is None:
            self._safe = self._made_safe()
            self._news += counted(self._rig.devices.values())
        return self._safe

    def close(self) -> None:
        """Release the lines; each device keeps the state that it is in."""
        self._rig.close()

    def _made_safe(self) -> dict[str, str]:
        order = self._rig.file.safety.order
        ranks = {name: order.index(name) if name in order else len(order) for name in self._rig.devices}
        # Those that have no order come after the others, as they stand, and what is silent after what answers.
        ranked = sorted(ranks, key=lambda name: (ranks[name], name in self._away))
        return make_safe(self._rig.devices[name] for name in ranked)

    def _ask(self, name: str, call: Callable[[], _T]) -> _T:
        began = self.clock.now()
        try:
            return call()
        except DeviceConnectionError as error:
            self._reconnect(name, error, began)
            return call()
        finally:
            now = self.clock.now()
            if now - began > _SLOW:
                self._slow[name] = now, now - began

    def _raise_blamed(self, error: DeviceError, lost: Collection[str]) -> NoReturn:
        """Raise an error that also names the devices that kept the others waiting, which may be the cause of it."""
        since = self.clock.now() - _JUST_BEFORE
        others = {name: f"took {took:.1f} s to answer" for name, (t, took) in self._slow.items() if t >= since}
        others |= dict.fromkeys(lost, "had been out of reach")
        others.pop(error.device, None)
        if not others:
            raise error
        causes = ", ".join(f"{name} {what}" for name, what in sorted(others.items()))
        # The error itself, as a driver's own class may be made in another way.
        error.text = f"{error.text} ({causes} just before)"
        error.args = (f"{error.device}: {error.text}",)
        raise error

    def _reconnect(self, name: str, error: DeviceConnectionError, since: float) -> None:
        self._away.add(name)
        absence = Absence(self._rig.devices[name], error, self.clock, self._longest_away[name], since)
        # Those that share its line have waited for it.
        self._look_at_others()
        while (seconds := absence.try_again()) is None:
            self._look_at_others()
            self.clock.sleep_until(absence.due)
        self._away.discard(name)
        self._lost.add(name)
        self._news.append(News("WARN", "line", f"{name}: line lost for {seconds:.1f} s: {error}"))

    def _look_at_others(self) -> None:
        """Judge what the devices that are not away show by the interlocks; this feeds their watchdogs as well."""
        readings = {}
        for name, read in self._watching.items():
            if name not in self._away:
                # One that is silent as well is looked for once this one is back.
                with suppress(DeviceConnectionError):
                    readings[name] = read()
        values = self._rig.assembled(readings)
        self._note(self._core.judge(self.clock.now(), values, self._rig.setpoints))
        self._raise_if_tripped()

    def _note(self, findings: tuple[InterlockFinding, ...]) -> None:
        if findings:
            self._news += news_of(findings)

    def _raise_if_tripped(self) -> None:
        if self._core.cause is not None:
            raise self._core.cause
