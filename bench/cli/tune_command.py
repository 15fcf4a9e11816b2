"""The command that tunes a controller for a specimen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import print_plain, write_result
from bench.cli.command_support import JsonOption, check_outputs, parse_assignments, write_json
from bench.cli.printing import console, print_rows, show_compilation


@show_compilation()
def tune_(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file of the specimen.")],
    rig: Annotated[str, typer.Option("--rig", metavar="RIG", help="The rig of the specimen.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.toml", help="Tuning file to write.")],
    twin: Annotated[
        str | None,
        typer.Option(
            "--twin", metavar="RIG", help="Emulated rig on which it is tuned; if not given, the twin of the rig."
        ),
    ] = None,
    controller: Annotated[
        str, typer.Option("--controller", metavar="NAME", help="The controller.")
    ] = "closed-loop-inverse",
    protocol: Annotated[
        str | None,
        typer.Option("--protocol", metavar="NAME", help="length-control or force-control, of a two-stage model."),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Parameter of the protocol; repeatable.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Sessions of each run.")] = 2,
    checks: Annotated[
        int, typer.Option(min=2, max=100, help="Further sessions, in which the result has to be better as well.")
    ] = 8,
    rounds: Annotated[int, typer.Option(min=1, max=10, help="How often each number is changed.")] = 2,
    time_weight: Annotated[
        float, typer.Option(min=0.0, help="Part of the RMS error before that costs as much as the time before.")
    ] = 0.25,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Worker processes; as many as cores if not given.")
    ] = None,
    runs: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the runs.")] = Path("recordings/tuning"),
    json_file: JsonOption = None,
) -> None:
    """Tune a controller for a specimen, by runs on its emulated twin.

    The numbers of the controller are changed one after another, and all together. What counts is the RMS error, and
    by --time-weight the time at each target, as multiples of those before; half by the model as it is, half by the
    worst of models by which the specimen has another gain or time constant, so that what is chosen has margins of
    stability. If it is not better in sessions that the search has not seen, by more than chance, the numbers stay as
    they are. Use the file by `bench run ... --set tuning=FILE`.
    """
    from bench.batch import tune

    check_outputs(out=out, json_file=json_file, read=[model])
    found = tune(
        model, rig, twin=twin, controller=controller, protocol=protocol,
        settings=parse_assignments("--set", settings or []), seeds=seeds, checks=checks, rounds=rounds,
        time_weight=time_weight, workers=workers, folder=runs, console=console,
    )  # fmt: skip
    write_result(out, found.text())
    print_rows(f"{controller} on {found.twin}", found.rows())
    print_plain(console, f"tuning: {out}")
    write_json(json_file, found.summary())
