"""Trials of `bench model tune` on packaged rigs: controllers with constants by hand, of model and file, and tuned.

    python tools/tuning_trials.py [--case mckibben/length-control ...] [--sessions 5] [--out FOLDER]

Each rig is characterized once. Each controller is tuned for the model, and brings its output to its targets in
sessions whose noise and targets the tuning has not seen: with the constants by hand (`by_hand`), with the numbers of
model and rig file, and with those of the tuning file. The table has for each of the
three median and worst of the RMS error over the sessions, and the mean time at a target; then in how many sessions
the cost of `bench model tune` is less with the tuning file than by hand, and what supply and sensor of a muscle
leave. Of a controller that is given up it has at which target. Exits with 1 if tuned numbers cost more than those
by hand in most sessions.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

import bench
from bench.analysis import TargetResults, target_results
from bench.base import ConvergenceError, DataError, Workers
from bench.batch import RunSeries, reached_targets, tune
from bench.batch.tuning.search import cost_of
from bench.identification import load_model
from bench.record import Record
from bench.rig import load_rig
from rigs.muscles.identification import (
    FORCE,
    LENGTH,
    identify_muscle,
    identify_muscle_dynamics,
    muscle_file,
    read_resting,
    read_series,
)
from rigs.muscles.tasks import ForceTask, LengthTask, Task
from rigs.muscles.two_stage_inverse import TwoStageInverse

STEP = 0.01
"""Step of the supply of the muscles, V: a thousandth of its 10 V."""
READINGS = 5
"""Readings at each target of a muscle."""
UNSEEN = 1000
"""Seed of the first session that no tuning has seen."""
SEARCHED = {"count": "20"}
"""Settings of the search: fewer targets than in a session, for the sake of time."""
LOOPS: Mapping[str, Mapping[str, Any]] = {
    "vo2": {"model": "preisach-nonmonotonic", "levels": 20, "plane": (30.0, 70.0)},
    "hybrid": {"model": "preisach", "levels": 20},
}
"""How the model of a rig is identified from its damped oscillation; that of a muscle comes from three runs."""

BY_HAND: Mapping[str, Mapping[str, Any]] = {
    "vo2/tracking": {
        "close_enough": 5.0,
        "walk_variance": 3.0,
        "reading_variance": 1.0,
        "corrections": 3,
        "arrival": {"tolerance": 0.03},
    },
    "vo2/tracking/open-loop-inverse": {"wait": 8.0},
    "hybrid/tracking": {"corrections": 3, "arrival": {"tolerance": 0.1}},
}
"""Constants of the controllers before they took their numbers from model and rig file, in the units of the rig."""


class WireConstants(NamedTuple):
    """Constants of length or force control, all found on the SMA wire, before they came from the model of the muscle.

    The integration of a disturbance goes by the ratio of two variances: of the change of the model's error in one
    period, and of one reading.
    """

    slope: float
    ratio: float
    numbers: Mapping[str, Any] = {
        "time_constant": 5.0,
        "power": 2.0,
        "period": 1.0,
        "horizon": 2.0,
        "search": {"steps": 0, "margin": 0},
    }


# Least slope that is believed, m/V or N/V, half of the greatest; 2e-8 m² and a reading of 0.04 mm steps with 0.01 mm
# of noise; 0.02 N² and 0.02 N of noise.
WIRE = {
    LENGTH: WireConstants(1e-3, 2e-8 / (0.04e-3**2 / 12.0 + 0.01e-3**2)),
    FORCE: WireConstants(5.0, 2e-2 / 4e-4),
}


_CLOSED_LOOP = "closed-loop-inverse"


class Case(NamedTuple):
    """What is tuned: rig, protocol, controller; the signal that counts, and the unit that is printed, in SI.

    `seeds` and `checks` are the sessions of each run of the search, and those in which its result is judged.
    """

    rig: str
    protocol: str
    controller: str
    signal: str
    unit: str
    size: float = 1.0
    seeds: int = 2
    checks: int = 8

    @property
    def name(self) -> str:
        return f"{self.rig}/{self.protocol}" + f"/{self.controller}" * (self.controller != _CLOSED_LOOP)


CASES = (
    *(
        Case("vo2", "tracking", controller, "curvature", "1/m", seeds=6, checks=16)
        for controller in (_CLOSED_LOOP, "open-loop-inverse")
    ),
    *(
        case
        for rig in ("sma", "mckibben", "coiled-polymer")
        for case in (
            Case(rig, "length-control", _CLOSED_LOOP, LENGTH, "µm", 1e-6),
            Case(rig, "force-control", _CLOSED_LOOP, FORCE, "mN", 1e-3),
        )
    ),
    Case("hybrid", "tracking", _CLOSED_LOOP, "displacement_position", "nm", 1e-9),
)


def characterized(rig: str, folder: Path) -> Path:
    """Return the model file of a rig, identified from its characterization."""
    model = folder / "model.json"
    if model.exists():
        return model
    if rig in LOOPS:
        found = bench.identify(bench.run("damped-oscillation", rig, out=folder), **LOOPS[rig]).file
    else:
        force, *lengths = (
            bench.run(protocol, rig, out=folder).folder
            for protocol in ("force-voltage", "length-voltage", "length-force")
        )
        series = [one for run in lengths for one in read_series(run)]
        muscle = identify_muscle("two-stage", read_resting(force), series)
        dynamics = identify_muscle_dynamics(muscle.model, force, lengths)
        found = muscle_file("two-stage", muscle, [force, *lengths], dynamics)
    found.save(model)
    return model


def task_of(case: Case, model: Path) -> tuple[Task, float]:
    """Return the task of a muscle's controller at `model_error` = 1, and the range of its voltage, V."""
    file = load_model(model)
    assert file.dynamics is not None
    state = file.model.initial_state()
    kind = {LENGTH: LengthTask, FORCE: ForceTask}[case.signal]
    if kind is LengthTask:
        state, _ = file.model.step(state, state.voltage, load_rig(case.rig).roles["load"].rest)
    low, high = file.model.first.input_range
    inverse = TwoStageInverse(file.model)
    return kind.of_model(inverse, state, (low, high), file.dynamics.noise, model_error=1.0), high - low


def by_hand(case: Case, model: Path) -> Mapping[str, Any]:
    """Return the constants by hand, a muscle's as multiples of what its controller takes from the model."""
    if case.protocol == "tracking":
        return BY_HAND[case.name]
    task, _ = task_of(case, model)
    wire = WIRE[case.signal]
    walk = math.sqrt(wire.ratio * task.reading_variance / task.walk_variance)
    return {**wire.numbers, "caution": wire.slope / min(map(abs, task.slopes)), "model_error": walk}


def resolution(case: Case, model: Path) -> float:
    """Return the RMS error that steps of the supply and noise of the sensor leave at a muscle, SI."""
    if case.protocol == "tracking":
        return math.nan
    task, voltage = task_of(case, model)
    # Of the mean slope; the error within a step is uniform.
    step = abs(task.rise) / voltage * STEP
    return math.hypot(step / math.sqrt(12.0), math.sqrt(task.reading_variance / READINGS))


class Sessions(NamedTuple):
    """What sessions with one set of numbers gave.

    Attributes
    ----------
    values : ndarray, shape (N, 2)
        RMS error (SI) and seconds at a target; nan where the controller was given up.
    ended : list of int
        At which target it was given up, in each of those sessions; 1 is the first.
    """

    values: np.ndarray
    ended: list[int]

    def cells(self, size: float) -> list[str]:
        """Return median and worst error, in units of `size`, and the mean time, for the table."""
        if self.ended:
            low, high = min(self.ended), max(self.ended)
            where = f"target {low}" if low == high else f"targets {low} to {high}"
            return [f"given up at {where} in {len(self.ended)} of {len(self.values)}", ""]
        errors = self.values[:, 0] / size
        return [f"{np.median(errors):.3g} / {errors.max():.3g}", f"{self.values[:, 1].mean():.3g}"]


def tried(
    case: Case, model: Path, tunings: Mapping[str, str], folder: Path, sessions: int, pool: Workers
) -> list[Sessions]:
    """Return unseen sessions with each of some tuning files or tables; an empty one is that of the rig file."""
    runs = {}
    for name, tuning in tunings.items():
        for seed in range(UNSEEN, UNSEEN + sessions):
            settings = {"model": str(model), "controller": case.controller, "sequence_seed": str(seed)}
            if tuning:
                settings["tuning"] = tuning
            campaign = RunSeries(case.rig, folder / name / str(seed), seed, False, pool)
            runs[name, seed] = campaign, campaign.start(case.protocol, settings)
    found = {name: Sessions(np.full((sessions, 2), math.nan), []) for name in tunings}
    for (name, seed), (campaign, run) in runs.items():
        try:
            reached = reached_targets(run.result(), case.signal)
        except ConvergenceError:
            found[name].ended.append(1 + targets_before(campaign.folder, case.signal))
            continue
        rms = float(np.sqrt(np.mean((reached.outputs - reached.targets) ** 2)))
        found[name].values[seed - UNSEEN] = rms, float(reached.seconds.mean())
    return list(found.values())


def targets_before(folder: Path, signal: str) -> int:
    """Return how many targets were reached in the run of a folder, which was ended."""
    results: TargetResults | None = None
    for run in folder.iterdir():
        with suppress(DataError), Record(run) as record:
            results = target_results(record, signal)
    return 0 if results is None else len(results.targets)


def found_numbers(case: Case, model: Path, folder: Path, workers: int | None, console: Console) -> Path:
    """Return the tuning file of a case, which is made if the folder has none."""
    tuning = folder / "tuning.toml"
    if not tuning.exists():
        found = tune(
            model, case.rig, controller=case.controller, protocol=case.protocol, workers=workers, settings=SEARCHED,
            seeds=case.seeds, checks=case.checks, folder=folder / "search", console=console,
        )  # fmt: skip
        tuning.write_text(found.text(), encoding="utf-8")
        (folder / "numbers.json").write_text(json.dumps(found.summary()), encoding="utf-8")
    return tuning


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="*", choices=[case.name for case in CASES], help="some of the cases")
    parser.add_argument("--sessions", type=int, default=5)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--out", type=Path, help="folder that keeps models, tuning files and runs")
    given = parser.parse_args()
    shown, by_name = Console(width=200), {case.name: case for case in CASES}
    worse = 0
    with tempfile.TemporaryDirectory() as name:
        out = given.out or Path(name)
        for case in CASES if given.case is None else [by_name[each] for each in given.case]:
            rig, folder = out / case.rig, out / case.name
            rig.mkdir(parents=True, exist_ok=True)
            folder.mkdir(parents=True, exist_ok=True)
            model = characterized(case.rig, rig)
            tunings = {
                "by-hand": json.dumps({case.controller: by_hand(case, model)}),
                "today": "",
                "tuned": str(found_numbers(case, model, folder, given.workers, shown)),
            }
            with Workers(given.workers, title=case.name) as pool:
                hand, today, tuned = tried(case, model, tunings, folder, given.sessions, pool)
            scale = np.nanmean(today.values, axis=0).tolist()
            before, after = (
                np.array([cost_of(rms, seconds, scale) for rms, seconds in each.values.tolist()])
                for each in (hand, tuned)
            )
            worse += int((after > before).sum()) > given.sessions / 2
            cells = [cell for each in (hand, today, tuned) for cell in each.cells(case.size)]
            cells += [f"{(after < before).sum()} of {given.sessions}", f"{resolution(case, model) / case.size:.3g}"]
            shown.print(
                f"| `{case.rig}` | {case.protocol}, {case.controller} | {case.unit} | {' | '.join(cells)} |",
                highlight=False,
                markup=False,
            )
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main())
