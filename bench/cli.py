"""The `bench` command.

Every command prints for people, and with `--json FILE` writes the same result for programs. Heavy imports
wait until a command needs them, so that `bench --help` answers at once.
"""

from __future__ import annotations

import json
import sqlite3
import sys
from collections.abc import Callable, Sequence
from enum import Enum, StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn

import typer
from rich.console import Console
from rich.markdown import Markdown
from rich.markup import escape
from rich.table import Table
from typer.core import TyperGroup

from bench import registry
from bench.errors import BenchError, ConfigurationError

_EPILOG = (
    "Exit codes: 0 done; 1 failed; 2 wrong command, rig file or parameter (nothing has moved); 3 unusable data or "
    "model file; 4 device fault; 5 interlock; 6 not steady in time; 7 safe state not confirmed; 130 ended by the "
    "operator. Try: bench run damped-oscillation --rig vo2 --clock virtual"
)
UNSAFE_EXIT_CODE = 7


class RegisteredCommands(TyperGroup):
    """A group of commands with those that packages register in `group`, each loaded when it is asked for."""

    group: ClassVar[registry.Group] = "commands"

    # The types of click are a private part of typer.
    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401
        """Return the names of all commands, the registered ones last."""
        own = super().list_commands(ctx)
        return [*own, *(name for name in registry.entries(self.group) if name not in own)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401
        """Return a command; one that cannot be loaded says so when it is called."""
        entry = registry.entries(self.group).get(cmd_name)
        if cmd_name in self.commands or entry is None:
            return super().get_command(ctx, cmd_name)
        one = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)
        try:
            callback = self.make_callback(cmd_name, entry.load())
        except ConfigurationError as error:
            failure = error

            def callback() -> None:
                raise failure

            callback.__doc__ = f"Cannot be loaded: {error}"
        one.command(cmd_name)(callback)
        return typer.main.get_command(one)

    def make_callback(self, name: str, part: Any) -> Callable[..., None]:  # noqa: ARG002, ANN401
        """Return the function of a command whose entry point is `part`: that itself."""
        callback: Callable[..., None] = part
        return callback


class Studies(RegisteredCommands):
    """The commands of `bench reproduce`, one for each registered study."""

    group = "studies"

    def make_callback(self, name: str, part: Any) -> Callable[..., None]:  # noqa: ANN401
        """Return a function that carries a study out."""

        def carry_out_study(
            rig: Annotated[
                str | None,
                typer.Option("--rig", metavar="RIG", help="Another rig with the same signals."),
            ] = None,
            seed: Annotated[
                int, typer.Option(min=0, help="Seed of all noise in the emulated laboratory and of random sequences.")
            ] = 0,
            out: Annotated[Path, typer.Option(metavar="DIR", help="Where runs, models and figures go.")] = Path(
                "recordings"
            ),
            live: Annotated[
                bool, typer.Option("--live/--no-live", help="Serve the live view on the loopback interface.")
            ] = False,
            json_file: JsonOption = None,
        ) -> None:
            from bench.campaign import reproduce

            write_json(json_file, reproduce(name, part, rig=rig, seed=seed, out=out, live=live, console=console))

        carry_out_study.__doc__ = f"{part.summary}\n\n{part.description}"
        return carry_out_study


app = typer.Typer(
    name="bench",
    cls=RegisteredCommands,
    help="A lab bench for smart-material actuators: run step protocols on real or emulated instruments, "
    "identify hysteresis models from what was measured, and apply them.",
    epilog=_EPILOG,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
console = Console()
_errors = Console(stderr=True)

JsonOption = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON, for programs.")
]


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command; every error that the bench raises becomes one message and an exit code."""
    try:
        app(args=None if arguments is None else list(arguments))
    except BenchError as error:
        fail(error)
    except sqlite3.Error as error:
        _errors.print(f"[bold red]error:[/] the journal cannot be written: {error}", highlight=False)
        sys.exit(1)
    sys.exit(0)


def fail(error: BenchError) -> NoReturn:
    """Print an error of the bench and exit with its code."""
    _print_error(error)
    sys.exit(error.exit_code)


def _print_error(error: BenchError) -> None:
    for line in str(error).splitlines():
        _errors.print("[bold red]error:[/]", escape(line), highlight=False, soft_wrap=True)


@app.command("list")
def list_(
    name: Annotated[
        str | None,
        typer.Argument(help="A rig, a protocol or a model, to see all of it; nothing, to see what there is."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Show the rigs, protocols and models, or one of them in full.

    A protocol is shown with its parameters, a rig with its file: `bench list vo2-hardware > desk.toml`
    gives you a copy to fill in.
    """
    from bench.hysteresis import identifiable_models
    from bench.protocol import packaged_protocols
    from bench.rig_file import load_rig, packaged_rigs

    models = {model: spec.summary for model, spec in identifiable_models().items()}
    protocols = packaged_protocols().protocols
    rigs = {rig: load_rig(rig) for rig in packaged_rigs()}
    if name is None:
        _print_table("rigs", {rig: file.rig.title for rig, file in rigs.items()})
        _print_table("protocols", {key: protocol.summary for key, protocol in protocols.items()})
        _print_table("models", models)
        write_json(
            json_file,
            {
                "rigs": {rig: file.rig.title for rig, file in rigs.items()},
                "protocols": {key: protocol.summary for key, protocol in protocols.items()},
                "models": models,
            },
        )
    elif name in rigs:
        # Plain, so that it can be redirected into a file.
        typer.echo(rigs[name].text, nl=False)
        write_json(json_file, {"name": name, "text": rigs[name].text})
    elif name in protocols:
        print_protocol(protocols[name])
        write_json(json_file, {"name": name, "parameters": [vars(entry) for entry in protocols[name].help()]})
    elif name in models:
        console.print(models[name])
        write_json(json_file, {"name": name, "summary": models[name]})
    else:
        known = ", ".join([*rigs, *protocols, *models])
        raise ConfigurationError(f"there is no rig, protocol or model {name!r}; there are: {known}")


@app.command(add_help_option=False)
def run(
    context: typer.Context,
    protocol: Annotated[
        str | None, typer.Argument(help="Name of a protocol, or a file of your own: path/to/file.py[:NAME].")
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option("--rig", metavar="RIG", help="Name of a packaged rig, or a rig file: path/to/rig.toml."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set a parameter of the protocol; may come several times."),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--override",
            metavar="KEY=VALUE",
            help="Replace a value of the rig file, such as devices.tec.port=/dev/ttyUSB1; may come several times.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is random in an emulated laboratory.")] = 0,
    clock: Annotated[
        str,
        typer.Option(
            help="wall; on emulated rigs also virtual (as fast as it goes) or xN (N times as fast, up to about 100)."
        ),
    ] = "wall",
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the folder of the run is made.")] = Path(
        "recordings"
    ),
    live: Annotated[
        bool, typer.Option("--live/--no-live", help="Serve the live view on the loopback interface.")
    ] = False,
    json_file: JsonOption = None,
    help_: Annotated[
        bool, typer.Option("--help", help="Show this message; after PROTOCOL, also what can be set there.")
    ] = False,
) -> None:
    """Carry a protocol out on a rig, record it, and leave every device in its safe state.

    The set-points are checked against the rig's limits before anything moves. Ctrl-C pauses at the next
    step and asks; Ctrl-C again ends at once; so do SIGTERM and SIGHUP. Whatever ends the run, every
    device is brought into its safe state, and what was recorded so far is kept.
    """
    from bench.protocol import find_protocol

    if help_ or protocol is None:
        console.print(context.get_help(), highlight=False)
        if protocol is not None:
            print_protocol(find_protocol(protocol))
        return
    if rig is None:
        raise ConfigurationError("--rig is missing: `bench list` shows the packaged rigs")
    definition = find_protocol(protocol)
    given = parse_assignments("--set", settings or [])

    from bench.runs import Run, carry_out
    from bench.safety import SAFE

    result = carry_out(
        Run(
            protocol=definition,
            settings=given,
            rig=rig,
            overrides=parse_assignments("--override", overrides or []),
            seed=seed,
            clock=clock,
            folder=out,
            live=live,
        ),
        console,
    )
    outcome = result.outcome
    console.print(
        f"{outcome.status}: {outcome.steps} steps, {outcome.laboratory_seconds:.0f} s of laboratory time in "
        f"{result.wall_seconds:.1f} s ({result.time_ratio:.0f} times as fast)",
        highlight=False,
    )
    console.print(f"record: {result.folder}", highlight=False, soft_wrap=True)
    write_json(
        json_file,
        {
            "folder": str(result.folder),
            "status": outcome.status,
            "reason": outcome.reason,
            "steps": outcome.steps,
            "laboratory_seconds": outcome.laboratory_seconds,
            "wall_seconds": result.wall_seconds,
            "safe_state": dict(outcome.safe_state),
            "is_safe": outcome.is_safe,
        },
    )
    for name, state in outcome.safe_state.items():
        if state != SAFE:
            _errors.print(
                f"[bold red]error:[/] {name} is NOT in its safe state:", state, highlight=False, soft_wrap=True
            )
    if outcome.error is not None:
        if not isinstance(outcome.error, BenchError):
            raise outcome.error
        _print_error(outcome.error)
    # What is not safe matters more than what ended the run.
    if not outcome.is_safe:
        sys.exit(UNSAFE_EXIT_CODE)
    if isinstance(outcome.error, BenchError):
        sys.exit(outcome.error.exit_code)


@app.command("identify")
def identify_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="CSV file with a header, or the folder of a run.")],
    input_column: Annotated[str, typer.Option("--input", metavar="COLUMN", help="What drives.")],
    output_column: Annotated[str, typer.Option("--output", metavar="COLUMN", help="What answers.")],
    model: Annotated[str, typer.Option(metavar="NAME", help="Which model; `bench list` shows them.")],
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
        int, typer.Option(metavar="ROWS", help="First rows that drive the memory but do not count in the fit.")
    ] = 0,
    initial: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="Memory at the first row: negative or positive saturation, or unknown: skip the rows that it could "
            "reach, or estimate it.",
        ),
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option(
            "--option", metavar="KEY=VALUE", help="Another option of the model, a number; may come several times."
        ),
    ] = None,
    cross_validate: Annotated[
        bool, typer.Option("--cross-validate", help="Choose the smoothing by cross-validation, and show the table.")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="model.json", help="Where the model file goes.")] = None,
    figures: Annotated[Path | None, typer.Option(metavar="DIR", help="Draw loops, errors and density there.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Identify a hysteresis model from measurements, and say how good it is.

    Columns are named as in the header; a unit in brackets at the end, as in `force [N]`, may be left out and
    goes into the model. Of a run, the readings are taken: `bench identify RUN --input voltage
    --output displacement --model preisach --out model.json`.
    """
    from bench.results.models import certificate_lines, identify_file

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
        **parse_numbers("--option", options or ()),
        cross_validated=cross_validate,
    )
    if found.trials is not None:
        console.print(f"cross-validation, errors in {found.file.operator.output_unit or 'output units'}:")
        console.print(found.trials.table(), highlight=False, markup=False)
    for warning in found.warnings:
        _errors.print("[yellow]warning:[/]", escape(warning), highlight=False, soft_wrap=True)
    print_rows(f"{model} from {file.name}", certificate_lines(found))
    if out is not None:
        found.file.save(out)
        console.print(f"model: {out}", highlight=False, soft_wrap=True)
    if figures is not None:
        from bench.results.report import draw_identification

        for path in draw_identification(found, figures):
            console.print(f"figure: {path}", highlight=False, soft_wrap=True)
    write_json(json_file, found.summary())


@app.command("predict")
def predict_(
    model_path: Annotated[Path, typer.Argument(metavar="model.json", help="A model file.")],
    file: Annotated[Path, typer.Argument(metavar="FILE", help="CSV file with a header, or the folder of a run.")],
    input_column: Annotated[str, typer.Option("--input", metavar="COLUMN", help="What drives.")],
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="Where the input and the prediction go.")],
    output_column: Annotated[
        str | None, typer.Option("--output", metavar="COLUMN", help="What was measured, to compare with.")
    ] = None,
    continue_memory: Annotated[
        bool,
        typer.Option(
            "--continue-memory", help="Start from the memory at the end of the model's data, not from saturation."
        ),
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Apply a model to a column of inputs, row by row.

    Writes a CSV file with the input column and `predicted`.
    """
    from bench.identification import measure_errors
    from bench.results.data import read_columns, write_csv
    from bench.results.model_file import load_model
    from bench.results.models import check_unit, errors_json, outside_of_range, predict

    model = load_model(model_path)
    columns = read_columns(file, [input_column] + ([output_column] if output_column else []))
    inputs = columns.values[input_column]
    check_unit(model.operator.input_unit, columns.units[input_column], input_column)
    if warning := outside_of_range(model, inputs):
        _errors.print("[yellow]warning:[/]", escape(warning), highlight=False, soft_wrap=True)
    predicted = predict(model, inputs, continue_memory=continue_memory)
    write_csv(out, [input_column, "predicted"], [inputs, predicted])
    result: dict[str, Any] = {"model": model.name, "samples": int(inputs.size), "out": str(out)}
    if output_column:
        errors = measure_errors(columns.values[output_column], predicted)
        result |= errors_json(errors)
        unit = model.operator.output_unit
        print_rows(
            f"{model.name} on {file.name}",
            (
                ("largest error", f"{errors.maximum:.4g} {unit} ({errors.maximum_percent:.2f} % of the range)"),
                ("RMS error", f"{errors.rms:.4g} {unit} ({errors.rms_percent:.2f} % of the range)"),
            ),
        )
    console.print(f"{inputs.size} rows: {out}", highlight=False, soft_wrap=True)
    write_json(json_file, result)


@app.command("compare")
def compare_(
    models: Annotated[list[Path], typer.Argument(metavar="A.json B.json", help="Model files.")],
    data: Annotated[
        Path, typer.Option("--data", metavar="FILE", help="CSV file with a header, or the folder of a run.")
    ],
    input_column: Annotated[
        str | None, typer.Option("--input", metavar="COLUMN", help="What drives; the first model's if not given.")
    ] = None,
    output_column: Annotated[
        str | None, typer.Option("--output", metavar="COLUMN", help="What answers; the first model's if not given.")
    ] = None,
    skip: Annotated[
        int, typer.Option(min=0, metavar="ROWS", help="First rows that drive the memory but do not count.")
    ] = 0,
    figures: Annotated[Path | None, typer.Option(metavar="DIR", help="Draw the residuals there.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Compare models on measurements that they may not have seen.

    Shows each model's errors raw, and after re-zeroing the sensor: between sessions a sensor's offset moves, and
    what a model is worth then is another number.
    """
    from bench.results.models import compare_models

    result = compare_models(models, data, input_column, output_column, skip=skip)
    table = Table(title=f"models on {data.name}, errors in {result.unit or 'output units'}", title_justify="left")
    table.add_column("model")
    for column in ("max", "RMS", "RMS / %", "offset", "re-zeroed max", "re-zeroed RMS"):
        table.add_column(column, justify="right")
    for name, entry in result.comparisons.items():
        raw, mended = entry.raw, entry.rezeroed
        table.add_row(
            name, f"{raw.maximum:.4g}", f"{raw.rms:.4g}", f"{raw.rms_percent:.2f}", f"{entry.offset:+.4g}",
            f"{mended.maximum:.4g}", f"{mended.rms:.4g}",
        )  # fmt: skip
    console.print(table)
    if figures is not None:
        from bench.results.report import draw_comparison

        console.print(f"figure: {draw_comparison(result, figures)}", highlight=False, soft_wrap=True)
    write_json(json_file, result.to_json())


@app.command()
def design(
    plane: Annotated[tuple[float, float], typer.Option(metavar="LOW HIGH", help="Ends of the Preisach plane.")] = (
        30.0,
        70.0,
    ),
    operating: Annotated[
        tuple[float, float], typer.Option("--range", metavar="LOW HIGH", help="Operating range; contains the plane.")
    ] = (21.0, 84.0),
    levels: Annotated[int, typer.Option(min=2, max=60, help="Discretization levels of the plane.")] = 20,
    dwell: Annotated[float, typer.Option(min=0.0, help="Settling time at each set-point, s.")] = 8.0,
    json_file: JsonOption = None,
) -> None:
    """Compare excitation sequences: what each tells about a plane, and the laboratory time that it takes.

    The damped oscillation of the papers, first-order reversal curves, the shortest sequence that covers every cell,
    and the same twice as fine with two set-points a level, which averages noise. Each is a protocol:
    damped-oscillation, first-order-reversals, covering.
    """
    from bench.results.models import assess_designs

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
def invert(
    model_path: Annotated[Path, typer.Argument(metavar="model.json", help="A model file.")],
    file: Annotated[Path, typer.Argument(metavar="TARGETS.csv", help="CSV file with a header.")],
    column: Annotated[str, typer.Option("--column", metavar="NAME", help="Column with the targets.")],
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="Where the set-points go.")] = Path("setpoints.csv"),
    policy: Annotated[
        PolicyOption,
        typer.Option(help="Which answer, where there are several: nearest, or the paper's direction rule."),
    ] = PolicyOption.NEAREST,
    continue_memory: Annotated[
        bool,
        typer.Option(
            "--continue-memory", help="Start from the memory at the end of the model's data, not from saturation."
        ),
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Compute the set-points that bring a model's output to one target after another.

    Writes a CSV file, a row a target: `target`, `passing` (a set-point to pass before, where the target is met
    only after saturation), `setpoint`, `predicted` (the model's output there) and `flag` (`met`, `too high` or
    `too low`; what cannot be met is clamped to the nearest reachable value).
    """
    from bench.results.data import header_with_unit, read_columns, write_csv
    from bench.results.model_file import load_model
    from bench.results.models import check_unit, invert_targets

    model = load_model(model_path)
    columns = read_columns(file, [column])
    units = (model.operator.input_unit, model.operator.output_unit)
    check_unit(units[1], columns.units[column], column)
    found = invert_targets(model, columns.values[column], policy=policy.value, continue_memory=continue_memory)
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


@app.command()
def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or its journal.")],
    models: Annotated[
        list[Path] | None,
        typer.Option("--model", metavar="FILE", help="Model file to compare; may come several times."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where figures go; the folder `report` of the run if not given."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Tables and figures of a run: what happened, the extremes of every signal, and how models do on it.

    Models that were identified from this run are compared without being named. Works while the run goes on.
    """
    from bench.results.model_file import load_model
    from bench.results.report import report_run

    result = report_run(run, [load_model(path) for path in models or []], out, console)
    write_json(json_file, result)


class ExportFormat(StrEnum):
    """What a run can be exported to."""

    CSV = "csv"
    PARQUET = "parquet"
    RRD = "rrd"
    PNG = "png"


@app.command()
def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or its journal.")],
    format_: Annotated[ExportFormat, typer.Option("--format", help="Which format.")],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where the files go; the folder of the run if not given.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Write a run's readings and telemetry for other programs, or rebuild its recording for the viewer.

    csv and parquet: `readings` (one row a step) and `telemetry` (one row a tick), units in the headers. rrd: the
    recording, rebuilt from the journal. png: a picture of the dashboard, drawn without a screen.
    """
    from bench.results.report import export_run

    paths = export_run(run, format_.value, out)
    for path in paths:
        console.print(f"{path}", highlight=False, soft_wrap=True)
    write_json(json_file, {"files": [str(path) for path in paths]})


def print_rows(title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print (name, text) pairs under a title."""
    table = Table(title=title, title_justify="left", show_header=False, box=None, padding=(0, 2))
    for name, text in rows:
        table.add_row(name, text)
    console.print(table)


def print_protocol(definition: Any) -> None:  # noqa: ANN401 - a ProtocolDefinition, not imported at start
    """Print a protocol's help: what it does and what can be set."""
    console.print(Markdown(f"**{definition.name}**: {definition.description}"))
    console.print()
    table = Table("--set", "default", "unit", "allowed", "what it does", title="parameters", title_justify="left")
    for entry in definition.help():
        table.add_row(entry.name, entry.default, entry.unit, entry.allowed, entry.text)
    console.print(table)


def parse_assignments(option: str, texts: Sequence[str]) -> dict[str, str]:
    """Split texts of the form `key=value`.

    Raises
    ------
    ConfigurationError
        If one is not of this form, or a key comes twice.
    """
    pairs: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise ConfigurationError(f"{option} {text!r}: expected KEY=VALUE")
        if key in pairs:
            raise ConfigurationError(f"{option}: {key} is given twice")
        pairs[key] = value
    return pairs


def parse_numbers(option: str, texts: Sequence[str]) -> dict[str, int | float]:
    """Split texts of the form `key=number`; errors as `parse_assignments`, or if a value is not a number."""
    numbers: dict[str, int | float] = {}
    for key, text in parse_assignments(option, texts).items():
        try:
            numbers[key] = int(text) if text.lstrip("-").isdigit() else float(text)
        except ValueError:
            raise ConfigurationError(f"{option} {key}={text}: expected a number") from None
    return numbers


def write_json(path: Path | None, content: Any) -> None:  # noqa: ANN401 - anything that JSON can hold
    """Write a result for programs, if a file was asked for.

    Raises
    ------
    ConfigurationError
        If the file cannot be written.
    """
    if path is None:
        return
    try:
        path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"--json {path} cannot be written: {error.strerror}") from None


def _print_table(title: str, rows: dict[str, str]) -> None:
    table = Table(title=title, title_justify="left", show_header=False, box=None, padding=(0, 2))
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for name, text in rows.items():
        table.add_row(name, text)
    console.print(table)
    console.print()


reproduce_ = typer.Typer(
    help="Reproduce a paper's results on its emulated rig, at the wire level, on the virtual clock.",
    no_args_is_help=True,
    cls=Studies,
)
app.add_typer(reproduce_, name="reproduce")
