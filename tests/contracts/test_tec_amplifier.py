"""What the role of a TEC amplifier promises, of the emulated device itself and of the driver over the wire."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from bench.clock import VirtualClock
from bench.devices import TECAmplifier, TECMode, role_of
from bench.errors import DeviceConnectionError, DeviceError, LimitError
from drivers.meerstetter import MeerstetterTEC
from sim_devices.instruments.meerstetter_table import DeviceStatus
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.plants.vo2 import VO2Cantilever, VO2Parameters
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire.mecom import MeComServer
from sim_devices.world import World

WATCHDOG = 5.0


class RecordingLoad:
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

    def drive(self, current_ampere):
        self.commands.append((self.world.time, "drive", current_ampere))
        self.plant.drive(current_ampere)

    def release(self):
        self.commands.append((self.world.time, "release", 0.0))
        self.plant.release()


@dataclass
class Bench:
    """One device under test and what is behind it."""

    clock: VirtualClock
    device: TECAmplifier
    instrument: EmulatedTEC
    load: RecordingLoad
    connect: Callable[[], TECAmplifier] | None
    requests: list = field(default_factory=list)


class RecordingServer:
    def __init__(self, server, requests):
        self.server = server
        self.requests = requests

    def receive(self, data):
        self.requests.append(data)
        return self.server.receive(data)


names = (f"contract-tec-{number}" for number in itertools.count())


@pytest.fixture(params=["emulated", "driver"])
def bench(request):
    clock = VirtualClock()
    plant = VO2Cantilever(VO2Parameters(relay_count=64), np.random.default_rng(1))
    world = World(plant, clock)
    load = RecordingLoad(plant, world)
    instrument = EmulatedTEC("tec", world, load, rng=np.random.default_rng(2))
    instrument.write_parameter(4010, 10.0)
    instrument.write_parameter(4011, 95.0)
    if request.param == "emulated":
        instrument.write_parameter(2030, 3.0)
        instrument.write_parameter(2060, WATCHDOG)
        yield Bench(clock, instrument, instrument, load, None)
        return
    requests = []
    name = next(names)
    settings = MeerstetterTEC.Settings(
        port=register(name, RecordingServer(MeComServer(instrument), requests), clock),
        temperature_limits=(10.0, 95.0),
        current_limit=3.0,
        voltage_limit=15.0,
        watchdog=WATCHDOG,
    )

    def connect():
        return MeerstetterTEC.connect("tec", settings, clock)

    device = connect()
    yield Bench(clock, device, instrument, load, connect, requests)
    device.close()
    unregister(name)


def test_role_and_identity(bench):
    assert role_of(type(bench.device)) == "TEC amplifier"
    assert str(bench.device.identity) == ("Meerstetter Engineering TEC-1091, serial number 10910042, firmware 4.10")
    assert bench.device.name == "tec"
    assert bench.device.parent is None


def test_nothing_is_driven_before_the_first_set_point(bench):
    bench.clock.sleep(2.0)
    assert not bench.device.output_enabled
    assert math.isnan(bench.device.setpoint)
    assert all(command == "release" for _, command, _ in bench.load.commands)


def test_signals_readings_and_units_agree(bench):
    device = bench.device
    assert [(signal.name, signal.unit) for signal in device.signals] == [
        ("tec_temperature", "°C"),
        ("tec_sink_temperature", "°C"),
        ("tec_current", "A"),
        ("tec_voltage", "V"),
    ]
    names = [signal.name for signal in device.signals]
    assert list(device.measure()) == list(device.glance()) == names
    readings, keys = device.read(), device.describe()
    assert list(readings) == list(keys) == names
    for signal in device.signals:
        assert keys[signal.name]["units"] == signal.unit
        assert keys[signal.name]["source"] == f"TEC-1091:10910042:{signal.name}"
        assert readings[signal.name]["timestamp"] == pytest.approx(bench.clock.timestamp(), abs=0.1)


def test_measures_what_the_plant_is(bench):
    bench.device.set(60.0).wait()
    values = bench.device.measure()
    plant = bench.load.plant
    assert values["tec_temperature"] == pytest.approx(plant.plate_temperature, abs=0.02)
    assert values["tec_sink_temperature"] == pytest.approx(plant.sink_temperature, abs=0.04)
    assert values["tec_current"] == pytest.approx(plant.current, abs=2e-3)
    assert values["tec_voltage"] == pytest.approx(plant.voltage, abs=5e-3)


def test_temperature_arrives_and_holds(bench):
    status = bench.device.set(45.0)
    assert not status.update()
    assert bench.device.output_enabled
    assert bench.device.setpoint == 45.0
    status.wait()
    assert status.success
    assert bench.device.measure()["tec_temperature"] == pytest.approx(45.0, abs=0.15)
    for _ in range(10):
        bench.clock.sleep(2.0)
        assert bench.device.glance()["tec_temperature"] == pytest.approx(45.0, abs=0.15)


def test_every_new_target_is_a_new_arrival(bench):
    bench.device.set(45.0).wait()
    start = bench.clock.now()
    status = bench.device.set(46.0)
    assert not status.update()
    status.wait()
    assert bench.clock.now() - start > 1.0


def test_current_mode(bench):
    device = bench.device
    device.select_mode(TECMode.CURRENT)
    assert device.mode is TECMode.CURRENT
    assert device.setpoint_signal.unit == device.limits.unit == "A"
    assert (device.limits.low, device.limits.high) == (-3.0, 3.0)
    assert not device.output_enabled
    before = device.measure()["tec_temperature"]
    status = device.set(0.5)
    assert status.done
    assert status.success
    bench.clock.sleep(3.0)
    values = device.measure()
    assert values["tec_current"] == pytest.approx(0.5, abs=2e-3)
    assert values["tec_temperature"] > before + 1.0
    device.set(-0.5)
    bench.clock.sleep(3.0)
    assert device.measure()["tec_current"] == pytest.approx(-0.5, abs=2e-3)


def test_change_of_mode_switches_off(bench):
    device = bench.device
    device.set(45.0).wait()
    device.select_mode(TECMode.CURRENT)
    assert not device.output_enabled
    assert math.isnan(device.setpoint)
    device.set(1.0)
    assert device.output_enabled
    device.select_mode(TECMode.TEMPERATURE)
    assert not device.output_enabled
    assert device.limits.unit == device.setpoint_signal.unit == "°C"
    device.set(40.0).wait()


def test_old_current_does_not_come_back_with_the_mode(bench):
    device = bench.device
    device.select_mode(TECMode.CURRENT)
    device.set(2.0)
    device.select_mode(TECMode.TEMPERATURE)
    device.select_mode(TECMode.CURRENT)
    bench.load.commands.clear()
    device.set(0.25)
    assert {value for _, command, value in bench.load.commands if command == "drive"} == {0.25}


@pytest.mark.parametrize("value", [9.9, 95.1, math.nan, math.inf, -math.inf])
def test_beyond_the_limits_nothing_is_sent(bench, value):
    commands, requests = len(bench.load.commands), len(bench.requests)
    with pytest.raises(LimitError, match=r"tec: set-point .* is outside of 10 to 95 °C"):
        bench.device.set(value)
    with pytest.raises(LimitError):
        bench.device.check(value)
    assert (len(bench.load.commands), len(bench.requests)) == (commands, requests)
    assert math.isnan(bench.device.setpoint)
    assert not bench.device.output_enabled


def test_limits_themselves_are_allowed(bench):
    limits = bench.device.limits
    for value in (limits.low, limits.high):
        bench.device.check(value)
    bench.device.set(limits.low)
    bench.device.select_mode(TECMode.CURRENT)
    bench.device.set(3.0)
    bench.device.set(-3.0)


def test_stop_holds_the_temperature_of_the_moment(bench):
    bench.device.set(80.0)
    bench.clock.sleep(1.0)
    bench.device.stop()
    held = bench.device.setpoint
    assert 25.0 < held < 75.0
    bench.clock.sleep(3.0)
    assert bench.device.measure()["tec_temperature"] == pytest.approx(held, abs=2.0)
    assert bench.device.output_enabled


def test_stop_keeps_the_current_and_does_nothing_when_off(bench):
    bench.device.stop()
    assert not bench.device.output_enabled
    bench.device.select_mode(TECMode.CURRENT)
    bench.device.set(0.5)
    bench.device.stop(success=False)
    assert bench.device.setpoint == 0.5
    assert bench.instrument.status is DeviceStatus.RUN


def test_safe_switches_off_and_again_changes_nothing(bench):
    bench.device.set(60.0).wait()
    bench.device.safe()
    assert not bench.device.output_enabled
    assert bench.load.commands[-1][1] == "release"
    commands = len(bench.load.commands)
    bench.device.safe()
    bench.clock.sleep(1.0)
    assert len(bench.load.commands) == commands
    assert bench.device.measure()["tec_current"] == pytest.approx(0.0, abs=5e-3)
    bench.device.set(50.0).wait()


def test_safe_from_an_error_state(bench):
    bench.device.set(60.0)
    bench.instrument.trip(138)
    bench.device.safe()
    bench.device.safe()
    assert not bench.device.output_enabled


def test_safe_of_a_device_that_does_not_answer_raises(bench):
    bench.device.set(60.0)
    bench.instrument.unplug()
    with pytest.raises(DeviceError, match="tec: "):
        bench.device.safe()


@pytest.mark.parametrize("number", [11, 30, 60, 100, 108, 134, 137, 138, 139, 143, 176, 182, 183])
def test_every_call_tells_of_an_error(bench, number):
    status = bench.device.set(60.0)
    bench.instrument.trip(number)
    for call in (bench.device.measure, bench.device.glance, bench.device.read, lambda: bench.device.set(50.0)):
        with pytest.raises(DeviceError, match=f"tec: error {number} "):
            call()
    with pytest.raises(DeviceError, match=f"tec: error {number} "):
        status.wait()
    assert status.done
    assert not status.success
    assert not bench.device.output_enabled


def test_protection_of_the_device_ends_the_heating(bench):
    bench.instrument.write_parameter(4011, 50.0)
    status = bench.device.set(50.0) if bench.connect is None else bench.device.set(80.0)
    if bench.connect is None:
        bench.load.plant.regulate(80.0)  # the device itself knows no target beyond its threshold
    with pytest.raises(DeviceError, match="error 138"):
        status.wait()
    assert bench.load.commands[-1][1] == "release"


def test_silence_of_the_host_switches_the_output_off_at_that_instant(bench):
    bench.device.set(60.0)
    bench.device.glance()
    last_request = bench.clock.now()
    bench.clock.sleep(3600.0)
    assert bench.instrument.status is DeviceStatus.ERROR
    instant, command, _ = bench.load.commands[-1]
    assert command == "release"
    # The answer to the last request took at most a few milliseconds of the wire.
    assert instant == pytest.approx(last_request + WATCHDOG, abs=0.005)
    with pytest.raises(DeviceError, match="error 183"):
        bench.device.measure()
    assert not bench.device.output_enabled
    assert bench.load.plant.plate_temperature == pytest.approx(22.0, abs=0.5)


def test_ticks_of_two_seconds_keep_the_output_on(bench):
    bench.device.set(60.0)
    for _ in range(100):
        bench.clock.sleep(2.0)
        bench.device.glance()
    assert bench.device.output_enabled


def test_device_that_stops_answering(bench):
    bench.device.set(60.0)
    bench.instrument.unplug()
    for call in (bench.device.measure, bench.device.glance, lambda: bench.device.set(50.0)):
        with pytest.raises(DeviceConnectionError, match="tec: "):
            call()


def test_bluesky_finds_its_protocols(bench):
    from bluesky.protocols import Movable, Readable, Stoppable

    assert isinstance(bench.device, Readable)
    assert isinstance(bench.device, Movable)
    assert isinstance(bench.device, Stoppable)


# What only a wire can do.


over_the_wire = pytest.mark.parametrize("bench", ["driver"], indirect=True)


@over_the_wire
@pytest.mark.parametrize("fault", ["corrupt_next_answer", "drop_next_answer"])
def test_spoilt_answer_is_asked_for_again_and_the_order_is_carried_out_once(bench, fault):
    bench.device.set(45.0).wait()
    bench.load.commands.clear()
    bench.requests.clear()
    for call in (bench.device.measure, lambda: bench.device.set(50.0), bench.device.safe):
        getattr(bench.instrument, fault)()
        bench.requests.clear()
        call()
        assert bench.requests[0] == bench.requests[1]
        assert len(set(bench.requests)) == len(bench.requests) - 1
    assert [command for _, command, _ in bench.load.commands] == ["regulate", "release"]


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
    settings = bench.device._settings
    device = MeerstetterTEC.recover("tec", settings, bench.clock)
    assert not device.output_enabled
    device.set(45.0).wait()
    device.safe()
    device.close()


@over_the_wire
def test_reset_of_a_connected_device(bench):
    bench.device.set(60.0)
    bench.instrument.trip(138)
    bench.device.reset()
    assert math.isnan(bench.device.setpoint)
    assert not bench.device.output_enabled
    bench.device.set(45.0).wait()


@over_the_wire
def test_connecting_to_an_output_that_is_on_switches_it_off(bench):
    bench.device.set(60.0)
    bench.device.close()
    device = bench.connect()
    assert not device.output_enabled
    assert bench.load.commands[-1][1] == "release"
    device.close()


def test_two_runs_are_equal_to_the_last_digit():
    def run():
        clock = VirtualClock()
        plant = VO2Cantilever(VO2Parameters(relay_count=64), np.random.default_rng(1))
        world = World(plant, clock)
        instrument = EmulatedTEC("tec", world, plant, rng=np.random.default_rng(2))
        name = next(names)
        settings = MeerstetterTEC.Settings(
            port=register(name, MeComServer(instrument), clock),
            temperature_limits=(15, 90),
            current_limit=3.0,
            voltage_limit=15.0,
        )
        device = MeerstetterTEC.connect("tec", settings, clock)
        readings = []
        for target in (30.0, 60.0, 45.0):
            device.set(target).wait()
            readings.append(device.read())
        device.safe()
        device.close()
        unregister(name)
        return readings

    assert run() == run()
