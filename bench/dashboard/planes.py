"""Preisach planes with their memory curves: the one of the first input, with a lattice, and those of other inputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bench.base import Floats, fitting_prefix
from bench.dashboard.drawing import FAINT, INK, MARKER, Frame, line_style, lines, point_style, texts, xy_view
from bench.dashboard.entries import ModelDensity
from bench.dashboard.rerun_recording import RerunRecording, times
from bench.dashboard.xy_plots import Points
from bench.devices import Signal
from bench.models import Coupled, MemoryCurve, density_unit
from bench.rig import SETPOINT, DashboardLayout


class SignalMemory:
    """The memory curve of a signal, in a column of the values."""

    def __init__(self, column: int) -> None:
        self.columns = [column]
        self.curve: MemoryCurve | None = None
        """None before the first reading."""

    def see(self, x: float) -> None:
        """Let the signal move the memory."""
        if math.isfinite(x):
            self.curve = self.curve.step(x) if self.curve else MemoryCurve.from_negative_saturation(x)


class StageMemory:
    """The memory curve of the second stage of a model, whose input is no signal: the model follows the readings.

    The model, of voltage and force, starts as after a reset.
    """

    def __init__(self, model: Coupled[Any], columns: tuple[int, int]) -> None:
        self._model, self.columns = model, list(columns)
        self._state: Any = model.initial_state()
        self.curve: MemoryCurve | None = None
        """None before the first reading, and for operators without one."""

    def see(self, voltage: float, force: float) -> None:
        """Let the model follow a reading."""
        if math.isfinite(voltage) and math.isfinite(force):
            self._state, _ = self._model.step(self._state, voltage, force)
            second = getattr(self._state, "second", None)
            self.curve = second if isinstance(second, MemoryCurve) else None


def memory_of(model: ModelDensity, signals: Sequence[Signal], drive: int) -> SignalMemory | StageMemory | None:
    """Return what follows the memory on the plane of a density over another input; None if nothing can."""

    def column(unit: str) -> int | None:
        if signals[drive].unit == unit:
            return drive
        return next((i for i, s in enumerate(signals) if s.unit == unit and not s.name.endswith(SETPOINT)), None)

    if model.density.measured:
        found = column(model.density.unit)
        return None if found is None else SignalMemory(found)
    # A model of several stages has a force beside its voltage.
    if getattr(model.model, "force_unit", None) is not None:
        stages = cast("Coupled[Any]", model.model)
        voltage, force = column(stages.voltage_unit), column(stages.force_unit)
        if voltage is not None and force is not None:
            return StageMemory(stages, (voltage, force))
    return None


class Planes:
    """The planes of a layout with the columns x and y of the first input and output.

    Those of `densities`, which are known from the start, that do not fit the first plane get views of their own. A
    layout without a plane has none of the first input.
    """

    def __init__(
        self,
        layout: DashboardLayout,
        signals: Sequence[Signal],
        columns: tuple[int, int],
        densities: Sequence[ModelDensity],
    ) -> None:
        self._extent, self._levels = layout.plane, layout.levels
        self._x, self._y = (signals[column] for column in columns)
        self._others = {path: model for model in densities if (path := self._path_of(model)) != "plane"}
        self._memories: dict[str, SignalMemory | StageMemory] = {}
        self._extents: dict[str, tuple[float, float]] = {}
        self._has_density = len(self._others) < len(densities)
        if self._extent is not None:
            self._memories["plane"] = SignalMemory(columns[0])
            self._extents["plane"] = self._extent
        for path, model in self._others.items():
            if (memory := memory_of(model, signals, columns[0])) is not None:
                self._memories[path] = memory
                self._extents[path] = (float(model.density.levels[0]), float(model.density.levels[-1]))

    def draw(self, recording: RerunRecording) -> None:
        """Draw the first input's plane."""
        for path in self._memories:
            recording.log(f"{path}/data/memory", line_style(1.75, MARKER))
            recording.log(f"{path}/data/input", point_style())
        if self._extent is not None:
            low, high = self._extent
            _draw_plane(recording, "plane", Frame.of_plane((low, high), self._x.unit))
            inner = np.linspace(low, high, self._levels + 1)[1:-1]
            lattice = [[(low, value), (value, value), (value, high)] for value in inner]
            recording.log("plane/data/lattice", lines(lattice, FAINT, 0.5, -15.0))

    def write(self, recording: RerunRecording, points: Points, drawn: Sequence[int]) -> None:
        """Draw the memory curves at the points whose numbers are `drawn`; all points move that of the first input."""
        shown = frozenset(drawn)
        for path, memory in self._memories.items():
            corners: list[tuple[int, Floats]] = []
            # What only a model knows takes long, and a point that is not drawn differs too little.
            numbers = range(len(points.rows)) if path == "plane" else drawn
            for k, values in zip(numbers, points.rows.values[np.ix_(numbers, memory.columns)].tolist(), strict=True):
                memory.see(*values)
                if k in shown and memory.curve is not None:
                    corners.append((k, memory.curve.corners(*self._extents[path])))
            if corners:
                seen = [k for k, _ in corners]
                when = times(points.rows.t[seen], points.rows.step[seen])
                strips = [each for _, each in corners]
                recording.send(f"{path}/data/memory", when, rr.LineStrips2D.columns(strips=strips))
                ends = [each[-1] for each in strips]
                recording.send(f"{path}/data/input", when, rr.Points2D.columns(positions=ends))

    def draw_density(self, recording: RerunRecording, model: ModelDensity) -> None:
        """Draw a density with its legend, on a plane of its own if it is over another input than the first."""
        density, path = model.density, self._path_of(model)
        self._has_density |= path == "plane"
        x_unit, y_unit = density.unit or self._x.unit, density.output_unit or self._y.unit
        low, high, cells = float(density.levels[0]), float(density.levels[-1]), len(density.levels) - 1
        if path == "plane":
            frame = Frame.of_plane(self._extent or (low, high), self._x.unit)
        else:
            frame = Frame.of_plane((low, high), x_unit)
            _draw_plane(recording, path, frame)
        # Several pixels a cell, for the diagonal and for intervals of unequal length.
        pixels = cells * max(8, 256 // cells)
        middles = low + (np.arange(pixels) + 0.5) * (high - low) / pixels
        cell = np.clip(np.searchsorted(density.levels, middles, side="right") - 1, 0, cells - 1)
        values = np.where(middles[:, None] >= middles, density.values[np.ix_(cell, cell)], np.nan)
        greatest = float(np.nanmax(np.abs(values))) or 1.0
        frame.draw_image(recording, f"{path}/density", (values / greatest)[::-1], (low, high), (low, high))
        # The legend stands in the corner below the diagonal, which belongs to no cell.
        least = -greatest if np.nanmin(values) < 0 else 0.0
        ramp = np.linspace(least / greatest, 1.0, 128)[None, :].repeat(8, axis=0)
        low, high = frame.x_range
        left, right, bottom, top = low + np.array([0.62, 0.92, 0.06, 0.1]) * (high - low)
        frame.draw_image(recording, f"{path}/legend/bar", ramp, (left, right), (bottom, top))
        factor, y_unit = fitting_prefix(y_unit, greatest)
        above = frame.y(top)
        ends = [(frame.x(left), above - 0.09), (frame.x(right), above - 0.09)]
        numbers = [f"{factor * value:.3g}" for value in (least, greatest)]
        recording.log(f"{path}/legend/ends", texts(ends, numbers))
        middle = frame.x((left + right) / 2)
        title = f"{' '.join(('density', density.title)).strip()} [{density_unit(y_unit, x_unit)}]"
        recording.log(
            f"{path}/legend/title", texts([(middle, above - 0.23), (middle, above - 0.16)], [model.name, title])
        )

    def views(self, *, has_moved: bool) -> list[rrb.Spatial2DView | rrb.Tabs]:
        """Return the view of the first input's plane, if there is a density or a memory, and the others in tabs."""
        views = [
            xy_view(path, f"Preisach plane of {model.density.title or model.name}")
            for path, model in sorted(self._others.items())
        ]
        others = [rrb.Tabs(*views, active_tab=0)] if len(views) > 1 else views
        first = (
            [xy_view("plane", "Preisach plane")]
            if self._extent is not None and (has_moved or self._has_density)
            else []
        )
        return [*first, *others]

    def _path_of(self, model: ModelDensity) -> str:
        """Return the path of the plane on which a density is drawn."""
        density = model.density
        if self._extent is not None and density.measured and density.unit in ("", self._x.unit):
            return "plane"
        return f"planes/{rr.escape_entity_path_part(density.title or model.name)}"


def _draw_plane(recording: RerunRecording, path: str, frame: Frame) -> None:
    """Draw axes and triangle of a plane."""
    frame.draw(recording, path)
    low, high = frame.x_range
    triangle = [(low, low), (high, high), (low, high), (low, low)]
    recording.log(f"{path}/data/triangle", lines([triangle], INK, 1.0, 10.0))
