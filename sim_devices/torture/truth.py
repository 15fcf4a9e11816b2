"""What the record of a run may contain: by the run without a fault, and by the plant in the run itself."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from typing import Any

import numpy as np

from bench.base import Clock, VirtualClock
from bench.record import Record
from sim_devices.laboratory import EmulatedLaboratory

_PERIOD = 0.02
"""Laboratory time between two looks at the truth, s: a cantilever rings with some 30 Hz."""
_AGE = 1.5
"""Age that a value may have when it is recorded, s: other devices are asked first, three times if need be."""
_BURST = 0.05
"""How much later a value may be, s: an emulated burst of conversions is answered as soon as it is asked for."""
_YOUNG = 0.2
"""The same where every answer comes at once, s."""
_WIDER = 2.0
"""Tolerance over the largest deviation without a fault. Derivation: of some 50 readings that is 2.3 standard
deviations of noise; twice as far is one reading in 200 000."""
_DEVIATIONS = 7.5
"""Tolerance over the median deviation from the true value. Derivation: the median of noise is 0.67 standard
deviations, so it is 5 of them."""
_DIGITS = 1e-6
"""Rounding, as a part of the largest value. Derivation: instruments send single precision, 6e-8, or six digits."""
_EXPLAINED = 0.2
"""Tolerance, as a part of what a signal spans, from which on a true value in another unit does not explain it."""

Rows = list[tuple[int, float, dict[str, float]]]
"""Step, instant (s on the clock of the laboratory) and values of each recorded row."""


class Observed:
    """A laboratory whose truth is looked at every period; made in the place of the rig's own.

    Attributes
    ----------
    laboratory : EmulatedLaboratory
        The one that was made last.
    seen : list of (float, dict)
        Instants (s) and true values.
    clock : Clock
        The clock of that laboratory.
    """

    laboratory: EmulatedLaboratory
    clock: Clock

    def __init__(self, kind: Any) -> None:  # noqa: ANN401 - a laboratory with Settings of its own
        self._kind = kind
        self.seen: list[tuple[float, dict[str, float]]] = []

    def __call__(self, settings: Any, clock: Clock, seed: int) -> EmulatedLaboratory:  # noqa: ANN401
        """Make the laboratory."""
        self.laboratory = self._kind(settings, clock, seed)
        self.clock = clock
        self.seen.clear()
        self._look()
        return self.laboratory

    def _look(self) -> None:
        world = self.laboratory.world
        now = self.clock.now() if world is None else world.time
        self.seen.append((now, {name: float(each.value) for name, each in self.laboratory.truth().items()}))
        self.laboratory.at(now + _PERIOD, self._look)

    def outputs(self) -> dict[str, float]:
        """Return what the outputs of the instruments drive now, by name."""
        if self.laboratory.world is not None:
            self.laboratory.world.advance()
        truth = self.laboratory.truth()
        return {
            name: float(each.value) if not each.behind or truth[each.behind].value else 0.0
            for name, each in truth.items()
            if each.is_output
        }

    def units(self) -> dict[str, str]:
        """Return the units of the true values by name."""
        return {name: each.unit for name, each in self.laboratory.truth().items()}

    def span(self, source: str, instant: float, age: float) -> tuple[float, float]:
        """Return the least and the largest that a true value was since `age` s before an instant."""
        first = max(bisect_left(self.seen, instant - age, key=_time) - 1, 0)
        end = bisect_right(self.seen, instant + _BURST, key=_time) + 1
        values = [values[source] for _, values in self.seen[first:end]]
        return min(values), max(values)


def _time(look: tuple[float, Mapping[str, float]]) -> float:
    return look[0]


def rows_of(record: Record) -> Rows:
    """Return what a run has recorded of its signals, steps and ticks."""
    # The journal counts from the start of the run, the laboratory from the start of its clock.
    start = (datetime.fromisoformat(record.meta["epoch"]) - VirtualClock().epoch).total_seconds()
    found: Rows = []
    for table, clock in ((record.telemetry(), "t"), (record.steps(), "finished")):
        names = [signal.name for signal in record.signals]
        for number in range(len(table)):
            values = {name: float(table[name][number]) for name in names}
            found.append((int(table["step"][number]), float(table[clock][number]) + start, values))
    return found


@dataclass(frozen=True)
class Source:
    """The true value that a signal shows: `scale * NAME + offset`, in the unit of the signal."""

    name: str
    scale: float
    offset: float

    def range(self, observed: Observed, instant: float, age: float) -> tuple[float, float]:
        """Return what the signal would be since `age` s before an instant, without noise."""
        low, high = sorted(self.scale * each + self.offset for each in observed.span(self.name, instant, age))
        return low, high


@dataclass(frozen=True)
class Reference:
    """What a rig records without a fault.

    Attributes
    ----------
    envelopes : mapping of str to list of (float, float)
        By signal, what it was during each step and the one before; all along where no true value explains it.
    sources : mapping of str to Source
        By signal, the true value that it shows, if there is one.
    tolerances : mapping of str to float
        By signal, how far noise and instrument may bring it off.
    seconds : float
        Laboratory time of the run.
    """

    envelopes: Mapping[str, Sequence[tuple[float, float]]]
    sources: Mapping[str, Source]
    tolerances: Mapping[str, float]
    seconds: float

    @classmethod
    def of(cls, record: Record, observed: Observed, seconds: float, derived: Collection[str] = ()) -> Reference:
        """Return the reference of a run without a fault; derived signals are as true as what they come from."""
        rows, units = rows_of(record), observed.units()
        envelopes, sources, tolerances = {}, {}, {}
        for signal in record.signals:
            if signal.name.endswith("_setpoint") or signal.name in derived:
                # What was sent, nothing measures.
                continue
            seen = [(step, instant, values[signal.name]) for step, instant, values in rows]
            tolerances[signal.name] = _WIDER * _scatter(seen)
            if (found := _source(signal.unit, seen, observed, units)) is not None:
                tolerances[signal.name], sources[signal.name] = found
            steps = 1 + max(step for step, _, _ in seen)
            holds = [[v for step, _, v in seen if number - 1 <= step <= number] for number in range(steps)]
            if found is None and units:
                # Such as a velocity, which is seldom seen: what it is anywhere, of either sign.
                most = max(abs(v) for _, _, v in seen)
                holds = [[-most, most]] * steps
            envelopes[signal.name] = [(min(hold), max(hold)) for hold in holds]
        return cls(envelopes, sources, tolerances, seconds)

    def widened(self, others: Iterable[Reference]) -> Reference:
        """Return it with the largest tolerances of several: what is rare need not have happened in this one."""
        return replace(
            self, tolerances={name: max(each.tolerances[name] for each in others) for name in self.tolerances}
        )

    def lie(self, record: Record, observed: Observed, said: str) -> str:
        """Return the first recorded value that is not true, of a signal that `said` does not name; else nothing."""
        for step, instant, values in rows_of(record):
            for signal, holds in self.envelopes.items():
                value, tolerance = values[signal], self.tolerances[signal]
                low, high = holds[min(step, len(holds) - 1)]
                if low - tolerance <= value <= high + tolerance or math.isnan(value) or signal in said:
                    continue
                if (source := self.sources.get(signal)) is not None:
                    low, high = source.range(observed, instant, _AGE)
                if not low - tolerance <= value <= high + tolerance:
                    return (
                        f"{signal} = {value:.6g} at {instant:.2f} s, truly {low:.6g} to {high:.6g}, "
                        f"give or take {tolerance:.2g}"
                    )
        return ""


def _scatter(seen: Sequence[tuple[int, float, float]]) -> float:
    """Return the largest difference of two readings of one step."""
    pairs = pairwise(seen)
    return max((abs(b - a) for (step, _, a), (later, _, b) in pairs if step == later), default=0.0)


def _source(
    unit: str, seen: Sequence[tuple[int, float, float]], observed: Observed, units: Mapping[str, str]
) -> tuple[float, Source] | None:
    """Return the true value that a signal shows best, after its tolerance; None if none does."""
    values = np.array([value for _, _, value in seen])
    scatter, steps = _scatter(seen), np.diff(np.unique(values))
    least = max(_DIGITS * float(np.abs(values).max()), float(steps.min()) / 2 if steps.size else 0.0)
    found = []
    for name, other in units.items():
        spans = np.array([observed.span(name, instant, _YOUNG) for _, instant, _ in seen])
        true, motion = spans.mean(axis=1), np.ptp(spans, axis=1)
        # When a moving one was read is not known well.
        still = motion <= np.median(motion)
        lines = [(True, 1.0, float(np.median((values - true)[still])))] if other == unit else []
        if np.ptp(true[still]) > 0:
            slope, start = np.polyfit(true[still], values[still], 1)
            lines.append((False, float(slope), float(start)))
        for is_plain, scale, offset in lines:
            noise = _DEVIATIONS * float(np.median(np.abs(values - scale * true - offset)[still]))
            low, high = np.sort(scale * spans + offset, axis=1).T
            worst = float(np.max(np.maximum(low - values, values - high)))
            # One that hardly moves shows the quantity of its unit, with noise.
            if worst <= max(_EXPLAINED * np.ptp(values), scatter if is_plain else 0.0):
                tolerance = max(_WIDER * worst, noise, least)
                found.append((not is_plain, tolerance, Source(name, scale, offset)))
    # A fitted scale may be closer by chance.
    return min(found, key=lambda each: each[:2])[1:] if found else None
