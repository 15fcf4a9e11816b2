"""Keeps rows: in the journal, or in its second file while the journal cannot be written."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from bench.base import RecordError, Stopwatch
from bench.record.mirror import NAME as MIRROR_NAME, Mirror, elsewhere, second_files
from bench.record.rows import FILE_NAME, JournalEntry, split
from bench.record.store import Store

RESERVE_NAME = "journal.reserve"
_RESERVE = 1 << 18
"""Space that is kept for the end of a run on a full disk, bytes."""

_SHORT = 64 << 20
_SHORT_PART = 0.05
"""Free space below which a recording has to stop, bytes and part of the disk, whichever is less."""

_BETWEEN_LOOKS = 1.0
_BETWEEN_TRIES = 0.5
_BETWEEN_FOLDS = 30.0
"""Wall-clock times between looks at the free space, tries to write what waits, and foldings of the WAL, s."""

_LAST_WAIT = 5.0
"""Wall-clock time that the end of a run waits for a program that has the journal locked, s."""


class Keeper:
    """Keeps the rows of one journal; used by one thread at a time.

    Parameters
    ----------
    store : Store
        The SQLite file.
    identity : str
        Number of the journal, which its second files have as well; empty for one that has none.

    Attributes
    ----------
    store : Store
        The SQLite file; another one once the first was removed.
    identity : str
        Number of the journal.
    notices : list of str
        What happened to the journal, for the log; who reads them takes them out.
    is_short : bool
        Whether the disk is nearly full.
    spare : list of Mirror
        Further second files, to be closed with the journal.
    """

    def __init__(self, store: Store, identity: str = "") -> None:
        self.store = store
        self.identity = identity
        self.notices: list[str] = []
        self.is_short = False
        self.spare: list[Mirror] = []
        self._waiting: list[JournalEntry] = []
        """Rows that are in a second file only."""
        self._why = ""
        self._is_closed = False
        folder = store.path.parent
        self._mirror: Mirror | None = Mirror(folder / MIRROR_NAME, identity)
        self._elsewhere: Mirror | None = None
        self._is_whole = True
        """Whether the second file has every row."""
        self._reserve = folder / RESERVE_NAME
        self._looked, self._tried, self._folded = Stopwatch(), Stopwatch(), Stopwatch()
        # Without space for it there is none for the run either, which will be seen.
        with suppress(OSError):
            self._reserve.write_bytes(b"\xa5" * _RESERVE)

    def begin(self, entries: Sequence[JournalEntry]) -> None:
        """Put the rows that the journal has at its beginning into the second file."""
        assert self._mirror is not None
        self._mirror.append(entries)

    def keep(self, entries: Sequence[JournalEntry]) -> None:
        """Make rows durable.

        Raises RecordError if they are nowhere, or the journal has been removed or replaced; what there was is in
        another one then, in which the end of the run can be recorded.
        """
        is_beside = self._append(entries)
        if not self._waiting or self._tried.seconds() >= _BETWEEN_TRIES:
            is_kept = self._write([*self._waiting, *entries])
        else:
            is_kept = False
        if is_kept:
            self._look_around()
        else:
            self._waiting += entries
            self._keep_beside(entries, is_beside)
        if loss := self.store.loss():
            self._rescue(loss)

    def fold_in(self, *, anyway: bool = False) -> None:
        """Try what waits, and fold the WAL in if it is time."""
        if self._waiting and self._tried.seconds() >= _BETWEEN_TRIES:
            self._write(list(self._waiting))
        if anyway or self._folded.seconds() >= _BETWEEN_FOLDS:
            self._folded = Stopwatch()
            with suppress(sqlite3.Error):
                self.store.fold_in()

    def make_room(self) -> None:
        """Give back the space that was kept for the end, and try to write what waits."""
        _remove(self._reserve)
        if self._waiting:
            self._write(list(self._waiting))

    def end(self, counts: Mapping[str, int]) -> str:
        """Bring everything into the journal; return what is wrong with it, or nothing."""
        try:
            self.store.wait_for_others(_LAST_WAIT)
            self.make_room()
            self.store.wait_for_others(0.0)
            if self._waiting:
                return self._why
            self.store.fold_in()
            return self.store.problem(counts)
        except (sqlite3.Error, OSError) as error:
            return str(error)

    def close(self, *, is_whole: bool) -> None:
        """Close the files; the second one is removed if the journal has everything."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._waiting:
            self._write(list(self._waiting))
        self.store.close()
        for mirror in (self._mirror, self._elsewhere, *self.spare):
            if mirror is not None:
                mirror.close()
        if is_whole and not self._waiting:
            for path in second_files(self.store.path):
                _remove(path)
        _remove(self._reserve)

    @property
    def why(self) -> str:
        """Why rows wait in a second file; empty if none does."""
        return self._why

    @property
    def second_file(self) -> Path:
        """The file that rows wait in."""
        mirror = self._elsewhere or self._mirror
        return self.store.path.parent / MIRROR_NAME if mirror is None else mirror.path

    def _append(self, entries: Sequence[JournalEntry]) -> bool:
        if self._mirror is not None:
            try:
                self._mirror.append(entries)
            except OSError:
                self._is_whole = False
            else:
                return True
        return False

    def _write(self, entries: Sequence[JournalEntry]) -> bool:
        """Write into the journal; return whether that was possible."""
        self._tried = Stopwatch()
        try:
            if self._why and not _is_busy(self._why):
                self.store.reconnect()
            self.store.write(entries)
        except (sqlite3.OperationalError, sqlite3.DatabaseError, OSError) as error:
            if isinstance(error, sqlite3.ProgrammingError | sqlite3.IntegrityError):
                raise
            if not self._why:
                self.notices.append(f"the journal cannot be written ({error}); rows wait in a second file")
            self._why = str(error)
            return False
        if self._why:
            self._why = ""
            self.notices.append(
                f"the journal can be written again; {sum(len(each.rows) for each in self._waiting)} rows were waiting"
            )
        self._waiting = []
        return True

    def _keep_beside(self, entries: Sequence[JournalEntry], is_beside: bool) -> None:
        """Make rows durable in a second file: beside the journal, or else on another medium, or in the reserve."""
        problem: OSError | None = None
        if is_beside and self._mirror is not None:
            try:
                self._mirror.sync()
            except OSError as error:
                problem = error
                self._is_whole = False
            else:
                return
        try:
            if self._elsewhere is None:
                path, _ = elsewhere(self.store.path)
                self._elsewhere = Mirror(path, self.identity)
                self._elsewhere.append(self._waiting)
                self.notices.append(f"the disk of the journal takes nothing; rows wait in {path}")
            else:
                self._elsewhere.append(entries)
            self._elsewhere.sync()
        except OSError as error:
            raise RecordError(
                f"{self.store.path} cannot be written: {self._why}; its second file neither: {problem or error}"
            ) from None

    def _look_around(self) -> None:
        if self._looked.seconds() >= _BETWEEN_LOOKS:
            self._looked = Stopwatch()
            self.fold_in()
            with suppress(OSError):
                disk = shutil.disk_usage(self.store.path.parent)
                is_short = disk.free < min(_SHORT, _SHORT_PART * disk.total)
                if is_short and not self.is_short:
                    self.notices.append(f"the disk is nearly full ({disk.free >> 20} MB free): recordings stop")
                self.is_short = is_short

    def _rescue(self, loss: str) -> None:
        """Write everything anew elsewhere, from the files that are still open, and go on there; raise RecordError."""
        former, store = self.store.path, self.store
        beside = [] if self._mirror is None else self._mirror.entries()
        rows = {(each.table, each.row[0]): each for each in (*beside, *split(self._waiting))}
        if not self._is_whole:
            with suppress(sqlite3.Error):
                rows = {(each.table, each.row[0]): each for each in store.entries()} | rows
        message = f"{former} was {loss} while the run went on; "
        try:
            folder = Path(tempfile.mkdtemp(prefix=f"{former.parent.name}-rescued-"))
            signals = [each.row[1] for each in rows.values() if each.table == "signals"]
            self.store = Store(folder / FILE_NAME)
            self.store.create(signals, rows.values())
            mirror = Mirror(folder / MIRROR_NAME, self.identity)
            mirror.append(list(rows.values()))
        except (OSError, sqlite3.Error) as error:
            raise RecordError(f"{message}what is recorded could not be written anew: {error}") from None
        store.close()
        if self._mirror is not None:
            self._mirror.close()
        self._mirror, self._waiting = mirror, []
        raise RecordError(f"{message}everything so far is in {self.store.path}, and the run ends here")


def _remove(path: Path) -> None:
    # A medium that cannot be written keeps it.
    with suppress(OSError):
        path.unlink()


def _is_busy(problem: str) -> bool:
    return "locked" in problem
