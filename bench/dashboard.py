"""The live view of a run and its .rrd file, both by Rerun, both derived from what the journal holds.

The control thread only puts what happened into a queue. One thread takes it out about once a second and
hands it to Rerun in columns, which costs a fiftieth of logging row by row; the same code rebuilds an .rrd
from a journal. A viewer connects to a server of this process, bound to the loopback address. A viewer that
hangs costs memory at the rate of the run's data (tens of MB an hour at most) and nothing else: neither the
control thread nor the file waits for it.

The queue is bounded. If Rerun itself stands still, because a disk does, telemetry is dropped beyond
`QUEUED_TICKS` entries and everything beyond `QUEUED_ENTRIES`; the loss is counted and said in the log of
the dashboard. Nothing of the record is lost by that: `rebuild` makes the whole .rrd from the journal.

What is recorded, on the timelines `t` (laboratory time) and `step`
--------------------------------------------------------------------
`/signals/QUANTITY`, `/readings/QUANTITY`
    One vector a unit: quick readings of each tick, and the reading of each step.
`/loop/data/path`, `/loop/data/now`
    Output against input: the line from each step to the next, and the last point.
`/plane/data/memory`, `/plane/data/input`, `/plane/density`
    The Preisach plane: the memory curve after each step, the input on the diagonal, the model's density.
`/state/phase`, `/state/run`, `/state/settling`
    Where the protocol stands, changes only.
`/events/KIND`, `/card`
    What happened, and the run card.
"""

from __future__ import annotations

import json
import math
import queue
import socket
import subprocess
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
import rerun_cli
from rerun.experimental import ViewerClient

from bench.clock import Stopwatch, WallClock
from bench.devices import Signal
from bench.errors import ConfigurationError, DataError
from bench.hysteresis import MemoryCurve
from bench.journal import Event, Record, StepRecord

QUEUED_TICKS = 20_000
"""Entries waiting for Rerun beyond which telemetry is dropped (about 10 MB)."""

QUEUED_ENTRIES = 60_000
"""Entries waiting for Rerun beyond which steps and events are dropped as well."""

_BATCH_ROWS = 200
_BATCH_SECONDS = 1.0
_CLOSE_SECONDS = 10.0
_PORTS_TRIED = 50
_REBUILD_ROWS = 4096
"""Rows of a chunk when a whole journal is at hand: fewer, larger chunks load faster."""

Floats = npt.NDArray[np.float64]
Colour = tuple[int, int, int]

_BACKGROUND: Colour = (17, 20, 24)
_INK: Colour = (214, 219, 226)
_FAINT: Colour = (58, 65, 74)
_RISING: Colour = (255, 122, 72)
_FALLING: Colour = (78, 160, 255)
_MARKER: Colour = (255, 236, 120)
_SETPOINT: Colour = (150, 158, 168)
_PALETTE: tuple[Colour, ...] = (
    (255, 122, 72),
    (78, 160, 255),
    (98, 208, 126),
    (214, 128, 255),
    (255, 206, 84),
    (64, 208, 206),
    (255, 128, 170),
    (178, 196, 98),
)
_STATES: Mapping[str, Colour] = {
    "running": (66, 140, 92),
    "paused": (190, 146, 44),
    "interlock": (206, 62, 58),
    "safe": (64, 112, 176),
    "completed": (66, 140, 92),
    "aborted": (190, 146, 44),
    "failed": (206, 62, 58),
    "settled": (66, 140, 92),
    "not settled": (206, 62, 58),
}
_STATE_OF_EVENT = {
    "pause": "paused",
    "resume": "running",
    "interlock": "interlock",
    "safe-state": "safe",
}
_QUANTITIES = {
    "°C": "temperature",
    "K": "temperature difference",
    "A": "current",
    "V": "voltage",
    "W": "power",
    "m": "position",
    "N": "force",
    "1/m": "curvature",
    "rad": "angle",
    "rad/s": "angular velocity",
    "Ω": "resistance",
    "1": "number",
}


@dataclass(frozen=True)
class DashboardLayout:
    """What the loop and the plane of a dashboard show; the `[dashboard]` table of a rig file.

    Attributes
    ----------
    title : str
        What the loop is, for its headline.
    input, output : str
        Names of the signals on the horizontal and the vertical axis of the loop; the input also drives
        the memory curve.
    input_range, output_range : tuple of float
        Ranges of the axes, in the units of the signals.
    plane : tuple of float
        Range of the Preisach plane, in the unit of the input.
    levels : int
        Number of intervals of the plane's lattice.

    Raises
    ------
    ConfigurationError
        If a range is empty or there is no interval.
    """

    title: str
    input: str
    output: str
    input_range: tuple[float, float]
    output_range: tuple[float, float]
    plane: tuple[float, float]
    levels: int

    def __post_init__(self) -> None:
        for key in ("input_range", "output_range", "plane"):
            low, high = getattr(self, key)
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ConfigurationError(f"dashboard: {key}: expected low < high, got {low} and {high}")
        if self.levels < 1:
            raise ConfigurationError(f"dashboard: levels: expected at least 1, got {self.levels}")

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Return the layout from its JSON form, `dataclasses.asdict` of it.

        Raises
        ------
        ConfigurationError
            If a key is missing, unknown, or not of its kind.
        """
        try:
            values = dict(document)
            for key in ("input_range", "output_range", "plane"):
                low, high = values[key]
                values[key] = (float(low), float(high))
            return cls(**values)
        except KeyError as error:
            raise ConfigurationError(f"dashboard: {error.args[0]} is missing") from None
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f"dashboard: {error}") from None


class Dashboard:
    """Shows a run while it goes on, and records it in an .rrd file.

    Every method is for the control thread and never waits, but for `close`, which waits a bounded time.

    Parameters
    ----------
    signals : sequence of Signal
        What is measured, in the order in which values will be handed over.
    layout : DashboardLayout or None
        What the loop and the plane show; None for a rig that has neither.
    run_id : str
        Identifier of the run; live view and file carry it.
    title : str
        Name of the run in the viewer.
    path : Path or None
        The .rrd file to write; its folder exists, the file does not.
    live : bool
        Whether a viewer can connect.
    card : str
        The run card, Markdown.
    properties : mapping
        Plain values that the viewer shows as properties of the recording.
    port : int
        Port of the loopback address for viewers; if it is taken, the next free one. 0 takes any.

    Raises
    ------
    ConfigurationError
        If the file exists, the layout names a signal that there is not, or no port is free.
    ValueError
        If there is neither a file nor a live view.
    """

    def __init__(
        self,
        signals: Sequence[Signal],
        layout: DashboardLayout | None,
        *,
        run_id: str,
        title: str,
        path: Path | None,
        live: bool,
        card: str,
        properties: Mapping[str, object],
        port: int = 9876,
    ) -> None:
        if path is None and not live:
            raise ValueError("a dashboard needs a file or a live view")
        self._writer = _Writer(signals, layout, run_id)
        sinks: list[rr.FileSink | rr.GrpcServerSink] = []
        self.uri: str | None = None
        """Address for a viewer, None without a live view."""
        if path is not None:
            sinks.append(_file_sink(path))
        if live:
            server = rr.GrpcServerSink(bind_ip="127.0.0.1", port=_free_port(port), server_memory_limit="256MiB")
            self.uri = server.uri
            sinks.append(server)
        self._writer.open(sinks, title, card, properties)
        self.dropped = 0
        """Entries that the dashboard did not show because Rerun stood still."""
        self._queue: queue.SimpleQueue[_Tick | StepRecord | Event | _Model | _End] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="dashboard", daemon=False)
        self._thread.start()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Show one tick of a hold: laboratory time in s, step number, one value a signal."""
        waiting = self._queue.qsize()
        if waiting >= QUEUED_TICKS:
            self.dropped += 1
            return
        self._queue.put((t, step, tuple(values)))
        if waiting == _BATCH_ROWS:
            self._wake.set()

    def step(self, record: StepRecord) -> None:
        """Show a finished step."""
        self._put(record)

    def event(self, event: Event) -> None:
        """Show something that happened."""
        self._put(event)

    def model(self, density: npt.ArrayLike, grid: npt.ArrayLike, name: str) -> None:
        """Show the density of a model under the memory curve, from now on.

        Parameters
        ----------
        density : array_like, shape (M, M)
            Row of the up-threshold α, column of the down-threshold β, in units of the output a squared
            unit of the input; what is below the diagonal is ignored.
        grid : array_like, shape (M + 1,)
            Edges of rows and columns, units of the input.
        name : str
            Name of the model.
        """
        self._put(_Model(name, np.array(density, dtype=np.float64), np.array(grid, dtype=np.float64)))

    def finish(self, status: str, reason: str) -> None:
        """Show how the run ended: `completed`, `aborted` or `failed`, and why."""
        self._put(_End(status, reason))

    def close(self) -> None:
        """Hand over what is queued and let go of file and viewers; waits a bounded time.

        With a viewer that hangs, Rerun may take some 20 s to give it up. That is not waited for; the file
        is complete before.
        """
        self._closing = True
        self._wake.set()
        self._thread.join(_CLOSE_SECONDS)

    def _put(self, entry: StepRecord | Event | _Model | _End) -> None:
        if self._queue.qsize() >= QUEUED_ENTRIES:
            self.dropped += 1
        else:
            self._queue.put(entry)

    def _work(self) -> None:
        reported = 0
        while not self._closing or not self._queue.empty():
            self._wake.wait(_BATCH_SECONDS)
            self._wake.clear()
            entries = [self._queue.get() for _ in range(self._queue.qsize())]
            if self.dropped > reported:
                lost, reported = self.dropped - reported, self.dropped
                text = f"Rerun stood still: {lost} entries are not shown; bench export rebuilds the .rrd"
                entries.append(Event(self._writer.t, "WARN", "dashboard", text))
            self._writer.write(entries)
        self._writer.close()


def rebuild(record: Record, path: Path) -> None:
    """Make the .rrd of a run from its journal.

    Parameters
    ----------
    record : Record
        The journal, of a finished run or not.
    path : Path
        The file to write; its folder exists, the file does not.

    Raises
    ------
    ConfigurationError
        If the file exists.
    DataError
        If the journal is damaged.
    """
    meta = record.meta
    document = meta.get("dashboard")
    try:
        layout = None if document is None else DashboardLayout.from_json(document)
        writer = _Writer(record.signals, layout, str(meta.get("run", record.path.parent.name)))
    except ConfigurationError as error:
        raise DataError(f"{record.path}: {error}") from error
    title = f"{meta.get('rig', 'run')} {meta.get('protocol', '')} {meta.get('run', '')}".strip()
    writer.open([_file_sink(path)], title, run_card(meta), card_properties(meta))
    try:
        telemetry = record.telemetry()
        writer.ticks(
            telemetry["t"],
            telemetry["step"].astype(np.int64),
            np.column_stack([telemetry[signal.name] for signal in record.signals]),
        )
        steps, events = list(record.step_records()), record.events()
        writer.steps(steps)
        finished = np.array([step.finished for step in steps])
        done = np.searchsorted(finished, [event.t for event in events], side="right")
        writer.events(events, [steps[n - 1].step + 1 if n else 0 for n in done])
        for name, _, model in record.models():
            found = _density(model)
            if found is not None:
                writer.model(_Model(name, *found))
        if "status" in meta:
            writer.end(_End(str(meta["status"]), str(meta.get("reason", ""))))
    finally:
        writer.close()
