"""Opens the SQLite file of a journal to read it, also where nothing can be written."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from pathlib import Path

from bench.errors import DataError


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
        # Reading a WAL file may need its companions; mode=ro keeps us from changing the record itself.
        options = "mode=ro"
        try:
            if not os.access(path.parent, os.W_OK):
                companion = path.with_name(path.name + "-wal")
                if companion.is_file() and companion.stat().st_size:
                    self._copy = tempfile.TemporaryDirectory(prefix="bench-journal-")
                    for each in (path, companion):
                        shutil.copyfile(each, Path(self._copy.name) / each.name)
                    copy = Path(self._copy.name) / path.name
                    self.remark = f"{path.parent} cannot be written: the journal is read from a copy, {copy}"
                    path = copy
                else:
                    options += "&immutable=1"
            self.db = sqlite3.connect(f"{path.absolute().as_uri()}?{options}", uri=True, isolation_level=None)
        except (sqlite3.DatabaseError, OSError) as error:
            self._remove()
            raise DataError(f"{path} cannot be read: {error}") from error

    def close(self) -> None:
        """Close the file."""
        self.db.close()
        self._remove()

    def _remove(self) -> None:
        if self._copy is not None:
            self._copy.cleanup()
