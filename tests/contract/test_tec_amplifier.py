"""What the role of a TEC amplifier promises, of the emulated device itself and of the driver over the wire."""

import math
from itertools import dropwhile

import numpy as np
import pytest
from cases import cases
from emulated_bench import Bench, OnABench, Spoilt, over_the_wire, serial_port

from bench.base import DeviceError, VirtualClock
from bench.contracts import SilentInstrumentContract, SpoiltAnswerContract, TECAmplifierContract
from bench.devices import TECMode
from drivers.meerstetter import MeerstetterTEC
from sim_devices.instruments.meerstetter_table import DeviceStatus
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.plants.vo2 import VO2Cantilever, VO2Parameters
from sim_devices.wire.mecom import MeComServer
from sim_devices.world import World

WATCHDOG = 5.0


class RecordingPlant:
    """Passes everything on to the plant and notes when what was commanded."""

    def __init__(self, plant, world):
        self.plant = plant
        self.world = world
        self.commands = []

    def __getattr__(self, name):
        return getattr(self.plant, name)

    def regulate(self, target_celsius, current_limit=math.inf):
        self.commands.append((self.world.time, "regulate", target_celsius))
        self.plant.regulate(target_celsius, current_limit)

    def terminals(self):
        return self.plate_temperature, self.sink_temperature, self.current, self.voltage

    def drive(self, current_ampere):
        self.commands.append((self.world.time, "drive", current_ampere))
        self.plant.drive(current_ampere)

    def release(self):
        self.commands.append((self.world.time, "release", 0.0))
        self.plant.release()


def connected(kind, stack):
    clock = VirtualClock()
    specimen = VO2Cantilever(VO2Parameters(relay_count=64), np.random.default_rng(1))
    world = World(specimen, clock)
    plant = RecordingPlant(specimen, world)
    instrument = EmulatedTEC("tec", world, plant, rng=np.random.default_rng(2))
    instrument.write_parameter(4010, 10.0)
    instrument.write_parameter(4011, 95.0)
    if kind == "emulated":
        instrument.write_parameter(2030, 3.0)
        instrument.write_parameter(2060, WATCHDOG)
        return Bench(clock=clock, device=instrument, instrument=instrument, plant=plant)
    server = MeComServer(instrument)
    port, requests = serial_port(stack, server, clock)
    settings = MeerstetterTEC.Settings(
        port=port, temperature_limits=(10.0, 95.0), current_limit=3.0, voltage_limit=15.0, watchdog=WATCHDOG
    )

    def connect(kind=MeerstetterTEC.connect):
        return kind("tec", settings, clock)

    device = connect()
    stack.callback(device.close)
    return Bench(
        clock=clock, device=device, instrument=instrument, plant=plant,
        connect=connect, requests=requests, server=server,
    )  # fmt: skip


class OnAPlate(OnABench):
    @pytest.fixture
    def set_points(self):
        return 45.0, 60.0


class TestContract(OnAPlate, TECAmplifierContract):
    @pytest.fixture
    def identity(self):
        return "Meerstetter Engineering TEC-1091, serial number 10910042, firmware 4.10"

    @pytest.fixture
    def allowed(self):
        return "is outside of 10 to 95 °C"

    @pytest.fixture
    def tolerance(self):
        return 0.15

    @pytest.fixture
    def effects(self, bench):
        return lambda: [*dropwhile(lambda command: command[1] == "release", bench.plant.commands)]


class TestSilence(OnAPlate, SilentInstrumentContract):
    pass


def test_measures_what_the_plant_is(bench):
    bench.device.set(60.0).wait()
    values = bench.device.measure()
    plant = bench.plant.plant
    assert values["tec_temperature"] == pytest.approx(plant.plate_temperature, abs=0.02)
    assert values["tec_sink_temperature"] == pytest.approx(plant.sink_temperature, abs=0.04)
    assert values["tec_current"] == pytest.approx(plant.current, abs=2e-3)
    assert values["tec_voltage"] == pytest.approx(plant.voltage, abs=5e-3)


def test_every_new_target_is_a_new_arrival(bench):
    bench.device.set(45.0).wait()
    start = bench.clock.now()
    status = bench.device.set(46.0)
    assert not status.update()
    status.wait()
    assert bench.clock.now() - start > 1.0


def test_currents_of_both_signs_flow_and_have_limits(bench):
    device = bench.device
    device.select_mode(TECMode.CURRENT)
    assert (device.limits.low, device.limits.high) == (-3.0, 3.0)
    before = device.measure()["tec_temperature"]
    for current in (0.5, -0.5):
        assert device.set(current).success
        bench.clock.sleep(3.0)
        values = device.measure()
        assert values["tec_current"] == pytest.approx(current, abs=2e-3)
        if current > 0:
            assert values["tec_temperature"] > before + 1.0
    for limit in (3.0, -3.0):
        device.set(limit)


def test_old_current_does_not_come_back_with_the_mode(bench):
    device = bench.device
    device.select_mode(TECMode.CURRENT)
    device.set(2.0)
    device.select_mode(TECMode.TEMPERATURE)
    device.select_mode(TECMode.CURRENT)
    bench.plant.commands.clear()
    device.set(0.25)
    assert {value for _, command, value in bench.plant.commands if command == "drive"} == {0.25}


def test_stop_holds_the_temperature_of_the_moment(bench):
    bench.device.set(80.0)
    bench.clock.sleep(1.0)
    bench.device.stop()
    held = bench.device.setpoint
    assert 25.0 < held < 75.0
    bench.clock.sleep(3.0)
    assert bench.device.measure()["tec_temperature"] == pytest.approx(held, abs=2.0)
    assert bench.device.output_enabled


def test_stop_keeps_the_current(bench):
    bench.device.select_mode(TECMode.CURRENT)
    bench.device.set(0.5)
    bench.device.stop(success=False)
    assert bench.device.setpoint == 0.5
    assert bench.instrument.status is DeviceStatus.RUN


@cases("number", [11, 30, 60, 100, 108, 134, 137, 138, 139, 143, 176, 182, 183])
def test_every_call_tells_of_an_error_and_safe_succeeds(kind, stack, number):
    bench = connected(kind, stack)
    status = bench.device.set(60.0)
    bench.instrument.trip(number)
    for call in (bench.device.measure, bench.device.glance, bench.device.read, lambda: bench.device.set(50.0)):
        with pytest.raises(DeviceError, match=f"tec: error {number} "):
            call()
    with pytest.raises(DeviceError, match=f"tec: error {number} "):
        status.wait()
    assert status.done
    assert not status.success
    bench.device.safe()
    bench.device.safe()
    assert not bench.device.output_enabled


def test_protection_of_the_device_ends_the_heating(bench):
    bench.instrument.write_parameter(4011, 50.0)
    status = bench.device.set(50.0) if bench.connect is None else bench.device.set(80.0)
    if bench.connect is None:
        bench.plant.regulate(80.0)  # the device itself knows no target beyond its threshold
    with pytest.raises(DeviceError, match="error 138"):
        status.wait()
    assert bench.plant.commands[-1][1] == "release"


def test_silence_of_the_host_switches_the_output_off_at_that_instant(bench, kind):
    bench.device.set(60.0)
    bench.device.glance()
    last_request = bench.clock.now()
    bench.clock.sleep(3600.0)
    assert bench.instrument.status is DeviceStatus.ERROR
    instant, command, _ = bench.plant.commands[-1]
    assert command == "release"
    answer = 52 * 10 / 57600 if kind == "driver" else 0.0  # on the wire, after the request has fed the watchdog
    assert instant == pytest.approx(last_request - answer + WATCHDOG, abs=1e-4)
    with pytest.raises(DeviceError, match="error 183"):
        bench.device.measure()
    assert not bench.device.output_enabled
    assert bench.plant.plate_temperature == pytest.approx(22.0, abs=0.5)


def test_ticks_of_two_seconds_keep_the_output_on_and_the_temperature(bench):
    bench.device.set(60.0).wait()
    for _ in range(100):
        bench.clock.sleep(2.0)
        assert bench.device.glance()["tec_temperature"] == pytest.approx(60.0, abs=0.15)
    assert bench.device.output_enabled


# What only a wire can do.


@over_the_wire
class TestSpoiltAnswer(Spoilt, OnAPlate, SpoiltAnswerContract):
    def test_the_order_is_carried_out_once(self, bench, spoil):
        bench.device.set(45.0).wait()
        bench.plant.commands.clear()
        for call in (bench.device.measure, lambda: bench.device.set(50.0), bench.device.safe):
            spoil()
            call()
        assert [command for _, command, _ in bench.plant.commands] == ["regulate", "release"]


@over_the_wire
def test_output_is_off_and_the_watchdog_idle_after_connecting_and_after_safe(bench):
    bench.clock.sleep(100.0)
    bench.device.measure()
    bench.device.set(45.0).wait()
    bench.device.safe()
    bench.clock.sleep(100.0)
    bench.device.measure()
    bench.device.close()
    bench.clock.sleep(100.0)
    bench.connect().close()


@over_the_wire
def test_nothing_is_worn_out(bench):
    writes = bench.instrument.flash_writes
    for target in range(20, 60):
        bench.device.set(float(target))
    bench.device.safe()
    bench.connect().close()
    assert bench.instrument.flash_writes == writes


@over_the_wire
def test_closing_while_the_output_is_on_leaves_it_to_the_watchdog(bench):
    bench.device.set(60.0)
    bench.device.close()
    bench.clock.sleep(WATCHDOG - 0.1)
    assert bench.instrument.status is DeviceStatus.RUN
    bench.clock.sleep(0.2)
    assert bench.instrument.status is DeviceStatus.ERROR


@over_the_wire
def test_error_of_before_is_refused_and_recovered(bench):
    bench.device.set(60.0)
    bench.instrument.trip(183)
    bench.device.close()
    with pytest.raises(DeviceError, match=r"error 183 .*watchdog.*off and on"):
        bench.connect()
    device = bench.connect(MeerstetterTEC.recover)
    assert not device.output_enabled
    device.set(45.0).wait()
    device.safe()
    device.close()
