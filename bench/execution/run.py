"""A run from its start to the safe state."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from bench.base import Interrupts, Stopwatch, say_at_once
from bench.execution.context import Run, RunContext, _clock, _connected, _leave, _read, _rehearsed
from bench.execution.engine import Outcome, check_before_moving
from bench.execution.rehearsal import Rehearsal
from bench.execution.resumption.interrupted import Interrupted
from bench.protocol import plan
from bench.rig import read_schedule


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
        The run that died and is taken up; see `bench.execution.resume`.

    Raises
    ------
    ConfigurationError
        If anything is wrong before the start, or there is no library for the live view; nothing has moved.
    DeviceError
        If a device cannot be connected; nothing has moved.
    """
    stopwatch = Stopwatch()
    with RunContext(run, console, interrupts, again) as context:
        context.begin()
        context.rehearse()
        context.connect()
        context.check()
        context.open_record()
        context.open_views()
        outcome = context.carry_out()
    context.interrupts.finish()
    return RunResult(context.folder, outcome, stopwatch.seconds())


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
