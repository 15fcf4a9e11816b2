"""What a journal consists of: its tables and rows, and the checksum of a row."""

from __future__ import annotations

import base64
import json
import math
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
"""The copy that `bench recover-journal` writes."""


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
)

TABLES = ("meta", "signals", "steps", "telemetry", "events", "files")

_PATTERNS = {
    "meta": "tt",
    "signals": "ntttn",
    "steps": "nnntttt",
    "telemetry": "nnn",
    "events": "nnttt",
    "files": "ttt",
}
"""The kinds of a row's columns, numbers or texts; one number a signal may follow, and then `_TEXTS_BEHIND`."""

_TEXTS_BEHIND = {"steps": 1}

TEXTS = {table: pattern.count("t") + _TEXTS_BEHIND.get(table, 0) for table, pattern in _PATTERNS.items()}
"""Quantity of texts in a row."""

_FEW_ROWS = 3
"""Rows for which numpy takes longer than it saves."""

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


def meta_row(key: str, value: object) -> tuple[str, str]:
    """Return an entry of the metadata as a row without its checksum."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    # Characters that no encoding holds, as in a file name of another system, become JSON escapes.
    return key, text.encode("utf-8", "backslashreplace").decode("utf-8")


def canonical(numbers: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return numbers as they come back from a journal: without a sign of zero, and one nan for all."""
    array = np.array(numbers, dtype="<f8")
    array += 0.0
    array[np.isnan(array)] = math.nan
    return array


class JournalEntry(NamedTuple):
    """Rows that are to be kept: one, or several of the telemetry.

    Attributes
    ----------
    table : str
        Their table.
    rows : sequence of tuple
        Their columns without the checksum.
    payload : bytes
        Row by row: its numbers in their order (little-endian doubles; NULL as the quiet nan of positive sign, without
        a sign of zero), then its texts in their order (UTF-8, each followed by a zero byte). Their CRC-32 is the
        row's checksum.
    """

    table: str
    rows: Sequence[tuple[Any, ...]]
    payload: bytes

    @property
    def row(self) -> tuple[Any, ...]:
        """The first row."""
        return self.rows[0]

    def columns(self) -> Sequence[tuple[Any, ...]]:
        """Return the rows as they stand in their table."""
        if self.table == "files":
            return self.rows
        content = memoryview(self.payload)
        size = len(content) // len(self.rows)
        return [(*row, zlib.crc32(content[size * i : size * (i + 1)])) for i, row in enumerate(self.rows)]


def entry(table: str, row: Sequence[Any]) -> JournalEntry:
    """Return a row as it is kept.

    Raises ValueError or TypeError if one of its values is neither a number nor a text, nor the content of a file.
    """
    numbers, texts = [], []
    for value in row:
        if isinstance(value, str):
            texts.append(value.encode())
        elif isinstance(value, bytes):
            texts.append(base64.b64encode(value))
        else:
            numbers.append(math.nan if value is None else value)
    return JournalEntry(table, (tuple(row),), b"".join((_packed(numbers), *(text + b"\0" for text in texts))))


def ticks(rows: Sequence[tuple[float, ...]]) -> JournalEntry:
    """Return rows of the telemetry as they are kept."""
    payload = b"".join(map(_packed, rows)) if len(rows) <= _FEW_ROWS else canonical(rows).tobytes()
    return JournalEntry("telemetry", rows, payload)


def split(entries: Iterable[JournalEntry]) -> Iterator[JournalEntry]:
    """Yield an entry a row."""
    for several in entries:
        size = len(several.payload) // len(several.rows)
        for i, row in enumerate(several.rows):
            yield JournalEntry(several.table, (row,), several.payload[size * i : size * (i + 1)])


def joined(entries: Iterable[JournalEntry]) -> list[JournalEntry]:
    """Return entries with neighbouring rows of the telemetry in one."""
    result: list[JournalEntry] = []
    for each in entries:
        if result and each.table == result[-1].table == "telemetry":
            former = result.pop()
            each = JournalEntry(each.table, [*former.rows, *each.rows], former.payload + each.payload)
        result.append(each)
    return result


def _packed(numbers: Sequence[float]) -> bytes:
    """Return numbers as `canonical` does, faster for one row."""
    numbers = [number + 0.0 for number in numbers]
    # With infinities the sum is nan as well.
    if (total := sum(numbers)) != total:
        numbers = [number if number == number else math.nan for number in numbers]
    return struct.pack(f"<{len(numbers)}d", *numbers)


def unpacked(table: str, count: int, payload: bytes) -> tuple[Any, ...] | None:
    """Return the row of a payload that begins with `count` numbers, or None if it is none of the table's."""
    if 8 * count > len(payload):
        return None
    numbers = list(np.frombuffer(payload, dtype="<f8", count=count).tolist())
    try:
        texts: list[Any] = payload[8 * count :].decode().split("\0")[:-1]
    except UnicodeDecodeError:
        return None
    if table == "files" and len(texts) == 3:
        texts[2] = base64.b64decode(texts[2])
    pattern = _PATTERNS[table]
    values = iter(numbers), iter(texts)
    if TEXTS[table] != len(texts) or pattern.count("n") > count:
        return None
    row = [next(values[kind == "t"]) for kind in pattern]
    return *row, *values[0], *values[1]


def checksum(row: Sequence[str | float | None]) -> int:
    """Return the CRC-32 of a row; raise ValueError or TypeError if it has neither number nor text."""
    return zlib.crc32(entry("", row).payload)


def checksums(numbers: npt.NDArray[np.float64]) -> list[int]:
    """Return the CRC-32 of each row of numbers, shape (rows, columns), as `checksum` does."""
    content = memoryview(canonical(numbers).tobytes())
    size = 8 * numbers.shape[1]
    return [zlib.crc32(content[start : start + size]) for start in range(0, len(content), size)]
