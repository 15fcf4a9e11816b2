"""The one clock: holds, time stamps, emulated instruments and watchdogs all read it.

Nothing else in the bench reads or spends time. Where all instruments are emulated in this process, laboratory time
passes only by `sleep`: on the virtual clock a hold of 8 s costs only what the samples within it cost, and a paced
clock waits in each sleep until the wall clock has caught up. A busy machine then slows the laboratory down, and no
emulated watchdog trips because of it; two runs with one seed are equal to the last digit. Real instruments, and
emulated ones that other processes use, run by themselves: on the wall clock or a scaled one.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from bench.base.errors import ConfigurationError

VIRTUAL_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
"""Where every virtual clock begins, so that runs with one seed carry the same time stamps."""

_LONGEST_NAP = 0.2
"""Longest single wait in seconds, so that a signal to the process is noticed soon."""

_SHORTEST_NAP = 1e-3
"""Lead in s from which a paced clock waits: shorter naps are inexact, so the sleeps of single bytes are collected."""

_MOST_CATCHING_UP = 0.2
"""Lateness in s that a paced clock makes up for by running fast; what is beyond is lost."""

LEAST_PARTING = 1.0
"""Difference in s between laboratory time and time of day from which a wall clock notices that it has grown."""

SHORTEST_SUSPENSION = 1.0
"""Suspension of the machine in s from which a wall clock notices it."""

_CLOCK_WITH_SUSPENSION: int | None = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))
"""System clock that goes on while the machine is suspended, which `time.monotonic` does not: on Linux its boot time,
on macOS CLOCK_MONOTONIC. Windows has none that can be read here; there `time.monotonic` itself goes on."""


_PROBE = 0.01
"""Processor time in s by which slowness is measured: several slices that Linux gives at once, of some 3 ms each
(`sched(7)`, EEVDF), so that others come in between."""


BUSY = 1.5
"""Slowness from which on a computer counts as busy. Source: a choice; one other process on each core makes it 2."""


class Clock(ABC):
    """Laboratory time in seconds since the clock was made.

    Attributes
    ----------
    epoch : datetime
        Time of day (UTC) at which `now()` was zero.
    factor : float
        Laboratory seconds in a second of the wall clock, at most; infinite if only the computer limits them.
    sleep_waits : bool
        Whether `sleep` takes wall-clock time, so that a loop of sleeps lasts until someone acts.
    interrupted : callable
        Asked during every sleep that waits; when it returns True the sleep ends early.
    """

    epoch: datetime
    factor: float = 1.0
    sleep_waits: bool = True

    def __init__(self) -> None:
        self.interrupted: Callable[[], bool] = lambda: False

    @abstractmethod
    def now(self) -> float:
        """Return the laboratory time in seconds since the epoch of this clock; it never goes back."""

    @abstractmethod
    def sleep(self, seconds: float) -> None:
        """Let laboratory time pass.

        Parameters
        ----------
        seconds : float
            How long, in laboratory seconds; zero and negative values return at once.

        Raises
        ------
        ValueError
            If `seconds` is not finite.
        """

    def sleep_until(self, instant: float) -> None:
        """Let laboratory time pass until `now()` is `instant` (s); an instant in the past returns at once."""
        self.sleep(instant - self.now())

    def go_on(self, epoch: datetime, last: float) -> None:  # noqa: ARG002
        """Go on with the laboratory time of a run that died, before anything else has read this clock.

        Parameters
        ----------
        epoch : datetime
            Where that time began.
        last : float
            How far it is known to have come, s.

        Raises
        ------
        ConfigurationError
            If this clock cannot go on with it.
        """
        raise ConfigurationError("this clock cannot go on with the time of another run")

    def suspension(self) -> float:
        """Return for how many seconds the machine was suspended since the last call; 0 where it cannot matter."""
        return 0.0

    def parting(self) -> float:
        """Return by how many seconds the time of day was set forward, or back, since the last call.

        0 where that is less than 1 s, or where laboratory time has nothing to do with the time of day.
        """
        return 0.0

    def timestamp(self) -> float:
        """Return the laboratory time as seconds since 1970-01-01 UTC."""
        return self.epoch.timestamp() + self.now()

    def date(self) -> datetime:
        """Return the laboratory time as a time of day, in UTC."""
        return self.epoch + timedelta(seconds=self.now())


def _seconds_with_suspension() -> float:
    return time.monotonic() if _CLOCK_WITH_SUSPENSION is None else time.clock_gettime(_CLOCK_WITH_SUSPENSION)


class WallClock(Clock):
    """Wall-clock time: a second is a second. It stands still while the machine is suspended, except on Windows.

    Parameters
    ----------
    running, passing : callable, optional
        Sources of time in s: one that stands still while the machine is suspended, and one that goes on.
    of_day : callable, optional
        Source of the time of day, s since 1970, which somebody or the network may set.
    """

    def __init__(
        self,
        running: Callable[[], float] = time.monotonic,
        passing: Callable[[], float] = _seconds_with_suspension,
        of_day: Callable[[], float] = time.time,
    ) -> None:
        super().__init__()
        self.epoch = datetime.now(UTC)
        self._running = running
        self._passing = passing
        self._start = running()
        self._lag = passing() - self._start
        self._of_day = of_day
        self._ahead = self._time_of_day_ahead()

    def now(self) -> float:
        """Return seconds since the clock was made."""
        return self._running() - self._start

    def go_on(self, epoch: datetime, last: float) -> None:
        """Go on as if this clock had run since the epoch; a wall clock that was set back does not go back here."""
        passed = (datetime.now(UTC) - epoch).total_seconds()
        self.epoch = epoch
        self._start -= max(last, passed) - self.now()

    def sleep(self, seconds: float) -> None:
        """Wait, in naps short enough for signals to be handled between them."""
        _check_finite(seconds)
        end = self._running() + seconds
        while (left := end - self._running()) > 0 and not self.interrupted():
            time.sleep(min(left, _LONGEST_NAP))

    def suspension(self) -> float:
        """Return for how many seconds the machine was suspended since the last call, if it was for 1 s or longer."""
        # In this order: what passes between the two calls makes the lag smaller, and is no suspension.
        passed = self._passing()
        lag = passed - self._running()
        grown = lag - self._lag
        if grown < SHORTEST_SUSPENSION:
            return 0.0
        self._lag = lag
        return grown

    def parting(self) -> float:
        """Return by how many seconds the time of day was set since the last call, if it was by more than 1 s.

        A suspension of the machine is none: the time of day goes on meanwhile as it should.
        """
        least, most = self._time_of_day_ahead()
        forward, back = least - self._ahead[1], self._ahead[0] - most
        if max(forward, back) <= LEAST_PARTING:
            return 0.0
        self._ahead = least, most
        return forward if forward > back else -back

    def _time_of_day_ahead(self) -> tuple[float, float]:
        """Return bounds of the lead of the time of day, s: a busy machine may wait between two readings."""
        before = self._passing()
        of_day = self._of_day()
        return of_day - self._passing(), of_day - before


class ScaledClock(Clock):
    """Wall-clock time, `factor` times as fast, for emulated instruments that other processes use.

    It goes on whatever this process does, as their clients wait for nothing else.

    Parameters
    ----------
    factor : float
        Laboratory seconds per wall-clock second; positive.

    Raises
    ------
    ValueError
        If `factor` is not a positive finite number.
    """

    def __init__(self, factor: float) -> None:
        _check_factor(factor)
        super().__init__()
        self.factor = factor
        self._wall = WallClock()
        self.epoch = self._wall.epoch

    def now(self) -> float:
        """Return laboratory seconds since the clock was made."""
        return self._wall.now() * self.factor

    def sleep(self, seconds: float) -> None:
        """Wait `seconds / factor` wall-clock seconds."""
        _check_finite(seconds)
        self._wall.interrupted = self.interrupted
        self._wall.sleep(seconds / self.factor)


class VirtualClock(Clock):
    """A clock that jumps: sleeping takes no wall-clock time.

    Only one thread should let time pass, the one that carries the run out; any thread may read the time.
    """

    sleep_waits = False
    factor = math.inf

    def __init__(self) -> None:
        super().__init__()
        self.epoch = VIRTUAL_EPOCH
        self._now = 0.0
        self._parted = 0.0

    def now(self) -> float:
        """Return laboratory seconds since the clock was made."""
        return self._now

    def go_on(self, epoch: datetime, last: float) -> None:
        """Go on where that time ended: without a process there was no laboratory in which it could pass."""
        self.epoch = epoch
        self._now = last

    def set_time_of_day(self, seconds: float) -> None:
        """Set the time of day forward by so many seconds, or back, as `parting` then says."""
        self._parted += seconds

    def parting(self) -> float:
        """Return by how many seconds the time of day was set since the last call."""
        parted, self._parted = self._parted, 0.0
        return parted

    def sleep(self, seconds: float) -> None:
        """Jump ahead."""
        if 0.0 < seconds < math.inf:
            self._pass_until(self._now + seconds)
        else:
            _check_finite(seconds)

    def sleep_until(self, instant: float) -> None:
        """Jump to `instant` exactly, free of the rounding that adding up differences would bring."""
        if not -math.inf < instant < math.inf:
            _check_finite(instant)
        if instant > self._now:
            self._pass_until(instant)

    def _pass_until(self, instant: float) -> None:
        """Let laboratory time pass up to an instant that is to come, s."""
        self._now = instant


@dataclass(frozen=True)
class Pace:
    """How fast a paced clock went.

    Attributes
    ----------
    asked : float
        Laboratory seconds per wall-clock second that were asked for.
    reached : float
        Those that were reached.
    """

    asked: float
    reached: float

    @property
    def is_reached(self) -> bool:
        """Whether at least 90 % of what was asked for was reached."""
        return self.reached >= 0.9 * self.asked

    def __str__(self) -> str:
        return f"x{self.asked:g} asked for, x{self.reached:.3g} reached"


class PacedClock(VirtualClock):
    """A virtual clock that waits: after each sleep until the wall clock has caught up, for people who watch.

    Laboratory time passes only by `sleep`, so it never runs ahead of what the process has done: on a busy machine
    the laboratory slows down instead. Readings are those of the virtual clock. A process that is late makes up for
    0.2 s of wall-clock time at most.

    Parameters
    ----------
    factor : float
        Laboratory seconds per wall-clock second at most; positive. A process that cannot reach it never waits.

    Raises
    ------
    ValueError
        If `factor` is not a positive finite number.
    """

    sleep_waits = True

    def __init__(self, factor: float) -> None:
        _check_factor(factor)
        super().__init__()
        self.factor = factor
        self.epoch = datetime.now(UTC)
        # Wall-clock instant at which laboratory time would have been zero at this pace.
        self._origin = time.monotonic()
        self.restart_pace()

    def go_on(self, epoch: datetime, last: float) -> None:
        """Go on where that time ended."""
        super().go_on(epoch, last)
        self._origin = time.monotonic() - last / self.factor
        self.restart_pace()

    def restart_pace(self) -> None:
        """Begin to measure the pace here."""
        self._pace_since = self._now, time.monotonic()

    def pace(self) -> Pace:
        """Return the pace since the clock was made or `restart_pace` was called."""
        laboratory, wall = self._pace_since
        passed = time.monotonic() - wall
        return Pace(self.factor, (self._now - laboratory) / passed if passed > 0 else self.factor)

    def _pass_until(self, instant: float) -> None:
        """Wait until the wall clock has caught up, then let laboratory time pass."""
        due = self._origin + instant / self.factor
        while (left := due - time.monotonic()) >= _SHORTEST_NAP:
            if self.interrupted():
                # As far as the wall clock is; a loop of interrupted sleeps comes to its end as on the wall clock.
                reached = (time.monotonic() - self._origin) * self.factor
                self._now = max(self._now, min(instant, reached))
                return
            time.sleep(min(left, _LONGEST_NAP))
        self._now = instant
        if -left > _MOST_CATCHING_UP:
            self._origin -= left + _MOST_CATCHING_UP


class Stopwatch:
    """Wall-clock seconds since it was made, to report how long work took; never for control."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def seconds(self) -> float:
        """Return the elapsed wall-clock seconds."""
        return time.perf_counter() - self._start


def slowness() -> float:
    """Return how many times as long as alone on the computer this process takes for its work at present, at least 1.

    Measured by some milliseconds of work: other processes that want the processors make it take longer, and so does
    a limit that the system has set.
    """
    wall, used = time.perf_counter(), time.thread_time()
    while (worked := time.thread_time() - used) < _PROBE:
        pass
    return max(1.0, (time.perf_counter() - wall) / worked)


def wall_time() -> datetime:
    """Return the wall-clock date and time in UTC, for names and metadata; never for control."""
    return datetime.now(UTC)


def make_clock(name: str, *, in_process: bool) -> Clock:
    """Make a clock by its name on the command line.

    Parameters
    ----------
    name : {"wall", "virtual", "xN"}
        `x20` is a clock twenty times as fast as the wall clock; N may be any positive number.
    in_process : bool
        Whether every instrument is emulated in this process. Then `wall` and `xN` are paced clocks.

    Raises
    ------
    ConfigurationError
        If the name is none of these.
    """
    if name == "wall":
        return PacedClock(1.0) if in_process else WallClock()
    if name == "virtual":
        return VirtualClock()
    if name.startswith("x"):
        try:
            factor = float(name[1:])
            return PacedClock(factor) if in_process else ScaledClock(factor)
        except ValueError:
            pass
    raise ConfigurationError(f"clock {name!r} is unknown; allowed are wall, virtual, and xN such as x20")


def _check_finite(seconds: float) -> None:
    if not math.isfinite(seconds):
        raise ValueError(f"seconds: expected a finite number, got {seconds}")


def _check_factor(factor: float) -> None:
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"factor: expected a positive number, got {factor}")
