"""A controller that does not converge is given up."""

import math

import numpy as np
import pytest
from cases import cases

from bench.base import ConvergenceError
from bench.control import Command, Rules, Spans, Supervised, SupervisedFollower, Trace
from bench.control.following import ClosedLoopFollower, OpenLoopFollower
from bench.control.tracking import ClosedLoopInverse, CorrectionParameters, OpenLoopInverse
from bench.models import Preisach, Reach, uniform_levels

LIMITS = (0.0, 1.0)
RULES = Rules(allowed=0.02)
OPEN = Rules(allowed=0.02, feedback=False)
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
    controller = Supervised(Swinging(), LIMITS, RULES)
    with pytest.raises(ConvergenceError, match=r"sent the actuator 4 times .* fallback=open-loop"):
        Specimen().reach(controller, 0.5)
    assert ConvergenceError.exit_code == 10


def test_the_open_loop_goes_on_from_the_memory_of_the_controller():
    memories = []

    def fallback(state):
        memories.append(state)
        return OpenLoopInverse(MODEL.inverse(), wait=1.0)

    controller, specimen = Supervised(Swinging(), LIMITS, RULES, fallback), Specimen()
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
        Specimen().reach(Supervised(Forgetful(), LIMITS, RULES, lambda _: pytest.fail("there is a memory")), 0.5)


class Contrary(Swinging):
    """Stays away from its target by more than its model errs."""

    def aim(self, *_):
        return Command(0.0, 1.0, done=True)


def missing(errors, alone=0.02, rules=RULES, fallback=None, **kept):
    """Have a controller err at target after target, in parts of the range; return its supervision."""
    inner = Contrary()
    inner.trace = Trace(disturbance=alone)
    vars(inner).update(kept)
    controller = Supervised(inner, LIMITS, rules, fallback)
    for n, error in enumerate([*errors, 0.0]):
        controller.aim(error, float(n), 0.0, 0.0)
    return controller


def verdict(errors, *args, **kept):
    try:
        controller = missing(errors, *args, **kept)
    except ConvergenceError:
        return "the end"
    if controller.gave_up:
        return "open loop"
    return "warned of" if controller.take_notice() else "borne"


@cases(
    ("errors", "alone", "rules", "expected"),
    [
        ([0.009] * 5, 0.0, RULES, "borne"),
        # Worse than its model, or beyond what is allowed, or neither and not within it for certain.
        ([0.015] * 5, 0.005, RULES, "the end"),
        ([0.04] * 5, 0.1, RULES, "the end"),
        ([0.04] * 5, math.nan, RULES, "the end"),
        ([0.015] * 5, 0.01, RULES, "warned of"),
        ([0.015] * 5, math.nan, RULES, "warned of"),
        # A model is as good as what is allowed, or not.
        ([0.019] * 5, math.nan, OPEN, "borne"),
        ([0.025] * 5, math.nan, OPEN, "warned of"),
        ([0.04] * 5, math.nan, OPEN, "the end"),
        # One missed target of five ends no run, two do, as soon as the second is missed.
        ([0.0] * 9 + [0.3] + [0.0] * 9, 0.0, RULES, "warned of"),
        ([0.0] * 9 + [0.3, 0.0, 0.3], 0.1, RULES, "the end"),
        ([0.0] * 9 + [0.3, 0.0, 0.3], math.nan, OPEN, "the end"),
        # What the rig file says is what counts.
        ([0.04] * 5, 0.1, Rules(allowed=0.05), "warned of"),
        ([0.3] * 5, 0.1, Rules(allowed=0.02, targets=6), "borne"),
        ([0.029] * 5, 0.012, Rules(allowed=0.02, quantile=0.99), "warned of"),
        ([0.3] * 5, 0.0, Rules(allowed=0.02, judges=False), "borne"),
        ([math.nan] * 9, 0.0, RULES, "borne"),
    ],
)
def test_errors_are_borne_warned_of_or_the_end(errors, alone, rules, expected):
    assert verdict(errors, alone, rules) == expected


def opened(state):
    return OpenLoopInverse(MODEL.inverse(), wait=1.0)


def test_the_open_loop_goes_on_only_where_it_would_have_been_better():
    assert verdict([0.1] * 5, 0.02, fallback=opened) == "open loop"
    assert verdict([0.1] * 5, 0.08, fallback=opened) == "warned of"
    assert verdict([0.1] * 5, math.nan, OPEN, opened) == "open loop"


def test_a_warning_says_error_and_allowed_error_and_is_given_once():
    controller = missing([0.015] * 5)
    assert "0.015 RMS" in (notice := controller.take_notice())
    assert "allowed is 0.02" in notice
    controller.aim(0.015, 9.0, 0.0, 0.0)
    assert not controller.take_notice()


@cases(("error", "rules", "said"), [(0.1, RULES, "target 0.1 cannot be met"), (0.009, RULES, ""), (0.1, OPEN, "")])
def test_targets_that_cannot_be_met_do_not_count_but_one_that_is_missed_far_is_named(error, rules, said):
    notice = missing([error] * 9, rules=rules, reach=Reach.TOO_HIGH).take_notice()
    assert (said in notice) if said else not notice


def test_a_controller_may_doubt_itself():
    with pytest.raises(ConvergenceError, match="its lock held nowhere"):
        missing([0.0], doubt="its lock held nowhere")


@cases(("gain", "offset"), [(1.0, 0.0), (1.0, 0.05), (1.3, 0.0), (0.7, 0.0)])
def test_a_controller_that_converges_is_left_alone(gain, offset):
    rules = Rules(allowed=0.02 * (HIGH - LOW))
    controller, specimen = Supervised(closed_loop(), LIMITS, rules), Specimen(gain, offset)
    for target in TARGETS_WITHIN:
        specimen.reach(controller, gain * target + offset)
    assert not controller.gave_up
    assert controller.state.input == specimen.state.input
    assert controller.reach is Reach.MET
    assert controller.trace.reference == gain * TARGETS_WITHIN[-1] + offset


def test_an_open_loop_whose_model_does_not_hold_is_stopped_with_what_to_do():
    rules, span = Rules(allowed=0.06 * (HIGH - LOW), feedback=False), HIGH - LOW
    controller, specimen = Supervised(opened(None), LIMITS, rules), Specimen(offset=0.05 * span)
    for target in TARGETS_WITHIN:
        specimen.reach(controller, target)
    controller, specimen = Supervised(opened(None), LIMITS, rules), Specimen(offset=0.15 * span)
    with pytest.raises(ConvergenceError, match=r"the model does not hold .* adaptation=session"):  # noqa: PT012
        for target in TARGETS_WITHIN:
            specimen.reach(controller, target)


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


def supervised_follower(inner, *, allowed=0.03, fallback=None, **kept):
    return SupervisedFollower(inner, 16, Rules(allowed=allowed * (HIGH - LOW), **kept), fallback)


@cases("offset", [0.0, 0.05])
def test_a_follower_that_follows_is_left_alone(offset):
    specimen = Specimen(offset=offset * (HIGH - LOW))
    controller = supervised_follower(ClosedLoopFollower(MODEL.inverse()), allowed=0.12)
    assert follow(controller, specimen, 300.0) < 0.06
    assert not controller.gave_up


def test_an_open_loop_follower_whose_model_does_not_hold_is_stopped():
    specimen = Specimen(offset=0.2 * (HIGH - LOW))
    with pytest.raises(ConvergenceError, match="the model does not hold"):
        follow(supervised_follower(OpenLoopFollower(MODEL.inverse()), allowed=0.1, feedback=False), specimen, 300.0)


class Runaway(ClosedLoopFollower):
    """Corrects twice as far as it should, and the wrong way."""

    def _inverted(self, step, disturbance):
        return super()._inverted(step, -2.0 * disturbance)


def test_a_follower_that_errs_by_more_than_its_model_is_stopped_or_replaced():
    offset = 0.1 * (HIGH - LOW)
    with pytest.raises(ConvergenceError, match=r"does not converge: .* without feedback"):
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


def verdict_of_samples(error, disturbance, samples, rules=RULES):
    """Return what becomes of a follower that errs at so many samples of a reference that moves at every second."""
    controller = SupervisedFollower(Erring(disturbance), 4, rules)
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
    ("error", "alone", "samples", "rules", "expected"),
    [
        (0.009, 0.0, 20, RULES, "borne"),
        (0.015, 0.01, 20, RULES, "warned of"),
        (0.015, 0.005, 20, RULES, "the end"),
        (0.04, math.nan, 20, OPEN, "the end"),
        # Five stretches of four samples are not complete.
        (0.5, 0.0, 19, RULES, "borne"),
    ],
)
def test_stretches_of_a_moving_reference_are_judged_as_targets_are(error, alone, samples, rules, expected):
    assert verdict_of_samples(error, alone, samples, rules) == expected


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
