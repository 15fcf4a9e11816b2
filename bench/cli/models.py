"""The commands that identify and apply models."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from bench.cli.console import (
    JsonOption,
    check_outputs,
    console,
    parse_numbers,
    print_rows,
    show_compilation,
    warn,
    write_json,
)
from bench.cli.data_options import layout_options, print_assumptions, show_patience
from bench.errors import ConfigurationError
from bench.results.reading.options import ReadingOptions

app = typer.Typer()


DataArgument = Annotated[
    Path,
    typer.Argument(
        metavar="FILE", help="Table of measurements (text, .gz, .mat, .xlsx, .parquet), or the folder of a run."
    ),
]
ModelArgument = Annotated[Path, typer.Argument(metavar="model.json", help="A model file.")]
ContinueMemory = Annotated[
    bool,
    typer.Option(
        "--continue-memory", help="Start from the memory at the end of the model's data, not at their start."
    ),
]
InitialOption = Annotated[
    str | None,
    typer.Option(
        "--initial",
        metavar="KIND",
        help="Memory at the first row: file (that at the start of the model's data; if not given), negative or "
        "positive saturation, or unknown: skip the rows that it could reach.",
    ),
]


TimeColumn = Annotated[
    str | None, typer.Option("--time", metavar="COLUMN", help="Column of times, for a model with time.")
]


@app.command("identify")
@layout_options
@show_compilation()
def identify_(
    file: DataArgument,
    input_column: Annotated[str, typer.Option("--input", metavar="COLUMN", help="Input column.")],
    output_column: Annotated[str, typer.Option("--output", metavar="COLUMN", help="Output column.")],
    model: Annotated[str, typer.Option(metavar="NAME", help="Model to fit; `bench list` shows the names.")],
    levels: Annotated[
        int | None,
        typer.Option(min=2, max=1000, help="Discretization levels of the Preisach plane; 20 if not given."),
    ] = None,
    degree: Annotated[
        int | None,
        typer.Option(min=1, max=60, help="Degree of a polynomial: of the model (12) or the reversible part (5)."),
    ] = None,
    plane: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="LOW HIGH", help="Ends of the Preisach plane, in input units; the model's own if not given."
        ),
    ] = None,
    reversible: Annotated[
        str | None,
        typer.Option(metavar="KIND", help="Reversible part beside the density: none, linear, quadratic, polynomial."),
    ] = None,
    smoothing: Annotated[float, typer.Option(min=0.0, help="Weight of the roughness penalty on the density.")] = 0.0,
    skip: Annotated[
        int,
        typer.Option(metavar="ROWS", help="First rows, which drive the memory but are left out of the fit."),
    ] = 0,
    initial: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="Memory at the first row: negative or positive saturation, or unknown: skip the rows that it could "
            "reach, or estimate it.",
        ),
    ] = None,
    time_column: TimeColumn = None,
    static: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Operator within a model with time, such as preisach (hammerstein)."),
    ] = None,
    dynamics: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="What follows the operator: lag, resonance, delay, creep, kelvin-voigt, drift, fading-drift, or "
            "none; chosen by the data if not given (hammerstein).",
        ),
    ] = None,
    orientation: Annotated[
        str,
        typer.Option(
            metavar="KIND",
            help="Whether the output rises or falls with the input: auto (what fits better), rising, falling.",
        ),
    ] = "auto",
    options: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="KEY=VALUE", help="Another numerical option of the model; repeatable."),
    ] = None,
    cross_validate: Annotated[
        bool, typer.Option("--cross-validate", help="Choose the smoothing by cross-validation, and show the table.")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="model.json", help="Model file to write.")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for figures.")] = None,
    json_file: JsonOption = None,
    *,
    reading: ReadingOptions,
) -> None:
    """Identify a hysteresis model from measurements, and say how good it is.

    Columns are named as in the header; a unit at the end, as in `force [N]`, may be left out and goes into the
    model. A number, such as `--input 1`, chooses a column by its place. The layout of a file is found from it and
    printed; `--delimiter`, `--decimal`, `--encoding`, `--skip-lines` and `--table` set it. Of a run, the readings are
    taken: `bench identify RUN --input voltage --output displacement --model preisach --out model.json`.
    """
    from bench.results.models import certificate_lines, identify_file

    check_outputs(out=out, figures=figures, json_file=json_file)
    with show_patience(f"reading and fitting {file.name}"):
        found = identify_file(
            file,
            input_column=input_column,
            output_column=output_column,
            model=model,
            levels=levels,
            degree=degree,
            plane=plane,
            reversible=reversible,
            smoothing=smoothing,
            skip=skip,
            initial=initial,
            time_column=time_column,
            static=static,
            dynamics=dynamics,
            orientation=orientation,
            **parse_numbers("--option", options or ()),
            cross_validated=cross_validate,
            reading=reading,
        )
    print_assumptions(file, found.assumptions)
    if found.trials is not None:
        console.print(f"cross-validation, errors in {found.file.response.output_unit or 'output units'}:")
        console.print(found.trials.table(), highlight=False, markup=False)
    for warning in found.warnings:
        warn(warning)
    print_rows(f"{model} from {file.name}", certificate_lines(found))
    if out is not None:
        found.file.save(out)
        console.print(f"model: {out}", highlight=False, markup=False, soft_wrap=True)
    if figures is not None:
        from bench.results.report import draw_identification

        for path in draw_identification(found, figures):
            console.print(f"figure: {path}", highlight=False, markup=False, soft_wrap=True)
    write_json(json_file, found.summary())


@app.command("predict")
@layout_options
@show_compilation()
def predict_(
    model_path: ModelArgument,
    file: DataArgument,
    input_column: Annotated[str, typer.Option("--input", metavar="COLUMN", help="Input column.")],
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="File for input and prediction.")],
    output_column: Annotated[
        str | None, typer.Option("--output", metavar="COLUMN", help="Measured output, to compare with.")
    ] = None,
    time_column: TimeColumn = None,
    skip: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="ROWS",
            help="First rows, which drive the memory but are left out of the errors; on the model's own data those "
            "that its identification left out.",
        ),
    ] = None,
    initial: InitialOption = None,
    continue_memory: ContinueMemory = False,
    json_file: JsonOption = None,
    *,
    reading: ReadingOptions,
) -> None:
    """Apply a model to a column of inputs, row by row.

    Writes a CSV file with the input column and `predicted`. The model starts from the memory that it had at the start
    of its own data, so that on these data the errors are those of `bench identify`.
    """
    from bench.identification import measure_errors
    from bench.model_file import load_model
    from bench.results.data import read_columns, write_csv
    from bench.results.models import check_unit, errors_json, outside_of_range
    from bench.results.starting_state import starting_state
    from bench.results.times import bind_times, read_times

    check_outputs(out=out, json_file=json_file)
    model = load_model(model_path)
    with show_patience(f"reading {file.name}"):
        names = [name for name in (input_column, output_column, time_column) if name]
        columns = read_columns(file, names, options=reading)
    print_assumptions(file, columns.assumptions)
    inputs = columns.values[input_column]
    check_unit(model.response.input_unit, columns.units[input_column], input_column)
    if warning := outside_of_range(model, inputs):
        warn(warning)
    start = starting_state(model, inputs, initial=initial, skip=skip, continue_memory=continue_memory)
    times = read_times(columns, time_column) if time_column else None
    predicted = bind_times(model, times).evaluate(inputs, start.state)
    write_csv(out, [input_column, "predicted"], [inputs, predicted])
    result: dict[str, Any] = {"model": model.name, "samples": int(inputs.size), "out": str(out)}
    if output_column:
        errors = measure_errors(columns.values[output_column][start.skip :], predicted[start.skip :])
        result |= {**errors_json(errors), "skipped": start.skip}
        unit = model.response.output_unit
        print_rows(
            f"{model.name} on {file.name}",
            (
                ("samples", f"{inputs.size - start.skip} (skipped: {start.skip})"),
                ("largest error", f"{errors.maximum:.4g} {unit} ({errors.maximum_percent:.2f} % of the range)"),
                ("RMS error", f"{errors.rms:.4g} {unit} ({errors.rms_percent:.2f} % of the range)"),
            ),
        )
    console.print(f"{inputs.size} rows: {out}", highlight=False, markup=False, soft_wrap=True)
    write_json(json_file, result)


@app.command()
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
    json_file: JsonOption = None,
) -> None:
    """Compare excitation sequences: what each tells about a plane, and the laboratory time that it takes.

    The damped oscillation of the papers, first-order reversal curves, the shortest sequence that covers every cell,
    and the same twice as fine with two set-points a level, which averages noise. Each is a protocol:
    damped-oscillation, first-order-reversals, covering.
    """
    from bench.results.models import assess_designs

    if rig is not None:
        from bench.rig_file import load_rig

        file = load_rig(rig)
        drive = file.roles.get("drive")
        operating = operating or (drive.range if drive else None)
        dwell = dwell if dwell is not None else (drive.dwell if drive else None)
        plane = plane or (file.dashboard.plane if file.dashboard else None)
    if plane is None or operating is None or dwell is None:
        raise ConfigurationError("give --rig RIG, or --plane, --range and --dwell")
    result = assess_designs(plane, operating, levels, dwell)
    table = Table("sequence", title=f"excitation of {levels * (levels + 1) // 2} cells", title_justify="left")
    for column in ("set-points", "cells covered", "rank / coefficients", "condition", "laboratory time"):
        table.add_column(column, justify="right")
    for name, entry in result.items():
        table.add_row(
            name,
            str(entry.setpoints),
            f"{entry.covered} of {entry.cells}",
            f"{entry.rank} of {entry.coefficients}",
            f"{entry.condition:.2g}",
            f"{entry.time / 3600:.2f} h",
        )
    console.print(table)
    write_json(json_file, {name: vars(entry) for name, entry in result.items()})


class PolicyOption(Enum):
    """Which answer of an inverse is taken."""

    NEAREST: Literal["nearest"] = "nearest"  # type: ignore[misc]  # so that its value is of a literal type
    PAPER: Literal["paper"] = "paper"  # type: ignore[misc]


@app.command()
@layout_options
@show_compilation()
def invert(
    model_path: ModelArgument,
    file: Annotated[
        Path, typer.Argument(metavar="TARGETS.csv", help="Table of targets (text, .gz, .mat, .xlsx, .parquet).")
    ],
    column: Annotated[str, typer.Option("--column", metavar="NAME", help="Column with the targets.")],
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="File for the set-points.")] = Path("setpoints.csv"),
    policy: Annotated[
        PolicyOption,
        typer.Option(help="Choice among several solutions: nearest, or the paper's direction rule."),
    ] = PolicyOption.NEAREST,
    initial: InitialOption = None,
    continue_memory: ContinueMemory = False,
    json_file: JsonOption = None,
    *,
    reading: ReadingOptions,
) -> None:
    """Compute the set-points that bring a model's output to one target after another.

    Writes a CSV file, a row a target: `target`, `passing` (a set-point to pass before, where the target is met
    only after saturation), `setpoint`, `predicted` (the model's output there) and `flag` (`met`, `too high` or
    `too low`; what cannot be met is clamped to the nearest reachable value).
    """
    from bench.model_file import load_model
    from bench.results.data import read_columns, write_csv
    from bench.results.models import check_unit, invert_targets
    from bench.units import header_with_unit

    check_outputs(out=out, json_file=json_file)
    model = load_model(model_path)
    with show_patience(f"reading {file.name}"):
        columns = read_columns(file, [column], options=reading)
    print_assumptions(file, columns.assumptions)
    units = (model.operator.input_unit, model.operator.output_unit)
    check_unit(units[1], columns.units[column], column)
    found = invert_targets(
        model, columns.values[column], policy=policy.value, initial=initial, continue_memory=continue_memory
    )
    header = [
        header_with_unit(name, unit)
        for name, unit in (
            ("target", units[1]), ("passing", units[0]), ("setpoint", units[0]), ("predicted", units[1]), ("flag", "")
        )
    ]  # fmt: skip
    passing = ["" if value != value else value for value in found.passing.tolist()]
    write_csv(out, header, [found.targets, passing, found.setpoints, found.predicted, list(found.flags)])
    counts = {flag: found.flags.count(flag) for flag in ("met", "too high", "too low")}
    two = sum(value != "" for value in passing)
    console.print(
        f"{len(found.flags)} targets: {counts['met']} met, {counts['too high']} too high, "
        f"{counts['too low']} too low; {two} by way of saturation: {out}",
        highlight=False,
        soft_wrap=True,
    )
    met = [abs(p - t) for p, t, f in zip(found.predicted, found.targets, found.flags, strict=True) if f == "met"]
    write_json(
        json_file,
        {
            "model": model.name,
            "targets": len(found.flags),
            "met": counts["met"],
            "too_high": counts["too high"],
            "too_low": counts["too low"],
            "through_saturation": two,
            "largest_residual": float(max(met)) if met else None,
            "out": str(out),
        },
    )
