"""Trials of `bench tune` on the packaged rigs: controllers with the numbers of today, and with those that were found.

    python tests/bench/tuning_trials.py [--case mckibben/length-control ...] [--sessions 5] [--out FOLDER]

Each rig is characterized once. Each controller is tuned for the model, and brings its output to its targets in
sessions whose noise and targets the tuning has not seen, with the numbers of model and rig file and with those of the
tuning file. The table, for docs/reference/tuning.md, has median and worst over the sessions of the RMS error, and the
median of the cost of one run by `bench tune`, as multiples of today's means; then what supply and sensor of a muscle
leave, and in how many sessions the cost with the tuning file is not greater. Exits with 1 if a median is worse.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

import bench
from bench.control.two_stage_inverse import TwoStageInverse
from bench.model_file import load_model
from bench.rig_file import load_rig
from bench.studies import Campaign, reached_targets
from bench.tuning.search import cost_of
from bench.tuning.tune import tune
from bench.workers import Workers
from rigs.muscles.identification import (
    FORCE,
    LENGTH,
    identify_muscle,
    identify_muscle_dynamics,
    muscle_file,
    read_resting,
    read_series,
)
from rigs.muscles.tasks import ForceTask, LengthTask

STEP = 0.01
"""Step of the supply of the muscles, V: a thousandth of its 10 V."""
READINGS = 5
"""Readings at each target of a muscle."""
UNSEEN = 1000
"""Seed of the first session that no tuning has seen."""
SEARCHED, ROUNDS = ("count=20",), 1
"""Settings and rounds of the search: fewer targets than in a session and each number changed once, for the sake of
time."""
LOOPS: Mapping[str, Mapping[str, Any]] = {
    "vo2": {"model": "preisach-nonmonotonic", "levels": 20, "plane": (30.0, 70.0)},
    "hybrid": {"model": "preisach", "levels": 20},
}
"""How the model of a rig is identified from its damped oscillation; that of a muscle comes from three runs."""


_CLOSED_LOOP = "closed-loop-inverse"


class Case(NamedTuple):
    """What is tuned: rig, protocol, controller; the signal that counts, and the unit that is printed, in SI."""

    rig: str
    protocol: str
    controller: str
    signal: str
    unit: str
    size: float = 1.0

    @property
    def name(self) -> str:
        return f"{self.rig}/{self.protocol}" + f"/{self.controller}" * (self.controller != _CLOSED_LOOP)


CASES = (
    *(
        Case("vo2", "tracking", controller, "curvature", "1/m")
        for controller in (_CLOSED_LOOP, "open-loop-inverse", "latched")
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


def resolution(case: Case, model: Path) -> float:
    """Return the RMS error that steps of the supply and noise of the sensor leave at a muscle, SI."""
    if case.protocol == "tracking":
        return math.nan
    file = load_model(model)
    state = file.model.initial_state()
    kind = {LENGTH: LengthTask, FORCE: ForceTask}[case.signal]
    if kind is LengthTask:
        state, _ = file.model.step(state, state.voltage, load_rig(case.rig).roles["load"].rest)
    low, high = file.model.first.input_range
    task = kind.of_model(TwoStageInverse(file.model), state, (low, high), file.dynamics.noise, model_error=1.0)
    # Of the mean slope; the error within a step is uniform.
    step = abs(task.rise) / (high - low) * STEP
    return math.hypot(step / math.sqrt(12.0), math.sqrt(task.reading_variance / READINGS))


def compared(case: Case, model: Path, tuning: str, folder: Path, sessions: int, pool: Workers) -> np.ndarray:
    """Return RMS error and cost without and with a tuning file, shape (2, sessions, 2)."""
    runs = []
    for name, given in (("today", {}), ("tuned", {"tuning": tuning})):
        for seed in range(UNSEEN, UNSEEN + sessions):
            settings = {"model": str(model), "controller": case.controller, "sequence_seed": str(seed)} | given
            runs.append(Campaign(case.rig, folder / name, seed, False, pool).start(case.protocol, settings))
    found = []
    for run in runs:
        reached = reached_targets(run.result(), case.signal)
        rms = float(np.sqrt(np.mean((reached.outputs - reached.targets) ** 2)))
        found.append((rms, float(reached.seconds.mean())))
    scale = np.mean(found[:sessions], axis=0).tolist()
    return np.array([(rms, cost_of(rms, seconds, scale)) for rms, seconds in found]).reshape(2, sessions, 2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="*", choices=[case.name for case in CASES], help="some of the cases")
    parser.add_argument("--sessions", type=int, default=5)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--out", type=Path, help="folder that keeps models, tuning files and runs")
    given = parser.parse_args()
    shown, by_name = Console(width=160), {case.name: case for case in CASES}
    worse = 0
    with tempfile.TemporaryDirectory() as name:
        out = given.out or Path(name)
        for case in CASES if given.case is None else [by_name[each] for each in given.case]:
            rig, folder = out / case.rig, out / case.name
            rig.mkdir(parents=True, exist_ok=True)
            folder.mkdir(parents=True, exist_ok=True)
            model, tuning = characterized(case.rig, rig), folder / "tuning.toml"
            if not tuning.exists():
                found = tune(
                    model, case.rig, controller=case.controller, protocol=case.protocol, workers=given.workers,
                    settings=SEARCHED, seeds=1, rounds=ROUNDS, folder=folder / "search", console=shown,
                )  # fmt: skip
                tuning.write_text(found.text(), encoding="utf-8")
                (folder / "numbers.json").write_text(json.dumps(found.summary()), encoding="utf-8")
            with Workers(given.workers, title=case.name) as pool:
                today, tuned = compared(case, model, str(tuning), folder, given.sessions, pool)
            better = int((tuned[:, 1] <= today[:, 1]).sum())
            worse += float(np.median(tuned[:, 1])) > float(np.median(today[:, 1]))
            sizes = [each[:, 0] / case.size for each in (today, tuned)]
            cells = [
                *(f"{np.median(each):.3g} / {each.max():.3g}" for each in sizes),
                *(f"{np.median(each[:, 1]):.3f}" for each in (today, tuned)),
                f"{resolution(case, model) / case.size:.3g}",
            ]
            shown.print(
                f"| `{case.rig}` | {case.protocol}, {case.controller} | {case.unit} | {' | '.join(cells)} "
                f"| {better} of {given.sessions} |",
                highlight=False,
                markup=False,
            )
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main())
