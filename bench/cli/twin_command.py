"""The command that makes a twin of the present specimen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import print_plain
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.printing import console, print_rows, show_compilation
from bench.cli.run_names import find_run


@show_compilation()
def twin_(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN", help="Runs: a characterization, and best also creep.", parser=find_run),
    ],
    rig: Annotated[str, typer.Option("--rig", metavar="RIG", help="The rig of the runs: a name, or a rig file.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.toml", help="Rig file of the twin to write.")],
    model: Annotated[
        Path | None,
        typer.Option("--model", metavar="FILE", help="Model of the specimen; identified from the runs if not given."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Make an emulated twin of the present specimen from what was measured on it.

    Its drive and response follow what is identified from the runs: hysteresis, dynamics, noise, wander and drift. Try
    a protocol on it by `bench run PROTOCOL --rig FILE.toml --clock virtual`.
    """
    from bench.specimen import write_twin

    check_outputs(out=out, json_file=json_file, read=[*runs, *([] if model is None else [model])])
    twin = write_twin(runs, rig, out, model)
    print_rows(f"twin of {rig}", twin.rows())
    print_plain(console, f"rig file: {out}")
    write_json(json_file, {"rig": rig, "out": str(out), **twin.summary()})
