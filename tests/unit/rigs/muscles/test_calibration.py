"""Load cell and position sensor calibrated by dead weights and gauge blocks, through the command line."""

import json
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from bench.rig import Calibration, UncertainSignals, calibrate, load_rig
from bench.rig.calibration import Calibrated
from rigs.muscles.study_sma import BLOCKS
from sim_devices.transducers.data_sheets import GAUGE_BLOCKS, POSITION
from sim_devices.transducers.imperfect import Characteristic
from sim_devices.transducers.magnet import RatiometricSensor

REST, CONVERSIONS = 17.5e-3, 20
"""Where along its stroke the sensor sees the wire at rest, m, and conversions in a reading."""
ERRORS = {"gain_error": 0.01, "offset": 5e-4, "nonlinearity": 0.0}


@cases(
    ("protocol", "table", "signal", "place", "known"),
    [
        ("calibration-load", "force_sensor", "load_cell_force", 5.0, 0.01),
        ("calibration-position", "position_sensor", "wire_end_position", 5e-3, 10e-6),
    ],
)
def test_what_is_set_up_by_hand_is_the_reference(bench, tmp_path, protocol, table, signal, place, known):
    code, _, err = bench(
        "run", protocol, "--rig", "sma", "--clock", "virtual", "--no-rehearse", "--out", tmp_path,
        "--json", tmp_path / "run.json",
        *(part for key, value in ERRORS.items() for part in ("--override", f"emulation.{table}.{key}={value}")),
    )  # fmt: skip
    assert (code, err) == (0, "")
    run = Path(json.loads((tmp_path / "run.json").read_text())["folder"])
    options = ("--uncertainty", 1e-6, "--interval", 365, "--out", tmp_path / "found.json")
    code, _, err = bench("rig", "calibrate", run, "--sensor", signal, *options)
    assert (code, err) == (0, "")
    found = Calibration.model_validate_json((tmp_path / "found.json").read_text())
    assert found.reference == "values that were set up"
    shown = 1.01 * place + 5e-4
    assert float(found.value(shown)) == pytest.approx(place, abs=known)
    assert found.uncertainty < 2 * known


class Wire:
    """The position sensor of a seed, as the T7 reads it: a mean of conversions."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self._magnet = RatiometricSensor(lambda: self._spot, rng=self.rng)
        self._sensor = Characteristic(POSITION.specimen(seed, "position_sensor"), -REST, REST)
        self._spot = 0.0

    def read(self, true):
        self._spot = self._sensor.value(true) + REST
        shares = [self._magnet.output() / self._magnet.supply() for _ in range(CONVERSIONS)]
        return self._magnet.stroke * (float(np.mean(shares)) - 0.1) / 0.8 - REST


def test_intervals_of_a_calibrated_length_contain_the_true_one():
    file = load_rig("sma")
    stated = {"wire_end_position": file.uncertainty["wire_end_position"]}
    places = file.protocols["calibration-position"]["positions"]
    about = {
        "signal": "wire_end_position", "unit": "m", "reference_unit": "m", "serial_number": "",
        "date": date(2025, 1, 1), "interval_days": 365, "reference": BLOCKS.name,
        "reference_uncertainty": BLOCKS.uncertainty,
    }  # fmt: skip
    inside = []
    for seed in range(20):
        wire = Wire(seed)
        blocks = Characteristic(GAUGE_BLOCKS.specimen(seed, "gauge_blocks"), -REST, REST)
        readings = [wire.read(blocks.value(place)) for place in places for _ in range(10)]
        found = calibrate(readings, np.repeat(places, 10), **about)
        length = Calibrated(kind="calibrated", source="wire_end_position", calibration=found)
        signals = UncertainSignals(stated, {"length": length}, {"wire_end_position": "m", "length": "m"}, "sma.toml")
        for true in wire.rng.uniform(-6e-3, 6e-3, 10):
            reading = signals.reading("length", {"wire_end_position": wire.read(true)})
            inside.append(abs(float(reading.number.x) - true) <= reading.budget().expanded)
    assert 0.92 < np.mean(inside) < 0.98
