"""The command that exports a model for another controller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bench.base import ConfigurationError, print_plain
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.printing import console, print_rows, show_compilation


@show_compilation()
def deploy_(
    model: Annotated[
        Path,
        typer.Argument(metavar="MODEL", help="Model file; with --fmu also the rig file of a twin, for its specimen."),
    ],
    c: Annotated[
        Path | None, typer.Option("--c", metavar="FOLDER", help="Write a header, a C99 source, main.c and a README.")
    ] = None,
    real: Annotated[Literal["float", "double"], typer.Option("--real", help="Type of the numbers.")] = "float",
    fmu: Annotated[
        Path | None,
        typer.Option("--fmu", metavar="FILE.fmu", help="Write a functional mock-up unit for co-simulation."),
    ] = None,
    fmi: Annotated[Literal["2.0", "3.0"], typer.Option("--fmi", help="Version of FMI.")] = "2.0",
    inverse: Annotated[
        bool, typer.Option("--inverse", help="Let the unit be the inverse: from target to input.")
    ] = False,
    controller: Annotated[
        str | None,
        typer.Option(
            "--controller",
            metavar="NAME",
            help="Write this controller too: follow.closed-loop-inverse or follow.open-loop-inverse of `following`, "
            "target.closed-loop-inverse or target.open-loop-inverse of `tracking`.",
        ),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option("--rig", metavar="RIG", help="Whose limits and rest set-point the controller has."),
    ] = None,
    tuning: Annotated[
        Path | None, typer.Option("--tuning", metavar="FILE.toml", help="Tuning file of the controller.")
    ] = None,
    name: Annotated[str, typer.Option("--name", help="Prefix of the functions, and name of the files.")] = "model",
    period: Annotated[
        float | None,
        typer.Option("--period", metavar="SECONDS", help="Time of a step, of a controller or a model with time."),
    ] = None,
    max_bytes: Annotated[
        int | None,
        typer.Option("--max-bytes", min=1, metavar="N", help="Most bytes of code and constants."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Export a model, its inverse and its memory as C99 or as a functional mock-up unit (FMI), to run elsewhere.

    The functions are `NAME_init`, `NAME_step` (input to output), `NAME_invert` (target to input, and whether it
    can be met), `NAME_save` and `NAME_restore`. They allocate nothing, and every loop has a bound.
    """
    from bench.api import deploy
    from bench.deployment import write_fmu
    from bench.identification import load_model
    from bench.rig import load_rig
    from bench.specimen import TwinTable

    if c is None and fmu is None:
        raise ConfigurationError("bench model deploy: say what to write, by --c FOLDER or --fmu FILE.fmu")
    if c is None and any(each is not None for each in (controller, rig, tuning)):
        raise ConfigurationError("--controller, --rig and --tuning are for C; say where to write it, by --c FOLDER")
    if fmu is not None and fmu.suffix != ".fmu":
        raise ConfigurationError(f"--fmu {fmu}: expected a name that ends with .fmu")
    check_outputs(folder=c, json_file=json_file, read=[model])
    if model.suffix == ".toml":
        if c is not None or fmu is None or inverse or period is not None:
            raise ConfigurationError(
                f"{model}: of a twin only --fmu FILE.fmu is written, without --inverse or --period"
            )
        settings = load_rig(str(model)).laboratory_settings
        if not isinstance(settings, TwinTable):
            raise ConfigurationError(
                f"{model}: expected a model file, or a rig file that bench model twin has written"
            )
        write_fmu(settings, fmu, version=fmi)
        print_plain(console, f"FMU: {fmu}")
        write_json(json_file, {"fmu": str(fmu), "fmi": fmi})
        return
    file = load_model(model)
    said: dict[str, object] = {}
    if c is not None:
        found = deploy(
            file, c, name=name, real=real, period=period, max_bytes=max_bytes, controller=controller, rig=rig,
            tuning=tuning,
        )  # fmt: skip
        rows = {"constants": found.constants, "code": found.code, "state": found.state}
        print_rows(f"{model.name} in {real}", [(what, f"{count} bytes") for what, count in rows.items()])
        print_plain(console, f"C: {c}")
        said |= {"folder": str(c), "files": sorted(found.files), "sha256": found.digest, **rows}
    if fmu is not None:
        write_fmu(file, fmu, what="inverse" if inverse else "operator", version=fmi, period=period)
        print_plain(console, f"FMU: {fmu}")
        said |= {"fmu": str(fmu), "fmi": fmi}
    write_json(json_file, said)
