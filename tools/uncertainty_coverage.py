"""Coverage of stated uncertainties: many emulated sessions with other specimens of the sensors, beside the truth.

Run as a script: `.venv/bin/python tools/uncertainty_coverage.py RIG [SESSIONS] [PART...]`. RIG is vo2, sma or hybrid,
SESSIONS is 200 if not given, and the parts are raw, calibrated, identified and tracking.

Each session draws what the rig file states without knowing it: gain and offset of the sensors (`sensor_seed`), the
phase of their nonlinearities, the length of the cantilever's beam, and how far the film's temperature has drifted
before the session. The part calibrated calibrates the sensors of each session first, and reads them then. For each
quantity the table has the number of values, the part of them whose interval of 95 % contains the truth, and how many
times as wide as needed the intervals are: they could all be divided by that number, and 95 % of them would still
contain the truth.

The truth of an identified quantity is what the same protocol and fit give without errors of sensors, noise and
disturbances, as a mean of several runs: a model of another structure than the specimen has no true parameters of its
own. The truth behind a tracked reading is the quantity of which the sensor makes it, but for noise and steps.
"""

import math
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bench
from bench.analysis import (
    ColumnNames,
    FitOptions,
    Reference,
    calibrate_run,
    control_uncertainties,
    identify_model,
    input_and_output,
    read_dataset,
    target_results,
    transients_of,
)
from bench.base import DataError
from bench.record import Record
from bench.rig import Budget, load_rig
from rigs.hybrid.identification import network_of, network_uncertainty
from rigs.hybrid.study import REFERENCE_UNCERTAINTY
from rigs.muscles.study_sma import BLOCKS, WEIGHTS, true_quantities
from rigs.vo2.curvature import curvature_to_deflection, deflection_to_curvature
from rigs.vo2.study import GONIOMETER
from sim_devices.plants.vo2 import VO2Parameters
from sim_devices.transducers.data_sheets import DISPLACEMENT, PSD

READINGS = 4
"""Raw readings of a session."""
PERIOD = 2.0
"""Time between two glances at a rig, s. Watchdogs want to hear of somebody."""
IDEALS = 8
"""Runs without errors whose mean is the truth of identified quantities."""
LENGTH, LENGTH_TOLERANCE = 300e-6, 0.3e-6
"""Length of the beam as the rig file has it, and the half-width that it states, m."""
INTERFEROMETER = Reference("interferometer", REFERENCE_UNCERTAINTY, 365, signal="witness_position")

Calibrating = tuple[str, str, Reference, Mapping[str, Any]]
"""Protocol, signal, reference and parameters."""
Floats = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Trial:
    """What is tried on a rig.

    Attributes
    ----------
    rig : str
        Its name.
    true : mapping of str to str
        The names of true values by signal.
    calibrations : mapping of str to tuple
        How the sensor behind a calibrated signal is calibrated, by the signal.
    true_calibrated : mapping of str to str
        The names of true values by calibrated signal.
    ranges : mapping of str to (float, float)
        Set-points by device.
    hold : int
        Glances at a set-point before it is read.
    sensors : tuple of str
        Keys in `[emulation]` of the sensors with a nonlinearity.
    settings : mapping
        Parameters of the characterization.
    model : str
        What is identified from it.
    options : mapping
        Its options.
    ideal : mapping of str to str
        Overrides that leave errors out.
    targets : int
        Number of targets in tracking.
    """

    rig: str
    true: Mapping[str, str]
    calibrations: Mapping[str, Calibrating]
    true_calibrated: Mapping[str, str]
    ranges: Mapping[str, tuple[float, float]]
    hold: int
    sensors: tuple[str, ...]
    settings: Mapping[str, Any]
    model: str
    options: Mapping[str, Any]
    ideal: Mapping[str, str]
    targets: int = 10


TRIALS = {
    "vo2": Trial(
        rig="vo2",
        true={"psd_position": "tip_deflection", "curvature": "curvature", "tec_temperature": "film_temperature"},
        calibrations={"tip_angle": ("calibration-mirror", "psd_position", GONIOMETER, {})},
        true_calibrated={"curvature": "curvature"},
        ranges={"tec": (25.0, 80.0)},
        hold=5,
        sensors=("psd",),
        settings={"low": 21.0, "high": 84.0, "dwell": 4.0, "increment": 1.4, "half_cycles": 24},
        model="preisach-nonmonotonic",
        options={"levels": 10, "plane": (30.0, 70.0), "reference": 20.0},
        ideal={"psd_noise": "0.0", "disturbances": "false"},
    ),
    "sma": Trial(
        rig="sma",
        true={"wire_end_position": "position", "load_cell_force": "force"},
        calibrations={
            "length": ("calibration-position", "wire_end_position", BLOCKS, {}),
            "force": ("calibration-load", "load_cell_force", WEIGHTS, {}),
        },
        true_calibrated={"length": "position", "force": "force"},
        ranges={"supply": (0.0, 3.0)},
        hold=15,
        sensors=("force_sensor", "position_sensor"),
        settings={"low": 0.0, "high": 3.0, "dwell": 10.0, "increment": 0.2, "half_cycles": 16},
        model="preisach",
        options={"levels": 10},
        ideal={"ambient_deviation": "0.0"},
        targets=4,
    ),
    "hybrid": Trial(
        rig="hybrid-witness",
        true={
            "displacement_position": "deflection",
            "base_temperature": "base_temperature",
            "tip_temperature": "tip_temperature",
            "piezo_voltage": "piezo_voltage",
        },
        calibrations={
            "displacement": ("calibration-displacement", "displacement_position", INTERFEROMETER, {"sweeps": 1})
        },
        true_calibrated={"displacement": "deflection"},
        ranges={"tec": (-0.08, 0.06), "piezo": (-40, 40)},
        hold=1200,
        sensors=("displacement_sensor",),
        settings={"half_cycles": 16},
        model="preisach",
        options={"levels": 10},
        ideal={"ambient_deviation": "0.0"},
    ),
}

Found = dict[str, list[tuple[float, float]]]
"""Errors and expanded uncertainties by quantity."""


def specimens(trial: Trial, session: int) -> dict[str, str]:
    """Return the overrides that draw the specimens of a session."""
    rng = np.random.default_rng([session, 1])
    drawn = {"sensor_seed": str(session + 1)}
    drawn |= {f"{sensor}.phase": repr(rng.uniform(0.0, 2.0 * math.pi)) for sensor in trial.sensors}
    if trial.rig == "vo2":
        drawn["plant.beam_length"] = repr(LENGTH + LENGTH_TOLERANCE * rng.uniform(-1.0, 1.0))
        # A session begins anywhere in the drift.
        drawn["session_offset"] = repr(VO2Parameters.drift_sd * rng.standard_normal())
    return {f"emulation.{key}": value for key, value in drawn.items()}


def carry_out(protocol: str, trial: Trial, folder: Path, seed: int, overrides: Mapping[str, str], **settings: Any):
    """Carry a protocol out; return what was recorded."""
    return bench.run(
        protocol, trial.rig, out=folder, clock="virtual", seed=seed, recording=False, overrides=overrides, **settings
    )


def calibrated_rig(trial: Trial, folder: Path, session: int) -> str:
    """Calibrate the sensors of a session; return the path of the rig file that applies that."""
    path = folder / f"{trial.rig}-{session}.toml"
    text = [f'extends = "{trial.rig}"']
    for name, (protocol, signal, reference, settings) in trial.calibrations.items():
        run = carry_out(protocol, trial, folder, session, specimens(trial, session), **settings)
        file = folder / f"{trial.rig}-{session}-{name}.json"
        calibrate_run(run.folder, signal, reference).save(file)
        text.append(f'[derived.{name}]\nkind = "calibrated"\nsource = "{signal}"\ncalibration = "{file.name}"')
    extra = '[derived.curvature]\nsource = "tip_angle"' if trial.rig == "vo2" else ""
    path.write_text("\n".join([*text, extra]))
    return str(path)


def read(trial: Trial, session: int, found: Found, file: str | None = None) -> None:
    """Read signals at random set-points, those of a rig file with calibrated ones if given, beside what is true."""
    rng = np.random.default_rng([session, 2])
    names = trial.true if file is None else trial.true_calibrated
    with bench.open_rig(file or trial.rig, seed=session, overrides=specimens(trial, session)) as rig:
        signals, laboratory = rig.description.uncertain(), rig.laboratory
        for _ in range(READINGS):
            if trial.rig == "sma":
                laboratory.operate("load", rng.uniform(1.0, 8.8))
            for device, (low, high) in trial.ranges.items():
                rig.actuators[device].set(rng.uniform(low, high))
            for _ in range(trial.hold):
                rig.clock.sleep(PERIOD)
                rig.glance()
            # What still moves is true in the middle of the reading.
            before, values, after = laboratory.truth(), rig.measure(), laboratory.truth()
            for name, true in names.items():
                truth = 0.5 * (before[true].value + after[true].value)
                budget = signals.reading(name, values).budget()
                title = name if file is None else f"{name}, calibrated"
                found[title].append((values[name] - truth, budget.expanded))


class Identified:
    """The quantities that are identified on a rig, with their truth.

    Parameters
    ----------
    trial : Trial
        What is tried.
    folder : Path
        Where runs are recorded, and the model `model.json`.
    ideals : int
        Number of runs whose mean is the truth.
    """

    def __init__(self, trial: Trial, folder: Path, ideals: int) -> None:
        self._trial, self._folder = trial, folder
        # They are for advice, and take longer than the fit.
        self._transients = None
        ideal = {f"emulation.{key}": value for key, value in {"sensors": "ideal", **trial.ideal}.items()}
        runs = [self.quantities(seed, ideal) for seed in range(ideals)]
        self.truth = {name: float(np.mean([run[name].value for run in runs])) for name in runs[0]}

    def quantities(self, seed: int, overrides: Mapping[str, str]) -> dict[str, Budget]:
        """Return the budgets of what a session identifies."""
        trial = self._trial
        run = carry_out("damped-oscillation", trial, self._folder, seed, overrides, **trial.settings)
        data = read_dataset([run.folder], ColumnNames(*input_and_output(run.folder, ("", ""))))
        self._transients = self._transients or transients_of(data)
        model = identify_model(data, trial.model, FitOptions.of(dict(trial.options)), self._transients)
        if not (file := self._folder / "model.json").exists():
            model.file.save(file)
        found = dict(model.with_uncertainty().uncertainty.quantities)
        if trial.rig == "hybrid-witness":
            steps = carry_out("current-steps", trial, self._folder, seed, overrides).folder
            found |= network_uncertainty(steps, network_of(steps))
        return found

    def compare(self, session: int, found: Found) -> None:
        """Identify them in a session, beside the truth."""
        try:
            quantities = self.quantities(session, specimens(self._trial, session))
        except DataError as error:
            print(f"session {session} is left out: {error}")
            return
        for name, budget in quantities.items():
            if budget.rows:
                found[name].append((budget.value - self.truth[name], budget.expanded))


def behind(trial: Trial, overrides: Mapping[str, str]) -> Callable[[Floats], Floats]:
    """Return what gives the true values behind readings of the controlled signal."""
    settings = load_rig(trial.rig, overrides).laboratory_settings
    if trial.rig == "sma":
        return true_quantities(trial.rig, overrides)["wire_end_position"]
    if trial.rig == "hybrid-witness":
        return settings.characteristic_of("displacement_sensor", DISPLACEMENT).quantities
    sensor = settings.characteristic_of("psd", PSD)
    length = settings.plant["beam_length"]
    return lambda read: deflection_to_curvature(sensor.quantities(curvature_to_deflection(read, LENGTH)), length)


def track(trial: Trial, folder: Path, session: int, found: Found) -> None:
    """Track targets, beside the true values."""
    overrides = specimens(trial, session)
    run = carry_out(
        "tracking", trial, folder, session, overrides, model=str(folder / "model.json"),
        controller="closed-loop-inverse", fallback="open-loop", count=trial.targets,
        sequence_seed=session,
    )  # fmt: skip
    with Record(run.folder) as record:
        output = record.meta["controls"]
        reached = target_results(record, output)
        stated = control_uncertainties(record, output)["tracking"]
    true = behind(trial, overrides)(reached.outputs)
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


def main(trial: Trial, sessions: int, parts: list[str]) -> None:
    """Carry the sessions out and print the table, after each tenth of them."""
    found: Found = defaultdict(list)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Tracking needs the model only.
        ideals = IDEALS if "identified" in parts else int("tracking" in parts)
        identified = Identified(trial, folder, ideals) if ideals else None
        for session in range(sessions):
            if "raw" in parts:
                read(trial, session, found)
            if "calibrated" in parts:
                read(trial, session, found, calibrated_rig(trial, folder, session))
            if identified is not None and "identified" in parts:
                identified.compare(session, found)
            if "tracking" in parts:
                track(trial, folder, session, found)
            if (session + 1) % max(sessions // 10, 1) == 0:
                print(f"\n{trial.rig}, {session + 1} sessions")
                show(found)


if __name__ == "__main__":
    main(
        TRIALS[sys.argv[1]],
        int(sys.argv[2]) if len(sys.argv) > 2 else 200,
        sys.argv[3:] or ["raw", "calibrated", "identified", "tracking"],
    )
