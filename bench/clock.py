"""The one clock: holds, time stamps, emulated instruments and watchdogs all read it.

Nothing else in the bench reads or spends time. On the virtual clock a hold of 8 s costs only what the
samples within it cost, and two runs with one seed are equal to the last digit.
"""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from bench.errors import ConfigurationError

VIRTUAL_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
"""Where every virtual clock begins, so that runs with one seed carry the same time stamps."""

_LONGEST_NAP = 0.2
"""Longest single wait in seconds, so that a signal to the process is noticed soon."""


class Clock(ABC):
    """Laboratory time in seconds since the clock was made.

    Attributes
    ----------
    epoch : datetime
        Time of day (UTC) at which `now()` was zero.
    runs_by_itself : bool
        Whether time passes without `sleep`.
    interrupted : callable
        Asked during every sleep; when it returns True the sleep ends early.
    """

    epoch: datetime
    runs_by_itself: bool = True

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

    def timestamp(self) -> float:
        """Return the laboratory time as seconds since 1970-01-01 UTC."""
        return self.epoch.timestamp() + self.now()

    def date(self) -> datetime:
        """Return the laboratory time as a time of day, in UTC."""
        return self.epoch + timedelta(seconds=self.now())


class WallClock(Clock):
    """Wall-clock time: a second is a second."""

    def __init__(self) -> None:
        super().__init__()
        self.epoch = datetime.now(UTC)
        self._start = time.monotonic()

    def now(self) -> float:
        """Return seconds since the clock was made."""
        return time.monotonic() - self._start

    def sleep(self, seconds: float) -> None:
        """Wait, in naps short enough for signals to be handled between them."""
        _check_finite(seconds)
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and not self.interrupted():
            time.sleep(min(left, _LONGEST_NAP))


class ScaledClock(Clock):
    """Wall-clock time, `factor` times as fast, for people who watch an emulated rig.

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
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"factor: expected a positive number, got {factor}")
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

    runs_by_itself = False

    def __init__(self) -> None:
        super().__init__()
        self.epoch = VIRTUAL_EPOCH
        self._now = 0.0
        self._lock = threading.Lock()

    def now(self) -> float:
        """Return laboratory seconds since the clock was made."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Jump ahead."""
        _check_finite(seconds)
        if seconds > 0:
            with self._lock:
                self._now += seconds

    def sleep_until(self, instant: float) -> None:
        """Jump to `instant` exactly, free of the rounding that adding up differences would bring."""
        _check_finite(instant)
        with self._lock:
            self._now = max(self._now, instant)


class Stopwatch:
    """Wall-clock seconds since it was made, to report how long work took; never for control."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def seconds(self) -> float:
        """Return the elapsed wall-clock seconds."""
        return time.perf_counter() - self._start


def wall_time() -> datetime:
    """Return the wall-clock date and time in UTC, for names and metadata; never for control."""
    return datetime.now(UTC)


def make_clock(name: str) -> Clock:
    """Make a clock by its name on the command line.

    Parameters
    ----------
    name : {"wall", "virtual", "xN"}
        `x20` is a clock twenty times as fast as the wall clock; N may be any positive number.

    Raises
    ------
    ConfigurationError
        If the name is none of these.
    """
    if name == "wall":
        return WallClock()
    if name == "virtual":
        return VirtualClock()
    if name.startswith("x"):
        try:
            return ScaledClock(float(name[1:]))
        except ValueError:
            pass
    raise ConfigurationError(f"clock {name!r} is unknown; allowed are wall, virtual, and xN such as x20")


def _check_finite(seconds: float) -> None:
    if not math.isfinite(seconds):
        raise ValueError(f"seconds: expected a finite number, got {seconds}")
