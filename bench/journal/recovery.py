"""Says how far a journal is good, and puts together what there is of it."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bench.errors import ConfigurationError, DataError
from bench.journal.finding import missing
from bench.journal.mirror import NAME as MIRROR_NAME
from bench.journal.mirror import read_mirror, second_files
from bench.journal.opening import OpenedJournal
from bench.journal.rows import FILE_NAME, FIRST, RECOVERED_NAME, SCHEMA, TABLES, Entry, entry, meta_row
from bench.journal.store import Store
from bench.journal.substitutes import metadata, signal_rows, unnamed_signals

_KEYS = dict(zip(TABLES, ("key", "position", "step", "tick", "event", "rowid"), strict=True))


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
    seconds = (*second_files(journal), *others)
    if absent := [other for other in others if not other.is_file()]:
        raise ConfigurationError(f"there is no second file {absent[0]}")
    found = tuple(each for each in seconds if each.is_file())
    if not journal.is_file() and not found:
        raise DataError(missing(path))
    left = _salvage(journal)
    beside: dict[str, dict[Any, Entry]] = {table: {} for table in TABLES}
    for second in found:
        for each in read_mirror(second):
            beside[each.table][each.row[0]] = each
    whole = {table: {**beside[table], **left.rows[table]} for table in TABLES}
    if not any(whole.values()):
        raise DataError(_hopeless(journal, left.problem, found))
    meta = {key: json.loads(each.row[1]) for key, each in whole["meta"].items()}
    # A second file has every row.
    is_lost = {table: table in left.cut and not beside["meta"] for table in TABLES}
    if meta.get("schema", None if whole["meta"] and not left.bad["meta"] else SCHEMA) != SCHEMA:
        raise DataError(f"{journal} has schema version {meta.get('schema')}; this bench reads version {SCHEMA}")
    substitutes: dict[str, Any] = {}
    if is_lost["meta"] or set(left.bad["meta"]).difference(whole["meta"]):
        guessed = metadata(journal, whole["files"], whole["events"].values())
        substitutes = {key: value for key, value in guessed.items() if key not in meta}
    named = left.signals or unnamed_signals(whole["steps"].values(), whole["telemetry"].values())
    signals = {position: each for position, each in named.items() if position not in whole["signals"]}
    # What is known to be lost although nothing of it can be read.
    left.bad["meta"] += [] if not is_lost["meta"] else [key for key in substitutes if key not in left.bad["meta"]]
    left.bad["signals"] += [position for position in signals if position not in left.bad["signals"]]
    counts = meta.get("counts", {})
    tables = {table: _state(table, left, whole[table], counts.get(table), is_cut=is_lost[table]) for table in TABLES}
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
        _write(copy, whole, more)
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


@dataclass(frozen=True)
class _Left:
    """What is left of the SQLite file.

    Attributes
    ----------
    rows : dict of str to dict
        The good rows of each table by their keys.
    bad : dict of str to list
        The keys of bad ones.
    cut : set of str
        The tables of which there may be more rows than are known.
    signals : dict of int to Entry
        By position, in the place of signals whose rows are lost.
    problem : str
        What SQLite finds wrong.
    """

    rows: dict[str, dict[Any, Entry]] = field(default_factory=lambda: {table: {} for table in TABLES})
    bad: dict[str, list[Any]] = field(default_factory=lambda: {table: [] for table in TABLES})
    cut: set[str] = field(default_factory=set)
    signals: dict[Any, Entry] = field(default_factory=dict)
    problem: str = ""


def _state(table: str, left: _Left, whole: Mapping[Any, Entry], count: int | None, *, is_cut: bool) -> TableState:
    good, bad = left.rows[table], left.bad[table]
    added = len(whole) - len(good)
    lacking = set(bad) | (set(whole) - set(good))
    missing = set(bad) - set(whole)
    if table in FIRST:
        start = FIRST[table]
        numbers = [*whole, *(key for key in bad if isinstance(key, int)), start - 1]
        last = int(max(numbers)) if count is None else count + start - 1
        gone = set(range(start, last + 1)) - set(whole)
        missing |= gone
        lacking |= gone
        # Their end is known all the same.
        is_cut = is_cut and count is None
    first = min(lacking, key=lambda key: (isinstance(key, str), key)) if lacking else ""
    first_bad = first if isinstance(first, str) else str(int(first))
    if is_cut and not missing:
        return TableState(len(good), added, 1, first_bad or "?")
    return TableState(len(good), added, len(missing), first_bad)


def _salvage(journal: Path) -> _Left:
    if not journal.is_file():
        return _Left(cut=set(TABLES), problem="it is not there")
    try:
        opened = OpenedJournal(journal)
    except DataError as error:
        return _Left(cut=set(TABLES), problem=str(error.__cause__ or error))
    # A text that is damaged is one whose checksum does not fit.
    opened.db.text_factory = lambda content: content.decode("utf-8", "replace")
    try:
        left = _Left(problem=_problem(opened.db))
        for table in TABLES:
            rows, is_cut = _readable(opened.db, table)
            if is_cut:
                left.cut.add(table)
            for columns in rows:
                kept = _checked(table, columns)
                if kept is None:
                    left.bad[table].append(columns[0])
                else:
                    left.rows[table][columns[0]] = kept
        return replace(left, signals=signal_rows(opened.db, left.rows["signals"]))
    finally:
        opened.close()


def _problem(db: sqlite3.Connection) -> str:
    try:
        found = str(db.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.DatabaseError as error:
        return str(error)
    return "" if found == "ok" else found.replace("\n", " ")


def _readable(db: sqlite3.Connection, table: str) -> tuple[list[tuple[Any, ...]], bool]:
    """Return the rows of a table that SQLite can read, around what it cannot; and whether others may be unknown.

    Where rows are numbered, those that lie between two that can be read are known.
    """
    key = _KEYS[table]
    found: dict[Any, tuple[Any, ...]] = {}
    ends = []
    for order in ("ASC", "DESC"):
        last: Any = None
        try:
            for row in db.execute(f"SELECT * FROM {table} ORDER BY {key} {order}"):  # noqa: S608 - own names
                found[row[0]] = row
                last = row[0]
        except sqlite3.DatabaseError:
            ends.append(last)
        else:
            return list(found.values()), False
    if table in FIRST and isinstance(ends[0], int) and isinstance(ends[1], int):
        for number in range(ends[0] + 1, ends[1]):
            with suppress(sqlite3.DatabaseError):
                row = db.execute(f"SELECT * FROM {table} WHERE {key} = ?", (number,)).fetchone()  # noqa: S608
                if row is not None:
                    found[number] = row
    return list(found.values()), table not in FIRST or ends[1] is None


def _checked(table: str, columns: tuple[Any, ...]) -> Entry | None:
    """Return a row if its checksum fits."""
    try:
        if table == "files":
            kept = entry(table, columns)
            return kept if hashlib.sha256(columns[2]).hexdigest() == columns[1] else None
        kept = entry(table, columns[:-1])
    except (ValueError, TypeError):
        return None
    return kept if kept.columns() == [columns] else None


def _write(copy: Path, whole: Mapping[str, Mapping[Any, Entry]], more: Mapping[str, object]) -> None:
    if copy.exists():
        raise ConfigurationError(f"{copy} exists already; nothing is overwritten, so name another one by --out")
    entries = [each for table in TABLES for _, each in sorted(whole[table].items())]
    entries += [entry("meta", meta_row(key, value)) for key, value in more.items()]
    try:
        store = Store(copy)
        store.create([each.row[1] for _, each in sorted(whole["signals"].items())], entries)
        store.close()
    except (sqlite3.Error, OSError) as error:
        raise ConfigurationError(f"{copy} cannot be written: {error}; name another one by --out") from None
