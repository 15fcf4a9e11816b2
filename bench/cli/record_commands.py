"""The commands that report and export runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bench.base import print_plain
from bench.cli.command_support import FigureFormatOption, JsonOption, write_json
from bench.cli.printing import console, show_compilation
from bench.cli.run_names import NEWEST, RunArgument


@show_compilation()
def report(
    run: RunArgument = NEWEST,
    models: Annotated[
        list[Path] | None,
        typer.Option("--model", metavar="FILE", help="Model file to compare; repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for figures and page; if not given, `report` and `report.html` in the folder of the run.",
        ),
    ] = None,
    figures: FigureFormatOption = "png",
    json_file: JsonOption = None,
) -> None:
    """Tables, figures and a page of a run: what happened, extremes, margins, and how models do on it.

    The page is one HTML file that needs nothing else: for a log book, or to hand out. Models that are kept with the
    run are compared without being named: those of `bench identify` without --out, and what the run itself corrected.
    Works while the run goes on; the page then says so.
    """
    from bench.analysis import PAGE_NAME, report_run
    from bench.batch import published_of
    from bench.identification import load_model

    files = [load_model(path) for path in models or []]
    published = published_of(run)
    page = (out or (run if run.is_dir() else run.parent)) / PAGE_NAME
    result = report_run(run, files, out, console, page=page, figure_format=figures, published=published)
    write_json(json_file, result)


@show_compilation()
def export(
    run: RunArgument = NEWEST,
    *,
    format_: Annotated[
        Literal["csv", "parquet", "bluesky", "rrd", "png"], typer.Option("--format", help="Format of the files.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to write to; the folder of the run if not given.")
    ] = None,
    escape_formulas: Annotated[
        bool,
        typer.Option(
            "--escape-formulas/--formulas",
            help="csv: put an apostrophe before a text, such as a note or what an instrument answered, that a "
            "spreadsheet would carry out as a formula (it begins with =, +, -, @, a tab or a carriage return, and is "
            "no number); or write every text as it was recorded.",
        ),
    ] = True,
    json_file: JsonOption = None,
) -> None:
    """Write a run's readings and telemetry for other programs, or rebuild its recording for the viewer.

    csv and parquet: `readings` (one row a step), `telemetry` (one row a tick) and `events`, units in the headers;
    metadata in `metadata.json` or the schema. bluesky: `documents.jsonl`, documents of event-model as JSON lines.
    rrd: the recording, rebuilt from the journal. png: a picture of the dashboard, drawn without a screen.
    """
    from bench.analysis import export_run

    paths = export_run(run, format_, out, escape_formulas=escape_formulas)
    for path in paths:
        print_plain(console, f"{path}")
    write_json(json_file, {"files": [str(path) for path in paths]})
