"""A run from end to end: its folder, its journal, its dashboard, and the engine in between."""

from __future__ import annotations

import getpass
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bench.attachment import AttachedClock, Attachment, attach
from bench.binding import Slots
from bench.clock import Clock, Stopwatch, wall_time
from bench.description import RigDescription
from bench.detached_observer import DetachedObserver
from bench.devices import Signal
from bench.engine import Engine, Outcome, check_before_moving
from bench.errors import AbortError, ConfigurationError
from bench.extras import MissingExtraError, needed_for
from bench.faults import read_schedule, schedule_faults
from bench.guardian.remote import GuardedRig, RemoteStation
from bench.interrupts import Interrupts, say_at_once
from bench.journal import FILE_NAME, Journal, abandon
from bench.protocol import LATENESS, TRACES, Plan, ProtocolDefinition, ProtocolParameters, plan
from bench.rig import Rig, clock_for
from bench.rig_file import RigFile, load_rig
from bench.start_checks import check_start
from bench.station.interface import Station
from bench.station.local import LocalStation
from bench.terminal import ProgressDisplay, ask_operator

if TYPE_CHECKING:
    from bench.dashboard import Dashboard

RECORDING_NAME = "run.rrd"
RIG_FILE_NAME = "rig.toml"
_LAST_WORDS = 1.0
"""Longest wait for a terminal at the end, s."""
_PACKAGES = ("actuator-bench", "numba", "numpy", "pymodbus", "pyserial", "rerun-sdk", "scipy")


@dataclass(frozen=True)
class Run:
    """What to run, and how.

    Attributes
    ----------
    protocol : ProtocolDefinition
        What to carry out.
    settings : mapping
        Parameters of it that were set, as texts or values; the others have the rig's defaults or its own.
    rig : str
        Name of a packaged rig or path of a rig file.
    overrides : mapping of str to str
        Values of the rig file to replace, by dotted key.
    seed : int
        Seed of everything random in an emulated laboratory.
    clock : str
        `wall`, `virtual` or `xN`; see `bench.clock.make_clock`.
    folder : Path
        Where the folder of the run is made.
    live : bool
        Whether to serve the live view on the loopback interface.
    recording : bool
        Whether to write the .rrd beside the journal while the run goes on.
    attach : Path, optional
        Endpoints file of `bench emulate`: the emulated laboratory is served there, on its own clock and seed.
    interlock_rate : float, optional
        Looks at the interlocks of an emulated rig in a laboratory second, Hz, beside each reading and tick; on
        hardware the rig file says it, `[safety] rate`.
    faults : Path, optional
        Faults of the emulated laboratory, at instants from the start of the run; see `bench.faults`.
    """

    protocol: ProtocolDefinition
    settings: Mapping[str, Any]
    rig: str
    folder: Path
    overrides: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    clock: str = "wall"
    live: bool = False
    recording: bool = True
    attach: Path | None = None
    interlock_rate: float | None = None
    faults: Path | None = None


@dataclass(frozen=True)
class RunResult:
    """What a run left behind.

    Attributes
    ----------
    folder : Path
        Its folder: journal, .rrd, rig file as used.
    outcome : Outcome
        How it ended.
    wall_seconds : float
        Wall-clock seconds, connecting and closing included.
    """

    folder: Path
    outcome: Outcome
    wall_seconds: float

    @property
    def time_ratio(self) -> float:
        """Laboratory time over wall-clock time."""
        return self.outcome.laboratory_seconds / self.wall_seconds


def carry_out(run: Run, console: Console, interrupts: Interrupts | None = None) -> RunResult:
    """Carry a run out, keep its record, and leave the rig in the safe state.

    Parameters
    ----------
    run : Run
        What to run.
    console : Console
        Where progress is shown.
    interrupts : Interrupts, optional
        At work already, and for longer than the run; without them the run has its own.

    Raises
    ------
    ConfigurationError
        If anything is wrong before the start, or there is no library for the live view; nothing has moved.
    DeviceError
        If a device cannot be connected; nothing has moved.
    """
    stopwatch = Stopwatch()
    rig_file = load_rig(run.rig, run.overrides)
    parameters = run.protocol.parse(
        run.settings, rig_file.roles, rig_file.protocols.get(run.protocol.name), path=rig_file.path
    )
    faults = () if run.faults is None else read_schedule(run.faults)
    dashboard_class = _dashboard_class(run, console)
    operator_is_there = sys.stdin is not None and sys.stdin.isatty()
    guardian: RemoteStation | None = None
    warnings: tuple[str, ...] = ()
    with ExitStack() as stack:
        clock, attachment = _clock(run, rig_file, stack)
        if interrupts is None:
            interrupts = stack.enter_context(Interrupts(say_at_once))
        clock.interrupted = interrupts.abort_requested
        # A guardian makes the devices safe as soon as this process is gone.
        interrupts.leave_by(_leave)
        if run.attach is None and rig_file.in_process:
            rig = Rig(rig_file, clock, run.seed)
            laboratory: object = rig.laboratory
            station: Station = LocalStation(rig, run.interlock_rate)
        else:
            doing = f"a run of {run.protocol.name}, recorded below {run.folder.resolve()}"
            guarded = GuardedRig(rig_file, run.rig, run.overrides, run.attach, run.seed, doing)
            laboratory, station = attachment, RemoteStation(guarded, clock)
            guardian = station
        # The lines only: the engine brings the devices into their safe state, and says how that went.
        stack.callback(station.close)
        if run.faults is not None:
            schedule_faults(laboratory, faults, run.faults)
        description = station.description
        slots = description.slots(run.protocol)
        expected = plan(run.protocol, parameters, slots)
        check_before_moving(description, run.protocol, expected)
        if expected.prompts and not (rig_file.emulated or operator_is_there):
            raise ConfigurationError(
                f"protocol {run.protocol.name} asks the operator {expected.prompts} times to do something by hand; "
                "run it in a terminal, where an operator can answer"
            )
        if guardian is not None:
            warnings = check_start(description, interval=1.0 / rig_file.safety.rate, interval_key="safety.rate")
        if (reason := interrupts.abort_reason) is not None:
            raise AbortError(f"ended by {reason} before anything moved")
        folder = _make_folder(run.folder, f"{rig_file.name}-{run.protocol.name}")
        if guardian is not None:
            guardian.keep_record(folder)
        (folder / RIG_FILE_NAME).write_text(rig_file.text, encoding="utf-8")
        meta = _metadata(run, station, parameters, slots, expected, folder.name)
        signals = description.signals + trace_signals(run.protocol, description, slots)
        journal = Journal(folder / FILE_NAME, signals, meta)
        stack.callback(journal.close)
        interrupts.leave_by(partial(_leave, station=station, journal=journal.path))
        observers: list[Any] = []
        dashboard = None
        if dashboard_class is not None:
            path = folder / RECORDING_NAME if run.recording else None
            dashboard = stack.enter_context(dashboard_class(signals, meta, path=path, live=run.live))
            observers.append(dashboard)
            if run.live:
                console.print(f"live view: run [bold]rerun {dashboard.uri}[/] in another terminal", highlight=False)
        layout = rig_file.dashboard
        shown = (layout.input, layout.output) if layout else tuple(signal.name for signal in description.signals[:2])
        progress = ProgressDisplay(console, run.protocol.name, signals, shown, expected.steps)
        observers.append(stack.enter_context(DetachedObserver(progress)))
        ask = partial(ask_operator, console) if operator_is_there else None
        engine = Engine(station, journal, observers, interrupts, ask)
        engine.warn(warnings)
        outcome = engine.run(run.protocol, parameters)
        if dashboard is not None:
            dashboard.finish(outcome.status, outcome.reason)
    interrupts.finish()
    return RunResult(folder, outcome, stopwatch.seconds())


def _clock(run: Run, file: RigFile, stack: ExitStack) -> tuple[Clock, Attachment | None]:
    """Return the clock of a run, and the served laboratory that it is of."""
    if run.attach is None:
        return clock_for(file, run.clock), None
    if not file.emulated:
        raise ConfigurationError(f"rig {file.name} has no emulated laboratory that could be served elsewhere")
    attachment = attach(run.attach, file.name)
    stack.callback(attachment.close)
    return attachment.clock, attachment


def _leave(reason: str, station: Station | None = None, journal: Path | None = None) -> None:
    """End the process from another thread than the one that hangs; a guardian makes the devices safe then."""
    safe_state = station.end() if isinstance(station, LocalStation) else {}
    text = f"ended by {reason}; the protocol did not come to an end, so the process was left"
    if journal is not None:
        abandon(journal, text, safe_state)
    # The terminal may hang as well.
    saying = threading.Thread(target=say_at_once, args=(text,), daemon=True)
    saying.start()
    saying.join(_LAST_WORDS)
    os._exit(AbortError.exit_code)


def _dashboard_class(run: Run, console: Console) -> type[Dashboard] | None:
    """Import the dashboard if the run needs it, and say so if it is not installed.

    Raises MissingExtraError only for a live view: without a recording the journal has everything.
    """
    if not (run.live or run.recording):
        return None
    try:
        # Rerun takes half a second to import; those who neither watch nor record do not pay for it.
        with needed_for("the live view" if run.live else "an .rrd file", "dashboard"):
            from bench.dashboard import Dashboard
    except MissingExtraError as error:
        if run.live:
            raise
        console.print(f"no recording: {error}", highlight=False, markup=False, soft_wrap=True)
        return None
    return Dashboard


def trace_signals(protocol: ProtocolDefinition, description: RigDescription, slots: Slots) -> tuple[Signal, ...]:
    """Return the signals that a protocol's controllers add to the rig's."""
    controlled = protocol.controlled(slots)
    if not controlled:
        return ()
    description.check_needs(protocol.name, [controlled])
    signal = description.by_name[controlled]
    traces = (replace(trace, unit=signal.unit, precision=signal.precision) for trace in TRACES)
    return (*traces, LATENESS)


def _metadata(
    run: Run, station: Station, parameters: ProtocolParameters, slots: Slots, expected: Plan, name: str
) -> dict[str, Any]:
    file, clock = station.description.file, station.clock
    return {
        "run": name,
        "rig": file.name,
        "rig_title": file.rig.title,
        "rig_file": file.text,
        "rig_content": file.content,
        "overrides": dict(run.overrides),
        "protocol": run.protocol.name,
        "protocol_summary": run.protocol.summary,
        "parameters": parameters.model_dump(mode="json"),
        "controls": run.protocol.controlled(slots),
        "slots": {slot.name: {"device": slot.device, "signal": slot.signal} for slot in slots.values()},
        "plan": {"steps": expected.steps, "seconds": expected.seconds, "at_most": expected.at_most},
        "seed": run.seed,
        "interlock_rate": run.interlock_rate if file.in_process and run.attach is None else file.safety.rate,
        "clock": f"attached x{clock.factor:g}" if isinstance(clock, AttachedClock) else run.clock,
        "epoch": clock.epoch.isoformat(),
        "devices": {name: str(device.identity) for name, device in station.description.devices.items()},
        "limits": {name: (limits.low, limits.high) for name, limits in station.description.limits.items()},
        "calibration": {
            **{entry.name: entry.settings.model_dump(mode="json") for entry in file.devices},
            **{name: derived.model_dump(mode="json") for name, derived in file.derived.items()},
        },
        "dashboard": file.dashboard.model_dump(mode="json") if file.dashboard else None,
        "operator": _operator(),
        "command": sys.argv,
        "packages": {package: _version(package) for package in _PACKAGES},
        "git": _git_state(),
        "host": {
            "name": platform.node(),
            "system": platform.platform(),
            "python": platform.python_version(),
            "started": wall_time().isoformat(),
        },
    }


def _make_folder(parent: Path, name: str) -> Path:
    stamp = wall_time().strftime("%Y%m%d-%H%M%S")
    for suffix in ("", *(f"-{i}" for i in range(2, 1000))):
        folder = parent / f"{name}-{stamp}{suffix}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ConfigurationError(f"the folder of the run cannot be made: {error}") from None
        return folder
    raise ConfigurationError(f"{parent} holds a thousand runs of this second already")


def _operator() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _git_state() -> str:
    git = shutil.which("git")
    if git is None:
        return "unknown"
    here = Path(__file__).parent

    def ask(*arguments: str) -> str | None:
        answer = subprocess.run([git, *arguments], cwd=here, capture_output=True, text=True, check=False)  # noqa: S603
        return answer.stdout.strip() if answer.returncode == 0 else None

    commit = ask("rev-parse", "--short=12", "HEAD")
    if commit is None:
        return "unknown"
    return commit + (" with changes" if ask("status", "--porcelain") else "")
