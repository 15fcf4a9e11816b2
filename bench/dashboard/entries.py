"""Entries of the dashboard: ticks, steps, events, densities and the end of a run, in their order."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from bench.base import Floats
from bench.dashboard.rerun_recording import Ints
from bench.identification import ModelFile
from bench.models import Density, Model
from bench.record import Event, StepRecord


class Tick(NamedTuple):
    """One tick of a hold: laboratory time in s, step number, one value a signal."""

    t: float
    step: int
    values: Sequence[float]


@dataclass(frozen=True, eq=False)
class Ticks:
    """Ticks that follow one another, as columns.

    values : ndarray, shape (ticks, signals)
    """

    t: Floats  # shape (ticks,); laboratory time, s
    step: Ints  # shape (ticks,); step number
    values: Floats

    @classmethod
    def joined(cls, pieces: Sequence[Ticks]) -> Ticks:
        """Return one or more pieces, one behind the other."""
        return cls(
            np.concatenate([each.t for each in pieces]),
            np.concatenate([each.step for each in pieces]),
            np.concatenate([each.values for each in pieces]),
        )

    @classmethod
    def of(cls, ticks: Sequence[Tick]) -> Ticks:
        """Return single ticks, one or more, as columns."""
        t, step, values = zip(*ticks, strict=True)
        return cls(np.array(t, dtype=np.float64), np.array(step, dtype=np.int64), np.array(values, dtype=np.float64))

    def __len__(self) -> int:
        return self.t.size

    def __iter__(self) -> Iterator[Tick]:
        return map(Tick, self.t.tolist(), self.step.tolist(), self.values.tolist())

    def part(self, first: int, end: int) -> Ticks:
        """Return the ticks from the number `first` to before `end`."""
        return Ticks(self.t[first:end], self.step[first:end], self.values[first:end])


@dataclass(frozen=True)
class ModelDensity:
    """A density to draw, the name of its model, and the model."""

    name: str
    density: Density
    model: Model


def densities_of(models: Iterable[ModelFile]) -> list[ModelDensity]:
    """Return the densities of models, in their order; a model without a plane has none."""
    return [ModelDensity(file.name, density, file.model) for file in models for density in file.model.densities()]


@dataclass(frozen=True)
class End:
    """How a run ended: `completed`, `aborted` or `failed`, and why; how late its loops were (`Lateness`)."""

    status: str
    reason: str
    lateness: Mapping[str, Any] = field(default_factory=dict)


Entry: TypeAlias = Tick | StepRecord | Event | ModelDensity | End
Part: TypeAlias = Ticks | StepRecord | Event | ModelDensity | End
"""An entry, or ticks that follow one another."""


def in_parts(entries: Iterable[Entry | Part]) -> list[Part]:
    """Return entries in their order, ticks that follow one another as columns."""
    parts: list[Part] = []
    ticks: list[Tick] = []
    for entry in entries:
        if isinstance(entry, Tick):
            ticks.append(entry)
            continue
        if ticks:
            parts.append(Ticks.of(ticks))
            ticks = []
        parts.append(entry)
    return [*parts, Ticks.of(ticks)] if ticks else parts


def merged(ticks: Ticks, steps: Sequence[StepRecord], events: Sequence[Event]) -> list[Part]:
    """Return what happened in order: of one instant, the ticks of a step, its end, then events."""
    order = np.lexsort((ticks.step, ticks.t))
    ticks = Ticks(ticks.t[order], ticks.step[order], ticks.values[order])
    dated: list[tuple[tuple[float, float], StepRecord | Event]]
    dated = [((step.finished, step.step), step) for step in steps]
    dated += [((event.t, math.inf), event) for event in events]
    dated.sort(key=lambda each: each[0])
    parts: list[Part] = []
    first = 0
    for (t, step), each in dated:
        begin, end = ticks.t.searchsorted(t), ticks.t.searchsorted(t, "right")
        before = int(begin + ticks.step[begin:end].searchsorted(step, "right"))
        if before > first:
            parts.append(ticks.part(first, before))
            first = before
        parts.append(each)
    return [*parts, ticks.part(first, len(ticks))] if first < len(ticks) else parts


def single(parts: Iterable[Part]) -> Iterator[Entry]:
    """Yield each entry by itself."""
    for part in parts:
        if isinstance(part, Ticks):
            yield from part
        else:
            yield part


def portions(parts: Iterable[Entry | Part], most: int) -> Iterator[list[Entry | Part]]:
    """Yield parts in portions of so many entries at most."""
    portion: list[Entry | Part] = []
    count = 0
    for part in parts:
        first, length = 0, size(part)
        while first < length:
            taken = min(length - first, most - count)
            portion.append(part.part(first, first + taken) if isinstance(part, Ticks) else part)
            first, count = first + taken, count + taken
            if count == most:
                yield portion
                portion, count = [], 0
    if portion:
        yield portion


def size(part: Entry | Part) -> int:
    """Return the number of entries of a part."""
    return len(part) if isinstance(part, Ticks) else 1
