"""The commands that compare: models on measurements, and two runs with each other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import percent, print_plain, print_table, show_patience, significant
from bench.cli.band_options import BandsOption, Recalibrating, print_applied
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.data_options import FiguresOption, ReadingGroup, SkipOption, offer_groups, print_assumptions
from bench.cli.model_commands import InitialOption
from bench.cli.printing import console, show_compilation, warn
from bench.cli.run_names import BEFORE, NEWEST, RunArgument, find_run
from bench.cli.written import print_figures, write_rows


@offer_groups
@show_compilation()
def models_on_data(
    compared: Annotated[list[Path], typer.Argument(metavar="MODEL", help="Model files.")],
    data: Annotated[
        Path,
        typer.Option(
            "--data",
            metavar="FILE",
            help="Table of measurements (text, .mat, .xlsx, .h5, .tdms, .npz, .parquet), or a run.",
            parser=find_run,
        ),
    ],
    input_column: Annotated[
        str | None, typer.Option("--input", metavar="COLUMN", help="Input column; the first model's if not given.")
    ] = None,
    output_column: Annotated[
        str | None, typer.Option("--output", metavar="COLUMN", help="Output column; the first model's if not given.")
    ] = None,
    time_column: Annotated[
        str | None, typer.Option("--time", metavar="COLUMN", help="Column of times, for models with time.")
    ] = None,
    skip: SkipOption = None,
    initial: InitialOption = None,
    bands: BandsOption = False,
    *,
    recalibrating: Recalibrating,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="File for input, measured output, and by model the rest."),
    ] = None,
    figures: FiguresOption = None,
    json_file: JsonOption = None,
    reading: ReadingGroup,
) -> None:
    """Compare models on measurements that they may not have seen.

    Each model's errors are shown raw, and after re-zeroing the sensor: between sessions a sensor's offset moves, and
    what a model is worth then is another number. `--out` writes input, measured output and by model `predicted` and
    `residual` (measured minus predicted) of every row. `bench runs compare` compares two runs.
    """
    from bench.analysis import ColumnNames, compare_models, load_models, read_for

    check_outputs(out=out, figures=figures, json_file=json_file, read=(data, *compared))
    session = recalibrating.session()
    with show_patience(f"reading {data.name}", console):
        models = load_models(compared)
        names = ColumnNames(input_column or "", output_column or "", time_column)
        measured = read_for([*models.values()], data, names, reading)
        result = compare_models(models, measured, skip=skip, initial=initial, session=session)
    print_assumptions(data.name, measured.assumptions)
    for warning in result.warnings:
        warn(warning)
    if result.skip:
        console.print(f"rows 1 to {result.skip} are left out of the errors", highlight=False)
    heads = ("model", "max", "RMS", "RMS / %", "offset", "max, offset removed", "RMS, offset removed")
    rows = [
        (
            name, significant(raw.maximum, 4), significant(raw.rms, 4), percent(raw.rms_percent).removesuffix(" %"),
            f"{entry.offset:+.4g}", significant(mended.maximum, 4), significant(mended.rms, 4),
        )
        for name, entry in result.comparisons.items()
        for raw, mended in [(entry.raw, entry.rezeroed)]
    ]  # fmt: skip
    title = f"models on {data.name}, errors in {result.unit or 'output units'}"
    print_table(console, heads, rows, title, numbers_from=1)
    for name, applied in result.applied.items():
        print_applied(applied, name, bands=bands)
    if out is not None:
        write_rows(out, result.applied)
    if figures is not None:
        from bench.analysis import draw_comparison

        print_figures(draw_comparison(result, figures))
    write_json(json_file, result.to_json())


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
