"""Coverage of stated uncertainties: many emulated sessions with other specimens of the sensors, beside the truth.

Run as a script: `.venv/bin/python tools/uncertainty_coverage.py RIG [SESSIONS] [PART...]`. RIG is vo2, sma or hybrid,
SESSIONS is 200 if not given, and the parts are raw, calibrated, identified and tracking; the last two are of vo2.

Each session draws the sensors from the tolerances of their data sheets (`sensor_seed`), and the cantilever's beam
from that of its length. The part calibrated calibrates the sensors of each session first, and reads them then. For
each quantity the table has the number of values, the part of them whose interval of 95 %
contains the truth, and how many times as wide as needed the intervals are: they could all be divided by that number,
and 95 % of them would still contain the truth.

The truth of an identified quantity is what the same protocol and fit give without errors of sensors, noise and
disturbances: a model of another structure than the specimen has no true parameters of its own.
"""

import math
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

import bench
from bench.analysis import Reference, calibrate_run, control_uncertainties, target_results
from bench.record import Record
from bench.rig import load_rig
from rigs.hybrid.study import REFERENCE_UNCERTAINTY
from rigs.muscles.study_sma import BLOCKS, WEIGHTS
from rigs.vo2.curvature import curvature_to_deflection, deflection_to_curvature
from rigs.vo2.study import GONIOMETER
from sim_devices.transducers.data_sheets import PSD

LENGTH, LENGTH_TOLERANCE = 300e-6, 0.3e-6
"""Length of the beam as the rig file has it, and the half-width that it states, m."""
READINGS = 12
"""Raw readings of a session."""
TRUE_NAMES = {
    "vo2": {"psd_position": "tip_deflection", "curvature": "curvature", "tec_temperature": "film_temperature"},
    "sma": {"wire_end_position": "position", "load_cell_force": "force"},
    "hybrid": {
        "displacement_position": "deflection",
        "base_temperature": "base_temperature",
        "tip_temperature": "tip_temperature",
        "piezo_voltage": "piezo_voltage",
    },
}
CALIBRATED_NAMES = {
    "vo2": {"curvature": "curvature"},
    "sma": {"length": "position", "force": "force"},
    "hybrid": {"displacement": "deflection"},
}
WITNESSED = {"hybrid": "hybrid-witness"}
INTERFEROMETER = Reference("interferometer", REFERENCE_UNCERTAINTY, 365, signal="witness_position")
CALIBRATIONS = {
    "vo2": {"tip_angle": ("calibration-mirror", "psd_position", GONIOMETER, {})},
    "sma": {
        "length": ("calibration-position", "wire_end_position", BLOCKS, {}),
        "force": ("calibration-load", "load_cell_force", WEIGHTS, {}),
    },
    "hybrid": {"displacement": ("calibration-displacement", "displacement_position", INTERFEROMETER, {"sweeps": 1})},
}
"""Protocol, signal, reference and parameters by the calibrated signal."""
RANGES = {
    "vo2": {"tec": (25.0, 80.0)},
    "sma": {"supply": (0.0, 3.0)},
    "hybrid": {"tec": (-0.08, 0.06), "piezo": (-40, 40)},
}
"""Set-points by device."""
HOLD = {"vo2": 5, "sma": 30, "hybrid": 400}
"""Times of 2 s at a set-point before it is read."""
SETTINGS = {"low": 21.0, "high": 84.0, "dwell": 4.0, "increment": 1.4, "half_cycles": 24}
MODEL = {"levels": 10, "plane": (30.0, 70.0), "reference": 20.0}
IDEAL = {"emulation.sensors": "ideal", "emulation.psd_noise": "0.0", "emulation.disturbances": "false"}

Found = dict[str, list[tuple[float, float]]]
"""Errors and expanded uncertainties by quantity."""


def specimens(rig: str, session: int) -> dict[str, str]:
    """Return the overrides that draw the specimens of a session."""
    drawn = {"emulation.sensor_seed": str(session + 1)}
    if rig == "vo2":
        share = np.random.default_rng([session, 1]).uniform(-1.0, 1.0)
        drawn["emulation.plant.beam_length"] = repr(LENGTH + LENGTH_TOLERANCE * float(share))
    return drawn


def calibrated_rig(rig: str, folder: Path, session: int) -> str:
    """Calibrate the sensors of a session; return the path of the rig file that applies that."""
    path = folder / f"{rig}-{session}.toml"
    text = [f'extends = "{WITNESSED.get(rig, rig)}"']
    for name, (protocol, signal, reference, settings) in CALIBRATIONS[rig].items():
        run = bench.run(
            protocol, WITNESSED.get(rig, rig), out=folder, clock="virtual", seed=session, recording=False,
            overrides=specimens(rig, session), **settings,
        )  # fmt: skip
        file = folder / f"{rig}-{session}-{name}.json"
        calibrate_run(run.folder, signal, reference).save(file)
        text.append(f'[derived.{name}]\nkind = "calibrated"\nsource = "{signal}"\ncalibration = "{file.name}"')
    path.write_text("\n".join([*text, *(('[derived.curvature]\nsource = "tip_angle"',) if rig == "vo2" else ())]))
    return str(path)


def raw(rig: str, session: int, found: Found, file: str | None = None) -> None:
    """Read signals at random set-points, those of a rig file with calibrated ones if given, beside what is true."""
    rng = np.random.default_rng([session, 2])
    names = TRUE_NAMES[rig] if file is None else CALIBRATED_NAMES[rig]
    with bench.open_rig(file or rig, seed=session, overrides=specimens(rig, session)) as bench_rig:
        signals = bench_rig.description.uncertain()
        laboratory, clock = bench_rig.laboratory, bench_rig.clock
        for _ in range(READINGS):
            if rig == "sma":
                laboratory.operate("load", rng.uniform(1.0, 8.8))
            for device, (low, high) in RANGES[rig].items():
                bench_rig.actuators[device].set(rng.uniform(low, high))
            for _ in range(HOLD[rig]):
                # Watchdogs want to hear of somebody.
                clock.sleep(2.0)
                bench_rig.glance()
            # What still moves is true in the middle of the reading.
            before, values, after = laboratory.truth(), bench_rig.measure(), laboratory.truth()
            for name, true in names.items():
                truth = 0.5 * (before[true].value + after[true].value)
                budget = signals.reading(name, values).budget()
                title = name if file is None else f"{name}, calibrated"
                found[title].append((values[name] - truth, budget.expanded))


def characterized(folder: Path, overrides: dict[str, str], seed: int):
    """Return the model of a short characterization."""
    run = bench.run(
        "damped-oscillation", "vo2", out=folder, clock="virtual", seed=seed, recording=False, overrides=overrides,
        **SETTINGS,
    )  # fmt: skip
    return bench.identify(run, "preisach-nonmonotonic", input="tec_temperature", output="curvature", **MODEL)


def identified(folder: Path, session: int, truth: dict[str, float], found: Found) -> None:
    """Identify the quantities of a model, beside those without errors."""
    quantities = characterized(folder, specimens("vo2", session), session).uncertainty.quantities
    for name, budget in quantities.items():
        if budget.rows:
            found[name].append((budget.value - truth[name], budget.expanded))


def tracking(folder: Path, session: int, found: Found) -> None:
    """Track targets, beside the true curvatures."""
    overrides = specimens("vo2", session)
    run = bench.run(
        "tracking", "vo2", out=folder, clock="virtual", seed=session, recording=False, overrides=overrides,
        model=str(folder / "model.json"), controller="closed-loop-inverse", count=10, sequence_seed=session,
    )  # fmt: skip
    sensor = load_rig("vo2", overrides).laboratory_settings.characteristic_of("psd", PSD)
    with Record(run.folder) as record:
        reached = target_results(record, "curvature")
        stated = control_uncertainties(record, "curvature")["tracking"]
    length = float(overrides["emulation.plant.beam_length"])
    true = deflection_to_curvature(sensor.quantities(curvature_to_deflection(reached.outputs, LENGTH)), length)
    errors = reached.outputs - true
    found["tracking error"] += list(zip(errors.tolist(), stated.expanded.tolist(), strict=True))
    rms = math.sqrt(float(np.mean((true - reached.targets) ** 2)))
    low, high = stated.intervals["rms"]
    found["tracking, true RMS"].append((rms - 0.5 * (low + high), 0.5 * (high - low)))


def show(found: Found) -> None:
    """Print the table."""
    print(f"{'quantity':26}{'values':>8}{'covered / %':>13}{'too wide by':>13}{'median U':>12}")
    for name, pairs in found.items():
        errors, widths = np.abs(np.array(pairs)).T
        ratios = errors / widths
        wide = 1.0 / float(np.quantile(ratios, 0.95))
        covered = 100.0 * float(np.mean(ratios <= 1.0))
        print(f"{name:26}{errors.size:8d}{covered:13.1f}{wide:13.2f}{np.median(widths):12.2g}", flush=True)


def main(rig: str, sessions: int, parts: list[str]) -> None:
    """Carry the sessions out and print the table, after each tenth of them."""
    found: Found = defaultdict(list)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if rig == "vo2" and {"identified", "tracking"} & {*parts}:
            ideal = characterized(folder, IDEAL, 0)
            ideal.file.save(folder / "model.json")
            truth = {name: budget.value for name, budget in ideal.uncertainty.quantities.items()}
        for session in range(sessions):
            if "raw" in parts:
                raw(rig, session, found)
            if "calibrated" in parts:
                raw(rig, session, found, calibrated_rig(rig, folder, session))
            if rig == "vo2" and "identified" in parts:
                identified(folder, session, truth, found)
            if rig == "vo2" and "tracking" in parts:
                tracking(folder, session, found)
            if (session + 1) % max(sessions // 10, 1) == 0:
                print(f"\n{rig}, {session + 1} sessions")
                show(found)


if __name__ == "__main__":
    main(
        sys.argv[1],
        int(sys.argv[2]) if len(sys.argv) > 2 else 200,
        sys.argv[3:] or ["raw", "calibrated", "identified", "tracking"],
    )
