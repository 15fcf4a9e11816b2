"""A run from end to end: its folder, its journal, its dashboard, and the engine in between."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bench.attachment import Attachment, attach
from bench.binding import Slots
from bench.clock import Clock, Stopwatch, wall_time
from bench.description import RigDescription
from bench.detached_observer import DetachedObserver
from bench.devices import Signal
from bench.dialogue import Dialogue
from bench.emulated_twin import twin_of
from bench.engine import Engine, Outcome, check_before_moving
from bench.errors import AbortError, ConfigurationError, GuardianError
from bench.extras import MissingExtraError, needed_for
from bench.faults import read_schedule, schedule_faults
from bench.guardian.remote import STACKS_NAME, GuardedRig, RemoteStation
from bench.interrupts import Interrupts, say_at_once
from bench.journal import BLACK_BOX_NAME, FILE_NAME, Ending, Journal, abandon, ending_of
from bench.locks import Holder, Locks
from bench.mailbox import RunMailbox
from bench.model_file import models_among
from bench.notify import Notifier, facts_of
from bench.past import Interrupted
from bench.printing import print_plain
from bench.protocol import LATENESS, TRACES, Plan, ProtocolDefinition, ProtocolParameters, plan
from bench.protocol.changes import ParameterChange
from bench.questions import Question
from bench.recorded_files import RIG_FILE_NAME, Original, given_files
from bench.rehearsal import Rehearsal, rehearse
from bench.remaining_time import Expectation
from bench.rig import Rig, clock_for
from bench.rig_file import RigFile, load_rig
from bench.run_record import NewFolder, differences, metadata, run_name
from bench.start_checks import check_start, overdue_calibrations
from bench.station.interface import Station
from bench.station.local import LocalStation
from bench.terminal import ProgressDisplay, RehearsalDisplay

if TYPE_CHECKING:
    from bench.dashboard import Dashboard

RECORDING_NAME = "run.rrd"
_DEFINITE = 1.1
"""Longest time of a plan over its shortest, up to which it says when the run ends."""
_LAST_WORDS = 1.0
"""Longest wait for a terminal at the end, s."""

_PREPARATION = 120.0
"""Wall-clock time (s) from the connection of the devices to the first step: a record and its views are opened."""


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
    original : Original, optional
        The run that this one repeats: its files are read in the place of those that `settings` name, and its rig is
        taken if it has one.
    rehearse : bool
        Whether the run is rehearsed on the emulated twin of the rig before anything moves. A run on the virtual clock
        is not, as it would take as long itself.
    notify : tuple of str
        Who is sent messages at a pause, a prompt, a warning, a trip and the end, also that of a bench which hung or
        died; see `bench.notify`.
    changes : tuple of ParameterChange
        Parameters that are changed on the way, as in the run that is repeated.
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
    original: Original | None = None
    rehearse: bool = True
    notify: tuple[str, ...] = ()
    changes: tuple[ParameterChange, ...] = ()


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
        """Laboratory time over wall-clock time, both of this process: of a run that is resumed, from there on."""
        return self.outcome.own_seconds / self.wall_seconds


def carry_out(
    run: Run, console: Console, interrupts: Interrupts | None = None, again: Interrupted | None = None
) -> RunResult:
    """Carry a run out, keep its record, and leave the rig in the safe state.

    Parameters
    ----------
    run : Run
        What to run.
    console : Console
        Where progress is shown.
    interrupts : Interrupts, optional
        At work already, and for longer than the run; without them the run has its own.
    again : Interrupted, optional
        The run that died and is taken up; see `bench.resume`.

    Raises
    ------
    ConfigurationError
        If anything is wrong before the start, or there is no library for the live view; nothing has moved.
    DeviceError
        If a device cannot be connected; nothing has moved.
    """
    stopwatch = Stopwatch()
    rig_file, stated, parameters = _read(run)
    original = run.original
    faults = () if run.faults is None else read_schedule(run.faults)
    notifier = Notifier(run.notify) if run.notify else None
    dashboard_class = _dashboard_class(run, console)
    operator_is_there = sys.stdin is not None and sys.stdin.isatty()
    with ExitStack() as stack:
        clock, attachment = _clock(run, rig_file, stack)
        if interrupts is None:
            interrupts = stack.enter_context(Interrupts(say_at_once))
        clock.interrupted = interrupts.abort_requested
        # A guardian makes the devices safe as soon as this process is gone.
        interrupts.leave_by(_leave)
        rehearsal = None
        if run.rehearse and again is None and run.clock != "virtual":
            rehearsal = _rehearsed(run, rig_file, parameters, console, interrupts)
        elif clock.sleep_waits:
            # Loading the filters takes a second, as a rehearsal would have done: no device waits for that later.
            import_module("filterpy.kalman")
        if rehearsal is not None:
            rehearsal.raise_if_wrong()
        # Removed again after all that may write there is closed.
        new = stack.enter_context(NewFolder((RECORDING_NAME, BLACK_BOX_NAME), (STACKS_NAME,)))
        station, laboratory = _connected(run, rig_file, clock, attachment, again)
        guardian = station if isinstance(station, RemoteStation) else None
        # The lines only: the engine brings the devices into their safe state, and says how that went.
        stack.callback(station.close)
        if run.faults is not None:
            schedule_faults(laboratory, faults, run.faults)
        description = station.description
        slots = description.slots(run.protocol)
        planned = plan(run.protocol, parameters, slots)
        expected = planned if rehearsal is None else rehearsal.widened(planned)
        warnings = _checked(run, description, expected, guarded=guardian is not None, attended=operator_is_there)
        if (reason := interrupts.abort_reason) is not None:
            raise AbortError(f"ended by {reason} before anything moved")
        files = dict(original.files) if original else given_files(run.protocol, stated, rig_file, run.faults)
        models = [] if dashboard_class is None else [*models_among(files, "the files of the run").values()]
        meta = _asked(run, attachment, rig_file)
        # One zero for all times: the epoch of the record.
        zero, epoch = clock.now(), clock.date()
        meta |= metadata(run.protocol, stated, description, slots, planned, epoch)
        resumption = None
        if again is not None:
            resumption = again.fed(run.protocol, parameters, slots, description, clock, by_hand=guardian is None)
        elif original:
            meta["repeats"] = original.meta["run"]
            for difference in differences(original.meta, meta):
                print_plain(console, f"not as in the original: {difference}")
        folder = again.folder if again is not None else new.make(run.folder, run_name(run.protocol, meta))
        if again is None:
            locks = stack.enter_context(Locks(Holder.of_this_process(rig_file.name, f"run {folder}")))
            locks.take_folder(folder)
        with _written_into(folder):
            if guardian is not None:
                began = (meta if again is None else again.meta)["epoch"]
                guardian.promise(_PREPARATION, "the run is prepared")
                guardian.keep_record(folder, run.notify, facts_of(meta, folder), began)
            if again is None:
                (folder / RIG_FILE_NAME).write_text(rig_file.text, encoding="utf-8")
        meta["run"] = folder.name
        meta["rehearsal"] = None if rehearsal is None else rehearsal.to_json()
        signals = description.signals + trace_signals(run.protocol, description, slots)
        patience = rig_file.telemetry.period if clock.sleep_waits else None
        if again is not None and resumption is not None:
            changes = [str(each) for each in differences(again.latest, meta)]
            journal = again.reopen(folder / FILE_NAME, resumption, meta, changes, clock.now(), patience)
        else:
            given = files | {RIG_FILE_NAME: rig_file.text.encode()}
            # A run on the virtual clock moves nothing, and is done again in the time that its flushes would take.
            flushed = clock.sleep_waits
            journal = Journal(folder / FILE_NAME, signals, meta, given, patience=patience, flushed=flushed)
        stack.callback(journal.close)
        interrupts.leave_by(partial(_leave, station=station, journal=journal.path))
        observers: list[Any] = []
        dashboard = None
        if dashboard_class is not None:
            path = folder / RECORDING_NAME if run.recording else None
            dashboard = stack.enter_context(dashboard_class(signals, meta, path=path, live=run.live, models=models))
            observers.append(dashboard)
            journal.when_short = dashboard.stop_recording
            if run.live:
                _open_view(dashboard, console)
        length = _expectation(rehearsal, planned)
        progress = ProgressDisplay(console, run.protocol.name, signals, _shown(description), length, clock.factor)
        observers.append(stack.enter_context(DetachedObserver(progress)))
        if notifier is not None:
            notifier.signals = tuple(signal.name for signal in signals)
            notifier.facts = facts_of(meta, folder)
            if guardian is not None:
                notifier.is_told = lambda: guardian.is_told
            observers.append(stack.enter_context(notifier))
        # A run on the virtual clock is over before anybody could look at it.
        mailbox = stack.enter_context(RunMailbox(folder, interrupts)) if clock.sleep_waits else None
        ask: Callable[[Question], str] | None = Dialogue(
            console, progress, mailbox, at_terminal=operator_is_there
        ).ask
        if not operator_is_there and mailbox is None:
            ask = None
        engine = Engine(station, journal, observers, interrupts, ask, zero, notifier, run.changes)
        if again is None:
            engine.warn(warnings)
        new.keep()
        outcome = engine.run(run.protocol, parameters, resumption)
        if dashboard is not None:
            dashboard.finish(outcome.status, outcome.reason, outcome.lateness)
    interrupts.finish()
    return RunResult(folder, outcome, stopwatch.seconds())


@contextmanager
def _written_into(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"the folder of the run, {folder}, cannot be written: {error.strerror or error}; nothing has moved"
        ) from None


def _open_view(dashboard: Dashboard, console: Console) -> None:
    """Open the viewer of a live view where there is a display, else say how to."""
    from bench.dashboard.viewers import has_display, open_viewer

    if dashboard.uri is not None and has_display():
        open_viewer(dashboard.uri)
        print_plain(console, f"live view: {dashboard.uri}; bench watch opens it again")
    else:
        console.print(f"live view: run [bold]rerun {dashboard.uri}[/] in another terminal", highlight=False)


def _checked(
    run: Run, description: RigDescription, expected: Plan, *, guarded: bool, attended: bool
) -> tuple[str, ...]:
    """Check what is known before anything moves; return what is accepted only as an operator is present."""
    check_before_moving(description, run.protocol, expected)
    file = description.file
    if expected.prompts and not (file.emulated or attended):
        raise ConfigurationError(
            f"protocol {run.protocol.name} asks the operator {expected.prompts} times to do something by hand; "
            "run it in a terminal, where an operator can answer"
        )
    if not guarded:
        return ()
    return (
        *check_start(description, interval=1.0 / file.safety.rate, interval_key="safety.rate"),
        *overdue_calibrations(file, wall_time().astimezone().date()),
    )


def _shown(description: RigDescription) -> tuple[str, ...]:
    """Return the signals that the progress display shows."""
    layout = description.file.dashboard
    return (layout.input, layout.output) if layout else tuple(signal.name for signal in description.signals[:2])


def _asked(run: Run, attachment: Attachment | None, rig: RigFile) -> dict[str, Any]:
    """Return what the record says of how the run was asked for."""
    return {
        "rig_given": str(Path(run.rig).resolve()) if run.rig.endswith(".toml") else run.rig,
        "overrides": dict(run.overrides),
        "seed": run.seed,
        "interlock_rate": _interlock_rate(run, rig),
        "clock": run.clock if attachment is None else f"attached x{attachment.clock.factor:g}",
        "laboratory_epoch": None if attachment is None else attachment.clock.epoch.isoformat(),
    }


def foresee(run: Run, console: Console, interrupts: Interrupts | None = None) -> Rehearsal:
    """Return what a run would do and touch: rehearsed, or planned if its rig has no twin; nothing moves.

    A rig without a twin is connected, to know its limits.

    Raises
    ------
    ConfigurationError
        If anything is wrong before the start.
    DeviceError
        If a device of a rig without a twin cannot be connected.
    AbortError
        If the rehearsal was asked to end.
    """
    rig_file, _, parameters = _read(run)
    if run.faults is not None:
        # None of them happens in a rehearsal, but a file that the run would refuse is refused here, too.
        read_schedule(run.faults)
    with ExitStack() as stack:
        if interrupts is None:
            interrupts = stack.enter_context(Interrupts(say_at_once))
        interrupts.leave_by(_leave)
        rehearsal = _rehearsed(run, rig_file, parameters, console, interrupts)
        if rehearsal is None:
            clock, attachment = _clock(run, rig_file, stack)
            station, _ = _connected(run, rig_file, clock, attachment)
            stack.callback(station.close)
            description = station.description
            expected = plan(run.protocol, parameters, description.slots(run.protocol))
            check_before_moving(description, run.protocol, expected)
            rehearsal = Rehearsal.of_plan(description, run.protocol, expected)
    interrupts.finish()
    return rehearsal


def _read(run: Run) -> tuple[RigFile, ProtocolParameters, ProtocolParameters]:
    """Return the rig file, the parameters as they are stated, and with the paths of files that can be read."""
    original = run.original
    rig_file = (original and original.rig) or load_rig(run.rig, run.overrides)
    defaults = rig_file.protocols.get(run.protocol.name)
    stated = run.protocol.parse(run.settings, rig_file.roles, defaults, path=rig_file.path)
    return rig_file, stated, original.readable(run.protocol, stated) if original else stated


def _rehearsed(
    run: Run, file: RigFile, parameters: ProtocolParameters, console: Console, interrupts: Interrupts
) -> Rehearsal | None:
    """Rehearse a run on the twin of its rig; return None if it has none."""
    twin = twin_of(file, run.rig)
    if twin is None:
        console.print(
            f"not rehearsed: rig {file.name} has no emulated twin; its file can name one: [rig] twin",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
        return None
    with RehearsalDisplay(console, f"rehearsing {run.protocol.name} on {twin.name}") as display:
        return rehearse(
            run.protocol,
            parameters,
            twin,
            rig=file.name,
            seed=run.seed,
            interlock_rate=_interlock_rate(run, file),
            interrupts=interrupts,
            observers=[display],
        )


def _expectation(rehearsal: Rehearsal | None, planned: Plan) -> Expectation | None:
    """Return when the steps of a run are expected to end, None if that is not known."""
    if rehearsal is not None:
        return Expectation(rehearsal.marks, rehearsal.seconds, rehearsal.at_most)
    # A plan with steps that may take much longer than their least time says nothing of the end.
    if planned.complete and planned.at_most <= _DEFINITE * planned.seconds:
        marks = tuple(enumerate(planned.finished, 1))
        return Expectation(marks, planned.seconds, planned.at_most)
    return None


def _interlock_rate(run: Run, file: RigFile) -> float | None:
    """Return how often the interlocks of a run are looked at beside its readings, Hz; None for not at all."""
    return run.interlock_rate if run.attach is None and file.in_process else file.safety.rate


def _connected(
    run: Run, file: RigFile, clock: Clock, attachment: Attachment | None, again: Interrupted | None = None
) -> tuple[Station, object]:
    """Connect the rig of a run; return its station, and the emulated laboratory if there is one."""
    continue_time = None if again is None else partial(again.continue_time, clock)
    if run.attach is None and file.in_process:
        # A laboratory that begins at 0 has the room that the run has by now.
        rig = Rig(file, clock, run.seed, continue_time)
        return LocalStation(rig, run.interlock_rate), rig.laboratory
    if continue_time is not None:
        continue_time()
    doing = f"a run of {run.protocol.name}, recorded below {run.folder.resolve()}"
    guarded = GuardedRig(file, run.rig, run.overrides, run.attach, run.seed, doing)
    return RemoteStation(guarded, clock), attachment


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
    ending = Ending("aborted", text, safe_state)
    if journal is not None:
        # The guardian asks a bench that hangs to end as well.
        ending = ending_of(journal.parent) or ending
        abandon(journal, ending)
    text = ending.reason
    # The terminal may hang as well.
    saying = threading.Thread(target=say_at_once, args=(text,), daemon=True)
    saying.start()
    saying.join(_LAST_WORDS)
    os._exit(AbortError.exit_code if ending.status == "aborted" else GuardianError.exit_code)


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
        print_plain(console, f"no recording: {error}")
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
