"""Bands of the studies' errors: none may be half as much again as what was recorded.

The goals of a study leave room; a controller could lose most of its accuracy and still meet them. The numbers
recorded are those of seed 0 with the settings `SHORT`:

    python -P tests/support/regression_bands.py vo2
"""

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

RECORDED = Path(__file__).parents[1] / "golden" / "recorded"
ERRORS = {"rms", "max", "median", "average", "settling", "seconds"}
BAND = 1.5
RECORDED_SEED = 0
_MODELS_OF_A_MUSCLE = (
    "force-voltage.dwell=20",
    "length-voltage.points=13",
    "length-voltage.dwell=20",
    "length-verification.points=7",
    "length-verification.dwell=20",
    "length-force.points=5",
    "length-force.voltages=0,1,2,3",
    "length-force.dwell=20",
)
SHORT = {
    "vo2": (
        "damped-oscillation.increment=0.5",
        "damped-oscillation.dwell=5",
        "random-validation.count=300",
        "tracking.count=12",
        "following.duration=200",
    ),
    "sma": (*_MODELS_OF_A_MUSCLE, "length-control.count=10", "force-control.count=10"),
    "muscles": _MODELS_OF_A_MUSCLE,
    "hybrid": (
        "current-sine.rate=0.25",
        "current-sine.periods=2",
        "current-steps.on=400",
        "current-steps.off=500",
        "current-steps.rate=0.5",
        "thermomechanical.levels=7",
        "piezo-step.duration=0.15",
        "hybrid-excitation.duration=1000",
        "hybrid-excitation.rate=1",
        "hybrid-control.positions=90e-6, -120e-6",
        "hybrid-control.low=-10e-6",
        "hybrid-control.high=10e-6",
        "hybrid-control.steps=1",
        "hybrid-control.rate=100",
        "hybrid-control.record_rate=25",
        "hybrid-control.speed=3e-6",
        "calibration-displacement.rate=2",
        "fine-step.duration=0.06",
    ),
}
"""Settings with which a study takes less time: fewer and shorter steps, targets and moves."""


def options_of(study):
    """Return the options of `bench study` for the short study."""
    return [text for setting in SHORT[study] for text in ("--set", setting)]


def errors_of(result):
    """Return the errors among the numbers of a study by their dotted names."""
    # Imported late: most tests do not need it.
    from bench.batch.campaign.file import dotted

    return {
        name: float(value)
        for name, value in dotted(result).items()
        if isinstance(value, (int, float))
        and ERRORS & set(name.rpartition(".")[2].split("_"))
        and not name.endswith("_seconds")
    }


def beyond_the_bands(study, result):
    """Return a line for each error that is missing, or beyond its band."""
    found, recorded = errors_of(result), json.loads((RECORDED / f"{study}.json").read_text(encoding="utf-8"))
    return [
        f"{name}: {found.get(name)}, recorded {value:g}"
        for name, value in recorded.items()
        if name not in found or not found[name] <= BAND * value
    ]


def record(study, result):
    """Write the errors of a result."""
    rounded = {name: float(f"{value:.3g}") for name, value in errors_of(result).items() if value}
    RECORDED.mkdir(exist_ok=True)
    (RECORDED / f"{study}.json").write_text(json.dumps(rounded, indent=1) + "\n", encoding="utf-8")
    print(f"{len(rounded)} errors in {RECORDED / study}.json")


if __name__ == "__main__":
    from bench.cli import main

    (study,) = sys.argv[1:]
    with TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        command = ["study", study, "--seed", RECORDED_SEED, *options_of(study), "--out", folder, "--json", file]
        try:
            main([str(argument) for argument in command])
        except SystemExit as stopped:
            if stopped.code:
                raise
        record(study, json.loads(file.read_text(encoding="utf-8")))
