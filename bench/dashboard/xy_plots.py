"""Plots of one signal over another, and the memory curve that the first input drives.

A point is a reading of a step or, while a controller is at work, a tick. Every tick moves the memory, but a point is
drawn only if it comes `_REDRAW_SECONDS` after the last one and differs visibly from it; the line to it passes
through the points left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from bench.dashboard.drawing import Colour, Frame, line_style, point_style, xy_view
from bench.dashboard.recording import Recording, times
from bench.dashboard.signal_plots import find_column
from bench.devices import Signal
from bench.hysteresis import MemoryCurve
from bench.layout import DashboardLayout, XYPlot

_REDRAW_SECONDS = 0.1
_VISIBLE = 0.002
"""Visible part of an axis; a controller at its target moves by less."""

_RISING: Colour = (255, 122, 72)
_FALLING: Colour = (78, 160, 255)

_Line = list[tuple[float, float]]


class Point(NamedTuple):
    """A point of the plots: a reading after settling, or a tick under control."""

    t: float
    step: int
    values: Sequence[float]
    is_reading: bool


class XYPlots:
    """The plots of a layout, the first of which drives the memory curve.

    A plot that stands alone has the name `title`; several are named after their signals. Raises a
    ConfigurationError if the layout names a signal that does not exist.
    """

    def __init__(self, layout: DashboardLayout, signals: Sequence[Signal], title: str) -> None:
        self._plane, self._signals = layout.plane, signals
        self._tracks: list[_Track] = []
        for prefix, plot in layout.plots.items():
            x = find_column(signals, f"{prefix}input", plot.input)
            y = find_column(signals, f"{prefix}output", plot.output)
            path = prefix.replace(".", "/").strip("/") or "loop"
            # What moves the first plot moves the memory curve, too.
            self._tracks.append(_Track(path, plot, x, y, plot.input_range if prefix else layout.plane))
        names = [f"{plot.output} over {plot.input}" for plot in layout.plots.values()]
        self._names = names if len(names) > 1 else [title]
        self._memory: MemoryCurve | None = None

    @property
    def columns(self) -> tuple[int, int]:
        """Columns of the first plot's input and output."""
        return self._tracks[0].x, self._tracks[0].y

    def draw(self, recording: Recording) -> None:
        """Draw the axes."""
        for track in self._tracks:
            frame = Frame.of_plot(track.plot, self._signals[track.x], self._signals[track.y])
            frame.draw(recording, track.path)
            recording.log(f"{track.path}/data/path", line_style(1.25))
            recording.log(f"{track.path}/data/now", point_style())

    def write(self, recording: Recording, points: Iterable[Point]) -> None:
        """Draw plots and memory curve to further points."""
        first = self._tracks[0]
        drawn: list[list[tuple[Point, _Line]]] = [[] for _ in self._tracks]
        memories = []
        for point in points:
            x = point.values[first.x]
            if math.isfinite(x):
                self._memory = self._memory.step(x) if self._memory else MemoryCurve.from_negative_saturation(x)
            for track, shown in zip(self._tracks, drawn, strict=True):
                line = track.line_to(point)
                if line is None:
                    continue
                shown.append((point, line))
                if track is first and self._memory is not None:
                    memories.append(self._memory.corners(*self._plane))
        for track, shown in zip(self._tracks, drawn, strict=True):
            if not shown:
                continue
            when = times([point.t for point, _ in shown], [point.step for point, _ in shown])
            strips = [line for _, line in shown]
            colours = [_RISING if line[-1][0] >= line[0][0] else _FALLING for line in strips]
            recording.send(f"{track.path}/data/path", when, rr.LineStrips2D.columns(strips=strips, colors=colours))
            ends = [line[-1] for line in strips]
            recording.send(f"{track.path}/data/now", when, rr.Points2D.columns(positions=ends))
            if track is first:
                recording.send("plane/data/memory", when, rr.LineStrips2D.columns(strips=memories))
                inputs = [memory[-1] for memory in memories]
                recording.send("plane/data/input", when, rr.Points2D.columns(positions=inputs))

    def views(self) -> list[rrb.Spatial2DView]:
        """Return a view of each plot."""
        return [
            xy_view(track.path, name, f"/{track.path}/data/path")
            for track, name in zip(self._tracks, self._names, strict=True)
        ]


class _Track:
    """One plot of column y over column x below the entity `path`, and the line since the point drawn last.

    `_VISIBLE` is a part of `extent`, a range of the input.
    """

    def __init__(self, path: str, plot: XYPlot, x: int, y: int, extent: tuple[float, float]) -> None:
        self.path, self.plot, self.x, self.y = path, plot, x, y
        self._extents = extent, plot.output_range
        self._line: _Line = []
        self._drawn = -math.inf

    def line_to(self, point: Point) -> _Line | None:
        """Return the line to a point from the one that was drawn last; None if it is not drawn yet."""
        here = x, y = point.values[self.x], point.values[self.y]
        if not (math.isfinite(x) and math.isfinite(y)):
            return None
        self._line = self._line or [here]
        if not (point.is_reading or self._is_visible(here)):
            return None
        self._line.append(here)
        if not point.is_reading and point.t - self._drawn < _REDRAW_SECONDS:
            return None
        line, self._line, self._drawn = self._line, [here], point.t
        return line

    def _is_visible(self, point: tuple[float, float]) -> bool:
        """Return whether a point differs visibly from the one that was drawn last."""
        return any(
            abs(new - old) > _VISIBLE * (high - low)
            for new, old, (low, high) in zip(point, self._line[0], self._extents, strict=True)
        )
