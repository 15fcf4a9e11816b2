"""A controller that does not converge is given up."""

import math

import numpy as np
import pytest

from bench.control.supervision import TARGETS, Supervised
from bench.control.tracking import ClosedLoopInverse, Command, CorrectionParameters, OpenLoopInverse, Trace
from bench.control.tuning import Spans
from bench.errors import ConvergenceError
from bench.hysteresis import Preisach, Reach, uniform_levels

LIMITS = (0.0, 1.0)
MODEL = Preisach(uniform_levels(*LIMITS, 10), np.full(55, 2.0), 0.0, None, LIMITS)
LOW, HIGH = MODEL.output_range()


class Swinging:
    """Sends the actuator from one end to the other, as a gain far too high does."""

    trace, state, reach = Trace(), "its memory", Reach.MET
    _setpoint = 1.0

    def aim(self, *_):
        return self.update()

    def update(self, *_):
        self._setpoint = 1.0 - self._setpoint
        return Command(self._setpoint, 1.0)


class Specimen:
    """A specimen of another gain than the model, and of an offset."""

    def __init__(self, gain=1.0, offset=0.0):
        self.state, self.gain, self.offset, self.t = MODEL.initial_state(), gain, offset, 0.0

    def read(self):
        return self.t, self.state.input, self.gain * MODEL.value(self.state) + self.offset

    def reach(self, controller, target):
        command = controller.aim(target, *self.read())
        for _ in range(300):
            if command.done:
                break
            self.state, self.t = self.state.step(command.setpoint), self.t + command.wait
            command = controller.update(*self.read())
        return self.read()[2] - target


def closed_loop():
    numbers = CorrectionParameters.scaled(Spans.of(MODEL))
    return ClosedLoopInverse(MODEL.inverse(), parameters=numbers)


TARGETS_WITHIN = (LOW + (HIGH - LOW) * np.random.default_rng(3).uniform(0.2, 0.8, 12)).tolist()


def test_swings_from_end_to_end_end_the_run_with_what_to_do():
    controller = Supervised(Swinging(), LIMITS, 1.0)
    with pytest.raises(ConvergenceError, match=r"sent the actuator 4 times .* fallback=open-loop"):
        Specimen().reach(controller, 0.5)
    assert ConvergenceError.exit_code == 10


def test_the_open_loop_goes_on_from_the_memory_of_the_controller():
    memories = []

    def fallback(state):
        memories.append(state)
        return OpenLoopInverse(MODEL.inverse(), wait=1.0)

    controller, specimen = Supervised(Swinging(), LIMITS, 1.0, fallback), Specimen()
    middle = 0.5 * (LOW + HIGH)
    specimen.reach(controller, middle)
    assert memories == ["its memory"]
    assert controller.gave_up
    assert "goes on in open loop" in controller.take_notice()
    assert controller.take_notice() == ""
    assert abs(specimen.reach(controller, middle + 0.1 * (HIGH - LOW))) < 0.4 * (HIGH - LOW)


def test_a_controller_without_memory_has_no_fallback():
    class Forgetful(Swinging):
        state = None

    with pytest.raises(ConvergenceError, match="keeps no memory"):
        Specimen().reach(Supervised(Forgetful(), LIMITS, 1.0, lambda _: OpenLoopInverse(MODEL.inverse())), 0.5)


class Contrary(Swinging):
    """Stays away from its target by more than its model errs."""

    trace = Trace(disturbance=0.02)

    def aim(self, *_):
        return Command(0.0, 1.0, done=True)


@pytest.mark.parametrize("disturbance", [0.02, math.nan])
def test_errors_beyond_those_of_the_model_alone_over_several_targets(disturbance):
    inner = Contrary()
    inner.trace = Trace(disturbance=disturbance)
    controller = Supervised(inner, LIMITS, 1.0)
    for n in range(TARGETS):
        controller.aim(0.1, float(n), 0.0, 0.0)
    if math.isnan(disturbance):
        controller.aim(0.1, 9.0, 0.0, 0.0)
    else:
        with pytest.raises(ConvergenceError, match=r"error is 0\.1 RMS, and that of its model alone.* 0\.02"):
            controller.aim(0.1, 9.0, 0.0, 0.0)


def test_targets_that_cannot_be_met_do_not_count():
    inner = Contrary()
    inner.reach = Reach.TOO_HIGH
    controller = Supervised(inner, LIMITS, 1.0)
    for n in range(3 * TARGETS):
        controller.aim(0.1, float(n), 0.0, 0.0)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (1.0, 0.05), (1.3, 0.0), (0.7, 0.0)])
def test_a_controller_that_converges_is_left_alone(gain, offset):
    controller, specimen = Supervised(closed_loop(), LIMITS, HIGH - LOW), Specimen(gain, offset)
    errors = [specimen.reach(controller, gain * target + offset) for target in TARGETS_WITHIN]
    assert np.sqrt(np.mean(np.square(errors))) < 0.03 * (HIGH - LOW)
    assert not controller.gave_up
    assert controller.state.input == specimen.state.input
    assert controller.reach is Reach.MET
    assert controller.trace.reference == gain * TARGETS_WITHIN[-1] + offset


def test_a_controller_may_doubt_itself():
    inner = Contrary()
    inner.doubt = "its lock held nowhere"
    controller = Supervised(inner, LIMITS, 1.0)
    controller.aim(0.0, 0.0, 0.0, 0.0)
    with pytest.raises(ConvergenceError, match="its lock held nowhere"):
        controller.aim(0.0, 1.0, 0.0, 0.0)
