"""Inputs that overshoot: the memory sees the peak, and moves come to rest without one."""

import numpy as np
import pytest

from bench.control import Spans
from bench.control.overshoot import LEAST, Overshoot
from bench.control.tracking import Arrival, ClosedLoopInverse, CorrectionParameters, OpenLoopInverse
from bench.models import Preisach, uniform_levels

LIMITS = (0.0, 100.0)
MODEL = Preisach(uniform_levels(*LIMITS, 20), np.full(210, 0.01), 0.0, None, LIMITS)
LOW, HIGH = MODEL.output_range()
STEP = 0.01


class Plate:
    """An input behind a loop of second order with a fastest change, and the specimen on it, which is the model."""

    def __init__(self, damping, frequency=2.2, rate=30.0):
        self.damping, self.frequency, self.rate = damping, frequency, rate
        self.place = self.speed = self.t = 0.0
        self.peak = 0.0
        self.memory = MODEL.initial_state()

    def wait(self, seconds, setpoint):
        for _ in range(max(1, round(seconds / STEP))):
            w = self.frequency
            self.speed += STEP * (w * w * (setpoint - self.place) - 2.0 * self.damping * w * self.speed)
            self.speed = min(max(self.speed, -self.rate), self.rate)
            self.place += STEP * self.speed
            self.peak = max(self.peak, self.place)
            self.memory = self.memory.step(self.place)
        self.t += seconds

    def read(self):
        return self.t, self.place, MODEL.value(self.memory)

    def reach(self, controller, target):
        """Return the error at a target and the time that it took."""
        command, started = controller.aim(target, *self.read()), self.t
        while not command.done:
            self.wait(command.wait, command.setpoint)
            command = controller.update(*self.read())
        self.wait(1.0, command.setpoint)
        return MODEL.value(self.memory) - target, self.t - started - 1.0


TARGETS = (LOW + (HIGH - LOW) * np.random.default_rng(4).uniform(0.1, 0.9, 30)).tolist()


def open_loop():
    return OpenLoopInverse(MODEL.inverse(), wait=8.0)


def closed_loop():
    numbers = CorrectionParameters.scaled(Spans.of(MODEL))
    return ClosedLoopInverse(
        MODEL.inverse(), parameters=CorrectionParameters(numbers.close_enough, 1.0, 0.3, Arrival(0.05))
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_in_open_loop_an_input_that_overshoots_does_as_well_as_one_that_does_not_once_it_is_known():
    errors = {}
    for damping in (0.95, 0.6):
        plate, controller = Plate(damping), open_loop()
        errors[damping] = [plate.reach(controller, target)[0] for target in TARGETS]
    assert rms(errors[0.6][10:]) < 0.02 * (HIGH - LOW)
    # What the first move costs, by which the overshoot is learned, is gone by then.
    assert rms(errors[0.6][10:]) < 0.3 * abs(errors[0.6][0])


def test_the_memory_follows_the_peak_of_an_input():
    plate, controller = Plate(0.5), open_loop()
    plate.reach(controller, 0.5 * (LOW + HIGH))
    last = plate.place
    assert plate.peak > last + 1.0
    # A reading each 8 s would not have seen it.
    outputs = [MODEL.value(state) for state in (controller.state, plate.memory)]
    assert outputs[0] == pytest.approx(outputs[1], abs=0.01 * (HIGH - LOW))


def test_closed_loop_takes_no_longer_and_is_as_good():
    found = {}
    for damping in (0.95, 0.6):
        plate, controller = Plate(damping), closed_loop()
        reached = [plate.reach(controller, target) for target in TARGETS][5:]
        found[damping] = rms([error for error, _ in reached]), np.mean([seconds for _, seconds in reached])
    assert found[0.6][0] < 5e-3 * (HIGH - LOW)
    assert found[0.6][1] < 1.2 * found[0.95][1]


def test_an_input_that_does_not_overshoot_is_sent_to_its_set_point_at_once():
    plate, controller = Plate(1.0), open_loop()
    for target in TARGETS[:5]:
        first = controller.aim(target, *plate.read())
        setpoints = {first.setpoint}
        command = first
        while not command.done:
            plate.wait(command.wait, command.setpoint)
            command = controller.update(*plate.read())
            setpoints.add(command.setpoint)
        assert setpoints == {first.setpoint}


def test_shares_are_learned_by_the_size_of_moves():
    overshoot = Overshoot(1.0)
    assert overshoot.share(10.0) == 0.0
    overshoot.learn(10.0, 0.1)
    assert overshoot.share(-11.0) == pytest.approx(0.1)
    overshoot.learn(80.0, 0.02)
    assert overshoot.share(70.0) == pytest.approx(0.02)
    assert overshoot.share(9.0) == pytest.approx(0.1)
    overshoot.learn(10.0, 0.2)
    assert overshoot.share(10.0) == pytest.approx(0.15)
    # Too small a move shows nothing, and is made at once; so is one whose overshoot is no matter.
    overshoot.learn(0.5, 0.4)
    assert overshoot.share(0.5) == 0.0
    other = Overshoot(1.0)
    other.learn(10.0, 0.9 * LEAST)
    assert other.share(10.0) == 0.0
    other.learn(20.0, -0.3)
    assert other.share(20.0) == 0.0
