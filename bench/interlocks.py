"""Interlocks: what signals may not do while a run goes on, and what is done about it.

Nothing here touches a device, a clock or a thread. Each reading that is taken, for whatever reason, is shown to an
`InterlockWatch`, which says what begins and what ends at it.

A rig file has one table an interlock; one table may ask for several things of one signal::

    [[interlocks]]
    signal = "plate_temperature"
    high = 90.0                  # °C
    resume_high = 85.0           # it counts as outside until it is below this
    seconds = 2.0                # outside for so long before it acts
    fastest = 5.0                # K/s, on average over ...
    over = 2.0                   # ... so many seconds
    level = "hold"               # warn, hold, pause, or safe
    warn = 0.05                  # it warns from 85.5 °C on, 5 % of the limit before it

    [[interlocks]]
    signal = "plate_temperature"
    minus = "plate_setpoint"     # the difference of two signals
    low = -3.0                   # K
    high = 3.0
    settle = 60.0                # s after a change of a set-point during which it does not act

    [[interlocks]]
    signal = "spot_position"
    stale = 60.0                 # s for which readings may be equal to the last bit

    [[interlocks]]
    signal = "plate_temperature"
    setpoint = "plate"           # it has to follow the set-point of this device
    stuck = { moved = 5.0, follows = 1.0, within = 60.0 }
"""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from pydantic import ConfigDict, Field, model_validator

from bench.checked_table import CheckedTable
from bench.errors import ConfigurationError, InterlockError

SETPOINT = "_setpoint"
"""Ending of the signal that is the set-point of a device, after the name of the device."""

_SAME_INSTANT = 1e-6
"""Instants closer than this are the same, s: they may be computed in different ways."""


class Level(StrEnum):
    """What an interlock does when it acts."""

    WARN = "warn"
    """It is recorded as an event."""
    HOLD = "hold"
    """The set-points stay until the signal is back, then the run goes on; it ends if that takes too long."""
    PAUSE = "pause"
    """The run pauses, as the operator may ask for at any time."""
    SAFE = "safe"
    """The run ends in the safe state."""


class Stuck(CheckedTable):
    """How a signal has to follow a set-point."""

    moved: float = Field(gt=0, description="change of the set-point that the signal has to follow, in its unit")
    follows: float = Field(gt=0, description="smallest change of the signal that follows it, in the signal's unit")
    within: float = Field(gt=0, le=3600, description="time that the signal has for it, s")


class Interlock(CheckedTable):
    """What a signal may not do while a run goes on. A value that is nan counts as outside of any range."""

    model_config = ConfigDict(allow_inf_nan=True)

    signal: str = Field(description="signal that is watched")
    low: float = Field(default=-math.inf, description="smallest value allowed, in the signal's unit")
    high: float = Field(default=math.inf, description="largest value allowed, in the signal's unit")
    seconds: float = Field(
        default=0.0, ge=0, le=3600, description="how long it may be outside, or change too fast, before it acts, s"
    )
    resume_low: float | None = Field(
        default=None, allow_inf_nan=False, description="once below low, it is outside until it has reached this"
    )
    resume_high: float | None = Field(
        default=None, allow_inf_nan=False, description="once above high, it is outside until it has come down to this"
    )
    minus: str = Field(default="", description="signal that is subtracted from it before it is compared")
    unit: str = Field(default="", description="unit in which the numbers are meant, checked against the signal's")
    setpoint: str = Field(default="", description="device whose set-point moves the signal; without it any does")
    settle: float = Field(
        default=0.0,
        ge=0,
        le=3600,
        description="time after a set-point has changed during which range and rate do not act, s",
    )
    fastest: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="largest rate of change allowed, the signal's unit per s"
    )
    over: float = Field(default=1.0, ge=0.01, le=3600, description="time over which the rate is taken, s")
    stale: float | None = Field(
        default=None, gt=0, le=86400, description="how long its readings may be equal to the last bit, s"
    )
    stuck: Stuck | None = Field(
        default=None, description="how it has to follow the set-point: moved, follows, within"
    )
    level: Level = Field(default=Level.SAFE, description="what it does: warn, hold, pause, or safe")
    hold_at_most: float = Field(
        default=600.0, gt=0, le=86400, description="longest time that it holds before the run ends, s"
    )
    warn: float = Field(
        default=0.05,
        ge=0,
        le=0.5,
        description="width of the warning band before low and before high, as a share of the limit; 0 for none",
    )

    @property
    def label(self) -> str:
        """What is watched, for messages: the signal, or the difference of two."""
        return f"{self.signal} - {self.minus}" if self.minus else self.signal

    @property
    def resume(self) -> tuple[float, float]:
        """Range in which the signal counts as back, in its unit."""
        return (
            self.low if self.resume_low is None else self.resume_low,
            self.high if self.resume_high is None else self.resume_high,
        )

    @property
    def unwarned(self) -> tuple[float, float]:
        """Range outside of which it warns before it acts, in the signal's unit; infinite where it does not."""
        if self.level is Level.WARN:
            return -math.inf, math.inf
        low = self.low + self.warn * abs(self.low) if math.isfinite(self.low * self.warn) else -math.inf
        high = self.high - self.warn * abs(self.high) if math.isfinite(self.high * self.warn) else math.inf
        # A limit of zero has no share, and a narrow range no room.
        low, high = (low if low > self.low else -math.inf), (high if high < self.high else math.inf)
        return (low, high) if low < high else (-math.inf, math.inf)

    @property
    def limits_values(self) -> bool:
        """Whether it limits the values of the signal or their rate, not only how it follows."""
        return math.isfinite(self.low) or math.isfinite(self.high) or self.fastest is not None

    @model_validator(mode="after")
    def _is_consistent(self) -> Interlock:
        if not self.low < self.high:
            raise ValueError(f"low must be below high, got low = {self.low} and high = {self.high}")
        if not (self.limits_values or self.stale or self.stuck):
            raise ValueError("low or high, or both, must be given, or fastest, stale or stuck")
        low, high = self.resume
        if not (self.low <= low <= high <= self.high):
            raise ValueError(
                "expected low ≤ resume_low ≤ resume_high ≤ high, "
                f"got {self.low:g}, {low:g}, {high:g} and {self.high:g}"
            )
        for key, wanted, is_there in (
            ("resume_low", "low", math.isfinite(self.low)),
            ("resume_high", "high", math.isfinite(self.high)),
            ("over", "fastest", self.fastest is not None),
            ("hold_at_most", 'level = "hold"', self.level is Level.HOLD),
            ("stuck", "setpoint", bool(self.setpoint)),
        ):
            if key in self.model_fields_set and getattr(self, key) is not None and not is_there:
                raise ValueError(f"{key} has no meaning without {wanted}")
        if self.minus and (self.stale is not None or self.minus == self.signal):
            raise ValueError(
                f"minus = {self.minus!r}: expected another signal than {self.signal}, in a table of its own without "
                "stale, which concerns one sensor"
            )
        return self


@dataclass(frozen=True)
class Finding:
    """Something that an interlock found, when it acts and when that is over.

    Attributes
    ----------
    interlock : Interlock
        Which it is.
    level : Level
        What is to be done: that of the interlock, and `safe` once it has held for too long.
    text : str
        What was seen, for how long, and what is allowed.
    since : float
        Laboratory time at which it was seen first, s.
    value : float
        Reading that was looked at, in the signal's unit; the difference of two where two are compared.
    over : bool
        Whether it is over.
    early : bool
        Whether the signal has only come near a limit, so that the interlock may act soon.
    """

    interlock: Interlock
    level: Level
    text: str
    since: float
    value: float
    over: bool = False
    early: bool = False


class InterlockWatch:
    """Watches the interlocks of a rig during a run; each run has a new one.

    Parameters
    ----------
    interlocks : iterable of Interlock
        What to watch.
    units : mapping of str to str
        Unit by name, of all signals and set-points that there are.

    Raises
    ------
    ConfigurationError
        If there is no such signal as an interlock names.
    """

    def __init__(self, interlocks: Iterable[Interlock], units: Mapping[str, str]) -> None:
        self._courses = tuple(_Course(interlock, units) for interlock in interlocks)
        self._plain = tuple((each, each.plain, *each.quiet, each.stale) for each in self._courses)
        # Those with something that may act or is not over: mostly none.
        self._restless: list[_Course] = []
        self._latest = -math.inf
        self._tripped: Finding | None = None
        watched = [course.interlock for course in self._courses]
        self._names = {name for each in watched for name in (each.signal, each.minus) if name}
        self._names |= {f"{each.setpoint}{SETPOINT}" for each in watched if each.setpoint}
        if missing := sorted(self._names - units.keys()):
            raise ConfigurationError(
                f"interlocks: there is no signal {', '.join(missing)}; there are: {', '.join(units)}"
            )

    @property
    def signals(self) -> frozenset[str]:
        """Names of the signals that have to be read for it; set-points are not among them, as they are known."""
        return frozenset(name for name in self._names if not name.endswith(SETPOINT))

    @property
    def active(self) -> tuple[Finding, ...]:
        """What has begun and is not over, in the order of the interlocks; one of level `safe` is never over."""
        return tuple(finding for course in self._courses for finding in course.active if finding is not None)

    @property
    def due(self) -> float:
        """Laboratory time at which the next one acts if its signal stays as it is, s; inf if none would.

        A look at this instant makes the time until it acts independent of the rate of the looks.
        """
        return self.due_after(-math.inf)

    def due_after(self, t: float) -> float:
        """Return the first such time after `t`, s; one before it waits for a signal that was not read last."""
        if not self._restless:
            return math.inf
        return min((due for course in self._restless if (due := course.due()) > t), default=math.inf)

    def look(
        self, t: float, values: Mapping[str, float], setpoints: Mapping[str, float] | None = None
    ) -> tuple[Finding, ...]:
        """Look at one set of readings.

        Parameters
        ----------
        t : float
            Laboratory time, s.
        values : mapping of str to float
            Readings by signal name. A value that is nan counts as outside. An interlock whose signals are not all
            there is left as it is.
        setpoints : mapping of str to float, optional
            Set-points by device name, nan for an output that is off; without it those among `values`.

        Returns
        -------
        tuple of Finding
            What begins and what is over at this look, in the order of the interlocks.

        Raises
        ------
        ValueError
            If `t` is before the last look.
        """
        if not t >= self._latest - _SAME_INSTANT:
            raise ValueError(
                f"a look at {t:g} s follows one at {self._latest:g} s; looks have to be in order of time"
            )
        self._latest = t = max(t, self._latest)
        found: list[Finding] = []
        restless: list[_Course] = []
        for course, signal, low, high, stale in self._plain:
            if not course.restless and signal in values and low <= (value := values[signal]) <= high:
                if stale is None:
                    continue
                if stale.last != value:
                    stale.last, stale.first = value, t
                    continue
            course.look(t, values, setpoints, found)
            if course.restless:
                restless.append(course)
        self._restless = restless
        if found and self._tripped is None:
            self._tripped = next((finding for finding in found if finding.level is Level.SAFE), None)
        return tuple(found)

    def check(
        self, t: float, values: Mapping[str, float], setpoints: Mapping[str, float] | None = None
    ) -> tuple[Finding, ...]:
        """Look at one set of readings, and return what begins and what is over below the level `safe`; see `look`.

        Raises
        ------
        InterlockError
            If an interlock of the level `safe` acts, or has acted before, or one has held for too long.
        """
        found = self.look(t, values, setpoints)
        if self._tripped is not None:
            raise InterlockError(self._tripped.text)
        return found


class _Criterion(ABC):
    """One thing that an interlock asks for; `since` is when it was violated first, None while it is met."""

    over = ""  # what the signal does once it is met again

    def __init__(self, interlock: Interlock, units: Mapping[str, str], seconds: float) -> None:
        self._interlock = interlock
        self._unit = units.get(interlock.signal, "")
        if interlock.minus:
            self._unit = _of_difference(self._unit)
        self.seconds = seconds
        self.since: float | None = None

    @abstractmethod
    def look(self, t: float, value: float, setpoint: float | None) -> None:
        """Look at a reading, and set `since`."""

    @abstractmethod
    def seen(self, t: float, since: float, value: float) -> str:
        """Return what was seen and what is allowed."""

    def back(self, t: float, since: float, value: float) -> str:
        """Return that it is over."""
        return f"{self._interlock.label} = {value:.6g} {self._unit} {self.over} (after {t - since:.1f} s)"


class _Range(_Criterion):
    def __init__(self, interlock: Interlock, units: Mapping[str, str], seconds: float) -> None:
        super().__init__(interlock, units, seconds)
        self._low, self._high = interlock.low, interlock.high
        low, high = interlock.resume
        self.over = f"is back within {low:g} to {high:g} {self._unit}"

    def look(self, t: float, value: float, setpoint: float | None) -> None:  # noqa: ARG002 - as of all
        if self.since is None:
            if not self._low <= value <= self._high:
                self.since = t
            return
        low, high = self._interlock.resume
        if low <= value <= high:
            self.since = None

    def seen(self, t: float, since: float, value: float) -> str:
        return (
            f"{self._interlock.label} = {value:.6g} {self._unit} is outside of "
            f"{self._interlock.low:g} to {self._interlock.high:g} {self._unit} (for {t - since:.1f} s)"
        )


class _Near(_Criterion):
    """Whether the signal is within the warning band before a limit; it is over half a band further inside."""

    over = "is far from its interlock again"

    def __init__(self, interlock: Interlock, units: Mapping[str, str]) -> None:
        super().__init__(interlock, units, 0.0)
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
            f"{interlock.label} = {value:.6g} {self._unit} is {'below' if below else 'above'} {edge:g} {self._unit}; "
            f"the interlock acts at {limit:g} {self._unit} (level {interlock.level})"
        )


class _Rate(_Criterion):
    """Mean rate from the newest reading that is as old as the window, or older, to the present one."""

    def __init__(self, interlock: Interlock, units: Mapping[str, str], fastest: float) -> None:
        super().__init__(interlock, units, interlock.seconds)
        self._unit = _of_difference(self._unit)
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
            f"{self._interlock.label} changes by {self._rate:.3g} {self._unit}/s over {self._span:.3g} s; "
            f"{self._fastest:g} {self._unit}/s is allowed (for {t - since:.1f} s)"
        )

    def back(self, t: float, since: float, value: float) -> str:  # noqa: ARG002 - as of all
        return f"{self._interlock.label} changes by {self._rate:.3g} {self._unit}/s again (after {t - since:.1f} s)"


class _Stale(_Criterion):
    """Whether the signal stands still; `last` is its last reading, and `first` when that came first, s."""

    over = "moves again"

    def __init__(self, interlock: Interlock, units: Mapping[str, str], stale: float) -> None:
        super().__init__(interlock, units, stale)
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
            f"{self._interlock.label} = {value:.6g} {self._unit} stands still: all readings of the last "
            f"{t - since:.1f} s are equal to the last bit; {self.seconds:g} s is allowed"
        )


class _Follows(_Criterion):
    """Whether the signal leaves the value that it had when the set-point left its own."""

    over = "follows again"

    def __init__(self, interlock: Interlock, units: Mapping[str, str], stuck: Stuck) -> None:
        super().__init__(interlock, units, stuck.within)
        self._stuck = stuck
        self._setpoint_unit = units.get(f"{interlock.setpoint}{SETPOINT}", "")
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
        stuck = self._stuck
        return (
            f"{self._interlock.label} = {value:.6g} {self._unit} is stuck: {t - since:.1f} s after "
            f"{self._interlock.setpoint} was set to {self._setpoint:g} {self._setpoint_unit} it has moved by "
            f"{abs(value - start):.3g}; at least {stuck.follows:g} is expected within {stuck.within:g} s"
        )


class _Settling:
    """How long ago set-points have changed.

    Changes that follow each other faster than the settle time put an interlock off for twice that time at most: in a
    loop that changes its set-point with each sample it goes on watching.
    """

    def __init__(self, interlock: Interlock) -> None:
        self._settle = interlock.settle
        self._device = interlock.setpoint
        self._last: dict[str, float] = {}
        self._first_change = self._last_change = -math.inf

    @property
    def until(self) -> float:
        """When the interlock may act again, s; -inf if nothing has changed."""
        return min(self._last_change + self._settle, self._first_change + 2.0 * self._settle)

    def look(self, t: float, setpoints: Mapping[str, float]) -> None:
        changed = False
        for device, setpoint in setpoints.items():
            if self._device in ("", device):
                last = self._last.setdefault(device, setpoint)
                if setpoint != last and not (math.isnan(setpoint) and math.isnan(last)):
                    self._last[device] = setpoint
                    changed = True
        if changed:
            if t - self._last_change >= self._settle:
                self._first_change = t
            self._last_change = t


class _Course:
    """The course of one interlock: its criteria, which of them have acted, and what they found."""

    def __init__(self, interlock: Interlock, units: Mapping[str, str]) -> None:
        self.interlock = interlock
        self.restless = False
        """Whether a criterion is violated, or has acted and is not over."""
        self._units = units
        self._signal = interlock.signal
        self._settling = _Settling(interlock) if interlock.settle else None
        self._follows = f"{interlock.setpoint}{SETPOINT}" if interlock.stuck is not None else ""
        self.quiet = max(interlock.low, interlock.unwarned[0]), min(interlock.high, interlock.unwarned[1])
        """Range in which neither range nor warning band has anything to say."""
        self._make_criteria()
        self.stale = next((each for each in self._further if isinstance(each, _Stale)), None)
        # A set-point stands still, and is none while the output is off.
        short = len(self._further) == (self.stale is not None) and not interlock.signal.endswith(SETPOINT)
        self.plain = interlock.signal if short and not (interlock.settle or interlock.minus) else ""
        """The signal, if readings in the quiet range that do not stand still need no further look; else empty."""
        self.active: list[Finding | None] = [None] * len(self._criteria)
        self._acted = [math.nan] * len(self._criteria)

    def _make_criteria(self) -> None:
        interlock, units = self.interlock, self._units
        # Of any interlock, as nan is outside of an infinite range too.
        criteria: list[_Criterion] = [_Range(interlock, units, interlock.seconds)]
        if interlock.unwarned != (-math.inf, math.inf):
            criteria.append(_Near(interlock, units))
        of_range = len(criteria)
        if interlock.fastest is not None:
            criteria.append(_Rate(interlock, units, interlock.fastest))
        if interlock.stale is not None:
            criteria.append(_Stale(interlock, units, interlock.stale))
        if interlock.stuck is not None:
            criteria.append(_Follows(interlock, units, interlock.stuck))
        self._criteria, self._further = tuple(criteria), tuple(criteria[of_range:])

    def due(self) -> float:
        """Return when it acts next if its signal stays as it is."""
        return min(self._due(criterion, i) for i, criterion in enumerate(self._criteria))

    def _due(self, criterion: _Criterion, i: int) -> float:
        finding = self.active[i]
        if finding is not None:
            if finding.level is Level.HOLD:
                return _first_instant(self._acted[i], self.interlock.hold_at_most)
            return math.inf
        if criterion.since is None:
            return math.inf
        return max(_first_instant(criterion.since, criterion.seconds), self._settled(criterion))

    def _settled(self, criterion: _Criterion) -> float:
        """Return from when on a criterion may act."""
        if self._settling is None or not isinstance(criterion, _Range | _Near | _Rate):
            return -math.inf
        return self._settling.until

    def look(
        self, t: float, values: Mapping[str, float], setpoints: Mapping[str, float] | None, found: list[Finding]
    ) -> None:
        interlock = self.interlock
        if self._settling is not None:
            self._settling.look(t, _setpoints(values) if setpoints is None else setpoints)
        setpoint = _reading(self._follows, values, setpoints) if self._follows else None
        value = _reading(self._signal, values, setpoints)
        if interlock.minus and value is not None:
            other = _reading(interlock.minus, values, setpoints)
            value = None if other is None else value - other
        if value is None:
            return
        if value != value and self._is_off(values, setpoints):
            self._make_criteria()
        else:
            low, high = self.quiet
            for criterion in self._criteria if self.restless or not low <= value <= high else self._further:
                criterion.look(t, value, setpoint)
                if criterion.since is not None:
                    self.restless = True
        if self.restless:
            for i, criterion in enumerate(self._criteria):
                if criterion.since is not None or self.active[i] is not None:
                    self._act(t, value, criterion, i, found)
            self.restless = any(
                criterion.since is not None or finding is not None
                for criterion, finding in zip(self._criteria, self.active, strict=True)
            )

    def _is_off(self, values: Mapping[str, float], setpoints: Mapping[str, float] | None) -> bool:
        """Return whether a set-point that is compared is none, as the output is off."""
        names = [name for name in (self.interlock.signal, self.interlock.minus) if name.endswith(SETPOINT)]
        return any(math.isnan(_reading(name, values, setpoints) or 0.0) for name in names)

    def _act(self, t: float, value: float, criterion: _Criterion, i: int, found: list[Finding]) -> None:
        interlock, finding, since = self.interlock, self.active[i], criterion.since
        if finding is None:
            if since is None or t - since < criterion.seconds or t < self._settled(criterion):
                return
            self._acted[i] = t
            early = isinstance(criterion, _Near)
            text = f"{'warning' if early else 'interlock'}: {criterion.seen(t, since, value)}"
            level = Level.WARN if early else interlock.level
            self.active[i] = Finding(interlock, level, text, since, value, early=early)
        elif finding.level is Level.SAFE:
            return
        elif since is None:
            self.active[i] = None
            text = f"{'warning' if finding.early else 'interlock'}: {criterion.back(t, finding.since, value)}"
            found.append(replace(finding, text=text, value=value, over=True))
            return
        elif finding.level is Level.HOLD and t - self._acted[i] >= interlock.hold_at_most:
            text = f"interlock: {criterion.seen(t, since, value)}; it was not back {interlock.hold_at_most:g} s after"
            self.active[i] = Finding(interlock, Level.SAFE, text, since, value)
        else:
            return
        found.extend(each for each in (self.active[i],) if each is not None)


def _setpoints(values: Mapping[str, float]) -> dict[str, float]:
    """Return the set-points among values of signals, by device."""
    return {name.removesuffix(SETPOINT): value for name, value in values.items() if name.endswith(SETPOINT)}


def _reading(name: str, values: Mapping[str, float], setpoints: Mapping[str, float] | None) -> float | None:
    """Return a signal, None if it is not there; set-points may be given by device."""
    value = values.get(name)
    if value is None and setpoints is not None and name.endswith(SETPOINT):
        value = setpoints.get(name.removesuffix(SETPOINT))
    return value


def _of_difference(unit: str) -> str:
    """Return the unit of a difference of two values."""
    return "K" if unit == "°C" else unit


_bits = struct.Struct("<d").pack


def _first_instant(since: float, seconds: float) -> float:
    """Return the first number that is `seconds` or more after `since`, also as a difference of rounded numbers."""
    instant = since + seconds
    while instant - since < seconds:
        instant = math.nextafter(instant, math.inf)
    return instant
