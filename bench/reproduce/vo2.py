"""The VO2 paper: characterization, identification and validation on the rig `vo2`.

J. Zhang, E. Merced, N. Sepúlveda, X. Tan, *Modeling and Inverse Compensation of Nonmonotonic Hysteresis in
VO2-Coated Microactuators*, IEEE/ASME Transactions on Mechatronics, 2013; here "Zhang et al. 2013".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from bench.clock import Stopwatch
from bench.errors import BenchError
from bench.figures import plot_density, plot_errors, plot_loops, plot_sequence_and_errors
from bench.hysteresis import MemoryCurve, Preisach, ThermalExpansion
from bench.identification import measure_errors
from bench.journal import Record, add_model
from bench.modelling import IdentifiedFile, errors_json, identify_file, predict
from bench.protocol import find_protocol
from bench.report import export_run
from bench.runs import Run, RunResult, carry_out

Floats = npt.NDArray[np.float64]

INPUT = "tec_temperature"
OUTPUT = "curvature"

SESSION_OFFSET = 0.2
"""Between the temperatures of film and plate in the validation session, K; its sign alternates with the seed."""


@dataclass(frozen=True)
class PaperModel:
    """One of the paper's three models, and what the paper says of it.

    Attributes
    ----------
    key : str
        Name in the JSON.
    title : str
        Name in tables and figures.
    model : str
        Name of the model here.
    options : mapping
        Its options.
    identification, validation : float
        The paper's largest errors, 1/m (sections IV-B, Figs. 5, 7, 9 and 10).
    """

    key: str
    title: str
    model: str
    options: Mapping[str, Any]
    identification: float
    validation: float


MODELS = (
    PaperModel(
        "nonmonotonic", "proposed model", "preisach-nonmonotonic", {"levels": 20, "plane": (30.0, 70.0)}, 46.8, 108.1
    ),
    PaperModel("signed", "signed Preisach", "preisach-signed", {"levels": 20, "plane": (21.0, 84.0)}, 80.3, 108.8),
    PaperModel("polynomial", "polynomial, degree 12", "polynomial", {"degree": 12}, 483.0, 478.1),
)

_PAPER_PARAMETERS = {
    "c0": (1026.7, "1/m"),
    "k0": (2.8, "1/(m K)"),
    "k1": (4.3, "1/(m K)"),
    "κ−": (-20.0, "1/m"),
    "κ+": (1828.0, "1/m"),
    "κ min": (-75.0, "1/m"),
    "κ max": (1836.0, "1/m"),
}


def reproduce_vo2(*, rig: str, seed: int, out: Path, live: bool, console: Console) -> dict[str, Any]:
    """Run the paper's experiments, identify its models, and print its tables beside the measured.

    Parameters
    ----------
    rig : str
        The rig: `vo2`, or a rig file with the same devices and signals.
    seed : int
        Seed of the emulated laboratory's noise.
    out : Path
        Folder for runs, models and figures.
    live : bool
        Whether to serve the live view.
    console : Console
        Where to print.

    Returns
    -------
    dict
        The result for programs.

    Raises
    ------
    BenchError
        If a run did not complete; its record is kept.
    """
    stopwatch = Stopwatch()
    folder = out / f"reproduce-vo2-seed-{seed}"
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    offset = SESSION_OFFSET if seed % 2 == 0 else -SESSION_OFFSET

    characterization = _session(rig, "damped-oscillation", {}, 2 * seed, folder, live, console)
    validation = _session(
        rig, "random-validation", {"emulation.session_offset": str(offset)}, 2 * seed + 1, folder, live, console
    )
    models = {entry.key: _identify(entry, characterization.folder, folder) for entry in MODELS}
    with Record(validation.folder) as record:
        steps = record.steps()
        inputs, outputs = steps[INPUT], steps[OUTPUT]
    predictions = {key: predict(model.file, inputs) for key, model in models.items()}

    figures = _draw(models, inputs, outputs, predictions, folder / "figures")
    for run in (characterization, validation):
        with Record(run.folder) as record:
            finished = float(record.meta["finished"])
        # The proposed model last: the recording shows the density of the newest.
        for model in reversed(models.values()):
            add_model(run.folder, model.file.name, finished, model.file.to_json())
    recordings = [export_run(run.folder, "rrd", None)[0] for run in (characterization, validation)]

    identified = {key: errors_json(model.identification.errors) for key, model in models.items()}
    validated = {key: errors_json(measure_errors(outputs, predicted)) for key, predicted in predictions.items()}
    kkt = {key: model.identification.certificate.kkt_residual for key, model in models.items()}
    parameters = _parameters(models["nonmonotonic"].file.operator)
    laboratory = sum(run.outcome.laboratory_seconds for run in (characterization, validation))
    wall = stopwatch.seconds()
    _print_errors(identified, validated, kkt, offset, console)
    _print_parameters(parameters, console)
    console.print(
        f"{laboratory / 3600:.1f} h of laboratory time in {wall:.1f} s: {laboratory / wall:.0f} times as fast",
        highlight=False,
    )
    for title, paths in (
        ("runs", [characterization.folder, validation.folder]),
        ("models", [folder / f"{entry.model}.json" for entry in MODELS]),
        ("recordings (open with `rerun FILE`)", recordings),
        ("figures", figures),
    ):
        console.print(f"[bold]{title}[/]")
        for path in paths:
            console.print(f"  {path}", highlight=False, soft_wrap=True)
    return {
        "seed": seed,
        "session_offset": offset,
        "identification": identified,
        "validation": validated,
        "kkt": kkt,
        "parameters": parameters,
        "laboratory_seconds": laboratory,
        "wall_seconds": wall,
        "folder": str(folder),
        "figures": [str(path) for path in figures],
        "recordings": [str(path) for path in recordings],
    }


def _session(
    rig: str, protocol: str, overrides: Mapping[str, str], seed: int, folder: Path, live: bool, console: Console
) -> RunResult:
    definition = find_protocol(protocol)
    result = carry_out(
        Run(
            protocol=definition,
            parameters=definition.parse({}),
            rig=rig,
            overrides=overrides,
            seed=seed,
            clock="virtual",
            folder=folder,
            live=live,
            # Made from the journal afterwards, when the density is known and can be drawn with it.
            recording=False,
        ),
        console,
    )
    if result.outcome.error is not None:
        raise result.outcome.error
    if not result.outcome.is_safe:
        raise BenchError(f"{protocol}: the safe state was not confirmed: {dict(result.outcome.safe_state)}")
    return result


def _identify(entry: PaperModel, run: Path, folder: Path) -> IdentifiedFile:
    found = identify_file(run, input_column=INPUT, output_column=OUTPUT, model=entry.model, **entry.options)
    found.file.save(folder / f"{entry.model}.json")
    return found


def _parameters(operator: Any) -> dict[str, float]:  # noqa: ANN401 - checked here
    if not (isinstance(operator, Preisach) and isinstance(operator.reversible, ThermalExpansion)):
        raise TypeError("expected the non-monotonic model")
    low, high = float(operator.levels[0]), float(operator.levels[-1])
    smallest, largest = operator.output_range()
    cold, hot = operator.reversible.coefficients.tolist()
    return {
        "c0": operator.bias,
        "k0": cold,
        "k1": hot,
        "κ−": operator.value(MemoryCurve.from_negative_saturation(low)),
        "κ+": operator.value(MemoryCurve.from_positive_saturation(high)),
        "κ min": smallest,
        "κ max": largest,
    }


def _draw(
    models: Mapping[str, IdentifiedFile],
    inputs: Floats,
    outputs: Floats,
    predictions: Mapping[str, Floats],
    folder: Path,
) -> list[Path]:
    temperature, curvature, error = "temperature / °C", "curvature / (1/m)", "error / (1/m)"
    proposed = models["nonmonotonic"]
    residuals = {key: model.identification.residuals for key, model in models.items()}
    titles = {entry.key: entry.title for entry in MODELS}
    paths = {
        name: folder / f"{name}.png"
        for name in (
            "figure-05a-loops",
            "figure-05b-error-proposed",
            "figure-06-density-proposed",
            "figure-07-error-signed",
            "figure-08-density-signed",
            "figure-09-error-polynomial",
            "figure-10-validation",
        )
    }
    plot_loops(
        paths["figure-05a-loops"],
        proposed.inputs,
        proposed.outputs,
        proposed.outputs - residuals["nonmonotonic"],
        input_label=temperature,
        output_label=curvature,
    )
    for name, key in (
        ("figure-05b-error-proposed", "nonmonotonic"),
        ("figure-07-error-signed", "signed"),
        ("figure-09-error-polynomial", "polynomial"),
    ):
        plot_errors(paths[name], {titles[key]: residuals[key]}, error_label=error)
    for name, key in (("figure-06-density-proposed", "nonmonotonic"), ("figure-08-density-signed", "signed")):
        operator = models[key].file.operator
        if isinstance(operator, Preisach):
            plot_density(paths[name], operator)
    plot_sequence_and_errors(
        paths["figure-10-validation"],
        inputs,
        {titles[key]: outputs - predicted for key, predicted in predictions.items()},
        input_label=temperature,
        error_label=error,
    )
    return list(paths.values())


def _print_errors(
    identified: Mapping[str, Mapping[str, float]],
    validated: Mapping[str, Mapping[str, float]],
    kkt: Mapping[str, float],
    offset: float,
    console: Console,
) -> None:
    for title, measured, paper in (
        ("identification, errors in 1/m (Figs. 5, 7 and 9)", identified, {m.key: m.identification for m in MODELS}),
        (
            f"validation, errors in 1/m (Fig. 10; session offset {offset:+g} K)",
            validated,
            {m.key: m.validation for m in MODELS},
        ),
    ):
        table = Table("model", title=title, title_justify="left")
        for column in ("paper max", "bench max", "bench RMS", "KKT"):
            table.add_column(column, justify="right", no_wrap=True)
        for entry in MODELS:
            errors = measured[entry.key]
            certificate = f"{kkt[entry.key]:.0e}" if measured is identified else "–"
            table.add_row(
                entry.title, f"{paper[entry.key]:g}", f"{errors['max']:.1f}", f"{errors['rms']:.1f}", certificate
            )
        console.print(table)


def _print_parameters(parameters: Mapping[str, float], console: Console) -> None:
    table = Table("", title="the proposed model's parameters", title_justify="left")
    for column in ("paper", "bench", "unit"):
        table.add_column(column, justify="right")
    for name, (paper, unit) in _PAPER_PARAMETERS.items():
        table.add_row(name, f"{paper:g}", f"{parameters[name]:.2f}", unit)
    console.print(table)
