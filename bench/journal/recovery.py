"""Says how far a journal is good, and puts together what there is of it."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.errors import ConfigurationError, DataError
from bench.journal.mirror import read_mirror, second_files
from bench.journal.opening import OpenedJournal
from bench.journal.rows import FILE_NAME, FIRST, SCHEMA, TABLES, Entry, entry, meta_row
from bench.journal.store import Store

RECOVERED_NAME = "journal.recovered.sqlite"

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
        Rows that are nowhere.
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
        How its run ended; `unfinished` if that is not known.
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
        If it is no journal with checksums, or nothing of it is readable.
    ConfigurationError
        If the copy exists already or cannot be written, or there is no second file that was named.
    """
    journal = path / FILE_NAME if path.is_dir() else path
    seconds = (*second_files(journal), *others)
    if absent := [other for other in others if not other.is_file()]:
        raise ConfigurationError(f"there is no second file {absent[0]}")
    found = tuple(each for each in seconds if each.is_file())
    if not journal.is_file() and not found:
        raise DataError(f"{path} is not a run: there is no {FILE_NAME}")
    rows, bad, problem = _salvage(journal)
    beside: dict[str, dict[Any, Entry]] = {table: {} for table in TABLES}
    for second in found:
        for each in read_mirror(second):
            beside[each.table][each.row[0]] = each
    whole = {table: {**beside[table], **rows[table]} for table in TABLES}
    meta = {key: json.loads(each.row[1]) for key, each in whole["meta"].items()}
    if not meta or not whole["signals"]:
        raise DataError(f"{journal}: nothing of it is readable{f': {problem}' if problem else ''}")
    if meta.get("schema") != SCHEMA:
        raise DataError(f"{journal} has schema version {meta.get('schema')}, which has no checksums to recover by")
    tables = {
        table: _state(table, rows[table], bad[table], whole[table], meta.get("counts", {}).get(table))
        for table in TABLES
    }
    copy = None
    if problem or any(state.added or state.missing or state.first_bad for state in tables.values()):
        copy = out or journal.parent / RECOVERED_NAME
        lost = {table: state.missing for table, state in tables.items() if state.missing}
        _write(copy, whole, meta, journal, lost)
    return Recovery(journal, str(meta.get("status", "unfinished")), problem, tables, found, copy)


def _state(
    table: str, good: Mapping[Any, Entry], bad: Sequence[Any], whole: Mapping[Any, Entry], count: int | None
) -> TableState:
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
    first = min(lacking, key=lambda key: (isinstance(key, str), key)) if lacking else ""
    first_bad = first if isinstance(first, str) else str(int(first))
    return TableState(len(good), added, len(missing), first_bad)


def _salvage(journal: Path) -> tuple[dict[str, dict[Any, Entry]], dict[str, list[Any]], str]:
    """Return the good rows of each table by their keys, the keys of bad ones, and what SQLite finds wrong."""
    rows: dict[str, dict[Any, Entry]] = {table: {} for table in TABLES}
    bad: dict[str, list[Any]] = {table: [] for table in TABLES}
    if not journal.is_file():
        return rows, bad, "it is not there"
    try:
        opened = OpenedJournal(journal)
    except DataError as error:
        return rows, bad, str(error.__cause__ or error)
    # A text that is damaged is one whose checksum does not fit.
    opened.db.text_factory = lambda content: content.decode("utf-8", "replace")
    try:
        problem = _problem(opened.db)
        for table in TABLES:
            for columns in _readable(opened.db, table):
                kept = _checked(table, columns)
                if kept is None:
                    bad[table].append(columns[0])
                else:
                    rows[table][columns[0]] = kept
    finally:
        opened.close()
    return rows, bad, problem


def _problem(db: sqlite3.Connection) -> str:
    try:
        found = str(db.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.DatabaseError as error:
        return str(error)
    return "" if found == "ok" else found.replace("\n", " ")


def _readable(db: sqlite3.Connection, table: str) -> list[tuple[Any, ...]]:
    """Return the rows of a table that SQLite can read, around what it cannot."""
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
            return list(found.values())
    if table in FIRST and isinstance(ends[0], int) and isinstance(ends[1], int):
        for number in range(ends[0] + 1, ends[1]):
            with suppress(sqlite3.DatabaseError):
                row = db.execute(f"SELECT * FROM {table} WHERE {key} = ?", (number,)).fetchone()  # noqa: S608
                if row is not None:
                    found[number] = row
    return list(found.values())


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


def _write(
    copy: Path,
    whole: Mapping[str, Mapping[Any, Entry]],
    meta: Mapping[str, Any],
    journal: Path,
    lost: Mapping[str, int],
) -> None:
    if copy.exists():
        raise ConfigurationError(f"{copy} exists already; nothing is overwritten, so name another one by --out")
    more: dict[str, object] = {"recovered": {"from": str(journal), "lost": dict(lost)}}
    if lost and meta.get("status") == "completed":
        more |= {"status": "failed", "reason": "rows of the record were lost"}
    entries = [each for table in TABLES for _, each in sorted(whole[table].items())]
    entries += [entry("meta", meta_row(key, value)) for key, value in more.items()]
    try:
        store = Store(copy)
        store.create([each.row[1] for _, each in sorted(whole["signals"].items())], entries)
        store.close()
    except (sqlite3.Error, OSError) as error:
        raise ConfigurationError(f"{copy} cannot be written: {error}; name another one by --out") from None
