"""The page of two runs side by side."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.analysis.figures.panels import Curve, plot_panels, plot_signals
from bench.analysis.report.page.pages import Page, PageFigure, PageSection, inlined
from bench.analysis.report.recorded_run import RecordedRun
from bench.analysis.report.run_figures import loops_of
from bench.analysis.run_comparison import RunComparison
from bench.base import fitting_prefix, with_unit
from bench.record import Record, Table


def comparison_page(first: Record, second: Record, found: RunComparison) -> Page:
    """Return the page of two runs: how they ended, what tells them apart, and how far their signals are apart."""
    first_run, second_run = found.outcomes
    runs = RecordedRun.of(first), RecordedRun.of(second)
    sections = found.sections()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        sections["Signals"] += _differences(found, [run.steps for run in runs], scratch)
        sections["Loops"] = [*_loops(runs, scratch)]
    unfinished = "unfinished" in (first_run.status, second_run.status)
    lead = [f"{first_run.run}, {first_run.status}, beside {second_run.run}, {second_run.status}."]
    if unfinished:
        lead.append("UNFINISHED: one goes on, or its process died; this page has what was recorded until now.")
    return Page(
        title="Two runs",
        subtitle=f"{first_run.run} and {second_run.run}",
        badge="unfinished" if unfinished else "",
        badge_style="open" if unfinished else "",
        lead=lead,
        sections=[PageSection(title, parts) for title, parts in sections.items() if parts],
    )


def _loops(runs: Sequence[RecordedRun], scratch: Path) -> Iterator[PageFigure]:
    """Draw the loops that both runs have."""
    ours, theirs = ({(loop.input.name, loop.output.name): loop for loop in loops_of(run)} for run in runs)
    for i, (ends, first) in enumerate(ours.items()):
        if ends in theirs:
            path = scratch / f"loop-{i}.svg"
            curves = {"first": [first.curve(first)], "second": [theirs[ends].curve(first)]}
            horizontal, vertical = first.labels
            plot_panels(path, curves, horizontal_label=horizontal, vertical_label=vertical, measured=[*curves])
            caption = f"{ends[1]} over {ends[0]} in both runs, on the same axes."
            yield inlined(path, caption)


def _differences(found: RunComparison, tables: Sequence[Table], scratch: Path) -> list[PageFigure]:
    """Draw how far each signal is apart over the steps that both have, if that is anywhere."""
    common, ours, theirs = np.intersect1d(tables[0]["step"], tables[1]["step"], return_indices=True)
    curves = []
    for name, apart in found.signals.items():
        factor, unit = fitting_prefix(apart.unit, apart.maximum)
        apart_now = factor * (tables[1][name][theirs] - tables[0][name][ours])
        if np.any(np.nan_to_num(apart_now)):
            curves.append(Curve(with_unit(name, unit), common, apart_now))
    if not curves or common.size < 2:
        return []
    path = scratch / "differences.svg"
    plot_signals(path, curves, "step")
    caption = "Second less first, over the steps that both have."
    return [inlined(path, caption)]
