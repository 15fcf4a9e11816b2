"""Trials of twins: tracking runs on a twin, beside those on the emulated plant that it was identified from.

    python tests/bench/twin_trials.py [--rig vo2 ...] [--real 3] [--twin 5] [--out FOLDER]

The plants of the packaged rigs are built differently from any twin. Each rig is characterized once (creep,
damped-oscillation, random-validation); the second run identifies the model of the controller, and all three the
twin. Then `tracking` runs with that model on both, with other seeds. The table has medians over the seeds with the
range; the last line says how many goals were reached: the duration within 2 %, the RMS of the error within 30 %.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import bench
from bench.journal import Record
from bench.twin.write import write_twin

MODELS: Mapping[str, Mapping[str, Any]] = {
    "vo2": {"model": "preisach-nonmonotonic", "plane": (30.0, 70.0)},
    "sma": {"model": "preisach-signed"},
    "hybrid": {"model": "prandtl-ishlinskii"},
}
GOALS = (0.02, 0.3)
"""Of duration and RMS, as a share of the plant's."""


def tracked(run: Path) -> tuple[float, float]:
    """Return the duration of a tracking run, s, and the RMS over its targets of the mean error at each."""
    with Record(run) as record:
        steps = list(record.step_records())
        names = [signal.name for signal in record.signals]
        controlled, reference = names.index(record.meta["controls"]), names.index("reference")
    errors: list[list[float]] = []
    target = np.nan
    for step in steps:
        # The readings at a target are not under control: the step before them has the reference.
        if step.label == "reach":
            errors.append([])
            target = step.values[reference]
        elif step.label == "reading":
            errors[-1].append(step.values[controlled] - target)
    means = [np.mean(each) for each in errors]
    return steps[-1].finished, float(np.sqrt(np.mean(np.square(means))))


def trial(rig: str, folder: Path, real: int, twins: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return duration and RMS on the plant and on its twin, a row each seed."""
    creep = bench.run("creep", rig, out=folder, seed=1)
    loops = bench.run("damped-oscillation", rig, out=folder, seed=1)
    other = bench.run("random-validation", rig, out=folder, seed=2)
    model, twin = folder / "model.json", folder / "twin.toml"
    bench.identify(loops, **MODELS[rig]).file.save(model)
    write_twin([creep.folder, loops.folder, other.folder], rig, twin, model)
    found = []
    for on, seeds in ((rig, range(11, 11 + real)), (str(twin), range(101, 101 + twins))):
        runs = [bench.run("tracking", on, out=folder, seed=seed, model=str(model)) for seed in seeds]
        found.append(np.array([tracked(run.folder) for run in runs]))
    return found[0], found[1]


def _text(values: NDArray[np.float64]) -> str:
    middle, low, high = (float(f(values)) for f in (np.median, np.min, np.max))
    return f"{middle:.4g} ({low:.4g} to {high:.4g})"


def main() -> None:
    """Make the trials, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", nargs="+", choices=[*MODELS], default=[*MODELS])
    parser.add_argument("--real", type=int, default=3)
    parser.add_argument("--twin", type=int, default=5)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    table = Table("rig", "", "plant", "twin", "of the medians", "goal")
    reached = []
    with tempfile.TemporaryDirectory() as temporary:
        for rig in arguments.rig:
            folder = (arguments.out or Path(temporary)) / rig
            plant, twin = trial(rig, folder, arguments.real, arguments.twin)
            for column, name in enumerate(("duration, s", "RMS error, base unit")):
                change = float(np.median(twin[:, column]) / np.median(plant[:, column])) - 1.0
                reached.append(abs(change) <= GOALS[column])
                table.add_row(
                    rig,
                    name,
                    _text(plant[:, column]),
                    _text(twin[:, column]),
                    f"{100.0 * change:+.1f} %",
                    f"{100.0 * GOALS[column]:g} %{'' if reached[-1] else ', missed'}",
                )
    console = Console(width=118)
    console.print(table)
    console.print(f"{sum(reached)} of {len(reached)} goals reached")
    sys.exit(not all(reached))


if __name__ == "__main__":
    main()
