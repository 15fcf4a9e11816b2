"""The command that puts a rig, or a run in progress, under the operator's hands."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from bench.base import ConfigurationError, check_extra, needed_for
from bench.cli.command_support import AttachOption, OverrideOption, SeedOption, parse_assignments
from bench.cli.printing import print_error
from bench.cli.run_commands import print_result


def panel(
    rig: Annotated[
        str, typer.Argument(metavar="RIG|RUN", help="A packaged rig, a rig file, or the folder of a run in progress.")
    ],
    seed: SeedOption = 0,
    clock: Annotated[str, typer.Option(help="wall; on emulated rigs also xN, N times as fast.")] = "wall",
    attach: AttachOption = None,
    overrides: OverrideOption = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Parent of the record's folder.")] = Path("recordings"),
) -> None:
    """Move the devices of a rig by hand, or watch a run in progress and answer its questions.

    Every signal with its reading, its course and its margin to the nearest limit; commands at the bottom: set, ramp,
    hold, tare, zero, safe, note. Limits and interlocks are those of a run, everything is in a journal, and the rig is
    locked. Leaving, Ctrl-C, a closed terminal and any error end in the safe state.

    With the folder of a run that goes on in another process, the panel shows its record, can ask for a pause or the
    end, and answers at a pause. Closing the panel does not end the run.

    Exit codes: those of `bench run`.
    """
    check_extra("bench panel", "textual", "panel")
    if clock == "virtual":
        raise ConfigurationError("--clock virtual: nobody can follow it by hand; expected wall or xN")
    from bench.panel import HandsOnRig, RunInProgress, carry_out_by_hand

    with needed_for("bench panel", "panel"):
        from bench.panel import Panel
    if Path(rig).is_dir() or rig.endswith(".sqlite"):
        Panel(RunInProgress(Path(rig))).run()
        return

    from bench.base import Interrupts
    from bench.operator import Desk

    desk = Desk()
    with Interrupts() as interrupts:
        work = partial(
            carry_out_by_hand,
            desk,
            rig=rig,
            overrides=parse_assignments("--override", overrides or []),
            seed=seed,
            clock=clock,
            attach=attach,
            folder=out,
            interrupts=interrupts,
        )
        hands = HandsOnRig(rig, desk, work)
        try:
            if hands.is_connected():
                Panel(hands).run()
        finally:
            # The display may have died of a terminal that is gone.
            hands.leave()
            hands.wait()
        if hands.error is not None:
            print_error(hands.error)
            raise SystemExit(hands.error.exit_code)
        print_result(hands.result, None, can_resume=False)
