"""The commands of `bench model`: test, design, twin, tune and deploy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bench.base import (
    ConfigurationError,
    closest,
    percent,
    print_plain,
    print_table,
    show_patience,
    significant,
    write_result,
)
from bench.cli.band_options import BandsOption, Recalibrating, print_applied
from bench.cli.command_support import JsonOption, check_outputs, parse_assignments, write_json
from bench.cli.data_options import FiguresOption, ReadingGroup, SkipOption, offer_groups, print_assumptions
from bench.cli.model_commands import InitialOption
from bench.cli.printing import console, print_figures, print_rows, show_compilation, warn, write_rows
from bench.cli.run_names import find_run

if TYPE_CHECKING:
    from bench.base import Floats
    from bench.identification import Continuation


@offer_groups
@show_compilation()
def models_on_data(
    compared: Annotated[list[Path], typer.Argument(metavar="MODEL", help="Model files.")],
    data: Annotated[
        Path,
        typer.Option(
            "--data",
            metavar="FILE",
            help="Table of measurements (text, .mat, .xlsx, .h5, .tdms, .npz, .parquet, .json), or a run.",
            parser=find_run,
        ),
    ],
    input_column: Annotated[
        str | None, typer.Option("--input", metavar="COLUMN", help="Input column; the first model's if not given.")
    ] = None,
    output_column: Annotated[
        str | None, typer.Option("--output", metavar="COLUMN", help="Output column; the first model's if not given.")
    ] = None,
    time_column: Annotated[
        str | None, typer.Option("--time", metavar="COLUMN", help="Column of times, for models with time.")
    ] = None,
    skip: SkipOption = None,
    initial: InitialOption = None,
    bands: BandsOption = False,
    *,
    recalibrating: Recalibrating,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="File for input, measured output, and by model the rest."),
    ] = None,
    figures: FiguresOption = None,
    json_file: JsonOption = None,
    reading: ReadingGroup,
) -> None:
    """Compare models on measurements that they may not have seen.

    Each model's errors are shown raw, and after re-zeroing the sensor: between sessions a sensor's offset moves, and
    what a model is worth then is another number. `--out` writes input, measured output and by model `predicted` and
    `residual` (measured minus predicted) of every row. `bench runs compare` compares two runs.
    """
    from bench.analysis import ColumnNames, compare_models, load_models, read_for

    check_outputs(out=out, figures=figures, json_file=json_file, read=(data, *compared))
    session = recalibrating.session()
    with show_patience(f"reading {data.name}", console):
        models = load_models(compared)
        names = ColumnNames(input_column or "", output_column or "", time_column)
        measured = read_for([*models.values()], data, names, reading)
        result = compare_models(models, measured, skip=skip, initial=initial, session=session)
    print_assumptions(data.name, measured.assumptions)
    for warning in result.warnings:
        warn(warning)
    if result.skip:
        console.print(f"rows 1 to {result.skip} are left out of the errors")
    heads = ("model", "max", "RMS", "RMS / %", "offset", "max, offset removed", "RMS, offset removed")
    rows = [
        (
            name, significant(raw.maximum, 4), significant(raw.rms, 4), percent(raw.rms_percent).removesuffix(" %"),
            f"{entry.offset:+.4g}", significant(mended.maximum, 4), significant(mended.rms, 4),
        )
        for name, entry in result.comparisons.items()
        for raw, mended in [(entry.raw, entry.rezeroed)]
    ]  # fmt: skip
    title = f"models on {data.name}, errors in {result.unit or 'output units'}"
    print_table(console, heads, rows, title, numbers_from=1)
    for name, applied in result.applied.items():
        print_applied(applied, name, bands=bands)
    if out is not None:
        write_rows(out, result.applied)
    if figures is not None:
        from bench.analysis import draw_comparison

        print_figures(draw_comparison(result, figures))
    write_json(json_file, result.to_json())


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
    from bench.analysis import ReadingOptions, assess_designs, continue_file
    from bench.identification import load_model

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
        to_go_on = load_model(model)
        unit = to_go_on.operator.input_unit
        with show_patience(f"designing {hours:g} h of measurements", console):
            further = continue_file(
                to_go_on, data, input_column=input_column, seconds=3600.0 * hours, dwell=dwell, reading=reading
            )
        print_rows(f"continuation of {data.name} for {model.name}", _continuation_lines(further, unit))
        if out is not None:
            _write_sequence(out, further.setpoints, unit, dwell)
        write_json(json_file, _continuation_json(further))
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
        _write_sequence(out, found[sequence].setpoints, unit, dwell)
    write_json(json_file, {name: vars(entry) for name, entry in result.items()})


def _continuation_json(found: Continuation) -> dict[str, Any]:
    return {
        "setpoints": int(found.setpoints.size),
        "time": found.time,
        "tails": [{"center": tail.center, "reach": tail.reach} for tail in found.tails],
        "visits": [list(pair) for pair in found.visits],
        "log_determinant": {"before": found.before, "after": found.after, "repeated": found.repeated},
        "prediction_variance": {
            "before": found.variance_before, "after": found.variance_after, "repeated": found.variance_repeated
        },
    }  # fmt: skip


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


def _write_sequence(path: Path, setpoints: Floats, unit: str, dwell: float) -> None:
    from bench.analysis import write_sequence

    write_sequence(path, setpoints, unit=unit, dwell=dwell)
    print_plain(console, f"{setpoints.size} set-points: {path}; bench run sequence --rig RIG --set setpoints={path}")


@show_compilation()
def twin_(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN", help="Runs: a characterization, and best also creep.", parser=find_run),
    ],
    rig: Annotated[str, typer.Option("--rig", metavar="RIG", help="The rig of the runs: a name, or a rig file.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.toml", help="Rig file of the twin to write.")],
    model: Annotated[
        Path | None,
        typer.Option("--model", metavar="FILE", help="Model of the specimen; identified from the runs if not given."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Make an emulated twin of the present specimen from what was measured on it.

    Its drive and response follow what is identified from the runs: hysteresis, dynamics, noise, wander and drift. Try
    a protocol on it by `bench run PROTOCOL --rig FILE.toml --clock virtual`.
    """
    from bench.specimen import write_twin

    check_outputs(out=out, json_file=json_file, read=[*runs, *([] if model is None else [model])])
    twin = write_twin(runs, rig, out, model)
    print_rows(f"twin of {rig}", twin.rows())
    print_plain(console, f"rig file: {out}")
    write_json(json_file, {"rig": rig, "out": str(out), **twin.summary()})


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
