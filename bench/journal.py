"""The durable record of a run: one SQLite file, written before any observer is notified.

The file is in WAL mode with synchronous=FULL, and every telemetry tick, step and event is committed when
it is handed over; what `Journal` has returned from survives a crash of the process and of the machine.
Everything else (the .rrd, tables, figures) is derived from it and can be made again. When it is closed it
becomes one self-contained file, which can be read where nothing can be written.

Schema, version 2
-----------------
`meta(key, value)`
    Values are JSON. Keys: `schema`, `run` (identifier), `rig`, `rig_file` (its text), `rig_content` (with what it
    extends and the overrides), `overrides`, `protocol`, `parameters`, `slots` (device and signal by name), `seed`,
    `interlock_rate` (looks in a second beside the readings; null for none), `clock`, `epoch` (time of day at t =
    0), `devices` (identity by name), `limits` (set-points that each allows), `calibration`, `operator`, `command`, `packages` (versions), `git` (commit and
    whether it was clean), `host` (with the wall-clock time at the start), `controls` (the signal under control),
    `plan`, `dashboard`, and at the end `status` (`completed`, `aborted`, `failed`), `reason`, `finished`
    (laboratory s), `safe_state` (outcome by device). A file without `status` is of a run that is going on or whose
    process died.
`signals(position, name, unit, description, precision)`
    One row a signal column of the two tables below.
`steps(step, started, finished, phase, label, settled, setpoints, "<signal>", …)`
    One row a finished step; times are laboratory s; `settled` says how (`dwell`, `steady`, `arrived`,
    `controlled`; `not steady` or `not arrived` in the step that ended a run); `setpoints` is JSON by device; then
    one REAL column a signal, the reading. Version 1 has 1 for each `settled`.
`telemetry(tick, t, step, "<signal>", …)`
    One row a tick of a hold: quick readings.
`events(event, t, level, kind, text)`
    Phases, notes, pauses, suspensions of the machine, interlocks, errors, safe state, the factor that a paced clock
    reached; level is `INFO`, `WARN` or `ERROR`.
`models(name, t, model)`
    Model files (JSON) that were identified from this run.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from bench.clock import Stopwatch
from bench.devices import Signal
from bench.errors import ConfigurationError, DataError
from bench.settling import Settled
from bench.units import header_with_unit

SCHEMA = 2
_READABLE = (1, SCHEMA)
FILE_NAME = "journal.sqlite"
_ROWS_SHOWN = 5
"""Rows of a table at either end that its text shows."""

_SETTLED = "settled NOT IN ({})".format(", ".join(f"'{each}'" for each in Settled if each.failed))
"""Whether the settling rule was met, for SQL."""

_OWN_COLUMNS = ("step", "started", "finished", "phase", "label", "settled", "setpoints", "tick", "t")

_TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE signals (position INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, unit TEXT NOT NULL,
    description TEXT NOT NULL, precision INTEGER NOT NULL);
CREATE TABLE events (event INTEGER PRIMARY KEY, t REAL NOT NULL, level TEXT NOT NULL, kind TEXT NOT NULL,
    text TEXT NOT NULL);
CREATE TABLE models (name TEXT PRIMARY KEY, t REAL NOT NULL, model TEXT NOT NULL);
"""


@dataclass(frozen=True)
class StepRecord:
    """One finished step.

    Attributes
    ----------
    step : int
        Number within the run, from 0.
    started, finished : float
        Laboratory time, s.
    phase, label : str
        Where in the protocol.
    settled : Settled
        How it settled.
    setpoints : mapping of str to float
        What was sent, by device.
    values : tuple of float
        The reading, in the order of the journal's signals.
    """

    step: int
    started: float
    finished: float
    phase: str
    label: str
    settled: Settled
    setpoints: Mapping[str, float]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Event:
    """One thing that happened.

    Attributes
    ----------
    t : float
        Laboratory time, s.
    level : str
        `INFO`, `WARN` or `ERROR`.
    kind : str
        `phase`, `note`, `pause`, `resume`, `observer`, `suspended`, `interlock`, `error`, `safe-state`, `clock`,
        `end`.
    text : str
        One sentence.
    """

    t: float
    level: str
    kind: str
    text: str


_LONGEST_UNWRITTEN = 0.1
"""Wall-clock time after which a tick is committed, s."""


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

    Raises
    ------
    ConfigurationError
        If the file exists already: a record is never overwritten. If two signals have one name, or a signal
        has that of a column which the journal itself needs; case does not count.
    """

    def __init__(self, path: Path, signals: Sequence[Signal], meta: Mapping[str, Any]) -> None:
        if path.exists():
            raise ConfigurationError(f"{path} exists already; a record of a run is never overwritten")
        check_names([signal.name for signal in signals])
        self.path = path
        self.signals = tuple(signals)
        self._db = sqlite3.connect(path, isolation_level=None)
        self._db.execute("PRAGMA journal_mode=WAL")
        self._db.execute("PRAGMA synchronous=FULL")
        columns = "".join(f", {_quoted(signal.name)} REAL" for signal in self.signals)
        with self._transaction():
            for statement in _TABLES.split(";"):
                self._db.execute(statement)
            self._db.execute(
                "CREATE TABLE steps (step INTEGER PRIMARY KEY, started REAL NOT NULL, "
                "finished REAL NOT NULL, phase TEXT NOT NULL, label TEXT NOT NULL, "
                f"settled TEXT NOT NULL, setpoints TEXT NOT NULL{columns})"
            )
            self._db.execute(
                f"CREATE TABLE telemetry (tick INTEGER PRIMARY KEY, t REAL NOT NULL, step INTEGER NOT NULL{columns})"
            )
            self._db.executemany(
                "INSERT INTO signals VALUES (?, ?, ?, ?, ?)",
                [(i, s.name, s.unit, s.description, s.precision) for i, s in enumerate(self.signals)],
            )
            for key, value in {"schema": SCHEMA, **meta}.items():
                self._put_meta(key, value)
        made = path.stat()
        self._file = made.st_dev, made.st_ino
        marks = ", ?" * len(self.signals)
        self._waiting: list[tuple[float, ...]] = []
        self._since_write = Stopwatch()
        self._insert_step = f"INSERT INTO steps VALUES (?, ?, ?, ?, ?, ?, ?{marks})"  # noqa: S608 - marks only
        self._insert_tick = f"INSERT INTO telemetry VALUES (NULL, ?, ?{marks})"  # noqa: S608 - marks only

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Record one tick of a hold: laboratory time in s, step number, one value a signal.

        A tick that comes less than 0.1 s (wall clock) after the last write, as on the virtual clock, is written with
        the next tick, step or event.
        """
        self._waiting.append((t, step, *map(float, values)))
        if self._since_write.seconds() >= _LONGEST_UNWRITTEN:
            self._write_waiting()

    def step(self, record: StepRecord) -> None:
        """Record a finished step."""
        self._write(
            self._insert_step,
            (
                record.step,
                record.started,
                record.finished,
                record.phase,
                record.label,
                record.settled.value,
                json.dumps({name: float(value) for name, value in record.setpoints.items()}),
                *map(float, record.values),
            ),
        )

    def event(self, event: Event) -> None:
        """Record something that happened."""
        self._write("INSERT INTO events VALUES (NULL, ?, ?, ?, ?)", (event.t, event.level, event.kind, event.text))

    def finish(self, *, status: str, reason: str, finished: float, safe_state: Mapping[str, str]) -> None:
        """Record how the run ended: status, reason, laboratory time in s, safe state by device."""
        self._write_waiting()
        with self._transaction():
            self._put_meta("status", status)
            self._put_meta("reason", reason)
            self._put_meta("finished", finished)
            self._put_meta("safe_state", dict(safe_state))

    def close(self) -> None:
        """Close the file; what was recorded stays."""
        with suppress(sqlite3.OperationalError):
            self._write_waiting()
        # Out of WAL mode, as a reader of a WAL file leaves companions beside it; while one reads, it cannot be.
        with suppress(sqlite3.OperationalError):
            self._db.execute("PRAGMA busy_timeout=0")
            self._db.execute("PRAGMA journal_mode=DELETE")
        self._db.close()

    def _write(self, statement: str, values: Sequence[object]) -> None:
        """Commit one row, after the ticks that wait."""
        if not self._waiting:
            self._db.execute(statement, values)
        else:
            with self._transaction():
                self._db.executemany(self._insert_tick, self._waiting)
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
                self._db.executemany(self._insert_tick, self._waiting)
            self._waiting.clear()
        self._since_write = Stopwatch()

    def _put_meta(self, key: str, value: object) -> None:
        text = json.dumps(value, ensure_ascii=False, default=str)
        # Characters that no encoding holds, as in a file name of another system, become JSON escapes.
        text = text.encode("utf-8", "backslashreplace").decode("utf-8")
        self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, text))

    def _transaction(self) -> AbstractContextManager[None]:
        # Reuse an open transaction.
        return nullcontext() if self._db.in_transaction else _Transaction(self._db)


def abandon(path: Path, reason: str, safe_state: Mapping[str, str]) -> None:
    """Record the end of a run whose own thread hangs, if its file can be written within a second."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=1.0)) as db, db:
        for key, value in {"status": "aborted", "reason": reason, "safe_state": dict(safe_state)}.items():
            db.execute("INSERT OR IGNORE INTO meta VALUES (?, ?)", (key, json.dumps(value)))


class _Transaction:
    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def __enter__(self) -> None:
        self._db.execute("BEGIN IMMEDIATE")

    def __exit__(self, kind: object, *_: object) -> None:
        self._db.execute("COMMIT" if kind is None else "ROLLBACK")


@dataclass(frozen=True, repr=False)
class Table:
    """Columns of equal length.

    Attributes
    ----------
    columns : mapping of str to ndarray
        Float columns by signal or column name, shape (rows,).
    units : mapping of str to str
        Unit by the same names.
    """

    columns: Mapping[str, npt.NDArray[np.float64]]
    units: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> npt.NDArray[np.float64]:
        return self.columns[name]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def to_pandas(self) -> Any:  # noqa: ANN401 - pandas is optional
        """Return a pandas `DataFrame`, with the units in its `attrs`.

        Raises ConfigurationError if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise ConfigurationError("pandas is not installed; `pip install pandas`") from None
        frame = pd.DataFrame(dict(self.columns))
        frame.attrs["units"] = dict(self.units)
        return frame

    def __repr__(self) -> str:
        """Return size, column heads with units, and the first and last rows."""
        count = len(self)
        heads = [header_with_unit(name, self.units.get(name, "")) for name in self.columns]
        shown = list(range(count)) if count <= 2 * _ROWS_SHOWN else [*range(_ROWS_SHOWN), *range(-_ROWS_SHOWN, 0)]
        rows = [[f"{column[i]:.6g}" for column in self.columns.values()] for i in shown]
        if len(shown) < count:
            rows.insert(_ROWS_SHOWN, ["…"] * len(heads))
        widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
        lines = [
            "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in [heads, *rows]
        ]
        return "\n".join([*lines, f"{count} rows"])


class Record:
    """Reads the journal of a run, finished or not, without ever changing it.

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
            raise DataError(f"{path} is not a run: there is no {FILE_NAME}")
        # Reading a WAL file may need its companions; mode=ro keeps us from changing the record itself.
        try:
            self._db = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None)
        except sqlite3.DatabaseError as error:
            raise DataError(f"{self.path} cannot be read: {error}") from error
        try:
            self.meta: dict[str, Any] = {
                key: json.loads(value) for key, value in self._db.execute("SELECT key, value FROM meta")
            }
            rows = self._db.execute("SELECT name, unit, description, precision FROM signals ORDER BY position")
            self.signals = tuple(Signal(*row) for row in rows)
        except (sqlite3.DatabaseError, ValueError, TypeError) as error:
            self._db.close()
            raise DataError(f"{self.path} is not a readable journal: {error}") from error
        if self.meta.get("schema") not in _READABLE:
            self._db.close()
            raise DataError(
                f"{self.path} has schema version {self.meta.get('schema')}; this bench reads versions 1 and {SCHEMA}"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def status(self) -> str:
        """`completed`, `aborted`, `failed`, or `unfinished` if the run goes on or its process died."""
        return str(self.meta.get("status", "unfinished"))

    def unit(self, signal: str) -> str:
        """Return the unit of a column: a signal's own, s for times, 1 for counts."""
        others = "1" if signal in ("step", "tick", "settled") else "s"
        return next((s.unit for s in self.signals if s.name == signal), others)

    def steps(self) -> Table:
        """Return the readings: columns `step`, `started`, `finished`, `settled` (1 or 0), and one a signal."""
        return self._table("steps", ("step", "started", "finished", "settled"))

    def step_records(self) -> Iterator[StepRecord]:
        """Yield the finished steps one by one."""
        for row in self._query("SELECT * FROM steps ORDER BY step"):
            step, started, finished, phase, label, settled, setpoints, *values = row
            try:
                record = StepRecord(
                    step,
                    started,
                    finished,
                    phase,
                    label,
                    Settled.UNRECORDED if settled == 1 else Settled(settled),
                    json.loads(setpoints),
                    tuple(map(_number, values)),
                )
            except (ValueError, TypeError) as error:
                raise DataError(f"{self.path} is damaged: step {step}: {error}") from error
            yield record

    def telemetry(self) -> Table:
        """Return the ticks: columns `t`, `step`, and one a signal."""
        return self._table("telemetry", ("t", "step"))

    def events(self) -> list[Event]:
        """Return what happened, in its order."""
        return [Event(*row) for row in self._query("SELECT t, level, kind, text FROM events ORDER BY event")]

    def models(self) -> dict[str, Any]:
        """Return the content of the model files that were identified from this run, by name, the newest last."""
        rows = self._query("SELECT name, model FROM models ORDER BY rowid")
        try:
            return {name: json.loads(model) for name, model in rows}
        except (ValueError, TypeError) as error:
            raise DataError(f"{self.path} is damaged: {error}") from error

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def _table(self, table: str, leading: tuple[str, ...]) -> Table:
        names = leading + tuple(signal.name for signal in self.signals)
        columns = ", ".join(_SETTLED if name == "settled" else _quoted(name) for name in names)
        rows = self._query(f"SELECT {columns} FROM {table} ORDER BY 1")  # noqa: S608 - own names
        try:
            data = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
        except (ValueError, TypeError) as error:
            raise DataError(f"{self.path} is damaged: table {table}: {error}") from error
        values = {name: data[:, i].copy() for i, name in enumerate(names)}
        return Table(values, {name: self.unit(name) for name in names})

    def _query(self, statement: str) -> list[tuple[Any, ...]]:
        # All at once: damage may show at any row.
        try:
            return self._db.execute(statement).fetchall()
        except sqlite3.DatabaseError as error:
            raise DataError(f"{self.path} is damaged: {error}") from error


def add_model(path: Path, name: str, t: float, model: Mapping[str, Any]) -> None:
    """Keep a model with the run that it was identified from; one of the same name is replaced.

    Parameters
    ----------
    path : Path
        The journal, or the folder of the run.
    name : str
        Name of the model.
    t : float
        Laboratory time in s that its data reach to.
    model : mapping
        The model file's content.
    """
    file = path / FILE_NAME if path.is_dir() else path
    if not file.is_file():
        raise DataError(f"{path} is not a run: there is no {FILE_NAME}")
    db = sqlite3.connect(file, isolation_level=None)
    try:
        db.execute("INSERT OR REPLACE INTO models VALUES (?, ?, ?)", (name, t, json.dumps(model)))
    except sqlite3.DatabaseError as error:
        raise DataError(f"{file} is damaged: {error}") from error
    finally:
        db.close()


def run_card(meta: Mapping[str, Any]) -> str:
    """Return a run's metadata as a Markdown page, for the dashboard and the report."""
    lines = [
        f"# {meta['rig_title']}",
        "",
        f"**{meta['protocol']}** on **{meta['rig']}**: {meta['protocol_summary']}",
        "",
    ]
    lines += ["| | |", "|---|---|"]
    planned = meta["plan"]
    rows = {
        "run": meta["run"],
        "operator": meta["operator"],
        "started": f"{meta['epoch']} ({meta['clock']} clock)",
        "planned": f"{planned['steps']} steps, {planned['seconds'] / 3600:.2f} h",
        "seed": meta["seed"],
        **{f"device {name}": identity for name, identity in meta["devices"].items()},
        **{f"parameter {name}": value for name, value in meta["parameters"].items()},
        "git": meta["git"],
    }
    lines += [f"| {key} | {value} |" for key, value in rows.items()]
    return "\n".join(lines)


def check_names(names: Sequence[str]) -> None:
    """Check that signals can be columns of a journal.

    Raises ConfigurationError if two have one name, or one has that of a column which the journal itself needs; case
    does not count.
    """
    seen = dict.fromkeys(_OWN_COLUMNS, "is the name of a column of the journal")
    for name in names:
        if "\0" in name:
            raise ConfigurationError(f"signal {name!r}: a name may not have a null character")
        if (folded := name.lower()) in seen:
            raise ConfigurationError(f"signal {name!r}: {seen[folded]}; choose another")
        seen[folded] = "is the name of two signals (case does not count)"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)
