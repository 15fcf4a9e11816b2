"""A controller that does not converge is given up."""

import math

import numpy as np
import pytest
from cases import cases

from bench.base import ConvergenceError
from bench.control import Command, Spans, Supervised, SupervisedFollower, Trace
from bench.control.following import ClosedLoopFollower, OpenLoopFollower
from bench.control.supervision import SAMPLES, TARGETS
from bench.control.tracking import ClosedLoopInverse, CorrectionParameters, OpenLoopInverse
from bench.models import Preisach, Reach, uniform_levels

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
        Specimen().reach(Supervised(Forgetful(), LIMITS, 1.0, lambda _: pytest.fail("there is a memory")), 0.5)


class Contrary(Swinging):
    """Stays away from its target by more than its model errs."""

    trace = Trace(disturbance=0.02)

    def aim(self, *_):
        return Command(0.0, 1.0, done=True)


def judged(error, disturbance, fallback=None):
    """Have a controller miss several targets, in parts of the range; return its supervision."""
    inner = Contrary()
    inner.trace = Trace(disturbance=disturbance)
    controller = Supervised(inner, LIMITS, 1.0, fallback)
    for n in range(TARGETS + 1):
        controller.aim(error, float(n), 0.0, 0.0)
    return controller


@cases(
    ("disturbance", "said"),
    [
        (0.02, r"error but for the greatest is 0\.1 RMS, 10 % of the range, and that of its model alone.* 0\.02;"),
        (math.nan, r"10 % of the"),
    ],
)
def test_errors_beyond_three_percent_over_several_targets_end_the_run(disturbance, said):
    with pytest.raises(ConvergenceError, match=said):
        judged(0.1, disturbance)


@cases(("error", "notice"), [(0.003, ""), (0.015, "1.5 % of the range")])
def test_an_error_that_is_left_is_said_once(error, notice):
    controller = judged(error, 0.02)
    found = controller.take_notice()
    assert (notice in found) if notice else not found
    controller.aim(error, 9.0, 0.0, 0.0)
    assert not controller.take_notice()


def test_the_open_loop_goes_on_only_where_it_would_have_been_better():
    def fallback(state):
        return OpenLoopInverse(MODEL.inverse(), wait=1.0)

    assert judged(0.1, 0.02, fallback).gave_up
    kept = judged(0.1, 0.08, fallback)
    assert not kept.gave_up
    assert "leaves an error" in kept.take_notice()


def missing(errors, disturbance=0.02, **options):
    """Have a controller err at target after target, in parts of the range; return its supervision."""
    inner = Contrary()
    inner.trace = Trace(disturbance=disturbance)
    controller = Supervised(inner, LIMITS, 1.0, **options)
    for n, error in enumerate([*errors, 0.0]):
        controller.aim(error, float(n), 0.0, 0.0)
    return controller


@cases("options", [{}, {"holds": 0.03}])
def test_one_missed_target_of_five_is_warned_of_and_two_end_the_run(options):
    controller = missing([0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0], **options)
    assert "error is 0.134 RMS" in controller.take_notice()
    with pytest.raises(ConvergenceError, match=r"over 5 targets its error but for the greatest is 0\.15 RMS"):
        missing([0.0, 0.3, 0.0, 0.3, 0.0], **options)


def verdict(error, disturbance, **options):
    try:
        return "warned of" if missing([error] * TARGETS, disturbance, **options).take_notice() else "borne"
    except ConvergenceError:
        return "the end"


@cases(
    ("disturbance", "options", "borne", "warned_of", "the_end"),
    [
        (0.0, {}, 0.003, 0.014, 0.05),
        # By less than its model alone; of an open loop, by as much as its model may err.
        (0.1, {}, 0.003, 0.025, 0.3),
        (math.nan, {"holds": 0.1}, 0.03, 0.08, 0.2),
    ],
)
def test_small_errors_are_borne_larger_ones_warned_of_and_great_ones_are_the_end(
    disturbance, options, borne, warned_of, the_end
):
    assert verdict(borne, disturbance, **options) == "borne"
    assert verdict(warned_of, disturbance, **options) == "warned of"
    assert verdict(the_end, disturbance, **options) == "the end"


def test_a_specimen_that_changes_is_noticed_at_the_second_target_that_is_missed():
    steady = [0.0] * 10
    missing([*steady, 0.1])
    with pytest.raises(ConvergenceError):
        missing([*steady, 0.1, 0.1])


def test_targets_that_cannot_be_met_do_not_count():
    inner = Contrary()
    inner.reach = Reach.TOO_HIGH
    controller = Supervised(inner, LIMITS, 1.0)
    for n in range(3 * TARGETS):
        controller.aim(0.1, float(n), 0.0, 0.0)
    assert controller.take_notice() == "the target 0.1 cannot be met within the limits: missed by 10 % of the range"


@cases(("error", "options"), [(0.01, {}), (0.1, {"holds": 0.03})])
def test_a_target_that_is_nearly_met_or_by_an_open_loop_is_not_named(error, options):
    inner = Contrary()
    inner.reach = Reach.TOO_LOW
    controller = Supervised(inner, LIMITS, 1.0, **options)
    for n in range(2):
        controller.aim(error, float(n), 0.0, 0.0)
    assert not controller.take_notice()


def test_the_warning_of_an_open_loop_says_so():
    notice = missing([0.09] * TARGETS, holds=0.12).take_notice()
    assert notice.startswith("the open loop errs: over 5 targets")


@cases(("gain", "offset"), [(1.0, 0.0), (1.0, 0.05), (1.3, 0.0), (0.7, 0.0)])
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


def opened(offset, *, holds=0.1, fallback=None):
    """Return the errors of an open loop on a specimen of an offset, in parts of the range, and its supervision."""
    span = HIGH - LOW
    inner = OpenLoopInverse(MODEL.inverse(), wait=1.0)
    controller = Supervised(inner, LIMITS, span, fallback, holds=holds * span)
    specimen = Specimen(offset=offset * span)
    return [specimen.reach(controller, target) / span for target in TARGETS_WITHIN], controller


def test_an_open_loop_whose_model_does_not_hold_is_stopped_with_what_to_do():
    with pytest.raises(ConvergenceError, match=r"the model does not hold .* over 5 targets .* adaptation=session"):
        opened(0.15)


def test_an_open_loop_whose_model_holds_is_left_alone():
    errors, controller = opened(0.05)
    assert max(map(abs, errors)) > 0.03
    assert not controller.gave_up


def test_an_open_loop_goes_on_where_that_is_asked_for():
    errors, controller = opened(0.15, fallback=lambda state: OpenLoopInverse(MODEL.inverse(), state, wait=1.0))
    assert len(errors) == len(TARGETS_WITHIN)
    assert controller.gave_up
    assert "the model does not hold" in controller.take_notice()


PERIOD = 0.5


def follow(follower, specimen, seconds, *, high=0.8):
    """Follow a sine; return the RMS error in parts of the range."""
    errors = []
    for k in range(round(seconds / PERIOD)):
        wanted = LOW + (HIGH - LOW) * (0.5 - 0.3 * math.cos(2.0 * math.pi * k * PERIOD / 60.0)) * high / 0.8
        t, measured, output = specimen.read()
        specimen.state = specimen.state.step(follower.update(t, measured, output, wanted))
        specimen.t += PERIOD
        errors.append((specimen.read()[2] - wanted) / (HIGH - LOW))
    return math.sqrt(sum(error**2 for error in errors) / len(errors))


def supervised_follower(inner, *, holds=math.nan, fallback=None):
    return SupervisedFollower(inner, LIMITS, HIGH - LOW, fallback, holds=holds * (HIGH - LOW))


@cases("offset", [0.0, 0.05])
def test_a_follower_that_follows_is_left_alone(offset):
    span = HIGH - LOW
    controller = supervised_follower(ClosedLoopFollower(MODEL.inverse()))
    assert follow(controller, Specimen(offset=offset * span), 300.0) < 0.06
    assert not controller.gave_up
    controller = supervised_follower(OpenLoopFollower(MODEL.inverse()), holds=0.1)
    follow(controller, Specimen(offset=offset * span), 300.0)
    assert not controller.gave_up


def test_an_open_loop_follower_whose_model_does_not_hold_is_stopped():
    specimen = Specimen(offset=0.2 * (HIGH - LOW))
    with pytest.raises(ConvergenceError, match=r"the model does not hold .* over 200 samples"):
        follow(supervised_follower(OpenLoopFollower(MODEL.inverse()), holds=0.1), specimen, 300.0)


class Runaway(ClosedLoopFollower):
    """Corrects twice as far as it should, and the wrong way."""

    def _inverted(self, step, disturbance):
        return super()._inverted(step, -2.0 * disturbance)


def test_a_follower_that_errs_by_more_than_its_model_is_stopped_or_replaced():
    offset = 0.1 * (HIGH - LOW)
    with pytest.raises(ConvergenceError, match=r"does not converge: over 200 samples .* without feedback"):
        follow(supervised_follower(Runaway(MODEL.inverse())), Specimen(offset=offset), 300.0)
    replaced = supervised_follower(
        Runaway(MODEL.inverse()), fallback=lambda state: OpenLoopFollower(MODEL.inverse(), state)
    )
    specimen = Specimen(offset=offset)
    follow(replaced, specimen, 300.0)
    assert replaced.gave_up
    assert follow(replaced, specimen, 300.0) < 0.15


class Erring:
    """A follower that is off by what its test says."""

    state, reach = None, Reach.MET

    def __init__(self, disturbance):
        self.trace = Trace(disturbance=disturbance)

    def update(self, *_):
        return 0.0


def verdict_of_samples(error, disturbance, samples=SAMPLES, **options):
    """Return what becomes of a follower that errs at so many samples of a reference that moves at every second."""
    controller = SupervisedFollower(Erring(disturbance), LIMITS, 1.0, **options)
    reference = math.nan
    try:
        for k in range(2 * samples):
            # What the output does while the reference stands does not count.
            output, reference = (9.0, reference) if k % 2 else (reference + error, float(k % 4 == 0))
            controller.update(float(k), 0.5, output, reference)
        controller.update(math.nan, 0.5, reference + error, 0.5)
    except ConvergenceError:
        return "the end"
    return "warned of" if controller.take_notice() else "borne"


@cases(
    ("disturbance", "options", "borne", "warned_of", "the_end"),
    [
        (0.0, {}, 0.003, 0.014, 0.05),
        (0.05, {}, 0.003, 0.05, 0.3),
        (math.nan, {"holds": 0.05}, 0.03, 0.067, 0.15),
    ],
)
def test_so_are_those_of_a_follower(disturbance, options, borne, warned_of, the_end):
    assert verdict_of_samples(borne, disturbance, **options) == "borne"
    assert verdict_of_samples(warned_of, disturbance, **options) == "warned of"
    assert verdict_of_samples(the_end, disturbance, **options) == "the end"
    # Too few to judge by.
    assert verdict_of_samples(1.0, disturbance, SAMPLES // 2, **options) == "borne"


def test_a_follower_whose_model_errs_as_much_is_only_warned_of():
    assert verdict_of_samples(0.5, 0.5) == "warned of"


def test_a_follower_that_foresees_goes_on_doing_so_and_others_need_not():
    class Foreseer(OpenLoopFollower):
        horizon = 3
        seen = None

        def foresee(self, references):
            self.seen = references

    inner = Foreseer(MODEL.inverse())
    controller = supervised_follower(inner)
    assert controller.horizon == 3
    controller.foresee(np.arange(3.0))
    assert inner.seen.tolist() == [0.0, 1.0, 2.0]
    assert supervised_follower(OpenLoopFollower(MODEL.inverse())).horizon == 0
