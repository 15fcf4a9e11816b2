"""What every position sensor promises, run against the driver of a T7 on the wire of the emulated one."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from cases import cases
from emulated_bench import Bench, Given, OnABench, tcp_port
from modbus_tcp import ModbusTcpServer
from two_current_psd import TwoCurrentPSD

from bench.base import DeviceError, VirtualClock
from bench.contracts import PositionSensorContract
from drivers.labjack_t7 import T7PositionSensor
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.transducers.displacement import DisplacementSensor
from sim_devices.transducers.magnet import RatiometricSensor
from sim_devices.transducers.photodetector import NormalisedPSD
from sim_devices.world import World


@dataclass(kw_only=True)
class SensorBench(Bench):
    """A sensor and the stage whose position the test sets; `spoil` makes its signal invalid."""

    spoil: Callable[[], None]
    transducer: NormalisedPSD | TwoCurrentPSD | RatiometricSensor | DisplacementSensor


@dataclass(frozen=True)
class Case:
    """A readout, where its positions are, and how well it knows them."""

    channels: tuple[int, ...]
    positions: tuple[float, ...]
    outside: float
    measured_within: float
    glanced_within: float
    settings: dict[str, object] = field(default_factory=dict)
    readout: str = ""


DETECTOR = {
    "positions": (-85e-6, -1e-6, 0.0, 12.5e-6, 85e-6),
    "outside": 95e-6,
    "measured_within": 0.15e-6,
    "glanced_within": 0.45e-6,
}
ZERO = 0.0175
CASES = {
    "voltage": Case((0,), **DETECTOR),
    "currents": Case((2, 3), **DETECTOR),
    # Steps of 40 µm under a noise of 10 µm: half a step and 4 sigma, and what is left of it in a mean of ten.
    "ratiometric": Case(
        (4, 5),
        positions=(-14.98e-3, -1e-3, 0.0, 4.013e-3, 14.98e-3),
        outside=16e-3,
        measured_within=20e-6,
        glanced_within=60e-6,
        settings={"zero_position": ZERO, "position_limits": (-15e-3, 15e-3)},
    ),
    # Noise of 10 nm and steps of 10 nm, and 3 nm of the converter; five sigma of one conversion and of a mean of ten.
    "displacement": Case(
        (1,),
        positions=(-195e-6, -1e-6, 0.0, 12.5e-6, 195e-6),
        outside=199.5e-6,
        measured_within=17e-9,
        glanced_within=54e-9,
        settings={"volts_per_metre": 5e4, "position_limits": (-199e-6, 199e-6)},
        readout="voltage",
    ),
}


def connected(kind, readout, stack, seed=1):
    stage, clock = Given(), VirtualClock()
    world = World(stage, clock)
    streams = np.random.default_rng(seed).spawn(2)
    if readout == "voltage":
        transducer = NormalisedPSD(lambda: stage.value, rng=streams[0])
        inputs = {0: transducer}

        def spoil():
            stage.value = 1.0
    elif readout == "displacement":
        transducer = DisplacementSensor(lambda: stage.value, rng=streams[0])
        inputs = {1: transducer}

        def spoil():
            stage.value = 210e-6
    elif readout == "ratiometric":
        transducer = RatiometricSensor(lambda: stage.value + ZERO, rng=streams[0])
        inputs = {4: transducer.output, 5: transducer.supply}

        def spoil():
            transducer.supply_volts = 0.3
    else:
        transducer = TwoCurrentPSD(lambda: stage.value, streams[0])
        inputs = {2: transducer.first, 3: transducer.second}

        def spoil():
            transducer.light = 0.01

    instrument = EmulatedT7(world, inputs, rng=streams[1])
    case = CASES[readout]
    said = {"readout": case.readout or readout, "channels": case.channels} | case.settings
    if kind == "socket":
        port = stack.enter_context(ModbusTcpServer(instrument)).address
    else:
        port = tcp_port(stack, instrument, clock)
    settings = T7PositionSensor.Settings(port=port, **said)
    sensor = T7PositionSensor.connect("tip", settings, clock)
    stack.callback(sensor.close)
    return SensorBench(
        clock=clock, device=sensor, instrument=instrument, plant=stage, spoil=spoil, transducer=transducer
    )


@pytest.fixture(params=CASES)
def readout(request) -> str:
    return request.param


@pytest.fixture
def case(readout) -> Case:
    return CASES[readout]


@pytest.fixture
def kind():
    return "driver"


@pytest.fixture
def bench(kind, readout, stack):
    return connected(kind, readout, stack)


class TestContract(OnABench, PositionSensorContract):
    @pytest.fixture
    def identity(self):
        return "LabJack T7, serial number 470012345, firmware 1.0300"


def test_measures_the_position(bench, case):
    for position in case.positions:
        bench.plant.value = position
        assert bench.device.measure()["tip_position"] == pytest.approx(position, abs=case.measured_within)
        assert bench.device.glance()["tip_position"] == pytest.approx(position, abs=case.glanced_within)


def test_a_spoilt_signal_is_an_error_and_not_a_number(bench):
    bench.spoil()
    for take in (bench.device.measure, bench.device.glance, bench.device.read):
        with pytest.raises(DeviceError, match=r"^tip: "):
            take()


def test_outside_of_the_calibration_is_an_error(bench, case):
    for bench.plant.value in (-case.outside, case.outside):
        with pytest.raises(DeviceError, match=r"tip: position -?\d\S* m is outside of"):
            bench.device.measure()


def test_a_measurement_takes_the_time_of_its_conversions(bench, readout):
    begin = bench.clock.now()
    bench.device.measure()
    assert bench.clock.now() - begin == pytest.approx(0.010 * len(CASES[readout].channels))
    begin = bench.clock.now()
    bench.device.glance()
    assert bench.clock.now() == begin


def test_a_measurement_is_the_mean_over_its_time(kind, stack):
    bench = connected(kind, "voltage", stack)
    bench.plant.rate = 2e-3
    # Conversions at 1, 2 ... 10 ms: their mean is at 5.5 ms.
    assert bench.device.measure()["tip_position"] == pytest.approx(11e-6, abs=0.15e-6)


def test_a_socket_changes_nothing(readout, stack):
    def record(kind):
        bench = connected(kind, readout, stack)
        bench.plant.value = CASES[readout].positions[-1]
        return [bench.device.measure()["tip_position"] for _ in range(5)]

    assert record("driver") == record("socket")


@cases("position", [-1e-3, -200e-6, 200e-6, 1e-3])
def test_a_displacement_beyond_the_reach_is_never_a_position(kind, position, stack):
    bench = connected(kind, "displacement", stack)
    bench.plant.value = position
    for take in (bench.device.measure, bench.device.glance) * 20:
        with pytest.raises(DeviceError, match=r"tip: AIN1 .*is over its range of ±10 V"):
            take()


@cases("volts", [0.0, 4.45, 5.55, 9.0])
def test_a_failed_supply_is_named(kind, volts, stack):
    bench = connected(kind, "ratiometric", stack)
    bench.transducer.supply_volts = volts
    for take in (bench.device.measure, bench.device.glance):
        with pytest.raises(DeviceError, match=r"tip: supply voltage of the sensor is \S+ V"):
            take()


@cases("position", [-1.0, -ZERO - 1e-3, 0.035 - ZERO + 1e-3, 1.0])
def test_a_magnet_beyond_the_stroke_is_never_a_position(kind, position, stack):
    bench = connected(kind, "ratiometric", stack)
    bench.plant.value = position
    for take in (bench.device.measure, bench.device.glance) * 20:
        with pytest.raises(DeviceError, match="tip: output of the sensor"):
            take()
