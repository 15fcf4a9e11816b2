"""Commands of the muscles: entries of the group `bench.commands`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bench.base import print_plain
from bench.cli import JsonOption, console, print_rows, write_json


def identify_muscle(
    force_run: Annotated[Path, typer.Argument(metavar="FORCE_RUN", help="A run of force-voltage.")],
    length_runs: Annotated[
        list[Path], typer.Argument(metavar="LENGTH_RUN...", help="Runs of length-voltage and of length-force.")
    ],
    model: Annotated[
        Literal["two-stage", "two-stage-prandtl-ishlinskii", "summed", "linear"],
        typer.Option(metavar="NAME", help="two-stage, two-stage-prandtl-ishlinskii, summed or linear."),
    ] = "two-stage",
    verify: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A run that verifies the model, such as of length-verification."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="model.json", help="Where the model file goes.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Identify a model among voltage, force and length of a muscle from the runs that characterized it.

    The two-stage model is length = H2[force - H1[voltage]]; the protocols length-control and force-control use it.
    Errors are the average and the RMS in percent of the measured range.
    """
    from bench.identification import measure_series
    from rigs.muscles import identification as muscle

    series = [one for run in length_runs for one in muscle.read_series(run)]
    found = muscle.identify_muscle(model, muscle.read_resting(force_run), series)
    errors = dict(found.errors)
    if verify is not None:
        errors["verification"] = measure_series(found.model, muscle.read_series(verify))
    rows = [(kind, f"average {e.average_percent:.2f} %, RMS {e.rms_percent:.2f} %") for kind, e in errors.items()]
    rows += [(f"smoothing, {stage}", f"{weight:.0e}") for stage, weight in found.smoothing.items()]
    rows += [(f"KKT residual, {stage}", f"{fit.kkt_residual:.1e}") for stage, fit in found.certificates.items()]
    print_rows(f"{model} from {len(series)} series of lengths", rows)
    if out is not None:
        dynamics = muscle.identify_muscle_dynamics(found.model, force_run, length_runs)
        muscle.muscle_file(model, found, [force_run, *length_runs], dynamics).save(out)
        print_plain(console, f"model: {out}")
    write_json(
        json_file,
        {
            "model": model,
            "series": len(series),
            "errors": {kind: muscle.errors_json(e) for kind, e in errors.items()},
            "kkt": {stage: fit.kkt_residual for stage, fit in found.certificates.items()},
            "smoothing": dict(found.smoothing),
        },
    )
