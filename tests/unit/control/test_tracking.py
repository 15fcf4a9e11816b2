"""Tracking controllers on the emulated VO2 film, and the rules that all of them keep."""

import math
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise, product

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.control import Spans, modulated_sine, tracking_targets, tuned, widened
from bench.control.baselines import IntegralControl, IntegralParameters, LookUp
from bench.control.following import ClosedLoopFollower, FollowingParameters, IntegralFollower, OpenLoopFollower
from bench.control.latched import Latched, LatchParameters, reversible_slope
from bench.control.tracking import Arrival, ClosedLoopInverse, CorrectionParameters, OpenLoopInverse
from bench.models import MemoryCurve, Polynomial, Preisach, PreisachInverse, Reach, uniform_levels

LOW, HIGH = 21.0, 84.0
NARROW = (45.0, 66.0)
TARGETS = ["open", "closed", "latched", "look-up", "integral"]
FOLLOWERS = ["open-follower", "closed-follower", "integral-follower"]
WITH_MEMORY = ["open", "closed", "latched", "open-follower", "closed-follower"]


# Numbers that suit the film, K, 1/m and s; the defaults are in proportion to the ranges of a model.
CORRECTION = CorrectionParameters(5.0, 3.0, 1.0, Arrival(0.03))
INTEGRAL = IntegralParameters(0.005, 0.5, 8.0)
# By hand, where they are not those of the model: wander and noise of the film and its sensor.
LATCH = LatchParameters(wander=0.03, noise=0.37, steepest=280.0, locked_slope=-4.0, farthest=1.0, rest=8.0)
NUMBERS = {
    "open": {"wait": 8.0},
    "look-up": {"wait": 8.0},
    "closed": {"parameters": CORRECTION},
    "latched": {"parameters": LATCH, "correction": replace(CORRECTION, corrections=9, close_enough=2.0)},
    "integral": {"parameters": INTEGRAL},
    "integral-follower": {"parameters": INTEGRAL},
    "open-follower": {"parameters": FollowingParameters(30.0, 1.0, lead=1.14)},
    "closed-follower": {"parameters": FollowingParameters(30.0, 1.0, lead=1.14)},
}


def make(name, models, limits=(LOW, HIGH), **options):
    options = NUMBERS.get(name, {}) | options
    inverse = PreisachInverse(models.film)
    makers = {
        "open": lambda: OpenLoopInverse(inverse, limits=limits, **options),
        "closed": lambda: ClosedLoopInverse(inverse, limits=limits, **options),
        "latched": lambda: Latched(inverse, limits=limits, **options),
        "look-up": lambda: LookUp(models.polynomial, limits=limits, **options),
        "integral": lambda: IntegralControl(limits, **options),
        "open-follower": lambda: OpenLoopFollower(inverse, limits=limits, **options),
        "closed-follower": lambda: ClosedLoopFollower(inverse, limits=limits, **options),
        "integral-follower": lambda: IntegralFollower(limits, **options),
    }
    return makers[name]()


def with_wide_loops(film):
    """Return a film without hysterons narrower than a cell: it is locked for at least that after a reversal."""
    row, column = np.tril_indices(film.order)
    density = np.where(row - column >= 2, film.density, 0.0)
    density *= (film.density @ film.cell_areas()) / (density @ film.cell_areas())
    return film.with_coefficients(np.concatenate([density, film.reversible.coefficients]), film.bias)


class IdealActuator:
    """The model itself with a lag in its input and a disturbance of its output."""

    def __init__(self, model, lag=0.5):
        self.model, self.lag, self.disturbance = model, lag, 0.0
        self.state = model.initial_state()
        self.t = 0.0

    def read(self):
        return self.state.input, self.model.value(self.state) + self.disturbance

    def carry_out(self, command):
        keep = math.exp(-command.wait / self.lag)
        self.state = self.state.step(command.setpoint + keep * (self.state.input - command.setpoint))
        self.t += command.wait

    def reach(self, controller, target, most=2000):
        command = controller.aim(target, self.t, *self.read())
        commands = [command]
        while not command.done and len(commands) < most:
            self.carry_out(command)
            command = controller.update(self.t, *self.read())
            commands.append(command)
        return commands


class ColderActuator(IdealActuator):
    """The same, whose input is above that of the specimen."""

    def __init__(self, model, colder):
        super().__init__(model)
        self.colder = colder

    def read(self):
        measured, output = super().read()
        return measured + self.colder, output

    def carry_out(self, command):
        super().carry_out(replace(command, setpoint=command.setpoint - self.colder))


class TestGoals:
    """What each controller reaches on a plant that is not of the model's structure."""

    SEEDS = (0, pytest.param(1, marks=pytest.mark.seeds))

    @staticmethod
    def run(laboratory, controller, seed):
        here = laboratory(seed)
        targets = tracking_targets(np.random.default_rng([8, seed]), -63.0, 1814.0, 60)
        results = np.array([here.reach(controller, target) for target in targets])
        errors = np.abs(results[:, 0])
        return errors.max(), math.sqrt(np.mean(errors**2)), np.median(errors), results[:, 1].mean()

    @pytest.mark.parametrize("seed", SEEDS)
    @pytest.mark.parametrize("policy", ["nearest", "paper"])
    def test_open_loop(self, models, laboratory, seed, policy):
        controller = OpenLoopInverse(PreisachInverse(models.film, policy), wait=8.0)
        greatest, rms, _, _ = self.run(laboratory, controller, seed)
        assert greatest <= 90.0
        assert rms <= 42.0

    @pytest.mark.parametrize("seed", SEEDS)
    def test_closed_loop(self, models, laboratory, seed):
        _, rms, _, seconds = self.run(laboratory, make("closed", models), seed)
        assert rms <= 8.0
        assert seconds <= 7.0

    @pytest.mark.parametrize("seed", SEEDS)
    def test_latched(self, models, laboratory, seed):
        greatest, rms, median, seconds = self.run(laboratory, make("latched", models), seed)
        assert greatest <= 15.0
        assert rms <= 2.0
        assert median <= 0.2
        assert seconds <= 16.0

    def test_latched_in_a_draughty_room(self, models, laboratory):
        here, controller = laboratory(3, wander_sd=0.06), make("latched", models)
        targets = tracking_targets(np.random.default_rng(3), -63.0, 1814.0, 40)
        errors = np.array([here.reach(controller, target)[0] for target in targets])
        assert math.sqrt(np.mean(errors**2)) <= 3.0

    def test_what_the_inverse_is_worth(self, models, laboratory):
        without = self.run(laboratory, make("integral", models), 0)[1]
        look_up = self.run(laboratory, make("look-up", models), 0)[1]
        inverse = self.run(laboratory, make("open", models), 0)[1]
        assert without > 1.5 * inverse
        assert look_up > 5.0 * inverse

    @pytest.mark.parametrize("seed", SEEDS)
    @pytest.mark.parametrize(("period", "limit"), [pytest.param(200.0, 5.0, marks=pytest.mark.seeds), (60.0, 8.0)])
    def test_closed_loop_follower(self, models, laboratory, seed, period, limit):
        times = np.arange(0.0, 4.0 * period, 0.5)
        reference = modulated_sine(times, 200.0, 1500.0, period)
        errors = laboratory(seed).follow(make("closed-follower", models), reference, 0.5)[20:]
        assert math.sqrt(np.mean(errors**2)) <= limit

    def test_followers_in_order(self, models, laboratory):
        reference = modulated_sine(np.arange(0.0, 240.0, 0.5), 200.0, 1500.0, 60.0)
        rms = [
            math.sqrt(np.mean(laboratory(1).follow(make(name, models), reference, 0.5)[20:] ** 2))
            for name in ("closed-follower", "open-follower", "integral-follower")
        ]
        assert rms[0] < 0.5 * rms[1]
        assert rms[1] < rms[2]


# What a broken sensor may say, often enough near the plausible.
readings = st.one_of(
    st.floats(20.0, 90.0),
    st.floats(-100.0, 1900.0),
    st.floats(),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 0.0, 21.0, 70.0, 84.0]),
)


class TestLimits:
    @pytest.mark.parametrize("limits", [NARROW, (0.0, 200.0)])
    @pytest.mark.parametrize("name", TARGETS)
    @settings(max_examples=20)
    @given(
        moves=st.lists(
            st.tuples(st.floats(-3e3, 3e3), st.lists(st.tuples(readings, readings), max_size=12)), max_size=4
        )
    )
    def test_no_setpoint_ever_leaves_them_whatever_the_readings(self, models, name, limits, moves):
        controller = make(name, models, limits)
        low, high = limits if name == "integral" else (max(limits[0], LOW), min(limits[1], HIGH))
        t = 0.0
        for target, pairs in moves:
            commands = [controller.aim(target, t, math.nan, 1.0)]
            for measured, output in pairs:
                t += commands[-1].wait
                commands.append(controller.update(t, measured, output))
            assert all(low <= command.setpoint <= high for command in commands)
            assert all(0.0 < command.wait <= 8.0 for command in commands)
            assert controller.trace.reference == target

    @pytest.mark.parametrize("name", FOLLOWERS)
    @settings(max_examples=20)
    @given(calls=st.lists(st.tuples(readings, readings, st.floats(-3e3, 3e3)), max_size=30))
    def test_nor_of_a_follower(self, models, name, calls):
        follower = make(name, models, NARROW)
        for n, (measured, output, reference) in enumerate(calls):
            assert NARROW[0] <= follower.update(0.5 * n, measured, output, reference) <= NARROW[1]

    @pytest.mark.parametrize("name", TARGETS + FOLLOWERS)
    def test_limits_without_overlap(self, models, name):
        with pytest.raises(ValueError, match="limits"):
            make(name, models, (60.0, 50.0))
        if not name.startswith("integral"):
            with pytest.raises(ValueError, match="limits: expected an overlap"):
                make(name, models, (100.0, 120.0))


class TestMemory:
    @pytest.mark.parametrize("name", WITH_MEMORY)
    @settings(max_examples=30)
    @given(
        measured=st.lists(st.floats(LOW, HIGH) | st.just(math.nan), min_size=1, max_size=40),
        output=st.floats(-90.0, 1800.0) | st.just(math.nan),
    )
    def test_is_moved_by_what_the_actuator_did(self, models, name, measured, output):
        controller = make(name, models)
        for n, value in enumerate(measured):
            if name in FOLLOWERS:
                controller.update(0.5 * n, value, output, 700.0)
            elif n == 0:
                controller.aim(700.0, 0.0, value, output)
            else:
                controller.update(0.5 * n, value, output)
        known = [value for value in measured if not math.isnan(value)]
        start = MemoryCurve.from_negative_saturation(LOW)
        assert controller.state == (start.advance(known) if known else start)

    @pytest.mark.parametrize("name", ["look-up", "integral", "integral-follower"])
    def test_is_not_kept_without_a_model_of_hysteresis(self, models, name):
        assert make(name, models).state is None

    def test_goes_on_from_a_given_state(self, models):
        state = MemoryCurve.from_positive_saturation(84.0).step(60.0)
        controller = ClosedLoopInverse(PreisachInverse(models.film), state)
        controller.aim(900.0, 0.0, 59.0, 1200.0)
        assert controller.state == state.step(59.0)

    @pytest.mark.parametrize("name", ["open", "closed", "latched"])
    def test_the_whole_run_is_repeatable(self, models, name, laboratory):
        results = []
        for _ in range(2):
            here, controller = laboratory(5), make(name, models)
            results.append([(here.reach(controller, target), controller.state) for target in (900.0, 1500.0, 400.0)])
        assert results[0] == results[1]


class TestMissingReadings:
    @pytest.mark.parametrize(
        ("name", "missing"),
        [
            *product(["closed", "latched", "integral"], [(math.nan, 500.0), (55.0, math.nan), (math.nan, math.nan)]),
            # Without a model there is no telling what is plausible.
            *product(["closed", "latched"], [(55.0, 1e9), (1e9, 500.0)]),
        ],
    )
    def test_hold_and_go_on_as_if_nothing_had_been(self, models, name, missing):
        """A gap in the readings delays the script, whatever it does then; it neither advances nor disturbs it."""

        def run(gap=None):
            controller = make(name, models)
            commands, measured = [controller.aim(900.0, 0.0, 21.0, 100.0)], 21.0
            for n in range(60):
                if n == gap:
                    before = commands[-1], controller.trace.disturbance
                    for _ in range(5):
                        held = controller.update(0.1 * n, *missing)
                        assert held.setpoint == before[0].setpoint
                        assert held.done == before[0].done
                        assert np.array_equal(controller.trace.disturbance, before[1], equal_nan=True)
                # The input arrives in a few readings, so that the script comes to the steps that use the output.
                measured += 0.8 * (commands[-1].setpoint - measured)
                commands.append(controller.update(0.1 * n, measured, 500.0 + 3.0 * n))
            return commands

        undisturbed = run()
        for gap in (1, 2, 3, 5, 8, 13, 21, 34, 55):
            assert run(gap) == undisturbed

    @pytest.mark.parametrize("name", TARGETS)
    def test_at_the_first_call_hold_where_the_actuator_is(self, models, name):
        controller = make(name, models)
        command = controller.aim(900.0, 0.0, math.nan, math.nan)
        assert not command.done
        assert command.setpoint == (LOW if name in WITH_MEMORY else 0.5 * (LOW + HIGH))
        moved = controller.update(0.1, 40.0, 100.0)
        assert moved.setpoint != command.setpoint

    def test_a_missing_output_leaves_a_follower_with_its_model(self, models):
        blind, seeing = make("closed-follower", models), make("closed-follower", models)
        state = models.film.initial_state()
        for n in range(20):
            state = state.step(21.0 + 2.0 * n)
            output = models.film.value(state) + 30.0
            for follower in (blind, seeing):
                follower.update(0.5 * n, state.input, output if follower is seeing or n < 10 else math.nan, 700.0)
        assert seeing.trace.disturbance == pytest.approx(30.0, abs=1e-6)
        assert blind.trace.disturbance == pytest.approx(30.0, abs=1e-6)
        assert blind.trace.uncertainty > 10.0 * seeing.trace.uncertainty

    @pytest.mark.parametrize("name", FOLLOWERS)
    def test_a_missing_input_holds_a_follower(self, models, name):
        follower = make(name, models)
        setpoint = follower.update(0.0, 50.0, 300.0, 700.0)
        assert follower.update(0.5, math.nan, 300.0, 900.0) == setpoint

    @pytest.mark.parametrize("name", TARGETS)
    def test_there_must_be_a_target(self, models, name):
        controller = make(name, models)
        with pytest.raises(RuntimeError, match="target first"):
            controller.update(0.0, 50.0, 300.0)
        with pytest.raises(ValueError, match="target"):
            controller.aim(math.nan, 0.0, 50.0, 300.0)
        with pytest.raises(ValueError, match="reference"):
            make("open-follower", models).update(0.0, 50.0, 300.0, math.nan)


class TestReach:
    @pytest.mark.parametrize("name", TARGETS)
    @pytest.mark.parametrize(("target", "reach"), [(3000.0, Reach.TOO_HIGH), (-500.0, Reach.TOO_LOW)])
    def test_unreachable_targets_are_clamped_and_flagged(self, models, name, target, reach):
        actuator = IdealActuator(models.film)
        controller = make(name, models)
        commands = actuator.reach(controller, target)
        assert commands[-1].done
        assert controller.reach is reach
        assert controller.trace.reference == target
        if name in ("open", "closed"):
            bound = models.film.output_range()[0 if reach is Reach.TOO_LOW else 1]
            assert actuator.read()[1] == pytest.approx(bound, abs=3.0)
        actuator.reach(controller, 900.0)
        assert controller.reach is Reach.MET

    @pytest.mark.parametrize("name", ["open", "closed"])
    def test_limits_that_cut_an_answer_off_are_flagged(self, models, name):
        controller = make(name, models, NARROW)
        actuator = IdealActuator(models.film)
        actuator.reach(controller, 1800.0)
        assert controller.reach is Reach.TOO_HIGH
        assert actuator.state.input == pytest.approx(NARROW[1], abs=0.05)

    @pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
    @pytest.mark.parametrize(
        ("beyond", "side", "reach"),
        [(1e-8, 1, Reach.TOO_HIGH), (1e-8, -1, Reach.TOO_LOW), (1e-10, 1, Reach.MET), (1e-10, -1, Reach.MET)],
    )
    def test_what_the_limits_leave_short_is_judged_by_the_range_of_the_output(
        self, models, unit, beyond, side, reach
    ):
        film = models.film.with_coefficients(unit * models.film.coefficients, unit * models.film.bias)
        low, high = film.output_range()
        state = film.saturated_state(-side, 20.0 if side > 0 else 84.0)
        limit = 60.0 if side > 0 else 45.0
        ends = (20.0, limit) if side > 0 else (limit, 84.0)
        controller = OpenLoopInverse(PreisachInverse(film), state, ends, wait=1.0)
        target = float(film.evaluate((limit,), state)[-1]) + side * beyond * (high - low)
        controller.aim(target, 0.0, film.present_input(state), film.value(state))
        assert controller.reach is reach

    @pytest.mark.parametrize("name", ["open", "closed"])
    def test_two_elements(self, models, name):
        """Above what the major descending branch ends in, the way is through saturation."""
        actuator = IdealActuator(models.film)
        controller = make(name, models)
        actuator.reach(controller, 500.0)
        target = models.film.output_range()[1] - 1.0
        found = PreisachInverse(models.film).invert(actuator.state, target)
        assert len(found.setpoints) == 2
        commands = actuator.reach(controller, target)
        setpoints = [a.setpoint for a, b in pairwise([*commands, commands[-1]]) if a.setpoint != b.setpoint or b is a]
        assert setpoints[0] == pytest.approx(found.setpoints[0])
        assert setpoints[-1] == pytest.approx(found.setpoints[1], abs=0.2)
        assert actuator.read()[1] == pytest.approx(target, abs=0.5)
        if name == "open":
            # It waits 8 s at each of them, and looks at the input meanwhile.
            assert sum(command.wait for command in commands if not command.done) == pytest.approx(16.0)
            assert max(command.wait for command in commands) <= 0.3
            assert [command.done for command in commands].index(True) == len(commands) - 1


class TestAntiWindup:
    def test_an_integrator_leaves_its_limit_at_once(self):
        controller = IntegralControl((LOW, HIGH), replace(INTEGRAL, duration=1e4))
        setpoints = [controller.aim(1e4, 0.0, 50.0, 0.0).setpoint]
        setpoints += [controller.update(n, 50.0, 0.0).setpoint for n in range(1000)]
        assert setpoints[-1] == HIGH
        assert controller.reach is Reach.TOO_HIGH
        assert controller.update(1001.0, 84.0, 1e4 + 100.0).setpoint == pytest.approx(HIGH - 0.5 * 0.005 * 100.0)

    def test_a_disturbance_is_measured_and_not_summed_up(self, models):
        patient = replace(CORRECTION, corrections=40)
        burdened, fresh = IdealActuator(models.film), IdealActuator(models.film)
        first, second = make("closed", models, parameters=patient), make("closed", models)
        burdened.reach(first, 5000.0)
        assert abs(first.trace.disturbance) < 1.0
        fresh.reach(second, models.film.output_range()[1])
        assert burdened.reach(first, 700.0)[0].setpoint == pytest.approx(
            fresh.reach(second, 700.0)[0].setpoint, abs=0.2
        )


class TestClosedLoop:
    @pytest.mark.parametrize("disturbance", [-40.0, 0.0, 25.0])
    def test_a_constant_disturbance_is_found_and_taken_away(self, models, disturbance):
        actuator, controller = IdealActuator(models.film), make("closed", models)
        actuator.disturbance = disturbance
        for target in (900.0, 1500.0, 300.0):
            actuator.reach(controller, target)
        assert controller.trace.disturbance == pytest.approx(disturbance, abs=0.01)
        assert controller.trace.predicted == pytest.approx(actuator.read()[1], abs=0.01)
        assert abs(300.0 - actuator.read()[1]) <= 5.0

    def test_waits_for_the_actuator(self, models):
        controller = make("closed", models)
        command = controller.aim(900.0, 0.0, 21.0, -3.0)
        setpoint, t = command.setpoint, 0.0
        for measured in (30.0, setpoint + 0.02, setpoint + 0.04, setpoint + 0.02, setpoint, setpoint, setpoint):
            t += command.wait
            command = controller.update(t, measured, 500.0)
            assert command.setpoint == setpoint
        t += command.wait
        assert controller.update(t, setpoint, 500.0).setpoint != setpoint

    def test_does_not_wait_for_ever(self, models):
        parameters = replace(CORRECTION, arrival=Arrival(0.03, patience=2.0))
        controller = make("closed", models, parameters=parameters)
        first = controller.aim(900.0, 0.0, 21.0, -3.0)
        commands = [controller.update(0.1 * n, 50.0, 500.0) for n in range(1, 25)]
        assert commands[18].setpoint == first.setpoint
        assert commands[-1].setpoint != first.setpoint

    def test_parameters(self):
        with pytest.raises(ValueError, match="tolerance"):
            Arrival(tolerance=0.0)
        with pytest.raises(ValueError, match="corrections"):
            replace(CORRECTION, corrections=-1)
        with pytest.raises(ValueError, match="walk_variance"):
            replace(CORRECTION, walk_variance=math.nan)
        with pytest.raises(ValueError, match="lead"):
            FollowingParameters(30.0, 1.0, lead=-1.0)
        with pytest.raises(ValueError, match="walk_variance: expected a positive number"):
            FollowingParameters(0.0, 1.0)


class TestLatched:
    @settings(max_examples=25)
    @given(
        target=st.floats(60.0, 1700.0),
        disturbances=st.lists(st.floats(-30.0, 30.0), min_size=1, max_size=20),
        every=st.integers(1, 40),
    )
    def test_the_fine_loop_never_leaves_the_locked_stretch(self, models, target, disturbances, every):
        p = LATCH
        actuator, controller = IdealActuator(models.film), make("latched", models)
        command = controller.aim(target, 0.0, *actuator.read())
        fine = 0
        for n in range(600):
            actuator.carry_out(command)
            actuator.disturbance = disturbances[(n // every) % len(disturbances)]
            command = controller.update(actuator.t, *actuator.read())
            if controller.extreme is not None:
                fine += 1
                behind = abs(controller.extreme - command.setpoint)
                assert p.nearest - 1e-9 <= behind <= p.farthest + 1e-9
                assert abs(controller.extreme - actuator.state.input) <= p.farthest + 1e-9
            if command.done:
                break
        assert controller.tries <= p.tries
        assert fine or not controller.locked

    @pytest.mark.parametrize("target", [100.0, 900.0, 1500.0])
    def test_locks_where_the_output_hardly_answers(self, models, target):
        model = with_wide_loops(models.film)
        actuator, controller = (
            IdealActuator(model),
            Latched(PreisachInverse(model), LatchParameters.of(model, 8.0)),
        )
        actuator.disturbance = 20.0
        actuator.reach(controller, target)
        assert controller.locked
        assert controller.tries <= 2
        assert actuator.read()[1] == pytest.approx(target, abs=0.05)
        slope = abs(reversible_slope(model, actuator.state.input))
        for wander in (0.05, -0.05):
            wandered = model.value(actuator.state.step(actuator.state.input + wander))
            assert wandered + actuator.disturbance == pytest.approx(target, abs=0.05 + 1.1 * 0.05 * slope)

    @pytest.mark.parametrize("colder", [0.1, 0.2, 0.3])
    def test_locks_near_saturation_where_the_model_is_saturated_before_the_target(self, models, colder):
        """A film that is colder than the plate has the target ahead where the model has none."""
        model = with_wide_loops(models.film)
        actuator = ColderActuator(model, colder)
        controller = Latched(PreisachInverse(model), LatchParameters.of(model, 8.0))
        target = model.evaluate((model.levels[0], model.levels[-1])).max() - 10.0
        actuator.reach(controller, target)
        assert controller.locked
        assert actuator.read()[1] == pytest.approx(target, abs=0.5)

    def test_an_actuator_that_does_not_lock_ends_in_the_fall_back(self, models):
        """The model's narrowest loops let go at once: the slope turns, the clamp holds, the tries end."""
        actuator, controller = IdealActuator(models.film), make("latched", models)
        commands = actuator.reach(controller, 900.0)
        assert commands[-1].done
        assert actuator.read()[1] == pytest.approx(900.0, abs=5.0)

    @pytest.mark.parametrize(("share", "tried"), [(2.0, True), (0.5, False)])
    def test_within_a_margin_of_saturation_it_does_not_try_to_lock(self, models, share, tried):
        film = models.film
        low, high = sorted(film.evaluate((film.levels[0], film.levels[-1])).tolist())
        margin = LATCH.creep_offset + LATCH.reserve
        for target in (low + share * margin, high - share * margin):
            controller = make("latched", models)
            assert (controller.tries, controller.locked, controller.extreme) == (0, False, None)
            controller.aim(target, 0.0, *IdealActuator(film).read())
            assert (controller.tries > 0) is tried

    def test_near_saturation_it_is_the_incremental_inverse(self, models):
        actuator, controller = IdealActuator(models.film), make("latched", models)
        for target in (models.film.output_range()[1] - 1.0, models.film.output_range()[0] + 1.0):
            actuator.reach(controller, target)
            assert not controller.locked
            assert controller.extreme is None
            assert actuator.read()[1] == pytest.approx(target, abs=3.0)

    def test_a_deaf_actuator_ends_in_the_fall_back(self, models):
        """An output that never answers: no lock, no endless search, no runaway."""
        controller, t = make("latched", models, NARROW), 0.0
        command = controller.aim(900.0, t, 50.0, 200.0)
        setpoint = 50.0
        while not command.done:
            t += command.wait
            setpoint = command.setpoint
            command = controller.update(t, setpoint, 200.0)
            assert t < 3000.0
        assert not controller.locked

    def test_it_is_doubted_when_its_lock_held_at_three_targets_in_a_row_nowhere(self, models):
        controller, t, setpoint = make("latched", models, NARROW), 0.0, 50.0
        for target in (900.0, 800.0, 1000.0):
            assert controller.doubt == ""
            command = controller.aim(target, t, setpoint, 200.0)
            while not command.done:
                t, setpoint = t + command.wait, command.setpoint
                command = controller.update(t, setpoint, 200.0)
        assert controller.doubt.startswith("its lock held at none of the last 3 targets after 10 approaches each")

    def test_the_parameters_leave_a_stretch_behind_the_extreme(self):
        with pytest.raises(ValueError, match="farthest"):
            replace(LATCH, wander=0.4)
        with pytest.raises(ValueError, match="locked_slope"):
            replace(LATCH, locked_slope=0.0)
        with pytest.raises(ValueError, match="noise"):
            replace(LATCH, noise=-1.0)

    def test_needs_a_reversible_part(self):
        levels = uniform_levels(0.0, 1.0, 4)
        with pytest.raises(ValueError, match="reversible"):
            Latched(PreisachInverse(Preisach(levels, np.ones(10))), LATCH)
        assert reversible_slope(Preisach(levels, np.ones(10)), 0.5) == 0.0

    def test_slope_behind_a_reversal(self, models):
        for value in (25.0, 50.0, 65.0, 80.0):
            state = models.film.initial_state().step(value)
            before, after = (models.film.value(s) for s in (state, state.step(value - 1e-3)))
            assert reversible_slope(models.film, value) == pytest.approx((before - after) / 1e-3, rel=1e-3)

    @given(
        inputs=st.lists(st.floats(LOW, HIGH), min_size=1, max_size=8),
        target=st.floats(-150.0, 1900.0),
        direction=st.sampled_from([-1, 1]),
    )
    def test_walk_finds_the_first_input(self, models, inputs, target, direction):
        state = models.film.initial_state().advance(inputs)
        found = PreisachInverse(models.film).first_input(state, target, direction)
        end = LOW if direction < 0 else HIGH
        last = end if found is None else found
        path = np.linspace(state.input, last, 2000)
        short = direction * (target - models.film.evaluate(path, state))
        if found == state.input:
            assert short[0] <= 1e-6
        else:
            assert short.min() > -1e-6
        if found is not None and found != state.input:
            assert direction * (found - state.input) > 0.0
            assert short[-1] == pytest.approx(0.0, abs=1e-6)


class TestLookUp:
    def test_is_the_inverse_on_a_monotone_polynomial(self):
        line = Polynomial([10.0], (0.0, 4.0), 20.0)
        controller = LookUp(line, wait=8.0)
        for target in (10.0, 13.0, 30.0):
            assert controller.aim(target, 0.0, 1.0, 0.0).setpoint == pytest.approx((target - 10.0) / 5.0)
            assert controller.reach is Reach.MET
        for target, setpoint, reach in ((31.0, 4.0, Reach.TOO_HIGH), (9.0, 0.0, Reach.TOO_LOW)):
            assert controller.aim(target, 0.0, 1.0, 0.0).setpoint == setpoint
            assert controller.reach is reach

    def test_is_single_valued_where_the_polynomial_is_not(self, models):
        controller = LookUp(models.polynomial, wait=8.0)
        low, high = models.polynomial.output_range()
        targets = np.linspace(low, high, 300)
        setpoints = np.array([controller.aim(float(target), 0.0, 50.0, 0.0).setpoint for target in targets])
        assert (np.diff(setpoints) >= 0.0).all()
        assert models.polynomial.evaluate(setpoints) == pytest.approx(targets, abs=3.0)

    def test_wrong_arguments(self, models):
        with pytest.raises(ValueError, match="points"):
            LookUp(models.polynomial, wait=8.0, points=1)
        with pytest.raises(ValueError, match="wait"):
            LookUp(models.polynomial, wait=0.0)
        with pytest.raises(ValueError, match="wait"):
            OpenLoopInverse(PreisachInverse(models.film), wait=math.inf)
        with pytest.raises(ValueError, match="gain"):
            IntegralParameters(gain=0.0, period=0.5, duration=8.0)


class TestTrace:
    @pytest.mark.parametrize("name", TARGETS)
    def test_opinions(self, models, name):
        controller = make(name, models)
        controller.aim(900.0, 0.0, 50.0, 300.0)
        trace = controller.trace
        assert trace.reference == 900.0
        assert math.isnan(trace.disturbance) == (name not in ("closed", "latched"))
        assert math.isnan(trace.uncertainty) == (name not in ("closed", "latched"))
        assert math.isnan(trace.predicted) == (name == "integral")

    def test_of_the_open_loop_is_the_model(self, models):
        controller = make("open", models)
        controller.aim(900.0, 0.0, 50.0, 300.0)
        assert controller.trace.predicted == models.film.value(controller.state)


class TestTuning:
    """Defaults in proportion to the ranges of a model, and what a rig puts in their place."""

    spans = Spans(63.0, 1900.0)

    @cases(
        "scaled",
        [
            *(each.scaled for each in (CorrectionParameters, FollowingParameters, Arrival)),
            partial(IntegralParameters.scaled, dwell=8.0),
        ],
    )
    def test_other_units_of_the_same_model_change_nothing_but_the_units(self, scaled):
        """In mK and 1/mm every number with a unit changes by its unit's factor, every other not at all."""
        here, there = asdict(scaled(self.spans)), asdict(scaled(Spans(63e3, 1.9)))
        factors = {1.0, 1e3, 1e-3, 1e-6, 1e6}
        for name, value in here.items():
            pair = (value["tolerance"], there[name]["tolerance"]) if isinstance(value, dict) else (value, there[name])
            assert any(pair[1] == pytest.approx(factor * pair[0]) for factor in factors), name

    def test_an_actuator_that_takes_ten_times_as_long_has_ten_times_as_long(self):
        fast, slow = (IntegralParameters.scaled(self.spans, dwell) for dwell in (8.0, 80.0))
        assert (slow.period, slow.duration) == (10.0 * fast.period, 10.0 * fast.duration)
        assert slow.gain == pytest.approx(fast.gain / 10.0)

    def test_some_numbers_are_replaced_also_within(self):
        changed = tuned(CORRECTION, {"close_enough": 2, "arrival": {"tolerance": 0.5}})
        assert changed == replace(CORRECTION, close_enough=2, arrival=replace(CORRECTION.arrival, tolerance=0.5))

    @cases(
        ("options", "words"),
        [
            ({"closenough": 1.0}, "closenough: there is no such number; did you mean close_enough?"),
            ({"close_enough": "near"}, "close_enough = 'near': expected a number"),
            ({"close_enough": -1.0}, "close_enough: expected a positive number"),
            ({"arrival": 3.0}, "arrival"),
        ],
    )
    def test_nonsense_is_refused(self, options, words):
        with pytest.raises((ValueError, TypeError), match=words):
            tuned(CORRECTION, options)


def test_what_is_plausible_is_a_range_with_its_own_width_at_both_ends(models):
    assert widened(1.0, 3.0) == (-1.0, 5.0)
    low, high = models.film.input_range
    for name in ("open", "open-follower"):
        for measured, taken in ((2.0 * low - high, True), (2.0 * high - low, True), (2.0 * low - high - 1e-6, False)):
            controller = make(name, models)
            before = controller.state.input
            if name == "open":
                controller.aim(900.0, 0.0, measured, 500.0)
            else:
                controller.update(0.0, measured, 500.0, 900.0)
            assert (controller.state.input == before) is not taken
