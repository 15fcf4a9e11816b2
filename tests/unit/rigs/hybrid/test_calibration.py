"""The displacement sensor calibrated against the interferometer, through the command line."""

import json
from datetime import date
from pathlib import Path

import pytest
from cases import cases

from bench.base import VirtualClock
from bench.protocol import find_protocol
from bench.rig import Rig, load_rig

ERRORS = {"nonlinearity": "5e-4", "gain_error": "2e-3", "offset": "3e-7", "latency": "0.02"}
SENSOR = {f"emulation.displacement_sensor.{key}": value for key, value in ERRORS.items()}
CALIBRATED = """
extends = "hybrid-witness"
[rig]
title = "a calibrated hybrid"
[derived.displacement]
kind = "calibrated"
source = "displacement_position"
calibration = "displacement.json"
[roles.response]
signal = "displacement"
"""


def test_a_calibrated_sensor_is_accurate_to_nanometres(bench, tmp_path):
    sweep = {"sweeps": "1", "period": "150", "cooling": "-0.05", "heating": "0.05"}
    code, _, err = bench(
        "run", "calibration-displacement", "--rig", "hybrid-witness", "--clock", "virtual", "--out", tmp_path,
        "--json", tmp_path / "run.json",
        *(part for key, value in sweep.items() for part in ("--set", f"{key}={value}")),
        *(part for key, value in SENSOR.items() for part in ("--override", f"{key}={value}")),
    )  # fmt: skip
    assert (code, err) == (0, "")
    run = Path(json.loads((tmp_path / "run.json").read_text())["folder"])
    code, out, err = bench(
        "rig", "calibrate", run, "--sensor", "displacement_position", "--reference", "witness_position",
        "--name", "interferometer", "--uncertainty", "1e-9", "--interval", "365",
        "--out", tmp_path / "displacement.json", "--json", tmp_path / "found.json",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "accuracy" in out
    assert "repeatability" in out
    found = json.loads((tmp_path / "found.json").read_text())
    accuracy = found.pop("accuracy")
    assert found == json.loads((tmp_path / "displacement.json").read_text())
    assert found["reference"] == "interferometer"
    assert abs(found["lateness"] - 0.02) < 2e-3
    assert 1e-9 < accuracy < 5e-9
    assert 8e-9 < found["repeatability"] < 15e-9

    (tmp_path / "calibrated.toml").write_text(CALIBRATED)
    rig = Rig(load_rig(str(tmp_path / "calibrated.toml"), SENSOR), VirtualClock(), seed=3)
    try:
        rig.actuators["tec"].set(-0.02)
        for _ in range(40):
            rig.clock.sleep(2.0)
            readings = rig.measure()
        truth = rig.laboratory.truth()
        assert abs(truth["displacement_shown"].value - truth["deflection"].value) > 100e-9
        assert abs(readings["displacement"] - truth["deflection"].value) < 20e-9
    finally:
        rig.close()


def test_a_calibration_stands_beside_its_rig_file_and_is_kept_with_the_run(tmp_path):
    (tmp_path / "calibrated.toml").write_text(CALIBRATED)
    record = {
        "signal": "displacement_position", "unit": "m", "serial_number": "", "date": "2026-03-01",
        "interval_days": 365, "reference": "interferometer", "reference_unit": "m", "reference_uncertainty": 1e-9,
        "low": -1e-4, "high": 1e-4, "coefficients": [1e-7], "covariance": [[0]], "degrees_of_freedom": 8,
        "repeatability": 1e-8, "readings": 9,
    }  # fmt: skip
    (tmp_path / "displacement.json").write_text(json.dumps(record))
    rig = load_rig(str(tmp_path / "calibrated.toml"))
    assert rig.content["derived"]["displacement"]["calibration"]["coefficients"] == [1e-7]
    assert rig.derived["displacement"].calibration.due == date(2027, 3, 1)


@cases(("rig", "accuracy"), [("hybrid-witness", None), ("calibrated", 1e-9)])
def test_a_protocol_knows_how_accurate_its_response_is(tmp_path, rig, accuracy):
    if accuracy is not None:
        test_a_calibration_stands_beside_its_rig_file_and_is_kept_with_the_run(tmp_path)
        rig = str(tmp_path / "calibrated.toml")
    with Rig(load_rig(rig), VirtualClock(), 1) as connected:
        found = connected.description.slots(find_protocol("hybrid-control"))["response"].accuracy
        assert found == (accuracy and pytest.approx(accuracy))
