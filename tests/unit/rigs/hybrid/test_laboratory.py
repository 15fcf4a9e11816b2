"""The laboratory of the hybrid: with and without the witness, its wiring, its faults, and what it leaves."""

import numpy as np
import pytest
from cases import cases
from short_runs import assert_refused

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, VirtualClock
from bench.rig import Rig, load_rig
from rigs.hybrid.laboratory import (
    ENABLE_LINE,
    REACH,
    HybridLaboratory,
    HybridLaboratorySettings,
)
from rigs.hybrid.witness import Witness

PLAIN, WITNESSED = "hybrid", "hybrid-witness"
RIGS = (PLAIN, WITNESSED)
TDAC0, WATCHDOG = 30000, 5.0
"""Register of the amplifier's set-point, and the time after which the T7's watchdog lets the enable line fall, s."""
RESONANCE = 693.7


def laboratory(seed=1, **settings):
    return HybridLaboratory(HybridLaboratorySettings(**settings), VirtualClock(), seed)


def rig(name=PLAIN, seed=1, **emulation):
    overrides = {f"emulation.{key}": str(value) for key, value in emulation.items()}
    return Rig(load_rig(name, overrides), VirtualClock(), seed)


def wait(laboratory, instant):
    laboratory.world.clock.sleep_until(instant)
    laboratory.world.advance()


def look(rig, until):
    """Wait as the engine does: with a glance a second, which feeds the watchdogs."""
    while rig.clock.now() < until - 1.0:
        rig.clock.sleep(1.0)
        rig.glance()
    rig.clock.sleep_until(until)


class TestWitnessed:
    def drive(self, name, seed=3):
        with rig(name, seed, sensors="ideal") as bench:
            bench.clock.sleep_until(1.0)
            bench.devices["tec"].set(0.08)
            bench.devices["piezo"].set(20.0)
            look(bench, 40.0)
            bench.devices["piezo"].set(-15.0)
            look(bench, 90.0)
            bench.laboratory.world.advance()
            return bench.glance(), bench.laboratory.plant.deflection

    def test_the_witness_changes_nothing(self):
        (plain, bent), (witnessed, bent_as_well) = self.drive(PLAIN), self.drive(WITNESSED)
        assert bent == bent_as_well == witnessed.pop("witness_position")
        assert plain == witnessed
        assert bent < -80e-6
        assert plain["displacement_position"] == pytest.approx(bent, abs=60e-9)

    def test_signals_are_the_same_but_for_the_witness(self):
        signals = []
        for name in RIGS:
            with rig(name) as bench:
                signals.append([(signal.name, signal.unit) for signal in bench.signals])
                assert set(bench.measure()) == {signal.name for signal in bench.signals}
        assert signals[0] == [signal for signal in signals[1] if signal[0] != "witness_position"]
        assert len(signals[1]) == len(signals[0]) + 1

    def test_rig_files_say_the_same(self):
        plain, witnessed, real = map(load_rig, (*RIGS, "hybrid-hardware"))
        for other in (witnessed, real):
            assert other.interlocks == plain.interlocks
            assert other.telemetry == plain.telemetry
            assert other.dashboard == plain.dashboard
        assert witnessed.devices[:-1] == plain.devices
        assert [entry.name for entry in real.devices] == [entry.name for entry in plain.devices]
        for ours, theirs in zip(plain.devices, real.devices, strict=True):
            assert ours.driver is theirs.driver
            assert ours.settings.model_dump(exclude={"port"}) == theirs.settings.model_dump(exclude={"port"})
        assert plain.emulated
        assert witnessed.emulated
        assert not real.emulated


class TestNoise:
    def readings(self, seed, *, tec=0, displacement=0):
        with rig(seed=seed) as bench:
            for device, times in (("tec", tec), ("displacement", displacement)):
                for _ in range(times):
                    bench.devices[device].glance()
            bench.clock.sleep_until(3.0)
            seen = [bench.devices[device].glance() for device in ("displacement", "base", "tip", "piezo")]
            bench.clock.sleep_until(4.0)
            plant = bench.laboratory.plant
            truth = plant.deflection, plant.base_temperature, plant.tip_temperature, plant.ambient_temperature
            return seen, bench.devices["tec"].glance(), truth

    def test_how_often_one_instrument_is_asked_does_not_change_what_another_says(self):
        seldom = self.readings(3)
        assert self.readings(3, tec=5)[0] == seldom[0]
        asked_of_the_t7 = self.readings(3, displacement=5)
        assert asked_of_the_t7[1] == seldom[1]
        assert asked_of_the_t7[0] != seldom[0]


class TestAmplifier:
    def test_the_supply_drives_the_plant(self):
        with rig() as bench:
            lab, piezo = bench.laboratory, bench.devices["piezo"]
            for value in (25.0, -40.0, 40.0):
                piezo.set(value)
                bench.clock.sleep(0.01)
                assert piezo.glance()["piezo_voltage"] == pytest.approx(value, abs=0.3)
                assert lab.plant.piezo_voltage == pytest.approx(value, rel=5e-3)
                assert lab.t7.dio_level(ENABLE_LINE, pulled_down=True)
            piezo.safe()
            bench.clock.sleep(0.01)
            lab.world.advance()
            assert lab.plant.piezo_voltage == 0.0
            assert lab.t7.tdac_volts(0) == 0.0
            assert not lab.t7.dio_level(ENABLE_LINE, pulled_down=True)


class TestRoom:
    def test_steps_when_it_is_told(self):
        bench = laboratory(ambient_deviation=0.0, ambient_step=5.0, ambient_step_time=10.0)
        wait(bench, 9.999)
        assert bench.plant.ambient_temperature == 22.0
        assert bench.plant.deflection == pytest.approx(0.0, abs=1e-12)
        wait(bench, 10.001)
        assert bench.plant.ambient_temperature == pytest.approx(27.0)
        wait(bench, 400.0)
        assert bench.plant.ambient_temperature == pytest.approx(27.0)
        assert bench.plant.tip_temperature > 25.0
        assert bench.plant.deflection < -20e-6


class TestResonance:
    @cases("offset", [0.0, -0.03])
    def test_is_where_it_is_told(self, offset):
        bench = laboratory(ambient_deviation=0.0, resonance_offset=offset)
        bench.plant.apply(20.0)
        deflections = []
        for k in range(4000):
            wait(bench, k / 20e3)
            deflections.append(bench.plant.deflection)
        ringing = np.array(deflections[1000:])
        # By the crossings of the mean, over some seventy periods.
        above = ringing > ringing.mean()
        crossings = np.flatnonzero(above[1:] & ~above[:-1])
        frequency = (len(crossings) - 1) / ((crossings[-1] - crossings[0]) / 20e3)
        assert frequency == pytest.approx((1 + offset) * RESONANCE, rel=2e-3)


class TestFaults:
    FAULTS = (
        ("open-thermistor", "base", "base: thermistor open"),
        ("shorted-thermistor", "tip", "tip: thermistor shorted"),
        ("out-of-range", "displacement", "displacement: .*over its range"),
        ("tec-over-current", "tec", "tec: error 100 .*over-current"),
        ("tec-over-temperature", "tec", "tec: error 138 .*object temperature"),
        ("amplifier-trips", "piezo", "piezo: the amplifier went off by itself"),
    )

    @cases(("fault", "device", "words"), FAULTS)
    def test_each_comes_at_its_instant_and_only_there(self, fault, device, words):
        with rig(fault=fault, fault_time=8.0) as bench:
            bench.devices["tec"].set(0.05)
            bench.devices["piezo"].set(10.0)
            look(bench, 7.9)
            bench.glance()
            bench.clock.sleep_until(8.1)
            for name, each in bench.devices.items():
                if name != device:
                    each.glance()
            with pytest.raises(DeviceError, match=words):
                bench.devices[device].glance()


class TestOpening:
    def test_nothing_is_done_by_hand(self):
        with pytest.raises(ConfigurationError, match="the hybrid laboratory cannot carry out 'load'"):
            laboratory().operate("load", 1.0)


class TestWitness:
    def test_another_instrument_is_refused(self):
        bench = laboratory()
        ports = bench.open()
        try:
            with pytest.raises(DeviceConnectionError, match="thermometer: no witness at emulated://tec"):
                Witness.connect("thermometer", Witness.Settings(port=ports["tec"]), bench.world.clock)
        finally:
            bench.close()

    @cases("request_", ["03 0000 0002", "03 0001 0004", "10 0000 0004 08 0000 0000 0000 0000"])
    def test_has_one_value_that_can_only_be_read(self, request_):
        bench = laboratory()
        stream = bench.servers["witness"].connect()
        body = bytes.fromhex(request_)
        reply = stream.receive(bytes([0, 1, 0, 0, 0, len(body) + 1, 1]) + body)
        assert reply == bytes([0, 1, 0, 0, 0, 3, 1, body[0] | 0x80, 2])

    def test_the_witness_sees_the_deflection_itself(self):
        with rig(WITNESSED, sensors="ideal") as bench:
            witness, sensor, plant = bench.devices["witness"], bench.devices["displacement"], bench.laboratory.plant
            bench.devices["tec"].set(-0.1)
            bench.devices["piezo"].set(20.0)
            errors = []
            for k in range(1, 101):
                bench.clock.sleep_until(0.5 * k)
                bench.devices["tec"].glance()  # feeds its watchdog
                seen = witness.glance()
                assert seen == witness.measure() == {"witness_position": plant.deflection}
                errors.append(sensor.glance()["displacement_position"] - seen["witness_position"])
            assert plant.deflection > 60e-6
            # Beside it the sensor has 10 nm of noise, 10 nm steps, and what the T7 adds.
            assert 5e-9 < np.std(errors) < 30e-9
            assert abs(np.mean(errors)) < 10e-9

    def test_the_sensor_ends_where_the_rig_file_says(self):
        settings = next(entry.settings for entry in load_rig(PLAIN).devices if entry.name == "displacement")
        assert settings.position_limits == (-REACH, REACH)


class TestSettings:
    @cases("name", RIGS)
    @cases(
        ("key", "value", "words"),
        [
            ("ambient_deviation", "-0.1", "≥ 0"),
            ("resonance_offset", "0.2", "≤ 0.1"),
            ("current_limit", "0.5", "≤ 0.4"),
            ("fault", "fire", "'open-thermistor'"),
            ("fault_time", "nan", "finite number"),
            ("temperature", "20", "there is no such key"),
        ],
    )
    def test_what_is_wrong_is_one_message(self, name, key, value, words):
        assert_refused(name, key, value, words)


def test_a_quick_reading_in_few_requests_is_that_of_the_devices_one_by_one():
    """Also in the noise of each conversion: those of one request are taken in the order of the devices."""
    wanted = ("displacement_position", "base_temperature", "tip_temperature", "witness_position")
    with rig(WITNESSED) as joint, rig(WITNESSED) as single:
        read = joint.quick_reader(wanted)
        for instant in (1.0, 1.005, 1.01):
            for each in (joint, single):
                each.clock.sleep_until(instant)
            values = {}
            for name in ("displacement", "base", "tip", "witness"):
                values |= single.devices[name].glance()
            assert read() == values
