"""The live view of a run: takes entries from the control thread and passes them to Rerun in a thread of its own."""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from bench.base import WallClock, print_plain, task_console
from bench.dashboard.entries import End, Entry, Part, Tick, densities_of, portions
from bench.dashboard.rerun_recording import is_whole
from bench.dashboard.writer import Writer
from bench.devices import Signal
from bench.identification import ModelFile
from bench.record import Event, StepRecord

QUEUED_TICKS = 20_000
"""Entries waiting for Rerun beyond which telemetry is dropped. Derivation: about 10 MB, at 0.5 kB an entry."""

QUEUED_ENTRIES = 60_000
"""Entries waiting for Rerun beyond which steps and events are dropped as well. Derivation: about 30 MB."""

CHUNK_ROWS = 4096
"""Most rows at once: the more, the faster a recording loads, but the longer it takes to turn them into columns.

Source: Rerun joins rows to chunks of up to 4096 (`RERUN_CHUNK_MAX_ROWS`).
"""

_FILE_SECONDS = 300.0
_PART_OF_RUN = 0.25
"""Longest time until entries are in the file, s of wall-clock time, and as a part of the run so far.

Derivation: a bench that dies leaves out five minutes or a quarter of a run at most; the journal has all of it.
"""

_BATCH_ROWS = 200
_BATCH_SECONDS = 1.0
"""Entries, and wall-clock time in s, after which Rerun is given what came.

Source: Nielsen, *Usability Engineering*, 1993, section 5.5: what is late by 1 s does not interrupt a thought.
"""
_CLOSE_SECONDS = 5.0
"""Longest wait at the end of a run, s. Derivation: 3 s until a stalled file is given up, and 2 s for the queue."""


class Dashboard:
    """Shows a run while it goes on, and records it in an .rrd file; an `Observer` of the engine.

    Every method is for the control thread and never waits, except `close`, which waits a bounded time.

    Parameters
    ----------
    signals : sequence of Signal
        What is measured, in the order of the values; those of the controllers too, if the run has any.
    meta : mapping
        The run's metadata, as in its journal: layout, controlled signal, run card.
    path : Path or None
        The .rrd file to write; its folder exists, the file does not.
    live : bool
        Whether a viewer can connect.
    port : int
        Port of the loopback address for viewers; if it is taken, the next free one. 0 takes any.
    models : sequence of ModelFile
        Models whose densities are shown under the memory curve, and whose prediction bands beside the readings.

    Raises
    ------
    ConfigurationError
        If the file exists, the layout or `controls` names a signal that does not exist, or no port is free.
    ValueError
        If there is neither a file nor a live view.
    """

    def __init__(
        self,
        signals: Sequence[Signal],
        meta: Mapping[str, Any],
        *,
        path: Path | None,
        live: bool,
        port: int = 9876,
        models: Sequence[ModelFile] = (),
    ) -> None:
        if path is None and not live:
            raise ValueError("a dashboard needs a file or a live view")
        self._path = path
        self._file: Writer | None = None
        self._view: Writer | None = None
        if path is not None:
            self._file = Writer(signals, meta, models)
            self._file.open(path, None)
        if live:
            self._view = Writer(signals, meta, models)
            self._view.open(None, port)
        self.uri = None if self._view is None else self._view.recording.uri
        """Address for a viewer, None without a live view."""
        # Each portion of a file costs memory until it is complete: the longer the run, the larger they are.
        self._for_file: list[Entry] = []
        self._clock = WallClock()
        self._written_at = 0.0
        # One counter a thread, as adding is not atomic.
        self._not_queued = self._not_written = self._reported = 0
        self._queue: queue.SimpleQueue[Entry] = queue.SimpleQueue()
        for density in densities_of(models):
            self._queue.put(density)
        self._wake = threading.Event()
        self._closing = self._recording_stops = self._is_complete = self._is_said = False
        self._thread = threading.Thread(target=self._work, name="dashboard", daemon=False)
        self._thread.start()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Show one tick of a hold: laboratory time in s, step number, one value a signal."""
        self._put(Tick(t, step, tuple(values)), QUEUED_TICKS)

    def step(self, record: StepRecord) -> None:
        """Show a finished step."""
        self._put(record, QUEUED_ENTRIES)

    def event(self, event: Event) -> None:
        """Show something that happened."""
        self._put(event, QUEUED_ENTRIES)

    def stop_recording(self) -> None:
        """Write no more into the .rrd file, as the journal needs the space; the live view goes on."""
        self._recording_stops = True

    def finish(self, status: str, reason: str, lateness: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Show how the run ended: `completed`, `aborted` or `failed`, and why; and how late its loops were."""
        self._put(End(status, reason, lateness), QUEUED_ENTRIES)

    def close(self) -> None:
        """Hand over what is queued and let go of file and viewers; waits a bounded time.

        The file is complete first. Rerun takes some 30 s to give up a stalled viewer; the thread that
        waits for that ends by itself, later.
        """
        self._closing = True
        self._wake.set()
        self._thread.join(_CLOSE_SECONDS)
        if self._path is not None and not self._is_said and self._is_incomplete(self._path):
            self._is_said = True
            print_plain(
                task_console(),
                f"warning: the recording {self._path} is incomplete; bench runs export {self._path.parent} "
                "--format rrd --out DIR rebuilds it from the journal",
            )

    def _is_incomplete(self, path: Path) -> bool:
        """Return whether the file lacks something, as far as Rerun has written it by now."""
        return self._recording_stops or (self._is_complete and not is_whole(path))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def dropped(self) -> int:
        """Number of entries that are not shown because Rerun was stalled or refused them."""
        return self._not_queued + self._not_written

    @property
    def viewer_keeps_up(self) -> bool:
        """Whether there is a live view and no viewer has stalled."""
        return self._view is not None and self._view.recording.is_written

    def _put(self, entry: Entry, most: int) -> None:
        waiting = self._queue.qsize()
        if waiting >= most:
            self._not_queued += 1
            return
        self._queue.put(entry)
        if waiting >= _BATCH_ROWS and not self._wake.is_set():
            self._wake.set()

    def _work(self) -> None:
        while not self._closing:
            self._wake.wait(_BATCH_SECONDS)
            self._wake.clear()
            self._hand_over()
        # What came between the last look and the closing.
        self._hand_over()
        if self._file is not None:
            self._complete_file(self._file)
        if self._view is not None:
            self._view.recording.close()

    def _hand_over(self) -> None:
        # In portions, so that turning them into columns does not keep the interpreter from other threads.
        while waiting := min(self._queue.qsize(), CHUNK_ROWS):
            entries = [self._queue.get() for _ in range(waiting)]
            if self._view is not None and (change := self._view.recording.follow_viewer(len(entries))):
                self._warn(change)
            if self._view is not None:
                self._write(self._view, entries)
                self._view.arrange()
            if self._file is not None and self._file.recording.is_written:
                self._for_file += entries
                now = self._clock.now()
                due = self._written_at + min(_FILE_SECONDS, max(_BATCH_SECONDS, _PART_OF_RUN * now))
                if len(self._for_file) >= CHUNK_ROWS or now >= due:
                    self._write_file(self._file)
            self._warn_of_missing()
        if self._recording_stops and self._file is not None:
            self._complete_file(self._file)

    def _write_file(self, writer: Writer) -> None:
        entries, self._for_file = self._for_file, []
        for portion in portions(entries, CHUNK_ROWS):
            self._write(writer, portion)
        self._written_at = self._clock.now()

    def _complete_file(self, writer: Writer) -> None:
        if writer.recording.is_written:
            self._write_file(writer)
            self._warn_of_missing()
            writer.arrange()
            writer.recording.close()
            self._is_complete = True

    def _write(self, writer: Writer, entries: Sequence[Entry | Part]) -> None:
        try:
            writer.write(entries)
        # After any failure in the view, the run goes on, and so does the rest of the view.
        except Exception:
            self._not_written += len(entries)

    def _warn_of_missing(self) -> None:
        if (missing := self.dropped - self._reported) > 0:
            self._warn(f"{missing} entries are missing: Rerun did not take them; the journal has them")
            self._reported += missing

    def _warn(self, text: str) -> None:
        for writer in (self._file, self._view):
            if writer is not None:
                writer.warn(text)
