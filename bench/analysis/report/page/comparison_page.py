"""The page of two runs side by side."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.analysis.figures.panels import Curve, plot_panels, plot_signals
from bench.analysis.report.page.elements import Page, PageFigure, PageSection, PageTable
from bench.analysis.report.page.svg import inlined
from bench.analysis.run_comparison import SIGNAL_HEADS, RunComparison
from bench.base import counted, fitting_prefix, with_unit
from bench.record import Record, Table


def comparison_page(first: Record, second: Record, found: RunComparison) -> Page:
    """Return the page of two runs: how they ended, what tells them apart, and how far their signals are apart."""
    names = [outcome.run for outcome in found.outcomes]
    tables = first.steps(), second.steps()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        sections = [
            PageSection("Outcome", (PageTable(("", "first", "second"), found.outcome_rows()),)),
            PageSection("What differs", _differences(found)),
            PageSection("Loops", _loops(first, tables, scratch)),
            PageSection("Signals", _signals(found, tables, scratch)),
        ]
    unfinished = any(outcome.status == "unfinished" for outcome in found.outcomes)
    return Page(
        title="Two runs",
        subtitle=f"{names[0]} and {names[1]}",
        badge="unfinished" if unfinished else "",
        badge_style="open" if unfinished else "",
        lead=_lead(found),
        sections=[section for section in sections if section.parts],
    )


def _lead(found: RunComparison) -> list[str]:
    first, second = found.outcomes
    count = len(found.differences)
    equal = [name for name, same in found.equal.items() if same]
    lead = [
        f"First: {first.run}, {first.status} after {counted(first.steps, 'step')}. "
        f"Second: {second.run}, {second.status} after {counted(second.steps, 'step')}.",
        f"{counted(count, 'thing')} that they were given differ{'' if count != 1 else 's'}."
        if count
        else "Nothing differs in what they were given.",
        f"Equal to the last bit: {', '.join(equal) or 'nothing'}.",
    ]
    if "unfinished" in (first.status, second.status):
        lead.append("UNFINISHED: one goes on, or its process died; this page has what was recorded until now.")
    return lead


def _differences(found: RunComparison) -> list[PageTable]:
    return [PageTable(("key", "first", "second"), found.difference_rows())] if found.differences else []


def _loops(record: Record, tables: Sequence[Table], scratch: Path) -> list[PageFigure]:
    layout = record.meta.get("dashboard")
    if not layout:
        return []
    figures = []
    for i, pair in enumerate([layout, *layout.get("loops", ())]):
        ends = pair["input"], pair["output"]
        if not all(name in table.columns and np.isfinite(table[name]).any() for table in tables for name in ends):
            continue
        factors, labels = [], []
        for name in ends:
            greatest = max(float(np.nanmax(np.abs(table[name]))) for table in tables)
            factor, unit = fitting_prefix(record.unit(name), greatest)
            factors.append(factor)
            labels.append(with_unit(name, unit))
        path = scratch / f"loop-{i}.svg"
        titles = ("first", "second")
        plot_panels(
            path,
            {
                title: [Curve("", factors[0] * table[ends[0]], factors[1] * table[ends[1]])]
                for title, table in zip(titles, tables, strict=True)
            },
            horizontal_label=labels[0],
            vertical_label=labels[1],
            measured=titles,
        )
        caption = f"{ends[1]} over {ends[0]} in both runs, on the same axes."
        figures.append(PageFigure(inlined(path, caption), caption))
    return figures


def _signals(found: RunComparison, tables: Sequence[Table], scratch: Path) -> list[PageTable | PageFigure]:
    parts: list[PageTable | PageFigure] = [
        PageTable(SIGNAL_HEADS, found.signal_rows(), title=found.signals_title, numbers_from=1)
    ]
    common, ours, theirs = np.intersect1d(tables[0]["step"], tables[1]["step"], return_indices=True)
    curves = []
    for name, apart in found.signals.items():
        factor, unit = fitting_prefix(apart.unit, apart.maximum)
        apart_now = factor * (tables[1][name][theirs] - tables[0][name][ours])
        if np.any(np.nan_to_num(apart_now)):
            curves.append(Curve(with_unit(name, unit).replace(" / ", "\n/ "), common, apart_now))
    if curves and common.size > 1:
        path = scratch / "differences.svg"
        plot_signals(path, curves, "step")
        caption = "Second less first, over the steps that both have."
        parts.append(PageFigure(inlined(path, caption), caption))
    return parts
