"""The command that lists runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from bench.cli.console import JsonOption, console, parse_assignments, write_json

if TYPE_CHECKING:
    from bench.results.run_list import ListedRun

app = typer.Typer()

_STYLES = {"completed": "", "running": "green", "unfinished": "yellow"}


@app.command("runs")
def runs_(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to look, at any depth.")] = Path(
        "recordings"
    ),
    where: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE", help="Only runs with this parameter (or seed, clock, operator); repeatable."
        ),
    ] = None,
    status: Annotated[
        str | None,
        typer.Option(metavar="STATUS", help="Only completed, aborted, failed, running, unfinished or damaged ones."),
    ] = None,
    protocol: Annotated[str | None, typer.Option(metavar="PROTOCOL", help="Only runs of this protocol.")] = None,
    rig: Annotated[str | None, typer.Option("--rig", metavar="RIG", help="Only runs on this rig.")] = None,
    json_file: JsonOption = None,
) -> None:
    """List the runs below a folder in the order of their start: how they ended, what was set, what came out.

    `running` is a run of a process of this computer, `unfinished` one whose process died or is of another computer,
    `damaged` one whose journal cannot be read. Shown are the parameters that differ from their defaults; any can be
    searched for: `bench runs --where controller=integral`.
    """
    from bench.results.run_list import list_runs, select_runs

    found = select_runs(
        list_runs(folder),
        parse_assignments("--where", where or []),
        status=status,
        protocol=protocol,
        rig=rig,
    )
    _print_runs(folder, found)
    console.print(f"{len(found)} runs", highlight=False)
    write_json(json_file, [run.to_json() for run in found])


def _print_runs(folder: Path, runs: list[ListedRun]) -> None:
    """Print a line of short columns a run, and below it what is long."""
    rows = [("started", "status", "protocol", "rig", "duration", "steps")]
    for run in runs:
        duration = "" if run.seconds is None else f"{run.seconds:.0f} s"
        started = run.started[:16].replace("T", " ")
        rows.append((started, run.status, run.protocol, run.rig, duration, str(run.steps)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row, listed in zip(rows, [None, *runs], strict=True):
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        style = "bold" if listed is None else _STYLES.get(listed.status, "red")
        console.print(Text(line, style), soft_wrap=True)
        if listed is not None:
            parameters = ", ".join(f"{name}={value}" for name, value in listed.changed.items())
            for text in filter(None, (parameters, listed.result, str(listed.folder.relative_to(folder)))):
                console.print(Text(f"    {text}"), soft_wrap=True, highlight=False)
