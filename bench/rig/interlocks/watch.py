"""The interlocks of a rig while a run goes on: which begin and which end at a reading."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from bench.base import ConfigurationError, Display, InterlockError, closest
from bench.rig.interlocks.config import SETPOINT, Interlock, Level
from bench.rig.interlocks.criteria import (
    _SAME_INSTANT,
    _Criterion,
    _first_instant,
    _Follows,
    _Near,
    _Range,
    _Rate,
    _Stale,
)


@dataclass(frozen=True)
class InterlockFinding:
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
    displays : mapping of str to Display
        How values are shown, by name, of all signals and set-points that there are.

    Raises
    ------
    ConfigurationError
        If there is no such signal as an interlock names.
    """

    def __init__(self, interlocks: Iterable[Interlock], displays: Mapping[str, Display]) -> None:
        watched = tuple(interlocks)
        self._names = {name for each in watched for name in (each.signal, each.minus) if name}
        self._names |= {f"{each.setpoint}{SETPOINT}" for each in watched if each.setpoint}
        if missing := sorted(self._names - displays.keys()):
            raise ConfigurationError(f"interlocks: there is no signal {missing[0]}; {closest(missing[0], displays)}")
        self._courses = tuple(_Course(interlock, displays) for interlock in watched)
        self._plain = tuple((each, each.plain, *each.quiet, each.stale) for each in self._courses)
        # Those with something that may act or is not over: mostly none.
        self._restless: list[_Course] = []
        self._latest = -math.inf
        self._tripped: InterlockFinding | None = None

    @property
    def signals(self) -> frozenset[str]:
        """Names of the signals that have to be read for it; set-points are not among them, as they are known."""
        return frozenset(name for name in self._names if not name.endswith(SETPOINT))

    @property
    def active(self) -> tuple[InterlockFinding, ...]:
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
    ) -> tuple[InterlockFinding, ...]:
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
        tuple of InterlockFinding
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
        found: list[InterlockFinding] = []
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
    ) -> tuple[InterlockFinding, ...]:
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

    def __init__(self, interlock: Interlock, displays: Mapping[str, Display]) -> None:
        self.interlock = interlock
        self.restless = False
        """Whether a criterion is violated, or has acted and is not over."""
        self._displays = displays
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
        self.active: list[InterlockFinding | None] = [None] * len(self._criteria)
        self._acted = [math.nan] * len(self._criteria)

    def _make_criteria(self) -> None:
        interlock, displays = self.interlock, self._displays
        # Of any interlock, as nan is outside of an infinite range too.
        criteria: list[_Criterion] = [_Range(interlock, displays, interlock.seconds)]
        if interlock.unwarned != (-math.inf, math.inf):
            criteria.append(_Near(interlock, displays))
        of_range = len(criteria)
        if interlock.fastest is not None:
            criteria.append(_Rate(interlock, displays, interlock.fastest))
        if interlock.stale is not None:
            criteria.append(_Stale(interlock, displays, interlock.stale))
        if interlock.stuck is not None:
            criteria.append(_Follows(interlock, displays, interlock.stuck))
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
        self,
        t: float,
        values: Mapping[str, float],
        setpoints: Mapping[str, float] | None,
        found: list[InterlockFinding],
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
        names = (name for name in (self.interlock.signal, self.interlock.minus) if name.endswith(SETPOINT))
        return any(found != found for found in (_reading(name, values, setpoints) for name in names))

    def _act(self, t: float, value: float, criterion: _Criterion, i: int, found: list[InterlockFinding]) -> None:
        interlock, finding, since = self.interlock, self.active[i], criterion.since
        if finding is None:
            if since is None or t - since < criterion.seconds or t < self._settled(criterion):
                return
            self._acted[i] = t
            early = isinstance(criterion, _Near)
            text = f"{'warning' if early else 'interlock'}: {criterion.seen(t, since, value)}"
            level = Level.WARN if early else interlock.level
            self.active[i] = InterlockFinding(interlock, level, text, since, value, early=early)
        elif finding.level is Level.SAFE:
            return
        elif since is None:
            self.active[i] = None
            text = f"{'warning' if finding.early else 'interlock'}: {criterion.back(t, finding.since, value)}"
            found.append(replace(finding, text=text, value=value, over=True))
            return
        elif finding.level is Level.HOLD and t - self._acted[i] >= interlock.hold_at_most:
            text = f"interlock: {criterion.seen(t, since, value)}; it was not back {interlock.hold_at_most:g} s after"
            self.active[i] = InterlockFinding(interlock, Level.SAFE, text, since, value)
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
