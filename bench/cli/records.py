"""The commands that report and export runs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from bench.cli.console import JsonOption, console, show_compilation, write_json
from bench.printing import print_plain

app = typer.Typer()


@app.command()
@show_compilation()
def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or its journal.")],
    models: Annotated[
        list[Path] | None,
        typer.Option("--model", metavar="FILE", help="Model file to compare; repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for figures; the folder `report` of the run if not given."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Tables and figures of a run: what happened, the extremes of every signal, and how models do on it.

    Models that were identified from this run are compared without being named. Works while the run goes on.
    """
    from bench.model_file import load_model
    from bench.results.report import report_run

    result = report_run(run, [load_model(path) for path in models or []], out, console)
    write_json(json_file, result)


class ExportFormat(StrEnum):
    """What a run can be exported to."""

    CSV = "csv"
    PARQUET = "parquet"
    RRD = "rrd"
    PNG = "png"


@app.command()
@show_compilation()
def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or its journal.")],
    format_: Annotated[ExportFormat, typer.Option("--format", help="Format of the files.")],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to write to; the folder of the run if not given.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Write a run's readings and telemetry for other programs, or rebuild its recording for the viewer.

    csv and parquet: `readings` (one row a step) and `telemetry` (one row a tick), units in the headers. rrd: the
    recording, rebuilt from the journal. png: a picture of the dashboard, drawn without a screen.
    """
    from bench.results.report import export_run

    paths = export_run(run, format_.value, out)
    for path in paths:
        print_plain(console, f"{path}")
    write_json(json_file, {"files": [str(path) for path in paths]})
