"""The second file of a journal: rows that SQLite cannot take, until it takes them.

It exists only while the journal cannot be written. A line is the CRC-32 of the rest, and the rest: the table and the
columns of a row, as JSON. The first line is the random number that tells the journal from every other one, as a row
of its metadata. A line that is damaged or cut off is left out when it is read, and so is a file that begins with
another number.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import json
import os
import stat
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any

from bench.base import parse_json
from bench.record.rows import IDENTITY, TABLES, Row, meta
from bench.rig import is_own

NAME = "journal.second"
_sync = getattr(os, "fdatasync", os.fsync)


def places(journal: Path) -> tuple[Path, Path]:
    """Return where the second file may be: in the folder of the journal, else in the folder for temporary files."""
    digest = hashlib.sha256(str(journal.absolute()).encode("utf-8", "surrogateescape")).hexdigest()
    return journal.with_name(NAME), Path(tempfile.gettempdir()) / f"bench-{digest[:24]}.second"


class SecondFile:
    """A second file that is made, to append to; raises OSError where the system does, also if it is there already.

    Parameters
    ----------
    path : Path
        The file.
    identity : str
        Number of the journal.
    rows : sequence of Row
        Its first rows; they are durable.
    """

    def __init__(self, path: Path, identity: str, rows: Sequence[Row] = ()) -> None:
        self.path = path
        self._file = _open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        self._end = 0
        try:
            self.append([*meta({IDENTITY: identity}), *rows])
            self.sync()
            _sync_folder(path.parent)
        except OSError:
            self.close()
            remove(path)
            raise

    def append(self, rows: Iterable[Row]) -> None:
        """Append rows, all or none; they are durable after `sync` only."""
        data = b"".join(map(encoded, rows))
        try:
            if os.write(self._file, data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        except OSError:
            # Half of a line would spoil the next one.
            os.ftruncate(self._file, self._end)
            os.lseek(self._file, self._end, os.SEEK_SET)
            raise
        self._end += len(data)

    def sync(self) -> None:
        """Make what was appended durable."""
        _sync(self._file)

    @property
    def is_there(self) -> bool:
        """Whether the file is where it was made."""
        try:
            return os.path.samestat(self.path.lstat(), os.fstat(self._file))
        except OSError:
            return False

    def close(self) -> None:
        """Close the file, which stays."""
        os.close(self._file)


def read_second_file(path: Path, identity: str | None = None) -> Iterator[Row]:
    """Yield the intact rows of a second file as they were written; none of a file that is missing or not believed.

    Those of the journal with this number are wanted, or of any if it is not given.
    """
    wanted = None if identity is None else meta({IDENTITY: identity})[0]
    try:
        with os.fdopen(_open(path, os.O_RDONLY), "rb") as file:
            rows = filter(None, map(decoded, file))
            first = next(rows, None)
            if first is not None and first.key == ("meta", IDENTITY) and wanted in (None, first):
                yield from chain((first,), rows)
    except OSError:
        return


def is_second_file(path: Path, identity: str) -> bool:
    """Return whether a file is the second file of a journal; also if its process died before a row was in it."""
    start = encoded(*meta({IDENTITY: identity}))
    try:
        with os.fdopen(_open(path, os.O_RDONLY), "rb") as file:
            return start.startswith(file.read(len(start)))
    except OSError:
        return False


def second_files(journal: Path) -> list[Path]:
    """Return the second files that are there and believed; whose rows they have is not looked at."""
    return [path for path in places(journal) if not _refusal(path)]


def refusal(journal: Path) -> str:
    """Return why the second file in the folder of a journal is not read although it is there, or nothing."""
    path, _ = places(journal)
    return f"its second file {path} is not read: {_refusal(path)}" if os.path.lexists(path) and _refusal(path) else ""


def remove(path: Path) -> None:
    """Remove a file, if that is possible."""
    # A medium that cannot be written keeps it; its rows are those of the journal then.
    with suppress(OSError):
        path.unlink()


def _sync_folder(folder: Path) -> None:
    """Make durable that a file was made in a folder."""
    if os.name != "nt":
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def _refusal(path: Path) -> str:
    try:
        os.close(_open(path, os.O_RDONLY))
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _open(path: Path, flags: int) -> int:
    """Open a second file, which has to be a plain file of this user, of root, or of who has the folder.

    Everybody can write to the folder for temporary files, and the names are no secret: no link is followed, and
    nothing of another user is believed.
    """
    if os.name == "nt":
        return os.open(path, flags | getattr(os, "O_BINARY", 0), 0o600)
    file = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    found = os.fstat(file)
    is_theirs = not (is_own(found) or found.st_uid == path.parent.stat().st_uid)
    # What this process has just made is its own, whatever a drive of the network says of its owner.
    if not flags & os.O_EXCL and (is_theirs or not stat.S_ISREG(found.st_mode) or found.st_nlink != 1):
        os.close(file)
        raise OSError(errno.EPERM, "it is not a file of this user", str(path))
    return file


def encoded(row: Row) -> bytes:
    """Return a row as a line."""
    content = json.dumps([row.table, *row.columns], default=lambda value: base64.b64encode(value).decode()).encode()
    return b"%08x %s\n" % (zlib.crc32(content), content)


def decoded(line: bytes) -> Row | None:
    """Return the row of a line, None if it is damaged."""
    total, _, content = line.removesuffix(b"\n").partition(b" ")
    try:
        if int(total, 16) != zlib.crc32(content):
            return None
        found: list[Any] = parse_json(content)
        table, *columns = found
        if table == "files":
            columns[2] = base64.b64decode(columns[2])
    except (ValueError, TypeError, IndexError):
        return None
    return Row(table, tuple(columns)) if table in TABLES else None
