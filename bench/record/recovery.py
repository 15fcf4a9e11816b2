"""Says how far a journal is good, and puts together what there is of it."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from bench.base import ConfigurationError, DataError, parse_json
from bench.record.finding import missing
from bench.record.mirror import NAME as MIRROR_NAME, read_mirror, readable_second_files
from bench.record.missing_rows import Range, joined_ranges
from bench.record.opening import OpenedJournal
from bench.record.rows import (
    FILE_NAME,
    FIRST,
    IDENTITY,
    NUMBERS,
    RECOVERED_NAME,
    SCHEMA,
    TABLES,
    JournalEntry,
    canonical,
    checksums,
    entry,
    meta_row,
)
from bench.record.store import Store
from bench.record.substitutes import metadata, signal_rows, unnamed_signals
from bench.record.write_ahead_log import log_damage

_SMALL = tuple(table for table in TABLES if table not in FIRST)
"""Tables that are held as a whole; the others may have millions of rows."""
_KEYS = {"meta": "key", "signals": "position", "files": "rowid", **NUMBERS}
_BESIDE_SIGNALS = {"steps": 8, "telemetry": 3, "events": 5}
"""Columns of a row, without its checksum, that are no signals."""
_BLOCK = 4096
"""Rows that are read together."""


@dataclass(frozen=True)
class TableState:
    """How much there is of a table.

    Attributes
    ----------
    good : int
        Rows of the journal whose checksums fit.
    added : int
        Rows that only a second file has.
    missing : int
        Rows that are nowhere; where not all of them can be known, those that are, 1 at least.
    first_bad : str
        First row that is damaged or missing in the journal; empty if all are good.
    """

    good: int
    added: int
    missing: int
    first_bad: str


@dataclass(frozen=True)
class Recovery:
    """What is left of a journal.

    Attributes
    ----------
    journal : Path
        The journal.
    status : str
        How its run ended, in the copy if one was written; `unfinished` if that is not known.
    problem : str
        What SQLite says of the file; empty if nothing.
    tables : mapping of str to TableState
        By table.
    second_files : tuple of Path
        Second files that were found.
    copy : Path or None
        Repaired copy that was written, if any was needed.
    """

    journal: Path
    status: str
    problem: str
    tables: Mapping[str, TableState]
    second_files: tuple[Path, ...]
    copy: Path | None

    @property
    def is_complete(self) -> bool:
        """Whether no row is lost."""
        return not any(table.missing for table in self.tables.values())


def recover(path: Path, others: Sequence[Path] = (), out: Path | None = None) -> Recovery:
    """Find out how far a journal is good, and write a repaired copy if it is not; the journal itself stays.

    Parameters
    ----------
    path : Path
        The journal, or the folder of the run.
    others : sequence of Path
        Second files, beside those that are where the journal left them.
    out : Path or None
        The copy; `journal.recovered.sqlite` beside the journal if None.

    Raises
    ------
    DataError
        If it is no journal, its schema is of another version, or nothing of it is readable.
    ConfigurationError
        If the copy exists already or cannot be written, or there is no second file that was named.
    """
    journal = path / FILE_NAME if path.is_dir() else path
    if absent := [other for other in others if not other.is_file()]:
        raise ConfigurationError(f"there is no second file {absent[0]}")
    found = (*readable_second_files(journal), *others)
    if not journal.is_file() and not found:
        raise DataError(missing(path))
    left = _salvage(journal)
    identity = _identity(left.rows["meta"], found)
    if strange := [other for other in others if not any(read_mirror(other, identity)) and any(read_mirror(other))]:
        raise ConfigurationError(f"{strange[0]} is the second file of another journal")
    beside = _beside(found, identity)
    whole = {table: {**beside.rows[table], **left.rows[table]} for table in _SMALL}
    numbers = {table: left.numbers[table].joined(beside.numbers[table]) for table in FIRST}
    if not any(whole.values()) and not any(numbers.values()):
        raise DataError(_hopeless(journal, left.problem, found))
    meta = {key: parse_json(each.row[1]) for key, each in whole["meta"].items()}
    # A second file has every row.
    is_lost = {table: table in left.cut and not beside.rows["meta"].keys() - {IDENTITY} for table in TABLES}
    if meta.get("schema", None if whole["meta"] and not left.bad["meta"] else SCHEMA) != SCHEMA:
        raise DataError(f"{journal} has schema version {meta.get('schema')}; this bench reads version {SCHEMA}")
    substitutes: dict[str, Any] = {}
    if is_lost["meta"] or set(left.bad["meta"]).difference(whole["meta"]):
        events = chain.from_iterable(each.rows for each in _rows_of(journal, found, identity, ("events",)))
        guessed = metadata(journal, whole["files"], events)
        substitutes = {key: value for key, value in guessed.items() if key not in meta}
    named = left.signals or unnamed_signals(max(left.signals_of_rows, beside.signals_of_rows))
    signals = {position: each for position, each in named.items() if position not in whole["signals"]}
    # What is known to be lost although nothing of it can be read.
    left.bad["meta"] += [] if not is_lost["meta"] else [key for key in substitutes if key not in left.bad["meta"]]
    left.bad["signals"] += [position for position in signals if position not in left.bad["signals"]]
    counts = meta.get("counts", {})
    tables = {table: _small_state(left, table, whole[table], is_cut=is_lost[table]) for table in _SMALL}
    tables |= {
        table: _state(left, table, numbers[table], counts.get(table), is_cut=is_lost[table]) for table in FIRST
    }
    tables = {table: tables[table] for table in TABLES}
    meta = substitutes | meta
    copy = None
    if left.problem or any(state.added or state.missing or state.first_bad for state in tables.values()):
        copy = out or journal.parent / RECOVERED_NAME
        lost = {table: state.missing for table, state in tables.items() if state.missing}
        more = dict(substitutes)
        if lost and meta.get("status") == "completed":
            more |= {"status": "failed", "reason": "rows of the record were lost"}
        more["recovered"] = {"from": str(journal), "lost": lost, "substituted": sorted(substitutes)}
        meta |= more
        whole["signals"] |= signals
        _write(copy, whole, _rows_of(journal, found, identity, tuple(FIRST)), more)
    return Recovery(journal, str(meta.get("status", "unfinished")), left.problem, tables, found, copy)


def _hopeless(journal: Path, problem: str, found: Sequence[Path]) -> str:
    """Return what to say of a journal of which nothing can be read."""
    text = f"{journal}: nothing of it is readable{f' by SQLite: {problem}' if problem else ''}"
    if found:
        return f"{text}, nor of {' and '.join(map(str, found))}"
    return (
        f"{text}; there is no second file of it ({MIRROR_NAME} in its folder, which a run removes at its end). One "
        "that is elsewhere is named by --second"
    )


class _Numbers:
    """Numbers of rows, as ranges: rows come in the order of their numbers, so that there are few."""

    def __init__(self, ranges: Iterable[Range] = ()) -> None:
        self.ranges = list(ranges)

    def add(self, first: int, last: int) -> None:
        if self.ranges:
            begin, end = self.ranges[-1]
            if begin <= first <= end + 1 or begin <= last + 1 <= end + 1:
                self.ranges[-1] = min(begin, first), max(end, last)
                return
        self.ranges.append((first, last))

    def joined(self, others: _Numbers) -> _Numbers:
        """Return these and others, in order and without a number twice."""
        return _Numbers(joined_ranges([*self.ranges, *others.ranges]))

    def lacking(self, first: int, last: int) -> list[Range]:
        """Return the ranges of the numbers from `first` to `last` that are not among these, which are in order."""
        edges = [first - 1, *chain.from_iterable(self.ranges), last + 1]
        pairs = zip(edges[::2], edges[1::2], strict=True)
        return [(before + 1, after - 1) for before, after in pairs if after - before > 1]

    @property
    def last(self) -> int | None:
        return max((end for _, end in self.ranges), default=None)

    def __contains__(self, number: object) -> bool:
        return isinstance(number, int) and any(first <= number <= last for first, last in self.ranges)

    def __len__(self) -> int:
        return sum(last - first + 1 for first, last in self.ranges)


@dataclass
class _Left:
    """What is left of the SQLite file or of second files; numbered rows are counted only, as there may be many.

    Attributes
    ----------
    rows : dict of str to dict
        The good rows of each small table by their keys.
    numbers : dict of str to _Numbers
        The numbers of the good rows of the other tables.
    bad : dict of str to list
        The keys of bad ones.
    cut : set of str
        The tables of which there may be more rows than are known.
    signals : dict of int to JournalEntry
        By position, in the place of signals whose rows are lost.
    signals_of_rows : int
        Most values of signals that a numbered row has.
    problem : str
        What SQLite finds wrong.
    """

    rows: dict[str, dict[Any, JournalEntry]] = field(default_factory=lambda: {table: {} for table in _SMALL})
    numbers: dict[str, _Numbers] = field(default_factory=lambda: {table: _Numbers() for table in FIRST})
    bad: dict[str, list[Any]] = field(default_factory=lambda: {table: [] for table in TABLES})
    cut: set[str] = field(default_factory=set)
    signals: dict[Any, JournalEntry] = field(default_factory=dict)
    signals_of_rows: int = 0
    problem: str = ""

    def add(self, entry: JournalEntry) -> None:
        """Add good rows."""
        if entry.table in _SMALL:
            self.rows[entry.table][entry.row[0]] = entry
            return
        self.signals_of_rows = max(self.signals_of_rows, len(entry.row) - _BESIDE_SIGNALS[entry.table])
        for row in entry.rows:
            self.numbers[entry.table].add(int(row[0]), int(row[0]))


def _small_state(left: _Left, table: str, whole: Mapping[Any, JournalEntry], *, is_cut: bool) -> TableState:
    good, bad = left.rows[table], left.bad[table]
    lost = set(bad) - set(whole)
    lacking = set(bad) | (set(whole) - set(good))
    first = min(lacking, key=_order, default=None)
    return _counted(len(good), len(whole) - len(good), len(lost), first, is_cut=is_cut)


def _state(left: _Left, table: str, whole: _Numbers, count: int | None, *, is_cut: bool) -> TableState:
    good = left.numbers[table].joined(_Numbers())
    start = FIRST[table]
    bad = [key for key in left.bad[table] if key not in whole]
    known = [whole.last, *(key for key in bad if isinstance(key, int))]
    last = (
        max((number for number in known if number is not None), default=start - 1)
        if count is None
        else count + start - 1
    )
    gone = whole.lacking(start, last)
    others = [key for key in bad if not isinstance(key, int) or not start <= key <= last]
    lost = sum(end - begin + 1 for begin, end in gone) + len(others)
    lacking = good.lacking(start, max(last, whole.last or last))
    first = min([*(begin for begin, _ in lacking), *left.bad[table]], key=_order, default=None)
    # Their end is known all the same.
    return _counted(len(good), len(whole) - len(good), lost, first, is_cut=is_cut and count is None)


def _counted(good: int, added: int, lost: int, first: Any, *, is_cut: bool) -> TableState:  # noqa: ANN401 - a key
    # The key of a damaged row may be anything.
    first_bad = "" if first is None else str(int(first)) if isinstance(first, int | float) else str(first)
    if is_cut and not lost:
        return TableState(good, added, 1, first_bad or "?")
    return TableState(good, added, lost, first_bad)


def _order(key: Any) -> tuple[bool, Any]:  # noqa: ANN401 - a key of any table
    return (False, key) if isinstance(key, int | float) else (True, str(key))


def _salvage(journal: Path) -> _Left:
    if not journal.is_file():
        return _Left(cut=set(TABLES), problem="it is not there")
    try:
        opened = _opened(journal)
    except DataError as error:
        return _Left(cut=set(TABLES), problem=str(error.__cause__ or error))
    try:
        left = _Left(problem=_problem(opened.db))
        for table in TABLES:
            for each in _readable(opened.db, table, left.cut, left.bad[table]):
                left.add(each)
        left.signals = signal_rows(opened.db, left.rows["signals"])
    finally:
        opened.close()
    if damage := log_damage(journal.with_name(f"{journal.name}-wal")):
        left.problem = left.problem or damage
        left.cut |= FIRST.keys()
    return left


def _identity(meta: Mapping[Any, JournalEntry], seconds: Sequence[Path]) -> str:
    """Return the number of a journal; where it has lost it, that of the first second file that has rows."""
    if IDENTITY in meta:
        return str(parse_json(meta[IDENTITY].row[1]))
    first = next(chain.from_iterable(map(read_mirror, seconds)), None)
    if first is None or (first.table, first.row[0]) != ("meta", IDENTITY):
        return ""
    return str(parse_json(first.row[1]))


def _beside(seconds: Sequence[Path], identity: str) -> _Left:
    """Return what second files have."""
    found = _Left()
    for second in seconds:
        for each in read_mirror(second, identity):
            found.add(each)
    return found


def _rows_of(journal: Path, seconds: Sequence[Path], identity: str, tables: Sequence[str]) -> Iterator[JournalEntry]:
    """Yield the good rows of some tables, last those of the journal itself, which may come a second time."""
    for second in seconds:
        yield from (each for each in read_mirror(second, identity) if each.table in tables)
    if journal.is_file():
        with suppress(DataError), closing(_opened(journal)) as opened:
            for table in tables:
                yield from _readable(opened.db, table, set(), [])


def _opened(journal: Path) -> OpenedJournal:
    opened = OpenedJournal(journal)
    # A text that is damaged is one whose checksum does not fit.
    opened.db.text_factory = lambda content: content.decode("utf-8", "replace")
    return opened


def _problem(db: sqlite3.Connection) -> str:
    try:
        found = str(db.execute("PRAGMA quick_check(1)").fetchone()[0])
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        return str(error)
    return "" if found == "ok" else found.replace("\n", " ")


def _readable(db: sqlite3.Connection, table: str, cut: set[str], bad: list[Any]) -> Iterator[JournalEntry]:
    """Yield the good rows of a table that SQLite can read, around what it cannot.

    The table is added to `cut` if there may be others, and the keys of bad rows to `bad`. Where rows are numbered,
    those that lie between two that can be read are known.
    """
    key = _KEYS[table]
    ends: list[Any] = []
    for order in ("ASC", "DESC"):
        last: Any = None
        try:
            for rows in _blocks(db, f"SELECT * FROM {table} ORDER BY {key} {order}"):  # noqa: S608 - own names
                last = rows[-1][0]
                yield from _checked(table, rows, bad)
        except (sqlite3.DatabaseError, UnicodeDecodeError):
            ends.append(last)
        else:
            return
    if table in FIRST and isinstance(ends[0], int) and isinstance(ends[1], int):
        for number in range(ends[0] + 1, ends[1]):
            with suppress(sqlite3.DatabaseError, UnicodeDecodeError):
                row = db.execute(f"SELECT * FROM {table} WHERE {key} = ?", (number,)).fetchone()  # noqa: S608
                if row is not None:
                    yield from _checked(table, [row], bad)
    if table not in FIRST or ends[1] is None:
        cut.add(table)


def _blocks(db: sqlite3.Connection, statement: str) -> Iterator[list[tuple[Any, ...]]]:
    """Yield rows in blocks, also those before one that cannot be read; raises what SQLite does."""
    rows = []
    try:
        for row in db.execute(statement):
            rows.append(row)
            if len(rows) == _BLOCK:
                yield rows
                rows = []
    except (sqlite3.DatabaseError, UnicodeDecodeError):
        if rows:
            yield rows
        raise
    if rows:
        yield rows


def _checked(table: str, rows: Sequence[tuple[Any, ...]], bad: list[Any]) -> Iterator[JournalEntry]:
    """Yield the rows whose checksums fit, ticks together; the keys of others are added to `bad`."""
    if table == "telemetry" and rows:
        with suppress(ValueError, TypeError):
            numbers = np.array(rows, dtype=np.float64)
            if (np.array(checksums(numbers[:, :-1]), dtype=np.float64) == numbers[:, -1]).all():
                yield JournalEntry(table, [row[:-1] for row in rows], canonical(numbers[:, :-1]).tobytes())
                return
    for columns in rows:
        kept = None
        with suppress(ValueError, TypeError):
            if table != "files":
                kept = entry(table, columns[:-1])
            elif hashlib.sha256(columns[2]).hexdigest() == columns[1]:
                kept = entry(table, columns)
        if kept is not None and list(kept.columns()) == [columns]:
            yield kept
        else:
            bad.append(columns[0])


def _write(
    copy: Path,
    whole: Mapping[str, Mapping[Any, JournalEntry]],
    rows: Iterator[JournalEntry],
    more: Mapping[str, object],
) -> None:
    if copy.exists():
        raise ConfigurationError(f"{copy} exists already; nothing is overwritten, so name another one by --out")
    small = (each for table in whole for _, each in sorted(whole[table].items()))
    added = (entry("meta", meta_row(key, value)) for key, value in more.items())
    try:
        store = Store(copy, flushed=False)
        store.create([each.row[1] for _, each in sorted(whole["signals"].items())], chain(small, rows, added))
        store.close()
    except (sqlite3.Error, OSError) as error:
        raise ConfigurationError(f"{copy} cannot be written: {error}; name another one by --out") from None
