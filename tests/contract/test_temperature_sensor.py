"""What every temperature sensor promises, run against the driver of a T7 on the wire of the emulated one."""

from dataclasses import dataclass

import numpy as np
import pytest
from cases import cases
from emulated_bench import Bench, Given, OnABench, tcp_port

from bench.base import DeviceError, VirtualClock
from bench.contracts import TemperatureSensorContract
from drivers.labjack_t7 import T7Thermistor
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.transducers.thermistor import Thermistor
from sim_devices.world import World

CHANNELS = (4, 5)
TEMPERATURES = (-30.0, 0.0, 22.0, 42.5, 110.0)
NOISE = 0.02


@dataclass(kw_only=True)
class SensorBench(Bench):
    """A sensor and the plate whose temperature the test sets."""

    thermistor: Thermistor

    def takes(self):
        return self.device.measure, self.device.glance, self.device.read


def connected(stack, seed=1):
    plate, clock = Given(22.0), VirtualClock()
    streams = np.random.default_rng(seed).spawn(2)
    thermistor = Thermistor(lambda: plate.value, noise=NOISE, rng=streams[0])
    inputs = {CHANNELS[0]: thermistor.divider, CHANNELS[1]: thermistor.excitation}
    instrument = EmulatedT7(World(plate, clock), inputs, rng=streams[1])
    settings = T7Thermistor.Settings(port=tcp_port(stack, instrument, clock), channels=CHANNELS)
    sensor = T7Thermistor.connect("base", settings, clock)
    stack.callback(sensor.close)
    return SensorBench(clock=clock, device=sensor, instrument=instrument, plant=plate, thermistor=thermistor)


@pytest.fixture
def bench(stack):
    return connected(stack)


class TestContract(OnABench, TemperatureSensorContract):
    @pytest.fixture
    def identity(self):
        return "LabJack T7, serial number 470012345, firmware 1.0300"


@cases("temperature", TEMPERATURES)
def test_measures_the_temperature(bench, temperature):
    bench.plant.value = temperature
    # The noise of the thermistor, and up to 60 mK of the converter where the divider is steep.
    assert bench.device.measure()["base_temperature"] == pytest.approx(temperature, abs=0.1)
    assert bench.device.glance()["base_temperature"] == pytest.approx(temperature, abs=0.3)


def test_excitation_does_not_matter_within_its_range(bench):
    bench.plant.value = 30.0
    for volts in (2.02, 2.5, 2.98):
        bench.thermistor.excitation_volts = volts
        means = [bench.device.measure()["base_temperature"] for _ in range(20)]
        assert np.mean(means) == pytest.approx(30.0, abs=0.01)


@cases("fault", ["open", "shorted"])
def test_a_broken_thermistor_is_named_and_recovers_by_itself(bench, fault):
    setattr(bench.thermistor, fault, True)
    for take in bench.takes() * 10:
        with pytest.raises(DeviceError, match=rf"^base: thermistor {fault}"):
            take()
    setattr(bench.thermistor, fault, False)
    assert bench.device.measure()["base_temperature"] == pytest.approx(22.0, abs=0.1)


@cases("volts", [0.0, 1.9, 3.1, 20.0])
def test_a_failed_excitation_is_an_error_and_not_a_number(bench, volts):
    bench.thermistor.excitation_volts = volts
    for take in bench.takes():
        with pytest.raises(
            DeviceError, match=r"^base: (excitation of the thermistor is \S+ V|AIN4 .* over its range)"
        ):
            take()


@cases("temperature", [-45.0, 130.0])
def test_outside_of_the_limits_is_an_error(bench, temperature):
    bench.plant.value = temperature
    for take in bench.takes():
        with pytest.raises(DeviceError, match=r"^base: temperature -?\d\S* °C is outside of -40 to 125 °C"):
            take()


def test_a_measurement_takes_the_time_of_its_conversions(bench):
    begin = bench.clock.now()
    bench.device.measure()
    assert bench.clock.now() - begin == pytest.approx(0.020)
    begin = bench.clock.now()
    bench.device.glance()
    assert bench.clock.now() == begin
