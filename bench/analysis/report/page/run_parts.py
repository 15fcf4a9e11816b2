"""The parts of a run's page that come from its record: parameters, phases, signals, interlocks, devices, events."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from bench.analysis.report.page.elements import PageSection, PageTable, PageText
from bench.analysis.report.published import Published
from bench.analysis.report.run_figures import Phase
from bench.analysis.report.telemetry_summary import TelemetrySummary, wider
from bench.base import BenchError, Display, format_duration
from bench.protocol import ParameterHelp, find_protocol
from bench.record import Event, Record, Table
from bench.rig import SETPOINT, Interlock, RoleTable

_MOST_EVENTS = 1000
"""Events that a page lists; a record of a long run may have more."""
_IDENTITY_OF_LINES = ("port", "baudrate", "timeout", "address")
_NOT_SHOWN = ("format", "version", "date")
"""Keys of a calibration that say nothing more."""


def phases_section(found: Sequence[Phase]) -> PageSection:
    """Return the table of phases with their durations."""
    rows = [
        (each.name, format_duration(each.start), format_duration(each.end - each.start), str(each.steps))
        for each in found
    ]
    return PageSection(
        "Phases", (PageTable(("phase", "from / h:mm:ss", "duration / h:mm:ss", "steps"), rows, numbers_from=1),)
    )


def parameters_section(meta: Mapping[str, Any]) -> PageSection:
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
    parts: list[PageTable | PageText] = [
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
    return PageSection("Parameters", parts)


def _parameter_help(meta: Mapping[str, Any]) -> Mapping[str, ParameterHelp]:
    # A protocol of a file of somebody's own may be gone, and tables of another version not fit.
    with suppress(BenchError, ValidationError, AttributeError):
        roles = {
            name: RoleTable.model_validate(table)
            for name, table in (meta.get("rig_content") or {}).get("roles", {}).items()
        }
        return {each.name: each for each in find_protocol(meta["protocol"]).help(roles)}
    return {}


def devices_section(meta: Mapping[str, Any]) -> PageSection:
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
    return PageSection(
        "Devices and calibration",
        (
            PageTable(heads, rows),
            PageTable(
                ("device", "setting", "value"), settings, title="settings and calibration constants", folded=True
            ),
        ),
    )


def _day_of(meta: Mapping[str, Any]) -> date | None:
    started = (meta.get("host") or {}).get("started", "")
    try:
        return datetime.fromisoformat(started).date()
    except ValueError:
        return None


def signals_table(record: Record, extremes: Mapping[str, Mapping[str, Any]]) -> PageTable:
    """Return the extremes of every signal, with the least margin to what limits it."""
    rows = []
    bounds = _bounds(record)
    for signal in record.signals:
        entry = extremes[signal.name]
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


def interlocks_of(record: Record) -> list[Interlock]:
    """Return the interlocks that watched a run; none where the record does not say."""
    found = []
    for table in (record.meta.get("rig_content") or {}).get("interlocks", ()):
        with suppress(ValidationError):
            found.append(Interlock.model_validate(table))
    return found


def _bounds(record: Record) -> dict[str, list[tuple[float, float]]]:
    bounds: dict[str, list[tuple[float, float]]] = {}
    for name, (low, high) in record.meta.get("limits", {}).items():
        bounds.setdefault(f"{name}{SETPOINT}", []).append((float(low), float(high)))
    for each in interlocks_of(record):
        if not each.minus:
            bounds.setdefault(each.signal, []).append((each.low, each.high))
    return bounds


def _margin(extremes: Mapping[str, Any], bounds: Sequence[tuple[float, float]]) -> float | None:
    if extremes["low"] is None:
        return None
    margins = [min(extremes["low"] - low, high - extremes["high"]) for low, high in bounds]
    least = min(margins, default=math.inf)
    return least if math.isfinite(least) else None


def interlocks_section(
    record: Record,
    steps: Table,
    summary: TelemetrySummary,
    extremes: Mapping[str, Mapping[str, Any]],
    events: Sequence[Event],
) -> PageSection:
    """Return each interlock with what it allows, what was seen, the margin, and how often it acted."""
    rows = []
    displays = {signal.name: signal.display for signal in record.signals}
    for each in interlocks_of(record):
        if each.signal not in extremes:
            continue
        shown = displays[each.signal]
        seen = extremes[each.signal] if not each.minus else _difference(steps, summary, each.signal, each.minus)
        margin = _margin(seen, [(each.low, each.high)])
        acted = [event for event in events if event.kind == "interlock" and event.text.startswith(each.label)]
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
    parts: list[PageTable | PageText] = []
    if rows:
        heads = ("watched", "allowed", "seen", "least margin", "then", "acted")
        parts.append(PageTable(heads, rows))
    else:
        parts.append(PageText("The record names no interlocks."))
    rate = record.meta.get("interlock_rate")
    beside = f"{rate:g} looks in a second beside the readings" if rate else "looked at with every reading"
    parts.append(PageText(f"Interlocks were {beside}."))
    return PageSection("Interlocks and margins", parts)


def _between(low: float | None, high: float | None, shown: Display) -> str:
    if low is None or high is None:
        return "–"
    return f"{shown.number(low)} to {shown.number(high)} {shown.unit}".rstrip()


def watched_pairs(record: Record) -> list[tuple[str, str]]:
    """Return the signals of a run whose differences an interlock watched."""
    names = {signal.name for signal in record.signals}
    return [(each.signal, each.minus) for each in interlocks_of(record) if {each.signal, each.minus} <= names]


def _difference(steps: Table, summary: TelemetrySummary, signal: str, minus: str) -> dict[str, Any]:
    low = high = None
    if (signal, minus) in summary.differences:
        low, high = wider(summary.differences[signal, minus], steps[signal] - steps[minus])
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


def events_section(events: Sequence[Event]) -> PageSection:
    """Return what happened, in its order."""
    rows = [(format_duration(each.t), each.level, each.kind, each.text) for each in events[:_MOST_EVENTS]]
    note = f"The record has {len(events) - _MOST_EVENTS} more." if len(events) > _MOST_EVENTS else ""
    return PageSection("Events", (PageTable(("t / h:mm:ss", "level", "kind", "what happened"), rows, note=note),))


def requests_section(events: Sequence[Event]) -> PageSection | None:
    """Return how the devices on shared lines were asked, and what had to be repeated; None if nothing is known."""
    rows = [
        (device, what)
        for each in events
        if each.kind == "requests"
        for device, _, what in [each.text.partition(": ")]
    ]
    return PageSection("Requests", (PageTable(("device", "requests"), rows),)) if rows else None


def published_section(published: Sequence[Published], result: Mapping[str, Any]) -> PageSection | None:
    """Return what papers state beside the same of the run; None if the run has nothing of it."""
    rows = []
    measured = [each.measured(result) for each in published]
    if all(ours is None for ours in measured):
        return None
    for each, ours in zip(published, measured, strict=True):
        rows.append((each.quantity, each.value, "–" if ours is None else f"{ours:.4g}", each.unit, each.source))
    return PageSection("Numbers of the paper", (PageTable(("", "paper", "this run", "unit", "source"), rows),))


def repeat_section(record: Record) -> PageSection:
    """Return the commands that carry the run out again, and with what it was carried out."""
    meta = record.meta
    folder = record.path.parent
    parts: list[PageTable | PageText] = [
        PageText("From the record alone, on the same rig:"),
        PageText(shlex.join(["bench", "run", "--from", str(folder)]), is_command=True),
    ]
    if command := meta.get("command"):
        words = [Path(command[0]).name, *command[1:]]
        parts += [PageText("The run was started by:"), PageText(shlex.join(map(str, words)), is_command=True)]
    host = meta.get("host") or {}
    rows = [
        ("run", meta["run"]),
        ("journal", str(record.path)),
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
    return PageSection("How to repeat it", parts)


def safe_state_text(states: Mapping[str, str]) -> str:
    """Return a sentence about the safe state at the end."""
    wrong = {name: state for name, state in states.items() if state != "safe"}
    if not states:
        return "The record does not say whether the safe state was reached."
    if wrong:
        return "NOT in the safe state: " + "; ".join(f"{name}: {state}" for name, state in wrong.items()) + "."
    return f"{'All ' if len(states) > 1 else 'The '}{_count(len(states), 'device')} confirmed the safe state."


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


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
