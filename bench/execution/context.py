"""What a run has at hand, from its rig file to its views: each method is one stage of a run."""

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

from bench.base import (
    AbortError,
    Clock,
    ConfigurationError,
    Expectation,
    GuardianError,
    Interrupts,
    MissingExtraError,
    needed_for,
    print_plain,
    say_at_once,
    wall_time,
)
from bench.devices import Signal
from bench.execution.accuracy import check_accuracy
from bench.execution.detached_observer import DetachedObserver
from bench.execution.dialogue import Dialogue
from bench.execution.engine import Engine, Outcome, check_before_moving
from bench.execution.guardian.remote import STACKS_NAME, RemoteStation
from bench.execution.notify import Notifier, facts_of
from bench.execution.rehearsal import Rehearsal, rehearse
from bench.execution.resumption.interrupted import Interrupted
from bench.execution.station.interface import Station
from bench.execution.station.local import LocalStation
from bench.execution.terminal import ProgressDisplay, RehearsalDisplay
from bench.identification import models_among
from bench.operator import Question, RunMailbox
from bench.protocol import LATENESS, TRACES, ParameterChange, Plan, ProtocolDefinition, ProtocolParameters, plan
from bench.record import (
    BLACK_BOX_NAME,
    FILE_NAME,
    RIG_FILE_NAME,
    Ending,
    Journal,
    NewFolder,
    Original,
    abandon,
    differences,
    ending_of,
    given_files,
    metadata,
    run_name,
)
from bench.rig import (
    Attachment,
    Holder,
    Locks,
    Rig,
    RigDescription,
    RigFile,
    Slots,
    attach,
    calibration_warnings,
    check_start,
    clock_for,
    load_rig,
    read_schedule,
    schedule_faults,
    shortened_absences,
    twin_of,
)

if TYPE_CHECKING:
    from bench.dashboard import Dashboard

RECORDING_NAME = "run.rrd"
_DEFINITE = 1.1
"""Longest time of a plan over its shortest, up to which it says when the run ends."""
_SHOWN = 3
"""Most readings beside the progress of a run. Derivation: a line of 80 columns has room for three."""
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
    clock : str or None
        `wall`, `virtual` or `xN`; see `bench.base.clock.make_clock`. None is `virtual` where all instruments are
        emulated in this process, else `wall`.
    folder : Path
        Where the folder of the run is made.
    live : bool
        Whether to serve the live view on the loopback interface.
    recording : bool
        Whether to write the .rrd beside the journal while the run goes on.
    attach : Path, optional
        Endpoints file of `bench rig emulate`: the emulated laboratory is served there, on its own clock and seed.
    interlock_rate : float, optional
        Looks at the interlocks of an emulated rig in a laboratory second, Hz, beside each reading and tick; on
        hardware the rig file says it, `[safety] rate`.
    faults : Path, optional
        Faults of the emulated laboratory, at instants from the start of the run; see `bench.rig.fault_schedule`.
    original : Original, optional
        The run that this one repeats: its files are read in the place of those that `settings` name, and its rig is
        taken if it has one.
    rehearse : bool
        Whether the run is rehearsed on the emulated twin of the rig before anything moves. A run on the virtual clock
        is not, as it would take as long itself.
    notify : tuple of str
        Who is sent messages at a pause, a prompt, a warning, a trip and the end, also that of a bench which hung or
        died; see `bench.execution.notify`.
    accuracy : str or None
        Largest expanded uncertainty (95 %) of the controlled signal that is accepted, in its unit or with one: a run
        whose budget does not support it is refused. None for any.
    changes : tuple of ParameterChange
        Parameters that are changed on the way, as in the run that is repeated.
    rig_file : RigFile, optional
        The rig, if it was read already; it is taken in the place of the one that `rig` and `overrides` name.
    """

    protocol: ProtocolDefinition
    settings: Mapping[str, Any]
    rig: str
    folder: Path
    overrides: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    clock: str | None = "wall"
    live: bool = False
    recording: bool = True
    attach: Path | None = None
    interlock_rate: float | None = None
    faults: Path | None = None
    original: Original | None = None
    rehearse: bool = True
    notify: tuple[str, ...] = ()
    accuracy: str | None = None
    changes: tuple[ParameterChange, ...] = ()
    rig_file: RigFile | None = None


class RunContext(ExitStack):
    """A run on its way: leaving the context closes whatever was opened, last first.

    Parameters
    ----------
    run : Run
        What to run.
    console : Console
        Where progress is shown.
    interrupts : Interrupts, optional
        At work already, and for longer than the run; without them the run has its own.
    again : Interrupted, optional
        The run that died and is taken up.

    Attributes
    ----------
    rig_file : RigFile
        The rig, with its overrides.
    parameters : ProtocolParameters
        Of the protocol, with the paths of files that can be read.
    clock : Clock
        Of the run.
    station : Station
        The connected rig, after `connect`.
    folder : Path
        Of the run, after `open_record`.
    """

    def __init__(
        self, run: Run, console: Console, interrupts: Interrupts | None = None, again: Interrupted | None = None
    ) -> None:
        super().__init__()
        self.rig_file, self._stated, self.parameters = _read(run)
        if run.clock is None:
            run = replace(run, clock="virtual" if self.rig_file.in_process and run.attach is None else "wall")
        self.run, self._console, self._again = run, console, again
        self._faults = () if run.faults is None else read_schedule(run.faults)
        self._notifier = Notifier(run.notify) if run.notify else None
        self._dashboard_class = _dashboard_class(run, console)
        self._dashboard: Dashboard | None = None
        self._is_attended = sys.stdin is not None and sys.stdin.isatty()
        self._observers: list[Any] = []
        self._rehearsal: Rehearsal | None = None
        self._accuracy: dict[str, Any] | None = None
        self._interrupts = interrupts

    def begin(self) -> None:
        """Open the clock, and have Ctrl-C and the signals of the system end the run."""
        self.clock, self._attachment = _clock(self.run, self.rig_file, self)
        given = self._interrupts
        self.interrupts = self.enter_context(Interrupts(say_at_once)) if given is None else given
        self.clock.interrupted = self.interrupts.abort_requested
        # A guardian makes the devices safe as soon as this process is gone.
        self.interrupts.leave_by(_leave)

    @property
    def guardian(self) -> RemoteStation | None:
        """The station, if a guardian holds the rig."""
        return self.station if isinstance(self.station, RemoteStation) else None

    def rehearse(self) -> None:
        """Rehearse the run; a run on the virtual clock is not, as it would take as long itself."""
        run = self.run
        if run.rehearse and self._again is None and run.clock != "virtual":
            self._rehearsal = _rehearsed(run, self.rig_file, self.parameters, self._console, self.interrupts)
        elif self.clock.sleep_waits:
            # Loading the filters takes a second, as a rehearsal would have done: no device waits for that later.
            import_module("filterpy.kalman")
        if self._rehearsal is not None:
            self._rehearsal.raise_if_wrong()

    def connect(self) -> None:
        """Connect the rig; nothing moves."""
        # Removed again after all that may write there is closed.
        self._new = self.enter_context(NewFolder((RECORDING_NAME, BLACK_BOX_NAME), (STACKS_NAME,)))
        self.station, laboratory = _connected(self.run, self.rig_file, self.clock, self._attachment, self._again)
        # The lines only: the engine brings the devices into their safe state, and says how that went.
        self.callback(self.station.close)
        if self.run.faults is not None:
            schedule_faults(laboratory, self._faults, self.run.faults)

    def check(self) -> None:
        """Plan the run, and refuse it if anything is wrong that can be known before it moves."""
        description = self.station.description
        self._slots = description.slots(self.run.protocol)
        self._planned = plan(self.run.protocol, self.parameters, self._slots)
        expected = self._planned if self._rehearsal is None else self._rehearsal.widened(self._planned)
        self._warnings = _checked(
            self.run,
            description,
            expected,
            guarded=self.guardian is not None,
            attended=self._is_attended,
        )
        if self.run.accuracy is not None:
            self._accuracy = check_accuracy(
                self.run.accuracy, self.run.protocol, self.parameters, description, self._slots
            )
        if (reason := self.interrupts.abort_reason) is not None:
            raise AbortError(f"ended by {reason} before anything moved")

    def open_record(self) -> None:
        """Make the folder of the run and its journal, or open those of the run that died."""
        run, again, description = self.run, self._again, self.station.description
        if run.original:
            files = dict(run.original.files)
        else:
            files = given_files(run.protocol, self._stated, self.rig_file, run.faults)
        self._models = (
            [] if self._dashboard_class is None else [*models_among(files, "the files of the run").values()]
        )
        # One zero for all times: the epoch of the record.
        self._zero, epoch = self.clock.now(), self.clock.date()
        meta = _asked(run, self._attachment, self.rig_file)
        meta |= metadata(run.protocol, self._stated, description, self._slots, self._planned, epoch)
        if again is not None:
            by_hand = self.guardian is None
            again.feed(run.protocol, self.parameters, self._slots, description, self.clock, by_hand=by_hand)
        elif run.original:
            meta["repeats"] = run.original.meta["run"]
            for difference in differences(run.original.meta, meta):
                print_plain(self._console, f"not as in the original: {difference}")
        self.folder = again.folder if again is not None else self._new.make(run.folder, run_name(run.protocol, meta))
        self._take_folder(meta)
        meta["run"] = self.folder.name
        meta["accuracy"] = self._accuracy
        meta["rehearsal"] = None if self._rehearsal is None else self._rehearsal.to_json()
        self._signals = description.signals + trace_signals(run.protocol, description, self._slots)
        self._meta = meta
        self._journal = self._open_journal(files)
        self.callback(self._journal.close)
        self.interrupts.leave_by(partial(_leave, station=self.station, journal=self._journal.path))

    def open_views(self) -> None:
        """Show the run to people: dashboard, progress in the terminal, messages."""
        run, console, description = self.run, self._console, self.station.description
        if self._dashboard_class is not None:
            path = self.folder / RECORDING_NAME if run.recording else None
            self._dashboard = self.enter_context(
                self._dashboard_class(self._signals, self._meta, path=path, live=run.live, models=self._models)
            )
            self._observers.append(self._dashboard)
            self._journal.when_short = self._dashboard.stop_recording
            if run.live:
                _open_view(self._dashboard, console)
        length = _expectation(self._rehearsal, self._planned)
        self._progress = ProgressDisplay(
            console,
            run.protocol.name,
            self._signals,
            _shown(run.protocol, description, self._slots),
            length,
            self.clock.factor,
        )
        self._observers.append(self.enter_context(DetachedObserver(self._progress)))
        if (notifier := self._notifier) is not None:
            notifier.signals = tuple(signal.name for signal in self._signals)
            notifier.facts = facts_of(self._meta, self.folder)
            if (guardian := self.guardian) is not None:
                notifier.is_told = lambda: guardian.is_told
            self._observers.append(self.enter_context(notifier))

    def carry_out(self) -> Outcome:
        """Carry the protocol out, up to the safe state of every device; return how it ended."""
        run = self.run
        # A run on the virtual clock is over before anybody could look at it.
        mailbox = self.enter_context(RunMailbox(self.folder, self.interrupts)) if self.clock.sleep_waits else None
        ask: Callable[[Question], str] | None = None
        if self._is_attended or mailbox is not None:
            ask = Dialogue(self._console, self._progress, mailbox, at_terminal=self._is_attended).ask
        engine = Engine(
            self.station,
            self._journal,
            self._observers,
            self.interrupts,
            ask,
            self._zero,
            self._notifier,
            run.changes,
        )
        if self._again is None:
            engine.warn(self._warnings)
        self._new.keep()
        outcome = engine.run(run.protocol, self.parameters, self._again)
        if self._dashboard is not None:
            self._dashboard.finish(outcome.status, outcome.reason, outcome.lateness)
        return outcome

    def _take_folder(self, meta: dict[str, Any]) -> None:
        """Lock the folder of the run, have the guardian keep its record there, and write the rig file into it."""
        again, folder, file = self._again, self.folder, self.rig_file
        if again is None:
            locks = self.enter_context(Locks(Holder.of_this_process(file.name, f"run {folder}")))
            locks.take_folder(folder)
        with _written_into(folder):
            if (guardian := self.guardian) is not None:
                began = (meta if again is None else again.meta)["epoch"]
                guardian.promise(_PREPARATION, "the run is prepared")
                guardian.keep_record(folder, self.run.notify, facts_of(meta, folder), began)
            if again is None:
                (folder / RIG_FILE_NAME).write_text(file.text, encoding="utf-8")

    def _open_journal(self, files: dict[str, bytes]) -> Journal:
        path, meta, clock, again = self.folder / FILE_NAME, self._meta, self.clock, self._again
        patience = self.rig_file.telemetry.period if clock.sleep_waits else None
        if again is not None:
            changes = [str(difference) for difference in differences(again.latest, meta)]
            return again.reopen(path, meta, changes, clock.now(), patience)
        given = files | {RIG_FILE_NAME: self.rig_file.text.encode()}
        # A run on the virtual clock moves nothing, and is done again in the time that its flushes would take.
        return Journal(path, self._signals, meta, given, patience=patience, flushed=clock.sleep_waits)


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
    from bench.dashboard import has_display, open_viewer

    if dashboard.uri is not None and has_display():
        open_viewer(dashboard.uri)
        print_plain(console, f"live view: {dashboard.uri}; bench view opens it again")
    else:
        print_plain(console, f"live view: run rerun {dashboard.uri} in another terminal")


def _checked(
    run: Run, description: RigDescription, expected: Plan, *, guarded: bool, attended: bool
) -> tuple[str, ...]:
    """Check what is known before anything moves; return warnings."""
    check_before_moving(description, run.protocol, expected)
    file = description.file
    if expected.prompts and not (file.emulated or attended):
        raise ConfigurationError(
            f"protocol {run.protocol.name} asks the operator {expected.prompts} times to do something by hand; "
            "run it in a terminal, where an operator can answer"
        )
    # By the calendar: laboratory time may begin in any year.
    warnings = calibration_warnings(file, wall_time().astimezone().date())
    # Of the default nobody expects that it counts for every device.
    if "reconnect" in file.safety.model_fields_set:
        shortened = shortened_absences(description, guarded=guarded)
        warnings = (*(f"{file.path}: {each}" for each in shortened), *warnings)
    if not guarded:
        return warnings
    return (*check_start(description, interval=1.0 / file.safety.rate, interval_key="safety.rate"), *warnings)


def _shown(protocol: ProtocolDefinition, description: RigDescription, slots: Slots) -> tuple[str, ...]:
    """Return the signals that the progress display shows: those of the slots, or those that the protocol names."""
    if slots:
        return tuple(dict.fromkeys(slot.signal for slot in slots.values()))[:_SHOWN]
    named = tuple(name for name in protocol.names if name in description.by_name)
    layout = description.file.dashboard
    return named[:_SHOWN] or ((layout.input, layout.output) if layout else tuple(description.by_name)[:2])


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


def _read(run: Run) -> tuple[RigFile, ProtocolParameters, ProtocolParameters]:
    """Return the rig file, the parameters as they are stated, and with the paths of files that can be read."""
    original = run.original
    rig_file = run.rig_file or (original and original.rig) or load_rig(run.rig, run.overrides)
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
            soft_wrap=True,
        )
        return None
    with RehearsalDisplay(f"rehearsing {run.protocol.name} on {twin.name}", console) as display:
        return rehearse(
            run.protocol,
            parameters,
            twin,
            rig=file.name,
            seed=run.seed,
            interlock_rate=_interlock_rate(run, file),
            guarded=run.attach is not None or not file.in_process,
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
    return RemoteStation(clock, file, run.rig, run.overrides, run.attach, run.seed, doing), attachment


def _clock(run: Run, file: RigFile, stack: ExitStack) -> tuple[Clock, Attachment | None]:
    """Return the clock of a run, and the served laboratory that it is of."""
    if run.attach is None:
        return clock_for(file, run.clock or "wall"), None
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
    """Import the dashboard if the run needs it; say so if it is not installed, or raise if a live view needs it."""
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
    traces = (replace(trace, unit=signal.unit, precision=signal.precision, extent=signal.extent) for trace in TRACES)
    return (*traces, LATENESS)
