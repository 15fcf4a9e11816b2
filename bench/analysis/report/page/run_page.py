"""The page of one run, for a log book: all that its record says, in words, tables and figures."""

from __future__ import annotations

import math
import shlex
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import date, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from bench.analysis.applied_figures import errors_text
from bench.analysis.figures.panels import plot_histogram
from bench.analysis.figures.targets import plot_tracking
from bench.analysis.report.page.model_parts import given_parts, models_parts
from bench.analysis.report.page.pages import Page, PagePart, PageSection, PageTable, PageText, inlined
from bench.analysis.report.published import Published
from bench.analysis.report.recorded_run import RecordedRun, wider
from bench.analysis.report.run_figures import draw_loops, draw_signals
from bench.analysis.report.uncertainty_tables import uncertainty_parts
from bench.analysis.tracking_errors import FollowingResult, following_result, target_results, ticks_with
from bench.base import BenchError, Display, Floats, counted, format_duration, with_unit
from bench.protocol import LATENESS, ParameterHelp, find_protocol
from bench.record import Event, bins_of, headline_of, interlocks_of, steps_of
from bench.rig import SETPOINT, Interlock, RoleTable

_STYLES = {"completed": "good", "unfinished": "open"}
_MOST_EVENTS = 1000
"""Events that a page lists; a record of a long run may have more."""
_IDENTITY_OF_LINES = ("port", "baudrate", "timeout", "address")
_NOT_SHOWN = ("format", "version", "date")
"""Keys of a calibration that say nothing more."""


def run_page(run: RecordedRun, published: Sequence[Published] = ()) -> Page:
    """Return the page of a run; of one that has not ended what there is, marked as unfinished.

    Of the numbers of papers those are shown that concern the run.
    """
    meta, record = run.meta, run.record
    stated = [each for each in published if each.concerns(meta)]
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        models, times = run.applied, run.steps["finished"]
        sections: dict[str, Sequence[PagePart]] = {
            "Control": [*_control(run, stated, scratch)],
            "Uncertainty": uncertainty_parts(run.uncertainty),
            **(
                {"Loops and models": models_parts(models, times, scratch)}
                if models
                else {"Loops": [inlined(path, caption) for path, caption in draw_loops(scratch, "svg", run)]}
            ),
            "Numbers of the paper": _published(stated, run.result),
            "Models that the run was given": given_parts(run.given, scratch),
            "Phases": _phases(run),
            "Signals": [*_signals(run, scratch)],
            "Interlocks and margins": _interlocks(run),
            "Parameters": _parameters(meta),
            "Devices and calibration": _devices(meta),
            "Real time": [*_lateness(run, scratch)],
            "Requests": _requests(run.events),
            "Events": _events(run.events),
            "How to repeat it": _repeat(run),
        }
    return Page(
        title=str(meta["rig_title"]),
        subtitle=f"{meta['protocol']}, {meta['run']}",
        badge=record.status,
        badge_style=_STYLES.get(record.status, "bad"),
        lead=_lead(run),
        sections=[PageSection(title, parts) for title, parts in sections.items() if parts],
    )


def _lead(run: RecordedRun) -> list[str]:
    record, meta, events = run.record, run.meta, run.events
    host = meta.get("host") or {}
    started = str(host.get("started") or meta["epoch"])[:16].replace("T", " ")
    clock = "" if meta["clock"] == "wall" else f" on the {meta['clock']} clock"
    first = (
        f"{meta['protocol_summary']}: protocol {meta['protocol']} on rig {meta['rig']}, started by "
        f"{meta['operator']} on {started} UTC{clock}."
    )
    carried_out = steps_of(meta, len(run.steps))
    lasted = f" and {format_duration(run.phases[-1].end)} of laboratory time" if run.phases else ""
    if record.status == "unfinished":
        second = (
            "UNFINISHED: the run goes on, or its process died; this page has what was recorded until now, "
            f"{carried_out}{lasted}."
        )
    else:
        reason = f": {record.reason}" if record.reason else ""
        states = _safe_state_text(record.safe_state)
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
    lead += [f"Control of {record.controlled}, {line}." for line in run.control_lines()]
    for model in run.applied:
        lead.append(f"Errors of the model {model.file.name}: {errors_text(model.errors(), model.unit)}.")
    notes = [event.text for event in events if event.kind == "note"]
    if notes:
        lead.append(f"Last note of the protocol: {notes[-1]}")
    return lead


def _control(run: RecordedRun, stated: Sequence[Published], scratch: Path) -> Iterator[PagePart]:
    record, controlled, result = run.record, run.record.controlled, run.control
    followed = _followed(run) if controlled else None
    if followed is None and "tracking" not in result:
        return
    display = run.signal(controlled).display
    factor, shown = display.factor, display.unit
    controller = str(run.meta["parameters"].get("controller", "output"))
    plot = partial(plot_tracking, output_label=with_unit(controlled, shown), error_label=with_unit("error", shown))
    if (reached := target_results(record, controlled)) is not None:
        path = scratch / "targets.svg"
        largest = next((float(each.value) / each.scale for each in stated if each.path == ("tracking", "max")), None)
        plot(
            path,
            factor * reached.targets,
            {controller: factor * reached.outputs},
            published=None if largest is None else {controller: factor * largest},
        )
        yield inlined(path, f"Targets (marks) and what was reached (points) under {controller}; below, the errors.")
        yield _targets_table(reached.targets, reached.outputs, reached.seconds, display)
    if followed is not None and "tracking" not in result:
        path = scratch / "following.svg"
        plot(
            path,
            factor * followed.reference,
            {controller: factor * followed.output},
            horizontal=followed.times,
            horizontal_label="time / s",
        )
        yield inlined(path, f"Reference (grey) and output under {controller}; below, the error.")


def _followed(run: RecordedRun) -> FollowingResult | None:
    """Return a moving reference and its output; of a protocol that marks none, whatever reference there was."""
    record, controlled = run.record, run.record.controlled
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


def _signals(run: RecordedRun, scratch: Path) -> Iterator[PagePart]:
    yield signals_table(run)
    path = scratch / "signals.svg"
    if caption := draw_signals(path, run):
        yield inlined(path, caption)


def _lateness(run: RecordedRun, scratch: Path) -> Iterator[PagePart]:
    for label, each in run.meta.get("lateness", {}).items():
        rows = [(name, str(count)) for name, count in bins_of(each) if count]
        yield PageTable(("late by", "samples"), rows, title=headline_of(label, each), numbers_from=0)
    ticks = ticks_with(run.record, LATENESS.name)
    if ticks is not None and len(ticks):
        late = ticks[LATENESS.name]
        path = scratch / "lateness.svg"
        plot_histogram(path, 1e3 * late, label="lateness / ms")
        shares = np.percentile(late, [50, 95, 99, 100]) * 1e3
        names = ("median", "95 %", "99 %", "greatest")
        yield inlined(path, f"How late the {late.size} recorded samples of loops at a fixed rate were.")
        rows = [(name, f"{value:.3f}") for name, value in zip(names, shares.tolist(), strict=True)]
        yield PageTable(("lateness", "ms"), rows, numbers_from=1)


def _phases(run: RecordedRun) -> list[PagePart]:
    rows = [
        (each.name, format_duration(each.start), format_duration(each.end - each.start), str(each.steps))
        for each in run.phases
    ]
    return [PageTable(("phase", "from / h:mm:ss", "duration / h:mm:ss", "steps"), rows, numbers_from=1)]


def _parameters(meta: Mapping[str, Any]) -> list[PagePart]:
    """Return the parameters with units, what they are, and whether they differ from their defaults."""
    known = _parameter_help(meta)
    changed = meta.get("changed", {})
    rows = []
    for name, value in meta["parameters"].items():
        if name in meta.get("without_slot", ()):
            continue
        about = known.get(name)
        unit = about.unit if about is not None and about.unit not in ("1",) else ""
        rows.append((name, _plain(value), unit, "set" if name in changed else "", about.text if about else ""))
    parts: list[PagePart] = [
        PageTable(("parameter", "value", "unit", "", "what it is"), rows)
        if rows
        else PageText("The protocol has no parameters.")
    ]
    if slots := meta.get("slots"):
        cells = [(name, entry["device"] or "–", entry["signal"] or "–") for name, entry in slots.items()]
        parts.append(PageTable(("slot", "device", "signal"), cells, title="bound slots"))
    if overrides := meta.get("overrides"):
        replaced = [(name, _plain(value)) for name, value in overrides.items()]
        parts.append(PageTable(("key", "value"), replaced, title="replaced values of the rig file"))
    return parts


def _parameter_help(meta: Mapping[str, Any]) -> Mapping[str, ParameterHelp]:
    # A protocol of a file of somebody's own may be gone, and tables of another version not fit.
    with suppress(BenchError, ValidationError, AttributeError):
        roles = {
            name: RoleTable.model_validate(table)
            for name, table in (meta.get("rig_content") or {}).get("roles", {}).items()
        }
        return {each.name: each for each in find_protocol(meta["protocol"]).help(roles)}
    return {}


def _devices(meta: Mapping[str, Any]) -> list[PagePart]:
    """Return instruments, limits and calibration; a calibration that was overdue in the run is marked."""
    day = _day_of(meta)
    rows, settings = [], []
    limits = meta.get("limits", {})
    for name, entry in meta.get("calibration", {}).items():
        own = {key: value for key, value in entry.items() if value is not None}
        calibrated, due = own.pop("calibrated", ""), own.pop("calibration_due", "")
        if isinstance(applied := own.pop("calibration", None), dict):
            calibrated = applied["date"]
            due = (date.fromisoformat(calibrated) + timedelta(days=applied["interval_days"])).isoformat()
            own |= {key: value for key, value in applied.items() if key not in _NOT_SHOWN}
        if due and day is not None and date.fromisoformat(due) <= day:
            due = f"{due}: overdue"
        low_high = limits.get(name)
        identity = meta["devices"].get(name, f"derived: {own.get('kind', '')}".rstrip(": "))
        between = "" if low_high is None else f"{low_high[0]:g} to {low_high[1]:g}"
        rows.append((name, identity, between, calibrated or "not stated", due or "not stated"))
        for key, value in own.items():
            if key not in _IDENTITY_OF_LINES:
                settings.append((name, key, _plain(value)))
    for name, identity in meta["devices"].items():
        if name not in meta.get("calibration", {}):
            rows.append((name, identity, "", "not stated", "not stated"))
    heads = ("device", "instrument", "set-points", "calibrated", "due")
    title = "settings and calibration constants"
    return [
        PageTable(heads, rows),
        PageTable(("device", "setting", "value"), settings, title=title, folded=True),
    ]


def _day_of(meta: Mapping[str, Any]) -> date | None:
    started = (meta.get("host") or {}).get("started", "")
    try:
        return datetime.fromisoformat(started).date()
    except ValueError:
        return None


def signals_table(run: RecordedRun) -> PageTable:
    """Return the extremes of every signal, with the least margin to what limits it."""
    rows = []
    bounds = _bounds(run)
    for signal in run.record.signals:
        entry = run.extremes[signal.name]
        if entry["low"] is None:
            continue
        shown = signal.display
        margin = _margin(entry, bounds.get(signal.name, ()))
        numbers = [shown.number(entry[end]) for end in ("low", "high")]
        rows.append((signal.name, *numbers, shown.unit, "–" if margin is None else shown.text(margin)))
    return PageTable(
        ("signal", "lowest", "highest", "unit", "least margin"),
        rows,
        title="signals, readings and telemetry",
        note="The margin is the distance to the nearest limit of the device or interlock.",
        numbers_from=1,
    )


def _bounds(run: RecordedRun) -> dict[str, list[tuple[float, float]]]:
    bounds: dict[str, list[tuple[float, float]]] = {}
    for name, (low, high) in run.meta.get("limits", {}).items():
        bounds.setdefault(f"{name}{SETPOINT}", []).append((float(low), float(high)))
    for each in interlocks_of(run.meta):
        if not each.minus:
            bounds.setdefault(each.signal, []).append((each.low, each.high))
    return bounds


def _margin(extremes: Mapping[str, Any], bounds: Sequence[tuple[float, float]]) -> float | None:
    if extremes["low"] is None:
        return None
    margins = [min(extremes["low"] - low, high - extremes["high"]) for low, high in bounds]
    least = min(margins, default=math.inf)
    return least if math.isfinite(least) else None


def _interlocks(run: RecordedRun) -> list[PagePart]:
    """Return each interlock with what it allows, what was seen, the margin, and how often it acted."""
    rows = []
    for each in interlocks_of(run.meta):
        if each.signal not in run.extremes:
            continue
        shown = run.signal(each.signal).display
        seen = run.extremes[each.signal] if not each.minus else _difference(run, each.signal, each.minus)
        margin = _margin(seen, [(each.low, each.high)])
        acted = [event for event in run.events if event.kind == "interlock" and event.text.startswith(each.label)]
        rows.append(
            (
                each.label,
                _allowed(each, shown),
                _between(seen["low"], seen["high"], shown),
                "–" if margin is None else shown.text(margin),
                each.level.value,
                str(len(acted)) if acted else "no",
            )
        )
    parts: list[PagePart] = []
    if rows:
        heads = ("watched", "allowed", "seen", "least margin", "then", "acted")
        parts.append(PageTable(heads, rows))
    else:
        parts.append(PageText("The record names no interlocks."))
    rate = run.meta.get("interlock_rate")
    beside = f"{rate:g} looks in a second beside the readings" if rate else "looked at with every reading"
    parts.append(PageText(f"Interlocks were {beside}."))
    return parts


def _between(low: float | None, high: float | None, shown: Display) -> str:
    if low is None or high is None:
        return "–"
    return f"{shown.number(low)} to {shown.number(high)} {shown.unit}".rstrip()


def _difference(run: RecordedRun, signal: str, minus: str) -> dict[str, Any]:
    low = high = None
    if (found := run.summary.differences.get((signal, minus))) is not None:
        low, high = wider(found, run.steps[signal] - run.steps[minus])
    return {"low": low, "high": high}


def _allowed(interlock: Interlock, display: Display) -> str:
    shown, factor, found = f" {display.unit}" if display.unit else "", display.factor, []
    if math.isfinite(interlock.low) or math.isfinite(interlock.high):
        found.append(display.between(interlock.low, interlock.high))
    if interlock.fastest is not None:
        found.append(f"at most {factor * interlock.fastest:g}{shown}/s over {interlock.over:g} s")
    if interlock.stale is not None:
        found.append(f"equal readings for {interlock.stale:g} s at most")
    if (stuck := interlock.stuck) is not None:
        found.append(f"follows {interlock.setpoint}: {stuck.follows:g} for {stuck.moved:g} within {stuck.within:g} s")
    return "; ".join(found) + (f", for {interlock.seconds:g} s" if interlock.seconds else "")


def _events(events: Sequence[Event]) -> list[PagePart]:
    rows = [(format_duration(each.t), each.level, each.kind, each.text) for each in events[:_MOST_EVENTS]]
    note = f"The record has {len(events) - _MOST_EVENTS} more." if len(events) > _MOST_EVENTS else ""
    return [PageTable(("t / h:mm:ss", "level", "kind", "what happened"), rows, note=note)]


def _requests(events: Sequence[Event]) -> list[PagePart]:
    """Return how the devices on shared lines were asked, and what had to be repeated."""
    rows = [
        (device, what)
        for each in events
        if each.kind == "requests"
        for device, _, what in [each.text.partition(": ")]
    ]
    return [PageTable(("device", "requests"), rows)] if rows else []


def _published(published: Sequence[Published], result: Mapping[str, Any]) -> list[PagePart]:
    """Return what papers state beside the same of the run, if the run has any of it."""
    measured = [each.measured(result) for each in published]
    if all(ours is None for ours in measured):
        return []
    rows = [
        (each.quantity, each.value, "–" if ours is None else f"{ours:.4g}", each.unit, each.source)
        for each, ours in zip(published, measured, strict=True)
    ]
    return [PageTable(("", "paper", "this run", "unit", "source"), rows)]


def _repeat(run: RecordedRun) -> list[PagePart]:
    """Return the commands that carry the run out again, and with what it was carried out."""
    meta, path = run.meta, run.record.path
    parts: list[PagePart] = [
        PageText("From the record alone, on the same rig:"),
        PageText(shlex.join(["bench", "run", "--from", str(path.parent)]), is_command=True),
    ]
    if command := meta.get("command"):
        words = [Path(command[0]).name, *command[1:]]
        parts += [PageText("The run was started by:"), PageText(shlex.join(map(str, words)), is_command=True)]
    host = meta.get("host") or {}
    rows = [
        ("run", meta["run"]),
        ("journal", str(path)),
        ("operator", meta["operator"]),
        ("seed", _plain(meta["seed"])),
        ("clock", f"{meta['clock']}, laboratory time 0 is {meta['epoch']}"),
        ("commit", meta["git"]),
        ("computer", ", ".join(str(host[key]) for key in ("name", "system") if host.get(key))),
        ("Python", str(host.get("python", ""))),
        *meta.get("packages", {}).items(),
        *((f"repeats {key}", _plain(value)) for key, value in (meta.get("repeats") or {}).items()),
    ]
    parts.append(PageTable(("", ""), [row for row in rows if row[1]], title="made with"))
    return parts


def _safe_state_text(states: Mapping[str, str]) -> str:
    """Return a sentence about the safe state at the end."""
    wrong = {name: state for name, state in states.items() if state != "safe"}
    if not states:
        return "The record does not say whether the safe state was reached."
    if wrong:
        return "NOT in the safe state: " + "; ".join(f"{name}: {state}" for name, state in wrong.items()) + "."
    return f"{'All ' if len(states) > 1 else 'The '}{counted(len(states), 'device')} confirmed the safe state."


def _plain(value: Any) -> str:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    if isinstance(value, dict):
        return ", ".join(f"{key} = {_plain(each)}" for key, each in value.items())
    return str(value)
