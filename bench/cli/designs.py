"""The command that designs experiments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.analysis import ReadingOptions
from bench.base import ConfigurationError, closest, print_plain, print_table, show_patience
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.data_options import ReadingGroup, offer_groups
from bench.cli.printing import console, print_rows, show_compilation
from bench.cli.run_names import find_run

if TYPE_CHECKING:
    from bench.identification import Continuation


@offer_groups
@show_compilation()
def design(
    rig: Annotated[
        str | None, typer.Option("--rig", metavar="RIG", help="Rig whose range, plane and dwell are taken.")
    ] = None,
    plane: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Ends of the Preisach plane; the rig's if not given."),
    ] = None,
    operating: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--range", metavar="LOW HIGH", help="Operating range, which contains the plane; the rig's if not given."
        ),
    ] = None,
    levels: Annotated[int, typer.Option(min=2, max=60, help="Discretization levels of the plane.")] = 20,
    dwell: Annotated[
        float | None, typer.Option(min=0.0, help="Settling time at each set-point, s; the rig's if not given.")
    ] = None,
    sequence: Annotated[
        str | None, typer.Option(metavar="NAME", help="Sequence of the table whose set-points are written.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="model.json", help="Model that is to be measured further, with --continue.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Measurements of the model, or their run.", parser=find_run)
    ] = None,
    input_column: Annotated[
        str | None, typer.Option("--input", metavar="COLUMN", help="Their input column; the model's if not given.")
    ] = None,
    hours: Annotated[
        float | None,
        typer.Option("--continue", min=0.0, metavar="HOURS", help="Time for which to measure a model further."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="File for the set-points, as the protocol `sequence` takes them."),
    ] = None,
    json_file: JsonOption = None,
    *,
    reading: ReadingGroup,
) -> None:
    """Compare excitation sequences: what each tells about a plane, and the laboratory time that it takes.

    The damped oscillation of the papers, first-order reversal curves, the shortest sequence that covers every cell,
    and the same twice as fine with two set-points a level, which averages noise. Each is a protocol:
    damped-oscillation, first-order-reversals, covering. `--sequence NAME --out sequence.csv` writes one; `bench run
    sequence --set setpoints=sequence.csv` carries it out.

    `cells` are those covered, `rank` how many of the coefficients are determined.
    `log det / h` is log10 of the determinant of the information that an hour of the sequence gives, in decades per
    coefficient; it comes closest to the order of the errors on other inputs. `variance` is the mean variance of
    predictions over random reversals after the sequence once, in variances of the noise, without constraints of sign,
    which lower it. The condition number does not order the errors; it says how exactly the coefficients can be
    computed.

    `bench model design --model model.json --data FILE --continue HOURS` goes on from measurements: it adds damped
    tails, each where it tells most per second. Each tail visits its first maximum again: outputs that differ there by
    more than the noise say that the specimen has no return-point memory, so that no Preisach model fits it.
    """
    from bench.analysis import assess_designs, write_sequence

    check_outputs(out=out, json_file=json_file, read=[path for path in (model, data) if path is not None])
    unit = ""
    if rig is not None:
        from bench.rig import load_rig

        file = load_rig(rig)
        drive = file.roles.get("drive")
        operating = operating or (drive.range if drive else None)
        dwell = dwell if dwell is not None else (drive.dwell if drive else None)
        plane = plane or (file.dashboard.plane if file.dashboard else None)
        unit = (drive.unit if drive else None) or ""
    if hours is not None or model is not None or data is not None:
        if hours is None or model is None or data is None or dwell is None:
            raise ConfigurationError("to go on, give --model, --data, --continue, and --dwell or --rig")
        if sequence is not None:
            raise ConfigurationError("--sequence is of the table; --continue makes a sequence of its own")
        _continue(model, data, input_column, hours, dwell, out, json_file, reading)
        return
    if input_column is not None or reading != ReadingOptions():
        raise ConfigurationError("--input and how a file is read are for --model, --data and --continue")
    if plane is None or operating is None or dwell is None:
        raise ConfigurationError("give --rig RIG, or --plane, --range and --dwell")
    if (sequence is None) != (out is None):
        raise ConfigurationError("--sequence NAME and --out FILE.csv belong together")
    found = assess_designs(plane, operating, levels, dwell)
    if sequence is not None and sequence not in found:
        known = closest(sequence, found)
        raise ConfigurationError(f"--sequence {sequence!r}: there is no such sequence; {known}")
    result = {name: each.assessment for name, each in found.items()}
    heads = ("sequence", "set-points", "cells", "rank", "condition", "log det / h", "variance", "time")
    rows = [
        (
            name, str(each.setpoints), f"{each.covered}/{each.cells}", f"{each.rank}/{each.coefficients}",
            f"{each.condition:.2g}", f"{each.log_determinant:.3f}", f"{each.prediction_variance:.2g}",
            f"{each.time / 3600:.2f} h",
        )
        for name, each in result.items()
    ]  # fmt: skip
    print_table(console, heads, rows, f"excitation of {levels * (levels + 1) // 2} cells", numbers_from=1)
    if sequence is not None and out is not None:
        write_sequence(out, found[sequence].setpoints, unit=unit, dwell=dwell)
        _print_sequence(out, found[sequence].setpoints.size)
    write_json(json_file, {name: vars(entry) for name, entry in result.items()})


def _continue(
    path: Path,
    data: Path,
    input_column: str | None,
    hours: float,
    dwell: float,
    out: Path | None,
    json_file: Path | None,
    reading: ReadingGroup,
) -> None:
    from bench.analysis import continue_file, write_sequence
    from bench.identification import load_model

    model = load_model(path)
    with show_patience(f"designing {hours:g} h of measurements", console):
        found = continue_file(
            model, data, input_column=input_column, seconds=3600.0 * hours, dwell=dwell, reading=reading
        )
    print_rows(f"continuation of {data.name} for {path.name}", _continuation_lines(found, model.operator.input_unit))
    if out is not None:
        write_sequence(out, found.setpoints, unit=model.operator.input_unit, dwell=dwell)
        _print_sequence(out, found.setpoints.size)
    write_json(
        json_file,
        {
            "setpoints": int(found.setpoints.size),
            "time": found.time,
            "tails": [{"center": tail.center, "reach": tail.reach} for tail in found.tails],
            "visits": [list(pair) for pair in found.visits],
            "log_determinant": {"before": found.before, "after": found.after, "repeated": found.repeated},
            "prediction_variance": {
                "before": found.variance_before, "after": found.variance_after, "repeated": found.variance_repeated
            },
        },
    )  # fmt: skip


def _continuation_lines(found: Continuation, unit: str) -> list[tuple[str, str]]:
    centers = sorted(tail.center for tail in found.tails)
    shown = f" {unit}" if unit else ""
    first = found.visits[0]
    return [
        ("set-points", f"{found.setpoints.size}, {found.time / 3600.0:.2f} h"),
        ("damped tails", f"{len(centers)}, about {centers[0]:.4g} to {centers[-1]:.4g}{shown}"),
        (
            "log10 det",
            f"{found.before:.3f} → {found.after:.3f} decades per coefficient; the data repeated for the same time: "
            f"{found.repeated:.3f}",
        ),
        (
            "prediction variance",
            f"{found.variance_before:.3g} → {found.variance_after:.3g} variances of the noise over random reversals; "
            f"the data repeated: {found.variance_repeated:.3g}",
        ),
        (
            "return-point test",
            f"{len(found.visits)} maxima are visited twice, such as rows {first[0] + 1} and {first[1] + 1}: "
            "equal outputs within the noise allow a Preisach-type model",
        ),
    ]


def _print_sequence(path: Path, count: int) -> None:
    print_plain(console, f"{count} set-points: {path}; bench run sequence --rig RIG --set setpoints={path}")
