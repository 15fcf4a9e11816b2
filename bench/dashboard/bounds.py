"""The bounds of signals: limits of set-points, interlocks and warnings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from bench.base import Floats
from bench.dashboard.drawing import ALARM, CAUTION, LIMIT, Colour
from bench.dashboard.rerun_recording import Ints, RerunRecording, times
from bench.devices import Signal
from bench.record import interlocks_of
from bench.rig import SETPOINT, Level


@dataclass(frozen=True)
class Bound:
    """What a signal may not pass."""

    column: int  # the signal's
    value: float  # in its unit
    is_high: bool  # whether the signal has to stay below
    # Distance to the bound on the other side, or the size of the value where there is none; the signal's unit.
    span: float
    name: str  # signal and value, in words
    kind: str  # `limit` of a set-point, `interlock`, or `warning`, for legends
    colour: Colour  # red where an interlock acts, amber for a warning, violet for the limit of a set-point

    def margin(self, value: float) -> float:
        """Return how far a value is from the bound, in its unit; negative beyond it."""
        return self.value - value if self.is_high else value - self.value


def bounds_of(meta: Mapping[str, Any], signals: Sequence[Signal]) -> tuple[Bound, ...]:
    """Return the bounds that the metadata of a run know of."""
    columns = {signal.name: i for i, signal in enumerate(signals)}
    found: list[Bound] = []
    for device, (low, high) in (meta.get("limits") or {}).items():
        if (column := columns.get(f"{device}{SETPOINT}")) is not None:
            found += _pair(column, signals[column], low, high, "limit", LIMIT)
    for interlock in interlocks_of(meta):
        if interlock.minus or (column := columns.get(interlock.signal)) is None:
            continue
        kind, colour = ("warning", CAUTION) if interlock.level is Level.WARN else ("interlock", ALARM)
        found += _pair(column, signals[column], interlock.low, interlock.high, kind, colour)
        found += _pair(column, signals[column], *interlock.unwarned, "warning", CAUTION)
    return tuple(found)


def _pair(column: int, signal: Signal, low: float, high: float, kind: str, colour: Colour) -> Iterator[Bound]:
    for value, is_high in ((low, False), (high, True)):
        if math.isfinite(value):
            span = high - low if math.isfinite(high - low) else abs(value) or 1.0
            shown = signal.display
            name = f"{signal.name} {'<' if is_high else '>'} {shown.factor * value:g} {shown.unit}".rstrip()
            yield Bound(column, value, is_high, span, name, kind, colour)


def nearest(bounds: Sequence[Bound], values: Sequence[float]) -> Bound | None:
    """Return the interlock's bound that values are nearest to, in parts of its span; None if there is none."""
    known = [bound for bound in bounds if bound.kind == "interlock" and math.isfinite(values[bound.column])]
    return min(known, key=lambda bound: bound.margin(values[bound.column]) / bound.span, default=None)


class BoundLines:
    """Draws the bounds of some signals over time, as lines below the entity `path`, as far as the data go.

    `factor` leads from their unit to that of the plot.
    """

    def __init__(self, path: str, bounds: Sequence[Bound], factor: float) -> None:
        self._path, self._factor = path, factor
        # The same for several signals, such as a set-point and its reading, is one line.
        self._bounds = list({(bound.value, bound.colour): bound for bound in bounds}.values())

    def draw(self, recording: RerunRecording) -> None:
        """Write how the lines look."""
        for i, bound in enumerate(self._bounds):
            look = rr.SeriesLines(names=bound.kind, colors=bound.colour, widths=1.0)
            recording.log(f"{self._path}/bounds/{i}", look)

    def write(self, recording: RerunRecording, t: Floats, step: Ints) -> None:
        """Draw the bounds over times, shape (times,), from the first to the last."""
        ends = [0, -1]
        for i, bound in enumerate(self._bounds):
            values = np.full((2, 1), self._factor * bound.value)
            recording.send_vectors(f"{self._path}/bounds/{i}", times(t[ends], step[ends]), values)
