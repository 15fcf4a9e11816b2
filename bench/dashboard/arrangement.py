"""How the views of a run are arranged: only those that have something to show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import rerun.blueprint as rrb

from bench.dashboard.drawing import whole_run

_MOST_OVER_TIME = 4
"""Plots over time that are visible at once. Derivation: of a window of 1000 pixels each has 200 then."""

View = rrb.View | rrb.Container


def blueprint(
    *,
    control: Sequence[tuple[rrb.TimeSeriesView, int]],  # views of a run under control, and their heights
    over_time: Sequence[rrb.TimeSeriesView],  # those that are always visible
    others: Sequence[rrb.TimeSeriesView],  # further ones, in tabs
    drawn: Sequence[View],  # loops, and Preisach planes
    lateness: rrb.Spatial2DView | None,  # how late the samples of loops were
    state: str,  # what the run is doing, or how it ended
    lanes: Sequence[str],  # entities that show phases and states over time
) -> rrb.Blueprint:
    """Return the blueprint of a run: time on the left, loops and planes in the middle, numbers on the right."""
    # The signals beside a controller are looked at less, and many plots are too low to be read.
    rest = [*over_time, *others]
    visible = 1 if control else max(1, min(_MOST_OVER_TIME, len(over_time)))
    left: list[View] = [*(view for view, _ in control), *rest[: visible - 1]]
    if tabs := rest[max(visible - 1, 0) :]:
        left.append(rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else tabs[0])
    shares = [*(share for _, share in control), *[4] * (len(left) - len(control))]
    columns: list[View] = []
    if left:
        columns.append(rrb.Vertical(*left, row_shares=shares))
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
    numbers = rrb.TextDocumentView(origin="/numbers", name=f"Now: {state}")
    if lateness is None:
        columns.append(rrb.Vertical(numbers, below, row_shares=[2, 1]))
    else:
        columns.append(rrb.Vertical(numbers, lateness, below, row_shares=[4, 3, 3]))
    timeline = rrb.StateTimelineView(
        origin="/state", name=f"Protocol: {state}", contents=lanes, time_view=whole_run()
    )
    widths = [4, 3 if len(drawn) <= 2 else 5, 3][-len(columns) :] if len(columns) == 3 else [3, 2]
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(*columns, column_shares=widths), timeline, row_shares=[11, 2]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="t", play_state="following"),
    )


def seldom(value: float) -> float:
    """Return a positive number that changes seldom: a power of two that is no less; inf for any other."""
    return 2.0 ** math.ceil(math.log2(value)) if 0.0 < value < math.inf else math.inf
