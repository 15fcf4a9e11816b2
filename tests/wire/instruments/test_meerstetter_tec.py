"""The emulated TEC controller: parameters, states, protections and deadlines, on a small plant of its own."""

import math

import numpy as np
import pytest

from bench.base import DeviceConnectionError, DeviceError, VirtualClock
from bench.devices import TECMode
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


def test_unknown_parameter_instance_and_numbers_that_are_none(tec):
    assert refusal(lambda: tec.read_parameter(1234)) is ServerError.PARAMETER_NOT_AVAILABLE
    for number, instance in ((1000, 3), (1000, 0), (104, 2), (6100, 9)):
        assert refusal(lambda n=number, i=instance: tec.read_parameter(n, i)) is ServerError.INSTANCE_NOT_AVAILABLE
    assert refusal(lambda: tec.write_parameter(3000, math.nan)) is ServerError.OUT_OF_RANGE
    assert refusal(lambda: tec.write_parameter(3000, 1e300)) is ServerError.OUT_OF_RANGE
    assert refusal(lambda: tec.write_parameter(2060, 0.05)) is ServerError.OUT_OF_RANGE


def test_reals_are_of_single_precision(tec):
    tec.write_parameter(3000, 20.1)
    assert tec.read_parameter(3000) == float(np.float32(20.1)) != 20.1


def test_identity_is_what_the_parameters_say(tec):
    assert [tec.read_parameter(number) for number in (100, 102, 103)] == [1091, 10910042, 410]
    assert tec.identity.model == "TEC-1091"
    assert tec.identity.firmware == "4.10"
    assert len(tec.identification) == 20


def test_a_channel_that_is_not_there_keeps_settings_and_measures_nothing(tec, plate):
    assert math.isnan(tec.read_parameter(1000, 2))
    assert math.isnan(tec.read_parameter(1001, 2))
    assert tec.read_parameter(1021, 2) == 0.0
    for number, value in ((50012, 60.0), (50011, 1), (2010, 2), (50000, 1)):
        tec.write_parameter(number, value, 2)
        assert tec.read_parameter(number, 2) == value
    assert tec.status is DeviceStatus.READY
    assert plate.calls == []
    assert tec.read_parameter(50012) == 0.0


def test_ranges_of_the_makers_documents(tec):
    tec.write_parameter(2052, 1_000_000)
    assert refusal(lambda: tec.write_parameter(2052, 1_000_001)) is ServerError.OUT_OF_RANGE
    for value, taken in ((0.0, True), (0.0999, False), (0.1, True), (600.0, True), (600.1, False)):
        if taken:
            tec.write_parameter(2060, value)
        else:
            assert refusal(lambda v=value: tec.write_parameter(2060, v)) is ServerError.OUT_OF_RANGE
    assert refusal(lambda: tec.write_parameter(52103, 1)) is ServerError.READ_ONLY
    for line in range(1, 9):
        tec.write_parameter(6100, 13 + line, line)
    assert [tec.read_parameter(6100, line) for line in range(1, 9)] == list(range(14, 22))


def test_runs_ready_run_and_back(tec, clock, plate):
    assert tec.status is DeviceStatus.READY
    run(tec)
    assert tec.status is DeviceStatus.RUN
    clock.sleep(10.0)
    assert tec.read_parameter(1000) == pytest.approx(40.0, abs=1e-3)
    assert tec.read_parameter(1011) == 40.0
    tec.write_parameter(50000, 0)
    assert tec.status is DeviceStatus.READY
    assert plate.calls[-1] == (pytest.approx(10.0), "release")


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


def test_polarity_turns_the_sign_of_the_wire_and_not_of_the_role(tec, plate):
    tec.write_parameter(3034, 0)
    tec.select_mode(TECMode.CURRENT)
    tec.set(1.0)
    assert plate.current == 1.0
    assert tec.read_parameter(50001) == -1.0
    assert tec.read_parameter(1020) == -1.0
    assert tec.measure()["tec_current"] == 1.0


def test_same_command_again_does_not_disturb_the_loop(tec, plate):
    run(tec)
    before = len(plate.calls)
    run(tec)
    assert len(plate.calls) == before


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


def test_watchdog_expires_at_its_own_instant(tec, clock, plate):
    tec.write_parameter(2060, 1.5)
    run(tec)
    clock.sleep(1.0)
    tec.read_parameter(1000)
    clock.sleep(3600.0)
    assert tec.status is DeviceStatus.ERROR
    assert plate.calls[-1] == (pytest.approx(2.5, abs=1e-9), "release")
    assert [tec.read_parameter(number) for number in (105, 106, 107)] == [183, 1, 2060]
    assert [tec.read_parameter(number) for number in (50000, 50011, 50012)] == [1, 1, 40.0]
    assert plate.plate_temperature == pytest.approx(AMBIENT, abs=0.01)


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


def test_watchdog_can_be_switched_off(tec, clock):
    tec.write_parameter(2060, 1.0)
    run(tec)
    tec.write_parameter(2060, 0.0)
    clock.sleep(100.0)
    assert tec.status is DeviceStatus.RUN


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


def test_a_power_cycle_of_an_output_that_the_flash_switches_on_interrupts_it(tec, plate):
    tec.write_parameter(2010, 1)
    tec.power_cycle()
    assert [call[1] for call in plate.calls] == ["regulate", "release", "regulate"]
    assert tec.status is DeviceStatus.RUN


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


def test_flash_writes_are_counted_while_saving_is_on(tec):
    tec.write_parameter(3000, 30.0)
    tec.write_parameter(50012, 30.0)
    assert (tec.flash_writes, tec.read_parameter(109)) == (1, 0)
    tec.write_parameter(108, 1)
    tec.write_parameter(3000, 31.0)
    assert (tec.flash_writes, tec.read_parameter(109)) == (1, 2)


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


def test_first_error_stays(tec):
    tec.trip(60)
    tec.trip(138)
    assert tec.read_parameter(105) == 60


def test_an_error_that_resets_itself_brings_the_output_back(tec, clock, plate):
    tec.write_parameter(6310, 3.0)
    run(tec)
    tec.trip(138)
    assert plate.calls[-1][1] == "release"
    clock.sleep(2.9)
    assert tec.status is DeviceStatus.ERROR
    clock.sleep(0.2)
    assert tec.status is DeviceStatus.RUN
    assert plate.calls[-1] == (pytest.approx(3.0), "regulate", 40.0, 4.0)
    assert tec.read_parameter(105) == 0


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


def test_saturation_can_be_ignored(tec, clock, plate):
    tec.write_parameter(2033, 25.0)
    tec.write_parameter(6320, -1)
    plate.RESISTANCE = 24.5
    for number, value in ((2000, 1), (50001, 1.0), (4011, 500.0), (2010, 2), (50000, 1)):
        tec.write_parameter(number, value)
    clock.sleep(1.0)
    assert tec.status is DeviceStatus.RUN


def test_noise_is_small_seeded_and_on_the_object_alone(clock, plate):
    def readings(seed, number):
        tec = EmulatedTEC("tec", World(plate, clock), plate, rng=np.random.default_rng(seed))
        return [tec.read_parameter(number) for _ in range(400)]

    assert readings(1, 1000) == readings(1, 1000) != readings(2, 1000)
    assert np.std(readings(1, 1000)) == pytest.approx(0.002, rel=0.15)
    assert np.mean(readings(1, 1000)) == pytest.approx(AMBIENT, abs=5e-4)
    assert len(set(readings(1, 1001))) == 1


def test_unplugged_it_says_so_and_its_watchdog_expires(tec, clock, plate):
    tec.write_parameter(2060, 1.0)
    tec.set(40.0)
    tec.unplug()
    for call in (tec.measure, tec.safe, lambda: tec.set(30.0), lambda: tec.output_enabled):
        with pytest.raises(DeviceConnectionError, match="tec: does not answer"):
            call()
    clock.sleep(5.0)
    tec.plug_in()
    with pytest.raises(DeviceError, match="error 183"):
        tec.measure()
    assert plate.calls[-1][:2] == (pytest.approx(1.0), "release")


def test_splitting_the_time_does_not_matter_to_what_happens():
    def release_time(pieces):
        clock, plate = VirtualClock(), Plate()
        tec = EmulatedTEC("tec", World(plate, clock), plate)
        tec.write_parameter(4011, 39.0)
        run(tec)
        for _ in range(pieces):
            clock.sleep(8.0 / pieces)
            _ = tec.status
        return plate.calls[-1]

    assert release_time(1) == release_time(7) == release_time(160)


def test_current_heats_and_cools_the_plate(tec, clock):
    tec.select_mode(TECMode.CURRENT)
    tec.set(0.5)
    clock.sleep(60.0)
    warm = tec.measure()["tec_temperature"]
    tec.set(-0.5)
    clock.sleep(60.0)
    assert tec.measure()["tec_temperature"] < AMBIENT < warm
