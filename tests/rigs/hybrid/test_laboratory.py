"""The laboratory of the hybrid: the same by wire and called directly, its wiring, its faults, and what it leaves."""

import socket

import numpy as np
import pytest
import serial
from short_runs import assert_refused

from bench.clock import VirtualClock
from bench.errors import ConfigurationError, DeviceConnectionError, DeviceError, LimitError
from bench.rig import Rig
from bench.rig_file import load_rig
from rigs.hybrid.laboratory import (
    ENABLE_LINE,
    GAIN,
    REACH,
    DirectHighVoltageSupply,
    DirectPositionSensor,
    DirectTEC,
    DirectTemperatureSensor,
    DirectWitness,
    HybridLaboratory,
    HybridLaboratorySettings,
)

WIRED, DIRECT = "hybrid", "hybrid-direct"
RIGS = (WIRED, DIRECT)
TDAC0, WATCHDOG = 30000, 5.0
"""Register of the amplifier's set-point, and the time after which the T7's watchdog lets the enable line fall, s."""
RESONANCE = 693.7


def laboratory(seed=1, **settings):
    return HybridLaboratory(HybridLaboratorySettings(**settings), VirtualClock(), seed)


def rig(name=WIRED, seed=1, **emulation):
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


class TestWiredAndDirect:
    def drive(self, name, seed=3):
        with rig(name, seed) as bench:
            bench.clock.sleep_until(1.0)
            bench.devices["tec"].set(0.08)
            bench.devices["piezo"].set(20.0)
            look(bench, 40.0)
            bench.devices["piezo"].set(-15.0)
            look(bench, 90.0)
            bench.laboratory.world.advance()
            return bench.glance(), bench.laboratory.plant.deflection

    def test_physics_are_the_same(self):
        (wired, bent), (direct, bent_directly) = self.drive(WIRED), self.drive(DIRECT)
        # By wire the set-points come some milliseconds later.
        assert bent == pytest.approx(bent_directly, abs=20e-9)
        assert bent < -80e-6
        for name, noise in (
            ("displacement_position", 10e-9),
            ("base_temperature", 0.02),
            ("tip_temperature", 0.02),
            ("tec_temperature", 0.02),
            ("tec_current", 1e-3),
            ("piezo_voltage", 0.05),
        ):
            assert wired[name] == pytest.approx(direct[name], abs=8 * noise), name
        assert wired["displacement_position"] == pytest.approx(bent, abs=60e-9)

    def test_signals_are_the_same_but_for_the_witness(self):
        signals = []
        for name in RIGS:
            with rig(name) as bench:
                signals.append([(signal.name, signal.unit) for signal in bench.signals])
                assert set(bench.measure()) == {signal.name for signal in bench.signals}
        assert signals[0] == [signal for signal in signals[1] if signal[0] != "witness_position"]
        assert len(signals[1]) == len(signals[0]) + 1

    def test_rig_files_say_the_same(self):
        wired, direct, real = map(load_rig, (*RIGS, "hybrid-hardware"))
        for other in (direct, real):
            assert other.interlocks == wired.interlocks
            assert other.telemetry == wired.telemetry
            assert other.dashboard == wired.dashboard
        assert [entry.name for entry in real.devices] == [entry.name for entry in wired.devices]
        for ours, theirs in zip(wired.devices, real.devices, strict=True):
            assert ours.driver is theirs.driver
            assert ours.settings.model_dump(exclude={"port"}) == theirs.settings.model_dump(exclude={"port"})
        assert wired.emulated
        assert direct.emulated
        assert not real.emulated

    def test_limits_are_the_same(self):
        limits = []
        for name in RIGS:
            with rig(name) as bench:
                limits.append([(name, str(each.limits)) for name, each in bench.actuators.items()])
        assert limits[0] == limits[1] == [("tec", "-0.15 to 0.15 A"), ("piezo", "-40 to 40 V")]


class TestNoise:
    def readings(self, name, seed, *, tec=0, displacement=0):
        with rig(name, seed=seed) as bench:
            for device, times in (("tec", tec), ("displacement", displacement)):
                for _ in range(times):
                    bench.devices[device].glance()
            bench.clock.sleep_until(3.0)
            seen = [bench.devices[device].glance() for device in ("displacement", "base", "tip", "piezo")]
            bench.clock.sleep_until(4.0)
            plant = bench.laboratory.plant
            truth = plant.deflection, plant.base_temperature, plant.tip_temperature, plant.ambient_temperature
            return seen, bench.devices["tec"].glance(), truth

    @pytest.mark.parametrize("name", RIGS)
    def test_the_same_seed_gives_the_same_readings(self, name):
        assert self.readings(name, 3) == self.readings(name, 3)
        for ours, theirs in zip(self.readings(name, 3), self.readings(name, 4), strict=True):
            assert ours != theirs

    @pytest.mark.parametrize("name", RIGS)
    def test_how_often_one_instrument_is_asked_does_not_change_what_another_says(self, name):
        seldom = self.readings(name, 3)
        assert self.readings(name, 3, tec=5)[0] == seldom[0]
        asked_of_the_t7 = self.readings(name, 3, displacement=5)
        assert asked_of_the_t7[1] == seldom[1]
        assert asked_of_the_t7[0] != seldom[0]

    def test_nor_does_it_change_the_room(self):
        rooms = []
        for asked in (0, 50):
            bench = laboratory(seed=2)
            for _ in range(asked):
                bench.displacement(), bench.base.divider(), bench.amplifier.voltage_monitor()
            wait(bench, 500.0)
            rooms.append(bench.plant.ambient_temperature)
        assert rooms[0] == rooms[1] != 22.0


class TestAmplifier:
    def test_it_takes_the_t7_s_voltage_while_the_enable_line_is_up(self):
        bench = laboratory()
        bench.t7.write_value(TDAC0, 5.0)
        wait(bench, 1.0)
        assert bench.plant.piezo_voltage == 0.0
        # Lines of the T7 are pulled up when nothing drives them; that of the amplifier is pulled down outside.
        assert not bench.amplifier.on
        bench.t7.write_value(2000 + ENABLE_LINE, 1)
        wait(bench, 2.0)
        assert bench.amplifier.on
        assert bench.plant.piezo_voltage == pytest.approx(5.0 * GAIN, rel=5e-3)
        assert bench.plant.deflection > 4e-6
        bench.t7.write_value(2000 + ENABLE_LINE, 0)
        wait(bench, 3.0)
        assert bench.plant.piezo_voltage == 0.0

    @pytest.mark.parametrize("name", RIGS)
    def test_the_supply_drives_the_plant(self, name):
        with rig(name) as bench:
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

    @pytest.mark.parametrize("name", RIGS)
    def test_a_silent_host_lets_the_line_fall(self, name):
        with rig(name) as bench:
            bench.devices["piezo"].set(30.0)
            start = bench.clock.now()
            wait(bench.laboratory, start + 0.9 * WATCHDOG)
            assert bench.laboratory.plant.piezo_voltage == pytest.approx(30.0, rel=5e-3)
            wait(bench.laboratory, start + 1.1 * WATCHDOG)
            assert bench.laboratory.plant.piezo_voltage == 0.0
            assert not bench.laboratory.t7.dio_level(ENABLE_LINE, pulled_down=True)
            with pytest.raises(DeviceError, match="piezo: the amplifier went off by itself"):
                bench.devices["piezo"].glance()


class TestCooler:
    @pytest.mark.parametrize("name", RIGS)
    @pytest.mark.parametrize("current", [0.1501, -0.2, 0.4])
    def test_no_more_than_its_current_limit(self, name, current):
        with rig(name) as bench:
            with pytest.raises(LimitError, match=r"tec: set-point .* A is outside of -0.15 to 0.15 A"):
                bench.devices["tec"].set(current)
            bench.clock.sleep(1.0)
            assert bench.glance()["tec_current"] == pytest.approx(0.0, abs=5e-3)
            assert bench.laboratory.plant.current == 0.0
            bench.devices["tec"].set(0.15)
            bench.clock.sleep(1.0)
            bench.glance()
            assert bench.laboratory.plant.current == pytest.approx(0.15)

    def test_the_limit_is_a_setting(self):
        with rig(DIRECT, current_limit=0.05) as bench:
            with pytest.raises(LimitError, match=r"outside of -0.05 to 0.05 A"):
                bench.devices["tec"].set(0.06)
            bench.devices["tec"].set(-0.05)

    @pytest.mark.parametrize("name", RIGS)
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_a_positive_current_heats_and_bends_down(self, name, sign):
        with rig(name) as bench:
            bench.devices["tec"].set(sign * 0.1)
            look(bench, 60.0)
            values = bench.glance()
            assert sign * (values["base_temperature"] - 22.0) > 5.0
            assert sign * (values["tip_temperature"] - 22.0) > 4.0
            assert sign * values["displacement_position"] < -40e-6
            assert values["tec_temperature"] == pytest.approx(values["base_temperature"], abs=0.2)


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

    def test_wanders_as_much_as_it_is_told(self):
        temperatures = {}
        for deviation in (0.0, 0.1, 1.0):
            bench, seen = laboratory(ambient_deviation=deviation), []
            for instant in np.arange(0.0, 40000.0, 200.0):
                wait(bench, instant)
                seen.append(bench.plant.ambient_temperature)
            temperatures[deviation] = np.array(seen)
        assert set(temperatures[0.0]) == {22.0}
        assert np.std(temperatures[1.0]) == pytest.approx(1.0, rel=0.3)
        np.testing.assert_allclose(10 * (temperatures[0.1] - 22.0), temperatures[1.0] - 22.0, atol=1e-6)


class TestResonance:
    @pytest.mark.parametrize("offset", [-0.03, 0.0, 0.03, 0.1])
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

    @pytest.mark.parametrize(("fault", "device", "words"), FAULTS)
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

    @pytest.mark.parametrize(("fault", "device"), [entry[:2] for entry in FAULTS])
    def test_each_is_seen_without_a_wire_too(self, fault, device):
        with rig(DIRECT, fault=fault, fault_time=8.0) as bench:
            bench.devices["tec"].set(0.05)
            bench.devices["piezo"].set(10.0)
            look(bench, 7.9)
            bench.glance()
            bench.clock.sleep_until(8.1)
            with pytest.raises(DeviceError, match=f"^{device}: "):
                bench.devices[device].glance()

    def test_an_amplifier_that_tripped_stays_off_until_it_is_disabled(self):
        bench = laboratory(fault="amplifier-trips", fault_time=1.0)
        bench.t7.write_value(TDAC0, 5.0)
        bench.t7.write_value(2000 + ENABLE_LINE, 1)
        wait(bench, 0.9)
        assert bench.plant.piezo_voltage > 19.0
        wait(bench, 2.0)
        assert (bench.plant.piezo_voltage, bench.amplifier.on) == (0.0, False)
        assert bench.t7.dio_level(ENABLE_LINE, pulled_down=True)
        bench.t7.write_value(TDAC0, 6.0)
        wait(bench, 3.0)
        assert bench.plant.piezo_voltage == 0.0
        for level in (0, 1):
            bench.t7.write_value(2000 + ENABLE_LINE, level)
        wait(bench, 4.0)
        assert bench.plant.piezo_voltage == pytest.approx(6.0 * GAIN, rel=5e-3)

    @pytest.mark.parametrize(("fault", "number"), [("tec-over-current", 100), ("tec-over-temperature", 138)])
    def test_a_controller_that_tripped_drives_no_current(self, fault, number):
        with rig(DIRECT, fault=fault, fault_time=5.0) as bench:
            bench.devices["tec"].set(0.1)
            wait(bench.laboratory, 4.9)
            assert bench.laboratory.plant.current == pytest.approx(0.1)
            wait(bench.laboratory, 5.1)
            assert bench.laboratory.plant.current == 0.0
            assert bench.laboratory.tec.read_parameter(105) == number

    def test_none_is_the_default(self):
        with rig() as bench:
            bench.devices["tec"].set(0.05)
            bench.devices["piezo"].set(10.0)
            look(bench, 30.0)
            assert bench.glance()["piezo_voltage"] == pytest.approx(10.0, abs=0.3)


class TestOpening:
    def test_nothing_is_left_and_it_can_be_opened_again(self):
        bench = laboratory()
        for _ in range(2):
            ports = bench.open()
            assert set(ports) == {"tec", "t7"}
            host, port = ports["t7"].removeprefix("tcp://").split(":")
            socket.create_connection((host, int(port))).close()
            bench.close()
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((host, int(port)))
            with pytest.raises(serial.SerialException, match="there are: none"):
                serial.serial_for_url(ports["tec"])

    def test_the_same_without_wires(self):
        bench = laboratory(direct=True)
        for _ in range(2):
            assert set(bench.open()) == {"tec", "displacement", "base", "tip", "piezo", "witness"}
            bench.close()
            with pytest.raises(DeviceConnectionError, match="there are: none"):
                DirectTEC.connect("tec", DirectTEC.Settings(port="tec"), bench.world.clock)

    @pytest.mark.parametrize("name", RIGS)
    def test_a_second_one_leaves_the_first_as_it_is(self, name):
        with rig(name, seed=1) as bench:
            second = laboratory(seed=2, direct=name == DIRECT)
            with pytest.raises((ValueError, ConfigurationError), match=r"is taken|another rig"):
                second.open()
            second.close()
            assert bench.glance()["base_temperature"] == pytest.approx(22.0, abs=1.0)
            third = laboratory(seed=3, direct=name == DIRECT)
            with pytest.raises((ValueError, ConfigurationError), match=r"is taken|another rig"):
                third.open()
        with rig(name, seed=2) as bench:
            assert bench.glance()["base_temperature"] == pytest.approx(22.0, abs=1.0)

    def test_a_second_direct_one_in_a_process_is_refused(self):
        with rig(DIRECT), pytest.raises(ConfigurationError, match="another rig with directly called instruments"):
            rig(DIRECT)

    def test_one_of_each_kind_may_be_open(self):
        with rig(WIRED) as wired, rig(DIRECT) as direct:
            direct.devices["piezo"].set(20.0)
            for bench in (wired, direct):
                bench.clock.sleep_until(1.0)
            assert wired.glance()["piezo_voltage"] == pytest.approx(0.0, abs=0.3)
            assert direct.glance()["piezo_voltage"] == pytest.approx(20.0, abs=0.3)

    def test_closing_twice_or_what_was_never_opened_does_no_harm(self):
        bench = laboratory()
        bench.close()
        bench.open()
        bench.close()
        bench.close()

    def test_nothing_is_done_by_hand(self):
        with pytest.raises(ConfigurationError, match="the hybrid laboratory cannot carry out 'load'"):
            laboratory().operate("load", 1.0)


class TestDirect:
    CLASSES = (
        (DirectTEC, "tec"),
        (DirectPositionSensor, "displacement"),
        (DirectTemperatureSensor, "base"),
        (DirectTemperatureSensor, "tip"),
        (DirectHighVoltageSupply, "piezo"),
        (DirectWitness, "witness"),
    )

    @pytest.mark.parametrize(("kind", "name"), CLASSES)
    def test_needs_a_laboratory_with_direct(self, kind, name):
        with pytest.raises(DeviceConnectionError) as caught:
            kind.connect(name, kind.Settings(port=f"emulated://{name}"), VirtualClock())
        assert str(caught.value) == (
            f"{name}: no such instrument at emulated://{name}; "
            "there are: none: the table [emulation] needs direct = true"
        )

    def test_a_rig_whose_laboratory_has_wires_says_so(self):
        with pytest.raises(DeviceConnectionError, match=r"tec: no such .*\[emulation\] needs direct = true"):
            rig(DIRECT, direct="false")

    @pytest.mark.parametrize(("kind", "name"), CLASSES)
    def test_another_kind_of_instrument_is_refused(self, kind, name):
        bench = laboratory(direct=True)
        bench.open()
        try:
            for other, port in self.CLASSES:
                if other is not kind:
                    with pytest.raises(DeviceConnectionError, match=f"no such instrument at {port}; there are: "):
                        kind.connect(port, kind.Settings(port=port), bench.world.clock)
            assert isinstance(kind.connect(name, kind.Settings(port=name), bench.world.clock), kind.__mro__[1])
        finally:
            bench.close()

    def test_another_name_is_refused_as_its_signals_would_have_the_first(self):
        file = load_rig(DIRECT, {"devices.base.port": "emulated://tip"})
        with pytest.raises(DeviceConnectionError) as caught:
            Rig(file, VirtualClock(), 1)
        assert str(caught.value) == "base: is called directly and has to be named tip, as it is there"
        # What was open before is closed again.
        rig(DIRECT).__exit__(None, None, None)

    def test_the_witness_sees_the_deflection_itself(self):
        with rig(DIRECT) as bench:
            witness, sensor, plant = bench.devices["witness"], bench.devices["displacement"], bench.laboratory.plant
            bench.devices["tec"].set(-0.1)
            bench.devices["piezo"].set(20.0)
            errors = []
            for k in range(1, 101):
                bench.clock.sleep_until(0.5 * k)
                seen = witness.glance()
                assert seen == witness.measure() == {"witness_position": plant.deflection}
                errors.append(sensor.glance()["displacement_position"] - seen["witness_position"])
            assert plant.deflection > 60e-6
            # Beside it the sensor has 10 nm of noise, 10 nm steps, and what the T7 adds.
            assert 5e-9 < np.std(errors) < 30e-9
            assert abs(np.mean(errors)) < 10e-9

    def test_the_witness_has_nothing_to_switch_off(self):
        with rig(DIRECT) as bench:
            witness = bench.devices["witness"]
            before = witness.measure()
            witness.safe()
            witness.close()
            assert witness.measure() == before
            assert str(witness.identity).startswith("emulated witness")

    def test_the_sensor_ends_where_the_rig_file_says(self):
        settings = next(entry.settings for entry in load_rig(WIRED).devices if entry.name == "displacement")
        assert settings.position_limits == (-REACH, REACH)


class TestSettings:
    @pytest.mark.parametrize("name", RIGS)
    @pytest.mark.parametrize(
        ("key", "value", "words"),
        [
            ("ambient_deviation", "-0.1", "greater than or equal to 0"),
            ("ambient_deviation", "6", "less than or equal to 5"),
            ("ambient_step", "21", "less than or equal to 20"),
            ("ambient_step_time", "-1", "greater than or equal to 0"),
            ("resonance_offset", "0.2", "less than or equal to 0.1"),
            ("current_limit", "0", "greater than 0"),
            ("current_limit", "0.5", "less than or equal to 0.4"),
            ("fault", "fire", "'open-thermistor'"),
            ("fault_time", "-1", "greater than or equal to 0"),
            ("fault_time", "nan", "finite number"),
            ("direct", "2", "valid boolean"),
            ("temperature", "20", "there is no such key"),
        ],
    )
    def test_what_is_wrong_is_one_message(self, name, key, value, words):
        assert_refused(name, key, value, words)
