"""Turns entries into the columns of a recording, and arranges its views."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from pydantic import ValidationError

from bench.configuration_errors import problems
from bench.dashboard.control import TRACE_NAMES, ControlPlots
from bench.dashboard.drawing import whole_run
from bench.dashboard.entries import End, Entry, ModelDensity, Tick
from bench.dashboard.planes import Planes
from bench.dashboard.recording import Recording, times
from bench.dashboard.signal_plots import plots_by_unit
from bench.dashboard.timeline import Timeline
from bench.dashboard.xy_plots import Point, XYPlots
from bench.devices import Signal
from bench.errors import ConfigurationError
from bench.journal import StepRecord, run_card
from bench.lateness import lateness_lines
from bench.layout import DashboardLayout

_PLOTS_IN_A_ROW = 3


class Writer:
    """Writes a run to a recording, once it is open; used by one thread at a time.

    Signals and metadata are those of the run's journal, `densities` those known from the start. Raises a
    ConfigurationError if the layout is wrong, or a signal that it or `controls` names does not exist, and a KeyError
    if the metadata is incomplete.
    """

    def __init__(
        self, signals: Sequence[Signal], meta: Mapping[str, Any], densities: Sequence[ModelDensity] = ()
    ) -> None:
        layout = _layout_of(meta)
        ranges = {} if layout is None else layout.ranges
        controls = meta.get("controls", "")
        self._run_id, self._card = str(meta["run"]), run_card(meta)
        self._title = f"{meta['rig_title']}: {meta['protocol']}"
        self._properties = {key: meta[key] for key in ("rig", "protocol", "seed")}
        self._plots: XYPlots | None = None
        self._planes: Planes | None = None
        if layout is not None:
            self._plots = XYPlots(layout, signals, meta["rig_title"])
            x, y = (signals[column] for column in self._plots.columns)
            self._planes = Planes(layout, x, y, densities)
        self._control = ControlPlots.of(signals, controls, ranges.get(controls)) if controls else None
        self._signals = plots_by_unit(signals, ranges, TRACE_NAMES if controls else ())
        self._timeline = Timeline()

    def open(self, path: Path | None, port: int | None) -> None:
        """Make the recording, see `Recording`, and write everything that does not change."""
        self.recording = Recording(self._run_id, self._title, path, port, self._blueprint())
        self.recording.set_property("bench", self._properties)
        self.recording.log("card", rr.TextDocument(self._card, media_type=rr.MediaType.MARKDOWN))
        for plot in self._signals:
            for kind in ("signals", "readings"):
                self.recording.log(f"{kind}/{plot.path}", plot.style)
        if self._control is not None:
            for name, style in self._control.styles().items():
                self.recording.log(f"control/{name}", style)
        self._timeline.draw(self.recording)
        if self._plots is not None and self._planes is not None:
            self._plots.draw(self.recording)
            self._planes.draw(self.recording)

    def write(self, entries: Sequence[Entry]) -> None:
        """Write entries in the order in which they happened."""
        for entry in entries:
            if isinstance(entry, ModelDensity) and self._planes is not None:
                self._planes.draw_density(self.recording, entry)
            elif isinstance(entry, End):
                self.recording.set_property("outcome", {"status": entry.status, "reason": entry.reason})
                if entry.lateness:
                    lines = "\n".join(lateness_lines(entry.lateness))
                    text = f"{self._card}\n\n```text\n{lines}\n```\n"
                    self.recording.log("card", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        ticks = [entry for entry in entries if isinstance(entry, Tick)]
        self._write_values("signals", ticks)
        readings = [Tick(e.finished, e.step, e.values) for e in entries if isinstance(e, StepRecord)]
        self._write_values("readings", readings)
        if self._plots is not None:
            self._plots.write(self.recording, self._points(entries))
        self._timeline.write(self.recording, entries)

    def warn(self, text: str) -> None:
        """Report a problem of the dashboard itself in the log."""
        self._timeline.warn(self.recording, text)

    def _write_values(self, kind: str, rows: Sequence[Tick]) -> None:
        if not rows:
            return
        t, step, values = zip(*rows, strict=True)
        when, table = times(t, step), np.array(values, dtype=np.float64)
        for plot in self._signals:
            self.recording.send_vectors(f"{kind}/{plot.path}", when, plot.series(table))
        if self._control is not None and kind == "signals":
            for name, series in self._control.series(table).items():
                self.recording.send_vectors(f"control/{name}", when, series)

    def _points(self, entries: Sequence[Entry]) -> Iterator[Point]:
        """Yield the points of the XY plots: each reading and, under control, each tick."""
        for entry in entries:
            if isinstance(entry, StepRecord):
                yield entry.finished, entry.step, entry.values, True
            elif isinstance(entry, Tick) and self._control is not None and self._control.is_at_work(entry.values):
                yield *entry, False

    def _blueprint(self) -> rrb.Blueprint:
        series = [plot.view() for plot in self._signals]
        left = rrb.Vertical(*series, row_shares=[plot.height for plot in self._signals])
        if self._control is not None:
            driven = [self._plots is not None and self._plots.columns[0] in plot.columns for plot in self._signals]
            others = rrb.Tabs(*series, active_tab=driven.index(True) if any(driven) else 0)
            left = rrb.Vertical(*self._control.views(), others, row_shares=[5, 4, 4, 4])
        state = rrb.StateTimelineView(origin="/state", name="Protocol", time_view=whole_run())
        log = rrb.TextLogView(
            origin="/events",
            name="Log",
            columns=rrb.TextLogColumns(
                timeline_columns=[rrb.encodings.TimelineColumn("t", visible=False)],
                text_log_columns=["LogLevel", "Body"],
            ),
        )
        card = rrb.TextDocumentView(origin="/card", name="Run card")
        below = rrb.Vertical(state, rrb.Horizontal(log, card, column_shares=[3, 2]), row_shares=[3, 5])
        right: rrb.Container = below
        plots = [] if self._plots is None else self._plots.views()
        planes = [] if self._planes is None else self._planes.views()
        if len(plots) == 1:
            right = rrb.Vertical(rrb.Horizontal(*plots, *planes), below, row_shares=[8, 7])
        elif plots:
            right = rrb.Vertical(
                rrb.Grid(*plots, grid_columns=min(len(plots), _PLOTS_IN_A_ROW)),
                rrb.Horizontal(*planes, rrb.Tabs(log, card, active_tab=0)),
                state,
                row_shares=[5 * math.ceil(len(plots) / _PLOTS_IN_A_ROW), 5, 2],
            )
        return rrb.Blueprint(
            rrb.Horizontal(left, right, column_shares=[2, 3] if len(plots) + len(planes) <= 2 else [1, 2]),
            rrb.BlueprintPanel(state="hidden"),
            rrb.SelectionPanel(state="hidden"),
            rrb.TimePanel(state="collapsed", timeline="t", play_state="following"),
        )


def _layout_of(meta: Mapping[str, Any]) -> DashboardLayout | None:
    try:
        return DashboardLayout.model_validate(meta["dashboard"]) if meta.get("dashboard") else None
    except ValidationError as error:
        raise ConfigurationError("; ".join(problems(error, DashboardLayout, "dashboard."))) from None
