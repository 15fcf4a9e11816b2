"""`bench model deploy`: what it writes, and what it refuses in one message."""

import json
from pathlib import Path

import numpy as np
import pytest
from deployed import plane, run

from bench.api import deploy, load, predict
from bench.base import ConfigurationError
from bench.identification import ModelFile

RIGS = Path(__file__).parents[2] / "rigs"
RIG = """
[rig]
title = "a unit"
[devices.source]
driver = "twin-actuator"
port = "emulated://source"
[[devices.source.signals]]
name = "voltage"
unit = "V"
[devices.source.setpoint]
name = "source_setpoint"
unit = "V"
limits = [0.0, 10.0]
[devices.sensor]
driver = "twin-sensor"
port = "emulated://sensor"
[[devices.sensor.signals]]
name = "position"
unit = "µm"
[roles.drive]
device = "source"
reading = "voltage"
unit = "V"
range = [0.0, 10.0]
rest = 0.0
dwell = 0.5
increment = 1.0
[roles.response]
signal = "position"
[emulation]
laboratory = "fmu"
file = "FILE"
step = 0.1
[emulation.drive]
device = "source"
signal = "voltage"
rest = 0.0
[emulation.response]
signal = "position"
"""


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.json"
    ModelFile("plane", plane(12)).save(path)
    return path


def test_the_example_meets_its_target(model, gcc, tmp_path, bench):
    folder = tmp_path / "firmware"
    options = ["--name", "stage", "--real", "double", "--json", "-"]
    code, out, _ = bench("model", "deploy", model, "--c", folder, *options)
    assert code == 0
    said = json.loads(out)
    assert said["files"] == ["README.md", "main.c", "stage.c", "stage.h"]
    assert said["sha256"] in (folder / "README.md").read_text()
    run([gcc, "-std=c99", "main.c", "stage.c", "-o", "example", "-lm"], folder)
    assert ", met" in run(["./example"], folder)


def test_the_function_writes_what_the_command_does(model, tmp_path, bench):
    rig = tmp_path / "unit.toml"
    rig.write_text(RIG.replace("FILE", "model.fmu"))
    options = ["--controller", "follow.closed-loop-inverse", "--rig", rig, "--period", "0.5", "--real", "double"]
    code, _, err = bench("model", "deploy", model, "--c", tmp_path / "command", *options)
    assert code == 0, err
    found = deploy(
        model, str(tmp_path / "function"), controller="follow.closed-loop-inverse", rig=rig, period=0.5, real="double"
    )
    for name, text in found.files.items():
        assert (tmp_path / "function" / name).read_text() == text
        assert (tmp_path / "command" / name).read_text() == text
    with pytest.raises(ConfigurationError, match="belong together"):
        deploy(model, tmp_path / "other", rig="vo2")
    assert not (tmp_path / "other").exists()


def test_a_unit_is_characterized_as_a_specimen(model, gcc, tmp_path, bench):
    unit, rig = tmp_path / "model.fmu", tmp_path / "unit.toml"
    assert bench("model", "deploy", model, "--fmu", unit, "--fmi", "3.0")[0] == 0
    rig.write_text(RIG.replace("FILE", str(unit)))
    options = ["--clock", "virtual", "--set", "half_cycles=6", "--out", tmp_path / "runs"]
    code, _, err = bench("run", "damped-oscillation", "--rig", rig, *options)
    assert code == 0, err
    (found,) = (tmp_path / "runs").iterdir()
    readings = load(found).readings
    assert len(readings) > 20
    # The unit is itself such a plane, without noise.
    expected = predict(model, readings["voltage"])
    np.testing.assert_allclose(readings["position"], expected, atol=1e-6 * np.ptp(expected))


def test_what_is_wrong_is_one_message_and_nothing_is_written(model, tmp_path, bench):
    folder = tmp_path / "firmware"
    cases = [
        (["--c", folder, "--max-bytes", "5000"], "--max-bytes 5000"),
        (["--c", folder, "--period", "0.1"], "--period 0.1"),
        (["--c", folder, "--controller", "integral", "--rig", "vo2", "--period", "0.5"], "closed-loop-inverse"),
        (["--c", folder, "--controller", "follow.closed-loop-inverse"], "belong together"),
        (["--fmu", tmp_path / "model.zip"], ".fmu"),
        (["--fmu", tmp_path / "model.fmu", "--controller", "follow.open-loop-inverse", "--rig", "vo2"], "--c FOLDER"),
        (["--fmu", tmp_path / "model.fmu", "--rig", "vo2"], "--c FOLDER"),
        (["--fmu", tmp_path / "model.fmu", "--tuning", model], "--c FOLDER"),
        ([], "--c FOLDER or --fmu"),
    ]
    for options, said in cases:
        code, _, err = bench("model", "deploy", model, *options)
        assert code == 2
        assert said in err
        assert err.count("error:") == 1
    for options in (["--c", folder], ["--fmu", tmp_path / "model.fmu"]):
        code, _, err = bench("model", "deploy", RIGS / "vo2/vo2.toml", *options)
        assert code == 2
        assert "twin" in err
    assert not folder.exists()
