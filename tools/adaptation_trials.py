"""Open loop on a cantilever that changed after its model was identified, with and without adaptation: a table.

Run as a script, some minutes: `.venv/bin/python tools/adaptation_trials.py [SESSIONS]`. It prints the RMS
error of targets 1 to 60 and 61 to 120, median and worst over the sessions (5 if not given), for
docs/reference/tuning.md.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import bench
from bench.analysis import target_results
from bench.record import Record

WIDER = ("major_width", "minor_width", "major_width_spread", "minor_width_spread")
SPECIMENS = {
    "as identified": {},
    "loops 1.3 times as wide": dict(zip(WIDER, (5.2, 18.2, 2.6, 7.8), strict=True)),
    "transition 10 % larger": {"transition_curvature": 1.1 * 2034.0},
}
COUNT = 120
IDEAL = {"emulation.sensors": "ideal"}


def main(sessions: int) -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run = bench.run("damped-oscillation", "vo2", out=folder, clock="virtual", overrides=IDEAL)
        found = bench.identify(
            run, "preisach-nonmonotonic", input="tec_temperature", output="curvature", levels=20,
            plane=(30.0, 70.0), reference=20.0,
        )  # fmt: skip
        found.file.save(folder / "model.json")
        print(f"{'specimen':28}{'adaptation':12}{'first 60':>16}{'then':>16}")
        for specimen, changes in SPECIMENS.items():
            for adaptation in ("off", "session", "density"):
                errors = [tracked(folder, changes, adaptation, seed) for seed in range(sessions)]
                parts = [
                    np.sqrt(np.mean(np.square(half), axis=1)) for half in np.split(np.array(errors), [60], axis=1)
                ]
                texts = [f"{np.median(part):.1f} / {part.max():.1f}" for part in parts]
                print(f"{specimen:28}{adaptation:12}{texts[0]:>16}{texts[1]:>16}", flush=True)


def tracked(folder: Path, changes: dict[str, float], adaptation: str, seed: int) -> np.ndarray:
    """Return the errors of a session, 1/m."""
    overrides = IDEAL | {f"emulation.plant.{name}": str(value) for name, value in changes.items()}
    overrides["emulation.session_offset"] = "0.12" if seed % 2 == 0 else "-0.12"
    run = bench.run(
        "tracking", "vo2", out=folder, clock="virtual", seed=seed, overrides=overrides,
        model=str(folder / "model.json"), controller="open-loop-inverse", count=COUNT, sequence_seed=seed + 1,
        adaptation=adaptation, fallback="open-loop",
    )  # fmt: skip
    with Record(run.folder) as record:
        results = target_results(record, "curvature")
    assert results is not None
    return results.outputs - results.targets


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
