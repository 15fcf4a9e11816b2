"""The SQLite file of a journal: its settings, writing rows, and whether they are all there."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import groupby
from pathlib import Path

from bench.record.rows import FILE_NAME, HEADING, TABLES, Row, is_good, sealed, table_definitions
from bench.record.second_file import decoded, encoded

OTHERS = 5.0
"""Wall-clock time that the beginning and the end of a run wait for a program that has the journal locked, s: as long
as `sqlite3.connect` does by itself."""

_LOG_PAGES = 64
"""Pages after which the write-ahead log is folded in and overwritten, of a journal whose commits wait for the disk.

A commit that makes the log longer waits for the file system's record of its size as well. After 64 pages, some 16
steps, the log does not grow any more (https://sqlite.org/wal.html).
"""


class Store:
    """Writes rows into the SQLite file; every method raises `sqlite3.Error`, and none waits for another program.

    Parameters
    ----------
    path : Path
        The file; it is created if there is none.
    wait : float
        Wall-clock time for which it waits for other programs until `wait_for_others` says otherwise, s.
    flushed : bool
        Whether each commit waits for the disk.
    """

    def __init__(self, path: Path, wait: float = 0.0, *, flushed: bool = True) -> None:
        self.path = path
        self._settings = (
            ("synchronous=FULL", f"wal_autocheckpoint={_LOG_PAGES}") if flushed else ("synchronous=NORMAL",)
        )
        self._wait = wait
        self._connect()
        made = path.stat()
        self._file = made.st_dev, made.st_ino

    def _connect(self) -> None:
        # One thread at a time, see `Keeper`.
        self._db = sqlite3.connect(self.path, timeout=self._wait, isolation_level=None, check_same_thread=False)
        self._db.execute("PRAGMA journal_mode=WAL")
        for setting in self._settings:
            self._db.execute(f"PRAGMA {setting}")

    def create(self, signals: Sequence[str], rows: Sequence[Row]) -> None:
        """Make the tables, with their first rows."""
        with self._transaction():
            for statement in table_definitions(signals):
                self._db.execute(statement)
            insert(self._db, rows)
            copy_heading(self._db)

    def write(self, rows: Sequence[Row]) -> None:
        """Commit rows, all or none."""
        with self._transaction():
            insert(self._db, rows)
            if any(row.table in HEADING for row in rows):
                copy_heading(self._db)

    def forget(self, keys: Iterable[str]) -> None:
        """Remove entries of the metadata."""
        with self._transaction():
            self._db.executemany("DELETE FROM meta WHERE key = ?", [(key,) for key in keys])
            copy_heading(self._db)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._db.execute("COMMIT")
        except sqlite3.Error:
            # SQLite itself may have done so.
            with suppress(sqlite3.Error):
                self._db.execute("ROLLBACK")
            raise

    def wait_for_others(self, seconds: float) -> None:
        """Wait for other programs from now on, each time for so long at most, s of wall-clock time."""
        self._wait = seconds
        self._db.execute(f"PRAGMA busy_timeout={round(1e3 * seconds)}")

    def reconnect(self) -> None:
        """Open the file again, as after a failure of the disk."""
        with suppress(sqlite3.Error):
            self._db.close()
        self._connect()

    def fold_in(self) -> None:
        """Bring what is committed from the companion file into the file itself, as far as nobody reads there."""
        self._db.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()

    def loss(self) -> str:
        """Return how the file is no longer where it was made, or nothing; SQLite goes on with one that is removed."""
        try:
            found = self.path.stat()
        except OSError:
            return "removed"
        return "" if (found.st_dev, found.st_ino) == self._file else "replaced"

    def problem(self, counts: Mapping[str, int]) -> str:
        """Return what is wrong with the file, by SQLite's own check and the number of rows by table; or nothing."""
        # What is in the file, not what this connection remembers of it.
        with closing(sqlite3.connect(self.path, isolation_level=None)) as db:
            if damage := damage_of(db):
                return damage
            for table, count in counts.items():
                (rows,) = db.execute(f"SELECT count(*) FROM {table}").fetchone()  # noqa: S608 - own names
                if rows != count:
                    return f"table {table} has {rows} rows of {count}"
        return ""

    def rows(self) -> Iterator[Row]:
        """Yield every row, also of a file that has been removed."""
        for table in TABLES:
            for columns in self._db.execute(f"SELECT * FROM {table}"):  # noqa: S608 - own names
                yield Row(table, columns if table == "files" else columns[:-1])

    def close(self) -> None:
        """Close the file, as one that can be read where nothing can be written."""
        # Out of WAL mode, as a reader of a WAL file leaves companions beside it; while one reads, it cannot be.
        with suppress(sqlite3.Error):
            self._db.execute("PRAGMA journal_mode=DELETE")
        self._db.close()


def damage_of(db: sqlite3.Connection) -> str:
    """Return what SQLite's own check finds wrong with the pages of a file; empty if nothing."""
    try:
        found = str(db.execute("PRAGMA quick_check(1)").fetchone()[0]).replace("\n", " ")
    # Names in a damaged file may be no text.
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        return str(error)
    return "" if found == "ok" else found


def insert(db: sqlite3.Connection, rows: Iterable[Row], otherwise: str = "REPLACE") -> None:
    """Insert rows; one that comes a second time, as from the second file, is the same."""
    for table, several in groupby(rows, key=lambda row: row.table):
        stored = list(sealed(table, [row.columns for row in several]))
        marks = ", ".join("?" * len(stored[0]))
        db.executemany(f"INSERT OR {otherwise} INTO {table} VALUES ({marks})", stored)  # noqa: S608 - own names


def copy_heading(db: sqlite3.Connection) -> None:
    """Write the rows of the heading a second time, onto other pages, as without them no row can be understood."""
    rows = [(table, row) for table in HEADING for row in db.execute(f"SELECT * FROM {table}")]  # noqa: S608 - own names
    # The copy that is there is better than one of a damaged row.
    if all(is_good(table, row) for table, row in rows):
        db.execute("DELETE FROM heading")
        lines = [(encoded(Row(table, row[:-1])),) for table, row in rows]
        db.executemany("INSERT INTO heading VALUES (?)", lines)


def first_page(signals: Sequence[str], size: int) -> bytes:
    """Return the first page of a journal of so many bytes: what is where follows from the number of its signals.

    The tables are made in one order, before any row, and SQLite never moves where one begins
    (https://sqlite.org/fileformat2.html, section 1).
    """
    with tempfile.TemporaryDirectory(prefix="bench-journal-") as folder:
        path = Path(folder) / FILE_NAME
        with closing(Store(path)) as store:
            store.create(signals, [])
        content = path.read_bytes()
    page = int.from_bytes(content[16:18], "big")
    return content[:28] + (size // page).to_bytes(4, "big") + content[32:page]


def copied_heading(db: sqlite3.Connection) -> list[Row]:
    """Return the rows that `copy_heading` has written; none if they are not all readable."""
    try:
        lines = [line for (line,) in db.execute("SELECT line FROM heading")]
    except sqlite3.DatabaseError:
        return []
    # A damaged cell may have any type.
    rows = [decoded(line) if isinstance(line, bytes) else None for line in lines]
    return [row for row in rows if row is not None] if all(rows) else []
