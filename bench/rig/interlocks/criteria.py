"""Criteria of interlocks: one for each thing that a table may ask of its signal."""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import replace

from bench.base import Display, difference_unit
from bench.rig.interlocks.config import SETPOINT, Interlock, Stuck

_SAME_INSTANT = 1e-6
"""Instants closer than this are the same, s: they may be computed in different ways."""


class _Criterion(ABC):
    """One thing that an interlock asks for; `since` is when it was violated first, None while it is met."""

    over = ""  # what the signal does once it is met again

    def __init__(self, interlock: Interlock, displays: Mapping[str, Display], seconds: float) -> None:
        self._interlock = interlock
        self._display = displays[interlock.signal]
        if interlock.minus:
            self._display = _of_difference(self._display)
        self.seconds = seconds
        self.since: float | None = None

    def _reading(self, value: float) -> str:
        return f"{self._interlock.label} = {self._shown(value)}"

    def _shown(self, value: float) -> str:
        return f"{self._display.bare(value)} {self._display.unit}".rstrip()

    @abstractmethod
    def look(self, t: float, value: float, setpoint: float | None) -> None:
        """Look at a reading, and set `since`."""

    @abstractmethod
    def seen(self, t: float, since: float, value: float) -> str:
        """Return what was seen and what is allowed."""

    def back(self, t: float, since: float, value: float) -> str:
        """Return that it is over."""
        return f"{self._reading(value)} {self.over} (after {t - since:.1f} s)"


class _Range(_Criterion):
    def __init__(self, interlock: Interlock, displays: Mapping[str, Display], seconds: float) -> None:
        super().__init__(interlock, displays, seconds)
        self._low, self._high = interlock.low, interlock.high
        self.over = f"is back within {self._display.between(*interlock.resume)}"

    def look(self, t: float, value: float, setpoint: float | None) -> None:  # noqa: ARG002 - as of all
        if self.since is None:
            if not self._low <= value <= self._high:
                self.since = t
            return
        low, high = self._interlock.resume
        if low <= value <= high:
            self.since = None

    def seen(self, t: float, since: float, value: float) -> str:
        allowed = self._display.between(self._interlock.low, self._interlock.high)
        return f"{self._reading(value)} is outside of {allowed} (for {t - since:.1f} s)"


class _Near(_Criterion):
    """Whether the signal is within the warning band before a limit; it is over half a band further inside."""

    over = "is far from its interlock again"

    def __init__(self, interlock: Interlock, displays: Mapping[str, Display]) -> None:
        super().__init__(interlock, displays, 0.0)
        self._low, self._high = low, high = interlock.unwarned
        half = 0.5 * interlock.warn
        low += half * abs(interlock.low) if math.isfinite(low) else 0.0
        high -= half * abs(interlock.high) if math.isfinite(high) else 0.0
        # Of a narrow range the edges of the bands themselves.
        self._back = (low, high) if low < high else interlock.unwarned

    def look(self, t: float, value: float, setpoint: float | None) -> None:  # noqa: ARG002 - as of all
        if self.since is None:
            # What is beyond the limit acts by itself, if it does so at once.
            acts = self._interlock.seconds == 0.0 and not self._interlock.low <= value <= self._interlock.high
            if not acts and (value < self._low or value > self._high):
                self.since = t
        elif self._back[0] <= value <= self._back[1]:
            self.since = None

    def seen(self, t: float, since: float, value: float) -> str:  # noqa: ARG002 - as of all
        interlock = self._interlock
        below = value < self._low
        edge, limit = (self._low, interlock.low) if below else (self._high, interlock.high)
        return (
            f"{self._reading(value)} is {'below' if below else 'above'} {self._shown(edge)}; "
            f"the interlock acts at {self._shown(limit)} (level {interlock.level})"
        )


class _Rate(_Criterion):
    """Mean rate from the newest reading that is as old as the window, or older, to the present one."""

    def __init__(self, interlock: Interlock, displays: Mapping[str, Display], fastest: float) -> None:
        super().__init__(interlock, displays, interlock.seconds)
        self._display = _of_difference(self._display)
        self._fastest = fastest
        self._readings: deque[tuple[float, float]] = deque()
        self._rate, self._span = 0.0, math.nan

    def look(self, t: float, value: float, setpoint: float | None) -> None:  # noqa: ARG002 - as of all
        if not math.isfinite(value):
            return  # that is outside of the range
        readings = self._readings
        if not readings or t > readings[-1][0]:
            readings.append((t, value))
        # Instants of looks are rounded; none may fall out of its window by that.
        over = self._interlock.over - _SAME_INSTANT
        while len(readings) > 1 and t - readings[1][0] >= over:
            readings.popleft()
        before, old = readings[0]
        if t - before < over:
            return
        self._span = t - before
        self._rate = (value - old) / self._span
        if abs(self._rate) <= self._fastest:
            self.since = None
        elif self.since is None:
            self.since = t

    def seen(self, t: float, since: float, value: float) -> str:  # noqa: ARG002 - as of all
        return (
            f"{self._interlock.label} changes by {self._per_second()} over {self._span:.3g} s; "
            f"{self._shown(self._fastest)}/s is allowed (for {t - since:.1f} s)"
        )

    def back(self, t: float, since: float, value: float) -> str:  # noqa: ARG002 - as of all
        return f"{self._interlock.label} changes by {self._per_second()} again (after {t - since:.1f} s)"

    def _per_second(self) -> str:
        return f"{self._display.factor * self._rate:.3g} {self._display.unit}/s"


class _Stale(_Criterion):
    """Whether the signal stands still; `last` is its last reading, and `first` when that came first, s."""

    over = "moves again"

    def __init__(self, interlock: Interlock, displays: Mapping[str, Display], stale: float) -> None:
        super().__init__(interlock, displays, stale)
        self.last: float | None = None
        self.first = math.nan

    def look(self, t: float, value: float, setpoint: float | None) -> None:  # noqa: ARG002 - as of all
        last = self.last
        # Readings that compare as different are; zeros and what is not a number have to be seen as bits.
        if last is not None and (value == last or value != value) and _bits(value) == _bits(last):
            self.since = self.first
        else:
            # From its first reading on; the next one has to be equal before it counts.
            self.last, self.first, self.since = value, t, None

    def seen(self, t: float, since: float, value: float) -> str:
        return (
            f"{self._reading(value)} stands still: all readings of the last "
            f"{t - since:.1f} s are equal to the last bit; {self.seconds:g} s is allowed"
        )


class _Follows(_Criterion):
    """Whether the signal leaves the value that it had when the set-point left its own."""

    over = "follows again"

    def __init__(self, interlock: Interlock, displays: Mapping[str, Display], stuck: Stuck) -> None:
        super().__init__(interlock, displays, stuck.within)
        self._stuck = stuck
        self._setpoint_display = displays[f"{interlock.setpoint}{SETPOINT}"]
        # Set-point and signal where they last were at rest together.
        self._rest: tuple[float, float] | None = None
        self._setpoint = math.nan
        self._upwards = True

    def look(self, t: float, value: float, setpoint: float | None) -> None:
        if setpoint is None:
            return
        last, self._setpoint = self._setpoint, setpoint
        if math.isnan(setpoint) or self._rest is None:
            # Off, or on for the first time.
            self._rest, self.since = None if math.isnan(setpoint) else (setpoint, value), None
            return
        origin, start = self._rest
        if abs(value - start) >= self._stuck.follows:
            self._rest, self.since = (setpoint, value), None
            return
        distance = setpoint - origin
        if abs(distance) < self._stuck.moved:
            self.since = None
            if setpoint == last == origin:
                self._rest = (setpoint, value)  # it drifts, while nothing moves
        elif self.since is None or (distance > 0) != self._upwards:
            self.since, self._upwards = t, distance > 0

    def seen(self, t: float, since: float, value: float) -> str:
        start = math.nan if self._rest is None else self._rest[1]
        setpoint, change = self._setpoint_display, _of_difference(self._display)
        return (
            f"{self._reading(value)} is stuck: {t - since:.1f} s after {self._interlock.setpoint} was set to "
            f"{setpoint.bare(self._setpoint)} {setpoint.unit} it has moved by "
            f"{change.factor * abs(value - start):.3g} {change.unit}; "
            f"at least {change.bare(self._stuck.follows)} {change.unit} is expected within {self._stuck.within:g} s"
        )


def _of_difference(display: Display) -> Display:
    """Return how the difference of two values is shown."""
    return replace(display, unit=difference_unit(display.unit))


_bits = struct.Struct("<d").pack


def _first_instant(since: float, seconds: float) -> float:
    """Return the first number that is `seconds` or more after `since`, also as a difference of rounded numbers."""
    instant = since + seconds
    while instant - since < seconds:
        instant = math.nextafter(instant, math.inf)
    return instant
