"""The characterization of a muscle by its four protocols: runs, models, their errors, and figures of the lengths.

J. Zhang and M. C. Yip, *Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles with Application to Shape
Memory Alloy Actuators*, Robotics: Science and Systems, 2017; here "Zhang and Yip 2017".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bench.analysis import Curve, plot_panels
from bench.batch import ResultTable, RunSeries
from bench.identification import CoupledIdentification, FirstStage, ModelFile, Series, measure_series
from bench.models import TwoStage
from rigs.muscles.identification import (
    MODELS,
    ModelName,
    Resting,
    errors_json,
    identify_muscle,
    identify_muscle_dynamics,
    identify_resting,
    muscle_file,
    read_resting,
    read_series,
)

if TYPE_CHECKING:
    from bench.base import Pending
    from bench.execution import RunResult

Floats = npt.NDArray[np.float64]

TITLES: Mapping[ModelName, str] = {
    "two-stage": "two-stage (proposed)",
    "summed": "Summed",
    "linear": "Linear",
    "two-stage-prandtl-ishlinskii": "two-stage, 15 plays",
}
KINDS = {
    "fv": ("F–V, ends held", "Fig. 6"),
    "lv": ("L–V, five loads", "Figs. 7, 10"),
    "lf": ("L–F, six voltages", "Figs. 8, 10"),
    "verification": ("verification", "Fig. 11"),
}
"""The kinds of series by their keys in the JSON: what was varied, and the paper's figures of it."""
_RESIDUALS = {"fv": "force-voltage", "lv": "length-voltage", "lf": "length-force"}
"""The keys of the result, and those of an identification."""

PAPER: Mapping[tuple[str, ModelName], str] = {
    ("fv", "two-stage"): "1.2 / 1.9",
    ("lv", "two-stage"): "4.8 / 7.2",
    ("lv", "summed"): "10.0 / 11.8",
    ("lv", "linear"): "11.8 / 14.5",
    ("lf", "two-stage"): "4.3 / 4.9",
    ("lf", "summed"): "3.8 / 6.3",
    ("lf", "linear"): "8.9 / 11.6",
    ("verification", "two-stage"): "4.7 / 6.9",
    ("verification", "summed"): "9.3 / 11.3",
    ("verification", "linear"): "10.4 / 13.5",
}
"""Average and RMS errors that the paper states, % of the range (sections V-B and V-C)."""


@dataclass(frozen=True)
class Measurements:
    """The run with the ends held and those of the length, what they measured, and the stage of the former."""

    force: Path
    lengths: Sequence[Path]
    resting: Resting
    first: FirstStage
    series: Sequence[Series]


@dataclass(frozen=True)
class Characterization:
    """What the four runs of a characterization measured, and the models that were identified from three of them."""

    resting: Resting
    series: Sequence[Series]
    verification: Sequence[Series]
    models: Mapping[ModelName, CoupledIdentification[Any]]

    def errors_json(self) -> dict[str, dict[str, dict[str, float]]]:
        """Return average and RMS errors in percent of the range, by kind and model; a Summed has no `fv`."""
        result: dict[str, dict[str, dict[str, float]]] = {key: {} for key in KINDS}
        for name, found in self.models.items():
            errors = {key: found.errors[kind] for key, kind in _RESIDUALS.items() if kind in found.errors}
            errors["verification"] = measure_series(found.model, self.verification)
            for key, value in errors.items():
                result[key][json_key(name)] = errors_json(value)
        return result


def json_key(name: str) -> str:
    """Return a name as it is a key in the JSON."""
    return name.replace("-", "_")


def start_runs(campaign: RunSeries, *, verified: bool = True) -> dict[str, Pending[RunResult]]:
    """Start the protocols of a muscle; the campaign's seed chooses the random voltages of the verification."""
    protocols: dict[str, dict[str, str]] = {"force-voltage": {}, "length-voltage": {}, "length-force": {}}
    if verified:
        protocols["length-verification"] = {"sequence_seed": str(campaign.seed + 1)}
    runs = {protocol: campaign.start(protocol, settings) for protocol, settings in protocols.items()}
    # The longest one, and the models wait for it.
    runs["length-force"].hurry()
    return runs


def measure(runs: Mapping[str, Pending[RunResult]]) -> Measurements:
    """Return what the runs of a muscle measured from which its models are identified.

    Raises BenchError if one of them did not complete.
    """
    force = runs["force-voltage"].result().folder
    resting = read_resting(force)
    # Identified beside the other runs.
    first = identify_resting(resting)
    lengths = [runs[protocol].result().folder for protocol in ("length-voltage", "length-force")]
    return Measurements(force, lengths, resting, first, [one for run in lengths for one in read_series(run)])


def identify_models(measured: Measurements, folder: Path) -> Iterator[tuple[ModelName, CoupledIdentification[Any]]]:
    """Yield each model with its name, that of the controllers first; its file is in the folder then.

    Raises BenchError if a model cannot be identified.
    """
    dynamics = None
    for name in MODELS:
        found = identify_muscle(name, measured.resting, measured.series, measured.first)
        is_two_stage = found.model.kind == TwoStage.kind
        if is_two_stage and dynamics is None:
            # The models of two stages have the same first one, which is all that counts here.
            dynamics = identify_muscle_dynamics(found.model, measured.force, measured.lengths)
        sources = [measured.force, *measured.lengths]
        muscle_file(name, found, sources, dynamics if is_two_stage else None).save(folder / f"{name}.json")
        yield name, found


def conclude(
    campaign: RunSeries,
    runs: Mapping[str, Pending[RunResult]],
    measured: Measurements,
    models: Mapping[ModelName, CoupledIdentification[Any]],
) -> Characterization:
    """Return the characterization of a muscle; its runs get the two-stage model, for the view of its densities.

    Raises BenchError if a run did not complete.
    """
    identified = ModelFile("two-stage", models["two-stage"].model)
    folders = {protocol: campaign.conclude(run, [identified]).folder for protocol, run in runs.items()}
    verification = read_series(folders["length-verification"])
    return Characterization(measured.resting, measured.series, verification, models)


def characterize(campaign: RunSeries, runs: Mapping[str, Pending[RunResult]]) -> Characterization:
    """Identify each model from the four runs of a muscle; the model files go into the campaign's folder.

    Raises
    ------
    BenchError
        If a run did not complete, or a model cannot be identified.
    """
    measured = measure(runs)
    return conclude(campaign, runs, measured, dict(identify_models(measured, campaign.folder)))


def errors_table(title: str, path: str = "{}", *, beside_paper: bool = False) -> ResultTable:
    """Return the table of errors, average / RMS in percent of the range.

    Parameters
    ----------
    title : str
        Its title.
    path : str
        Where the errors are in the values of the study, with a place for the kind, such as `muscle[{}]`.
    beside_paper : bool
        Whether to show the paper's figures and errors.
    """
    rows = []
    for key, (kind, figures) in KINDS.items():
        first = f"{kind} ({figures})" if beside_paper else kind
        for name, model in TITLES.items():
            if (key, name) == ("fv", "summed"):
                continue
            entry = f"{path.format(key)}[{json_key(name)}]"
            paper = [PAPER.get((key, name), "–")] if beside_paper else []
            rows.append((first, model, *paper, f"{{{entry}[average]:.1f}} / {{{entry}[rms]:.1f}}"))
            first = ""
    return ResultTable(title, ("", "model", *(["paper"] if beside_paper else []), "bench"), rows)


def plot_lengths(
    path: Path, kind: str, series: Sequence[Series], lengths: Mapping[str, Sequence[Floats]], columns: int = 2
) -> None:
    """Draw lengths over voltages or forces, a panel for each of several sources, a curve for each series.

    Parameters
    ----------
    path : Path
        File to write.
    kind : {"length-voltage", "length-force"}
        Over what.
    series : sequence of Series
        Of this kind.
    lengths : mapping of str to sequence of ndarray
        Lengths (m) by the panel's title, one array for each series.
    columns : int
        Panels beside each other.
    """
    over_voltage = kind == "length-voltage"
    labels = [f"{s.forces[0]:.2f} N" if over_voltage else f"{s.voltages[0]:g} V" for s in series]
    horizontal = [s.voltages if over_voltage else s.forces for s in series]
    plot_panels(
        path,
        {
            title: [Curve(*curve) for curve in zip(labels, horizontal, [v * 1e3 for v in values], strict=True)]
            for title, values in lengths.items()
        },
        horizontal_label="voltage / V" if over_voltage else "force / N",
        vertical_label="length / mm",
        columns=columns,
        measured=("measured",),
    )
