"""What every temperature sensor promises, run against the emulated device and the driver on its wire."""

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest

from bench.clock import VirtualClock
from bench.devices import TemperatureSensor, role_of
from bench.errors import DeviceError
from drivers.labjack_t7 import T7Thermistor
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.instruments.t7_roles import EmulatedTemperatureSensor
from sim_devices.transducers.thermistor import Thermistor
from sim_devices.wire.modbus_tcp import ModbusTcpServer
from sim_devices.world import World

CHANNELS = (4, 5)
TEMPERATURES = (-30.0, 0.0, 22.0, 42.5, 110.0)
NOISE = 0.02


class Plate:
    """A plant whose temperature the test sets."""

    def __init__(self) -> None:
        self.temperature = 22.0
        self.rate = 0.0

    def advance(self, dt: float) -> None:
        self.temperature += self.rate * dt


@dataclass
class Laboratory:
    sensor: TemperatureSensor
    plate: Plate
    clock: VirtualClock
    thermistor: Thermistor


def laboratory(kind: str, stack: ExitStack, seed: int = 1) -> Laboratory:
    plate, clock = Plate(), VirtualClock()
    streams = np.random.default_rng(seed).spawn(2)
    thermistor = Thermistor(lambda: plate.temperature, noise=NOISE, rng=streams[0])
    inputs = {CHANNELS[0]: thermistor.divider, CHANNELS[1]: thermistor.excitation}
    instrument = EmulatedT7(World(plate, clock), inputs, rng=streams[1])
    if kind == "emulated":
        sensor: TemperatureSensor = EmulatedTemperatureSensor("base", instrument, channels=CHANNELS)
    else:
        server = stack.enter_context(ModbusTcpServer(instrument))
        settings = T7Thermistor.Settings(port=server.address, channels=CHANNELS)
        sensor = T7Thermistor.connect("base", settings, clock)
    stack.callback(sensor.close)
    return Laboratory(sensor, plate, clock, thermistor)


@pytest.fixture(params=["emulated", "wire"])
def kind(request) -> str:
    return request.param


@pytest.fixture
def lab(kind) -> Iterator[Laboratory]:
    with ExitStack() as stack:
        yield laboratory(kind, stack)


def takes(lab: Laboratory):
    return lab.sensor.measure, lab.sensor.glance, lab.sensor.read


def test_plays_the_role(lab):
    assert role_of(type(lab.sensor)) == "temperature sensor"
    assert lab.sensor.name == "base"
    assert lab.sensor.parent is None


def test_says_who_it_is(lab):
    assert str(lab.sensor.identity) == "LabJack T7, serial number 470012345, firmware 1.0300"


def test_signals_readings_and_units_agree(lab):
    assert [(signal.name, signal.unit) for signal in lab.sensor.signals] == [("base_temperature", "°C")]
    assert list(lab.sensor.measure()) == list(lab.sensor.glance()) == ["base_temperature"]
    readings, keys = lab.sensor.read(), lab.sensor.describe()
    assert list(readings) == list(keys) == ["base_temperature"]
    assert keys["base_temperature"]["units"] == "°C"
    assert keys["base_temperature"]["source"] == "T7:470012345:base_temperature"
    assert readings["base_temperature"]["timestamp"] == lab.clock.timestamp()


@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_measures_the_temperature(lab, temperature):
    lab.plate.temperature = temperature
    # The noise of the thermistor, and up to 60 mK of the converter where the divider is steep.
    assert lab.sensor.measure()["base_temperature"] == pytest.approx(temperature, abs=0.1)
    assert lab.sensor.glance()["base_temperature"] == pytest.approx(temperature, abs=0.3)


def test_excitation_does_not_matter_within_its_range(lab):
    lab.plate.temperature = 30.0
    for volts in (2.02, 2.5, 2.98):
        lab.thermistor.excitation_volts = volts
        means = [lab.sensor.measure()["base_temperature"] for _ in range(20)]
        assert np.mean(means) == pytest.approx(30.0, abs=0.01)


@pytest.mark.parametrize("fault", ["open", "shorted"])
def test_a_broken_thermistor_is_named_and_recovers_by_itself(lab, fault):
    setattr(lab.thermistor, fault, True)
    for take in takes(lab) * 10:
        with pytest.raises(DeviceError, match=rf"^base: thermistor {fault}"):
            take()
    setattr(lab.thermistor, fault, False)
    assert lab.sensor.measure()["base_temperature"] == pytest.approx(22.0, abs=0.1)


@pytest.mark.parametrize("volts", [0.0, 1.9, 3.1, 20.0])
def test_a_failed_excitation_is_an_error_and_not_a_number(lab, volts):
    lab.thermistor.excitation_volts = volts
    for take in takes(lab):
        with pytest.raises(
            DeviceError, match=r"^base: (excitation of the thermistor is \S+ V|AIN4 .* over its range)"
        ):
            take()


@pytest.mark.parametrize("temperature", [-45.0, 130.0])
def test_outside_of_the_limits_is_an_error(lab, temperature):
    lab.plate.temperature = temperature
    for take in takes(lab):
        with pytest.raises(DeviceError, match=r"^base: temperature -?\d\S* °C is outside of -40 to 125 °C"):
            take()


def test_safe_and_stop_change_nothing(lab):
    for _ in range(2):
        lab.sensor.safe()
        lab.sensor.stop()
    assert lab.sensor.measure()["base_temperature"] == pytest.approx(22.0, abs=0.1)


def test_a_measurement_takes_the_time_of_its_conversions(lab):
    begin = lab.clock.now()
    lab.sensor.measure()
    assert lab.clock.now() - begin == pytest.approx(0.020)
    begin = lab.clock.now()
    lab.sensor.glance()
    assert lab.clock.now() == begin


def test_noise_is_that_of_the_thermistor(lab):
    single = [lab.sensor.glance()["base_temperature"] for _ in range(1000)]
    means = [lab.sensor.measure()["base_temperature"] for _ in range(500)]
    assert np.std(single) == pytest.approx(NOISE, rel=0.1)
    assert np.std(means) == pytest.approx(NOISE / math.sqrt(10), rel=0.15)
    assert abs(np.mean(means) - 22.0) < 4 * NOISE / math.sqrt(5000) + 1e-3


def test_one_seed_gives_one_record(kind):
    def record(seed: int) -> list[float]:
        with ExitStack() as stack:
            lab = laboratory(kind, stack, seed)
            values = []
            for temperature in TEMPERATURES:
                lab.plate.temperature = temperature
                values += [lab.sensor.measure()["base_temperature"], lab.sensor.glance()["base_temperature"]]
            return values

    assert record(7) == record(7)
    assert record(7) != record(8)


def test_the_wire_changes_no_more_than_the_rounding_of_a_float():
    def record(kind: str) -> list[float]:
        with ExitStack() as stack:
            lab = laboratory(kind, stack)
            return [lab.sensor.measure()["base_temperature"] for _ in range(5)]

    np.testing.assert_allclose(record("wire"), record("emulated"), atol=1e-4)


def test_bluesky_finds_its_protocols(lab):
    protocols = pytest.importorskip("bluesky.protocols")
    assert isinstance(lab.sensor, protocols.Readable)
