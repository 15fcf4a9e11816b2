"""The emulated TEC controller: parameters, states, protections and deadlines, on a small plant of its own."""

import math

import numpy as np
import pytest

from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.instruments.meerstetter_table import PARAMETERS, DeviceStatus, ServerError
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.world import World

AMBIENT = 22.0


class Plate:
    """First order: heat capacity C, loss K to a sink at ambient, Seebeck and Joule heat of a current."""

    CAPACITY, LOSS, SEEBECK, RESISTANCE, LAG = 5.0, 0.5, 0.02, 2.0, 0.5

    def __init__(self):
        self.time = 0.0
        self.plate_temperature = self.sink_temperature = AMBIENT
        self.current = 0.0
        self.target = None
        self.limit = math.inf
        self.calls = []

    @property
    def voltage(self):
        difference = self.plate_temperature - self.sink_temperature
        return self.RESISTANCE * self.current + self.SEEBECK * difference

    def regulate(self, target_celsius, current_limit=math.inf):
        self.calls.append((self.time, "regulate", target_celsius, current_limit))
        self.target, self.limit = target_celsius, current_limit

    def terminals(self):
        return self.plate_temperature, self.sink_temperature, self.current, self.voltage

    def drive(self, current_ampere):
        self.calls.append((self.time, "drive", current_ampere))
        self.target, self.current = None, current_ampere

    def release(self):
        self.calls.append((self.time, "release"))
        self.target, self.current = None, 0.0

    def advance(self, dt):
        self.time += dt
        if self.target is not None:
            share = math.exp(-dt / self.LAG)
            self.plate_temperature = self.target + share * (self.plate_temperature - self.target)
            self.current = min((self.plate_temperature - AMBIENT) * self.LOSS / 10.0, self.limit)
            return
        # Linear in the temperature for a constant current, so the step is exact.
        loss = self.LOSS - self.SEEBECK * self.current
        power = self.LOSS * AMBIENT + 273.15 * self.SEEBECK * self.current
        power += 0.5 * self.RESISTANCE * self.current**2
        rest = power / loss
        self.plate_temperature = rest + (self.plate_temperature - rest) * math.exp(-loss * dt / self.CAPACITY)


@pytest.fixture
def plate():
    return Plate()


@pytest.fixture
def tec(clock, plate):
    return EmulatedTEC("tec", World(plate, clock), plate)


def run(tec, temperature=40.0):
    """Switch the temperature controller on as a host does by parameters."""
    for number, value in ((50012, temperature), (50011, 1), (2010, 2), (50000, 1)):
        tec.write_parameter(number, value)


def refusal(action):
    with pytest.raises(RequestRefusedError) as caught:
        action()
    return caught.value.reason


def test_every_parameter_can_be_read_and_is_in_its_range(tec):
    for number, row in PARAMETERS.items():
        assert row.low <= tec.read_parameter(number) <= row.high or number == 2050


def test_every_writable_parameter_takes_its_bounds_and_nothing_beyond(tec):
    tec.write_parameter(108, 1)
    for number, row in PARAMETERS.items():
        if not row.writable:
            assert refusal(lambda n=number: tec.write_parameter(n, 0)) is ServerError.READ_ONLY
            continue
        beyond = max(1.0, abs(row.high) * 0.01)
        assert refusal(lambda n=number, v=row.high + beyond: tec.write_parameter(n, v)) is (ServerError.OUT_OF_RANGE)
        assert refusal(lambda n=number, v=row.low - beyond: tec.write_parameter(n, v)) is (ServerError.OUT_OF_RANGE)
        if number not in (50000, 50001, 2010, 4010, 4011, 5010, 5011):
            tec.write_parameter(number, row.high)
            tec.write_parameter(number, row.low)


@pytest.mark.parametrize(("enable", "live", "on"), [(0, 1, False), (1, 0, True), (2, 0, False), (3, 1, False)])
def test_enable_decides_whether_live_enable_counts(tec, enable, live, on):
    tec.write_parameter(2010, enable)
    tec.write_parameter(50000, live)
    assert (tec.status is DeviceStatus.RUN) is on


def test_target_comes_from_the_flash_parameter_unless_the_live_one_is_selected(tec, plate):
    tec.write_parameter(3000, 30.0)
    tec.write_parameter(50012, 50.0)
    tec.write_parameter(2010, 1)
    assert plate.calls[-1] == (0.0, "regulate", 30.0, 4.0)
    tec.write_parameter(50011, 1)
    assert plate.calls[-1] == (0.0, "regulate", 50.0, 4.0)


def test_current_is_limited_and_static_current_is_another_source(tec, plate):
    for number, value in ((2000, 1), (2030, 1.5), (50001, -3.0), (2020, 0.5), (2010, 2), (50000, 1)):
        tec.write_parameter(number, value)
    assert plate.calls[-1] == (0.0, "drive", -1.5)
    tec.write_parameter(2000, 0)
    assert plate.calls[-1] == (0.0, "drive", 0.5)


def test_stability_is_off_searching_and_stable(tec, clock):
    assert tec.read_parameter(1200) == 0
    run(tec)
    assert tec.read_parameter(1200) == 1
    clock.sleep(2.0)
    assert tec.read_parameter(1200) == 1
    clock.sleep(10.0)
    assert tec.read_parameter(1200) == 2
    tec.write_parameter(50012, 41.0)
    assert tec.read_parameter(1200) == 1


def test_not_stable_in_time_is_error_182(tec, clock):
    tec.write_parameter(4042, 2.0)
    run(tec)
    clock.sleep(10.0)
    assert tec.status is DeviceStatus.ERROR
    assert tec.read_parameter(105) == 182


def test_watchdog_is_fed_by_any_request_and_not_by_looking_on(tec, clock):
    tec.write_parameter(2060, 1.0)
    run(tec)
    for _ in range(5):
        clock.sleep(0.9)
        tec.measure()
    assert tec.status is DeviceStatus.RUN
    for _ in range(3):
        clock.sleep(0.5)
        _ = tec.status
    assert tec.status is DeviceStatus.ERROR


def test_reset_restores_the_flash_after_200_ms(tec, clock):
    tec.write_parameter(3000, 30.0)
    tec.write_parameter(108, 1)
    tec.write_parameter(3000, 35.0)
    run(tec)
    tec.trip(138)
    tec.reset()
    assert tec.status is DeviceStatus.RESET_PENDING
    clock.sleep(0.199)
    assert tec.status is DeviceStatus.RESET_PENDING
    clock.sleep(0.002)
    assert tec.status is DeviceStatus.READY
    assert [tec.read_parameter(number) for number in (105, 108, 3000, 50000)] == [0, 0, 30.0, 0]


def test_a_power_cycle_loses_what_is_in_ram_and_switches_off(tec, clock, plate):
    tec.write_parameter(3000, 30.0)
    tec.write_parameter(108, 1)
    tec.write_parameter(3000, 35.0)
    tec.write_parameter(2030, 1.5)
    tec.write_parameter(2060, 1.0)
    run(tec)
    clock.sleep(0.5)
    tec.power_cycle()
    assert tec.status is DeviceStatus.READY
    assert plate.calls[-1] == (0.5, "release")
    assert [tec.read_parameter(number) for number in (108, 3000, 2030, 2060, 2010, 50000)] == [0, 30.0, 4.0, 0, 0, 0]
    tec.trip(138)
    tec.power_cycle()
    assert (tec.status, tec.read_parameter(105)) == (DeviceStatus.READY, 0)


def test_saving_writes_to_the_flash_what_differs(tec):
    tec.write_parameter(108, 1)
    tec.write_parameter(3000, 31.0)
    tec.write_parameter(3000, 32.0, 2)
    tec.write_parameter(50012, 33.0)
    assert tec.flash_writes == 0
    tec.save()
    assert tec.flash_writes == 2
    tec.save()
    assert tec.flash_writes == 2
    tec.power_cycle()
    assert [tec.read_parameter(3000, each) for each in (1, 2)] == [31.0, 32.0]
    assert tec.read_parameter(50012) == 0.0


def test_emergency_stop_is_error_11_and_stays(tec, clock, plate):
    run(tec)
    tec.emergency_stop()
    assert tec.status is DeviceStatus.ERROR
    assert [tec.read_parameter(number) for number in (105, 106, 107)] == [11, 1, 464]
    assert plate.calls[-1][1] == "release"
    run(tec)
    clock.sleep(10.0)
    assert tec.status is DeviceStatus.ERROR
    assert plate.calls[-1][1] == "release"


def test_an_automatic_restart_takes_time_while_its_cause_stays(tec, clock):
    tec.write_parameter(6310, 1e-40)
    run(tec)
    tec.write_parameter(4011, -200.0)
    clock.sleep(10.0)
    assert tec.read_parameter(105) == 138


@pytest.mark.parametrize(
    ("settings", "number"),
    [
        ({4011: 35.0}, 138),
        ({4010: 30.0}, 137),
        ({5011: 20.0}, 143),
        ({5010: 25.0}, 142),
        ({4012: 3.0}, 139),
        ({2032: 0.2}, 100),
        ({2033: 1.0}, 104),
    ],
)
def test_protections_trip_while_nobody_looks(tec, clock, plate, settings, number):
    for parameter, value in settings.items():
        tec.write_parameter(parameter, value)
    run(tec)
    clock.sleep(10.0)
    assert tec.status is DeviceStatus.ERROR
    assert tec.read_parameter(105) == number
    assert plate.calls[-1][0] < 2.0
    assert plate.calls[-1][1] == "release"


def test_fast_sink_is_error_144(tec, clock, plate):
    tec.write_parameter(5012, 1.0)
    run(tec)
    clock.sleep(0.5)
    tec.read_parameter(1001)
    plate.sink_temperature += 20.0
    clock.sleep(0.5)
    assert tec.read_parameter(105) == 144


def test_saturation_is_error_108_after_its_delay(tec, clock, plate):
    tec.write_parameter(2033, 25.0)
    tec.write_parameter(6320, 700)
    plate.RESISTANCE = 24.5 / 1.0
    for number, value in ((2000, 1), (50001, 1.0), (2010, 2), (50000, 1)):
        tec.write_parameter(number, value)
    clock.sleep(10.0)
    assert tec.read_parameter(105) == 108
    assert 0.7 < plate.calls[-1][0] <= 1.0


def test_noise_is_small_seeded_and_on_the_object_alone(clock, plate):
    def readings(seed, number):
        tec = EmulatedTEC("tec", World(plate, clock), plate, rng=np.random.default_rng(seed))
        return [tec.read_parameter(number) for _ in range(400)]

    assert readings(1, 1000) == readings(1, 1000) != readings(2, 1000)
    assert np.std(readings(1, 1000)) == pytest.approx(0.002, rel=0.15)
    assert np.mean(readings(1, 1000)) == pytest.approx(AMBIENT, abs=5e-4)
    assert len(set(readings(1, 1001))) == 1
