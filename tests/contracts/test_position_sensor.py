"""What every position sensor promises, run against the emulated device and the driver on its wire."""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest

from bench.clock import VirtualClock
from bench.devices import PositionSensor, role_of
from bench.errors import DeviceError
from drivers.labjack_t7 import T7PositionSensor
from sim_devices.instruments.labjack_t7 import (
    EmulatedPositionSensor,
    EmulatedT7,
    NormalisedPSD,
    TwoCurrentPSD,
)
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


def laboratory(kind: str, readout: str, stack: ExitStack, seed: int = 1) -> Laboratory:
    stage, clock = Stage(), VirtualClock()
    world = World(stage, clock)
    streams = np.random.default_rng(seed).spawn(2)
    if readout == "voltage":
        psd = NormalisedPSD(lambda: stage.position, rng=streams[0])
        inputs = {0: psd}
        channels = (0,)

        def spoil() -> None:
            stage.position = 1.0
    else:
        two = TwoCurrentPSD(lambda: stage.position, rng=streams[0])
        inputs = {2: two.first, 3: two.second}
        channels = (2, 3)

        def spoil() -> None:
            two.light = 0.01

    instrument = EmulatedT7(world, inputs, rng=streams[1])
    if kind == "emulated":
        sensor: PositionSensor = EmulatedPositionSensor("tip", instrument, readout=readout, channels=channels)
    else:
        server = stack.enter_context(ModbusTcpServer(instrument))
        settings = T7PositionSensor.Settings(port=server.address, readout=readout, channels=channels)
        sensor = T7PositionSensor.connect("tip", settings, clock)
    stack.callback(sensor.close)
    return Laboratory(sensor, stage, clock, spoil)


@pytest.fixture(params=["emulated", "wire"])
def kind(request) -> str:
    return request.param


@pytest.fixture(params=["voltage", "currents"])
def readout(request) -> str:
    return request.param


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


@pytest.mark.parametrize("position", [-85e-6, -1e-6, 0.0, 12.5e-6, 85e-6])
def test_measures_the_position(lab, position):
    lab.stage.position = position
    assert lab.sensor.measure()["tip_position"] == pytest.approx(position, abs=0.15e-6)
    assert lab.sensor.glance()["tip_position"] == pytest.approx(position, abs=0.45e-6)


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


def test_outside_of_the_calibration_is_an_error(lab):
    lab.stage.position = 95e-6
    with pytest.raises(DeviceError, match="tip: position 9"):
        lab.sensor.measure()


def test_recovers_by_itself(lab):
    lab.stage.position = 1.0
    with pytest.raises(DeviceError):
        lab.sensor.measure()
    lab.stage.position = 1e-6
    assert lab.sensor.measure()["tip_position"] == pytest.approx(1e-6, abs=0.15e-6)


def test_safe_and_stop_change_nothing(lab):
    lab.stage.position = 20e-6
    for _ in range(2):
        lab.sensor.safe()
        lab.sensor.stop()
    assert lab.sensor.measure()["tip_position"] == pytest.approx(20e-6, abs=0.15e-6)


def test_a_measurement_takes_the_time_of_its_conversions(lab, readout):
    begin = lab.clock.now()
    lab.sensor.measure()
    assert lab.clock.now() - begin == pytest.approx(0.010 if readout == "voltage" else 0.020)
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
            for step in range(5):
                lab.stage.position = step * 10e-6
                values += [lab.sensor.measure()["tip_position"], lab.sensor.glance()["tip_position"]]
            return values

    assert record(7) == record(7)
    assert record(7) != record(8)


def test_the_wire_changes_no_more_than_the_rounding_of_a_float(readout):
    def record(kind: str) -> list[float]:
        with ExitStack() as stack:
            lab = laboratory(kind, readout, stack)
            lab.stage.position = 33e-6
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
