"""The laboratories of the muscles: the operator, the faults, the ports, and noise that nobody else disturbs."""

from contextlib import closing

import numpy as np
import pytest
import serial
from cases import cases
from short_runs import assert_refused

from bench.base import ConfigurationError, DeviceError, VirtualClock
from bench.rig import Rig, load_rig
from rigs.muscles.laboratory import (
    LOAD,
    STAGE,
    Frame,
    SMALaboratory,
    SMALaboratorySettings,
)
from sim_devices.instruments.dynamixel_table import EXTENDED, VELOCITY_UNIT
from sim_devices.plants.sma import SMAParameters, SMAWire

OPERATING_MODE, TORQUE_ENABLE, PROFILE_VELOCITY, GOAL_POSITION = 11, 64, 112, 116
"""Items of the servo's control table."""

RIGS = ("sma", "mckibben", "coiled-polymer")
PORTS = ("supply", "load_cell", "stage")


def laboratory(seed=1, **settings):
    return SMALaboratory(SMALaboratorySettings(**settings), VirtualClock(), seed)


def wait(laboratory, seconds, pieces=1):
    start = laboratory.world.clock.now()
    for i in range(pieces):
        laboratory.world.clock.sleep_until(start + seconds * (i + 1) / pieces)
        laboratory.world.advance()


def rig(name="sma", seed=1, **emulation):
    overrides = {f"emulation.{key}": str(value) for key, value in emulation.items()}
    return Rig(load_rig(name, overrides), VirtualClock(), seed)


def go_slowly(laboratory):
    """Have the stage move at 1 mm/s: as a new servo it would go as fast as it can."""
    millimetre_per_second = 1e-3 / 4.5e-3 / VELOCITY_UNIT
    laboratory.servo.write_item(PROFILE_VELOCITY, round(millimetre_per_second))


def look(rig, seconds):
    """Wait as the engine does: with a glance a second, which feeds the watchdogs."""
    for _ in range(round(seconds)):
        rig.glance()
        rig.clock.sleep(1.0)


class TestFrame:
    def test_a_load_pulls_and_stretches(self):
        frame = Frame(SMAWire(SMAParameters(ambient_sd=0.0), np.random.default_rng(1)))
        positions = []
        for load in (0.3, 2.94, 8.82):
            frame.hang(load)
            frame.advance(20.0)
            assert frame.muscle.force == pytest.approx(load, abs=1e-6)
            positions.append(frame.muscle.position)
        assert positions[0] < positions[1] - 0.5e-3 < positions[2] - 1e-3

    def test_the_stage_pulls_the_muscle_along(self):
        bench = laboratory()
        bench.operate(LOAD, 0.3)
        wait(bench, 5.0)
        bench.operate(STAGE, 0.0)
        wait(bench, 1.0)
        go_slowly(bench)
        bench.frame.drum.set(2e-3)
        forces, behind = [], []
        for _ in range(25):
            wait(bench, 0.1)
            forces.append(bench.muscle.force)
            behind.append(abs(bench.muscle.position - bench.frame.drum.position))
        # The wire takes steps of 0.1 s, in which the stage moves by 0.1 mm.
        assert max(behind) < 0.11e-3
        assert behind[-1] < 1e-9
        assert bench.muscle.position == pytest.approx(2e-3, abs=8e-6)
        assert np.all(np.diff(forces) > -1e-3)
        assert np.max(np.diff(forces)) < 0.5
        assert forces[-1] > 2.0

    def test_a_muscle_on_the_stage_goes_slack_and_comes_back(self):
        bench = laboratory()
        bench.operate(STAGE, 0.0)
        bench.frame.drum.set(-6e-3)
        wait(bench, 5.0)
        assert bench.muscle.force == 0.0
        bench.operate(LOAD, 2.0)
        wait(bench, 5.0)
        assert bench.muscle.force == pytest.approx(2.0, rel=1e-4)
        assert bench.muscle.position > -1e-3
        # The stage stands still where it was.
        assert bench.frame.drum.position == pytest.approx(-6e-3, abs=8e-6)

    @cases("turns", [-256, 256])
    def test_the_stage_has_end_stops(self, turns):
        bench = laboratory()
        bench.operate(STAGE, 0.0)
        for item, value in ((OPERATING_MODE, EXTENDED), (TORQUE_ENABLE, 1), (GOAL_POSITION, turns * 4095)):
            bench.servo.write_item(item, value)
        wait(bench, 300.0)
        assert abs(bench.frame.drum.position) > 6.0
        assert bench.muscle.parameters.reach == pytest.approx(abs(bench.muscle.position), rel=1e-3)

    @cases(("command", "volts"), [(-1000, 0.0), (1000, 5.0), (300, 3.0)])
    def test_the_muscle_gets_no_voltage_that_it_does_not_take(self, command, volts):
        bench = laboratory(battery_voltage=10.0)
        bench.supply.write_object(0x2000, command, 1)
        assert bench.muscle.voltage == volts
        assert bench.supply.voltage == command / 100

    def test_how_time_is_split_hardly_matters_while_the_stage_moves(self):
        moving, standing = [], []
        for pieces in (1, 7, 400):
            bench = laboratory()
            bench.operate(STAGE, 0.0)
            wait(bench, 1.0)
            go_slowly(bench)
            bench.frame.drum.set(2e-3)
            wait(bench, 1.05, pieces)
            moving.append(bench.muscle.position)
            wait(bench, 3.0, pieces)
            standing.append((bench.muscle.force, bench.muscle.position))
        # On the way a step of the wire, 0.1 s, is what the split may make a difference of.
        assert moving[0] == pytest.approx(1e-3, abs=0.11e-3)
        assert moving == pytest.approx([moving[0]] * 3, abs=0.11e-3)
        assert standing[0][0] > 3.0
        for force, position in standing[1:]:
            assert force == pytest.approx(standing[0][0], abs=0.01)
            assert position == pytest.approx(standing[0][1], abs=1e-9)


class TestOperator:
    @cases("name", RIGS)
    def test_hangs_a_load_and_fastens_the_end(self, name):
        with rig(name) as bench:
            bench.laboratory.operate(LOAD, 2.0)
            bench.clock.sleep(5.0)
            hung = bench.measure()
            assert hung["load_cell_force"] == pytest.approx(2.0, abs=0.1)
            bench.laboratory.operate(STAGE, 0.0)
            bench.devices["stage"].set(-4e-3)
            look(bench, 5.0)
            fastened = bench.measure()
            assert fastened["load_cell_force"] == pytest.approx(0.0, abs=0.1)
            assert fastened["stage_position"] == pytest.approx(-4e-3, abs=1e-5)
            assert hung["wire_end_position"] > fastened["wire_end_position"]

    def test_what_it_cannot_do_is_refused(self):
        with pytest.raises(ConfigurationError, match="cannot carry out 'paint'; it can: load, stage"):
            laboratory().operate("paint", 1.0)

    @cases("load", [-1.0, 100.0, float("nan")])
    def test_a_load_that_the_muscle_does_not_bear_is_refused(self, load):
        bench = laboratory()
        bench.operate(LOAD, 1.0)
        with pytest.raises(
            ConfigurationError, match=f"a load of {load:g} N cannot be hung on the muscle: .* 18.85 N"
        ):
            bench.operate(LOAD, load)
        wait(bench, 5.0)
        assert bench.muscle.force == pytest.approx(1.0, rel=1e-4)


class TestFaults:
    @cases(
        ("fault", "device", "words"),
        [
            ("missing-heartbeat", "supply", "no heartbeat"),
            ("silent-supply", "supply", "no answer"),
            ("servo-overload", "stage", "overload"),
            ("broken-load-cell", "load_cell", "under its range"),
            ("unplugged-sensor", "wire_end", "supply voltage of the sensor"),
        ],
    )
    def test_one_device_tells_of_it_after_its_time(self, fault, device, words):
        with closing(rig(fault=fault, fault_time=20.0)) as bench:
            look(bench, 15.0)
            bench.clock.sleep_until(25.0)
            for name, other in bench.devices.items():
                if name != device:
                    other.glance()
            with pytest.raises(DeviceError, match=words) as caught:
                bench.devices[device].glance()
            assert caught.value.device == device

    @cases(("fault", "expected"), [("forgotten-load", 0.3), ("heavy-load", 4.0), ("none", 2.0)])
    def test_the_operator_errs_from_its_time_on(self, fault, expected):
        bench = laboratory(fault=fault, fault_time=10.0)
        bench.operate(LOAD, 0.3)
        wait(bench, 5.0)
        assert bench.muscle.force == pytest.approx(0.3, rel=1e-4)
        wait(bench, 5.0)
        bench.operate(LOAD, 2.0)
        wait(bench, 5.0)
        assert bench.muscle.force == pytest.approx(expected, rel=1e-4)
        bench.operate(STAGE, 0.0)
        wait(bench, 1.0)
        assert bench.muscle.position == pytest.approx(bench.frame.drum.position, abs=1e-9)


class TestPorts:
    def test_none_is_left_and_they_can_be_opened_again(self):
        bench = laboratory()
        for _ in range(2):
            ports = bench.open()
            assert ports == {name: f"emulated://{name}" for name in (*PORTS, "t7")}
            for port in ports.values():
                serial.serial_for_url(port).close()
            bench.close()
            for port in ports.values():
                with pytest.raises(serial.SerialException, match="there are: none"):
                    serial.serial_for_url(port)

    def test_a_second_one_has_ports_of_its_own(self):
        with rig(seed=1) as bench:
            second = laboratory(seed=2)
            ports = second.open()
            assert ports == {name: f"emulated://{name}-2" for name in (*PORTS, "t7")}
            assert bench.glance()["load_cell_force"] == pytest.approx(0.0, abs=0.5)
            second.close()
            assert bench.glance()["load_cell_force"] == pytest.approx(0.0, abs=0.5)
        with rig(seed=2) as bench:
            assert bench.glance()["load_cell_force"] == pytest.approx(0.0, abs=0.5)


class TestNoise:
    def readings(self, seed, asked_of_the_cell=0):
        with rig(seed=seed) as bench:
            bench.laboratory.operate(LOAD, 2.0)
            for _ in range(asked_of_the_cell):
                bench.devices["load_cell"].measure()
            bench.clock.sleep_until(10.0)
            position = bench.devices["wire_end"].measure()["wire_end_position"]
            bench.clock.sleep_until(12.0)
            return position, bench.devices["supply"].measure(), bench.devices["load_cell"].measure()

    def test_how_often_one_instrument_is_asked_does_not_change_what_another_says(self):
        seldom, often = self.readings(3), self.readings(3, asked_of_the_cell=5)
        assert seldom[:2] == often[:2]
        assert seldom[2] != often[2]


class TestSettings:
    @cases("name", RIGS)
    @cases(
        ("key", "value", "words"),
        [
            ("battery_voltage", "0", "> 0"),
            ("rest_position", "0.05", "≤ 0.035"),
            ("fault", "fire", "'missing-heartbeat'"),
            ("temperature", "20", "there is no such key"),
        ],
    )
    def test_what_is_wrong_is_one_message(self, name, key, value, words):
        assert_refused(name, key, value, words)

    @cases(
        ("name", "key"),
        [("sma", "ambient_deviation"), ("coiled-polymer", "ambient_deviation"), ("mckibben", "pressure_deviation")],
    )
    def test_each_has_its_own(self, name, key):
        with pytest.raises(ConfigurationError, match=f"{name}.toml: emulation.{key} = -1: "):
            load_rig(name, {f"emulation.{key}": "-1"})
        assert getattr(load_rig(name, {f"emulation.{key}": "0"}).laboratory_settings, key) == 0.0

    def test_the_hardware_rig_is_the_emulated_one_but_for_its_ports(self):
        emulated, real = load_rig("sma"), load_rig("sma-hardware")
        assert [entry.name for entry in emulated.devices] == [entry.name for entry in real.devices]
        for ours, theirs in zip(emulated.devices, real.devices, strict=True):
            assert ours.driver is theirs.driver
            ports = {"port", "pause", "baudrate"}
            assert ours.settings.model_dump(exclude=ports) == theirs.settings.model_dump(exclude=ports)
        assert emulated.interlocks == real.interlocks
        assert emulated.dashboard == real.dashboard
        assert emulated.emulated
        assert not real.emulated
