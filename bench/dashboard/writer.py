"""Turns entries into the columns of a recording, and arranges its views."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from pydantic import ValidationError

from bench.base import ConfigurationError, problems
from bench.dashboard.arrangement import View, blueprint, seldom
from bench.dashboard.bounds import BoundLines, bounds_of
from bench.dashboard.controlled_run import TRACE_NAMES, WITNESS, ControlPlots, ErrorPlot
from bench.dashboard.entries import End, Entry, ModelDensity, Part, Ticks, densities_of, in_parts
from bench.dashboard.lateness_plot import LatenessPlot
from bench.dashboard.model_band import ModelBand, Plotted, banded_model
from bench.dashboard.numbers import LIVE_SECONDS, Numbers
from bench.dashboard.planes import Planes
from bench.dashboard.rerun_recording import RerunRecording, times
from bench.dashboard.signal_plots import follows, plots_by_unit
from bench.dashboard.timeline import Timeline
from bench.dashboard.xy_plots import Points, XYPlots
from bench.devices import Signal
from bench.identification import ModelFile
from bench.protocol import LATENESS
from bench.record import StepRecord, lateness_lines, run_card
from bench.rig import DashboardLayout


class Writer:
    """Writes a run to a recording, once it is open; used by one thread at a time.

    Signals and metadata are those of the run's journal, `models` those known from the start. Raises a
    ConfigurationError if the layout is wrong, or a signal that it or `controls` names does not exist, and a KeyError
    if the metadata is incomplete.
    """

    def __init__(self, signals: Sequence[Signal], meta: Mapping[str, Any], models: Sequence[ModelFile] = ()) -> None:
        layout = _layout_of(meta)
        ranges = {} if layout is None else layout.ranges
        # A record that does not say what limits allow has the ranges of its axes.
        signals = [
            replace(each, extent=max(map(abs, ranges[each.name])))
            if not each.extent and each.name in ranges
            else each
            for each in signals
        ]
        controls = meta.get("controls", "")
        self._run_id, self._card = str(meta["run"]), run_card(meta)
        self._title = f"{meta['rig_title']}: {meta['protocol']}"
        self._properties = {key: meta[key] for key in ("rig", "protocol", "seed")}
        bounds = bounds_of(meta, signals)
        self._plots: XYPlots | None = None
        self._planes: Planes | None = None
        if layout is not None:
            self._plots = XYPlots(layout, signals, meta["rig_title"], bounds, fades=bool(controls))
            self._planes = Planes(layout, signals, self._plots.columns, densities_of(models))
        self._control: ControlPlots | None = None
        self._errors: ErrorPlot | None = None
        if controls:
            witness = (meta.get("slots") or {}).get(WITNESS, {}).get("signal", "")
            self._control = ControlPlots.of(signals, controls, ranges.get(controls), witness)
            self._errors = ErrorPlot(self._control)
        self._signals = plots_by_unit(signals, TRACE_NAMES if controls else ())
        self._bounds = {
            plot.path: BoundLines(
                f"signals/{plot.path}", [b for b in bounds if b.column in plot.columns], plot.factor
            )
            for plot in self._signals
        }
        names = [signal.name for signal in signals]
        self._lateness_column = names.index(LATENESS.name) if LATENESS.name in names else None
        # The set-points that the inputs of the plots follow.
        self._commanded = {
            column: place
            for column in (() if self._plots is None else self._plots.inputs)
            for place, setpoint in enumerate(signals)
            if follows(signals[column], setpoint)
        }
        self._over_time = {names.index(name) for name in meta.get("over_time") or () if name in names}
        self._band = self._band_of(models, signals)
        shown = [self._control.output] if self._control else list(self._plots.columns[::-1] if self._plots else ())
        self._numbers = Numbers(
            meta, signals, shown or sorted(self._over_time)[:2] or [0], bounds, self._errors, self._band
        )
        self._timeline = Timeline()
        self._lateness = LatenessPlot(meta)
        self._filled: set[str] = set()
        self._arranged: object = None

    def open(self, path: Path | None, port: int | None) -> None:
        """Make the recording, see `RerunRecording`, and write everything that does not change."""
        self.recording = RerunRecording(self._run_id, self._title, path, port)
        self.recording.set_property("bench", self._properties)
        self.recording.log("card", rr.TextDocument(self._card, media_type=rr.MediaType.MARKDOWN))
        for plot in self._signals:
            for kind, style in plot.styles.items():
                self.recording.log(f"{kind}/{plot.path}", style)
            self._bounds[plot.path].draw(self.recording)
        if self._control is not None:
            for name, look in self._control.styles().items():
                self.recording.log(f"control/{name}", look)
        if self._band is not None:
            self._band.draw(self.recording)
        self._timeline.draw(self.recording)
        if self._plots is not None and self._planes is not None:
            self._plots.draw(self.recording)
            self._planes.draw(self.recording)
        if path is None:
            self._numbers.interval = LIVE_SECONDS
            self.arrange()

    def write(self, entries: Sequence[Entry | Part]) -> None:
        """Write entries in the order in which they happened."""
        parts = in_parts(entries)
        if self._band is not None:
            self._band.see(parts)
            self._band.write(self.recording)
        for part in parts:
            if isinstance(part, ModelDensity) and self._planes is not None:
                self._planes.draw_density(self.recording, part)
            elif isinstance(part, End):
                self.recording.set_property("outcome", {"status": part.status, "reason": part.reason})
                self._lateness.draw(self.recording, part.lateness)
                if part.lateness:
                    lines = "\n".join(lateness_lines(part.lateness))
                    text = f"{self._card}\n\n```text\n{lines}\n```\n"
                    self.recording.log("card", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
            for piece in self._numbers.cut(part):
                if self._errors is not None:
                    self._errors.see(piece)
                self._numbers.see(piece)
        self._write_values("signals", [part for part in parts if isinstance(part, Ticks)])
        self._write_values("readings", [_readings_of(part) for part in parts if isinstance(part, StepRecord)])
        if self._plots is not None and self._planes is not None and (points := self._points(parts)) is not None:
            self._planes.write(self.recording, points, self._plots.write(self.recording, points))
        if self._errors is not None:
            self._errors.write(self.recording)
        self._numbers.write(self.recording)
        self._timeline.write(self.recording, parts)

    def arrange(self) -> None:
        """Arrange the views again if what they have to show has changed."""
        wanted = (
            frozenset(self._filled),
            None if self._errors is None else self._errors.range(),
            math.inf if self._errors is None else seldom(self._errors.seconds_bright(self._timeline.t)),
            self._numbers.state,
            self._timeline.is_eventful,
            frozenset() if self._plots is None else self._plots.moved,
        )
        if wanted != self._arranged:
            self._arranged = wanted
            self.recording.arrange(self._blueprint(*wanted[:5]))

    def warn(self, text: str) -> None:
        """Report a problem of the dashboard itself in the log."""
        self._timeline.warn(self.recording, text)

    def _write_values(self, kind: str, rows: Sequence[Ticks]) -> None:
        if not rows:
            return
        joined = Ticks.joined(rows)
        t, step, table = joined.t, joined.step, joined.values
        when = times(t, step)
        for plot in self._signals:
            self.recording.send_vectors(f"{kind}/{plot.path}", when, plot.series(table))
            self._note(f"{kind}/{plot.path}", table[:, plot.columns])
            if kind == "signals":
                self._bounds[plot.path].write(self.recording, t, step)
        if self._control is not None and kind == "signals":
            for name, series in self._control.series(table).items():
                self.recording.send_vectors(f"control/{name}", when, series)
                # Of the tracking the reference, as there is an output always.
                self._note(name, np.isfinite(series[:, 0]) if name == "tracking" else series)

    def _band_of(self, models: Sequence[ModelFile], signals: Sequence[Signal]) -> ModelBand | None:
        """Return the prediction band of the model of the first loop, if it is plotted and there is one."""
        if self._plots is None:
            return None
        drive, output = self._plots.columns
        places = {
            column: Plotted(column, f"signals/{plot.path}", plot.factor)
            for plot in self._signals
            for column in plot.columns
        }
        response, reference = places[output], None
        if self._control is not None:
            if self._control.output != output:
                return None
            response = Plotted(output, "control/error", self._control.error_factor)
            reference = self._control.traces[0]
        setpoint = places.get(self._commanded.get(drive, -1))
        units = signals[drive].unit, signals[output].unit
        file = banded_model(models, units, is_controlled=reference is not None)
        if file is None:
            return None
        return ModelBand(file, drive=drive, response=response, setpoint=setpoint, reference=reference)

    def _note(self, name: str, values: npt.NDArray[Any]) -> None:
        """Note whether a plot has something to show: numbers that are not all zero."""
        if name not in self._filled and np.any(np.nan_to_num(values)):
            self._filled.add(name)

    def _points(self, parts: Sequence[Part]) -> Points | None:
        """Return the points of the XY plots: each reading and, under control and in a fast loop, each tick."""
        found = []
        for part in parts:
            if isinstance(part, StepRecord):
                found.append((_readings_of(part), True))
            elif isinstance(part, Ticks) and len(shown := self._shown(part)):
                found.append((shown, False))
        if not found:
            return None
        are_readings = np.concatenate([np.full(len(each), is_reading) for each, is_reading in found])
        return Points(Ticks.joined([each for each, _ in found]), are_readings)

    def _shown(self, ticks: Ticks) -> Ticks:
        """Return the ticks that the XY plots show; a fast loop reads no actuator: there is what it was set to."""
        samples = np.zeros(len(ticks), dtype=np.bool_)
        if self._lateness_column is not None:
            samples |= np.isfinite(ticks.values[:, self._lateness_column])
        shown = samples if self._control is None else samples | self._control.is_at_work(ticks.values)
        values = ticks.values[shown]
        for column, setpoint in self._commanded.items():
            commanded = samples[shown] & np.isfinite(values[:, setpoint])
            values[commanded, column] = values[commanded, setpoint]
        return Ticks(ticks.t[shown], ticks.step[shown], values)

    def _blueprint(
        self, filled: frozenset[str], error_range: float | None, bright: float, state: str, eventful: bool
    ) -> rrb.Blueprint:
        over_time: list[rrb.TimeSeriesView] = []
        others: list[rrb.TimeSeriesView] = []
        for plot in self._signals:
            if filled and not {f"signals/{plot.path}", f"readings/{plot.path}"} & filled:
                continue
            always = not self._over_time or self._over_time & set(plot.columns)
            (over_time if always else others).append(plot.view())
        control = (
            [] if self._control is None else self._control.views(filled, error_range, banded=self._band is not None)
        )
        drawn: list[View] = []
        if self._plots is not None and self._planes is not None:
            drawn += [*self._plots.views(bright), *self._planes.views(has_moved=self._plots.has_first_moved)]
        return blueprint(
            control=control,
            over_time=over_time,
            others=others,
            drawn=drawn,
            lateness=self._lateness.view(),
            state=state,
            # What is over does not run: its lane would say so up to the end.
            lanes=["/state/phase", *["/state/run"] * (state in ("running", "paused") or eventful)],
        )


def _readings_of(record: StepRecord) -> Ticks:
    """Return the readings of a step, at its end."""
    return Ticks(np.array([record.finished]), np.array([record.step]), np.array([record.values], dtype=np.float64))


def _layout_of(meta: Mapping[str, Any]) -> DashboardLayout | None:
    try:
        return DashboardLayout.model_validate(meta["dashboard"]) if meta.get("dashboard") else None
    except ValidationError as error:
        raise ConfigurationError("; ".join(problems(error, DashboardLayout, "dashboard."))) from None
