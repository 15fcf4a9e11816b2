"""Runs on the command line: a folder, the beginning of its name, or `@N` for the newest but N - 1."""

from __future__ import annotations

import glob
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from bench.base import ConfigurationError, counted
from bench.cli.printing import error_console

RECORDINGS = Path("recordings")
"""Where runs are looked for by name."""

NO_RUNS = "has no runs; bench run makes one"
"""What is said of a folder without any."""

NEWEST = Path("@1")
BEFORE = Path("@2")

_STAMP = re.compile(r"\d{8}-\d{6}(?:-\d+)?$")


def newest_runs(folder: Path) -> list[Path]:
    """Return the folders of the runs below a folder, the newest start first."""
    from bench.record import find_journals

    def started(run: Path) -> str:
        stamp = _STAMP.search(run.name)
        return stamp[0] if stamp else f"{datetime.fromtimestamp(run.stat().st_mtime, UTC):%Y%m%d-%H%M%S}"

    return sorted((journal.parent for journal in find_journals(folder)), key=started, reverse=True)


def find_run(given: str | Path) -> Path:
    """Return the folder of a run, or a file; what is neither is left to who reads it.

    Raises ConfigurationError if there are not so many runs, or several names begin so.
    """
    text = str(given)
    if match := re.fullmatch(r"@(\d+)", text):
        runs, number = newest_runs(RECORDINGS), int(match[1])
        if not 1 <= number <= len(runs):
            there = f"has {counted(len(runs), 'run')}" if runs else NO_RUNS
            raise ConfigurationError(f"{text}: {RECORDINGS} {there}" if text != "@1" else f"{RECORDINGS} {there}")
        error_console.print(f"run: {runs[number - 1]}", style="dim", soft_wrap=True)
        return runs[number - 1]
    path = Path(text)
    if path.is_dir():
        runs = newest_runs(path)
        return runs[0] if runs and path not in runs else path
    if not path.exists():
        places = (path.parent,) if path.parent != Path() else (Path(), RECORDINGS)
        found = [
            run for place in places for run in place.glob(f"{glob.escape(path.name)}*") if newest_runs(run) == [run]
        ]
        if len(found) > 1:
            names = ", ".join(sorted(run.name for run in found)[:4])
            raise ConfigurationError(f"{text}: {len(found)} runs begin so: {names}{', …' * (len(found) > 4)}")
        path = found[0] if found else path
    return path


def complete_run(incomplete: str) -> list[str]:
    """Return the names of runs that begin so, for the completion of a shell."""
    return [run.name for run in newest_runs(RECORDINGS) if run.name.startswith(incomplete)]


_HELP = (
    "Folder of a run, its journal, the beginning of its name, or @2 for the newest but one; the newest if not given."
)
RunArgument = Annotated[
    Path,
    typer.Argument(metavar="RUN", help=_HELP, parser=find_run, autocompletion=complete_run, show_default=False),
]
