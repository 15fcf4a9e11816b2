"""Keeps rows: in the journal, or in its second file while the journal cannot be written."""

from __future__ import annotations

import shutil
import sqlite3
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress

from bench.base import RecordError, Stopwatch
from bench.record.rows import Row
from bench.record.second_file import SecondFile, places, remove
from bench.record.store import OTHERS, Store

_LONGEST_UNWRITTEN = 0.1
"""Wall-clock time after which a tick is committed, s: who watches takes it for at once (Nielsen, Usability
Engineering, 1993, section 5.5)."""

_BETWEEN_TRIES = 0.5
"""Wall-clock time between tries to write what waits, s. Chosen: a try takes some ms, 1 % of that."""

_BETWEEN_LOOKS = 30.0
"""Wall-clock time between looks at the free space, and between foldings of the write-ahead log, s. Chosen: a copy of
the journal without its log lacks no more, and a disk has room for so long below `_SHORT`."""

_SHORT = 64 << 20
_SHORT_PART = 0.05
"""Free space below which a recording has to stop, bytes and part of the disk, whichever is less. Chosen: 64 MB are
16 h of ten signals at 10 Hz; 5 % are what ext4 keeps from users (man mke2fs, -m)."""

_LAST_WAIT = 30.0
"""Wall-clock time that the end of a run waits for the disk, s: as long as Linux does for a command to a disk
(/sys/block/sda/device/timeout)."""


class Keeper:
    """Keeps the rows of one journal.

    Parameters
    ----------
    store : Store
        The SQLite file.
    identity : str
        Number of the journal, which its second file has as well.
    patience : float, optional
        Longest time that a call waits for the disk, s of wall-clock time; a thread of its own writes the SQLite file
        then. Without it the caller's does.

    Attributes
    ----------
    store : Store
        The SQLite file.
    notices : list of str
        What happened to the journal, for the log; who reads them takes them out.
    is_short : bool
        Whether the disk is nearly full.
    """

    def __init__(self, store: Store, identity: str, patience: float | None = None) -> None:
        self.store = store
        self.notices: list[str] = []
        self.is_short = False
        self._identity = identity
        self._patience = patience
        self._waiting: list[Row] = []
        """Rows that the journal does not have yet."""
        self._put = self._stored = self._doubled = 0
        """Rows so far: handed over, in the journal, and up to the last one in the second file."""
        self._second: SecondFile | None = None
        self._why = ""
        """Why the journal cannot be written."""
        self._loss = ""
        self._is_left = self._is_urgent = self._is_ending = self._is_closed = self._was_slow = False
        self._defect: Exception | None = None
        self._tried, self._looked = Stopwatch(), Stopwatch()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        if patience is not None:
            # One that hangs with its disk does not keep the process from ending.
            self._thread = threading.Thread(target=self._work, name="journal", daemon=True)
            self._thread.start()

    def keep(self, rows: Sequence[Row], *, soon: bool = False) -> None:
        """Make rows durable, and those before them; if `soon`, have them written within 0.1 s, with what comes next.

        Raises RecordError if they are nowhere, or the journal was removed or replaced: then every row is in a second
        file, into which further ones go.
        """
        with self._changed:
            is_first = not self._waiting
            self._waiting += rows
            self._put += len(rows)
            goal = self._put
            if self._thread is None:
                if not soon or self._tried.seconds() >= _LONGEST_UNWRITTEN:
                    self._try()
            else:
                self._is_urgent = self._is_urgent or not soon
                if is_first or not soon:
                    self._changed.notify_all()
                if not soon:
                    self._changed.wait_for(lambda: self._stored >= goal or self._why or self._defect, self._patience)
            defect, self._defect = self._defect, None
            if defect is not None:
                raise defect
            if self._loss and not self._is_left:
                self._leave()
            if self._doubled < goal and self._stored < goal and (self._why or not soon):
                first = max(0, self._doubled - self._stored)
                self._double(self._waiting[first:], self._waiting[:first], is_durable=not soon)

    def end(self, counts: Mapping[str, int]) -> str:
        """Bring everything into the journal; return what is wrong with it, by its numbers of rows, or nothing."""
        self._stop()
        if self._thread is not None or self._loss:
            return self._why
        try:
            self._try(anyway=True)
            if "locked" in self._why:
                self.store.wait_for_others(OTHERS)
                self._try(anyway=True)
                self.store.wait_for_others(0.0)
            if self._waiting:
                return self._why
            self.store.fold_in()
            return self.store.problem(counts)
        except (sqlite3.Error, OSError) as error:
            return str(error)

    def close(self) -> None:
        """Close the files; a second one stays if it has rows that the journal does not have."""
        self._stop()
        # Otherwise its disk does not answer.
        if self._thread is None and not self._is_closed:
            self._is_closed = True
            self._try(anyway=True)
            with suppress(RecordError):
                self.keep(())
            self.store.close()
            if self._second is not None:
                self._second.close()

    @property
    def why(self) -> str:
        """Why rows wait in a second file, and in which one; empty if none does."""
        return "" if self._second is None else f"{self._why or 'it is slow'}; rows wait in {self._second.path}"

    def _try(self, *, anyway: bool = False) -> None:
        """Write what waits into the journal in the caller's thread."""
        with self._changed:
            if not self._why or anyway or self._tried.seconds() >= _BETWEEN_TRIES:
                batch = list(self._waiting)
                self._settle(batch, *self._commit(batch))

    def _work(self) -> None:
        """Write what waits into the journal in a thread of its own."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: (self._waiting and not self._loss) or self._is_ending)
                # Ticks of a fast loop are written together.
                rest = (_BETWEEN_TRIES if self._why else _LONGEST_UNWRITTEN) - self._tried.seconds()
                self._changed.wait_for(lambda: (self._is_urgent and not self._why) or self._is_ending, rest)
                self._is_urgent = False
                batch = list(self._waiting)
            why, loss = self._commit(batch)
            with self._changed:
                self._settle(batch, why, loss)
                if self._is_ending:
                    return

    def _commit(self, rows: Sequence[Row]) -> tuple[str, str]:
        """Write rows into the journal; return why that was not possible, and how the journal was lost; or nothing."""
        # SQLite goes on with a file that is removed, and would make a new one where it is opened again.
        loss = self._loss or self.store.loss()
        try:
            if rows and not loss:
                if self._why:
                    self.store.reconnect()
                self.store.write(rows)
                loss = self.store.loss()
        except Exception as error:
            if isinstance(error, OSError | sqlite3.OperationalError) or type(error) is sqlite3.DatabaseError:
                return str(error), loss
            # It is no fault of the disk, and raised by the next call.
            self._defect = error
        finally:
            self._tried = Stopwatch()
        if self._looked.seconds() >= _BETWEEN_LOOKS and not loss:
            self._look_around()
        return f"it was {loss}" if loss else "", loss

    def _settle(self, batch: Sequence[Row], why: str, loss: str) -> None:
        """Note that rows are in the journal, or why they are not; with them the second file goes."""
        self._why, self._loss = why, loss
        if not why:
            del self._waiting[: len(batch)]
            self._stored += len(batch)
            if self._second is not None and self._stored >= self._doubled:
                self._second.close()
                remove(self._second.path)
                self._second = None
                if not self._was_slow:
                    self.notices.append("the journal can be written again; it has the rows that were waiting")
        self._changed.notify_all()

    def _double(self, rows: Sequence[Row], others: Sequence[Row] = (), *, is_durable: bool = True) -> None:
        """Put rows into the second file; one that is made has the others before them."""
        former = self._second
        try:
            if former is None or not former.is_there:
                self._second = self._made([*others, *rows])
            else:
                former.append(rows)
                if is_durable:
                    former.sync()
        except OSError:
            # It does not take them any more.
            self._second = self._made([*others, *rows])
        self._doubled = self._put
        if former is not None and self._second is not None and former is not self._second:
            former.close()
            if former.path != self._second.path:
                remove(former.path)

    def _made(self, rows: Sequence[Row]) -> SecondFile:
        """Return a second file that is made, with its first rows.

        Where the disk of the journal does not answer, none is made on it.
        """
        why, problems = self._why or "its disk does not answer", []
        for path in places(self.store.path)[not self._why :]:
            try:
                second = SecondFile(path, self._identity, rows)
            except OSError as error:
                problems.append(f"{path}: {error.strerror or error}")
                continue
            # A slow disk may be slow at each step.
            if self._why or not self._was_slow:
                self.notices.append(f"the journal cannot be written ({why}); rows wait in {path}")
            self._was_slow = not self._why
            return second
        raise RecordError(
            f"{self.store.path} cannot be written: {why}; its second file neither: {'; '.join(problems)}"
        )

    def _leave(self) -> None:
        """Put every row into a second file, from the journal that is still open, and raise RecordError."""
        self._is_left = True
        rows: list[Row] = []
        problem = ""
        try:
            rows.extend(self.store.rows())
        except sqlite3.Error as error:
            problem = f", as far as it could be read ({error})"
        self._double([*rows, *self._waiting])
        path, second = self.store.path, self._second
        assert second is not None
        raise RecordError(
            f"{path} was {self._loss} while the run went on; everything so far is in {second.path}{problem}, "
            f"from which `bench runs repair {path.parent}` writes it again, and the run ends here"
        )

    def _look_around(self) -> None:
        """Fold the write-ahead log in, and look at the free space."""
        self._looked = Stopwatch()
        with suppress(OSError, sqlite3.Error):
            self.store.fold_in()
            disk = shutil.disk_usage(self.store.path.parent)
            is_short = disk.free < min(_SHORT, _SHORT_PART * disk.total)
            if is_short and not self.is_short:
                self.notices.append(f"the disk is nearly full ({disk.free >> 20} MB free): recordings stop")
            self.is_short = is_short

    def _stop(self) -> None:
        """Write in the caller's thread from now on, if the other one ends."""
        if self._thread is None:
            return
        wait = 0.0 if self._is_ending else _LAST_WAIT
        with self._changed:
            self._is_ending = True
            self._changed.notify_all()
        self._thread.join(wait)
        if self._thread.is_alive():
            self._why = "its disk does not answer"
        else:
            self._thread = None
