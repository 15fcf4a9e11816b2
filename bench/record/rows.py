"""What a journal consists of: its tables and rows, and the checksum of a row."""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.devices import Settled

SCHEMA = 3
FILE_NAME = "journal.sqlite"
IDENTITY = "identity"
"""Key of the metadata: a random number that tells a journal from every other one."""
RECOVERED_NAME = "journal.recovered.sqlite"
"""The copy that `bench runs repair` writes."""


_TABLES = (
    "meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, checksum INTEGER NOT NULL) WITHOUT ROWID",
    "signals (position INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, unit TEXT NOT NULL, "
    "description TEXT NOT NULL, precision INTEGER NOT NULL, checksum INTEGER NOT NULL)",
    "steps (step INTEGER PRIMARY KEY, started REAL NOT NULL, finished REAL NOT NULL, phase TEXT NOT NULL, "
    "label TEXT NOT NULL, settled TEXT NOT NULL, setpoints TEXT NOT NULL{columns}, seen TEXT NOT NULL, "
    "checksum INTEGER NOT NULL)",
    "telemetry (tick INTEGER PRIMARY KEY, t REAL NOT NULL, step INTEGER NOT NULL{columns}, "
    "checksum INTEGER NOT NULL)",
    "events (event INTEGER PRIMARY KEY, t REAL NOT NULL, level TEXT NOT NULL, kind TEXT NOT NULL, "
    "text TEXT NOT NULL, checksum INTEGER NOT NULL)",
    "files (name TEXT PRIMARY KEY, sha256 TEXT NOT NULL, content BLOB NOT NULL)",
    "heading (line BLOB NOT NULL)",
)

TABLES = ("meta", "signals", "steps", "telemetry", "events", "files")

HEADING = ("meta", "signals")
"""Tables without which the others cannot be understood."""

FIRST = {"steps": 0, "telemetry": 1, "events": 1}
"""The tables whose rows are numbered without a gap, by their first column, and the first number of each."""

NUMBERS = {"steps": "step", "telemetry": "tick", "events": "event"}
"""The column of their numbers."""


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
    seen : tuple of float
        Times of the ticks that a controller was given, s; empty where none was at work reading by reading.
    """

    step: int
    started: float
    finished: float
    phase: str
    label: str
    settled: Settled
    setpoints: Mapping[str, float]
    values: tuple[float, ...]
    seen: tuple[float, ...] = ()


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
        `phase`, `note`, `pause`, `remark` (of the operator), `parameter` (a change), `off`, `resume`, `resumed` (by
        another process), `observer`, `notify`, `suspended`, `warning` (near an interlock), `interlock`,
        `error`, `safe-state`, `clock`, `end`.
    text : str
        One sentence.
    """

    t: float
    level: str
    kind: str
    text: str


def quoted(name: str) -> str:
    """Return a name as SQL has it."""
    return '"' + name.replace('"', '""') + '"'


def table_definitions(signals: Sequence[str]) -> tuple[str, ...]:
    """Return the statements that make the tables of a journal, with one column a signal."""
    columns = "".join(f", {quoted(name)} REAL" for name in signals)
    return tuple(f"CREATE TABLE {table.format(columns=columns)}" for table in _TABLES)


class Row(NamedTuple):
    """A row that is to be kept: its table, and its columns without the checksum."""

    table: str
    columns: tuple[Any, ...]

    @property
    def key(self) -> tuple[str, Any]:
        """What tells it from the other rows of a journal."""
        return self.table, self.columns[0]


def meta(entries: Mapping[str, object]) -> list[Row]:
    """Return entries of the metadata as rows."""
    texts = {key: json.dumps(value, ensure_ascii=False, default=str) for key, value in entries.items()}
    # Characters that no encoding holds, as in a file name of another system, become JSON escapes.
    return [Row("meta", (key, text.encode("utf-8", "backslashreplace").decode())) for key, text in texts.items()]


def sealed(table: str, rows: Sequence[tuple[Any, ...]]) -> Iterator[tuple[Any, ...]]:
    """Return rows of a table as they stand in it, each with its checksum."""
    if table == "files":
        return iter(rows)
    # By numpy, as a loop may leave a thousand ticks in a second.
    sums = checksums(np.array(rows, dtype=np.float64)) if table == "telemetry" else map(checksum, rows)
    return ((*row, found) for row, found in zip(rows, sums, strict=True))


def is_good(table: str, columns: Sequence[Any]) -> bool:
    """Return whether the checksum of a row fits, given as it stands in its table."""
    if table == "files":
        return isinstance(columns[2], bytes) and bool(hashlib.sha256(columns[2]).hexdigest() == columns[1])
    try:
        return bool(checksum(columns[:-1]) == columns[-1])
    except (ValueError, TypeError):
        return False


def checksum(row: Sequence[str | float | None]) -> int:
    """Return the CRC-32 of a row.

    It is that of its numbers in their order (little-endian doubles; NULL as the quiet nan of positive sign, without a
    sign of zero), then its texts in their order (UTF-8, each followed by a zero byte). Raises ValueError or TypeError
    if one of its values is neither number nor text.
    """
    numbers, texts = [], []
    for value in row:
        if isinstance(value, str):
            texts.append(value.encode() + b"\0")
        else:
            number = math.nan if value is None else value + 0.0
            numbers.append(number if number == number else math.nan)
    return zlib.crc32(b"".join((struct.pack(f"<{len(numbers)}d", *numbers), *texts)))


def checksums(numbers: npt.NDArray[np.float64]) -> list[int]:
    """Return the CRC-32 of each row of numbers, shape (rows, columns), as `checksum` does."""
    array = np.array(numbers, dtype="<f8")
    array += 0.0
    array[np.isnan(array)] = math.nan
    content = memoryview(array.tobytes())
    size = 8 * numbers.shape[1]
    return [zlib.crc32(content[start : start + size]) for start in range(0, len(content), size)]
