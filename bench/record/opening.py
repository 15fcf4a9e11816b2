"""Opens the SQLite file of a journal to read it, also where nothing can be written."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from contextlib import closing
from itertools import chain
from pathlib import Path

from bench.base import DataError
from bench.record.finding import cause_of, way_back
from bench.record.second_file import places, read_second_file
from bench.record.store import insert


class OpenedJournal:
    """A journal that is open for reading, without ever changing it.

    Parameters
    ----------
    path : Path
        The file.
    first_page : bytes, optional
        What is read in the place of its first page, which is lost.

    Attributes
    ----------
    path : Path
        The file.
    db : sqlite3.Connection
        To read with.
    remark : str
        How it is read, where that is not the usual way.

    Raises
    ------
    DataError
        If it cannot be opened.
    """

    def __init__(self, path: Path, first_page: bytes = b"") -> None:
        self.path = path
        self.remark = ""
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        try:
            if first_page:
                self.db = self._copied("has lost its first page", first_page)
            elif os.access(path.parent, os.W_OK):
                try:
                    # Reading a WAL file may need its companions; mode=ro keeps us from changing the record itself.
                    self.db = _connected(path, "mode=ro")
                except sqlite3.OperationalError as error:
                    if "readonly" not in str(error):
                        raise
                    # Its process died while it was closed: SQLite has something to undo first.
                    self.db = self._copied("was not closed")
            elif any(companion.stat().st_size for companion in _companions(path)):
                self.db = self._copied("cannot be changed and was not closed")
            else:
                self.db = _connected(path, "mode=ro&immutable=1")
        # Names in a damaged file may be no text.
        except (sqlite3.DatabaseError, OSError, UnicodeDecodeError) as error:
            self._remove()
            raise DataError(f"{path} is not a readable journal: {cause_of(error)}{way_back(path)}") from error

    def take_in(self, identity: str) -> str:
        """Have the rows that only a second file has read like those of the journal; return what is to be said of it.

        A temporary copy of the journal takes them then. Raises `sqlite3.Error` if they are no rows of its tables.
        """
        rows = {place: [*read_second_file(place, identity)] for place in places(self.path)}
        if not any(rows.values()):
            return ""
        with closing(self.db) as own:
            self.db = sqlite3.connect("", isolation_level=None)
            own.backup(self.db)
        before = self.db.total_changes
        insert(self.db, chain(*rows.values()), otherwise="IGNORE")
        if not (count := self.db.total_changes - before):
            return ""
        where = " and ".join(str(place) for place, found in rows.items() if found)
        return (
            f"{self.path} lacks {count} rows that its second file {where} has, and that are read from there; "
            f"`bench runs repair {self.path}` writes a copy with all rows, and bench resume takes them in"
        )

    def _copied(self, why: str, first_page: bytes = b"") -> sqlite3.Connection:
        self._copy = tempfile.TemporaryDirectory(prefix="bench-journal-")
        copy = Path(self._copy.name) / self.path.name
        for each in (self.path, *_companions(self.path)):
            shutil.copyfile(each, copy.with_name(each.name))
        with copy.open("r+b") as file:
            file.write(first_page)
        self.remark = f"{self.path} {why}: it is read from a copy, {copy}"
        return _connected(copy, "mode=rw")

    def close(self) -> None:
        """Close the file."""
        self.db.close()
        self._remove()

    def _remove(self) -> None:
        if self._copy is not None:
            self._copy.cleanup()


def _connected(path: Path, options: str) -> sqlite3.Connection:
    db = sqlite3.connect(f"{path.absolute().as_uri()}?{options}", uri=True, isolation_level=None)
    try:
        db.execute("SELECT count(*) FROM sqlite_master").fetchall()
    except (sqlite3.DatabaseError, UnicodeDecodeError):
        db.close()
        raise
    return db


def _companions(path: Path) -> list[Path]:
    """Return the files of what is not yet in the journal, or has to be undone in it."""
    companions = (path.with_name(f"{path.name}{end}") for end in ("-wal", "-journal"))
    return [companion for companion in companions if companion.is_file()]
