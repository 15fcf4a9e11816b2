"""What a journal consists of: its tables and rows, and the checksum of a row."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.errors import ConfigurationError
from bench.settling import Settled

SCHEMA = 3
READABLE = (1, 2, SCHEMA)
FILE_NAME = "journal.sqlite"

_OWN_COLUMNS = ("step", "started", "finished", "phase", "label", "settled", "setpoints", "tick", "t", "checksum")

_TABLES = (
    "meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, checksum INTEGER NOT NULL) WITHOUT ROWID",
    "signals (position INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, unit TEXT NOT NULL, "
    "description TEXT NOT NULL, precision INTEGER NOT NULL, checksum INTEGER NOT NULL)",
    "steps (step INTEGER PRIMARY KEY, started REAL NOT NULL, finished REAL NOT NULL, phase TEXT NOT NULL, "
    "label TEXT NOT NULL, settled TEXT NOT NULL, setpoints TEXT NOT NULL{columns}, checksum INTEGER NOT NULL)",
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
"""The kinds of a row's columns, numbers or texts; one number a signal may follow."""

FIRST = {"steps": 0, "telemetry": 1, "events": 1}
"""The tables whose rows are numbered without a gap, by their first column, and the first number of each."""


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


class Entry(NamedTuple):
    """A row that is to be kept.

    Attributes
    ----------
    table : str
        Its table.
    row : tuple
        Its columns without the checksum.
    payload : bytes
        Its numbers in their order (little-endian doubles; NULL as the quiet nan of positive sign, without a sign of
        zero), then its texts in their order (UTF-8, each followed by a zero byte). Its CRC-32 is the row's checksum.
    """

    table: str
    row: tuple[Any, ...]
    payload: bytes

    def columns(self) -> tuple[Any, ...]:
        """Return the row as it stands in its table."""
        return self.row if self.table == "files" else (*self.row, zlib.crc32(self.payload))


def entry(table: str, row: Sequence[Any]) -> Entry:
    """Return a row as it is kept.

    Raises ValueError or TypeError if one of its values is neither a number nor a text, nor the content of a file.
    """
    numbers = [math.nan if value is None else value for value in row if not isinstance(value, str | bytes)]
    texts = [
        base64.b64encode(value) if isinstance(value, bytes) else value.encode()
        for value in row
        if isinstance(value, str | bytes)
    ]
    return Entry(table, tuple(row), b"".join((canonical(numbers).tobytes(), *(text + b"\0" for text in texts))))


def ticks(rows: Sequence[tuple[float, ...]]) -> list[Entry]:
    """Return rows of numbers, all of the telemetry, as they are kept."""
    content = canonical(rows).tobytes()
    size = len(content) // len(rows)
    return [Entry("telemetry", row, content[size * i : size * (i + 1)]) for i, row in enumerate(rows)]


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
    if pattern.count("t") != len(texts) or pattern.count("n") > count:
        return None
    row = [next(values[kind == "t"]) for kind in pattern]
    return *row, *values[0]


def checksum(row: Sequence[str | float | None]) -> int:
    """Return the CRC-32 of a row, see `Entry`; raise ValueError or TypeError if it has neither number nor text."""
    return zlib.crc32(entry("", row).payload)


def checksums(numbers: npt.NDArray[np.float64]) -> list[int]:
    """Return the CRC-32 of each row of numbers, shape (rows, columns), as `checksum` does."""
    content = memoryview(canonical(numbers).tobytes())
    size = 8 * numbers.shape[1]
    return [zlib.crc32(content[start : start + size]) for start in range(0, len(content), size)]
