"""The command that lists runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.text import Text

from bench.base import ConfigurationError, counted, format_duration
from bench.cli.command_support import JsonOption, parse_assignments, write_json
from bench.cli.printing import console

if TYPE_CHECKING:
    from bench.analysis import ListedRun


_STYLES = {"completed": "", "running": "green", "unfinished": "yellow"}


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
        Literal["completed", "aborted", "failed", "running", "unfinished", "damaged"] | None,
        typer.Option(metavar="STATUS", help="Only completed, aborted, failed, running, unfinished or damaged ones."),
    ] = None,
    protocol: Annotated[str | None, typer.Option(metavar="PROTOCOL", help="Only runs of this protocol.")] = None,
    rig: Annotated[str | None, typer.Option("--rig", metavar="RIG", help="Only runs on this rig.")] = None,
    json_file: JsonOption = None,
) -> None:
    """List the runs below a folder in the order of their start: how they ended, what was set, what came out.

    `running` is a run of a process of this computer, `unfinished` one whose process died, with no guardian to say
    how, or is of another computer, `damaged` one whose journal is damaged or gone; `bench runs repair` says what
    is left of it. Shown are the parameters that differ from their defaults; any can be searched for:
    `bench runs --where controller=integral`.
    """
    from bench.analysis import list_runs, select_runs

    runs = list_runs(folder)
    _check_named("--protocol", protocol, [run.protocol for run in runs])
    _check_named("--rig", rig, [run.rig for run in runs])
    found = select_runs(
        runs,
        parse_assignments("--where", where or []),
        status=status,
        protocol=protocol,
        rig=rig,
    )
    _print_runs(folder, found)
    console.print(counted(len(found), "run"), highlight=False)
    write_json(json_file, [run.to_json() for run in found])


def _check_named(option: str, name: str | None, there_are: Sequence[str]) -> None:
    """Raise ConfigurationError if runs are found, but none of them is of that name."""
    names = sorted({each for each in there_are if each})
    if name is not None and names and name not in names:
        raise ConfigurationError(f"{option} {name}: no run is of it; there are runs of: {', '.join(names)}")


def _print_runs(folder: Path, runs: list[ListedRun]) -> None:
    """Print a line of short columns a run, and below it what is long."""
    rows = [("started (UTC)", "status", "protocol", "rig", "duration", "steps")]
    for run in runs:
        duration = "" if run.seconds is None else format_duration(run.seconds)
        started = run.started[:16].replace("T", " ")
        rows.append((started, run.status, run.protocol, run.rig, duration, str(run.steps)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row, listed in zip(rows, [None, *runs], strict=True):
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        style = "bold" if listed is None else _STYLES.get(listed.status, "red")
        console.print(Text(line, style), soft_wrap=True)
        if listed is not None:
            parameters = ", ".join(f"{name}={value}" for name, value in listed.changed.items())
            for text in filter(None, (parameters, listed.result, _named(listed.folder, folder))):
                console.print(Text(f"    {text}"), soft_wrap=True, highlight=False)


def _named(run: Path, folder: Path) -> str:
    """Return where a run is below a folder; if it is that folder, its name."""
    return folder.resolve().name if run == folder else str(run.relative_to(folder))
