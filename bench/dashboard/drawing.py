"""Colours, axes and images: how plots are drawn in Rerun's two-dimensional views.

Rerun has no view of one quantity over another. In its spatial view y points down and both axes have one scale, so
a transform places what is logged below `PATH/data` in physical units within a drawn frame of height 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from rerun.components import LineStrip2DBatch
from rerun.encodings import Vec2DBatch

from bench.base import Floats, fitting_prefix
from bench.dashboard.rerun_recording import RerunRecording
from bench.devices import Signal
from bench.rig import XYPlot

Colour = tuple[int, int, int] | tuple[int, int, int, int]
"""Red, green and blue, and how opaque it is, 0 to 255."""

# The viewer's own background is nearly black or nearly white.
# Source: WCAG 2.2, 1.4.11: each colour has a contrast of 3 to 1 or more to the one, and of 2.6 to the other.
INK: Colour = (124, 132, 142)
FAINT: Colour = (104, 110, 118)
MARKER: Colour = (22, 168, 150)
ALARM: Colour = (214, 58, 56)
CAUTION: Colour = (206, 142, 20)
LIMIT: Colour = (136, 116, 206)
# Source: blue against orange, which a reader tells apart who does not tell red from green.
_DENSITY_COLOURS: tuple[tuple[float, Colour], ...] = (
    (-1.0, (36, 128, 232, 255)),
    (-0.4, (52, 116, 196, 200)),
    (0.0, (110, 110, 140, 24)),
    (0.25, (128, 62, 156, 190)),
    (0.6, (214, 66, 86, 235)),
    (1.0, (244, 160, 40, 255)),
)

_WIDTH = 1.15
"""Width of a frame whose height is 1. Derivation: so is half a column in a window of 1600 by 1000 pixels."""


@dataclass(frozen=True)
class Frame:
    """A pair of axes: ranges in the units of the data, titles, and the factors of the numbers beside them."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    x_title: str
    y_title: str
    x_factor: float
    y_factor: float

    @classmethod
    def of_plot(cls, plot: XYPlot, x: Signal, y: Signal) -> Frame:
        """Return the frame of one signal over another."""
        titles = [f"{each.description} [{each.display.unit or 1}]" for each in (x, y)]
        factors = x.display.factor, y.display.factor
        return cls(plot.input_range, plot.output_range, titles[0], titles[1], *factors)

    @classmethod
    def of_plane(cls, extent: tuple[float, float], unit: str) -> Frame:
        """Return the frame of a Preisach plane over an input in `unit`."""
        factor, shown = fitting_prefix(unit, *extent)
        return cls(extent, extent, f"β [{shown}]", f"α [{shown}]", factor, factor)

    def grown(self, x: tuple[float, float], y: tuple[float, float]) -> Frame:
        """Return the frame with axes that reach the ends of x and y; the same if they do."""
        x_range, y_range = _grown(self.x_range, x), _grown(self.y_range, y)
        if (x_range, y_range) == (self.x_range, self.y_range):
            return self
        return replace(self, x_range=x_range, y_range=y_range)

    def x(self, value: float) -> float:
        """Return where a value stands on the horizontal axis."""
        low, high = self.x_range
        return _WIDTH * (value - low) / (high - low)

    def y(self, value: float) -> float:
        """Return where a value stands on the vertical axis."""
        low, high = self.y_range
        return -(value - low) / (high - low)

    def draw(self, recording: RerunRecording, path: str) -> None:
        """Draw the axes, and give what is logged below `path`/data their units."""
        columns = [(self.x(value), value * self.x_factor) for value in _round_values(*self.x_range)]
        rows = [(self.y(value), value * self.y_factor) for value in _round_values(*self.y_range)]
        grid = [[(x, 0.0), (x, -1.0)] for x, _ in columns] + [[(0.0, y), (_WIDTH, y)] for y, _ in rows]
        box = [(0.0, 0.0), (_WIDTH, 0.0), (_WIDTH, -1.0), (0.0, -1.0), (0.0, 0.0)]
        recording.log(f"{path}/axes/grid", lines(grid, FAINT, 0.5, -20.0))
        recording.log(f"{path}/axes/box", lines([box], INK, 0.75, 10.0))
        places = [(x, 0.02) for x, _ in columns] + [(-0.065, y - 0.035) for y, _ in rows]
        numbers = [f"{value:.6g}" for _, value in (*columns, *rows)]
        recording.log(f"{path}/axes/ticks", texts(places, numbers))
        titles = [(_WIDTH / 2, 0.09), (0.0, -1.1)]
        recording.log(f"{path}/axes/titles", texts(titles, [self.x_title, self.y_title]))
        matrix = np.diag([self.x(1.0) - self.x(0.0), self.y(1.0) - self.y(0.0), 1.0])
        shift = [self.x(0.0), self.y(0.0), 0.0]
        recording.log(f"{path}/data", rr.Transform3D(mat3x3=matrix, translation=shift))

    def draw_image(
        self, recording: RerunRecording, path: str, values: Floats, x: Sequence[float], y: Sequence[float]
    ) -> None:
        """Draw values from -1 to 1 as colours, the first row at the top, between two values of x and two of y."""
        height, width = values.shape
        across, down = (self.x(x[1]) - self.x(x[0])) / width, (self.y(y[0]) - self.y(y[1])) / height
        recording.log(
            path,
            rr.Transform3D(mat3x3=np.diag([across, down, 1.0]), translation=[self.x(x[0]), self.y(y[1]), 0.0]),
            rr.Image(_coloured(values), draw_order=-10.0),
        )


def pale(colour: Colour, part: float, grey: int) -> Colour:
    """Return a colour of which only a part is left; the rest is grey, 0 to 255."""
    red, green, blue = (round(part * each + (1 - part) * grey) for each in colour[:3])
    return red, green, blue


def lines(strips: Any, colour: Colour | Sequence[Colour], points: float, order: float) -> rr.LineStrips2D:  # noqa: ANN401
    """Return lines of a width in points of the screen."""
    return rr.LineStrips2D(strips, colors=colour, radii=rr.Radius.ui_points(points), draw_order=order)


def strips_at_once(points: Floats, lengths: Sequence[int]) -> pa.Array:
    """Return lines as one array, which Rerun would make from one array a line.

    `points`, shape (points, 2), are those of all lines, `lengths` the number of points of each.
    """
    ends = np.cumsum([0, *lengths], dtype=np.int32)
    vectors = Vec2DBatch(points.astype(np.float32)).as_arrow_array()
    return pa.ListArray.from_arrays(pa.array(ends), vectors, type=LineStrip2DBatch._ARROW_DATATYPE)


def line_style(points: float, colour: Colour | None = None) -> rr.LineStrips2D:
    """Return the look of lines that change in time."""
    return rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(points), colors=colour, draw_order=20.0)


def point_style() -> rr.Points2D:
    """Return the look of the latest point."""
    return rr.Points2D.from_fields(radii=rr.Radius.ui_points(5.0), colors=MARKER, draw_order=30.0)


def texts(places: Sequence[tuple[float, float]], labels: Sequence[str]) -> rr.Points2D:
    """Return texts at places of a frame."""
    return rr.Points2D(places, labels=labels, show_labels=True, colors=INK, radii=0.0)


def xy_view(path: str, name: str, past: Mapping[str, float] = MappingProxyType({})) -> rrb.Spatial2DView:
    """Return the view of what a `Frame` frames; of the entities of `past` it shows so many seconds of history."""
    now = rrb.TimeRangeBoundary.cursor_relative()
    overrides: dict[Any, rrb.VisibleTimeRanges] = {}
    for entity, seconds in past.items():
        forever = rrb.TimeRangeBoundary.infinite()
        since = forever if math.isinf(seconds) else rrb.TimeRangeBoundary.cursor_relative(seconds=-seconds)
        ranges = [
            rrb.VisibleTimeRange("t", start=since, end=now),
            rrb.VisibleTimeRange("step", start=forever, end=now),
        ]
        overrides[entity] = rrb.VisibleTimeRanges(ranges)
    return rrb.Spatial2DView(
        origin=f"/{path}",
        name=name,
        visual_bounds=rrb.VisualBounds2D(x_range=(-0.2, _WIDTH + 0.08), y_range=(-1.16, 0.2)),
        overrides=overrides,
    )


def time_view(origin: str, name: str, y: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
    """Return the view of a quantity over the time of the whole run, without a legend, which would hide data."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=whole_run(),
        axis_y=None if y is None else rrb.ScalarAxis(range=y),
    )


def whole_run() -> rrb.TimeAxis:
    """Return a time axis that shows the whole run."""
    forever = rrb.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=forever, end=forever))


def _grown(axis: tuple[float, float], ends: tuple[float, float]) -> tuple[float, float]:
    """Return an axis that is longer by eighths of its length at either end, as many as reach the ends."""
    low, high = axis
    part = (high - low) / 8
    below, above = (max(0, math.ceil(beyond / part)) for beyond in (low - ends[0], ends[1] - high))
    return low - below * part, high + above * part


def _round_values(low: float, high: float) -> list[float]:
    """Return some five round values within a range."""
    rough = (high - low) / 5
    magnitude = 10.0 ** math.floor(math.log10(rough))
    step = min((m * magnitude for m in (1, 2, 2.5, 5, 10)), key=lambda step: abs(step - rough))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [n * step for n in range(first, last + 1)]


def _coloured(values: Floats) -> npt.NDArray[np.uint8]:
    """Return colours of values from -1 to 1; nan is transparent."""
    stops = np.array([stop for stop, _ in _DENSITY_COLOURS])
    colours = np.array([colour for _, colour in _DENSITY_COLOURS], dtype=np.float64)
    known = np.nan_to_num(values)
    channels = [np.interp(known, stops, colours[:, i]) for i in range(4)]
    channels[3][np.isnan(values)] = 0.0
    return np.stack(channels, axis=-1).round().astype(np.uint8)
