"""The command that calibrates a sensor from a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import counted, print_plain
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.printing import console, print_rows
from bench.cli.run_names import NEWEST, RunArgument


def calibrate(
    run: RunArgument = NEWEST,
    *,
    sensor: Annotated[str, typer.Option(metavar="SIGNAL", help="Signal of the sensor.")],
    uncertainty: Annotated[
        float,
        typer.Option(metavar="U", help="Standard uncertainty of the reference, in its unit, by its certificate."),
    ],
    interval: Annotated[int, typer.Option(min=1, metavar="DAYS", help="Days for which the calibration holds.")],
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="SIGNAL", help="Signal of the reference; if not given, the values that steps have as labels."
        ),
    ] = None,
    name: Annotated[
        str, typer.Option(metavar="TEXT", help="What the reference is, and its certificate; its signal if not given.")
    ] = "",
    degrees_of_freedom: Annotated[
        float | None,
        typer.Option(metavar="N", help="Degrees of freedom of that uncertainty; infinitely many if not given."),
    ] = None,
    gain_uncertainty: Annotated[
        float, typer.Option(metavar="SHARE", help="Standard uncertainty of the scale of the reference, as a share.")
    ] = 0.0,
    unit: Annotated[
        str, typer.Option(metavar="UNIT", help="Unit of the reference where it is not that of the sensor, such as °.")
    ] = "",
    out: Annotated[
        Path | None, typer.Option(metavar="calibration.json", help="Where the calibration file goes.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Calibrate a sensor from a run of a calibration protocol: what its readings mean, and how well that is known.

    `accuracy` is the standard uncertainty of the mean of calibrated readings, that of the reference included;
    `repeatability` the standard deviation of one reading about the mean of many, which no calibration removes. A rig
    file applies the calibration by a derived signal: kind = "calibrated", source = SIGNAL, calibration =
    "calibration.json". A run says before it starts, and its report afterwards, if the calibration is older than its
    interval; one of another instrument is refused.
    """
    from bench.analysis import Reference, calibrate_run

    check_outputs(out=out, json_file=json_file, read=[run])
    named = name or reference or "values that were set up"
    found = calibrate_run(
        run, sensor, Reference(named, uncertainty, interval, reference, unit, degrees_of_freedom, gain_uncertainty)
    )
    unit = found.reference_unit
    values = found.value([found.low, 0.5 * (found.low + found.high), found.high]).tolist()
    rows = [
        ("reference", f"{found.reference}, {found.reference_uncertainty:.3g} {unit} (standard uncertainty)"),
        ("holds", f"from {found.date} to {found.due}"),
        ("instrument", found.serial_number or "tells no serial number"),
        ("range", f"{found.low:.6g} to {found.high:.6g} {found.unit}, {counted(found.readings, 'reading')}"),
        ("values at its ends and middle", ", ".join(f"{each:.6g}" for each in values) + f" {unit}"),
        ("coefficients", str(len(found.coefficients))),
        ("accuracy (standard uncertainty)", f"{found.uncertainty:.3g} {unit}"),
        ("repeatability (one reading)", f"{found.repeatability:.3g} {unit}"),
        ("late against the reference by", f"{1e3 * found.lateness:.3g} ms"),
    ]
    print_rows(f"calibration of {sensor}", rows)
    if out is not None:
        found.save(out)
        print_plain(console, f"calibration: {out}")
    write_json(json_file, {**found.model_dump(mode="json"), "accuracy": found.uncertainty})
