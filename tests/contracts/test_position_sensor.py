"""What every position sensor promises, run against the emulated device and the driver on its wire."""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
import pytest

from bench.clock import VirtualClock
from bench.devices import PositionSensor, role_of
from bench.errors import DeviceError
from drivers.labjack_t7 import T7PositionSensor
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.instruments.t7_roles import EmulatedPositionSensor
from sim_devices.transducers.displacement import DisplacementSensor
from sim_devices.transducers.magnet import RatiometricSensor
from sim_devices.transducers.photodetector import NormalisedPSD, TwoCurrentPSD
from sim_devices.wire.modbus_tcp import ModbusTcpServer
from sim_devices.world import World


class Stage:
    """A plant whose position the test sets."""

    def __init__(self) -> None:
        self.position = 0.0
        self.velocity = 0.0

    def advance(self, dt: float) -> None:
        self.position += self.velocity * dt


@dataclass
class Laboratory:
    sensor: PositionSensor
    stage: Stage
    clock: VirtualClock
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


def laboratory(kind: str, readout: str, stack: ExitStack, seed: int = 1) -> Laboratory:
    stage, clock = Stage(), VirtualClock()
    world = World(stage, clock)
    streams = np.random.default_rng(seed).spawn(2)
    if readout == "voltage":
        transducer = NormalisedPSD(lambda: stage.position, rng=streams[0])
        inputs = {0: transducer}

        def spoil() -> None:
            stage.position = 1.0
    elif readout == "displacement":
        transducer = DisplacementSensor(lambda: stage.position, rng=streams[0])
        inputs = {1: transducer}

        def spoil() -> None:
            stage.position = 210e-6
    elif readout == "ratiometric":
        transducer = RatiometricSensor(lambda: stage.position + ZERO, rng=streams[0])
        inputs = {4: transducer.output, 5: transducer.supply}

        def spoil() -> None:
            transducer.supply_volts = 0.3
    else:
        transducer = TwoCurrentPSD(lambda: stage.position, rng=streams[0])
        inputs = {2: transducer.first, 3: transducer.second}

        def spoil() -> None:
            transducer.light = 0.01

    instrument = EmulatedT7(world, inputs, rng=streams[1])
    case = CASES[readout]
    said = {"readout": case.readout or readout, "channels": case.channels} | case.settings
    if kind == "emulated":
        sensor: PositionSensor = EmulatedPositionSensor("tip", instrument, **said)
    else:
        server = stack.enter_context(ModbusTcpServer(instrument))
        settings = T7PositionSensor.Settings(port=server.address, **said)
        sensor = T7PositionSensor.connect("tip", settings, clock)
    stack.callback(sensor.close)
    return Laboratory(sensor, stage, clock, spoil, transducer)


@pytest.fixture(params=["emulated", "wire"])
def kind(request) -> str:
    return request.param


@pytest.fixture(params=CASES)
def readout(request) -> str:
    return request.param


@pytest.fixture
def case(readout) -> Case:
    return CASES[readout]


@pytest.fixture
def lab(kind, readout) -> Iterator[Laboratory]:
    with ExitStack() as stack:
        yield laboratory(kind, readout, stack)


def test_plays_the_role(lab):
    assert role_of(type(lab.sensor)) == "position sensor"
    assert lab.sensor.name == "tip"
    assert lab.sensor.parent is None


def test_says_who_it_is(lab):
    identity = lab.sensor.identity
    assert (identity.maker, identity.model) == ("LabJack", "T7")
    assert identity.serial_number == "470012345"
    assert identity.firmware == "1.0300"


def test_signals_are_what_measure_and_glance_deliver(lab):
    names = [signal.name for signal in lab.sensor.signals]
    assert names == ["tip_position"]
    assert [signal.unit for signal in lab.sensor.signals] == ["m"]
    assert list(lab.sensor.measure()) == names
    assert list(lab.sensor.glance()) == names


@pytest.mark.parametrize("index", range(5))
def test_measures_the_position(lab, case, index):
    position = lab.stage.position = case.positions[index]
    assert lab.sensor.measure()["tip_position"] == pytest.approx(position, abs=case.measured_within)
    assert lab.sensor.glance()["tip_position"] == pytest.approx(position, abs=case.glanced_within)


def test_read_and_describe_conform_to_bluesky(lab):
    lab.stage.position = 5e-6
    reading = lab.sensor.read()
    described = lab.sensor.describe()
    assert reading.keys() == described.keys() == {"tip_position"}
    assert reading["tip_position"]["timestamp"] == lab.clock.timestamp()
    assert described["tip_position"]["units"] == "m"
    assert described["tip_position"]["source"] == "T7:470012345:tip_position"


def test_a_spoilt_signal_is_an_error_and_not_a_number(lab):
    lab.spoil()
    for take in (lab.sensor.measure, lab.sensor.glance, lab.sensor.read):
        with pytest.raises(DeviceError, match=r"^tip: "):
            take()


@pytest.mark.parametrize("side", [-1, 1])
def test_outside_of_the_calibration_is_an_error(lab, case, side):
    lab.stage.position = side * case.outside
    with pytest.raises(DeviceError, match=rf"tip: position {'-' if side < 0 else ''}\d\S* m is outside of"):
        lab.sensor.measure()


def test_recovers_by_itself(lab, case):
    lab.stage.position = 1.0
    with pytest.raises(DeviceError):
        lab.sensor.measure()
    lab.stage.position = case.positions[3]
    assert lab.sensor.measure()["tip_position"] == pytest.approx(case.positions[3], abs=case.measured_within)


def test_safe_and_stop_change_nothing(lab, case):
    lab.stage.position = case.positions[3]
    for _ in range(2):
        lab.sensor.safe()
        lab.sensor.stop()
    assert lab.sensor.measure()["tip_position"] == pytest.approx(case.positions[3], abs=case.measured_within)


def test_a_measurement_takes_the_time_of_its_conversions(lab, readout):
    begin = lab.clock.now()
    lab.sensor.measure()
    assert lab.clock.now() - begin == pytest.approx(0.010 * len(CASES[readout].channels))
    begin = lab.clock.now()
    lab.sensor.glance()
    assert lab.clock.now() == begin


def test_a_measurement_is_the_mean_over_its_time(kind):
    with ExitStack() as stack:
        lab = laboratory(kind, "voltage", stack)
        lab.stage.velocity = 2e-3
        # Conversions at 1, 2 ... 10 ms: their mean is at 5.5 ms.
        assert lab.sensor.measure()["tip_position"] == pytest.approx(11e-6, abs=0.15e-6)


def test_one_seed_gives_one_record(kind, readout):
    def record(seed: int) -> list[float]:
        with ExitStack() as stack:
            lab = laboratory(kind, readout, stack, seed)
            values = []
            for position in CASES[readout].positions:
                lab.stage.position = position
                values += [lab.sensor.measure()["tip_position"], lab.sensor.glance()["tip_position"]]
            return values

    assert record(7) == record(7)
    assert record(7) != record(8)


def test_the_wire_changes_no_more_than_the_rounding_of_a_float(readout):
    def record(kind: str) -> list[float]:
        with ExitStack() as stack:
            lab = laboratory(kind, readout, stack)
            lab.stage.position = CASES[readout].positions[-1]
            return [lab.sensor.measure()["tip_position"] for _ in range(5)]

    np.testing.assert_allclose(record("wire"), record("emulated"), rtol=1e-6)


def test_noise_of_a_measurement_is_that_of_the_mean(kind):
    with ExitStack() as stack:
        lab = laboratory(kind, "voltage", stack)
        means = [lab.sensor.measure()["tip_position"] for _ in range(500)]
        single = [lab.sensor.glance()["tip_position"] for _ in range(500)]
    # 5 mV of the detector at 0.1 V/µm is 50 nm; the converter's own 0.1 mV does not show.
    assert np.std(means) == pytest.approx(50e-9 / math.sqrt(10), rel=0.12)
    assert np.std(single) == pytest.approx(50e-9, rel=0.12)
    assert abs(np.mean(means)) < 4 * 50e-9 / math.sqrt(5000)


def test_noise_of_a_displacement_sensor_is_not_that_of_the_converter(kind):
    with ExitStack() as stack:
        lab = laboratory(kind, "displacement", stack)
        lab.stage.position = 33.003e-6
        means = [lab.sensor.measure()["tip_position"] for _ in range(500)]
        single = [lab.sensor.glance()["tip_position"] for _ in range(1000)]
    # 10 nm, steps of 10 nm, and 132 µV of the converter at 50 mV/µm, which are 2.6 nm.
    sigma = math.sqrt(10e-9**2 + 10e-9**2 / 12 + 2.6e-9**2)
    assert np.std(single) == pytest.approx(sigma, rel=0.07)
    assert np.std(means) == pytest.approx(sigma / math.sqrt(10), rel=0.1)
    assert abs(np.mean(means) - 33.003e-6) < 4 * sigma / math.sqrt(5000)


@pytest.mark.parametrize("position", [-1e-3, -200e-6, 200e-6, 1e-3])
def test_a_displacement_beyond_the_reach_is_never_a_position(kind, position):
    with ExitStack() as stack:
        lab = laboratory(kind, "displacement", stack)
        lab.stage.position = position
        for take in (lab.sensor.measure, lab.sensor.glance) * 20:
            with pytest.raises(DeviceError, match=r"tip: AIN1 .*is over its range of ±10 V"):
                take()


def test_supply_of_a_ratiometric_sensor_does_not_matter_within_its_range(kind):
    with ExitStack() as stack:
        lab = laboratory(kind, "ratiometric", stack)
        lab.stage.position = 5e-3
        for volts in (4.55, 5.0, 5.45):
            lab.transducer.supply_volts = volts
            means = [lab.sensor.measure()["tip_position"] for _ in range(20)]
            assert np.mean(means) == pytest.approx(5e-3, abs=8e-6)


@pytest.mark.parametrize("volts", [0.0, 4.45, 5.55, 9.0])
def test_a_failed_supply_is_named(kind, volts):
    with ExitStack() as stack:
        lab = laboratory(kind, "ratiometric", stack)
        lab.transducer.supply_volts = volts
        for take in (lab.sensor.measure, lab.sensor.glance):
            with pytest.raises(DeviceError, match=r"tip: supply voltage of the sensor is \S+ V"):
                take()


@pytest.mark.parametrize("position", [-1.0, -ZERO - 1e-3, 0.035 - ZERO + 1e-3, 1.0])
def test_a_magnet_beyond_the_stroke_is_never_a_position(kind, position):
    with ExitStack() as stack:
        lab = laboratory(kind, "ratiometric", stack)
        lab.stage.position = position
        for take in (lab.sensor.measure, lab.sensor.glance) * 20:
            with pytest.raises(DeviceError, match="tip: output of the sensor"):
                take()
