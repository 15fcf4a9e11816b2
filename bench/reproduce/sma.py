"""The paper on three-dimensional hysteresis on the rig `sma`: characterization, models, verification, and control.

J. Zhang and M. C. Yip, *Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles with Application to Shape
Memory Alloy Actuators*, Robotics: Science and Systems, 2017; here "Zhang and Yip 2017".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from bench.clock import Stopwatch
from bench.errors import DataError
from bench.identification import Errors
from bench.identification.two_stage import CoupledIdentification, Series, measure_series, predict_series
from bench.journal import Record, add_model
from bench.muscle_runs import (
    FORCE,
    LENGTH,
    MODELS,
    ModelName,
    Resting,
    errors_json,
    identify_muscle,
    muscle_file,
    read_resting,
    read_series,
)
from bench.reproduce.campaign import Campaign, make_table, print_end
from bench.results.figures import (
    Curve,
    plot_densities,
    plot_errors,
    plot_panels,
    plot_sequence_and_errors,
    plot_tracking,
)
from bench.results.model_file import ModelFile
from bench.results.report import export_run
from bench.results.tracking import TargetResults, target_results
from bench.runs import RunResult

Floats = npt.NDArray[np.float64]

TITLES: Mapping[ModelName, str] = {
    "two-stage": "two-stage (proposed)",
    "summed": "Summed",
    "linear": "Linear",
    "two-stage-prandtl-ishlinskii": "two-stage, second one of 15 plays",
}
KINDS = {
    "fv": ("F–V, ends held", "Fig. 6"),
    "lv": ("L–V, five loads", "Figs. 7 and 10"),
    "lf": ("L–F, six voltages", "Figs. 8 and 10"),
    "verification": ("verification, random voltages", "Fig. 11"),
}
"""The kinds of series by their keys in the JSON: what was varied, and the paper's figures of it."""
_RESIDUALS = {"fv": "force-voltage", "lv": "length-voltage", "lf": "length-force"}
"""The keys of the result, and those of an identification."""

PAPER: Mapping[str, Mapping[ModelName, tuple[float, float]]] = {
    "fv": {"two-stage": (1.2, 1.9)},
    "lv": {"two-stage": (4.8, 7.2), "summed": (10.0, 11.8), "linear": (11.8, 14.5)},
    "lf": {"two-stage": (4.3, 4.9), "summed": (3.8, 6.3), "linear": (8.9, 11.6)},
    "verification": {"two-stage": (4.7, 6.9), "summed": (9.3, 11.3), "linear": (10.4, 13.5)},
}
"""Average and RMS errors that the paper states, % of the range (sections V-B and V-C)."""

CONTROLLERS = ("open-loop-inverse", "proportional-integral", "closed-loop-inverse")
LOAD_CHANGE = 1.96
"""What is hung on and taken off again in the session with a changing load, N."""


@dataclass(frozen=True)
class ControlSession:
    """One task, which each of some controllers is given.

    Attributes
    ----------
    key : str
        Name in the JSON.
    title : str
        Name in tables and figures.
    protocol : str
        What is run.
    settings : mapping of str to str
        Its parameters.
    """

    key: str
    title: str
    protocol: str
    settings: Mapping[str, str]

    @property
    def signal(self) -> str:
        """What is controlled."""
        return LENGTH if self.protocol == "length-control" else FORCE

    @property
    def scale(self) -> float:
        """From the signal to what is printed: mm or N."""
        return 1e3 if self.signal == LENGTH else 1.0

    @property
    def unit(self) -> str:
        """What is printed."""
        return "mm" if self.signal == LENGTH else "N"


CONTROL = (
    ControlSession("length_4.9N", "length under 4.90 N", "length-control", {"load": "4.9"}),
    ControlSession("length_8.82N", "length under 8.82 N", "length-control", {"load": "8.82"}),
    ControlSession(
        "length_changing_load",
        f"length, load changes by {LOAD_CHANGE} N",
        "length-control",
        {"load": "4.9", "change": str(LOAD_CHANGE)},
    ),
    ControlSession("force", "force, ends held", "force-control", {}),
)


@dataclass(frozen=True)
class Characterization:
    """What the four runs of a characterization measured, and the models that were identified from three of them."""

    resting: Resting
    series: Sequence[Series]
    verification: Sequence[Series]
    models: Mapping[ModelName, CoupledIdentification[Any]]
    runs: Sequence[RunResult]

    def errors(self, name: ModelName) -> dict[str, Errors]:
        """Return the errors of a model by `fv`, `lv`, `lf` and `verification`; a Summed has no `fv`."""
        found = self.models[name]
        by_key = {key: found.errors[kind] for key, kind in _RESIDUALS.items() if kind in found.errors}
        return by_key | {"verification": measure_series(found.model, self.verification)}

    def keep_model(self, campaign: Campaign) -> None:
        """Put the two-stage model into the record of every run of a campaign, for the view of its densities."""
        content = ModelFile("two-stage", self.models["two-stage"].model).to_json()
        for run in campaign.runs:
            add_model(run.folder, "two-stage", 0.0, content)

    def errors_json(self) -> dict[str, dict[str, dict[str, float]]]:
        """Return average and RMS errors in percent of the range, by kind and model."""
        result: dict[str, dict[str, dict[str, float]]] = {key: {} for key in KINDS}
        for name in self.models:
            for key, errors in self.errors(name).items():
                result[key][json_key(name)] = errors_json(errors)
        return result


def json_key(name: str) -> str:
    """Return a name as it is a key in the JSON."""
    return name.replace("-", "_")


def characterize(campaign: Campaign, settings: Mapping[str, Mapping[str, str]] | None = None) -> Characterization:
    """Run the four protocols of a muscle, and identify each model; the model files go into the campaign's folder.

    Parameters
    ----------
    campaign : Campaign
        Where to run.
    settings : mapping of str to mapping, optional
        Parameters by protocol.

    Raises
    ------
    BenchError
        If a run did not complete, or a model cannot be identified.
    """
    given = settings or {}
    runs = {
        protocol: campaign.run(protocol, given.get(protocol, {}))
        for protocol in ("force-voltage", "length-voltage", "length-force", "length-verification")
    }
    resting = read_resting(runs["force-voltage"].folder)
    series = [*read_series(runs["length-voltage"].folder), *read_series(runs["length-force"].folder)]
    models = {name: identify_muscle(name, resting, series) for name in MODELS}
    sources = [run.folder for run in list(runs.values())[:3]]
    for name, found in models.items():
        muscle_file(name, found, sources).save(campaign.folder / f"{name}.json")
    return Characterization(
        resting, series, read_series(runs["length-verification"].folder), models, list(runs.values())
    )


def reproduce_sma(*, rig: str, seed: int, out: Path, live: bool, console: Console) -> dict[str, Any]:
    """Run the paper's experiments and the control beyond it, identify the models, and print the tables.

    Parameters
    ----------
    rig : str
        The rig: `sma`, or a rig file with the same devices and signals.
    seed : int
        Seed of the emulated laboratory's noise, of the random voltages and of the targets.
    out : Path
        Folder for runs, models and figures.
    live : bool
        Whether to serve the live view.
    console : Console
        Where to print.

    Returns
    -------
    dict
        The result for programs: errors in percent of the range by `fv`, `lv`, `lf` and `verification`; `control` in
        mm and N.

    Raises
    ------
    BenchError
        If a run did not complete; its record is kept.
    """
    stopwatch = Stopwatch()
    campaign = Campaign(rig, out / f"reproduce-sma-seed-{seed}", seed, live, console)
    sequence = {"sequence_seed": str(seed + 1)}
    measured = characterize(campaign, {"length-verification": sequence})
    model = str(campaign.folder / "two-stage.json")
    reached = {
        (session.key, controller): _reached(
            campaign.run(
                session.protocol, {"model": model, "controller": controller, **session.settings, **sequence}
            ),
            session.signal,
        )
        for session in CONTROL
        for controller in CONTROLLERS
    }
    measured.keep_model(campaign)
    recordings = [export_run(run.folder, "rrd", None)[0] for run in campaign.runs]
    figures = _draw(measured, campaign.folder / "figures")
    figures += _draw_control(reached, campaign.folder / "figures")
    result = {
        "seed": seed,
        **measured.errors_json(),
        "kkt": {
            json_key(name): max(certificate.kkt_residual for certificate in found.certificates.values())
            for name, found in measured.models.items()
        },
        "control": {
            session.key: {
                json_key(controller): _control_json(reached[session.key, controller], session.scale)
                for controller in CONTROLLERS
            }
            for session in CONTROL
        },
        "units": {session.key: session.unit for session in CONTROL},
        "laboratory_seconds": campaign.laboratory_seconds,
        "wall_seconds": stopwatch.seconds(),
        "folder": str(campaign.folder),
        "figures": [str(path) for path in figures],
        "recordings": [str(path) for path in recordings],
    }
    console.print(errors_table(measured, PAPER))
    console.print(_control_table(result))
    print_end(result, console)
    return result


def errors_table(
    measured: Characterization, paper: Mapping[str, Mapping[ModelName, tuple[float, float]]], title: str = ""
) -> Table:
    """Return the table of errors, average / RMS in percent of the range, beside those of the paper."""
    found = {name: measured.errors(name) for name in TITLES}
    rows = []
    for key, (kind, figures) in KINDS.items():
        first = f"{kind} ({figures})" if paper else kind
        for name, model in TITLES.items():
            if key in found[name]:
                errors = found[name][key]
                stated = paper.get(key, {}).get(name)
                beside = [f"{stated[0]:.1f} / {stated[1]:.1f}" if stated else "–"] if paper else []
                rows.append((first, model, *beside, f"{errors.average_percent:.1f} / {errors.rms_percent:.1f}"))
                first = ""
    columns = ("", "model", *(["paper"] if paper else []), "bench")
    return make_table(title or "errors, average / RMS in % of the range", columns, rows)


def _reached(run: RunResult, signal: str) -> TargetResults:
    with Record(run.folder) as record:
        results = target_results(record, signal)
    if results is None:
        raise DataError(f"{run.folder}: has no targets")
    return results


def _control_json(results: TargetResults, scale: float) -> dict[str, float]:
    summary = results.summary()
    return {key: summary[key] * scale for key in ("max", "rms", "median")}


def _control_table(result: Mapping[str, Any]) -> Table:
    rows = []
    for session in CONTROL:
        title = f"{session.title}, {session.unit}"
        for controller in CONTROLLERS:
            entry = result["control"][session.key][json_key(controller)]
            rows.append((title, controller, *(f"{entry[key]:.3f}" for key in ("max", "rms", "median"))))
            title = ""
    return make_table(
        "control, 40 targets of 20 s each, absolute errors", ("", "controller", "max", "RMS", "median"), rows
    )


def _draw(measured: Characterization, folder: Path) -> list[Path]:
    voltages, forces, _ = measured.resting
    models = {name: found.model for name, found in measured.models.items() if name in PAPER["lv"]}
    paths = []

    def path(name: str) -> Path:
        paths.append(folder / f"{name}.png")
        return paths[-1]

    plot_panels(
        path("figure-06-force-voltage"),
        {
            "measured": [Curve("", voltages, forces)],
            **{
                TITLES[name]: [Curve("", voltages, forces - measured.models[name].residuals["force-voltage"])]
                for name in ("two-stage", "linear")
            },
        },
        horizontal_label="voltage / V",
        vertical_label="force / N",
        columns=3,
    )
    for name, kind in (("figure-07-length-voltage", "length-voltage"), ("figure-08-length-force", "length-force")):
        over_voltage = kind == "length-voltage"
        chosen = [series for series in measured.series if series.kind == kind]
        labels = [f"{s.forces[0]:.2f} N" if over_voltage else f"{s.voltages[0]:g} V" for s in chosen]
        horizontal = [s.voltages if over_voltage else s.forces for s in chosen]
        lengths = {"measured": [s.lengths for s in chosen]} | {
            TITLES[which]: [predict_series(model, s) for s in chosen] for which, model in models.items()
        }
        plot_panels(
            path(name),
            {
                title: [Curve(*curve) for curve in zip(labels, horizontal, [v * 1e3 for v in values], strict=True)]
                for title, values in lengths.items()
            },
            horizontal_label="voltage / V" if over_voltage else "force / N",
            vertical_label="length / mm",
        )
    two_stage = measured.models["two-stage"].model
    plot_densities(path("figure-09-densities"), two_stage.densities())
    for name, kind in (
        ("figure-10a-errors-length-voltage", "length-voltage"),
        ("figure-10b-errors-length-force", "length-force"),
    ):
        plot_errors(
            path(name),
            {TITLES[which]: measured.models[which].residuals[kind] * 1e3 for which in models},
            error_label="error / mm",
        )
    verification = measured.verification
    plot_sequence_and_errors(
        path("figure-11-verification"),
        np.concatenate([s.voltages for s in verification]),
        {
            TITLES[which]: np.concatenate([s.lengths - predict_series(model, s) for s in verification]) * 1e3
            for which, model in models.items()
        },
        input_label="voltage / V",
        error_label="error / mm",
    )
    return paths


def _draw_control(reached: Mapping[tuple[str, str], TargetResults], folder: Path) -> list[Path]:
    paths = []
    for session in CONTROL:
        paths.append(folder / f"control-{session.key.replace('_', '-')}.png")
        first = reached[session.key, CONTROLLERS[-1]]
        what = "length" if session.unit == "mm" else "force"
        plot_tracking(
            paths[-1],
            first.targets * session.scale,
            {controller: reached[session.key, controller].outputs * session.scale for controller in CONTROLLERS},
            output_label=f"{what} / {session.unit}",
            error_label=f"error / {session.unit}",
        )
    return paths
