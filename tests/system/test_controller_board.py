"""A controller board that runs exported code, as a drive of the bench."""

from pathlib import Path

import numpy as np
import pytest
from deployed import STRICT, plane, run

import bench
from bench.analysis import target_results
from bench.base import ConfigurationError, VirtualClock, json_text
from bench.identification import ModelFile
from bench.models import Polynomial, Preisach
from bench.record import Record
from sim_devices.instruments.controller_board import ControllerBoard
from sim_devices.world import World

SPECIMEN = """
[rig]
title = "a specimen"
[devices.source]
driver = "twin-actuator"
port = "emulated://source"
signals = [{ name = "voltage", unit = "V" }]
setpoint = { name = "source_setpoint", unit = "V", limits = [0.0, 10.0] }
[devices.sensor]
driver = "twin-sensor"
port = "emulated://sensor"
signals = [{ name = "position", unit = "1/m" }]
[roles.drive]
device = "source"
reading = "voltage"
unit = "V"
range = [0.0, 10.0]
rest = 0.0
dwell = 4.0
increment = 1.0
[roles.response]
signal = "position"
range = [200.0, 1500.0]
[emulation]
laboratory = "twin"
step = 0.02
drift = 0.3
model = '''MODEL'''
drive = { device = "source", signal = "voltage", rest = 0.0, frequency = 4.0, damping = 0.7 }
response = { signal = "position" }
signals.voltage = { quick = 1e-3, reading = 1e-3 }
signals.position = { quick = 0.6, reading = 0.3 }
"""
EXAMPLE = Path(__file__).parents[2] / "examples/controller-board.toml"


def _plane(levels):
    model = plane(levels)
    low, high = model.output_range()
    density = 1500.0 / (high - low) * model.density
    return Preisach(model.levels, density, input_unit="V", output_unit="1/m", bias=850.0)


@pytest.fixture
def rigs(gcc, tmp_path, monkeypatch):
    """Rig files of a specimen and of a board before it, and models of the specimen and of what the board does."""
    monkeypatch.chdir(tmp_path)
    specimen, board = tmp_path / "unit.toml", tmp_path / "board.toml"
    specimen.write_text(SPECIMEN.replace("MODEL", json_text(_plane(27).to_json())))
    board.write_text(EXAMPLE.read_text())
    ModelFile("plane", _plane(14)).save(tmp_path / "plane.json")
    line = Polynomial([850.0], (0.0, 1700.0), 850.0, input_unit="1/m", output_unit="1/m")
    ModelFile("line", line).save(tmp_path / "line.json")
    name, firmware = "target.closed-loop-inverse", tmp_path / "firmware"
    bench.deploy(tmp_path / "plane.json", firmware, controller=name, rig=specimen, period=0.1)
    return specimen, board


def _errors(rig, folder, **parameters):
    run = bench.run("tracking", rig, out=folder / "runs", count=20, allowed_error=0.5, **parameters)
    found = target_results(Record(run.folder), "position")
    return found.outputs - found.targets


@pytest.mark.slow
def test_it_errs_as_the_controller_of_the_bench_does(rigs, tmp_path):
    specimen, board = rigs
    of_bench = _errors(specimen, tmp_path, model=str(tmp_path / "plane.json"))
    of_board = _errors(board, tmp_path, model=str(tmp_path / "line.json"), controller="polynomial")
    rms = [float(np.sqrt(np.mean(each**2))) for each in (of_bench, of_board)]
    # Of a range of 1300, by a model of another density.
    assert 1.0 < rms[0] < 40.0
    assert rms[1] < 1.5 * rms[0]


class Plant:
    """An input that follows its set-point at once."""

    level = 0.0

    def advance(self, dt):
        """Do nothing: it is there."""

    def set(self, value):
        """Take a set-point."""
        self.level = value


def test_its_firmware_obeys_lines_and_is_safe_when_off(rigs, gcc, tmp_path):
    run([gcc, *STRICT, "-c", "board.c"], tmp_path / "firmware")
    clock, plant = VirtualClock(), Plant()
    specimen = _plane(14).stream()
    world = World(plant, clock)
    board = ControllerBoard(
        world, tmp_path / "firmware", lambda: (plant.level, specimen.step(plant.level)), plant.set
    )

    def ask(text, seconds=0.0):
        clock.sleep(seconds)
        return board.receive(text.encode() + b"\n").decode().strip()

    assert ask("*IDN?").startswith("bench,target.closed-loop-inverse,")
    # Without a target it does not run, and a number that is none changes nothing.
    assert [ask(text) for text in ("RUN", "RUN?", "TARGET 700x", "TARGET nan", "TARGET?")] == ["", "0", "", "", "0"]
    assert [ask(text) for text in ("TARGET 700", "RUN", "RUN?", "DONE?")] == ["", "", "1", "0"]
    assert ask("DONE?", 3.0) == "1"
    assert float(ask("OUTPUT?")) == pytest.approx(700.0, abs=4.0)
    assert float(ask("INPUT?")) == pytest.approx(plant.level)
    assert ask("REACH?") == "0"
    ask("TARGET 1e4")
    assert ask("REACH?", 1.0) == "1"
    assert plant.level > 5.0
    ask("STOP")
    assert ask("SETPOINT?", 0.2) == "0"
    assert plant.level == 0.0
    ask("RUN")
    assert ask("RUN?", 1.0) == "1"
    board.power_cycle()
    assert ask("RUN?", 0.2) == "0"
    assert plant.level == 0.0


def test_a_folder_without_firmware_is_refused(gcc, tmp_path):
    with pytest.raises(ConfigurationError, match=r"board\.c"):
        ControllerBoard(World(Plant(), VirtualClock()), tmp_path, lambda: (0.0, 0.0), print)
