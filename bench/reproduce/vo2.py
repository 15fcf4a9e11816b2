"""The VO2 paper on the rig `vo2`: characterization, identification, validation, and tracking with every controller.

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

from bench.clock import Stopwatch
from bench.errors import DataError
from bench.hysteresis import MemoryCurve
from bench.identification import measure_errors
from bench.journal import Record, add_model
from bench.reproduce.campaign import Campaign, make_table, print_end
from bench.results.figures import plot_densities, plot_errors, plot_loops, plot_sequence_and_errors, plot_tracking
from bench.results.models import IdentifiedFile, errors_json, identify_file, predict
from bench.results.report import export_run
from bench.results.tracking import FollowingResult, TargetResults, following_result, target_results
from bench.runs import RunResult

Floats = npt.NDArray[np.float64]

TRACKING_OFFSET = 0.12
"""The same in the tracking sessions, K."""

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


PROPOSED = "preisach-nonmonotonic"

MODELS = (
    PaperModel(
        "nonmonotonic",
        "proposed model",
        PROPOSED,
        {"levels": 20, "plane": (30.0, 70.0), "reference": 20.0},
        46.8,
        108.1,
    ),
    PaperModel("signed", "signed Preisach", "preisach-signed", {"levels": 20, "plane": (21.0, 84.0)}, 80.3, 108.8),
    PaperModel("polynomial", "polynomial, degree 12", "polynomial", {"degree": 12}, 483.0, 478.1),
)


@dataclass(frozen=True)
class TrackingSession:
    """One controller at 60 targets, and what the paper says of it.

    Attributes
    ----------
    key : str
        Name in the JSON.
    title : str
        Name in tables and figures.
    controller : str
        Name of the controller.
    model : str
        Model that it takes.
    paper_max, paper_rms : float or None
        The paper's errors, 1/m (section V-B).
    """

    key: str
    title: str
    controller: str
    model: str
    paper_max: float | None = None
    paper_rms: float | None = None


TRACKING = (
    TrackingSession(
        "open_loop_inverse", "open-loop inverse", "open-loop-inverse", "preisach-nonmonotonic", 78.0, 26.7
    ),
    TrackingSession("polynomial", "polynomial look-up", "polynomial", "polynomial", 734.2, 320.6),
    TrackingSession("integral", "integral, no inverse", "integral", "preisach-nonmonotonic"),
    TrackingSession("closed_loop_inverse", "closed-loop inverse", "closed-loop-inverse", "preisach-nonmonotonic"),
    TrackingSession("latched", "latched", "latched", "preisach-nonmonotonic"),
)

FOLLOWING = {
    "open_loop_inverse": "open-loop-inverse",
    "integral": "integral",
    "closed_loop_inverse": "closed-loop-inverse",
}
PERIODS = (60, 200)
"""Periods of the sine that is followed, s."""

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
    campaign = Campaign(rig, out / f"reproduce-vo2-seed-{seed}", seed, live, console)
    folder = campaign.folder
    sign = 1.0 if seed % 2 == 0 else -1.0

    def session(protocol: str, settings: Mapping[str, str], offset: float) -> RunResult:
        return campaign.run(protocol, settings, {"emulation.session_offset": str(sign * offset)})

    characterization = session("damped-oscillation", {}, 0.0)
    validation = session("random-validation", {}, SESSION_OFFSET)
    models = {entry.key: _identify(entry, characterization.folder, folder) for entry in MODELS}
    with Record(validation.folder) as record:
        steps = record.steps()
        inputs, outputs = steps[INPUT], steps[OUTPUT]
    predictions = {key: predict(model.file, inputs) for key, model in models.items()}

    sequence = {"sequence_seed": str(seed + 1)}
    tracking_runs = {
        entry.key: session(
            "tracking",
            {"model": str(folder / f"{entry.model}.json"), "controller": entry.controller, **sequence},
            TRACKING_OFFSET,
        )
        for entry in TRACKING
    }
    proposed = str(folder / f"{PROPOSED}.json")
    following_runs = {
        (period, key): session(
            "following", {"model": proposed, "controller": controller, "period": str(period)}, TRACKING_OFFSET
        )
        for period in PERIODS
        for key, controller in FOLLOWING.items()
    }
    reached = {key: _reached(run) for key, run in tracking_runs.items()}
    followed = {key: _followed(run) for key, run in following_runs.items()}

    for run in (characterization, validation):
        with Record(run.folder) as record:
            finished = float(record.meta["finished"])
        # The proposed model last: the recording shows the density of the newest.
        for model in reversed(models.values()):
            add_model(run.folder, model.file.name, finished, model.file.to_json())
    for run in (*tracking_runs.values(), *following_runs.values()):
        add_model(run.folder, PROPOSED, 0.0, models["nonmonotonic"].file.to_json())
    recordings = [export_run(run.folder, "rrd", None)[0] for run in campaign.runs]
    figures = _draw(models, inputs, outputs, predictions, folder / "figures")
    figures += _draw_tracking(reached, followed, folder / "figures")

    result = {
        "seed": seed,
        "session_offset": sign * SESSION_OFFSET,
        "tracking_offset": sign * TRACKING_OFFSET,
        "identification": {key: errors_json(model.identification.errors) for key, model in models.items()},
        "validation": {
            key: errors_json(measure_errors(outputs, predicted)) for key, predicted in predictions.items()
        },
        "kkt": {key: model.identification.certificate.kkt_residual for key, model in models.items()},
        "parameters": _parameters(models["nonmonotonic"].file.operator),
        "tracking": {key: results.summary() for key, results in reached.items()},
        "continuous": {
            f"period_{period}": {key: followed[period, key].summary() for key in FOLLOWING} for period in PERIODS
        },
        "laboratory_seconds": campaign.laboratory_seconds,
        "wall_seconds": stopwatch.seconds(),
        "folder": str(folder),
        "figures": [str(path) for path in figures],
        "recordings": [str(path) for path in recordings],
    }
    _print_result(result, console)
    return result


def _reached(run: RunResult) -> TargetResults:
    with Record(run.folder) as record:
        results = target_results(record, OUTPUT)
    if results is None:
        raise DataError(f"{run.folder}: has no targets")
    return results


def _followed(run: RunResult) -> FollowingResult:
    with Record(run.folder) as record:
        result = following_result(record, OUTPUT)
    if result is None:
        raise DataError(f"{run.folder}: has no reference")
    return result


def _identify(entry: PaperModel, run: Path, folder: Path) -> IdentifiedFile:
    found = identify_file(run, input_column=INPUT, output_column=OUTPUT, model=entry.model, **entry.options)
    found.file.save(folder / f"{entry.model}.json")
    return found


def _parameters(operator: Any) -> dict[str, float]:  # noqa: ANN401 - the non-monotonic model
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
        plot_densities(paths[name], models[key].file.operator.densities())
    plot_sequence_and_errors(
        paths["figure-10-validation"],
        inputs,
        {titles[key]: outputs - predicted for key, predicted in predictions.items()},
        input_label=temperature,
        error_label=error,
    )
    return list(paths.values())


def _draw_tracking(
    reached: Mapping[str, TargetResults], followed: Mapping[tuple[int, str], FollowingResult], folder: Path
) -> list[Path]:
    curvature, error = "curvature / (1/m)", "error / (1/m)"
    titles = {entry.key: entry.title for entry in TRACKING}
    paths = [folder / "figure-12-open-loop.png", folder / "figure-12-closed-loop.png"]
    for path, keys in zip(
        paths, (("open_loop_inverse", "polynomial"), ("closed_loop_inverse", "latched")), strict=True
    ):
        plot_tracking(
            path,
            reached[keys[0]].targets,
            {titles[key]: reached[key].outputs for key in keys},
            output_label=curvature,
            error_label=error,
        )
    for period in PERIODS:
        paths.append(folder / f"following-period-{period}.png")
        first = followed[period, "closed_loop_inverse"]
        plot_tracking(
            paths[-1],
            first.reference,
            {
                titles[key]: np.interp(first.times, followed[period, key].times, followed[period, key].output)
                for key in FOLLOWING
            },
            horizontal=first.times,
            horizontal_label="time / s",
            output_label=curvature,
            error_label=error,
        )
    return paths


def _print_result(result: Mapping[str, Any], console: Console) -> None:
    for key, title, papers in (
        ("identification", "identification, errors in 1/m (Figs. 5, 7 and 9)", [m.identification for m in MODELS]),
        (
            "validation",
            f"validation, errors in 1/m (Fig. 10; session offset {result['session_offset']:+g} K)",
            [m.validation for m in MODELS],
        ),
    ):
        errors = [
            (
                entry.title,
                f"{paper:g}",
                f"{result[key][entry.key]['max']:.1f}",
                f"{result[key][entry.key]['rms']:.1f}",
            )
            for entry, paper in zip(MODELS, papers, strict=True)
        ]
        console.print(make_table(title, ("model", "paper max", "bench max", "bench RMS"), errors))
    residuals = ", ".join(f"{entry.title} {result['kkt'][entry.key]:.0e}" for entry in MODELS)
    console.print(f"KKT residuals: {residuals}", highlight=False)
    rows: list[tuple[str, ...]] = [
        (name, f"{paper:g}", f"{result['parameters'][name]:.2f}", unit)
        for name, (paper, unit) in _PAPER_PARAMETERS.items()
    ]
    console.print(make_table("the proposed model's parameters", ("", "paper", "bench", "unit"), rows))
    rows = []
    for session in TRACKING:
        entry = result["tracking"][session.key]
        paper = [f"{value:g}" if value is not None else "–" for value in (session.paper_max, session.paper_rms)]
        rows.append(
            (
                session.title,
                *paper,
                *(f"{entry[key]:.2f}" for key in ("max", "rms", "median")),
                f"{entry['seconds_per_target']:.1f}",
            )
        )
    columns: tuple[str, ...] = ("controller", "paper max", "paper RMS", "max", "RMS", "median", "s/target")
    title = f"tracking of 60 targets, errors in 1/m (Fig. 12; session offset {result['tracking_offset']:+g} K)"
    console.print(make_table(title, columns, rows))
    rows = [
        (
            next(session.title for session in TRACKING if session.key == key),
            *(
                f"{result['continuous'][f'period_{period}'][key][what]:.1f}"
                for period in PERIODS
                for what in ("max", "rms")
            ),
        )
        for key in FOLLOWING
    ]
    columns = ("controller", *(f"{what}, {period} s" for period in PERIODS for what in ("max", "RMS")))
    console.print(make_table("following a modulated sine at 2 Hz, errors in 1/m", columns, rows))
    print_end(result, console)
