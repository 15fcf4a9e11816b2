"""The command that calibrates a sensor from a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import print_plain
from bench.cli.command_support import JsonOption, check_outputs, console, print_rows, write_json


def calibrate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run of a calibration protocol.")],
    sensor: Annotated[str, typer.Option(metavar="SIGNAL", help="Signal of the sensor.")],
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="SIGNAL", help="Signal of the reference; if not given, the values that steps have as labels."
        ),
    ] = None,
    name: Annotated[str, typer.Option(metavar="TEXT", help="What the reference is, for the file.")] = "",
    uncertainty: Annotated[
        float, typer.Option(min=0.0, help="Standard uncertainty of the reference, in the unit of the sensor.")
    ] = 0.0,
    out: Annotated[
        Path | None, typer.Option(metavar="calibration.json", help="Where the calibration file goes.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Calibrate a sensor: what is to be added to its readings, and how well that is known.

    `accuracy` is the standard uncertainty of the mean of corrected readings against the reference, that of the
    reference included; `repeatability` the standard deviation of one reading about the mean of many, which no
    calibration removes. A rig file applies the file by a derived signal: kind = "calibrated", source = SIGNAL,
    calibration = "calibration.json".
    """
    from bench.analysis import calibrate_run

    check_outputs(out=out, json_file=json_file, read=[run])
    found = calibrate_run(run, sensor, reference, reference_name=name, reference_uncertainty=uncertainty)
    unit = found.unit
    corrections = found.correction([found.low, 0.5 * (found.low + found.high), found.high]).tolist()
    rows = [
        ("reference", f"{found.reference}, {found.calibrated}"),
        ("range", f"{found.low:.6g} to {found.high:.6g} {unit}, {found.readings} readings"),
        ("correction at its ends and middle", ", ".join(f"{each:.3g}" for each in corrections) + f" {unit}"),
        ("coefficients", str(len(found.coefficients))),
        ("accuracy (standard uncertainty)", f"{found.uncertainty:.3g} {unit}"),
        ("repeatability (one reading)", f"{found.repeatability:.3g} {unit}"),
        ("late against the reference by", f"{1e3 * found.lateness:.3g} ms"),
    ]
    print_rows(f"calibration of {sensor}", rows)
    if out is not None:
        found.save(out)
        print_plain(console, f"calibration: {out}")
    write_json(json_file, found.model_dump(mode="json"))
