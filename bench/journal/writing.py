"""Writes the journal of a run."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from bench.clock import Stopwatch
from bench.devices import Signal
from bench.errors import ConfigurationError, DataError
from bench.journal.record import Record
from bench.journal.rows import (
    FIRST,
    SCHEMA,
    Event,
    StepRecord,
    check_names,
    checksum,
    checksums,
    meta_row,
    table_definitions,
)

_LONGEST_UNWRITTEN = 0.1
"""Wall-clock time after which a tick is committed, s."""

_END = ("status", "reason", "finished", "safe_state", "counts")
"""Entries of the metadata that a run has once it has ended."""


class Journal:
    """Writes the record of one run.

    Parameters
    ----------
    path : Path
        File to create; its folder exists.
    signals : sequence of Signal
        What is measured, in the order in which values will be handed over.
    meta : mapping
        What is known at the start; values that JSON can hold.
    files : mapping of str to bytes
        Content of the files that the run was given, by name.

    Attributes
    ----------
    steps, ticks : int
        Number of rows that were handed over so far.

    Raises
    ------
    ConfigurationError
        If the file exists already: a record is never overwritten. If two signals have one name, or a signal
        has that of a column which the journal itself needs; case does not count.
    """

    def __init__(
        self,
        path: Path,
        signals: Sequence[Signal],
        meta: Mapping[str, Any],
        files: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        if path.exists():
            raise ConfigurationError(f"{path} exists already; a record of a run is never overwritten")
        check_names([signal.name for signal in signals])
        self._open(path, signals)
        with self._transaction():
            for statement in table_definitions([signal.name for signal in signals]):
                self._db.execute(statement)
            for position, signal in enumerate(signals):
                row = (position, signal.name, signal.unit, signal.description, signal.precision)
                self._db.execute("INSERT INTO signals VALUES (?, ?, ?, ?, ?, ?)", (*row, checksum(row)))
            for name, content in files.items():
                digest = hashlib.sha256(content).hexdigest()
                self._db.execute("INSERT INTO files VALUES (?, ?, ?)", (name, digest, content))
            for key, value in {"schema": SCHEMA, **meta}.items():
                self._put_meta(key, value)
        self._begin(dict(FIRST))

    @classmethod
    def reopen(cls, path: Path, meta: Mapping[str, Any] = MappingProxyType({})) -> Self:
        """Open the record of a run that was not completed to write on: steps, ticks and events are numbered on.

        Its end, if it had one, is taken back.

        Parameters
        ----------
        path : Path
            The journal, or the folder of the run that holds it.
        meta : mapping
            Further entries of the metadata.

        Raises
        ------
        DataError
            If there is none, it is damaged or of an older schema.
        ConfigurationError
            If the run was completed.
        """
        with Record(path) as record:
            file, signals = record.path, record.signals
            if record.meta["schema"] != SCHEMA:
                raise DataError(
                    f"{file} has schema version {record.meta['schema']}; only one of {SCHEMA} is written on"
                )
            if record.status == "completed":
                raise ConfigurationError(f"{file} is the record of a run that was completed")
            tables = {"steps": record.steps(), "telemetry": record.telemetry(), "events": record.events()}
            following = {table: FIRST[table] + len(rows) for table, rows in tables.items()}  # type: ignore[arg-type]
        journal = cls.__new__(cls)
        journal._open(file, signals)
        journal._begin(following)
        with journal._transaction():
            for key in _END:
                journal._db.execute("DELETE FROM meta WHERE key = ?", (key,))
            for key, value in meta.items():
                journal._put_meta(key, value)
        return journal

    def _open(self, path: Path, signals: Sequence[Signal]) -> None:
        self.path = path
        self.signals = tuple(signals)
        self._db = sqlite3.connect(path, isolation_level=None)
        self._db.execute("PRAGMA journal_mode=WAL")
        self._db.execute("PRAGMA synchronous=FULL")

    def _begin(self, following: dict[str, int]) -> None:
        """Take the next number of each table."""
        made = self.path.stat()
        self._file = made.st_dev, made.st_ino
        self._next = following
        marks = ", ?" * len(self.signals)
        self._waiting: list[tuple[float, ...]] = []
        self._since_write = Stopwatch()
        self._insert_step = f"INSERT INTO steps VALUES (?, ?, ?, ?, ?, ?, ?{marks}, ?, ?)"  # noqa: S608 - marks only
        self._insert_tick = f"INSERT INTO telemetry VALUES (?, ?, ?{marks}, ?)"  # noqa: S608 - marks only

    @property
    def steps(self) -> int:
        """Number of finished steps that were handed over."""
        return self._next["steps"] - FIRST["steps"]

    @property
    def ticks(self) -> int:
        """Number of ticks that were handed over."""
        return self._next["telemetry"] - FIRST["telemetry"]

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Record one tick of a hold: laboratory time in s, step number, one value a signal.

        A tick that comes less than 0.1 s (wall clock) after the last write, as on the virtual clock, is written with
        the next tick, step or event.
        """
        self._waiting.append((self._number("telemetry"), t, step, *map(float, values)))
        if self._since_write.seconds() >= _LONGEST_UNWRITTEN:
            self._write_waiting()

    def step(self, record: StepRecord) -> None:
        """Record a finished step."""
        self._next["steps"] = record.step + 1
        row = (
            record.step,
            record.started,
            record.finished,
            record.phase,
            record.label,
            record.settled.value,
            json.dumps({name: float(value) for name, value in record.setpoints.items()}),
            *map(float, record.values),
            json.dumps(record.seen),
        )
        self._write(self._insert_step, row)

    def event(self, event: Event) -> None:
        """Record something that happened."""
        row = (self._number("events"), event.t, event.level, event.kind, event.text)
        self._write("INSERT INTO events VALUES (?, ?, ?, ?, ?, ?)", row)

    def finish(self, *, status: str, reason: str, finished: float, safe_state: Mapping[str, str]) -> None:
        """Record how the run ended: status, reason, laboratory time in s, safe state by device."""
        self._write_waiting()
        with self._transaction():
            self._put_meta("status", status)
            self._put_meta("reason", reason)
            self._put_meta("finished", finished)
            self._put_meta("safe_state", dict(safe_state))
            self._put_meta("counts", {table: following - FIRST[table] for table, following in self._next.items()})

    def close(self) -> None:
        """Close the file; what was recorded stays."""
        with suppress(sqlite3.OperationalError):
            self._write_waiting()
        # Out of WAL mode, as a reader of a WAL file leaves companions beside it; while one reads, it cannot be.
        with suppress(sqlite3.OperationalError):
            self._db.execute("PRAGMA busy_timeout=0")
            self._db.execute("PRAGMA journal_mode=DELETE")
        self._db.close()

    def _number(self, table: str) -> int:
        number = self._next[table]
        self._next[table] = number + 1
        return number

    def _write(self, statement: str, row: Sequence[str | float]) -> None:
        """Commit one row, after the ticks that wait."""
        values = (*row, checksum(row))
        if not self._waiting:
            self._db.execute(statement, values)
        else:
            with self._transaction():
                self._insert_waiting()
                self._db.execute(statement, values)
            self._waiting.clear()
        self._since_write = Stopwatch()
        self._check_file()

    def _check_file(self) -> None:
        """Raise `DataError` if the file is no longer where it was made: SQLite goes on with one that is removed."""
        try:
            found = self.path.stat()
        except OSError:
            found = None
        if found is None or (found.st_dev, found.st_ino) != self._file:
            raise DataError(
                f"{self.path} was {'removed' if found is None else 'replaced'} while the run went on; what is "
                "recorded would be lost, so the run ends here"
            )

    def _write_waiting(self) -> None:
        if self._waiting:
            with self._transaction():
                self._insert_waiting()
            self._waiting.clear()
        self._since_write = Stopwatch()

    def _insert_waiting(self) -> None:
        sums = checksums(np.array(self._waiting, dtype=np.float64))
        self._db.executemany(self._insert_tick, [(*row, sum_) for row, sum_ in zip(self._waiting, sums, strict=True)])

    def _put_meta(self, key: str, value: object) -> None:
        row = meta_row(key, value)
        self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?, ?)", (*row, checksum(row)))

    def _transaction(self) -> AbstractContextManager[None]:
        # Reuse an open transaction.
        return nullcontext() if self._db.in_transaction else _Transaction(self._db)


def abandon(path: Path, reason: str, safe_state: Mapping[str, str]) -> None:
    """Record the end of a run whose own thread hangs, if its file can be written within a second."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=1.0)) as db, db:
        for key, value in {"status": "aborted", "reason": reason, "safe_state": dict(safe_state)}.items():
            row = meta_row(key, value)
            db.execute("INSERT OR IGNORE INTO meta VALUES (?, ?, ?)", (*row, checksum(row)))


class _Transaction:
    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def __enter__(self) -> None:
        self._db.execute("BEGIN IMMEDIATE")

    def __exit__(self, kind: object, *_: object) -> None:
        self._db.execute("COMMIT" if kind is None else "ROLLBACK")
