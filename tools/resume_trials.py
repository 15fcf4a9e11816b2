"""Trials of resuming: runs that are killed at random moments, resumed, and compared with uninterrupted ones.

    python tools/resume_trials.py [--trials 40] [--kills 10] [--seed 0]

First one run of vo2 that is killed many times in a row, then single kills on every rig. Each run has to have the
steps of the uninterrupted one, and coefficients of a model within one standard uncertainty of it: RMS, in σ of the
two fits. Where the noise is not white that σ is too small; then it may not be farther than two uninterrupted runs
with other noise are at most. A run that was completed before it was killed says nothing, and is made again. The
last line says how many did.
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from killing import EndedFirstError, distance, finished_steps, kill_after
from rich.console import Console
from rich.table import Table

import bench

SEEDS = 4
"""Uninterrupted runs, of which the first is compared with."""

CAMPAIGN = "vo2, characterization"
SETTINGS: Mapping[str, Mapping[str, float]] = {
    # The paper's characterization, as in `bench study vo2`.
    CAMPAIGN: {},
    "vo2": {"increment": 1.5, "half_cycles": 24},
    "sma": {"increment": 0.25, "half_cycles": 16, "dwell": 10.0},
    "hybrid": {"increment": 4.0, "half_cycles": 20},
}
MODEL = "preisach-nonmonotonic"
OPTIONS: Mapping[str, Mapping[str, Any]] = {CAMPAIGN: {"levels": 20, "plane": (30.0, 70.0), "reference": 20.0}}
FEW: Mapping[str, Any] = {"levels": 6}


def _command(rig: str, out: Path) -> list[str]:
    settings = [f"--set={name}={value}" for name, value in SETTINGS[rig].items()]
    return [
        "run",
        "damped-oscillation",
        "--rig",
        rig.partition(",")[0],
        "--clock",
        "virtual",
        "--out",
        str(out),
        *settings,
    ]


def _resumption(folder: Path) -> list[str]:
    # A developer may commit something meanwhile.
    return ["resume", str(folder), "--accept-changes"]


def _resume(folder: Path) -> str:
    """Resume a run in another process; return why it did not complete, or nothing."""
    code = f"from bench.cli import main; main({_resumption(folder)!r})"
    ended = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    return "" if ended.returncode == 0 else f"exit code {ended.returncode}: {ended.stderr.strip().splitlines()[-1:]}"


def _trial(rig: str, whole: Path, kills: int, moments: random.Random, out: Path) -> tuple[list[int], str]:
    """Kill a run so often, resume it to its end; return after which steps it was killed, and what failed."""
    total = finished_steps(whole.parent)
    # A run that ends before it is killed is none.
    after = sorted(moments.sample(range(1, total - total // 10), kills))
    killed: list[int] = []
    command = _command(rig, out)
    for step in after:
        # A kill comes some time after the step: in a hold, in a commit, or on the way back.
        try:
            folder = kill_after(step, out, *command, delay=moments.uniform(0.0, 0.03))
        except AssertionError as error:
            return killed, str(error)
        killed.append(finished_steps(out))
        command = _resumption(folder)
    return killed, _resume(folder)


def main() -> int:
    """Carry the trials out and print the table; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40, help="runs that are killed once")
    parser.add_argument("--kills", type=int, default=10, help="kills of the one run of vo2")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    asked = parser.parse_args()
    moments = random.Random(asked.seed)
    table = Table("rig", "killed after steps", "steps", "of", "model / σ", "other noise / σ", "result")
    failed = 0
    with tempfile.TemporaryDirectory(prefix="resume-trials-") as scratch:
        wholes = {rig: _uninterrupted(rig, Path(scratch)) for rig in SETTINGS}
        singles = [rig for rig in SETTINGS if rig != CAMPAIGN]
        rigs = [CAMPAIGN, *(singles[i % len(singles)] for i in range(asked.trials))]
        apart = {rig: _apart(rig, folders) for rig, folders in wholes.items()}
        for number, rig in enumerate(rigs):
            out, whole = Path(scratch) / f"trial-{number}", wholes[rig][0]
            while True:
                try:
                    killed, problem = _trial(rig, whole, 1 if number else asked.kills, moments, out)
                    break
                except EndedFirstError:
                    shutil.rmtree(out)
            steps, total = finished_steps(out), finished_steps(whole.parent)
            away = float("nan")
            if not problem:
                (folder,) = out.iterdir()
                away = distance(folder, whole, MODEL, OPTIONS.get(rig, FEW))
            good = not problem and steps == total and away < max(1.0, apart[rig])
            failed += not good
            result = "as uninterrupted" if good else f"FAILED {problem}"
            listed = ", ".join(map(str, killed))
            row = (rig, listed, str(steps), str(total), f"{away:.3f}", f"{apart[rig]:.3f}", result)
            table.add_row(*row)
            print(*row, sep="  ", flush=True)
    Console(width=160).print(table)
    print(f"{len(rigs) - failed} of {len(rigs)} runs went on as if they had not been killed")
    return 1 if failed else 0


def _uninterrupted(rig: str, out: Path) -> list[Path]:
    """Carry the run of a rig out with one seed after another; return the folders."""
    name = rig.partition(",")[0]
    return [
        bench.run("damped-oscillation", name, out=out / rig / str(seed), seed=seed, **SETTINGS[rig]).folder
        for seed in range(SEEDS)
    ]


def _apart(rig: str, folders: Sequence[Path]) -> float:
    """Return how far the models of two uninterrupted runs with different noise are apart at most."""
    return max(distance(*pair, MODEL, OPTIONS.get(rig, FEW)) for pair in combinations(folders, 2))


if __name__ == "__main__":
    sys.exit(main())
