"""What every load cell promises, run against the emulated device and the driver on its wire."""

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest

from bench.clock import VirtualClock
from bench.devices import LoadCell, role_of
from bench.errors import DeviceError
from drivers.flintec_dad141 import FlintecDAD141
from sim_devices import protocol_emulated
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141, reading_interval
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.world import World

NOISE = 5e-4 * math.sqrt(4 / 17)  # of one reading at filter setting 3, N
STEP = 1e-3  # of the display, N


class Specimen:
    """A plant whose force the test sets."""

    def __init__(self) -> None:
        self.force = 0.0
        self.rate = 0.0

    def advance(self, dt: float) -> None:
        self.force += self.rate * dt


@dataclass
class Laboratory:
    cell: LoadCell
    specimen: Specimen
    clock: VirtualClock

    def put(self, force: float) -> None:
        """Load the cell and let its filter settle."""
        self.specimen.force = force
        self.clock.sleep(2.0)


def laboratory(kind: str, stack: ExitStack, seed: int = 1, **options) -> Laboratory:
    specimen, clock = Specimen(), VirtualClock()
    instrument = EmulatedDAD141(
        "load", World(specimen, clock), lambda: specimen.force, rng=np.random.default_rng(seed), **options
    )
    cell: LoadCell = instrument
    if kind == "wire":
        port = protocol_emulated.register("load", ModbusRtuServer(instrument), clock)
        stack.callback(protocol_emulated.unregister, "load")
        calibration = {key: options[key] for key in ("newtons_per_unit", "zero_newtons") if key in options}
        settings = FlintecDAD141.Settings(port=port, force_limits=(-70.0, 70.0), **calibration)
        cell = FlintecDAD141.connect("load", settings, clock)
    stack.callback(cell.close)
    return Laboratory(cell, specimen, clock)


@pytest.fixture(params=["emulated", "wire"])
def kind(request) -> str:
    return request.param


@pytest.fixture
def lab(kind) -> Iterator[Laboratory]:
    with ExitStack() as stack:
        yield laboratory(kind, stack)


def force(reading: dict[str, float]) -> float:
    return reading["load_force"]


def test_plays_the_role(lab):
    assert role_of(type(lab.cell)) == "load cell"
    assert lab.cell.name == "load"
    assert lab.cell.parent is None


def test_says_who_it_is(lab):
    identity = lab.cell.identity
    assert (identity.maker, identity.model) == ("Flintec", "DAD 141.1")
    assert (identity.serial_number, identity.firmware) == ("1410237", "1.10")


def test_signals_are_what_measure_and_glance_deliver(lab):
    names = [signal.name for signal in lab.cell.signals]
    assert names == ["load_force"]
    assert [signal.unit for signal in lab.cell.signals] == ["N"]
    assert list(lab.cell.measure()) == names
    assert list(lab.cell.glance()) == names


@pytest.mark.parametrize("newtons", [-59.9, -0.5, 0.0, 12.345, 59.9])
def test_measures_the_force(lab, newtons):
    lab.put(newtons)
    assert force(lab.cell.measure()) == pytest.approx(newtons, abs=1.5e-3)
    assert force(lab.cell.glance()) == pytest.approx(newtons, abs=2e-3)


@pytest.mark.parametrize(("newtons_per_unit", "zero_newtons"), [(9.80665, 0.0), (-2.0, 3.0), (0.5, -10.0)])
def test_calibration(kind, newtons_per_unit, zero_newtons):
    with ExitStack() as stack:
        calibration = {"newtons_per_unit": newtons_per_unit, "zero_newtons": zero_newtons}
        lab = laboratory(kind, stack, **calibration, noise=5e-5, decimals=4)
        lab.put(7.5)
        assert force(lab.cell.measure()) == pytest.approx(7.5, abs=2e-3)
        lab.cell.tare()
        lab.put(9.0)
        assert force(lab.cell.measure()) == pytest.approx(1.5, abs=3e-3)


def test_read_and_describe_conform_to_bluesky(lab):
    lab.put(5.0)
    reading, described = lab.cell.read(), lab.cell.describe()
    assert reading.keys() == described.keys() == {"load_force"}
    assert reading["load_force"]["timestamp"] == lab.clock.timestamp()
    assert described["load_force"]["units"] == "N"
    assert described["load_force"]["source"] == "DAD 141.1:1410237:load_force"


def test_tare_makes_the_present_force_zero(lab):
    lab.put(10.0)
    lab.cell.tare()
    assert force(lab.cell.measure()) == pytest.approx(0.0, abs=2e-3)
    lab.put(12.5)
    assert force(lab.cell.measure()) == pytest.approx(2.5, abs=3e-3)
    assert force(lab.cell.glance()) == pytest.approx(2.5, abs=3e-3)
    lab.put(4.0)
    lab.cell.tare()
    assert force(lab.cell.measure()) == pytest.approx(0.0, abs=2e-3)
    lab.cell.clear_tare()
    assert force(lab.cell.measure()) == pytest.approx(4.0, abs=1.5e-3)
    lab.cell.clear_tare()
    assert force(lab.cell.measure()) == pytest.approx(4.0, abs=1.5e-3)


def test_tare_waits_until_the_signal_is_still(lab):
    lab.cell.measure()
    lab.specimen.force = 10.0
    lab.clock.sleep(0.05)
    lab.cell.tare()  # the filter has not settled yet: without waiting, a part of the 10 N would remain
    assert force(lab.cell.measure()) == pytest.approx(0.0, abs=2e-3)


def test_tare_of_a_moving_load_is_refused(lab):
    lab.specimen.rate = 0.5
    begin = lab.clock.now()
    with pytest.raises(DeviceError, match=r"^load: .*still"):
        lab.cell.tare()
    assert lab.clock.now() - begin == pytest.approx(10.0, abs=0.3)
    lab.specimen.rate = 0.0
    lab.put(8.0)
    assert force(lab.cell.measure()) == pytest.approx(8.0, abs=1.5e-3)


@pytest.mark.parametrize(("newtons", "side"), [(60.1, "over"), (-60.1, "under"), (1e9, "over"), (-1e9, "under")])
def test_out_of_range_is_an_error_and_not_a_number(lab, newtons, side):
    lab.put(newtons)
    for take in (lab.cell.measure, lab.cell.glance, lab.cell.read):
        with pytest.raises(DeviceError, match=f"^load: .*{side} its range"):
            take()


def test_recovers_by_itself(lab):
    lab.put(1e6)
    with pytest.raises(DeviceError):
        lab.cell.measure()
    lab.put(3.0)
    assert force(lab.cell.measure()) == pytest.approx(3.0, abs=1.5e-3)


def test_range_is_that_of_the_gross_force(lab):
    lab.put(40.0)
    lab.cell.tare()
    lab.put(61.0)
    with pytest.raises(DeviceError, match="over its range"):
        lab.cell.measure()


def test_safe_and_stop_change_nothing(lab):
    lab.put(6.0)
    lab.cell.tare()
    lab.put(7.0)
    for _ in range(2):
        lab.cell.safe()
        lab.cell.stop()
    assert force(lab.cell.measure()) == pytest.approx(1.0, abs=3e-3)


def test_a_measurement_spaces_its_readings_by_the_filter(lab):
    begin = lab.clock.now()
    lab.cell.measure()
    assert lab.clock.now() - begin == pytest.approx(4 * reading_interval(3), abs=0.01)
    begin = lab.clock.now()
    lab.cell.glance()
    assert lab.clock.now() - begin < 0.01


def test_a_measurement_is_the_mean_over_its_time(lab):
    lab.put(0.0)
    lab.cell.glance()
    lab.specimen.rate = 1.0
    lab.clock.sleep(2.0)
    # Readings over 0.5 s, 0.25 s on the mean; both lags hold them back by 25.6 ms each.
    assert force(lab.cell.measure()) == pytest.approx(2.0 + 0.25 - 2 * 0.0256, abs=8e-3)


def test_a_force_that_nobody_watched_arriving_is_seen_settled(lab):
    lab.put(0.0)
    lab.cell.glance()
    lab.specimen.force = 20.0
    lab.clock.sleep(3600.0)
    assert force(lab.cell.glance()) == pytest.approx(20.0, abs=2e-3)
    lab.cell.tare()
    assert force(lab.cell.glance()) == pytest.approx(0.0, abs=2e-3)


def test_one_seed_gives_one_record(kind):
    def record(seed: int) -> list[float]:
        with ExitStack() as stack:
            lab = laboratory(kind, stack, seed)
            values = []
            for step in range(5):
                lab.put(2.0 * step)
                values += [force(lab.cell.measure()), force(lab.cell.glance())]
            return values

    assert record(7) == record(7)
    assert record(7) != record(8)


def test_the_wire_changes_no_more_than_the_rounding_of_a_float():
    def record(kind: str) -> list[float]:
        with ExitStack() as stack:
            lab = laboratory(kind, stack, noise=0.0)
            values = []
            for newtons in (-33.333, 0.001, 47.11):
                lab.put(newtons)
                values.append(force(lab.cell.measure()))
            return values

    np.testing.assert_allclose(record("wire"), record("emulated"), rtol=1e-6)


def test_noise_of_a_measurement_is_that_of_the_mean(kind):
    with ExitStack() as stack:
        # Fine enough a display that its steps do not show.
        lab = laboratory(kind, stack, noise=5e-3, weight_limits=(-9.0, 9.0), decimals=5)
        lab.put(3.0)
        means, single = [], []
        for _ in range(400):
            means.append(force(lab.cell.measure()))
            lab.clock.sleep(0.2)
            single.append(force(lab.cell.glance()))
            lab.clock.sleep(0.2)
    assert np.std(single) == pytest.approx(10 * NOISE, rel=0.12)
    # Neighbouring readings are correlated by 4 %.
    assert np.std(means) == pytest.approx(10 * NOISE * math.sqrt((1 + 0.08) / 5), rel=0.12)
    assert abs(np.mean(means) - 3.0) < 4 * 10 * NOISE / math.sqrt(2000)
