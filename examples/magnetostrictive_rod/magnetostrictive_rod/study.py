"""The study: characterization, two models, and tracking by the inverse of each, in one table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bench.analysis import FEWEST_ROWS, ColumnNames, FitOptions, identify_model, read_dataset
from bench.base import Pending
from bench.batch import ResultTable, RunSeries, Study, StudyResult, reached_targets
from bench.execution import RunResult

MODELS: Mapping[str, Mapping[str, Any]] = {
    "quadratic-play": {},
    "preisach-signed": {"plane": (-2.4, 2.4), "smoothing": 0.0, "ridge": 0.0},
}
"""Models and their options. The plane ends before the drive's range does, so that the reset saturates it."""

CONTROLLERS = ("open-loop-inverse", "closed-loop-inverse")

TABLE = ResultTable(
    "models of the rod, RMS errors in µm/m (seed {seed})",
    ("model", "identification", *CONTROLLERS),
    [
        (
            name,
            f"{{identification[{name}][rms]:.2f}}",
            *(f"{{tracking[{name}][{key}][rms]:.2f}}" for key in CONTROLLERS),
        )
        for name in MODELS
    ],
)


def carry_out(campaign: RunSeries) -> StudyResult:
    """Run the experiments and evaluate them; raises `BenchError` if a run did not complete."""
    measured = campaign.run("damped-oscillation", {"half_cycles": "24"})
    identification: dict[str, Any] = {}
    runs: dict[str, dict[str, Pending[RunResult]]] = {}
    data = read_dataset([measured.folder], ColumnNames("coil_current", "strain"), at_least=FEWEST_ROWS)
    for name, options in MODELS.items():
        model = identify_model(data, name, FitOptions.of(options))
        path = campaign.folder / f"{name}.json"
        model.file.save(path)
        identification[name] = model.identification.errors.to_json()
        # They go on beside each other.
        runs[name] = {
            controller: campaign.start("tracking", {"model": str(path), "controller": controller, "count": "20"})
            for controller in CONTROLLERS
        }
    tracking = {
        name: {controller: reached_targets(run.result(), "strain").summary() for controller, run in started.items()}
        for name, started in runs.items()
    }
    return StudyResult({"identification": identification, "tracking": tracking}, (TABLE,), ())


STUDY = Study(
    "magnetostrictive-rod",
    "Magnetostrictive rod: characterization, two models, and tracking by the inverse of each",
    "Runs damped-oscillation, identifies the models quadratic-play and preisach-signed, and brings the strain to 20 "
    "targets by the inverse of each, without and with feedback.",
    carry_out,
)
