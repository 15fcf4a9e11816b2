"""Writes a journal in a thread of its own, so that a slow disk does not hold up the control thread."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from bench.base import RecordError, Stopwatch
from bench.record.keeping import Keeper
from bench.record.mirror import Mirror, elsewhere
from bench.record.rows import JournalEntry, joined

LONGEST_UNWRITTEN = 0.1
"""Wall-clock time after which a tick is committed, s."""

_IDLE = 5.0
_LAST_WAIT = 30.0
"""Wall-clock time that the end of a run waits for the disk, s."""


class Background:
    """Passes rows on to a keeper in a thread of its own.

    Parameters
    ----------
    keeper : Keeper
        It is used by that thread only, until `stop`.
    patience : float
        Longest time that a call waits for the disk, s of wall-clock time. After it the rows go into a file in the
        folder for temporary files, which may be on another disk.
    """

    def __init__(self, keeper: Keeper, patience: float) -> None:
        self._keeper = keeper
        self._patience = patience
        self._changed = threading.Condition()
        self._queue: list[JournalEntry] = []
        self._put = self._done = self._late = 0
        """Rows so far: handed over, durable, and in the file for those that are late."""
        self._urgent = self._stopping = False
        self.failure: Exception | None = None
        self._aside: Mirror | None = None
        self._thread = threading.Thread(target=self._work, name="journal", daemon=True)
        self._thread.start()

    def keep_soon(self, entries: Sequence[JournalEntry]) -> None:
        """Have rows made durable within 0.1 s."""
        with self._changed:
            first = not self._queue
            self._queue += entries
            self._put += len(entries)
            if first:
                self._changed.notify_all()
            self._raise_failure()

    def keep(self, entries: Sequence[JournalEntry]) -> None:
        """Make rows durable, and those before them."""
        with self._changed:
            self._queue += entries
            self._put += len(entries)
            self._urgent = True
            self._changed.notify_all()
            goal = self._put
            is_done = self._changed.wait_for(lambda: self._done >= goal or self.failure, self._patience)
            self._raise_failure()
            if is_done:
                return
            missing = self._queue[max(0, self._late - self._done) :]
        self._keep_aside(missing)
        self._late = goal

    def stop(self) -> bool:
        """Have everything made durable and end the thread; return whether the disk has let it.

        What the thread could not do is in `failure` then.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join(_LAST_WAIT)
        if self._thread.is_alive():
            return False
        if self._aside is not None:
            self._keeper.spare.append(self._aside)
        return True

    def _raise_failure(self) -> None:
        failure, self.failure = self.failure, None
        if failure is not None:
            raise failure

    def _keep_aside(self, entries: Sequence[JournalEntry]) -> None:
        try:
            if self._aside is None:
                _, path = elsewhere(self._keeper.store.path)
                self._aside = Mirror(path, self._keeper.identity)
                self._keeper.notices.append(f"the disk of the journal is slow; rows that wait are in {path} as well")
            self._aside.append(entries)
            self._aside.sync()
        except OSError as error:
            raise RecordError(f"{self._keeper.store.path} is not written in time, nor {error.filename}") from None

    def _work(self) -> None:
        since = Stopwatch()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._stopping, _IDLE)
                # Ticks of a fast loop are written together.
                rest = LONGEST_UNWRITTEN - since.seconds()
                if self._queue and rest > 0:
                    self._changed.wait_for(lambda: self._urgent or self._stopping, rest)
                self._urgent = False
                batch = list(self._queue)
                if self._stopping and not batch:
                    return
            failure: Exception | None = None
            try:
                if batch:
                    self._keeper.keep(joined(batch))
                else:
                    self._keeper.fold_in()
            # Raised in the run's own thread.
            except Exception as error:
                failure = error
            since = Stopwatch()
            with self._changed:
                del self._queue[: len(batch)]
                self._done += len(batch)
                self.failure = self.failure or failure
                self._changed.notify_all()
