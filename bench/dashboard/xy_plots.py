"""Plots of one signal over another.

A point is a reading of a step or, while a controller or a fast loop is at work, a tick. Every tick moves the memory,
but a point is drawn only if it comes `_REDRAW_SECONDS` after the last one and differs visibly from it; the line to it
passes through the points left out. Under control the path is pale, and the readings at the last targets are bright.
A plot is shown once its input has moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from bench.base import Floats
from bench.dashboard.bounds import Bound
from bench.dashboard.drawing import Colour, Frame, line_style, lines, pale, point_style, strips_at_once, xy_view
from bench.dashboard.entries import Ticks
from bench.dashboard.rerun_recording import RerunRecording, times
from bench.dashboard.signal_plots import find_column
from bench.devices import Signal
from bench.rig import DashboardLayout

_REDRAW_SECONDS = 0.1
"""Source: Nielsen, *Usability Engineering*, 1993, section 5.5: what takes 0.1 s is seen as happening at once."""
_VISIBLE = 0.002
"""Visible part of an axis; a controller at its target moves by less. Derivation: a pixel of 500."""

_MOVED = 5.0 * _VISIBLE
"""Part of its axis by which the input of a plot has to move for the plot to be shown. Derivation: five pixels."""

_PALE, _GREY = 0.35, 128
"""Part of their colour in that of the lines to old targets, and the grey that is the rest. Derivation: of a contrast
of 3.7 to 1 to a nearly black and a nearly white background."""

# Source: the palette of `signal_plots`, its first two.
_RISING: Colour = (236, 100, 46)
_FALLING: Colour = (58, 132, 232)

_Line = list[tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Points:
    """Points of the plots."""

    rows: Ticks  # one a point
    # Shape (points,); whether it is a reading after settling, not a tick under control.
    is_reading: npt.NDArray[np.bool_]


class XYPlots:
    """The plots of a layout, the first of which drives the memory curve.

    A plot that stands alone has the name `title`; several are named after their signals. With `fades` the path is
    pale, and bright only where it is recent. Raises a ConfigurationError if the layout names a signal that does not
    exist.
    """

    def __init__(
        self,
        layout: DashboardLayout,
        signals: Sequence[Signal],
        title: str,
        bounds: Sequence[Bound] = (),
        *,
        fades: bool = False,
    ) -> None:
        self._fades, self._bounds = fades, bounds
        self._tracks: list[_Track] = []
        for prefix, plot in layout.plots.items():
            x = find_column(signals, f"{prefix}input", plot.input)
            y = find_column(signals, f"{prefix}output", plot.output)
            path = prefix.replace(".", "/").strip("/") or "loop"
            frame = Frame.of_plot(plot, signals[x], signals[y])
            # What moves the first plot moves the memory curve, too.
            visible = plot.input_range if prefix or layout.plane is None else layout.plane
            self._tracks.append(_Track(path, frame, x, y, visible))
        names = [f"{plot.output} over {plot.input}" for plot in layout.plots.values()]
        self._names = names if len(names) > 1 else [title]

    @property
    def columns(self) -> tuple[int, int]:
        """Columns of the first plot's input and output."""
        return self._tracks[0].x, self._tracks[0].y

    @property
    def inputs(self) -> set[int]:
        """Columns of the inputs of all plots."""
        return {track.x for track in self._tracks}

    @property
    def moved(self) -> frozenset[str]:
        """Paths of the plots whose inputs have moved."""
        return frozenset(track.path for track in self._tracks if track.has_moved)

    @property
    def has_first_moved(self) -> bool:
        """Whether the input of the first plot has moved."""
        return self._tracks[0].has_moved

    def draw(self, recording: RerunRecording) -> None:
        """Draw the axes."""
        for track in self._tracks:
            self._draw_axes(recording, track)
            recording.log(f"{track.path}/data/path", line_style(1.0 if self._fades else 1.25))
            if self._fades:
                recording.log(f"{track.path}/data/recent", rr.Points2D.from_fields(radii=rr.Radius.ui_points(2.5)))
            recording.log(f"{track.path}/data/now", point_style())

    def _draw_axes(self, recording: RerunRecording, track: _Track) -> None:
        frame = track.frame
        frame.draw(recording, track.path)
        low_x, high_x = frame.x_range
        low_y, high_y = frame.y_range
        strips, colours = [], []
        for bound in self._bounds:
            if bound.column == track.x and low_x < bound.value < high_x:
                strips.append([(bound.value, low_y), (bound.value, high_y)])
            elif bound.column == track.y and low_y < bound.value < high_y:
                strips.append([(low_x, bound.value), (high_x, bound.value)])
            else:
                continue
            colours.append(bound.colour)
        recording.log(f"{track.path}/data/bounds", lines(strips, colours, 1.0, 5.0))

    def write(self, recording: RerunRecording, points: Points) -> list[int]:
        """Draw the plots to further points; return the numbers of those at which the first was drawn."""
        drawn: list[int] = []
        for track in self._tracks:
            shown = track.lines(points)
            if track is self._tracks[0]:
                drawn = [k for k, _ in shown]
            if not shown:
                continue
            strips = [line for _, line in shown]
            path = np.array(list(chain.from_iterable(strips)))
            if track.reach(path):
                self._draw_axes(recording, track)
            drawable = strips_at_once(path, [len(line) for line in strips])
            numbers = [k for k, _ in shown]
            when = times(points.rows.t[numbers], points.rows.step[numbers])
            colours = [_RISING if line[-1][0] >= line[0][0] else _FALLING for line in strips]
            ends = [line[-1] for line in strips]
            if self._fades:
                # What leads to a target is pale; a reading at it is bright.
                read = [i for i, k in enumerate(numbers) if points.is_reading[k]]
                if read:
                    at = times(
                        points.rows.t[[numbers[i] for i in read]], points.rows.step[[numbers[i] for i in read]]
                    )
                    recent = rr.Points2D.columns(positions=[ends[i] for i in read], colors=[colours[i] for i in read])
                    recording.send(f"{track.path}/data/recent", at, recent)
                colours = [_FADED[colour] for colour in colours]
            recording.send(f"{track.path}/data/path", when, rr.LineStrips2D.columns(strips=drawable, colors=colours))
            recording.send(f"{track.path}/data/now", when, rr.Points2D.columns(positions=ends))
        return drawn

    def views(self, bright: float) -> list[rrb.Spatial2DView]:
        """Return a view of each plot whose input has moved; its path is bright for so many seconds."""
        return [
            xy_view(track.path, name, self._past(track.path, bright))
            for track, name in zip(self._tracks, self._names, strict=True)
            if track.has_moved
        ]

    def _past(self, path: str, bright: float) -> dict[str, float]:
        past = {f"/{path}/data/path": math.inf}
        return past | {f"/{path}/data/recent": bright} if self._fades else past


_FADED = {colour: pale(colour, _PALE, _GREY) for colour in (_RISING, _FALLING)}


class _Track:
    """One plot of column y over column x below the entity `path`, and the line since the point drawn last."""

    def __init__(self, path: str, frame: Frame, x: int, y: int, extent: tuple[float, float]) -> None:
        self.path, self.frame, self.x, self.y = path, frame, x, y
        self._visible = [_VISIBLE * (high - low) for low, high in (extent, frame.y_range)]
        self._line: _Line = []
        self._drawn = -math.inf
        self._ends = math.inf, -math.inf
        self._least_move = _MOVED * (frame.x_range[1] - frame.x_range[0])

    @property
    def has_moved(self) -> bool:
        """Whether the input has moved."""
        low, high = self._ends
        return high - low > self._least_move

    def reach(self, path: Floats) -> bool:
        """Let the frame grow to points, shape (points, 2); return whether it did."""
        before = self.frame
        (low, bottom), (high, top) = path.min(axis=0).tolist(), path.max(axis=0).tolist()
        self._ends = min(self._ends[0], low), max(self._ends[1], high)
        self.frame = before.grown((low, high), (bottom, top))
        return self.frame is not before

    def lines(self, points: Points) -> list[tuple[int, _Line]]:
        """Return the points that are drawn, by their numbers, and the line to each from the one before."""
        values = points.rows.values
        known = np.flatnonzero(np.isfinite(values[:, [self.x, self.y]]).all(axis=1))
        columns = points.rows.t, values[:, self.x], values[:, self.y], points.is_reading
        # Tens of thousands of points: without a call for each.
        visible_x, visible_y = self._visible
        line, drawn = self._line, self._drawn
        shown = []
        for k, t, x, y, is_reading in zip(known.tolist(), *(each[known].tolist() for each in columns), strict=True):
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
