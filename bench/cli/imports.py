"""The command that makes a run of somebody else's measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import counted, print_plain
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.data_options import ReadingGroup, offer_groups, print_assumptions
from bench.cli.printing import console


@offer_groups
def import_(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Table of measurements (text, .mat, .xlsx, .h5, .tdms, .npz, .parquet)."),
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
    from bench.analysis import import_file

    check_outputs(json_file=json_file, folder=out, read=[file])
    found = import_file(
        file,
        input_column=input_column,
        output_column=output_column,
        others=others or (),
        time_column=time_column,
        title=title,
        out=out,
        reading=reading,
    )
    print_assumptions(file.name, found.assumptions)
    console.print(counted(found.rows, "reading"), highlight=False)
    print_plain(console, f"run: {found.folder}")
    write_json(json_file, {"folder": str(found.folder), "rows": found.rows, "assumptions": found.assumptions})
