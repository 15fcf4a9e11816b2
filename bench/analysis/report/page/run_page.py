"""The page of one run, for a log book: all that its record says, in words, tables and figures."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.applied import Applied
from bench.analysis.figures.panels import plot_histogram
from bench.analysis.figures.targets import plot_tracking
from bench.analysis.report.page.elements import Page, PageFigure, PagePart, PageSection, PageTable
from bench.analysis.report.page.model_parts import given_section, models_section
from bench.analysis.report.page.run_parts import (
    devices_section,
    events_section,
    interlocks_section,
    parameters_section,
    phases_section,
    published_section,
    repeat_section,
    requests_section,
    safe_state_text,
    signals_table,
)
from bench.analysis.report.page.svg import inlined
from bench.analysis.report.published import Published, concerning
from bench.analysis.report.run_figures import Phase, draw_loops, draw_signals, phases
from bench.analysis.report.telemetry_summary import TelemetrySummary
from bench.analysis.report.uncertainty_tables import uncertainty_parts
from bench.analysis.tracking_errors import FollowingResult, following_result, target_results, ticks_with
from bench.base import Display, Floats, counted, format_duration, percent, with_unit
from bench.devices import Signal
from bench.identification import models_among
from bench.record import Event, Record, Table, steps_of

_STYLES = {"completed": "good", "unfinished": "open"}
_LATENESS = "lateness"
"""Signal of the loops at a fixed rate: time by which a sample came too late, s."""


def run_page(
    record: Record,
    steps: Table,
    summary: TelemetrySummary,
    models: Sequence[Applied],
    result: Mapping[str, Any],
    published: Sequence[Published] = (),
) -> Page:
    """Return the page of a run; of one that has not ended what there is, marked as unfinished.

    `result` is what `report_run` returns, as far as it is known. Of the numbers of papers those are shown that
    concern the run.
    """
    meta, events = record.meta, record.events()
    extremes = result["extremes"]
    found = phases(record, steps, events)
    stated = concerning(published, meta)
    sections: list[PageSection] = []
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        if (control := _control_section(record, result, stated, scratch)) is not None:
            sections.append(control)
        if uncertain := uncertainty_parts(result["uncertainty"]):
            sections.append(PageSection("Uncertainty", uncertain))
        if models:
            sections.append(models_section(models, steps["finished"], scratch))
        elif (loops := _loops_section(record, steps, summary, found, scratch)) is not None:
            sections.append(loops)
        if (compared := published_section(stated, result)) is not None:
            sections.append(compared)
        if given := models_among(record.files(), str(record.path)):
            sections.append(given_section(list(given.items()), scratch))
        sections += [
            phases_section(found),
            _signals_section(record, steps, summary, extremes, found, scratch),
            interlocks_section(record, steps, summary, extremes, events),
            parameters_section(meta),
            devices_section(meta),
        ]
        if (late := _lateness_section(record, scratch)) is not None:
            sections.append(late)
        if (asked := requests_section(events)) is not None:
            sections.append(asked)
        sections += [events_section(events), repeat_section(record)]
    return Page(
        title=str(meta["rig_title"]),
        subtitle=f"{meta['protocol']}, {meta['run']}",
        badge=record.status,
        badge_style=_STYLES.get(record.status, "bad"),
        lead=_lead(record, len(steps), found, models, result, events),
        sections=sections,
    )


def _lead(
    record: Record,
    steps: int,
    found: Sequence[Phase],
    models: Sequence[Applied],
    result: Mapping[str, Any],
    events: Sequence[Event],
) -> list[str]:
    meta = record.meta
    host = meta.get("host") or {}
    started = str(host.get("started") or meta["epoch"])[:16].replace("T", " ")
    clock = "" if meta["clock"] == "wall" else f" on the {meta['clock']} clock"
    first = (
        f"{meta['protocol_summary']}: protocol {meta['protocol']} on rig {meta['rig']}, started by "
        f"{meta['operator']} on {started} UTC{clock}."
    )
    carried_out = steps_of(meta, steps)
    lasted = f" and {format_duration(found[-1].end)} of laboratory time" if found else ""
    if record.status == "unfinished":
        second = (
            "UNFINISHED: the run goes on, or its process died; this page has what was recorded until now, "
            f"{carried_out}{lasted}."
        )
    else:
        reason = f": {record.reason}" if record.reason else ""
        states = safe_state_text(record.safe_state)
        second = f"It ended as {record.status} after {carried_out}{lasted}{reason}. {states}"
    lead = [first, second]
    if remark := record.remark():
        lead.append(f"{remark[0].upper()}{remark[1:]}.")
    acted = [event for event in events if event.kind == "interlock"]
    warned = sum(event.level in ("WARN", "ERROR") for event in events)
    lead.append(
        f"{f'Interlocks acted {len(acted)} times' if acted else 'No interlock acted'}; "
        f"{warned or 'no'} warning{'' if warned == 1 else 's'} and errors among {counted(len(events), 'event')}."
    )
    for key, words in (("tracking", "brought to its targets"), ("following", "made to follow its reference")):
        if key in result:
            controlled = str(meta["controls"])
            lead.append(
                f"{controlled} was {words} with an error of {_errors_in_words(record, controlled, result[key])}."
            )
    for model in models:
        assert model.measured is not None
        errors = model.errors()
        display = _signal(record, model.measured.name).display
        lead.append(
            f"Model {model.file.name} is off by at most {display.text(errors.maximum)}, RMS "
            f"{display.text(errors.rms)} ({percent(errors.rms_percent)} of the range)."
        )
    notes = [event.text for event in events if event.kind == "note"]
    if notes:
        lead.append(f"Last note of the protocol: {notes[-1]}")
    return lead


def _errors_in_words(record: Record, controlled: str, errors: Mapping[str, float]) -> str:
    keys = [key for key in ("max", "rms", "median") if key in errors]
    display = _signal(record, controlled).display
    names = {"max": "at most", "rms": "RMS", "median": "median"}
    return ", ".join(f"{names[key]} {display.text(errors[key])}" for key in keys)


def _control_section(
    record: Record, result: Mapping[str, Any], stated: Sequence[Published], scratch: Path
) -> PageSection | None:
    controlled = str(record.meta.get("controls", ""))
    followed = _followed(record, controlled)
    if not controlled or not ("tracking" in result or followed is not None):
        return None
    display = _signal(record, controlled).display
    controller = str(record.meta["parameters"].get("controller", "output"))
    parts: list[PagePart] = []
    rows = []
    for key in ("tracking", "following"):
        for name, value in result.get(key, {}).items():
            if name == "seconds_per_target":
                rows.append((key, "time a target", f"{value:.1f}", "s"))
            else:
                number, _, shown = display.text(value).partition(" ")
                rows.append((key, f"error {name}", number, shown))
    if rows:
        parts.append(PageTable(("", "figure", "value", "unit"), rows, numbers_from=2))
    if (reached := target_results(record, controlled)) is not None:
        factor, shown = display.factor, display.unit
        path = scratch / "targets.svg"
        largest = next((float(each.value) / each.scale for each in stated if each.path == ("tracking", "max")), None)
        plot_tracking(
            path,
            factor * reached.targets,
            {controller: factor * reached.outputs},
            output_label=with_unit(controlled, shown),
            error_label=with_unit("error", shown),
            published=None if largest is None else {controller: factor * largest},
        )
        caption = f"Targets (marks) and what was reached (points) under {controller}; below, the errors."
        parts.append(PageFigure(inlined(path, caption), caption))
        parts.append(_targets_table(reached.targets, reached.outputs, reached.seconds, display))
    if followed is not None and "tracking" not in result:
        factor, shown = display.factor, display.unit
        path = scratch / "following.svg"
        plot_tracking(
            path,
            factor * followed.reference,
            {controller: factor * followed.output},
            horizontal=followed.times,
            horizontal_label="time / s",
            output_label=with_unit(controlled, shown),
            error_label=with_unit("error", shown),
        )
        caption = f"Reference (grey) and output under {controller}; below, the error."
        parts.append(PageFigure(inlined(path, caption), caption))
    return PageSection("Control", parts)


def _followed(record: Record, controlled: str) -> FollowingResult | None:
    """Return a moving reference and its output; of a protocol that marks none, whatever reference there was."""
    if (found := following_result(record, controlled)) is not None:
        return found
    ticks = ticks_with(record, "reference", ("t", controlled))
    if ticks is None or controlled not in ticks.columns:
        return None
    rows = np.isfinite(ticks[controlled])
    if rows.sum() < 2:
        return None
    times = ticks["t"][rows]
    return FollowingResult(times - times[0], ticks["reference"][rows], ticks[controlled][rows])


def _targets_table(targets: Floats, outputs: Floats, seconds: Floats, display: Display) -> PageTable:
    factor, shown = display.factor, display.unit
    rows = [
        (
            str(i),
            display.number(target),
            display.number(output),
            f"{factor * (output - target):+.3g}",
            f"{time:.1f}",
        )
        for i, (target, output, time) in enumerate(zip(targets, outputs, seconds, strict=True))
    ]
    heads = ("", with_unit("target", shown), with_unit("reached", shown), with_unit("error", shown), "time / s")
    return PageTable(heads, rows, title="targets", folded=True, numbers_from=1)


def _loops_section(
    record: Record, steps: Table, summary: TelemetrySummary, found: Sequence[Phase], scratch: Path
) -> PageSection | None:
    drawn = draw_loops(scratch, "svg", record, steps, summary, found)
    figures = [PageFigure(inlined(path, caption), caption) for path, caption in drawn]
    return PageSection("Loops", figures) if figures else None


def _signals_section(
    record: Record,
    steps: Table,
    summary: TelemetrySummary,
    extremes: Mapping[str, Mapping[str, Any]],
    found: Sequence[Phase],
    scratch: Path,
) -> PageSection:
    parts: list[PagePart] = [signals_table(record, extremes)]
    path = scratch / "signals.svg"
    if caption := draw_signals(path, record, steps, summary, found):
        parts.append(PageFigure(inlined(path, caption), caption))
    return PageSection("Signals", parts)


def _lateness_section(record: Record, scratch: Path) -> PageSection | None:
    parts: list[PagePart] = []
    for label, each in record.meta.get("lateness", {}).items():
        rate = f" at {each['rate']:g} Hz" if each["rate"] is not None else ""
        ends = [*(f"≤ {1e3 * edge:g}" for edge in each["edges"]), f"> {1e3 * each['edges'][-1]:g}"]
        title = f"{label or 'loop'}: {each['samples']} samples{rate}, {each['left_out']} left out"
        note = f"mean {1e3 * each['mean']:.3g} ms, worst {1e3 * each['worst']:.3g} ms"
        rows = [(end, str(count)) for end, count in zip(ends, each["counts"], strict=True) if count]
        parts.append(PageTable(("late by / ms", "samples"), rows, title=title, note=note, numbers_from=0))
    ticks = ticks_with(record, _LATENESS)
    if ticks is not None and len(ticks):
        late = ticks[_LATENESS]
        path = scratch / "lateness.svg"
        plot_histogram(path, 1e3 * late, label="lateness / ms")
        shares = np.percentile(late, [50, 95, 99, 100]) * 1e3
        names = ("median", "95 %", "99 %", "greatest")
        rows = [(name, f"{value:.3f}") for name, value in zip(names, shares.tolist(), strict=True)]
        caption = f"How late the {late.size} recorded samples of loops at a fixed rate were."
        parts.append(PageFigure(inlined(path, caption), caption))
        parts.append(PageTable(("lateness", "ms"), rows, numbers_from=1))
    return PageSection("Real time", parts) if parts else None


def _signal(record: Record, name: str) -> Signal:
    return next((signal for signal in record.signals if signal.name == name), Signal(name, "", name))
