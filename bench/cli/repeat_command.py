"""The command that repeats a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import print_plain
from bench.cli.command_support import (
    JsonOption,
    LiveOption,
    check_outputs,
    console,
    parse_assignments,
    show_compilation,
    warn,
)
from bench.cli.run_commands import print_result

app = typer.Typer()


@app.command()
def repeat(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or its journal.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Parent of the new run's folder.")] = Path("recordings"),
    rig: Annotated[
        str | None,
        typer.Option("--rig", metavar="RIG", help="Rig of a run on hardware, or at a served laboratory (--attach)."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--override", metavar="KEY=VALUE", help="Replace a value of that rig's file; repeatable."),
    ] = None,
    attach: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Endpoints file of `bench emulate --json`, for a run that had one."),
    ] = None,
    live: LiveOption = False,
    json_file: JsonOption = None,
) -> None:
    """Carry a run out again from its record alone, and say whether the same came out.

    Protocol, parameters, seed, clock and faults are those of the record, and so is the content of every file that
    the run was given: the originals may be gone. A run that was emulated has its rig from the record as well; on the
    virtual clock its values come out equal to the last bit. Any other run is repeated on the rig that you name, and
    what differs from the record is printed before anything moves.

    A record is code: its protocol and the modules of its rig file are run as they were kept.
    """
    from bench.analysis import compare_runs
    from bench.base import Interrupts
    from bench.execution import repeat as carry_out_again, say_what_ctrl_c_does
    from bench.record import Record

    check_outputs(json_file=json_file, folder=out, read=[run])
    with Interrupts(say_what_ctrl_c_does) as interrupts:
        with show_compilation():
            found = carry_out_again(
                run,
                out=out,
                console=console,
                rig=rig,
                overrides=parse_assignments("--override", overrides or []),
                attach=attach,
                live=live,
                interrupts=interrupts,
            )
        with Record(found.original) as before, Record(found.result.folder) as now:
            comparison = compare_runs(before, now)
        equal = comparison.equal
        if all(equal.values()):
            console.print(f"as the original: {', '.join(equal)} are equal to the last bit", highlight=False)
        else:
            differ = ", ".join(name for name, same in equal.items() if not same)
            text = f"{differ} differ from the original: bench compare {found.original} {found.result.folder}"
            if found.is_exact:
                warn(text)
            else:
                print_plain(console, text)
        print_result(found.result, json_file, {"repeats": str(found.original), **comparison.to_json()})
