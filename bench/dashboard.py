"""The live view of a run and its .rrd file, both by Rerun, both derived from what the journal holds.

The control thread only puts what happened into a queue. One thread takes it out about once a second and
hands it to Rerun in columns, which costs a twentieth of logging row by row; the same code rebuilds an .rrd
from a journal. A viewer connects to a server of this process, bound to the loopback address.

File and live view are two streams of one recording, so that a viewer that hangs cannot delay the file.
Rerun keeps what such a viewer does not take, some 8 kB for each batch of a quantity, until its channel is
full; from then on the live view is left out until the viewer moves again, and the log says so.

The queue is bounded, too. If Rerun itself stands still, because a disk does, telemetry is dropped beyond
`QUEUED_TICKS` entries and everything beyond `QUEUED_ENTRIES`; the log says how much. Nothing of the record
is lost by any of this: `rebuild` makes the whole .rrd from the journal.

What is recorded, on the timelines `t` (laboratory time) and `step`
--------------------------------------------------------------------
`/signals/QUANTITY`, `/readings/QUANTITY`
    One vector a unit: quick readings of each tick, and the reading of each step.
`/control/tracking`, `/control/error`, `/control/disturbance`
    Of a run under control, one vector each: reference, predicted output and output; output less reference; the
    estimated disturbance. Each has a band of two standard deviations of that estimate. nan while no controller
    is at work.
`/loop/data/path`, `/loop/data/now`
    Output against input: the line from each point to the next, and the last point. Further loops of the rig are
    `/loops/0`, `/loops/1` ...
`/plane/data/memory`, `/plane/data/input`, `/plane/density`
    The Preisach plane: the memory curve at each point, the input on the diagonal, the model's density.
`/planes/NAME/density`
    A density over another input, on a plane of its own, which has no memory curve: the second stage of a two-stage
    model is `H2`, and so on after Zhang and Yip 2017.
`/state/phase`, `/state/run`
    Where the protocol stands: changes only.
`/events`, `/card`
    What happened, and the run card.

The points of loops and plane are the readings of the steps and, while a controller is at work, the ticks. Every
tick moves the memory, but a point is drawn only if it is `_REDRAW_SECONDS` after the last and can be told from
it with the eye; the line to it leads through what was left out.
"""

from __future__ import annotations

import math
import queue
import socket
import subprocess
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
import rerun_cli
from rerun.experimental import ViewerClient

from bench.clock import WallClock
from bench.devices import Signal
from bench.errors import ConfigurationError, DataError
from bench.hysteresis import MemoryCurve
from bench.journal import Event, Record, StepRecord
from bench.protocol import TRACES
from bench.results.model_file import is_model, parse_model
from bench.runs import run_card

QUEUED_TICKS = 20_000
"""Entries waiting for Rerun beyond which telemetry is dropped (about 10 MB)."""

QUEUED_ENTRIES = 60_000
"""Entries waiting for Rerun beyond which steps and events are dropped as well."""

_BATCH_ROWS = 200
_BATCH_SECONDS = 1.0
_CLOSE_SECONDS = 5.0
_FLUSH_SECONDS = 0.5
"""After which a viewer hangs; the twentieth of it is enough to see that it still does."""
_PORTS_TRIED = 50
_CHUNK_ROWS = 4096
"""Most rows at once: the more, the faster a recording loads, but the longer they take to turn into columns."""

_VIEWER_START_SECONDS = 30.0
_VIEWER_SETTLE_SECONDS = 6.0
_LOOPBACK = "127.0.0.1"
_WIDTH = 1.15
"""Width of the drawn loop and plane where their height is 1."""

_REDRAW_SECONDS = 0.1
_VISIBLE = 0.002
"""Part of an axis that the eye can tell; a controller at its target moves by less."""

_LOOPS_IN_A_ROW = 3

_ARGUMENT_STAGES = ("H2", "H5")
"""Stages whose input is the force less what the voltage makes of it, which no signal measures."""

_CLOSE = 0.01
"""Part of the output's range that the close view of the error shows to either side of none."""

_TRACE_NAMES = tuple(signal.name for signal in TRACES)

Floats = npt.NDArray[np.float64]
Colour = tuple[int, int, int]

_BACKGROUND: Colour = (17, 20, 24)
_INK: Colour = (214, 219, 226)
_FAINT: Colour = (58, 65, 74)
_RISING: Colour = (255, 122, 72)
_FALLING: Colour = (78, 160, 255)
_MARKER: Colour = (150, 248, 228)
_SETPOINT: Colour = (150, 158, 168)
_OUTPUT: Colour = (255, 122, 72)
_PREDICTED: Colour = (150, 110, 190)
_ERROR: Colour = (255, 206, 84)
_DISTURBANCE: Colour = (64, 208, 206)
_BAND: Colour = (122, 132, 148)
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
_PHASE_COLOURS: tuple[Colour, ...] = (
    (58, 92, 138),
    (52, 116, 122),
    (104, 84, 140),
    (74, 112, 78),
    (128, 96, 62),
    (122, 74, 104),
)
_RUNNING = "running"
_NOT_SETTLED = "not settled"
_STATES: Mapping[str, Colour] = {
    _RUNNING: (66, 140, 92),
    "paused": (190, 146, 44),
    "interlock": (206, 62, 58),
    "safe": (64, 112, 176),
    "completed": (66, 140, 92),
    "aborted": (190, 146, 44),
    "failed": (206, 62, 58),
    _NOT_SETTLED: (206, 118, 52),
}
_DENSITY_COLOURS: tuple[tuple[float, Colour], ...] = (
    (-1.0, (92, 190, 255)),
    (-0.4, (36, 92, 168)),
    (0.0, (28, 33, 39)),
    (0.25, (84, 34, 92)),
    (0.6, (206, 66, 82)),
    (1.0, (255, 226, 138)),
)
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
class LoopLayout:
    """What a loop shows.

    Attributes
    ----------
    input, output : str
        Names of the signals on the horizontal and the vertical axis.
    input_range, output_range : tuple of float
        Ranges of the axes, in the units of the signals.
    """

    input: str
    output: str
    input_range: tuple[float, float]
    output_range: tuple[float, float]


@dataclass(frozen=True)
class DashboardLayout:
    """What the loops and the plane of a dashboard show; the `[dashboard]` table of a rig file.

    Attributes
    ----------
    title : str
        What the loop is, for its headline; of several, each is named after its signals.
    input, output : str
        Names of the signals on the horizontal and the vertical axis of the loop; the input also drives
        the memory curve.
    input_range, output_range : tuple of float
        Ranges of the axes, in the units of the signals.
    plane : tuple of float
        Range of the Preisach plane, in the unit of the input.
    levels : int
        Number of intervals of the plane's lattice.
    loops : tuple of LoopLayout
        Further loops; the tables that a journal has of them become such.

    Raises
    ------
    ConfigurationError
        If a range is empty or there is no interval.
    TypeError
        If the table of a further loop lacks a key, or has an unknown one.
    """

    title: str
    input: str
    output: str
    input_range: tuple[float, float]
    output_range: tuple[float, float]
    plane: tuple[float, float]
    levels: int
    loops: tuple[LoopLayout, ...] = ()

    def __post_init__(self) -> None:
        loops = tuple(loop if isinstance(loop, LoopLayout) else LoopLayout(**loop) for loop in self.loops)
        object.__setattr__(self, "loops", loops)
        ranges = {"plane": self.plane}
        for prefix, loop in self.all_loops.items():
            ranges |= {f"{prefix}input_range": loop.input_range, f"{prefix}output_range": loop.output_range}
        for key, (low, high) in ranges.items():
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ConfigurationError(f"dashboard: {key}: expected low < high, got {low} and {high}")
        if self.levels < 1:
            raise ConfigurationError(f"dashboard: levels: expected at least 1, got {self.levels}")

    @property
    def all_loops(self) -> dict[str, LoopLayout]:
        """The first loop and the further ones, by what their keys begin with."""
        first = LoopLayout(self.input, self.output, self.input_range, self.output_range)
        return {"": first} | {f"loops.{i}.": loop for i, loop in enumerate(self.loops)}


class Dashboard:
    """Shows a run while it goes on, and records it in an .rrd file.

    Every method is for the control thread and never waits, but for `close`, which waits a bounded time.

    Parameters
    ----------
    signals : sequence of Signal
        What is measured, in the order in which values will be handed over.
    layout : DashboardLayout or None
        What the loops and the plane show; None for a rig that has neither.
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
    controls : str
        Name of the signal that the run's controllers control, empty if there are none; their traces are then
        among the signals.
    port : int
        Port of the loopback address for viewers; if it is taken, the next free one. 0 takes any.

    Raises
    ------
    ConfigurationError
        If the file exists, the layout or `controls` names a signal that there is not, or no port is free.
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
        controls: str = "",
        port: int = 9876,
    ) -> None:
        if path is None and not live:
            raise ValueError("a dashboard needs a file or a live view")
        self._writer = _Writer(signals, layout, controls, run_id)
        self.uri: str | None = None
        """Address for a viewer, None without a live view."""
        server = None
        if live:
            server = rr.GrpcServerSink(bind_ip=_LOOPBACK, port=_free_port(port), server_memory_limit="256MiB")
            self.uri = server.uri
        file = None if path is None else _file_sink(path)
        self._writer.open(file, server, title, card, properties)
        # One counter a thread, as adding is not atomic.
        self._not_queued = self._not_written = self._reported = 0
        self._queue: queue.SimpleQueue[_Entry] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="dashboard", daemon=False)
        self._thread.start()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Show one tick of a hold: laboratory time in s, step number, one value a signal."""
        self._put((t, step, tuple(values)), QUEUED_TICKS)

    def step(self, record: StepRecord) -> None:
        """Show a finished step."""
        self._put(record, QUEUED_ENTRIES)

    def event(self, event: Event) -> None:
        """Show something that happened."""
        self._put(event, QUEUED_ENTRIES)

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
        model = _Model(name, np.array(density, dtype=np.float64), np.array(grid, dtype=np.float64))
        self._put(model, QUEUED_ENTRIES)

    def finish(self, status: str, reason: str) -> None:
        """Show how the run ended: `completed`, `aborted` or `failed`, and why."""
        self._put(_End(status, reason), QUEUED_ENTRIES)

    def close(self) -> None:
        """Hand over what is queued and let go of file and viewers; waits a bounded time.

        The file is complete first. Rerun takes some 30 s to give up a viewer that hangs; the thread that
        waits for that ends by itself, later.
        """
        self._closing = True
        self._wake.set()
        self._thread.join(_CLOSE_SECONDS)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def dropped(self) -> int:
        """Number of entries that the dashboard does not show because Rerun stood still or refused them."""
        return self._not_queued + self._not_written

    @property
    def viewer_keeps_up(self) -> bool:
        """Whether the live view is told everything, as no viewer hangs; false without a live view."""
        return self._writer.viewer_keeps_up

    def _put(self, entry: _Entry, most: int) -> None:
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
        self._writer.close()

    def _hand_over(self) -> None:
        # In portions, so that turning them into columns does not keep the interpreter from other threads.
        while waiting := min(self._queue.qsize(), _CHUNK_ROWS):
            entries = [self._queue.get() for _ in range(waiting)]
            try:
                self._writer.follow_viewer(len(entries))
                self._writer.write(entries)
                if (missing := self.dropped - self._reported) > 0:
                    self._writer.warn(f"{missing} entries are missing: Rerun did not take them; the journal has them")
                    self._reported += missing
            # Whatever goes wrong with the view, the run goes on, and so does the rest of the view.
            except Exception:
                self._not_written += len(entries)


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
    try:
        table = meta.get("dashboard")
        layout = DashboardLayout(title=meta["rig_title"], **table) if table else None
        models = list(_densities(record))
        writer = _Writer(record.signals, layout, meta.get("controls", ""), str(meta["run"]), models)
        card, title = run_card(meta), f"{meta['rig_title']}: {meta['protocol']}"
        properties = {key: meta[key] for key in ("rig", "protocol", "seed")}
    except (ConfigurationError, KeyError, TypeError) as error:
        raise DataError(f"{record.path} does not say what its dashboard was: {error}") from error
    writer.open(_file_sink(path), None, title, card, properties)
    try:
        entries = _entries(record)
        for start in range(0, len(entries), _CHUNK_ROWS):
            writer.write(entries[start : start + _CHUNK_ROWS])
        writer.write(models)
        if "status" in meta:
            writer.write([_End(str(meta["status"]), str(meta.get("reason", "")))])
    finally:
        writer.close()


def picture(rrd: Path, png: Path, *, at: float | None = None, size: tuple[int, int] = (1600, 1000)) -> list[str]:
    """Draw what a viewer shows of an .rrd file, without a screen.

    Parameters
    ----------
    rrd : Path
        The recording.
    png : Path
        The picture to write.
    at : float or None
        Laboratory time in s to put the cursor at; None for the end.
    size : tuple of int
        Width and height, pixels.

    Returns
    -------
    list of str
        What the views complain of; empty if all is well.

    Raises
    ------
    DataError
        If there is no such recording.
    ConfigurationError
        If the viewer does not start, for want of a graphics driver for instance.
    """
    if not rrd.is_file():
        raise DataError(f"there is no recording {rrd}")
    port = _free_port(0)
    # The console script is a wrapper that would leave its viewer behind, and a viewer that the SDK spawns
    # listens to the whole network.
    command = [Path(rerun_cli.__file__).parent / "rerun", "--headless", "--hide-welcome-screen"]
    options = ["--bind", _LOOPBACK, "--port", str(port), "--window-size", f"{size[0]}x{size[1]}"]
    viewer = subprocess.Popen(  # noqa: S603 - our own arguments
        [*map(str, command), *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    clock = WallClock()
    try:
        while not _listens(port):
            if viewer.poll() is not None or clock.now() > _VIEWER_START_SECONDS:
                raise ConfigurationError(
                    "Rerun's viewer does not start; without a screen it needs a Vulkan driver, such as the "
                    "one of the packages mesa-vulkan-drivers and libvulkan1"
                )
            clock.sleep(0.1)
        client = ViewerClient.connect(f"rerun+http://{_LOOPBACK}:{port}/proxy")
        client.open(str(rrd.absolute()))
        if at is None:
            client.set_time("t", play_state="following")
        else:
            client.set_time("t", duration=at, play_state="paused")
        # The viewer draws while data still arrive, and does not say when it has them all.
        clock.sleep(_VIEWER_SETTLE_SECONDS)
        client.save_screenshot(str(png.absolute()))
        return [
            f"{view.name}: {report.severity}: {report.summary}"
            for view in client.get_state().views
            for report in view.reports
        ]
    finally:
        viewer.terminate()
        viewer.wait()


@dataclass(frozen=True)
class _Model:
    """A density, as `Dashboard.model` takes it; `stage` of a coupled model, `input_unit` if it is known."""

    name: str
    density: Floats
    grid: Floats
    stage: str = ""
    input_unit: str = ""
    output_unit: str = ""


@dataclass(frozen=True)
class _End:
    status: str
    reason: str


_Tick = tuple[float, int, Sequence[float]]
_Entry = _Tick | StepRecord | Event | _Model | _End


class _Writer:
    """Turns what happened into Rerun's columns; used by one thread at a time."""

    def __init__(
        self,
        signals: Sequence[Signal],
        layout: DashboardLayout | None,
        controls: str,
        run_id: str,
        models: Sequence[_Model] = (),
    ) -> None:
        self._signals = tuple(signals)
        self._layout = layout
        self._loops = [] if layout is None else _Loop.all_of(layout, signals)
        ranges: dict[str, tuple[float, float]] = {}
        for loop in self._loops:
            ranges.setdefault(loop.layout.input, loop.layout.input_range)
            ranges.setdefault(loop.layout.output, loop.layout.output_range)
        # Planes beside that of the first input, for which the models that are known from the start ask.
        self._planes = {path: model for model in models if (path := self._plane_of(model)) != "plane"}
        self._control = _Control.of(signals, controls, ranges.get(controls)) if controls else None
        self._groups = _group_by_unit(self._signals, ranges, _TRACE_NAMES if controls else ())
        self._run_id = run_id
        self._streams: list[rr.RecordingStream] = []
        self._live: rr.RecordingStream | None = None
        self._unseen = 0
        self._memory: MemoryCurve | None = None
        self._states: dict[str, str] = {}
        self._phases: list[str] = []
        self._step = 0
        self._t = 0.0

    def open(
        self,
        file: rr.FileSink | None,
        server: rr.GrpcServerSink | None,
        title: str,
        card: str,
        properties: Mapping[str, Any],
    ) -> None:
        """Connect, and write everything that does not change."""
        blueprint = self._blueprint()
        for sink in (file, server):
            if sink is None:
                continue
            stream = rr.RecordingStream("bench", recording_id=self._run_id)
            try:
                stream.set_sinks(sink, default_blueprint=blueprint)
            except RuntimeError as error:
                raise ConfigurationError(f"the recording cannot be made: {error}") from error
            stream.send_recording_name(title)
            self._streams.append(stream)
            if sink is server:
                self._live = stream
        self._set_property("bench", properties)
        self._log("card", rr.TextDocument(card, media_type=rr.MediaType.MARKDOWN))
        for group in self._groups:
            for kind in ("signals", "readings"):
                self._log(f"{kind}/{group.path}", group.style)
        if self._control is not None:
            for name, style in self._control.styles().items():
                self._log(f"control/{name}", style)
        self._log("state/run", rr.StateConfiguration(values=list(_STATES), colors=list(_STATES.values())))
        for loop in self._loops:
            self._draw_frame(loop.path, _Frame.of_loop(loop.layout, self._signals[loop.x], self._signals[loop.y]))
            self._log(f"{loop.path}/data/path", _line_style(1.25))
            self._log(f"{loop.path}/data/now", _point_style())
        if self._layout is not None:
            low, high = self._layout.plane
            self._draw_plane("plane", _Frame.of_plane((low, high), self._signals[self._loops[0].x].unit))
            inner = np.linspace(low, high, self._layout.levels + 1)[1:-1]
            lattice = [[(low, value), (value, value), (value, high)] for value in inner]
            self._log("plane/data/lattice", _lines(lattice, _FAINT, 0.5, -15.0))
            self._log("plane/data/memory", _line_style(1.75, _MARKER))
            self._log("plane/data/input", _point_style())

    def write(self, entries: Sequence[_Entry]) -> None:
        """Write entries in the order in which they happened."""
        ticks = [entry for entry in entries if isinstance(entry, tuple)]
        steps: list[StepRecord] = []
        events: list[tuple[int, Event]] = []
        changes: list[tuple[str, float, int, str]] = []
        for entry in entries:
            if isinstance(entry, StepRecord):
                steps.append(entry)
                changes += self._enter(
                    "run", entry.started, entry.step, _NOT_SETTLED if entry.settled.failed else _RUNNING
                )
                self._step = entry.step + 1
                self._t = entry.finished
            elif isinstance(entry, Event):
                events.append((self._step, entry))
                if entry.kind == "phase":
                    self._colour_phase(entry.text)
                    changes += self._enter("phase", entry.t, self._step, entry.text)
                state = _state_after(entry)
                if state is not None:
                    changes += self._enter("run", entry.t, self._step, state)
                self._t = entry.t
            elif isinstance(entry, _Model):
                self._draw_model(entry)
            elif isinstance(entry, _End):
                self._set_property("outcome", {"status": entry.status, "reason": entry.reason})
        self._write_ticks(ticks)
        self._write_steps(steps)
        self._draw_points(self._points(entries))
        self._write_events(events)
        self._write_changes(changes)

    def warn(self, text: str) -> None:
        """Say in the log what the matter is with the dashboard itself."""
        self._write_events([(self._step, Event(self._t, "WARN", "dashboard", text))])

    @property
    def viewer_keeps_up(self) -> bool:
        """Whether the live view is not left out."""
        return self._live in self._streams

    def follow_viewer(self, entries: int) -> None:
        """Leave the live view out of the next `entries` entries if its viewer hangs; never waits long."""
        if self._live is None:
            return
        try:
            # Waits for the server, which holds some thousand batches for each viewer, not for the viewer.
            self._live.flush(timeout_sec=_FLUSH_SECONDS if self.viewer_keeps_up else 0.05 * _FLUSH_SECONDS)
        except RuntimeError:
            if self.viewer_keeps_up:
                self._streams.remove(self._live)
                self.warn("the viewer hangs; it is left out until it moves again")
            self._unseen += entries
            return
        if not self.viewer_keeps_up:
            self._streams.append(self._live)
            self.warn(f"the viewer moves again; {self._unseen} entries are missing in the live view")
            self._unseen = 0

    def close(self) -> None:
        """Let go of the file, then of the viewers."""
        for stream in self._streams:
            stream.disconnect()
        if self._live is not None:
            self._live.disconnect()

    def _write_ticks(self, ticks: Sequence[_Tick]) -> None:
        if not ticks:
            return
        t, step, rows = zip(*ticks, strict=True)
        values, times = np.array(rows, dtype=np.float64), _times(t, step)
        self._scalars("signals", times, values)
        if self._control is not None:
            for name, series in self._control.series(values).items():
                self._send_vectors(f"control/{name}", times, series)
        self._t = max(self._t, t[-1])

    def _write_steps(self, steps: Sequence[StepRecord]) -> None:
        if not steps:
            return
        times = _times([step.finished for step in steps], [step.step for step in steps])
        self._scalars("readings", times, np.array([step.values for step in steps], dtype=np.float64))

    def _points(self, entries: Iterable[_Entry]) -> Iterator[_Point]:
        """Yield where loops and memory curve go: to each reading and, under control, to each tick."""
        for entry in entries:
            if isinstance(entry, StepRecord):
                yield _Point(entry.finished, entry.step, entry.values, True)
            elif isinstance(entry, tuple) and self._control is not None and self._control.is_at_work(entry[2]):
                yield _Point(entry[0], entry[1], entry[2], False)

    def _draw_points(self, points: Iterable[_Point]) -> None:
        if self._layout is None:
            return
        first = self._loops[0]
        drawn: list[list[tuple[_Point, _Line]]] = [[] for _ in self._loops]
        memories = []
        for point in points:
            x = point.values[first.x]
            if math.isfinite(x):
                self._memory = self._memory.step(x) if self._memory else MemoryCurve.from_negative_saturation(x)
            for loop, lines in zip(self._loops, drawn, strict=True):
                line = loop.line_to(point)
                if line is None:
                    continue
                lines.append((point, line))
                if loop is first and self._memory is not None:
                    memories.append(self._memory.corners(*self._layout.plane))
        for loop, shown in zip(self._loops, drawn, strict=True):
            if not shown:
                continue
            times = _times([point.t for point, _ in shown], [point.step for point, _ in shown])
            strips = [line for _, line in shown]
            colours = [_RISING if line[-1][0] >= line[0][0] else _FALLING for line in strips]
            self._send(f"{loop.path}/data/path", times, rr.LineStrips2D.columns(strips=strips, colors=colours))
            ends = [line[-1] for line in strips]
            self._send(f"{loop.path}/data/now", times, rr.Points2D.columns(positions=ends))
            if loop is first:
                self._send("plane/data/memory", times, rr.LineStrips2D.columns(strips=memories))
                inputs = [memory[-1] for memory in memories]
                self._send("plane/data/input", times, rr.Points2D.columns(positions=inputs))

    def _write_events(self, events: Sequence[tuple[int, Event]]) -> None:
        if not events:
            return
        columns = rr.TextLog.columns(
            # The viewer leaves its own time column too narrow to read.
            text=[f"{_clock_face(event.t)}  {event.text}" for _, event in events],
            level=[event.level for _, event in events],
        )
        times = _times([event.t for _, event in events], [step for step, _ in events])
        self._send("events", times, columns)

    def _write_changes(self, changes: Sequence[tuple[str, float, int, str]]) -> None:
        for lane in dict.fromkeys(change[0] for change in changes):
            _, t, step, state = zip(*(change for change in changes if change[0] == lane), strict=True)
            self._send(f"state/{lane}", _times(t, step), rr.StateChange.columns(state=state))

    def _colour_phase(self, phase: str) -> None:
        if phase not in self._phases:
            self._phases.append(phase)
            colours = [_PHASE_COLOURS[i % len(_PHASE_COLOURS)] for i in range(len(self._phases))]
            self._log("state/phase", rr.StateConfiguration(values=self._phases, colors=colours))

    def _enter(self, lane: str, t: float, step: int, state: str) -> list[tuple[str, float, int, str]]:
        if self._states.get(lane) == state:
            return []
        self._states[lane] = state
        return [(lane, t, step, state)]

    def _scalars(self, kind: str, times: list[rr.TimeColumn], values: Floats) -> None:
        for group in self._groups:
            self._send_vectors(f"{kind}/{group.path}", times, values[:, group.columns] * group.factor)

    def _send_vectors(self, path: str, times: list[rr.TimeColumn], vectors: Floats) -> None:
        columns = rr.Scalars.columns(scalars=vectors.ravel())
        self._send(path, times, columns.partition(np.full(len(vectors), vectors.shape[1])))

    def _send(self, path: str, times: list[rr.TimeColumn], columns: Iterable[rr.ComponentColumn]) -> None:
        columns = list(columns)
        for stream in self._streams:
            stream.send_columns(path, times, columns)

    def _log(self, path: str, *what: rr.AsComponents) -> None:
        for stream in self._streams:
            stream.log(path, *what, static=True)

    def _set_property(self, name: str, values: Mapping[str, Any]) -> None:
        for stream in self._streams:
            stream.send_property(name, rr.AnyValues(**values))

    def _draw_frame(self, path: str, frame: _Frame) -> None:
        """Draw axes, and give what is logged below `path`/data their units."""
        columns = [(frame.x(value), value * frame.x_factor) for value in _round_values(*frame.x_range)]
        rows = [(frame.y(value), value * frame.y_factor) for value in _round_values(*frame.y_range)]
        lines = [[(x, 0.0), (x, -1.0)] for x, _ in columns] + [[(0.0, y), (_WIDTH, y)] for y, _ in rows]
        box = [(0.0, 0.0), (_WIDTH, 0.0), (_WIDTH, -1.0), (0.0, -1.0), (0.0, 0.0)]
        self._log(f"{path}/axes/grid", _lines(lines, _FAINT, 0.5, -20.0))
        self._log(f"{path}/axes/box", _lines([box], _INK, 0.75, 10.0))
        places = [(x, 0.02) for x, _ in columns] + [(-0.065, y - 0.035) for y, _ in rows]
        texts = [f"{value:.6g}" for _, value in (*columns, *rows)]
        self._log(f"{path}/axes/ticks", _texts(places, texts))
        titles = [(_WIDTH / 2, 0.09), (0.0, -1.1)]
        self._log(f"{path}/axes/titles", _texts(titles, [frame.x_title, frame.y_title]))
        matrix = np.diag([frame.x(1.0) - frame.x(0.0), frame.y(1.0) - frame.y(0.0), 1.0])
        self._log(f"{path}/data", rr.Transform3D(mat3x3=matrix, translation=[frame.x(0.0), frame.y(0.0), 0.0]))

    def _draw_plane(self, path: str, frame: _Frame) -> None:
        """Draw axes and triangle of a Preisach plane."""
        self._draw_frame(path, frame)
        low, high = frame.x_range
        triangle = [(low, low), (high, high), (low, high), (low, low)]
        self._log(f"{path}/data/triangle", _lines([triangle], _INK, 1.0, 10.0))

    def _plane_of(self, model: _Model) -> str:
        """Return the path of the plane on which a density is drawn."""
        unit = self._signals[self._loops[0].x].unit if self._loops else ""
        if model.stage not in _ARGUMENT_STAGES and model.input_unit in ("", unit):
            return "plane"
        return f"planes/{rr.escape_entity_path_part(model.stage or model.name)}"

    def _draw_model(self, model: _Model) -> None:
        if self._layout is None:
            return
        x, y = self._signals[self._loops[0].x], self._signals[self._loops[0].y]
        path, x_unit, y_unit = self._plane_of(model), model.input_unit or x.unit, model.output_unit or y.unit
        low, high, cells = float(model.grid[0]), float(model.grid[-1]), len(model.grid) - 1
        if path == "plane":
            frame = _Frame.of_plane(self._layout.plane, x.unit)
        else:
            frame = _Frame.of_plane((low, high), x_unit)
            self._draw_plane(path, frame)
        # Several pixels a cell, for the diagonal and for intervals of unequal length.
        pixels = cells * max(8, 256 // cells)
        middles = low + (np.arange(pixels) + 0.5) * (high - low) / pixels
        cell = np.clip(np.searchsorted(model.grid, middles, side="right") - 1, 0, cells - 1)
        density = np.where(middles[:, None] >= middles, model.density[np.ix_(cell, cell)], np.nan)
        greatest = float(np.nanmax(np.abs(density))) or 1.0
        self._draw_image(f"{path}/density", _coloured(density / greatest)[::-1], frame, (low, high), (low, high))
        # The legend stands in the corner below the diagonal, where there is no plane.
        least = -greatest if np.nanmin(density) < 0 else 0.0
        ramp = np.linspace(least / greatest, 1.0, 128)[None, :].repeat(8, axis=0)
        low, high = frame.x_range
        left, right, bottom, top = low + np.array([0.62, 0.92, 0.06, 0.1]) * (high - low)
        self._draw_image(f"{path}/legend/bar", _coloured(ramp), frame, (left, right), (bottom, top))
        title = " ".join(("density", model.stage)).strip()
        factor, y_unit = _prefixed(y_unit, (least, greatest))
        unit = f"{_in_brackets(y_unit)}/{_in_brackets(x_unit)}²"
        middle, above = frame.x((left + right) / 2), frame.y(top)
        ends = [(frame.x(left), above - 0.09), (frame.x(right), above - 0.09)]
        self._log(f"{path}/legend/ends", _texts(ends, [f"{factor * value:.3g}" for value in (least, greatest)]))
        self._log(
            f"{path}/legend/title",
            _texts([(middle, above - 0.23), (middle, above - 0.16)], [model.name, f"{title} [{unit}]"]),
        )

    def _draw_image(
        self, path: str, image: npt.NDArray[np.uint8], frame: _Frame, x: Sequence[float], y: Sequence[float]
    ) -> None:
        """Put an image, its first row at the top, between two values of x and two of y."""
        height, width = image.shape[:2]
        across, down = (frame.x(x[1]) - frame.x(x[0])) / width, (frame.y(y[0]) - frame.y(y[1])) / height
        self._log(
            path,
            rr.Transform3D(mat3x3=np.diag([across, down, 1.0]), translation=[frame.x(x[0]), frame.y(y[1]), 0.0]),
            rr.Image(image, draw_order=-10.0),
        )

    def _blueprint(self) -> rrb.Blueprint:
        whole_run = _whole_run()
        series = [
            _plot(f"/signals/{group.path}", group.title, rrb.Corner2D.RightBottom if len(group.columns) > 1 else None)
            for group in self._groups
        ]
        left = rrb.Vertical(*series, row_shares=[group.height for group in self._groups])
        if self._control is not None:
            driven = [bool(self._loops) and self._loops[0].x in group.columns for group in self._groups]
            others = rrb.Tabs(*series, active_tab=driven.index(True) if any(driven) else 0)
            left = rrb.Vertical(*self._control.views(), others, row_shares=[5, 4, 4, 4])
        state = rrb.StateTimelineView(origin="/state", name="Protocol", time_view=whole_run)
        log = rrb.TextLogView(
            origin="/events",
            name="Log",
            columns=rrb.TextLogColumns(
                timeline_columns=[rrb.encodings.TimelineColumn("t", visible=False)],
                text_log_columns=["LogLevel", "Body"],
            ),
        )
        card = rrb.TextDocumentView(origin="/card", name="Run card")
        below = rrb.Vertical(state, rrb.Horizontal(log, card, column_shares=[3, 2]), row_shares=[3, 5])
        right: rrb.Container = below
        loops, planes = self._loop_views(), self._plane_views()
        if len(loops) == 1:
            right = rrb.Vertical(rrb.Horizontal(*loops, *planes), below, row_shares=[8, 7])
        elif loops:
            right = rrb.Vertical(
                rrb.Grid(*loops, grid_columns=min(len(loops), _LOOPS_IN_A_ROW)),
                rrb.Horizontal(*planes, rrb.Tabs(log, card, active_tab=0)),
                state,
                row_shares=[5 * math.ceil(len(loops) / _LOOPS_IN_A_ROW), 5, 2],
            )
        return rrb.Blueprint(
            rrb.Horizontal(left, right, column_shares=[2, 3] if len(loops) + len(planes) <= 2 else [1, 2]),
            rrb.BlueprintPanel(state="hidden"),
            rrb.SelectionPanel(state="hidden"),
            rrb.TimePanel(state="collapsed", timeline="t", play_state="following"),
        )

    def _loop_views(self) -> list[rrb.Spatial2DView]:
        names = [f"{loop.layout.output} over {loop.layout.input}" for loop in self._loops]
        if self._layout is not None and len(names) == 1:
            names = [self._layout.title]
        return [
            _drawing(loop.path, name, f"/{loop.path}/data/path")
            for loop, name in zip(self._loops, names, strict=True)
        ]

    def _plane_views(self) -> list[rrb.Spatial2DView | rrb.Tabs]:
        if self._layout is None:
            return []
        views = [
            _drawing(path, f"Preisach plane of {model.stage or model.name}")
            for path, model in sorted(self._planes.items())
        ]
        others = [rrb.Tabs(*views, active_tab=0)] if len(views) > 1 else views
        return [_drawing("plane", "Preisach plane"), *others]


@dataclass(frozen=True)
class _Group:
    """The signals of one unit."""

    path: str
    title: str
    columns: list[int]
    factor: float
    height: int
    style: rr.SeriesLines


class _Point(NamedTuple):
    """A point of the loops: a reading that was waited for, or a tick under control."""

    t: float
    step: int
    values: Sequence[float]
    is_reading: bool


_Line = list[tuple[float, float]]


class _Loop:
    """A loop: where it is drawn, and the line since the point that was drawn last.

    Parameters
    ----------
    path : str
        Entity below which it is drawn.
    layout : LoopLayout
        Its axes.
    x, y : int
        Columns of its signals.
    extent : tuple of float
        Range of the input of which a small part is still seen.
    """

    def __init__(self, path: str, layout: LoopLayout, x: int, y: int, extent: tuple[float, float]) -> None:
        self.path, self.layout, self.x, self.y = path, layout, x, y
        self._extents = extent, layout.output_range
        self._line: _Line = []
        self._drawn = -math.inf

    @classmethod
    def all_of(cls, layout: DashboardLayout, signals: Sequence[Signal]) -> list[_Loop]:
        """Return the loops of a layout, the first one first."""
        loops = []
        for prefix, loop in layout.all_loops.items():
            x = _column(signals, f"{prefix}input", loop.input)
            y = _column(signals, f"{prefix}output", loop.output)
            # What moves the first loop moves the memory curve, too.
            extent = loop.input_range if prefix else layout.plane
            loops.append(cls(prefix.replace(".", "/").strip("/") or "loop", loop, x, y, extent))
        return loops

    def line_to(self, point: _Point) -> _Line | None:
        """Return the line that leads to a point from the one that was drawn last; None if it is not drawn yet."""
        here = x, y = point.values[self.x], point.values[self.y]
        if not (math.isfinite(x) and math.isfinite(y)):
            return None
        self._line = self._line or [here]
        if not (point.is_reading or self._is_visible(here)):
            return None
        self._line.append(here)
        if not point.is_reading and point.t - self._drawn < _REDRAW_SECONDS:
            return None
        line, self._line, self._drawn = self._line, [here], point.t
        return line

    def _is_visible(self, point: tuple[float, float]) -> bool:
        """Return whether a point can be told from the one that was drawn last."""
        return any(
            abs(new - old) > _VISIBLE * (high - low)
            for new, old, (low, high) in zip(point, self._line[0], self._extents, strict=True)
        )


@dataclass(frozen=True)
class _Control:
    """What there is to see of controllers: columns of their signals, and how to show them."""

    output: int
    traces: tuple[int, ...]
    extent: tuple[float, float] | None
    factor: float
    unit: str

    @classmethod
    def of(cls, signals: Sequence[Signal], controls: str, extent: tuple[float, float] | None) -> _Control:
        output = _column(signals, "controls", controls)
        factor, unit = _prefixed(signals[output].unit, extent or _likely_extent(signals[output]))
        traces = tuple(_column(signals, "controls", name) for name in _TRACE_NAMES)
        return cls(output, traces, extent, factor, unit)

    def is_at_work(self, values: Sequence[float]) -> bool:
        """Return whether a controller was at work when a tick was taken."""
        return math.isfinite(values[self.traces[0]])

    def series(self, values: Floats) -> dict[str, Floats]:
        """Return what is plotted of ticks: by plot, one row a tick, one column a line, in its unit."""
        reference, predicted, disturbance, uncertainty = self.factor * values[:, self.traces].T
        output = self.factor * values[:, self.output]
        band = 2.0 * uncertainty
        if self.extent is not None:
            # Before the first estimate there is only a notion of how large disturbances are at all.
            band[band > self.factor * (self.extent[1] - self.extent[0])] = np.nan
        around = np.where(np.isfinite(reference), 0.0, np.nan)
        return {
            "tracking": np.column_stack([reference - band, reference + band, predicted, output, reference]),
            "error": np.column_stack([output - reference, around - band, around + band]),
            "disturbance": np.column_stack([disturbance - band, disturbance + band, disturbance]),
        }

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Return how the lines of `series` look."""
        lines = {
            # The last line is on top. Lines of one name are one entry of the legend.
            "tracking": [
                *[("reference ± 2σ", _BAND, 0.75)] * 2,
                ("predicted", _PREDICTED, 1.0),
                ("output", _OUTPUT, 2.0),
                ("reference ± 2σ", _INK, 1.0),
            ],
            "error": [("output − reference", _ERROR, 1.0), *[("± 2σ", _BAND, 1.0)] * 2],
            "disturbance": [*[("± 2σ", _BAND, 0.75)] * 2, ("disturbance", _DISTURBANCE, 1.75)],
        }
        return {
            name: rr.SeriesLines(names=names, colors=colours, widths=widths)
            for name, (names, colours, widths) in ((name, zip(*look, strict=True)) for name, look in lines.items())
        }

    def views(self) -> list[rrb.TimeSeriesView | rrb.Tabs]:
        """Return the plots of `series`, from top to bottom."""
        error: rrb.TimeSeriesView | rrb.Tabs = _plot("/control/error", f"Error ± 2σ [{self.unit}]")
        if self.extent is not None:
            # A new target lies far away; next to the way there, what remains at the target would not be seen.
            most = _CLOSE * self.factor * (self.extent[1] - self.extent[0])
            close = _plot("/control/error", f"Error ± 2σ, close [{self.unit}]", y=(-most, most))
            error = rrb.Tabs(close, error, active_tab=0)
        return [
            _plot("/control/tracking", f"Tracking [{self.unit}]", rrb.Corner2D.LeftTop),
            error,
            _plot("/control/disturbance", f"Disturbance ± 2σ [{self.unit}]"),
        ]


@dataclass(frozen=True)
class _Frame:
    """A pair of axes: ranges in the units of the data, and what is written beside them."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    x_title: str
    y_title: str
    x_factor: float
    y_factor: float

    @classmethod
    def of_loop(cls, layout: LoopLayout, x: Signal, y: Signal) -> _Frame:
        x_factor, x_unit = _prefixed(x.unit, layout.input_range)
        y_factor, y_unit = _prefixed(y.unit, layout.output_range)
        titles = f"{x.description} [{x_unit}]", f"{y.description} [{y_unit}]"
        return cls(layout.input_range, layout.output_range, *titles, x_factor, y_factor)

    @classmethod
    def of_plane(cls, extent: tuple[float, float], unit: str) -> _Frame:
        factor, shown = _prefixed(unit, extent)
        return cls(extent, extent, f"β [{shown}]", f"α [{shown}]", factor, factor)

    def x(self, value: float) -> float:
        low, high = self.x_range
        return _WIDTH * (value - low) / (high - low)

    def y(self, value: float) -> float:
        low, high = self.y_range
        return -(value - low) / (high - low)


def _group_by_unit(
    signals: Sequence[Signal], ranges: Mapping[str, tuple[float, float]], omitted: Collection[str]
) -> list[_Group]:
    shown_signals = [(i, signal) for i, signal in enumerate(signals) if signal.name not in omitted]
    groups = []
    for unit in dict.fromkeys(signal.unit for _, signal in shown_signals):
        columns = [i for i, signal in shown_signals if signal.unit == unit]
        members = [signals[i] for i in columns]
        extents = [ranges[signal.name] for signal in members if signal.name in ranges]
        factor, shown = _prefixed(unit, extents[0] if extents else _likely_extent(members[0]))
        quantity = _QUANTITIES.get(unit, unit)
        title = quantity if len(members) > 1 else members[0].description
        style = rr.SeriesLines(
            names=[f"{signal.name} [{shown}]" for signal in members],
            colors=[_colour(signals[i].name, i) for i in columns],
            widths=[1.5] * len(members),
        )
        path = rr.escape_entity_path_part(quantity)
        headline = f"{title[:1].upper()}{title[1:]} [{shown}]"
        groups.append(_Group(path, headline, columns, factor, 2 if extents else 1, style))
    return groups


def _column(signals: Sequence[Signal], key: str, name: str) -> int:
    names = [signal.name for signal in signals]
    if name not in names:
        raise ConfigurationError(f"dashboard: {key}: there is no signal {name!r}; there are: {', '.join(names)}")
    return names.index(name)


def _likely_extent(signal: Signal) -> tuple[float, float]:
    """Return how large the numbers of a signal are, as the digits that are worth showing tell."""
    return 0.0, 10.0 ** (3 - signal.precision)


def _plot(
    origin: str, name: str, legend: rrb.Corner2D | None = None, y: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(legend, visible=legend is not None),
        axis_x=_whole_run(),
        axis_y=None if y is None else rrb.ScalarAxis(range=y),
    )


def _drawing(path: str, name: str, of_the_past: str = "") -> rrb.Spatial2DView:
    """Return the view of what `_draw_frame` frames; of the entity `of_the_past` it shows all that went before."""
    forever, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    past = [rrb.VisibleTimeRange(timeline, start=forever, end=now) for timeline in ("t", "step")]
    return rrb.Spatial2DView(
        origin=f"/{path}",
        name=name,
        visual_bounds=rrb.VisualBounds2D(x_range=(-0.2, _WIDTH + 0.08), y_range=(-1.16, 0.2)),
        background=_BACKGROUND,
        overrides={of_the_past: rrb.VisibleTimeRanges(past)} if of_the_past else None,
    )


def _whole_run() -> rrb.TimeAxis:
    forever = rrb.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=forever, end=forever))


def _colour(name: str, position: int) -> Colour:
    return _SETPOINT if name.endswith("_setpoint") else _PALETTE[position % len(_PALETTE)]


def _state_after(event: Event) -> str | None:
    """Return the state of the run that an event leads to, if it does."""
    return event.text if event.kind == "end" else _STATE_OF_EVENT.get(event.kind)


def _entries(record: Record) -> list[_Entry]:
    """Return what an engine told of a run, in its order."""
    telemetry = record.telemetry()
    rows = np.column_stack([telemetry[signal.name] for signal in record.signals]).tolist()
    times, steps = telemetry["t"].tolist(), telemetry["step"].astype(np.int64).tolist()
    # Of what happened in one instant, the ticks of a step come first, then its end, then what follows from it.
    dated: list[tuple[tuple[float, float, int], _Entry]] = [
        ((t, step, 0), (t, step, row)) for t, step, row in zip(times, steps, rows, strict=True)
    ]
    dated += [((step.finished, step.step, 1), step) for step in record.step_records()]
    dated += [((event.t, math.inf, 0), event) for event in record.events()]
    dated.sort(key=lambda entry: entry[0])
    return [entry for _, entry in dated]


def _densities(record: Record) -> Iterator[_Model]:
    """Yield the densities of the models that have one, the newest last."""
    for name, content in record.models().items():
        if is_model(content):
            for density in parse_model(content, f"{record.path}: model {name}").model.densities():
                units = density.input_unit, density.output_unit
                yield _Model(name, density.values, density.levels, density.title, *units)


def _times(t: npt.ArrayLike, step: npt.ArrayLike) -> list[rr.TimeColumn]:
    nanoseconds = np.round(np.asarray(t, dtype=np.float64) * 1e9).astype("timedelta64[ns]")
    return [
        rr.TimeColumn("t", duration=nanoseconds),
        rr.TimeColumn("step", sequence=np.asarray(step, dtype=np.int64)),
    ]


def _clock_face(t: float) -> str:
    minutes, seconds = divmod(max(int(t), 0), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


def _lines(strips: Any, colour: Colour, points: float, order: float) -> rr.LineStrips2D:  # noqa: ANN401
    return rr.LineStrips2D(strips, colors=colour, radii=rr.Radius.ui_points(points), draw_order=order)


def _line_style(points: float, colour: Colour | None = None) -> rr.LineStrips2D:
    return rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(points), colors=colour, draw_order=20.0)


def _point_style() -> rr.Points2D:
    return rr.Points2D.from_fields(radii=rr.Radius.ui_points(5.0), colors=_MARKER, draw_order=30.0)


def _texts(places: Sequence[tuple[float, float]], texts: Sequence[str]) -> rr.Points2D:
    return rr.Points2D(places, labels=texts, show_labels=True, colors=_INK, radii=0.0)


def _round_values(low: float, high: float) -> list[float]:
    """Return some five round values within a range."""
    rough = (high - low) / 5
    magnitude = 10.0 ** math.floor(math.log10(rough))
    step = min((m * magnitude for m in (1, 2, 2.5, 5, 10)), key=lambda step: abs(step - rough))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [n * step for n in range(first, last + 1)]


def _prefixed(unit: str, extent: tuple[float, float]) -> tuple[float, str]:
    """Return factor and unit that make the numbers of an axis readable."""
    greatest = max(abs(extent[0]), abs(extent[1]))
    if unit in ("m", "A", "V", "N", "W"):
        for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ")):
            if greatest * factor >= 1.0:
                return factor, prefix + unit
    return 1.0, unit


def _in_brackets(unit: str) -> str:
    return f"({unit})" if "/" in unit else unit


def _coloured(values: Floats) -> npt.NDArray[np.uint8]:
    """Return colours of values from -1 to 1; NaN is transparent."""
    stops = np.array([stop for stop, _ in _DENSITY_COLOURS])
    colours = np.array([colour for _, colour in _DENSITY_COLOURS], dtype=np.float64)
    known = np.nan_to_num(values)
    image = np.stack(
        [*(np.interp(known, stops, colours[:, i]) for i in range(3)), np.where(np.isnan(values), 0.0, 255.0)],
        axis=-1,
    )
    return image.round().astype(np.uint8)


def _file_sink(path: Path) -> rr.FileSink:
    # Rerun would truncate the file.
    if path.exists():
        raise ConfigurationError(f"{path} exists already; a recording is never overwritten")
    if not path.parent.is_dir():
        raise ConfigurationError(f"{path}: there is no folder {path.parent}")
    return rr.FileSink(path)


def _free_port(first: int) -> int:
    """Return `first` or the next port of the loopback address that is free; for 0, any free port."""
    # Rerun itself does not say that a port is taken, and takes 0 without telling which it became.
    for port in range(first, min(first + _PORTS_TRIED, 65536)) if first else (0,):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((_LOOPBACK, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise ConfigurationError(f"no port of {_LOOPBACK} from {first} to {first + _PORTS_TRIED - 1} is free")


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((_LOOPBACK, port)) == 0
