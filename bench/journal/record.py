"""Reads the journal of a run."""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from bench.devices import Signal
from bench.errors import DataError
from bench.journal.ending import ending_of
from bench.journal.finding import missing, way_back
from bench.journal.mirror import read_mirror, second_files
from bench.journal.models import models_beside
from bench.journal.opening import OpenedJournal
from bench.journal.rows import FILE_NAME, FIRST, SCHEMA, Event, StepRecord, checksum, checksums, quoted
from bench.journal.table import Table
from bench.locks import is_in_use
from bench.settling import Settled

_QUICKLY_CHECKED = 20_000
"""Ticks whose checksums are compared within some 50 ms."""

_FAILED = {each.value for each in Settled if each.failed}


class Record:
    """Reads the journal of a run, finished or not, without ever changing it.

    Every row is compared with its checksum when it is read; one that does not fit is a DataError which names it.

    Parameters
    ----------
    path : Path
        The journal, or the folder of the run that holds it.

    Raises
    ------
    DataError
        If there is no journal there, it is damaged, or its schema is of another version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path / FILE_NAME if path.is_dir() else path
        if not self.path.is_file():
            raise DataError(missing(path))
        self._opened = OpenedJournal(self.path)
        self._db = self._opened.db
        try:
            self._read_heading()
        except DataError:
            self.close()
            raise
        # A recovered copy beside the journal says for itself how far it is good.
        is_silent = "status" not in self.meta and self.path.name == FILE_NAME
        self._ending = ending_of(self.path.parent) if is_silent else None

    def remark(self) -> str:
        """Return what is unusual: how the journal is read, and how many rows only a second file has; else nothing."""
        return "; ".join(filter(None, (self._opened.remark, self._waiting())))

    def _waiting(self) -> str:
        if "status" in self.meta or is_in_use(self.path.parent):
            # A run that goes on has all its rows in the second file as well.
            return ""
        beside: dict[str, set[int]] = {table: set() for table in FIRST}
        for second in second_files(self.path):
            for entry in read_mirror(second):
                if entry.table in beside:
                    beside[entry.table].update(int(row[0]) for row in entry.rows)
        waiting = [
            f"{len(lacking)} of {table}"
            for table, numbers in beside.items()
            if (lacking := numbers - self.numbers(table))
        ]
        if not waiting:
            return ""
        return (
            f"{self.path} lacks rows that its second file has ({', '.join(waiting)}): bench recover-journal writes a "
            "journal with them, bench resume takes them in"
        )

    def _read_heading(self) -> None:
        try:
            meta = self._db.execute("SELECT * FROM meta").fetchall()
            self.meta: dict[str, Any] = {key: json.loads(value) for key, value, *_ in meta}
            signals = self._db.execute("SELECT * FROM signals ORDER BY position").fetchall()
            self.signals = tuple(Signal(*row[1:5]) for row in signals)
        except (sqlite3.DatabaseError, ValueError, TypeError) as error:
            raise DataError(f"{self.path} is not a readable journal: {error}{way_back(self.path)}") from error
        found = self.meta.get("schema")
        if found != SCHEMA:
            raise DataError(f"{self.path} has schema version {found}; this bench reads version {SCHEMA}")
        self._check("meta", meta)
        self._check("signals", signals)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def status(self) -> str:
        """`completed`, `aborted`, `failed`, or `unfinished` if the run goes on or its process died.

        A run whose bench hung or died is `failed` if its guardian has said so.
        """
        return str(self.meta.get("status", "unfinished" if self._ending is None else self._ending.status))

    @property
    def reason(self) -> str:
        """Why the run was not completed; empty if it was, or if nothing says it."""
        return str(self.meta.get("reason", "" if self._ending is None else self._ending.reason))

    @property
    def safe_state(self) -> Mapping[str, str]:
        """State of each device at the end: `safe`, or the fault; empty if it is not recorded."""
        found: Mapping[str, str] = self.meta.get(
            "safe_state", {} if self._ending is None else self._ending.safe_state
        )
        return found

    def unit(self, signal: str) -> str:
        """Return the unit of a column: a signal's own, s for times, 1 for counts."""
        others = "1" if signal in ("step", "tick", "settled") else "s"
        return next((s.unit for s in self.signals if s.name == signal), others)

    def steps(self) -> Table:
        """Return the readings: columns `step`, `started`, `finished`, `settled` (1 or 0), and one a signal."""
        rows = self._rows("steps")
        self._check("steps", rows)
        names = ("step", "started", "finished", "settled", *(signal.name for signal in self.signals))
        end = 7 + len(self.signals)
        return self._table("steps", names, [(*row[:3], row[5] not in _FAILED, *row[7:end]) for row in rows])

    def step_records(self, after: int = -1) -> Iterator[StepRecord]:
        """Yield the finished steps one by one, those with numbers beyond `after`."""
        rows = self._rows("steps", after)
        self._check("steps", rows)
        end = 7 + len(self.signals)
        for row in rows:
            step, started, finished, phase, label, settled, setpoints, *values = row[:end]
            try:
                record = StepRecord(
                    step,
                    started,
                    finished,
                    phase,
                    label,
                    Settled(settled),
                    json.loads(setpoints),
                    tuple(math.nan if value is None else float(value) for value in values),
                    tuple(map(float, json.loads(row[end]))),
                )
            except (ValueError, TypeError) as error:
                raise self._damaged(f"step {step}: {error}") from error
            yield record

    def newest_ticks(self, count: int) -> list[tuple[float, ...]]:
        """Return the newest ticks, oldest first, unchecked: laboratory time in s, and one value a signal."""
        columns = ", ".join(quoted(name) for name in ("t", *(signal.name for signal in self.signals)))
        rows = self._query(f"SELECT {columns} FROM telemetry ORDER BY tick DESC LIMIT {count:d}")  # noqa: S608 - own names
        return [tuple(math.nan if value is None else float(value) for value in row) for row in reversed(rows)]

    def telemetry(self, after: int = 0) -> Table:
        """Return the ticks, those with numbers beyond `after`: columns `t`, `step`, and one a signal."""
        names = ("tick", "t", "step", *(signal.name for signal in self.signals))
        rows = self._rows("telemetry", after)
        whole = self._table("telemetry", (*names, "checksum"), rows)
        if rows:
            numbers = np.column_stack([whole[name] for name in names])
            wrong = np.flatnonzero(np.array(checksums(numbers), dtype=np.float64) != whole["checksum"])
            if len(wrong):
                raise self._wrong_row("telemetry", rows[wrong[0]][0])
        return Table(
            {name: whole[name] for name in names if name != "tick"},
            {name: whole.units[name] for name in names if name != "tick"},
        )

    def numbers(self, table: str) -> set[int]:
        """Return the numbers of the rows of `steps`, `telemetry` or `events`, unchecked."""
        key = {"steps": "step", "telemetry": "tick", "events": "event"}[table]
        return {int(number) for (number,) in self._query(f"SELECT {key} FROM {table}")}  # noqa: S608 - own names

    def events(self, after: int = 0) -> list[Event]:
        """Return what happened, in its order, with numbers beyond `after`."""
        rows = self._rows("events", after)
        self._check("events", rows)
        return [Event(*row[1:5]) for row in rows]

    def files(self) -> dict[str, bytes]:
        """Return the content of every file that the run was given, by name."""
        result = {}
        for name, digest, content in self._query("SELECT name, sha256, content FROM files ORDER BY rowid"):
            if not isinstance(content, bytes) or hashlib.sha256(content).hexdigest() != digest:
                raise self._wrong_row("files", name)
            result[name] = content
        return result

    def models(self) -> dict[str, Any]:
        """Return the content of the model files that were identified from this run, by name, the newest last."""
        return models_beside(self.path.parent)

    def damage(self) -> str:
        """Return what is wrong with the rows, as far as that is quick to find; empty if that is nothing.

        Found are pages that SQLite cannot read, damaged rows of all tables but a long telemetry, and rows that a
        completed run lacks.
        """
        try:
            (found,) = self._query("PRAGMA quick_check(1)")[0]
            if found != "ok":
                return str(self._damaged(str(found).replace("\n", " ")))
            counts = {
                "steps": len(self.steps()),
                "telemetry": self._query("SELECT count(*) FROM telemetry")[0][0],
                "events": len(self.events()),
            }
            self.files()
            if counts["telemetry"] <= _QUICKLY_CHECKED:
                self.telemetry()
        except DataError as error:
            return str(error)
        if self.status == "completed":
            for table, count in self.meta.get("counts", {}).items():
                if counts.get(table, count) != count:
                    return str(self._damaged(f"table {table} has {counts[table]} rows of {count}"))
        return ""

    def close(self) -> None:
        """Close the file."""
        self._opened.close()

    def _rows(self, table: str, after: int = -1) -> list[tuple[Any, ...]]:
        # Columns by name, as only then a missing one is an error.
        leading = {
            "steps": ("step", "started", "finished", "phase", "label", "settled", "setpoints"),
            "telemetry": ("tick", "t", "step"),
            "events": ("event", "t", "level", "kind", "text"),
        }[table]
        signals = () if table == "events" else tuple(signal.name for signal in self.signals)
        seen = ("seen",) if table == "steps" else ()
        names = (*leading, *signals, *seen, "checksum")
        columns = ", ".join(map(quoted, names))
        # The rows are numbered by their first column, from 0 or 1.
        first = leading[0]
        return self._query(f"SELECT {columns} FROM {table} WHERE {first} > {after:d} ORDER BY 1")  # noqa: S608

    def _check(self, table: str, rows: Sequence[tuple[Any, ...]]) -> None:
        """Raise DataError for the first row that its checksum, the last column, does not fit."""
        for row in rows:
            try:
                fits = checksum(row[:-1]) == row[-1]
            except (ValueError, TypeError):
                fits = False
            if not fits:
                raise self._wrong_row(table, row[0])

    def _wrong_row(self, table: str, row: object) -> DataError:
        return self._damaged(f"table {table}, row {row}: its checksum does not fit")

    def _damaged(self, what: str) -> DataError:
        return DataError(f"{self.path} is damaged: {what}; `bench recover-journal {self.path}` says what is good")

    def _table(self, table: str, names: tuple[str, ...], rows: Sequence[tuple[Any, ...]]) -> Table:
        try:
            data = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
        except (ValueError, TypeError) as error:
            raise self._damaged(f"table {table}: {error}") from error
        values = {name: data[:, i].copy() for i, name in enumerate(names)}
        return Table(values, {name: self.unit(name) for name in names})

    def _query(self, statement: str) -> list[tuple[Any, ...]]:
        # All at once: damage may show at any row.
        try:
            return self._db.execute(statement).fetchall()
        except sqlite3.DatabaseError as error:
            raise self._damaged(str(error)) from error
