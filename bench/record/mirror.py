"""The second file of a journal: every row once more, appended, until the journal is closed whole.

It is written before the journal. Where the journal cannot be written for a while, as another program has it locked or
the disk is full, a row is durable as soon as this file is; where the journal is damaged, the rows come from here.

An entry is a mark, a head (table, quantity of rows and of numbers in each, length and CRC-32 of the rest), and the
rows' numbers and texts as in `JournalEntry`. What is damaged or cut off is left out when it is read.

Before the rows of a journal stands the random number that its metadata has, as a row of these. Rows that follow
another number, or none, are not of this journal, and are left out.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO

from bench.record.rows import IDENTITY, TABLES, TEXTS, JournalEntry, entry, meta_row, split, unpacked
from bench.rig import is_own

NAME = "journal.mirror"
_MARK = b"\xb5row"
_HEAD = struct.Struct("<BIHII")
_BLOCK = 1 << 20
"""Bytes that are read together."""
_sync = getattr(os, "fdatasync", os.fsync)


def elsewhere(journal: Path) -> tuple[Path, Path]:
    """Return second files in the folder for temporary files, for a journal whose own folder cannot be written.

    The first is for rows which that folder does not take, the second for those which it does not take in time.
    """
    digest = hashlib.sha256(str(journal.absolute()).encode("utf-8", "surrogateescape")).hexdigest()
    start = Path(tempfile.gettempdir()) / f"bench-{digest[:24]}"
    return start.with_suffix(".mirror"), start.with_suffix(".late")


class Mirror:
    """A second file to append to; raises OSError where the system does.

    Parameters
    ----------
    path : Path
        The file; what is there already is kept, up to the first entry that is cut off.
    identity : str
        Number of the journal; empty for one that has none.
    """

    def __init__(self, path: Path, identity: str = "") -> None:
        self.path = path
        self._unsaid = [entry("meta", meta_row(IDENTITY, identity))] if identity else []
        self._file = os.fdopen(_open(path, os.O_RDWR | os.O_CREAT), "r+b", buffering=0)
        self._end = self._file.seek(0, os.SEEK_END)

    def append(self, entries: Iterable[JournalEntry]) -> None:
        """Append rows, all or none; they are durable after `sync` only."""
        data = b"".join(map(_encoded, (*self._unsaid, *entries)))
        try:
            if self._file.write(data) != len(data):
                raise OSError(f"{self.path} takes no more")
        except OSError:
            # Half of an entry would only be in the way.
            self._file.truncate(self._end)
            self._file.seek(self._end)
            raise
        self._end += len(data)
        self._unsaid = []

    def sync(self) -> None:
        """Make what was appended durable."""
        _sync(self._file.fileno())

    def entries(self) -> list[JournalEntry]:
        """Return the rows, also of a file that has been removed meanwhile."""
        self._file.seek(0)
        entries = list(split(_decoded(self._file)))
        self._file.seek(self._end)
        return entries

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def second_files(journal: Path) -> list[Path]:
    """Return where second files of a journal may be."""
    return [journal.parent / NAME, *elsewhere(journal)]


def readable_second_files(journal: Path) -> list[Path]:
    """Return the second files of a journal that are there and may be read; whose rows they have is not looked at."""
    readable = []
    for path in second_files(journal):
        with suppress(FileNotFoundError, _ForeignFileError):
            os.close(_open(path, os.O_RDONLY))
            readable.append(path)
    return readable


def read_mirror(path: Path, identity: str | None = None) -> Iterator[JournalEntry]:
    """Yield the intact rows as they were written: ticks of one write together; none of a missing or foreign file.

    Parameters
    ----------
    path : Path
        The file.
    identity : str, optional
        Number of the journal whose rows are wanted, empty for a journal without one; if not given, rows of any.
    """
    wanted = meta_row(IDENTITY, identity) if identity else None
    journal = None
    try:
        with os.fdopen(_open(path, os.O_RDONLY), "rb") as file:
            for rows in _decoded(file):
                if rows.table == "meta" and rows.row[0] == IDENTITY:
                    journal = rows.row
                if identity is None or journal == wanted:
                    yield rows
    except (FileNotFoundError, _ForeignFileError):
        return


class _ForeignFileError(OSError):
    """A file in the folder for temporary files that this user has not written."""


def _open(path: Path, flags: int) -> int:
    """Open a second file; one in the folder for temporary files has to be a file of this user or of root.

    Everybody can write to that folder, and the names are no secret: no link is followed there, and nothing of another
    user is believed.
    """
    flags |= getattr(os, "O_BINARY", 0)
    if path.name == NAME or os.name == "nt":
        return os.open(path, flags, 0o666)
    try:
        file = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600)
    except FileNotFoundError:
        raise
    except OSError as error:
        why = "it is a link" if error.errno == errno.ELOOP else os.strerror(error.errno or 0)
        raise _ForeignFileError(error.errno, why, str(path)) from None
    found = os.fstat(file)
    if stat.S_ISREG(found.st_mode) and found.st_nlink == 1 and is_own(found):
        return file
    os.close(file)
    raise _ForeignFileError(errno.EPERM, "it is not a file of this user", str(path))


def _encoded(entry: JournalEntry) -> bytes:
    table, payload = TABLES.index(entry.table), entry.payload
    numbers = len(entry.row) - TEXTS[entry.table]
    return b"".join((_MARK, _HEAD.pack(table, len(entry.rows), numbers, len(payload), zlib.crc32(payload)), payload))


def _decoded(file: IO[bytes]) -> Iterator[JournalEntry]:
    size = os.fstat(file.fileno()).st_size
    data, start, passed = b"", 0, 0

    def reaches(end: int) -> bool:
        """Read on to an end in `data`; return whether the file goes so far, as a damaged length may be any."""
        nonlocal data
        if end > len(data) and passed + end <= size:
            data += file.read(max(end - len(data), _BLOCK))
        return end <= len(data)

    while True:
        if start >= _BLOCK:
            data, start, passed = data[start:], 0, passed + start
        mark = data.find(_MARK, start)
        if mark < 0:
            start = max(start, len(data) + 1 - len(_MARK))
            if not reaches(len(data) + 1):
                return
            continue
        start = mark + len(_MARK)
        begin = start + _HEAD.size
        if not reaches(begin):
            return
        table, count, numbers, length, crc = _HEAD.unpack_from(data, start)
        if not reaches(begin + length):
            continue
        payload = data[begin : begin + length]
        if zlib.crc32(payload) != crc or table >= len(TABLES):
            continue
        start = begin + length
        each = length // count if count else 0
        parts = [payload[each * i : each * (i + 1)] for i in range(count)]
        rows = [(row, part) for part in parts if (row := unpacked(TABLES[table], numbers, part)) is not None]
        if rows:
            yield JournalEntry(TABLES[table], [row for row, _ in rows], b"".join(part for _, part in rows))
