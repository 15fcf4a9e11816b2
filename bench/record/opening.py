"""Opens the SQLite file of a journal to read it, also where nothing can be written."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from pathlib import Path

from bench.base import DataError
from bench.record.finding import cause_of, way_back


class OpenedJournal:
    """A journal that is open for reading, without ever changing it.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    db : sqlite3.Connection
        To read with.
    remark : str
        How it is read, where that is not the usual way.

    Raises
    ------
    DataError
        If it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.remark = ""
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        try:
            if os.access(path.parent, os.W_OK):
                try:
                    # Reading a WAL file may need its companions; mode=ro keeps us from changing the record itself.
                    self.db = _connected(path, "mode=ro")
                except sqlite3.OperationalError as error:
                    if "readonly" not in str(error):
                        raise
                    # Its process died while it was closed: SQLite has something to undo first.
                    self.db = self._copied(path, "was not closed")
            elif any(companion.stat().st_size for companion in _companions(path)):
                self.db = self._copied(path, "cannot be changed and was not closed")
            else:
                self.db = _connected(path, "mode=ro&immutable=1")
        # Names in a damaged file may be no text.
        except (sqlite3.DatabaseError, OSError, UnicodeDecodeError) as error:
            self._remove()
            raise DataError(f"{path} is not a readable journal: {cause_of(error)}{way_back(path)}") from error

    def _copied(self, path: Path, why: str) -> sqlite3.Connection:
        self._copy = tempfile.TemporaryDirectory(prefix="bench-journal-")
        copy = Path(self._copy.name) / path.name
        for each in (path, *_companions(path)):
            shutil.copyfile(each, copy.with_name(each.name))
        self.remark = f"{path} {why}: it is read from a copy, {copy}"
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
