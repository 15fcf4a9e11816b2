"""The commands about records: report, and runs list, export, import, repair and compare."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.text import Text

from bench.base import ConfigurationError, RecordError, aligned, counted, format_duration, print_plain, print_table
from bench.cli.command_support import FigureFormatOption, JsonOption, check_outputs, parse_assignments, write_json
from bench.cli.data_options import ReadingGroup, offer_groups, print_assumptions
from bench.cli.printing import console, show_compilation
from bench.cli.run_names import BEFORE, NEWEST, NO_RUNS, RECORDINGS, RunArgument

if TYPE_CHECKING:
    from bench.analysis import ListedRun


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
    from bench.analysis import report_run
    from bench.batch import published_of
    from bench.identification import load_model

    files = [load_model(path) for path in models or []]
    result = report_run(run, files, out, console, figure_format=figures, published=published_of(run))
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


_STYLES = {"completed": "", "running": "green", "unfinished": "yellow"}


def runs_(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to look, at any depth.")] = RECORDINGS,
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

    # The first run makes it.
    runs = [] if folder == RECORDINGS and not folder.exists() else list_runs(folder)
    _check_named("--protocol", protocol, [run.protocol for run in runs])
    _check_named("--rig", rig, [run.rig for run in runs])
    found = select_runs(
        runs,
        parse_assignments("--where", where or []),
        status=status,
        protocol=protocol,
        rig=rig,
    )
    if runs:
        _print_runs(folder, found)
    console.print(counted(len(found), "run") if runs else f"{folder} {NO_RUNS}")
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
    for line, listed in zip(aligned(rows), [None, *runs], strict=True):
        style = "bold" if listed is None else _STYLES.get(listed.status, "red")
        console.print(Text(line, style), soft_wrap=True)
        if listed is not None:
            parameters = ", ".join(f"{name}={value}" for name, value in listed.changed.items())
            for text in filter(None, (parameters, listed.result, _named(listed.folder, folder))):
                console.print(Text(f"    {text}"), soft_wrap=True)


def _named(run: Path, folder: Path) -> str:
    """Return where a run is below a folder; if it is that folder, its name."""
    return folder.resolve().name if run == folder else str(run.relative_to(folder))


@offer_groups
def import_(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="Table of measurements (text, .mat, .xlsx, .h5, .tdms, .npz, .parquet, .json)."
        ),
    ],
    input_column: Annotated[
        str, typer.Option("--input", metavar="COLUMN", help="Column of the input, or FILE:COLUMN.")
    ],
    output_column: Annotated[
        str, typer.Option("--output", metavar="COLUMN", help="Column of the output, or FILE:COLUMN.")
    ],
    others: Annotated[
        list[str] | None, typer.Option("--column", metavar="COLUMN", help="A further column; repeatable.")
    ] = None,
    time_column: Annotated[
        str | None,
        typer.Option("--time", metavar="COLUMN", help="Column of times; if not given, one that is called so."),
    ] = None,
    title: Annotated[str, typer.Option(metavar="TEXT", help="Title of the rig; the name of the file if empty.")] = "",
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the folder of the run is made.")] = Path(
        "recordings"
    ),
    json_file: JsonOption = None,
    *,
    reading: ReadingGroup,
) -> None:
    """Make a run of a file of measurements of another program: each row becomes a reading.

    `bench report`, `bench identify` and `bench runs` then take its folder as that of any run. The file is kept in the
    record. Without times or --format interval=TIME, rows are 1 s apart; the time of day is that of the file.
    """
    from bench.analysis import ColumnNames, import_file

    check_outputs(json_file=json_file, folder=out, read=[file])
    names = ColumnNames(input_column, output_column, time_column, others=tuple(others or ()))
    found = import_file(file, names, title=title, out=out, reading=reading)
    print_assumptions(file.name, found.assumptions)
    console.print(counted(found.rows, "reading"))
    print_plain(console, f"run: {found.folder}")
    write_json(json_file, {"folder": str(found.folder), "rows": found.rows, "assumptions": found.assumptions})


def repair(
    journal: RunArgument = NEWEST,
    second: Annotated[
        list[Path] | None,
        typer.Option(
            "--second", metavar="FILE", help="Second file of the journal that is not where it was left; repeatable."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Repaired copy; journal.recovered.sqlite beside the journal if not given."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Say how far a journal is good, and write a repaired copy of it if it is not; the journal itself stays.

    Each row is compared with its checksum. The copy has the good rows, and those that wait in a second file because
    the journal could not be written or is damaged.

    Exit codes: 0 no row is lost; 2 the copy cannot be written; 3 it is no journal; 8 rows are lost.
    """
    from bench.record import recover

    check_outputs(json_file=json_file, read=[journal, *(second or [])])
    found = recover(journal, second or [], out)
    rows = [
        (name, *(str(cell or "-") for cell in (state.good, state.added, state.missing, state.first_bad)))
        for name, state in found.tables.items()
    ]
    print_table(console, ("table", "good", "from a second file", "lost", "first bad row"), rows, framed=False)
    said = [f"status: {found.status}"]
    if found.problem:
        said.append(f"SQLite finds: {found.problem}")
    said += [f"second file: {path}" for path in found.second_files]
    said.append("the journal is whole" if found.copy is None else f"repaired copy: {found.copy}")
    for line in said:
        print_plain(console, line)
    write_json(
        json_file,
        {
            "journal": str(found.journal),
            "status": found.status,
            "problem": found.problem,
            "tables": {name: asdict(state) for name, state in found.tables.items()},
            "second_files": [str(path) for path in found.second_files],
            "copy": None if found.copy is None else str(found.copy),
            "is_complete": found.is_complete,
        },
    )
    if not found.is_complete:
        sys.exit(RecordError.exit_code)


def compare(
    first_run: RunArgument = BEFORE,
    second_run: RunArgument = NEWEST,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Page of the comparison with figures, in one file.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Compare two runs: what they were given, how they ended, and how far each signal is apart at equal steps.

    Shown is what differs in parameters, rig, instruments, versions and files.
    """
    from bench.analysis import compare_runs, print_parts
    from bench.record import Record

    check_outputs(html=html, json_file=json_file, read=[first_run, second_run])
    with Record(first_run) as first, Record(second_run) as second:
        found = compare_runs(first, second)
        for title, parts in found.sections().items():
            print_parts(parts, console, title.lower())
        if html is not None:
            from bench.analysis import comparison_page, write_page

            write_page(html, comparison_page(first, second, found))
            print_plain(console, f"page: {html}")
    write_json(json_file, found.to_json())
