"""Says how far a journal is good, and puts together what there is of it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

from bench.base import ConfigurationError, DataError, parse_json
from bench.record.finding import missing
from bench.record.missing_rows import find_missing_rows
from bench.record.opening import OpenedJournal
from bench.record.rows import (
    FILE_NAME,
    FIRST,
    HEADING,
    IDENTITY,
    NUMBERS,
    RECOVERED_NAME,
    SCHEMA,
    TABLES,
    Row,
    is_good,
    meta as meta_rows,
    table_definitions,
)
from bench.record.second_file import NAME as SECOND_NAME, read_second_file, second_files
from bench.record.store import copied_heading, copy_heading, damage_of, first_page, insert
from bench.record.write_ahead_log import log_damage

_KEYS = {"meta": "key", "signals": "position", "files": "rowid", **NUMBERS}
_BLOCK = 4096
"""Rows that are held at a time. Chosen: one takes some 1 kB."""


@dataclass(frozen=True)
class TableState:
    """How much there is of a table.

    Attributes
    ----------
    good : int
        Rows of the journal whose checksums fit.
    added : int
        Rows that only a second file or the copy of the heading has.
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
        If it is no journal, its schema is of another version, or its metadata or signals and the copy of them are
        lost.
    ConfigurationError
        If the copy exists already or cannot be written, or there is no second file that was named.
    """
    is_journal = path.is_file() or path.suffix == Path(FILE_NAME).suffix
    journal = path if is_journal and not path.is_dir() else path / FILE_NAME
    if absent := [other for other in others if not other.is_file()]:
        raise ConfigurationError(f"there is no second file {absent[0]}")
    seconds = (*second_files(journal), *others)
    if not journal.is_file() and not seconds:
        raise DataError(missing(path))
    with closing(sqlite3.connect("", isolation_level=None)) as db:
        left = _gathered(journal, seconds, db)
        meta = left.meta
        for other in others:
            if not any(read_second_file(other, str(meta.get(IDENTITY, "")))):
                raise ConfigurationError(f"{other} is the second file of another journal, or none")
        tables = _states(left, journal, db)
        copy = None
        if left.problem or any(state.added or state.missing or state.first_bad for state in tables.values()):
            copy = out or journal.parent / RECOVERED_NAME
            lost = {table: state.missing for table, state in tables.items() if state.missing}
            more: dict[str, Any] = {"recovered": {"from": str(journal), "lost": lost}}
            if lost and meta.get("status") == "completed":
                more |= {"status": "failed", "reason": "rows of the record were lost"}
            insert(db, meta_rows(more))
            copy_heading(db)
            meta |= more
            if copy.exists():
                raise ConfigurationError(
                    f"{copy} exists already; nothing is overwritten, so name another one by --out"
                )
            try:
                db.execute("VACUUM INTO ?", (str(copy),))
            except sqlite3.Error as error:
                raise ConfigurationError(f"{copy} cannot be written: {error}; name another one by --out") from None
    return Recovery(journal, str(meta.get("status", "unfinished")), left.problem, tables, seconds, copy)


@dataclass(frozen=True)
class _Left:
    """What is left of a journal."""

    problem: str  # what SQLite finds wrong
    meta: dict[str, Any] = field(default_factory=dict)  # its metadata
    # By table the number of its good rows.
    good: dict[str, int] = field(default_factory=lambda: dict.fromkeys(TABLES, 0))
    # By table the keys of its bad rows, and of those that the journal's own tables lack.
    bad: dict[str, list[Any]] = field(default_factory=lambda: {table: [] for table in TABLES})
    added: dict[str, list[Any]] = field(default_factory=lambda: {table: [] for table in TABLES})
    cut: set[str] = field(default_factory=set)  # tables of which there may be more rows than are known


def _gathered(journal: Path, seconds: Sequence[Path], db: sqlite3.Connection) -> _Left:
    """Bring the good rows of a journal and of its second files into an empty database."""
    opened, problem = _opened(journal)
    left = _Left(problem)
    try:
        own = {table: [] if opened is None else [*_good_rows(opened, table, left)] for table in HEADING}
        copied = [] if opened is None else copied_heading(opened.db)
        heading = {row.key: row for row in chain(copied, *own.values())}
        identity = _identity(heading, seconds)
        beside = [*chain.from_iterable(read_second_file(second, identity) for second in seconds), *copied]
        heading = {row.key: row for row in chain(reversed(beside), *own.values()) if row.table in HEADING}
        if copied:
            # It has every row of these tables.
            left.cut.difference_update(HEADING)
            left.bad.update((table, []) for table in HEADING)
        left.meta.update(
            (key, parse_json(row.columns[1])) for (table, key), row in heading.items() if table == "meta"
        )
        if left.meta.get("schema", SCHEMA) != SCHEMA:
            raise DataError(f"{journal} has schema version {left.meta['schema']}; this bench reads version {SCHEMA}")
        lost = [
            f"row {key} of table {table}"
            for table in HEADING
            for key in left.bad[table]
            if (table, key) not in heading
        ]
        lost += [f"table {table}" for table in HEADING if table in left.cut]
        if lost or "schema" not in left.meta:
            raise DataError(_hopeless(journal, problem, lost, seconds))
        names = [row.columns[1] for _, row in sorted(heading.items()) if row.table == "signals"]
        for statement in table_definitions(names):
            db.execute(statement)
        for table in TABLES:
            rows = iter(own.get(table, ())) if opened is None or table in own else _good_rows(opened, table, left)
            while block := [*islice(rows, _BLOCK)]:
                insert(db, block)
            (left.good[table],) = db.execute(f"SELECT count(*) FROM {table}").fetchone()  # noqa: S608 - own names
        for row in beside:
            before = db.total_changes
            insert(db, [row], otherwise="IGNORE")
            if db.total_changes > before:
                left.added[row.table].append(row.columns[0])
    except sqlite3.Error as error:
        raise DataError(f"{journal}: its rows do not fit its signals: {error}") from error
    finally:
        if opened is not None:
            opened.close()
    return left


def _hopeless(journal: Path, problem: str, lost: Sequence[str], seconds: Sequence[Path]) -> str:
    """Return what to say of a journal whose metadata or signals are lost."""
    text = f"{journal}: nothing of it is readable{f' by SQLite: {problem}' if problem else ''}"
    if lost:
        text = f"{journal} has lost its heading ({', '.join(lost)}), without which no row can be understood"
    if seconds:
        return f"{text}, nor of {' and '.join(map(str, seconds))}"
    return (
        f"{text}; there is no second file ({SECOND_NAME}) in its folder; one that is elsewhere is named by --second"
    )


def _states(left: _Left, journal: Path, db: sqlite3.Connection) -> dict[str, TableState]:
    """Return how much there is of each table, by what a database has gathered."""
    missing = find_missing_rows(db, journal, left.meta)
    states = {}
    for table in TABLES:
        ranges = missing.ranges.get(table, ())
        gone = [key for key in left.bad[table] if key not in left.added[table]]
        gone = [key for key in gone if not any(first <= key <= last for first, last in ranges)]
        lost = sum(last - first + 1 for first, last in ranges) + len(gone) + missing.quantities.get(table, 0)
        is_cut = table in left.cut or (table in FIRST and bool(missing.damage))
        if is_cut and not lost and (table not in FIRST or "counts" not in left.meta):
            lost = 1
        wrong = [*(first for first, _ in ranges), *left.bad[table], *left.added[table]]
        first_bad = min(wrong, key=_order, default="?" if lost else "")
        states[table] = TableState(left.good[table], len(left.added[table]), lost, str(first_bad))
    return states


def _order(key: Any) -> tuple[bool, Any]:  # noqa: ANN401 - a key of any table
    return (False, key) if isinstance(key, int | float) else (True, str(key))


def _opened(journal: Path) -> tuple[OpenedJournal | None, str]:
    """Open a journal; return also what is wrong with it by SQLite's own check and its write-ahead log, or nothing."""
    if not journal.is_file():
        return None, "it is not there"
    lost = ""
    try:
        opened = OpenedJournal(journal)
    except DataError as error:
        lost = str(error.__cause__ or error)
        try:
            opened = _opened_without_first_page(journal)
        except (DataError, sqlite3.DatabaseError):
            return None, lost
    # A text that is damaged is one whose checksum does not fit.
    opened.db.text_factory = lambda content: content.decode("utf-8", "replace")
    return opened, lost or damage_of(opened.db) or log_damage(journal.with_name(f"{journal.name}-wal"))


def _opened_without_first_page(journal: Path) -> OpenedJournal:
    size = journal.stat().st_size
    with closing(OpenedJournal(journal, first_page([], size))) as opened:
        names = opened.db.execute("SELECT name FROM signals ORDER BY position").fetchall()
    return OpenedJournal(journal, first_page([name for (name,) in names], size))


def _identity(heading: Mapping[tuple[str, Any], Row], seconds: Sequence[Path]) -> str:
    """Return the number of a journal; where it has lost it, that of the first second file that has rows."""
    first = next((row for second in seconds for row in read_second_file(second)), None)
    found = heading.get(("meta", IDENTITY), None if heading else first)
    return "" if found is None else str(parse_json(found.columns[1]))


def _good_rows(opened: OpenedJournal, table: str, left: _Left) -> Iterator[Row]:
    """Yield the rows of a table whose checksums fit; the keys of others are noted as bad."""
    for columns in _readable(opened, table, left.cut):
        if is_good(table, columns):
            yield Row(table, columns if table == "files" else columns[:-1])
        else:
            left.bad[table].append(columns[0])


def _readable(opened: OpenedJournal, table: str, cut: set[str]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table that SQLite can read, around what it cannot.

    The table is added to `cut` if there may be others. Where rows are numbered, those that lie between two that can
    be read are known.
    """
    key = _KEYS[table]
    ends: list[Any] = []
    for order in ("ASC", "DESC"):
        last = None
        try:
            for row in opened.db.execute(f"SELECT * FROM {table} ORDER BY {key} {order}"):  # noqa: S608 - own names
                last = row[0]
                yield row
        except sqlite3.DatabaseError:
            ends.append(last)
        else:
            return
    are_known = table in FIRST and all(isinstance(end, int) for end in ends)
    # A damaged number may be any: a file has no more rows than bytes.
    if are_known and ends[1] - ends[0] <= opened.path.stat().st_size:
        yield from _between(opened.db, table, ends[0] + 1, ends[1] - 1)
    if table not in FIRST or ends[1] is None:
        cut.add(table)


def _between(db: sqlite3.Connection, table: str, first: int, last: int) -> Iterator[tuple[Any, ...]]:
    """Yield the rows with numbers from `first` to `last` that SQLite can read, by halves around what it cannot."""
    try:
        yield from db.execute(
            f"SELECT * FROM {table} WHERE {NUMBERS[table]} BETWEEN {first:d} AND {last:d}"  # noqa: S608 - own names
        ).fetchall()
    except sqlite3.DatabaseError:
        if first < last:
            yield from _between(db, table, first, (first + last) // 2)
            yield from _between(db, table, (first + last) // 2 + 1, last)
