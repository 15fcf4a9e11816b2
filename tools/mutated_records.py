"""Mutated records: what is read of a journal is what was recorded, or it is said what is missing."""

import functools
import json
import random
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

from commands import call
from mutations import STRANGE, mutated_bytes

from bench.base import DataError
from bench.devices import Settled, Signal
from bench.record import FILE_NAME, NAME as SECOND_NAME, RECOVERED_NAME, Event, Journal, Record, StepRecord, Table

SIGNALS = (Signal("u", "V", "input", 3), Signal("y", "m", "output", 6))
STEPS = 40
META = {
    "run": "r", "rig": "bench", "rig_title": "", "rig_file": "", "rig_content": {}, "protocol": "stairs",
    "protocol_summary": "", "parameters": {}, "slots": {}, "epoch": "2026-01-05T10:00:00+00:00", "devices": {},
    "limits": {}, "clock": "virtual", "seed": 0, "host": {}, "packages": {}, "git": None, "operator": "",
    "plan": None,
}  # fmt: skip

Rows = dict[str, list[Any]]


@functools.cache
def records() -> tuple[Path, Path]:
    """Return the folders of a record that was closed, and of one whose process died while rows waited."""
    folders = tuple(Path(tempfile.mkdtemp(prefix="mutated-record-")) for _ in range(2))
    for folder, is_closed in zip(folders, (True, False), strict=True):
        place = folder / "written"
        place.mkdir()
        journal = Journal(place / FILE_NAME, SIGNALS, META, {"a.txt": b"content"}, flushed=False)
        other = sqlite3.connect(place / FILE_NAME, isolation_level=None)
        for i in range(STEPS):
            if i == STEPS - 5 and not is_closed:
                other.execute("BEGIN IMMEDIATE")
            for k in range(5):
                journal.telemetry(i + 0.1 * k, i, (0.5 * i, 1e-6 * k + i))
            journal.step(StepRecord(i, i, i + 0.5, "up", "", Settled.DWELL, {"d": 0.5 * i}, (0.5 * i, 1e-6 * i)))
            journal.event(Event(i + 0.5, "INFO", "note", f"step {i}"))
        if is_closed:
            journal.finish(status="completed", reason="", finished=40.0, safe_state={"d": "safe"})
            journal.close()
        for path in place.iterdir():
            shutil.copy(path, folder)
        other.close()
        journal.close()
        shutil.rmtree(place)
    return folders[0], folders[1]


def rows_of(path: Path) -> Rows:
    """Return the rows of a record by the reader of the bench; raise DataError if one is damaged."""
    with Record(path) as record:
        steps, telemetry = record.steps(), record.telemetry()
        return {
            "steps": _listed(steps),
            "telemetry": _listed(telemetry),
            "events": [(event.t, event.kind, event.text) for event in record.events()],
        }


def _listed(table: Table) -> list[list[float]]:
    return [list(map(float, row)) for row in zip(*(table[name] for name in table.columns), strict=True)]


@functools.cache
def reference() -> Rows:
    """Return what was recorded."""
    return rows_of(records()[0])


def try_journal(folder: Path, rng: random.Random) -> str:
    """Read and recover a mutated record."""
    is_closed = rng.random() < 0.5
    run = folder / "run"
    shutil.copytree(records()[not is_closed], run)
    journal = run / FILE_NAME
    kind = rng.randrange(6)
    if kind == 0:
        _change_rows(journal, rng)
    elif kind == 1 and (second := run / SECOND_NAME).exists():
        second.write_bytes(mutated_bytes(second.read_bytes(), rng))
        if rng.random() < 0.5:
            journal.unlink()
            for companion in run.glob("journal.sqlite-*"):
                companion.unlink()
    elif kind == 2 and (log := run / f"{FILE_NAME}-wal").exists():
        log.write_bytes(mutated_bytes(log.read_bytes(), rng))
    elif kind == 3:
        (run / "guardian.jsonl").write_bytes(
            mutated_bytes(
                b'{"what": "begin", "at": "x"}\n{"what": "failed", "reason": "r", "safe": {"d": "safe"}}\n', rng
            )
        )
    else:
        journal.write_bytes(mutated_bytes(journal.read_bytes(), rng))
    call("runs", folder)
    wrong = _read_wrongly(run, "reading")
    result = folder / "result.json"
    recovered = call("runs", "repair", run, "--json", result)
    if wrong or not result.exists():
        return wrong
    return _recovered_wrongly(run, json.loads(result.read_text(encoding="utf-8")), recovered.code)


def _change_rows(journal: Path, rng: random.Random) -> None:
    with closing(sqlite3.connect(journal)) as db:
        table, key = rng.choice((("steps", "step"), ("telemetry", "tick"), ("events", "event")))
        number = rng.randrange(1, STEPS)
        if rng.random() < 0.4:
            db.execute(f"DELETE FROM {table} WHERE {key} = {number}")
        else:
            column = {"steps": "y", "telemetry": "u", "events": "text"}[table]
            value = rng.choice((1.0, -1, None, "text", b"bytes", 1e308, float("inf"), 10**18, *STRANGE))
            try:
                db.execute(f"UPDATE {table} SET {column} = ? WHERE {key} = {number}", (value,))
            except (sqlite3.IntegrityError, OverflowError):
                return
        db.commit()


def _read_wrongly(run: Path, what: str) -> str:
    """Return how what the bench reads differs from what was recorded without a word; empty if it does not."""
    try:
        with Record(run) as record:
            remark, is_over = record.remark(), record.status == "completed"
        read = rows_of(run)
    except DataError:
        return ""
    for table, rows in read.items():
        if lost := _foreign(rows, reference()[table]):
            return f"{what}: {table} has {lost}, which was not recorded"
        if len(rows) < len(reference()[table]) and is_over and not remark:
            return f"{what}: {table} has {len(rows)} rows of {len(reference()[table])}, and nothing says so"
    return ""


def _foreign(rows: Iterable[Any], recorded: list[Any]) -> Any:
    """Return a row that was not recorded, or comes out of order; None if there is none."""
    rest = iter(recorded)
    return next((row for row in rows if not any(row == other for other in rest)), None)


def _recovered_wrongly(run: Path, said: dict[str, Any], code: int) -> str:
    copy = run / RECOVERED_NAME
    is_missing = any(table["missing"] for table in said["tables"].values())
    if is_missing and code == 0:
        return "rows are missing, and the exit code is 0"
    if not copy.exists():
        return ""
    try:
        read = rows_of(copy)
    except DataError as error:
        return f"the recovered copy cannot be read: {error}"
    for table, rows in read.items():
        if lost := _foreign(rows, reference()[table]):
            return f"recovered: {table} has {lost}, which was not recorded"
        state = said["tables"][table]
        if state["good"] + state["added"] != len(rows):
            return f"recovered: {table} has {len(rows)} rows, {state} are said"
    return ""


KINDS = {"journal": try_journal}
