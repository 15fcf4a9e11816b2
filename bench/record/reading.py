"""Reads the journal of a run."""

from __future__ import annotations

import math
import sqlite3
import warnings
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from bench.base import DataError, IncompleteRecordWarning, parse_json
from bench.devices import RESERVED_NAMES, Settled, Signal
from bench.record.ending import ending_of
from bench.record.finding import missing, way_back
from bench.record.missing_rows import MissingRows, find_missing_rows
from bench.record.model_files import models_beside
from bench.record.opening import OpenedJournal
from bench.record.rows import FILE_NAME, IDENTITY, NUMBERS, SCHEMA, Event, StepRecord, checksums, is_good, quoted
from bench.record.store import damage_of
from bench.record.table import Table
from bench.rig import is_in_use

_QUICKLY_CHECKED = 20_000
"""Ticks whose checksums are compared within some 50 ms."""

_BLOCK = 8192
"""Rows that are read together; one takes some 1 kB until it is an array."""

_FAILED = {each.value for each in Settled if each.failed}


class Record:
    """Reads the journal of a run, finished or not, without ever changing it.

    Rows that wait in its second file are read with those of the journal, unless the run goes on.
    Every row is compared with its checksum when it is read; one that does not fit is a DataError which names it.

    Parameters
    ----------
    path : Path
        The journal, or the folder of the run that holds it.

    Attributes
    ----------
    missing : MissingRows
        Rows that were recorded and that the journal does not have; of a run that goes on it is not known.

    Raises
    ------
    DataError
        If there is no journal there, it is damaged, or its schema is of another version.

    Warns
    -----
    IncompleteRecordWarning
        If rows are missing, or are read from a second file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path / FILE_NAME if path.is_dir() else path
        if not self.path.is_file():
            raise DataError(missing(path))
        self._opened = OpenedJournal(self.path)
        self._db = self._opened.db
        with ExitStack() as failed:
            failed.callback(self.close)
            self._read_heading()
            goes_on = "status" not in self.meta and is_in_use(self.path.parent)
            self._waiting = "" if goes_on else self._take_in()
            self.missing = MissingRows(self.path) if goes_on else find_missing_rows(self._db, self.path, self.meta)
            for text in filter(None, (self._waiting, str(self.missing) if self.missing else "")):
                warnings.warn(text, IncompleteRecordWarning, stacklevel=2)
            failed.pop_all()
        # A recovered copy beside the journal says for itself how far it is good.
        is_silent = "status" not in self.meta and self.path.name == FILE_NAME
        ending = ending_of(self.path.parent) if is_silent else None
        self._end: Mapping[str, Any] = self.meta if ending is None else {**asdict(ending), **self.meta}

    @property
    def identity(self) -> str:
        """Random number of the journal, which its second files have as well; empty if it has none."""
        return str(self.meta.get(IDENTITY, ""))

    @property
    def controlled(self) -> str:
        """The signal that the run controlled; empty if there was none."""
        return str(self.meta.get("controls", ""))

    def remark(self) -> str:
        """Return what is unusual: how the journal is read, and which rows are missing; else nothing."""
        missing = str(self.missing) if self.missing else ""
        return "; ".join(filter(None, (self._opened.remark, self._waiting, missing)))

    def _take_in(self) -> str:
        """Have the rows of its second file read as well; return what is to be said of it."""
        try:
            said = self._opened.take_in(self.identity)
        except sqlite3.Error as error:
            raise self._damaged(f"its second file does not fit: {error}") from error
        self._db = self._opened.db
        if said:
            self._read_heading()
        return said

    def _read_heading(self) -> None:
        try:
            meta = self._db.execute("SELECT * FROM meta").fetchall()
            self.meta: dict[str, Any] = {key: parse_json(value) for key, value, *_ in meta}
            signals = self._db.execute("SELECT * FROM signals ORDER BY position").fetchall()
            extents = self.meta.get("extents", {})
            self.signals = tuple(
                Signal(row[1], row[2], row[3], row[4], extent=extents.get(row[1])) for row in signals
            )
        except (sqlite3.DatabaseError, ValueError, TypeError) as error:
            raise DataError(f"{self.path} is not a readable journal: {error}{way_back(self.path)}") from error
        found = self.meta.get("schema")
        if found != SCHEMA:
            raise DataError(f"{self.path} has schema version {found}; this bench reads version {SCHEMA}")
        self._check("meta", meta)
        self._check("signals", signals)
        self._check_signals()

    def _check_signals(self) -> None:
        """Raise DataError if a column of the steps is of a signal that is not among the signals."""
        known = {*RESERVED_NAMES, *(signal.name for signal in self.signals)}
        columns = [str(row[1]) for row in self._query("PRAGMA table_info(steps)")]
        if lost := [name for name in columns if name not in known]:
            raise self._damaged(f"table signals has no row of {lost[0]}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def status(self) -> str:
        """`completed`, `aborted`, `failed`, or `unfinished` if the run goes on or its process died.

        A run whose bench hung or died is `failed` if its guardian has said so.
        """
        return str(self._end.get("status", "unfinished"))

    @property
    def reason(self) -> str:
        """Why the run was not completed; empty if it was, or if nothing says it."""
        return str(self._end.get("reason", ""))

    @property
    def safe_state(self) -> Mapping[str, str]:
        """State of each device at the end: `safe`, or the fault; empty if it is not recorded."""
        found: Mapping[str, str] = self._end.get("safe_state", {})
        return found

    def unit(self, signal: str) -> str:
        """Return the unit of a column: a signal's own, s for times, 1 for counts."""
        others = "1" if signal in ("step", "tick", "settled") else "s"
        return next((s.unit for s in self.signals if s.name == signal), others)

    def steps(self) -> Table:
        """Return the readings: columns `step`, `started`, `finished`, `settled` (1 or 0), and one a signal."""
        names = ("step", "started", "finished", "settled", *(signal.name for signal in self.signals))
        end = 7 + len(self.signals)
        return self._joined(
            names,
            (
                self._table(
                    names, self._numbers("steps", [(*row[:3], row[5] not in _FAILED, *row[7:end]) for row in rows])
                )
                for rows in self._checked("steps")
            ),
        )

    def step_records(self, after: int = -1) -> Iterator[StepRecord]:
        """Yield the finished steps one by one, those with numbers beyond `after`."""
        end = 7 + len(self.signals)
        for row in chain.from_iterable(self._checked("steps", after)):
            step, started, finished, phase, label, settled, setpoints, *values = row[:end]
            try:
                record = StepRecord(
                    step,
                    started,
                    finished,
                    phase,
                    label,
                    Settled(settled),
                    parse_json(setpoints),
                    tuple(math.nan if value is None else float(value) for value in values),
                    tuple(map(float, parse_json(row[end]))),
                )
            except (ValueError, TypeError) as error:
                raise self._damaged(f"step {step}: {error}") from error
            yield record

    def places(self, first: int, last: int) -> dict[int, tuple[str, str]]:
        """Return phase and label of the finished steps from number `first` to `last`, unchecked."""
        rows = self._query(f"SELECT step, phase, label FROM steps WHERE step BETWEEN {first:d} AND {last:d}")  # noqa: S608
        return {step: (phase, label) for step, phase, label in rows}

    def newest_ticks(self, count: int) -> list[tuple[float, ...]]:
        """Return the newest ticks, oldest first, unchecked: laboratory time in s, and one value a signal."""
        columns = ", ".join(quoted(name) for name in ("t", *(signal.name for signal in self.signals)))
        rows = self._query(f"SELECT {columns} FROM telemetry ORDER BY tick DESC LIMIT {count:d}")  # noqa: S608 - own names
        return [tuple(math.nan if value is None else float(value) for value in row) for row in reversed(rows)]

    def telemetry(self, after: int = 0, names: Collection[str] | None = None) -> Table:
        """Return the ticks, those with numbers beyond `after`: columns `t`, `step`, and one a signal.

        With `names` only these columns are kept, so that a long run takes no more memory than they do.
        """
        columns = ("t", "step", *(signal.name for signal in self.signals))
        kept = [name for name in columns if names is None or name in names]
        return self._joined(kept, self.ticks(after))

    def ticks(self, after: int = 0) -> Iterator[Table]:
        """Yield the ticks with numbers beyond `after` in blocks, columns as `telemetry`; of none no block."""
        names = ("t", "step", *(signal.name for signal in self.signals))
        for rows in self._blocks("telemetry", after):
            numbers = self._numbers("telemetry", rows)
            wrong = np.flatnonzero(np.array(checksums(numbers[:, :-1]), dtype=np.float64) != numbers[:, -1])
            if len(wrong):
                raise self._wrong_row("telemetry", rows[wrong[0]][0])
            # The tick comes first, the checksum last.
            yield self._table(names, numbers[:, 1:-1])

    def count(self, table: str) -> int:
        """Return how many rows `steps`, `telemetry` or `events` have."""
        return int(self._query(f"SELECT count(*) FROM {table}")[0][0])  # noqa: S608 - own names

    def numbers(self, table: str) -> set[int]:
        """Return the numbers of the rows of `steps`, `telemetry` or `events`, unchecked."""
        return {int(number) for (number,) in self._query(f"SELECT {NUMBERS[table]} FROM {table}")}  # noqa: S608

    def events(self, after: int = 0) -> list[Event]:
        """Return what happened, in its order, with numbers beyond `after`."""
        return list(self.each_event(after))

    def each_event(self, after: int = 0) -> Iterator[Event]:
        """Yield what `events` returns, one by one."""
        return (Event(*row[1:5]) for row in chain.from_iterable(self._checked("events", after)))

    def files(self) -> dict[str, bytes]:
        """Return the content of every file that the run was given, by name."""
        result = {}
        for row in self._query("SELECT name, sha256, content FROM files ORDER BY rowid"):
            self._check("files", [row])
            result[row[0]] = row[2]
        return result

    def models(self) -> dict[str, Any]:
        """Return the content of the model files that were identified from this run, by name, the newest last."""
        return models_beside(self.path.parent)

    def damage(self) -> str:
        """Return what is wrong with the rows, as far as that is quick to find; empty if that is nothing.

        Found are pages that SQLite cannot read, damaged rows of all tables but a long telemetry, and rows that are
        missing in a run that was completed or whose process died.
        """
        try:
            if found := damage_of(self._db):
                return str(self._damaged(found))
            for table in ("steps", "events"):
                deque(self._checked(table), maxlen=0)
            self.files()
            if self.count("telemetry") <= _QUICKLY_CHECKED:
                deque(self.ticks(), maxlen=0)
        except DataError as error:
            return str(error)
        return str(self.missing) if self.missing and self.status in ("completed", "unfinished") else ""

    def close(self) -> None:
        """Close the file."""
        self._opened.close()

    def _blocks(self, table: str, after: int = -1) -> Iterator[list[tuple[Any, ...]]]:
        """Yield the rows with numbers beyond `after` in blocks."""
        # Columns by name, as only then a missing one is an error.
        leading = {
            "steps": ("started", "finished", "phase", "label", "settled", "setpoints"),
            "telemetry": ("t", "step"),
            "events": ("t", "level", "kind", "text"),
        }[table]
        signals = () if table == "events" else tuple(signal.name for signal in self.signals)
        seen = ("seen",) if table == "steps" else ()
        # The rows are numbered by their first column, from 0 or 1.
        number = NUMBERS[table]
        columns = ", ".join(map(quoted, (number, *leading, *signals, *seen, "checksum")))
        statement = f"SELECT {columns} FROM {table} WHERE {number} > {after:d} ORDER BY 1"  # noqa: S608 - own names
        try:
            cursor = self._db.execute(statement)
            while rows := cursor.fetchmany(_BLOCK):
                yield rows
        except sqlite3.DatabaseError as error:
            raise self._damaged(str(error)) from error

    def _checked(self, table: str, after: int = -1) -> Iterator[list[tuple[Any, ...]]]:
        """Yield what `_blocks` does, each row compared with its checksum."""
        for rows in self._blocks(table, after):
            self._check(table, rows)
            yield rows

    def _check(self, table: str, rows: Sequence[tuple[Any, ...]]) -> None:
        """Raise DataError for the first row that its checksum, the last column, does not fit."""
        for row in rows:
            if not is_good(table, row):
                raise self._wrong_row(table, row[0])

    def _wrong_row(self, table: str, row: object) -> DataError:
        return self._damaged(f"table {table}, row {row}: its checksum does not fit")

    def _damaged(self, what: str) -> DataError:
        return DataError(f"{self.path} is damaged: {what}; `bench runs repair {self.path}` says what is good")

    def _numbers(self, table: str, rows: Sequence[tuple[Any, ...]]) -> npt.NDArray[np.float64]:
        try:
            return np.array(rows, dtype=np.float64)
        except (ValueError, TypeError) as error:
            raise self._damaged(f"table {table}: {error}") from error

    def _table(self, names: Sequence[str], numbers: npt.NDArray[np.float64]) -> Table:
        columns = {name: column.copy() for name, column in zip(names, numbers.T, strict=True)}
        return Table(columns, {name: self.unit(name) for name in names})

    def _joined(self, names: Sequence[str], blocks: Iterable[Table]) -> Table:
        """Return blocks as one table; a column at a time is copied, so that no more than one is held twice."""
        parts: dict[str, list[npt.NDArray[np.float64]]] = {name: [] for name in names}
        for block in blocks:
            for name, several in parts.items():
                several.append(block[name])
        units = {name: self.unit(name) for name in names}
        columns = {name: np.concatenate([*parts.pop(name), np.empty(0)]) for name in names}
        return Table(columns, units)

    def _query(self, statement: str) -> list[tuple[Any, ...]]:
        # All at once: damage may show at any row.
        try:
            return self._db.execute(statement).fetchall()
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            raise self._damaged(str(error)) from error
