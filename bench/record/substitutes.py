"""What stands in a recovered journal in the place of metadata and signals that are lost, so that it can be read."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.record.rows import SCHEMA, JournalEntry, entry

UNKNOWN = "unknown"

_STAMP = re.compile(r"(\d{8}-\d{6})(-\d+)?$")
"""The end of the name of a run's folder: its start, in local time."""

_ENDS = ("completed", "aborted", "failed")

_BEHIND = {"steps": ("setpoints", "seen"), "telemetry": ("step", "checksum")}
"""The columns between which those of the signals stand."""


def signal_rows(db: sqlite3.Connection, found: Mapping[Any, JournalEntry]) -> dict[Any, JournalEntry]:
    """Return rows for the signals that are not found: by their names, which are columns of other tables.

    Unit and description are unknown.
    """
    for table, (before, behind) in _BEHIND.items():
        try:
            columns = [str(row[1]) for row in db.execute(f"PRAGMA table_info({table})")]
            names = columns[columns.index(before) + 1 : columns.index(behind)]
        except (sqlite3.DatabaseError, ValueError):
            continue
        return {i: each for i, each in _signals(names).items() if i not in found}
    return {}


def unnamed_signals(quantity: int) -> dict[Any, JournalEntry]:
    """Return rows for signals whose names are lost as well."""
    return _signals([f"signal_{i}" for i in range(quantity)])


def _signals(names: Sequence[str]) -> dict[Any, JournalEntry]:
    lost = f"{UNKNOWN}; its row in the record was lost"
    return {i: entry("signals", (i, name, "?", lost, 3)) for i, name in enumerate(names)}


def metadata(journal: Path, files: Mapping[Any, JournalEntry], events: Iterable[Sequence[Any]]) -> dict[str, Any]:
    """Return metadata of a run, as far as the other rows and the name of its folder tell; the rest says so.

    What it takes to repeat or to resume the run is not among them.
    """
    rig_file = ""
    with suppress(KeyError, UnicodeDecodeError):
        rig_file = files["rig.toml"].row[2].decode()
    started = _start(journal)
    found: dict[str, Any] = {
        "schema": SCHEMA,
        "run": journal.absolute().parent.name,
        "rig": UNKNOWN,
        "rig_title": "rig unknown",
        "rig_file": rig_file,
        "rig_content": {},
        "overrides": {},
        "protocol": UNKNOWN,
        "protocol_summary": "the metadata of the run were lost",
        "parameters": {},
        "changed": {},
        "slots": {},
        "seed": None,
        "interlock_rate": None,
        "clock": UNKNOWN,
        "epoch": started,
        "devices": {},
        "limits": {},
        "calibration": {},
        "operator": UNKNOWN,
        "command": [],
        "packages": {},
        "git": UNKNOWN,
        "host": {"name": UNKNOWN, "system": UNKNOWN, "python": UNKNOWN, "started": started},
        "controls": "",
        "plan": {"steps": 0, "seconds": 0.0, "at_most": None, "complete": False},
        "rehearsal": None,
        "dashboard": None,
        "over_time": [],
        "laboratory_epoch": None,
    }
    for _, t, _, kind, text in events:
        if kind == "end" and text in _ENDS:
            found |= {"status": text, "finished": t, "reason": "", "safe_state": {}}
    return found


def _start(journal: Path) -> str:
    """Return when a run began, by the name of its folder, which is in UTC, or else by its oldest file."""
    if stamp := _STAMP.search(journal.absolute().parent.name):
        with suppress(ValueError):
            return datetime.strptime(stamp[1], "%Y%m%d-%H%M%S").replace(tzinfo=UTC).isoformat()
    times = [file.stat().st_mtime for file in journal.absolute().parent.iterdir() if file.is_file()]
    return datetime.fromtimestamp(min(times, default=0.0), UTC).isoformat()
