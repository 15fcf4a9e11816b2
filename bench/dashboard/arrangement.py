"""How the views of a run are arranged: only those that have something to show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import rerun.blueprint as rrb

from bench.dashboard.drawing import whole_run

_MOST_OVER_TIME = 4
"""Plots over time that are visible at once. Derivation: of a window of 1000 pixels each has 200 then."""

View = rrb.View | rrb.Container


@dataclass(frozen=True)
class Arranged:
    """The views of a run."""

    control: Sequence[rrb.TimeSeriesView]  # of a run under control
    control_shares: Sequence[int]  # their heights
    over_time: Sequence[rrb.TimeSeriesView]  # those that are always visible
    others: Sequence[rrb.TimeSeriesView]  # further ones, in tabs
    # Loops, and Preisach planes.
    plots: Sequence[rrb.Spatial2DView]
    planes: Sequence[View]
    lateness: rrb.Spatial2DView | None  # how late the samples of loops were
    state: str  # what the run is doing, or how it ended
    lanes: Sequence[str]  # entities that show phases and states over time


def blueprint(views: Arranged) -> rrb.Blueprint:
    """Return the blueprint of a run: time on the left, loops and planes in the middle, numbers on the right."""
    # The signals beside a controller are looked at less, and many plots are too low to be read.
    rest = [*views.over_time, *views.others]
    visible = 1 if views.control else max(1, min(_MOST_OVER_TIME, len(views.over_time)))
    left: list[View] = [*views.control, *rest[: visible - 1]]
    if tabs := rest[max(visible - 1, 0) :]:
        left.append(rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0])
    shares = [*views.control_shares, *[4] * (len(left) - len(views.control))]
    columns: list[View] = []
    if left:
        columns.append(rrb.Vertical(*left, row_shares=shares))
    drawn = [*views.plots, *views.planes]
    log = rrb.TextLogView(
        origin="/events",
        name="Log",
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.encodings.TimelineColumn("t", visible=False)],
            text_log_columns=["LogLevel", "Body"],
        ),
    )
    below = rrb.Tabs(log, rrb.TextDocumentView(origin="/card", name="Run card"), active_tab=0)
    if drawn:
        columns.append(rrb.Grid(*drawn, grid_columns=1 if len(drawn) <= 2 else 2))
    numbers = rrb.TextDocumentView(origin="/numbers", name=f"Now: {views.state}")
    if views.lateness is None:
        columns.append(rrb.Vertical(numbers, below, row_shares=[2, 1]))
    else:
        columns.append(rrb.Vertical(numbers, views.lateness, below, row_shares=[4, 3, 3]))
    state = rrb.StateTimelineView(
        origin="/state", name=f"Protocol: {views.state}", contents=views.lanes, time_view=whole_run()
    )
    widths = [4, 3 if len(drawn) <= 2 else 5, 3][-len(columns) :] if len(columns) == 3 else [3, 2]
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(*columns, column_shares=widths), state, row_shares=[11, 2]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="t", play_state="following"),
    )


def seldom(value: float) -> float:
    """Return a positive number that changes seldom: a power of two that is no less; inf for any other."""
    return 2.0 ** math.ceil(math.log2(value)) if 0.0 < value < math.inf else math.inf
