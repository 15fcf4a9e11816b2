"""A Rerun recording as two streams, to a file and to a live view, so that a stalled viewer cannot delay the file."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from bench.errors import ConfigurationError

Floats = npt.NDArray[np.float64]

LOOPBACK = "127.0.0.1"

_FLUSH_SECONDS = 0.5
"""Time after which a viewer has stalled; a twentieth of it is enough to see that it still has."""
_PORTS_TRIED = 50


class Recording:
    """One recording, whose streams carry the same `run_id`; used by one thread at a time.

    Without `path` there is no file, without `port` no live view; a port that is taken gives the next free one, 0 any.
    Raises a ConfigurationError if the file exists or cannot be made, or no port is free.
    """

    def __init__(self, run_id: str, title: str, path: Path | None, port: int | None) -> None:
        sinks: list[rr.FileSink | rr.GrpcServerSink] = []
        self.uri: str | None = None
        """Address for a viewer, None without a live view."""
        if path is not None:
            # Rerun would truncate the file.
            if path.exists():
                raise ConfigurationError(f"{path} exists already; a recording is never overwritten")
            if not path.parent.is_dir():
                raise ConfigurationError(f"{path}: there is no folder {path.parent}")
            sinks.append(rr.FileSink(path))
        if port is not None:
            server = rr.GrpcServerSink(bind_ip=LOOPBACK, port=free_port(port), server_memory_limit="256MiB")
            self.uri = server.uri
            sinks.append(server)
        self._streams: list[rr.RecordingStream] = []
        for sink in sinks:
            stream = rr.RecordingStream("bench", recording_id=run_id)
            try:
                stream.set_sinks(sink)
            except RuntimeError as error:
                raise ConfigurationError(f"the recording cannot be made: {error}") from error
            stream.send_recording_name(title)
            self._streams.append(stream)
        self._live = self._streams[-1] if port is not None else None
        self._file = self._streams[0] if path is not None else None
        self._unseen = 0

    def stop_file(self) -> None:
        """Complete the file now; the live view goes on."""
        if self._file in self._streams:
            self._streams.remove(self._file)
            self._file.disconnect()

    @property
    def viewer_keeps_up(self) -> bool:
        """Whether there is a live view and it is not suspended."""
        return self._live in self._streams

    def follow_viewer(self, entries: int) -> str:
        """Suspend the live view for the next `entries` entries if its viewer has stalled; never waits long.

        Returns what changed, for the log; empty if nothing did.
        """
        if self._live is None:
            return ""
        keeps_up = self.viewer_keeps_up
        try:
            # Waits for the server, which holds some thousand batches for each viewer, not for the viewer.
            self._live.flush(timeout_sec=_FLUSH_SECONDS if keeps_up else 0.05 * _FLUSH_SECONDS)
        except RuntimeError:
            self._unseen += entries
            if not keeps_up:
                return ""
            self._streams.remove(self._live)
            return "the viewer has stalled; the live view is suspended until it resumes"
        if keeps_up:
            return ""
        self._streams.append(self._live)
        unseen, self._unseen = self._unseen, 0
        return f"the viewer has resumed; {unseen} entries are missing in the live view"

    def send(
        self, path: str, times: list[rr.TimeColumn], columns: Iterable[rr.ComponentColumn], only: str = ""
    ) -> None:
        """Write columns of an entity at their times; `only` to the `file`, or `live` to viewers."""
        columns = list(columns)
        for stream in self._streams:
            if only in ("", "live" if stream is self._live else "file"):
                stream.send_columns(path, times, columns)

    def arrange(self, blueprint: rrb.Blueprint, *, in_file: bool) -> None:
        """Arrange the views anew; in the file as well where it is worth its bytes."""
        for stream in self._streams:
            if in_file or stream is self._live:
                stream.send_blueprint(blueprint)

    def send_vectors(self, path: str, times: list[rr.TimeColumn], vectors: Floats) -> None:
        """Write one vector a time, shape (times, components)."""
        columns = rr.Scalars.columns(scalars=vectors.ravel())
        self.send(path, times, columns.partition(np.full(len(vectors), vectors.shape[1])))

    def log(self, path: str, *what: rr.AsComponents) -> None:
        """Write what holds at all times."""
        for stream in self._streams:
            stream.log(path, *what, static=True)

    def set_property(self, name: str, values: Mapping[str, Any]) -> None:
        """Write plain values that the viewer shows as properties of the recording."""
        for stream in self._streams:
            stream.send_property(name, rr.AnyValues(**values))

    def close(self) -> None:
        """Complete the file, then let go of the viewers."""
        for stream in self._streams:
            stream.disconnect()
        if self._live is not None:
            self._live.disconnect()


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
