"""`bench study NAME`: a registered study on emulated rigs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.base import ConfigurationError
from bench.cli.command_support import (
    FigureFormatOption,
    JsonOption,
    LiveOption,
    check_outputs,
    parse_assignments,
    write_json,
)
from bench.cli.printing import console


def command_of(name: str, study: Any) -> Callable[..., None]:  # noqa: ANN401 - as `bench.batch.Study`
    """Return the function of the command that carries a study out."""

    def carry_out_study(
        rig: Annotated[
            str | None,
            typer.Option("--rig", metavar="RIG", help="Another rig with the same signals."),
        ] = None,
        set_: Annotated[
            list[str] | None,
            typer.Option(
                "--set",
                metavar="PROTOCOL.KEY=VALUE",
                help="Set a parameter in each run of a protocol; repeatable.",
            ),
        ] = None,
        seed: Annotated[
            int, typer.Option(min=0, help="Seed of all noise in the emulated laboratory and of random sequences.")
        ] = 0,
        out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for runs, models and figures.")] = Path(
            "recordings"
        ),
        live: LiveOption = False,
        workers: Annotated[
            int | None,
            typer.Option(min=1, help="Runs that go on beside each other; as many as there are cores if not given."),
        ] = None,
        figures: FigureFormatOption = "png",
        json_file: JsonOption = None,
    ) -> None:
        from bench.batch import reproduce

        check_outputs(folder=out)
        settings: dict[str, dict[str, str]] = {}
        for name_of_parameter, text in parse_assignments("--set", set_ or []).items():
            protocol, dot, parameter = name_of_parameter.partition(".")
            if not dot:
                raise ConfigurationError(f"--set {name_of_parameter}={text}: expected PROTOCOL.KEY=VALUE")
            settings.setdefault(protocol, {})[parameter] = text
        result = reproduce(
            name,
            study,
            rig=rig,
            seed=seed,
            out=out,
            live=live,
            console=console,
            workers=workers,
            figure_format=figures,
            settings=settings,
        )
        write_json(json_file, result)

    carry_out_study.__doc__ = f"{study.summary}\n\n{study.description}"
    return carry_out_study
