"""The commands that identify and apply models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bench.base import ConfigurationError, DataError, counted, print_plain, show_patience
from bench.cli.band_options import BandOption, Recalibrating, print_applied, print_band
from bench.cli.choice_options import (
    Comparing,
    print_choice,
    print_test,
    read_measured,
)
from bench.cli.command_support import JsonOption, check_given, check_outputs, command_line, write_json
from bench.cli.data_options import FiguresOption, ReadingGroup, SkipOption, offer_groups, print_assumptions
from bench.cli.model_options import ModelOptions
from bench.cli.printing import console, print_figures, print_rows, show_compilation, warn, write_rows
from bench.cli.run_names import NEWEST, complete_run, find_run

if TYPE_CHECKING:
    from bench.analysis import FitOptions, WholeIdentification
    from bench.identification import ModelFile


DataArgument = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="Table of measurements (text, .mat, .xlsx, .h5, .tdms, .npz, .parquet, .json), or a run.",
        parser=find_run,
        autocompletion=complete_run,
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
    str | None,
    typer.Option(
        "--time",
        metavar="COLUMN",
        help="Column of times, for a model with time; if not given, that of its data, or one named time or t.",
    ),
]


@dataclass(frozen=True)
class Fitting:
    """What `bench identify` fits, and how: its options."""

    input_column: Annotated[
        str,
        typer.Option(
            "--input",
            metavar="COLUMN",
            help="Input column; of a run its drive. FILE:COLUMN: of a second file; A,B: joined in order.",
        ),
    ] = ""
    output_column: Annotated[
        str, typer.Option("--output", metavar="COLUMN", help="Output column; of a run its response.")
    ] = ""
    model: Annotated[
        str,
        typer.Option(
            metavar="NAME[,NAME...]|all",
            help="Model to fit, see `bench list`; of several, the one that best predicts what its fit left out.",
        ),
    ] = "all"
    smoothing: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Weight of the roughness penalty on the density; 0, for signed densities by cross-validation.",
        ),
    ] = None
    skip: Annotated[
        int,
        typer.Option(min=0, metavar="ROWS", help="First rows that drive the memory only."),
    ] = 0
    initial: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="Memory at the first row: negative, positive, skip (the rows that it could reach), or estimate.",
        ),
    ] = None
    time_column: Annotated[
        str | None,
        typer.Option(
            "--time",
            metavar="COLUMN|none",
            help="Column of times, for models with time; one named time or t if not given.",
        ),
    ] = None
    weights_column: Annotated[
        str | None,
        typer.Option("--weights", metavar="COLUMN", help="Column of the weights of the rows, ≥ 0."),
    ] = None
    cross_validate: Annotated[
        bool, typer.Option("--cross-validate", help="Choose the smoothing by cross-validation.")
    ] = False
    band: BandOption = False
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Also print the numerics of the fit: KKT residual, condition, σ.")
    ] = False

    def settings(self, comparing: Comparing, options: ModelOptions) -> FitOptions:
        """Return the options of the fit."""
        from bench.analysis import FitOptions

        values = dict(options.values)
        ridge = values.pop("ridge", None)
        own = {"initial": self.initial, "orientation": "auto", **values}
        levels, train = options.levels_to_try, comparing.train_rows
        return FitOptions(self.smoothing, ridge, self.skip, self.cross_validate, levels, train, self.band, own)

    def check(self, comparing: Comparing, options: ModelOptions) -> None:
        """Check that the options go together, before anything is read.

        Raises ConfigurationError otherwise.
        """
        if self.input_column and self.input_column == self.output_column:
            raise ConfigurationError(
                f"--input and --output are the same column, {self.input_column}; a model needs two"
            )
        from bench.analysis import is_comparison

        if not is_comparison(self.model):
            if comparing.table_out is not None:
                raise ConfigurationError("--table-out goes with --model all, or several models")
            return
        if self.cross_validate or self.weights_column:
            raise ConfigurationError("--cross-validate and --weights go with one --model NAME")
        if options.levels_to_try:
            raise ConfigurationError("--levels: give one number, or none, to compare models; or one --model")


@dataclass(frozen=True)
class FitOutputs:
    """What `bench identify` writes: its options."""

    out: Annotated[
        Path | None,
        typer.Option(
            metavar="model.json",
            help="Model file to write. Without it, the model of a run is kept with the run, for `bench report`.",
        ),
    ] = None
    card: Annotated[
        Path | None,
        typer.Option(metavar="FILE.md", help="Model card to write."),
    ] = None
    figures: FiguresOption = None
    json_file: JsonOption = None


@offer_groups
@show_compilation()
def identify_(
    context: typer.Context,
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE",
            help="Tables of measurements (text, .mat, .xlsx, .h5, .tdms, .npz, .parquet, .json), or runs; one model "
            "of all. The newest run if not given.",
            parser=find_run,
            autocompletion=complete_run,
            show_default=False,
        ),
    ] = None,
    *,
    fitting: Fitting,
    outputs: FitOutputs,
    reading: ReadingGroup,
    options: ModelOptions,
    comparing: Comparing,
) -> None:
    """Identify a hysteresis model from measurements, and say how good it is.

    Columns are named as in the header, without or with their unit, or by number. Of a run, the readings of its steps
    are taken, by default the signals of the slots drive and response. The layout of a file is found from it and
    printed; --format sets what is not. A model of several inputs takes the runs of its protocols, in any order.
    """
    from bench.analysis import (
        ColumnNames,
        certificate_lines,
        fit_sentence,
        identify_best,
        identify_model,
        input_and_output,
        is_comparison,
        is_run,
        named_models,
        whole_identification,
    )
    from bench.identification import ONE_RUN

    out, files = outputs.out, files or [find_run(NEWEST)]
    check_outputs(**vars(outputs), read=[*files, *comparing.test_files])
    if (whole := whole_identification(fitting.model)) is not None:
        _identify_whole(context, whole, files, comparing, options, outputs)
        return
    if comparing.table_out is not None:
        check_outputs(out=comparing.table_out)
    fitting.check(comparing, options)
    columns = input_and_output(files[0], (fitting.input_column, fitting.output_column), reading)
    names = ColumnNames(*columns, fitting.time_column, fitting.weights_column)
    model, fit = fitting.model, fitting.settings(comparing, options)
    patience = f"reading and fitting {', '.join(file.name for file in files)}"
    with show_patience(patience, console):
        data, test = read_measured(files, names, model, comparing, reading)
    selected = None
    with show_patience(patience, console):
        if is_comparison(model):
            found, selected = identify_best(data, named_models(model), fit)
            model = selected.model
        else:
            found = identify_model(data, model, fit).with_uncertainty()
    # Before anything is printed: a terminal that fails must not cost the fit.
    if out is not None:
        found.file.save(out)
    console.print(fit_sentence(found, None if selected is None else selected.error_left_out))
    print_assumptions(data.name, data.assumptions)
    if selected is not None:
        print_choice(selected, comparing)
    if found.trials is not None:
        console.print(f"cross-validation, errors in {found.file.response.output_unit or 'output units'}:")
        console.print(found.trials.table())
    for warning in found.warnings:
        warn(warning)
    print_rows(f"{model} from {data.name}", certificate_lines(found, verbose=fitting.verbose))
    for advice in found.advice:
        if advice.code == ONE_RUN:
            print_plain(console, str(advice))
    if found.band is not None:
        print_band(found.band)
    if out is not None:
        print_plain(console, f"model: {out}")
    elif len(files) == 1 and is_run(files[0]):
        _keep(found.file, files[0])
    tested = print_test(found, comparing, test)
    drawn: list[Path] = []
    if outputs.figures is not None:
        from bench.analysis import draw_identification

        drawn = draw_identification(found, outputs.figures)
        print_figures(drawn)
    if outputs.card is not None:
        from bench.analysis import write_card

        write_card(outputs.card, found, command=command_line(context), model=out, figures=drawn)
        print_plain(console, f"card: {outputs.card}")
    more = {"test": tested.to_json()} if tested else {}
    more |= {"selection": selected.to_json()} if selected else {}
    write_json(outputs.json_file, found.summary() | more)


def _keep(file: ModelFile, run: Path) -> None:
    """Keep a model with the run that it was identified from, if that can be written."""
    from bench.record import Record, add_model

    with Record(run) as record:
        reached = float(record.meta.get("finished", 0.0))
    try:
        add_model(run, file.name, reached, file.to_json())
    except DataError as error:
        warn(f"the model is not kept with the run: {error}")
    else:
        print_plain(console, f"model: {file.name}, kept with the run for `bench report`; --out FILE writes a file")


def _identify_whole(
    context: typer.Context,
    whole: WholeIdentification,
    runs: Sequence[Path],
    comparing: Comparing,
    options: ModelOptions,
    outputs: FitOutputs,
) -> None:
    """Identify a model from several runs together, such as one of several inputs."""
    check_given(context, ("files", "model", "test", "options", "out", "json_file"), "this model is of whole runs")
    test = None if comparing.test is None else Path(comparing.test)
    with show_patience(f"reading and fitting {counted(len(runs), 'run')}", console):
        found = whole.of_runs(runs, test, options.values)
    if outputs.out is not None:
        found.file.save(outputs.out)
    print_rows(found.title, found.rows)
    if outputs.out is not None:
        print_plain(console, f"model: {outputs.out}")
    write_json(outputs.json_file, found.summary)


@offer_groups
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
    skip: SkipOption = None,
    initial: InitialOption = None,
    continue_memory: ContinueMemory = False,
    *,
    recalibrating: Recalibrating,
    figures: FiguresOption = None,
    json_file: JsonOption = None,
    reading: ReadingGroup,
) -> None:
    """Apply a model to a column of inputs, row by row.

    Writes a CSV file with the input column and `predicted`; with `--time` the time before them, with `--output` also
    `measured` and `residual` (measured minus predicted), and if the model has a prediction band `predicted lower` and
    `predicted upper`. Heads have the units. The model starts from the memory that it had at the start of its own
    data, so that on these data the errors are those of `bench identify`. With `--recalibrate` the predictions are
    those for the session of the measured output.
    """
    from bench.analysis import (
        ColumnNames,
        apply_model,
        error_lines,
        foreign_drift,
        read_for,
        starting_state,
    )
    from bench.identification import load_model

    check_outputs(out=out, figures=figures, json_file=json_file, read=(model_path, file))
    session = recalibrating.session()
    model = load_model(model_path)
    with show_patience(f"reading {file.name}", console):
        data = read_for([model], file, ColumnNames(input_column, output_column or None, time_column), reading)
    print_assumptions(file.name, data.assumptions)
    data.check_units(model)
    inputs = data.inputs
    if session is None and (warning := foreign_drift(model, inputs)):
        warn(warning)
    start = starting_state(model, inputs, initial=initial, skip=skip, continue_memory=continue_memory)
    found = apply_model(model, data, state=start.state, session=session, skip=start.skip)
    result: dict[str, Any] = {"model": model.name, "samples": int(inputs.size), "out": str(out), **found.to_json()}
    print_applied(found)
    if data.output is not None:
        errors = found.errors()
        result |= {**errors.to_json(), "skipped": found.first}
        print_rows(
            f"{model.name} on {file.name}",
            (
                ("samples", f"{inputs.size - found.first} (skipped: {found.first})"),
                *error_lines(errors, found.unit),
            ),
        )
    write_rows(out, {model.name: found})
    if figures is not None:
        from bench.analysis import draw_predicted

        print_figures(draw_predicted(found, figures))
    write_json(json_file, result)


@offer_groups
@show_compilation()
def invert(
    model_path: ModelArgument,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="TARGETS.csv", help="Table of targets (text, .mat, .xlsx, .h5, .tdms, .npz, .parquet, .json)."
        ),
    ],
    column: Annotated[str, typer.Option("--column", metavar="NAME", help="Column with the targets.")],
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="File for the set-points.")] = Path("setpoints.csv"),
    time_column: TimeColumn = None,
    policy: Annotated[
        Literal["nearest", "paper"],
        typer.Option(help="Choice among several solutions: nearest, or the paper's direction rule."),
    ] = "nearest",
    initial: InitialOption = None,
    continue_memory: ContinueMemory = False,
    json_file: JsonOption = None,
    *,
    reading: ReadingGroup,
) -> None:
    """Compute the set-points that bring a model's output to one target after another.

    Writes a CSV file, a row a target: `target`, `passing` (a set-point to pass before, where the target is met
    only after saturation), `setpoint`, `predicted` (the model's output there) and `flag` (`met`, `too high` or
    `too low`; what cannot be met is clamped to the nearest reachable value). If the model has a prediction band, also
    its ends for the set-point, by the local slope, and for the output there. Of models with time `hammerstein`
    and `rate-dependent-plays` are inverted, at the times of the targets (`--time`); `time` is the first column then.
    Behind a delay set-points are for the targets that come so much later, and flags also `near` (met but for
    targets between the rows) and `too early` (before any set-point has an effect).
    """
    from bench.analysis import ColumnNames, check_unit, invert_targets, read_for, write_csv
    from bench.identification import load_model

    check_outputs(out=out, json_file=json_file, read=(model_path, file))
    model = load_model(model_path)
    with show_patience(f"reading {file.name}", console):
        data = read_for([model], file, ColumnNames(column, time=time_column), reading)
    print_assumptions(file.name, data.assumptions)
    check_unit(model.response.output_unit, data.input)
    found = invert_targets(
        model,
        data.inputs,
        policy=policy,
        initial=initial,
        continue_memory=continue_memory,
        times=data.times,
    )
    for warning in found.warnings():
        warn(warning)
    write_csv(out, found.table())
    if found.band is not None:
        print_band(found.band)
    counts = ", ".join(f"{count} {flag}" for flag, count in found.counts().items())
    via = f"{found.through_saturation} by way of saturation: {out}"
    print_plain(console, f"{counted(len(found.flags), 'target')}: {counts}; {via}")
    write_json(json_file, {**found.to_json(), "out": str(out)})
