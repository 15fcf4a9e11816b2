"""A Rerun recording: one stream to a file, another to viewers, so that a stalled viewer cannot delay the file."""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import socket
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from bench.base import ConfigurationError, Floats, WallClock

Ints = npt.NDArray[np.int64]

LOOPBACK = "127.0.0.1"

_END = b"RRF2FOOT"
"""In the last bytes of a file that was written to its end."""

_END_BYTES = 32
"""Source: an .rrd file ends in a frame of 32 bytes with that tag."""

_STALLED_SECONDS = 3.0
"""Wall-clock time without growth after which a file that is completed is given up, s.

Derivation: less than a run waits for the end of its dashboard (`_CLOSE_SECONDS` of `live`).
"""

_LOOK_SECONDS = 0.05
"""Wall-clock time between two looks at that, s. Derivation: sixty looks."""

_FLUSH_SECONDS = 0.5
"""Time after which a viewer has stalled; a twentieth of it is enough to see that it still has.

Derivation: half of the time in which the queue is looked at (`_BATCH_SECONDS` of `live`).
"""
_PORTS_TRIED = 50
"""Derivation: one for each bench on a machine, which bears fewer."""


class RerunRecording:
    """One stream of a recording, into a file or to the viewers that connect; used by one thread at a time.

    Streams of one `run_id` are the same recording to a viewer. One with a `path` goes into a file, one with a `port`
    to viewers; a port that is taken gives the next free one, 0 any. Raises a ConfigurationError if the file exists or
    cannot be made, or no port is free.
    """

    def __init__(self, run_id: str, title: str, path: Path | None, port: int | None) -> None:
        self.uri: str | None = None
        """Address for a viewer, None for a file."""
        self._path = path
        self._stream = rr.RecordingStream(_application(run_id), recording_id=run_id)
        try:
            self._stream.set_sinks(_file(path) if path is not None else self._server(port or 0))
        except RuntimeError as error:
            raise ConfigurationError(f"the recording cannot be made: {error}") from error
        self._stream.send_recording_name(title)
        self._is_written = True
        self._unseen = 0

    def _server(self, port: int) -> rr.GrpcServerSink:
        server = rr.GrpcServerSink(bind_ip=LOOPBACK, port=free_port(port), server_memory_limit="256MiB")
        self.uri = server.uri
        return server

    @property
    def is_written(self) -> bool:
        """Whether what is sent is taken: the file is not complete, the viewer keeps up."""
        return self._is_written

    def follow_viewer(self, entries: int) -> str:
        """Suspend the stream for the next `entries` entries if its viewer has stalled; never waits long.

        Returns what changed, for the log; empty if nothing did.
        """
        keeps_up = self._is_written
        try:
            # Waits for the server, which holds some thousand batches for each viewer, not for the viewer.
            self._stream.flush(timeout_sec=_FLUSH_SECONDS if keeps_up else 0.05 * _FLUSH_SECONDS)
        except RuntimeError:
            self._unseen += entries
            if not keeps_up:
                return ""
            self._is_written = False
            return "the viewer has stalled; the live view is suspended until it resumes"
        if keeps_up:
            return ""
        self._is_written = True
        unseen, self._unseen = self._unseen, 0
        return f"the viewer has resumed; {unseen} entries are missing in the live view"

    def send(self, path: str, times: list[rr.TimeColumn], columns: Iterable[rr.ComponentColumn]) -> None:
        """Write columns of an entity at their times."""
        if self._is_written:
            self._stream.send_columns(path, times, columns)

    def send_vectors(self, path: str, times: list[rr.TimeColumn], vectors: Floats) -> None:
        """Write one vector a time, shape (times, components)."""
        columns = rr.Scalars.columns(scalars=vectors.ravel())
        self.send(path, times, columns.partition(np.full(len(vectors), vectors.shape[1])))

    def log(self, path: str, *what: rr.AsComponents) -> None:
        """Write what holds at all times."""
        if self._is_written:
            self._stream.log(path, *what, static=True)

    def arrange(self, blueprint: rrb.Blueprint) -> None:
        """Arrange the views again."""
        if self._is_written:
            self._stream.send_blueprint(blueprint)

    def set_property(self, name: str, values: Mapping[str, Any]) -> None:
        """Write plain values that the viewer shows as properties of the recording."""
        if self._is_written:
            self._stream.send_property(name, rr.AnyValues(**values))

    def close(self) -> None:
        """Complete the file, or let go of the viewers; a file that does not grow any more is given up."""
        self._is_written = False
        if self._path is None:
            self._stream.disconnect()
            return
        # Rerun waits for ever for its writer of the file, if a full disk has ended that.
        work = threading.Thread(target=self._stream.disconnect, name="recording", daemon=True)
        work.start()
        clock, size, grown = WallClock(), -1, 0.0
        while work.is_alive() and clock.now() < grown + _STALLED_SECONDS:
            work.join(_LOOK_SECONDS)
            now = self._path.stat().st_size if self._path.exists() else -1
            if now != size:
                size, grown = now, clock.now()
        if work.is_alive():
            # It would wait for the same at the end of the process.
            atexit.unregister(rr.rerun_shutdown)


def is_whole(path: Path) -> bool:
    """Return whether a file was written to its end; Rerun reports a full disk in its log only."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _END_BYTES))
            return _END in file.read()
    except OSError:
        return False


def _application(run_id: str) -> str:
    """Return a name that Rerun takes for an application: of each run, as a viewer keeps one arrangement for each."""
    digest = hashlib.sha256(run_id.encode()).hexdigest()[:8]
    return f"bench {re.sub('[^A-Za-z0-9]+', '-', run_id)[:40]} {digest}"


def _file(path: Path) -> rr.FileSink:
    # Rerun would truncate it.
    if path.exists():
        raise ConfigurationError(f"{path} exists already; a recording is never overwritten")
    if not path.parent.is_dir():
        raise ConfigurationError(f"{path}: there is no folder {path.parent}")
    return rr.FileSink(path)


def times(t: npt.ArrayLike, step: npt.ArrayLike) -> list[rr.TimeColumn]:
    """Return the timelines `t` (laboratory time, s) and `step` of a batch."""
    nanoseconds = np.round(np.asarray(t, dtype=np.float64) * 1e9).astype("timedelta64[ns]")
    return [
        rr.TimeColumn("t", duration=nanoseconds),
        rr.TimeColumn("step", sequence=np.asarray(step, dtype=np.int64)),
    ]


def free_port(first: int) -> int:
    """Return `first` or the next port of the loopback address that is free; for 0, any free port."""
    # Rerun itself does not report that a port is taken, nor which one it took for 0.
    for port in range(first, min(first + _PORTS_TRIED, 65536)) if first else (0,):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise ConfigurationError(f"no port of {LOOPBACK} from {first} to {first + _PORTS_TRIED - 1} is free")
