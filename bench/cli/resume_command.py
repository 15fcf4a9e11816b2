"""The command that goes on with a run that died."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli.command_support import JsonOption, LiveOption, NotifyOption, check_outputs
from bench.cli.printing import console, show_compilation
from bench.cli.run_commands import print_result
from bench.cli.run_names import NEWEST, RunArgument


def resume(
    run: RunArgument = NEWEST,
    sigmas: Annotated[
        float,
        typer.Option(min=0.1, max=1000, help="Standard deviations by which the specimen may differ from the record."),
    ] = 5.0,
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="Go on although the protocol's source, the content of the rig or a version has changed; what has "
            "changed is recorded. A protocol that does other than the record says is refused all the same.",
        ),
    ] = False,
    accept_disagreement: Annotated[
        bool,
        typer.Option("--accept-disagreement", help="Go on although the specimen is not as the record left it."),
    ] = False,
    rig: Annotated[
        str | None,
        typer.Option("--rig", metavar="RIG", help="Where the rig file is now, if it was moved."),
    ] = None,
    attach: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Endpoints file of `bench rig emulate --json`, if the run was attached."),
    ] = None,
    notify: NotifyOption = None,
    live: LiveOption = False,
    json_file: JsonOption = None,
) -> None:
    """Go on with a run that was killed, aborted or failed, from its last finished step, in its own record.

    The protocol is started again with its recorded parameters, and the recorded readings are fed back to it: nothing
    is sent, and no time passes. What it yields has to be what the record says. Errors that watchdogs left in the
    instruments when the run died are cleared, no others (see `bench rig clear`). Then the specimen is brought to
    where it was by the corners of the set-points that it still remembers, and its signals are compared with the last
    readings. The step that had not finished is done again, and the run goes on: same record, same numbers of steps,
    same zero of time.

    A run without a finished step, or one that goes on or is completed, is refused; so is one whose protocol, rig or
    versions have changed. docs/reference/resume.md says how the specimen is brought back, and what is refused.

    Exit codes: those of `bench run`; 9 the specimen is not as the record left it, and every device is safe.
    """
    from bench.base import Interrupts, say_at_once
    from bench.execution import Resume, resume as resume_run

    check_outputs(json_file=json_file, read=[run])
    asked = Resume(
        folder=run,
        rig=rig,
        attach=attach,
        sigmas=sigmas,
        accept_changes=accept_changes,
        accept_disagreement=accept_disagreement,
        live=live,
        notify=tuple(notify or ()),
    )
    with Interrupts(say_at_once) as interrupts:
        with show_compilation():
            result = resume_run(asked, console, interrupts)
        print_result(result, json_file)
