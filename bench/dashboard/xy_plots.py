"""Plots of one signal over another, and the memory curve that the first input drives.

A point is a reading of a step or, while a controller is at work, a tick. Every tick moves the memory, but a point is
drawn only if it comes `_REDRAW_SECONDS` after the last one and differs visibly from it; the line to it passes
through the points left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

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


Point = tuple[float, int, Sequence[float], bool]
"""Time (s), step, values, and whether it is a reading after settling, not a tick under control."""


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
        points = list(points)
        first = self._tracks[0]
        memories = self._memories_at(points)
        for track in self._tracks:
            shown = track.lines(points)
            if not shown:
                continue
            when = times([points[k][0] for k, _ in shown], [points[k][1] for k, _ in shown])
            strips = [line for _, line in shown]
            colours = [_RISING if line[-1][0] >= line[0][0] else _FALLING for line in strips]
            recording.send(f"{track.path}/data/path", when, rr.LineStrips2D.columns(strips=strips, colors=colours))
            ends = [line[-1] for line in strips]
            recording.send(f"{track.path}/data/now", when, rr.Points2D.columns(positions=ends))
            if track is first:
                corners = [memory.corners(*self._plane) for k, _ in shown if (memory := memories[k]) is not None]
                recording.send("plane/data/memory", when, rr.LineStrips2D.columns(strips=corners))
                inputs = [each[-1] for each in corners]
                recording.send("plane/data/input", when, rr.Points2D.columns(positions=inputs))

    def _memories_at(self, points: Sequence[Point]) -> list[MemoryCurve | None]:
        """Return the memory after each point, which the first plot's input has moved."""
        memory, column = self._memory, self._tracks[0].x
        memories = []
        for _, _, values, _ in points:
            x = values[column]
            if math.isfinite(x):
                memory = memory.step(x) if memory else MemoryCurve.from_negative_saturation(x)
            memories.append(memory)
        self._memory = memory
        return memories

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
        self._visible = [_VISIBLE * (high - low) for low, high in (extent, plot.output_range)]
        self._line: _Line = []
        self._drawn = -math.inf

    def lines(self, points: Sequence[Point]) -> list[tuple[int, _Line]]:
        """Return the points that are drawn, by their numbers, and the line to each from the one before."""
        # Tens of thousands of points: without a call for each.
        column_x, column_y = self.x, self.y
        visible_x, visible_y = self._visible
        line, drawn = self._line, self._drawn
        shown = []
        for k, (t, _, values, is_reading) in enumerate(points):
            x, y = values[column_x], values[column_y]
            if not (math.isfinite(x) and math.isfinite(y)):
                continue
            if not line:
                line = [(x, y)]
            if not is_reading:
                last_x, last_y = line[0]
                if not (abs(x - last_x) > visible_x or abs(y - last_y) > visible_y):
                    continue
            line.append((x, y))
            if is_reading or t - drawn >= _REDRAW_SECONDS:
                shown.append((k, line))
                line, drawn = [(x, y)], t
        self._line, self._drawn = line, drawn
        return shown
