"""Sensors that are not ideal: what they make of a quantity, at rest and on its way."""

import math

import numpy as np
import pytest
from cases import cases

from bench.base import VirtualClock
from sim_devices.transducers.imperfect import Characteristic, ImperfectSensor, SensorErrors, imperfect, shown
from sim_devices.world import World


class Ramp:
    """A quantity that rises by 2 units a second until a stop, and jumps to 5 at an instant."""

    def __init__(self, stop=math.inf, jump=math.inf):
        self.time, self.stop, self.jump = 0.0, stop, jump

    def advance(self, dt):
        self.time += dt

    def __call__(self):
        return 5.0 if self.time >= self.jump else 2.0 * min(self.time, self.stop)


def laboratory(quantity, **errors):
    clock = VirtualClock()
    world = World(quantity, clock)
    return clock, world, imperfect(quantity, SensorErrors(**errors), -10.0, 10.0, world)


def read_at(clock, world, sensor, times):
    values = []
    for each in times:
        clock.sleep_until(each)
        world.advance()
        values.append(sensor())
    return np.array(values)


def static(value, **errors):
    world = World(Ramp(), VirtualClock())
    return ImperfectSensor(lambda: value, SensorErrors(**errors), -10.0, 10.0, world)()


def test_an_ideal_sensor_is_the_quantity_itself():
    quantity = Ramp()
    assert laboratory(quantity)[2] is quantity


def test_gain_and_offset():
    assert static(4.0, gain_error=0.002, offset=-0.5) == pytest.approx(4.008 - 0.5)


def test_nonlinearity_is_the_deviation_from_the_best_straight_line():
    values = np.linspace(-10.0, 10.0, 2001)
    deviation = np.array([static(each, nonlinearity=5e-4) for each in values]) - values
    slope, offset = np.polyfit(values, deviation, 1)
    assert abs(slope) < 1e-5  # of the samples
    assert abs(offset) < 1e-9
    assert np.abs(deviation).max() == pytest.approx(5e-4 * 20.0, rel=1e-3)


def test_the_phase_turns_a_nonlinearity_into_the_even_one_without_changing_its_size():
    values = np.linspace(-10.0, 10.0, 41)
    even = np.array([static(each, nonlinearity=5e-4, phase=0.5 * math.pi) for each in values]) - values
    assert even == pytest.approx(even[::-1], abs=1e-12)
    assert np.abs(even).max() == pytest.approx(5e-4 * 20.0)


def test_a_course_is_what_its_values_are():
    errors = SensorErrors(gain_error=0.01, offset=0.2, nonlinearity=1e-3, phase=0.7, resolution=0.01)
    sensor = Characteristic(errors, -10.0, 10.0)
    values = np.linspace(-12.0, 12.0, 49)
    assert sensor.course(values) == pytest.approx([sensor.value(each) for each in values], abs=1e-12)


def test_the_quantity_is_found_behind_what_is_made_of_it():
    sensor = Characteristic(SensorErrors(gain_error=0.01, offset=0.2, nonlinearity=4e-3), -10.0, 10.0)
    values = np.linspace(-12.0, 12.0, 49)
    assert sensor.quantities(sensor.course(values)) == pytest.approx(values, abs=1e-12)


def test_a_lag_is_that_of_the_first_order():
    times = np.arange(1, 300) * 0.01
    clock, world, sensor = laboratory(Ramp(jump=0.5), lag=0.1)
    seen = read_at(clock, world, sensor, times)
    lagged = 2.0 * times - 0.2 * (1.0 - np.exp(-times / 0.1))
    at_jump = 1.0 - 0.2 * (1.0 - math.exp(-5.0))
    expected = np.where(times < 0.5, lagged, 5.0 + (at_jump - 5.0) * np.exp(-(times - 0.5) / 0.1))
    # The jump is spread over one look in ten of the lag.
    assert seen == pytest.approx(expected, abs=0.25)
    assert seen[times < 0.48] == pytest.approx(expected[times < 0.48], abs=1e-9)
    assert seen[times > 1.5] == pytest.approx(5.0, abs=1e-3)


def test_a_latency_shows_what_was():
    times = np.arange(1, 200) * 0.005
    clock, world, sensor = laboratory(Ramp(stop=0.6), latency=0.02)
    seen = read_at(clock, world, sensor, times)
    assert seen == pytest.approx(2.0 * np.clip(times - 0.02, 0.0, 0.6), abs=1e-9)


def test_between_readings_far_apart_it_looks_by_itself_for_as_long_as_it_remembers():
    quantity = Ramp(jump=3600.0)
    clock, world, sensor = laboratory(quantity, lag=0.1)
    looks = 0
    inner = sensor._late.expire

    def expire():
        nonlocal looks
        looks += 1
        inner()

    sensor._late.expire = expire
    assert read_at(clock, world, sensor, [3599.9])[0] == pytest.approx(2.0 * 3599.8, abs=1e-3)
    assert read_at(clock, world, sensor, [7200.0])[0] == pytest.approx(5.0)
    assert looks < 300


def test_looking_at_the_truth_changes_nothing():
    rng = np.random.default_rng(0)
    looked, other = (laboratory(Ramp(jump=0.3), lag=0.05, latency=0.03) for _ in range(2))
    for each in np.cumsum(rng.uniform(0.001, 0.02, 60)):
        for clock, world, _ in (looked, other):
            clock.sleep_until(each)
            world.advance()
        before = shown(looked[2])
        assert shown(looked[2]) == before
        assert looked[2]() == other[2]() == pytest.approx(before, abs=1e-9)


@cases("resolution", [0.0, 0.03])
def test_a_course_is_shown_as_each_of_its_values(resolution):
    errors = SensorErrors(gain_error=0.01, offset=0.2, nonlinearity=0.02, resolution=resolution)
    characteristic = Characteristic(errors, -1.0, 3.0)
    quantities = np.random.default_rng(1).uniform(-2.0, 4.0, 500)
    shown = quantities.copy()
    characteristic.show(shown)
    assert shown.tolist() == [characteristic.value(quantity) for quantity in quantities.tolist()]
