"""Controllers of the wire's length and force: the thermal lag, the bookkeeping, and how well they do on the plant."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import cases

from bench.base import ConfigurationError, DataError
from bench.control import ControllerSetup, ReachTarget
from bench.identification import ModelFile, Series, identify_first_stage, identify_second_stage, voltage_steps
from bench.models import IdentifiedDynamics, Preisach, Reach, ResponseDynamics, SeenInput, TwoStage, uniform_levels
from rigs.muscles.control import (
    FORCE_OPEN_LOOP,
    LENGTH_CLOSED_LOOP,
    InverseControlParameters,
    LagSearch,
    MuscleClosedLoop,
    MuscleOpenLoop,
    MuscleProportionalIntegral,
    ProportionalIntegralParameters,
)
from rigs.muscles.tasks import ForceTask, LengthTask
from rigs.muscles.two_stage_inverse import TwoStageInverse
from sim_devices.plants.sma import SMAParameters, SMAWire

MILLIMETRE = 1e-3
LIMITS = (0.0, 3.0)
LOADS = (0.98, 2.94, 4.90, 6.86, 8.82)
HELD = (0.0, 0.6, 1.2, 1.8, 2.4, 3.0)
FORCES = np.concatenate([np.linspace(0.0, 10.5, 12), np.linspace(10.5, 0.0, 12)[1:]])
VOLTAGES = voltage_steps()


class Wire:
    """The plant with its sensors: length 0.01 mm rms, then rounded to 0.04 mm; force 0.02 N rms."""

    def __init__(self, seed, **parameters):
        self.rng = np.random.default_rng([7, seed])
        self.plant = SMAWire(SMAParameters(**parameters), self.rng)
        self.t = 0.0

    def wait(self, seconds):
        self.plant.advance(seconds)
        self.t += seconds

    def set(self, voltage, seconds=30.0):
        self.plant.apply(voltage)
        self.wait(seconds)

    def load(self, newton, seconds=30.0):
        self.plant.hang(newton)
        self.wait(seconds)

    def reset(self):
        self.plant.hang(0.3)
        self.set(3.0, 60.0)
        self.set(0.0, 60.0)

    def fix(self):
        """Fix the ends of the wire where it has the pretension, as it was conditioned."""
        self.load(0.3)
        self.plant.clamp(self.plant.position)

    def length(self):
        step = 0.04 * MILLIMETRE
        return step * round((self.plant.position + 0.01 * MILLIMETRE * self.rng.standard_normal()) / step)

    def force(self):
        return self.plant.force + 0.02 * self.rng.standard_normal()


class Bench:
    """A wire at one task: the length under a load, or the force between fixed ends if there is none."""

    def __init__(self, seed, load=None, **parameters):
        self.wire = Wire(100 + seed, ambient_sd=0.3, **parameters)
        self.is_length = load is not None
        if self.is_length:
            self.wire.reset()
            self.wire.load(load)
        else:
            self.wire.fix()

    @property
    def truth(self):
        return self.wire.plant.position if self.is_length else self.wire.plant.force

    def output(self):
        return self.wire.length() if self.is_length else self.wire.force()

    def read(self):
        others = (self.wire.force(),) if self.is_length else ()
        return self.wire.t, self.wire.plant.voltage, self.output(), *others

    def reach(self, controller, target, duration=20.0, load=None):
        """Return the errors after 10 s and at the end, the latter by the mean of ten readings.

        A load, if given, is hung on after 10 s.
        """
        loop, start, halfway = ReachTarget(controller, target), self.wire.t, math.nan
        command = loop.begin(*self.read())
        while not command.done:
            assert LIMITS[0] <= command.setpoint <= LIMITS[1]
            self.wire.set(command.setpoint, command.wait)
            if math.isnan(halfway) and self.wire.t - start >= 10.0 - 1e-6:
                halfway = target - self.truth
                if load is not None:
                    self.wire.plant.hang(load)
            command = loop.update(*self.read())
        assert self.wire.t - start == pytest.approx(duration)
        outputs = []
        for _ in range(10):
            outputs.append(self.output())
            self.wire.wait(0.1)
        return halfway, target - np.mean(outputs)


@pytest.fixture(scope="module")
def inverse():
    """Identify the plant once: force over voltage between fixed ends, lengths under loads and at voltages."""
    wire = Wire(1)
    wire.fix()
    forces = []
    for voltage in VOLTAGES:
        wire.set(voltage)
        forces.append(wire.force())
    series = []
    for load in LOADS:
        wire.reset()
        wire.plant.hang(load)
        lengths = []
        for voltage in VOLTAGES:
            wire.set(voltage)
            lengths.append(wire.length())
        series.append(Series.under_load(load, VOLTAGES, lengths))
    for voltage in HELD:
        wire.reset()
        wire.load(0.0)
        wire.set(voltage)
        lengths = []
        for force in FORCES:
            wire.load(force)
            lengths.append(wire.length())
        series.append(Series.at_voltage(voltage, FORCES, lengths))
    first = identify_first_stage(VOLTAGES, forces, units=("V", "N", "m"))
    return TwoStageInverse(identify_second_stage(first, series, units=("V", "N", "m")).model)


def output_range(load=None):
    """Return the outputs of the cold and the hot wire, the lower first."""
    bench = Bench(0, load)
    ends = [bench.truth]
    bench.wire.set(3.0, 60.0)
    return sorted([*ends, bench.truth])


TIMING = InverseControlParameters(5.0, 1.0, 2.0)
"""What transients of the wire tell, and a search for other time constants; then without."""
KNOWN = InverseControlParameters(5.0, 1.0, 2.0, search=LagSearch(steps=0))
HEATED = ResponseDynamics(5.0, 2.0)
NOISE = {"length": 0.02 * MILLIMETRE, "force": 0.02}
MODEL_ERROR = 0.02


def task(inverse, load):
    model = inverse.model
    start = model.initial_state()
    if load is None:
        return ForceTask.of_model(inverse, start, LIMITS, NOISE, MODEL_ERROR)
    return LengthTask.of_model(inverse, model.step(start, 0.0, load)[0], LIMITS, NOISE, MODEL_ERROR)


def controllers(inverse, load):
    what = task(inverse, load)
    gains = ProportionalIntegralParameters.of_lag(what.rise / LIMITS[1] ** 2, TIMING)
    return {
        "open-loop-inverse": lambda: MuscleOpenLoop(what, TIMING),
        "proportional-integral": lambda: MuscleProportionalIntegral(LIMITS, gains),
        "closed-loop-inverse": lambda: MuscleClosedLoop(what, TIMING),
    }


def rms(errors):
    return np.sqrt(np.mean(np.square(errors), axis=0))


# On the plant.

ROUNDS = [4.9, 8.82, None]
SEEDS = (0, 1)


@pytest.fixture(scope="module")
def rounds(inverse):
    """The errors of each controller, 20 targets in each session: rows of those after 10 s and at the end."""
    results = {}
    for load in ROUNDS:
        low, high = output_range(load)
        for name, make in controllers(inverse, load).items():
            errors = []
            # The others lie far apart.
            for seed in SEEDS if name == "closed-loop-inverse" else SEEDS[:1]:
                bench, controller = Bench(seed, load), make()
                targets = low + (high - low) * np.random.default_rng([seed, 5]).uniform(0.05, 0.95, 20)
                errors += [bench.reach(controller, target) for target in targets.tolist()]
            results[load, name] = np.array(errors)
    return results


@pytest.mark.parametrize("load", [4.9, 8.82])
def test_length_under_a_load(rounds, load):
    errors = rounds[load, "closed-loop-inverse"] / MILLIMETRE
    after_ten, final = rms(errors)
    # The fit takes one of several equal minimisers, which differs from processor to processor by some percent.
    assert final <= 0.022
    assert after_ten <= 0.07
    assert np.abs(errors[:, 1]).max() <= 0.1
    assert np.median(np.abs(errors[:, 1])) <= 0.015


def test_force_between_fixed_ends(rounds):
    errors = rounds[None, "closed-loop-inverse"]
    after_ten, final = rms(errors)
    assert final <= 0.04
    assert after_ten <= 0.15
    assert np.abs(errors[:, 1]).max() <= 0.15


@cases("load", ROUNDS)
def test_feedback_beats_open_loop_and_the_model_beats_feedback_alone(rounds, load):
    names = ("closed-loop-inverse", "proportional-integral", "open-loop-inverse")
    closed, proportional_integral, opened = (rms(rounds[load, name]) for name in names)
    assert (closed < proportional_integral).all()
    assert (proportional_integral < opened).all()
    # After 10 s by far: that is what driving ahead of the lag is for.
    assert closed[0] < 0.5 * proportional_integral[0]


def test_length_while_the_load_changes(inverse):
    loads = (5.88, 7.84, 6.37, 4.9)
    ranges = [output_range(load) for load in loads]
    low, high = max(r[0] for r in ranges), min(r[1] for r in ranges)
    errors = []
    for seed in SEEDS:
        bench = Bench(seed, loads[-1])
        controller = MuscleClosedLoop(
            task(inverse, loads[-1]), InverseControlParameters(5.0, 1.0, 2.0, duration=30.0)
        )
        targets = low + (high - low) * np.random.default_rng([seed, 6]).uniform(0.05, 0.95, 12)
        for n, target in enumerate(targets.tolist()):
            # The force is all that tells the controller.
            _, final = bench.reach(controller, target, 30.0, loads[n % 4])
            errors.append(final)
            assert controller.reach is Reach.MET
    assert rms(errors) <= 0.02 * MILLIMETRE


@cases("name", ["closed-loop-inverse", "proportional-integral"])
@cases(("load", "side"), [(4.9, 0), (4.9, 1), (None, 0), (None, 1)])
def test_out_of_reach_for_long_and_then_not(inverse, name, load, side):
    low, high = output_range(load)
    span = high - low
    bench, controller = Bench(3, load), controllers(inverse, load)[name]()
    # The cold end of the force is 0.3 N: below it there is less to ask for.
    beyond = (low - 0.5 * span, high + 0.5 * span)[side]
    for _ in range(5):
        bench.reach(controller, beyond)
        assert controller.reach is (Reach.TOO_LOW, Reach.TOO_HIGH)[side]
    limit = bench.wire.plant.voltage
    assert limit == (LIMITS[1] if (load is None) == (side == 1) else LIMITS[0])
    inside = low + 0.5 * span
    # It leaves the limit with the first command.
    command = controller.aim(inside, *bench.read())
    assert abs(command.setpoint - limit) > 0.3
    bench.reach(controller, inside)
    _, final = bench.reach(controller, inside)
    assert abs(final) <= 0.05 * span
    assert controller.reach is Reach.MET
    # As good as one that was never out of reach.
    _, final = bench.reach(controller, inside + 0.1 * span)
    assert abs(final) <= 0.02 * span


def test_narrower_limits_are_kept_and_flagged(inverse):
    bench = Bench(4, 4.9)
    low, high = output_range(4.9)
    for make in (MuscleClosedLoop, MuscleOpenLoop):
        controller = make(task(inverse, 4.9), TIMING, limits=(0.5, 2.0))
        assert controller.limits == (0.5, 2.0)
        command = controller.aim(low + 0.05 * (high - low), *bench.read())
        assert command.setpoint == 2.0
        assert controller.reach is Reach.TOO_LOW
    controller = MuscleOpenLoop(task(inverse, None), TIMING, limits=(0.0, 2.0))
    assert controller.aim(10.5, 0.0, 0.0, 0.3).setpoint == 2.0
    assert controller.reach is Reach.TOO_HIGH


# What the controllers know.


def test_memory_follows_what_the_supply_put_out_and_the_force_first(inverse):
    model, rng = inverse.model, np.random.default_rng(8)
    controller = MuscleClosedLoop(task(inverse, 4.9), KNOWN)
    state, seen = model.initial_state(), SeenInput(HEATED, 0.0)
    times = np.cumsum(rng.uniform(0.5, 2.0, 30)).tolist()
    for n, t in enumerate(times):
        voltage, force = rng.uniform(0.0, 3.0), rng.uniform(1.0, 9.0)
        # The supply does not do what the controller asked for.
        ask = controller.update if n % 10 else lambda *reading: controller.aim(2e-4, *reading)
        ask(t, voltage, rng.uniform(-1e-3, 2e-3), force)
        state, _ = model.step(state, seen.take(t, voltage), force)
        assert controller.state == state


def test_the_argument_stays_between_fixed_ends(inverse):
    model = inverse.model
    state = model.advance([1.5, 1.0], [3.0, 4.0])
    controller = MuscleOpenLoop(task(inverse, None), KNOWN, state)
    command = controller.aim(5.0, 0.0, 1.0, 4.0)
    expected = inverse.voltage_for_force(state, 5.0)
    assert command.setpoint == expected.voltage
    for n in range(1, 20):
        held = controller.update(float(n), command.setpoint, 9.9)
        assert (held.setpoint, held.done) == (command.setpoint, False)
    seen = SeenInput(HEATED, 1.0)
    for n in range(20):
        seen.take(float(n), command.setpoint if n else 1.0)
    assert controller.state == model.move(state, seen.value, state.argument)[0]
    assert controller.trace.reference == 5.0
    assert controller.trace.predicted == controller.state.force
    assert math.isnan(controller.trace.disturbance)


def test_an_exact_model_is_led_to_the_target(inverse):
    model = inverse.model
    # Slopes of any size are believed: the model is the wire.
    controller = MuscleClosedLoop(replace(task(inverse, None), slopes=(1e-3, 1e3)), KNOWN)
    state, seen, t, voltage = model.initial_state(), SeenInput(HEATED), 0.0, 0.0
    seen.take(t, voltage)
    for target in (4.0, 6.0, 5.0, 8.0, 7.0):
        command = controller.aim(target, t, voltage, state.force)
        while not command.done:
            voltage = command.setpoint
            t += command.wait
            state, _ = model.move(state, seen.take(t, voltage), state.argument)
            command = controller.update(t, voltage, state.force)
        assert state.force == pytest.approx(target, abs=2e-3)
        assert controller.reach is Reach.MET


def test_missing_readings(inverse):
    nan = math.nan
    controller = MuscleClosedLoop(task(inverse, 4.9), KNOWN)
    command = controller.aim(1e-3, 0.0, 0.0, 2e-3, 4.9)
    before = controller.trace.disturbance, controller.trace.uncertainty
    after = controller.update(1.0, nan, nan, nan)
    # The supply is taken to have done what it was told, the load to be the same; the wire is not left to overheat.
    seen = SeenInput(HEATED)
    seen.take(0.0, 0.0)
    assert controller.state.voltage == seen.take(1.0, command.setpoint)
    assert controller.state.force == 4.9
    assert (controller.trace.disturbance, controller.trace.uncertainty) == before
    assert math.isfinite(after.setpoint)
    # Nonsense is missing too.
    controller.update(2.0, 1e6, 5.0, 1e9)
    assert controller.state.force == 4.9
    assert controller.state.voltage == seen.take(2.0, after.setpoint)
    assert (controller.trace.disturbance, controller.trace.uncertainty) == before
    plain = MuscleProportionalIntegral(LIMITS, ProportionalIntegralParameters(1.0, 4.0, 1.0))
    assert plain.aim(5.0, 0.0, 1.5, nan).setpoint == 1.5
    # The integral begins with the first reading: no proportional part comes of it.
    assert plain.update(1.0, nan, 3.0).setpoint == pytest.approx(math.sqrt(1.5**2 + 2.0 / 4.0))
    assert plain.update(2.0, nan, nan).setpoint == pytest.approx(math.sqrt(1.5**2 + 2.0 / 4.0))


def test_proportional_integral_steps():
    controller = MuscleProportionalIntegral(LIMITS, ProportionalIntegralParameters(0.5, 5.0, 1.0))
    first = controller.aim(4.0, 0.0, 1.0, 3.0)
    assert first.setpoint == pytest.approx(math.sqrt(1.0 + 0.5 * 1.0 / 5.0))
    second = controller.update(1.0, first.setpoint, 3.5)
    assert second.setpoint == pytest.approx(math.sqrt(first.setpoint**2 + 0.5 * (-0.5 + 0.5 / 5.0)))
    assert controller.reach is Reach.MET
    assert controller.trace.reference == 4.0
    # A new target acts at once.
    third = controller.aim(5.0, 2.0, second.setpoint, 3.5)
    assert third.setpoint == pytest.approx(math.sqrt(second.setpoint**2 + 0.5 * (1.0 + 1.5 / 5.0)))
    assert controller.aim(1e3, 3.0, third.setpoint, 3.5).setpoint == 3.0
    assert controller.reach is Reach.TOO_HIGH
    assert controller.aim(-1e3, 4.0, 3.0, 3.5).setpoint == 0.0
    assert controller.reach is Reach.TOO_LOW


@cases("name", ["closed-loop-inverse", "proportional-integral", "open-loop-inverse"])
def test_lasts_its_time_and_then_holds(inverse, name):
    controller = controllers(inverse, 4.9)[name]()
    loop, t = ReachTarget(controller, 1e-3), 7.0
    command, commands = loop.begin(t, 0.0, 2e-3, 4.9), 1
    while not command.done:
        # Late by 0.3 s each time: the next period is the shorter.
        t += command.wait + 0.3
        held = command.setpoint
        command, commands = loop.update(t, held, 2e-3, 4.9), commands + 1
    assert commands == 21
    assert t == pytest.approx(27.3)
    for _ in range(3):
        t += command.wait
        command = loop.update(t, held, 1e-3, 4.9)
        assert (command.setpoint, command.done) == (held, True)


# Wrong input.


@cases(
    ("make", "message"),
    [
        (lambda: InverseControlParameters(-1.0, 1.0, 2.0), "time_constant: expected a finite"),
        (lambda: InverseControlParameters(5.0, 1.0, 0.0), "horizon: expected a positive"),
        (lambda: InverseControlParameters(5.0, 1.0, 2.0, duration=math.inf), "duration: expected a positive"),
        (lambda: InverseControlParameters(5.0, 1.0, 2.0, 3.0), "power: expected 1 or 2"),
        (lambda: LagSearch(factor=1.0), "factor: expected a number above 1"),
        (lambda: LagSearch(steps=-1), "steps, margin: expected at least 0"),
        (lambda: ProportionalIntegralParameters(0.0, 4.0, 1.0), "gain: expected a number other than 0"),
        (lambda: ProportionalIntegralParameters(1.0, 0.0, 1.0), "integral_time: expected a positive"),
        (
            lambda: MuscleProportionalIntegral((-1.0, 3.0), ProportionalIntegralParameters(1.0, 4.0, 1.0)),
            "limits: expected",
        ),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@cases(
    ("make", "message"),
    [
        (lambda i: replace(task(i, 4.9), walk_variance=0.0), "walk_variance: expected a positive"),
        (lambda i: replace(task(i, 4.9), slopes=(1e-3, 2e-3)), "slopes: expected negative"),
        (lambda i: replace(task(i, None), reading_variance=math.nan), "reading_variance: expected a positive"),
        (lambda i: replace(task(i, None), slopes=(-1.0, 2.0)), "slopes: expected positive"),
        (lambda i: replace(task(i, None), slopes=(2.0, 1.0)), "slopes: expected"),
        (lambda i: MuscleOpenLoop(task(i, 4.9), TIMING, limits=(4.0, 5.0)), "limits: expected an overlap"),
        (lambda i: MuscleClosedLoop(task(i, None), TIMING).aim(math.nan, 0.0, 0.0, 0.3), "target: expected a finite"),
        (
            lambda i: MuscleClosedLoop(task(i, None), TIMING).aim(5.0, 0.0, 0.0, 0.3, 1.0),
            "force task: expected no further",
        ),
        (lambda i: MuscleClosedLoop(task(i, 4.9), TIMING).aim(0.0, 0.0, 0.0, 0.0), "length task: expected the force"),
    ],
)
def test_wrong_input_of_a_controller_is_named(inverse, make, message):
    with pytest.raises(ValueError, match=message):
        make(inverse)


def test_time_does_not_go_back_and_targets_come_first(inverse):
    controller = MuscleClosedLoop(task(inverse, None), KNOWN)
    with pytest.raises(RuntimeError, match="expected a target first"):
        controller.update(0.0, 0.0, 0.3)
    controller.aim(5.0, 10.0, 0.0, 0.3)
    with pytest.raises(ValueError, match="t: expected a time not before"):
        controller.update(9.0, 0.0, 0.3)


# Another specimen than the one that was identified.


@cases(("load", "factor"), [(4.9, 0.7), (None, 1.3)])
def test_another_time_constant_is_found_while_the_wire_is_controlled(inverse, factor, load):
    low, high = output_range(load)
    found, constants = [], []
    for seed in (11, 12, 13):
        bench = Bench(seed, load, time_constant=factor * SMAParameters().time_constant)
        controller = MuscleClosedLoop(task(inverse, load), TIMING)
        targets = low + (high - low) * np.random.default_rng(seed + 1).uniform(0.05, 0.95, 20)
        found.append(rms([bench.reach(controller, target)[1] for target in targets.tolist()]))
        constants.append(controller.time_constant)
    assert constants == pytest.approx([factor * 5.0] * 3, rel=0.35)
    assert np.median(constants) == pytest.approx(factor * 5.0, rel=0.2)
    assert np.median(found) <= (0.05 if load is None else 0.02 * MILLIMETRE)


def test_slopes_are_about_the_mean_one_of_the_major_loop_of_the_model(inverse):
    model = inverse.model
    low, high = output_range(4.9)
    found = task(inverse, 4.9)
    # The mean slope lies within, and it falls.
    assert found.rise == pytest.approx(low - high, rel=0.1)
    assert found.slopes[0] < found.rise / 3.0 < found.slopes[1] < 0.0
    assert math.sqrt(found.reading_variance) == NOISE["length"]
    with pytest.raises(DataError, match="does not rise with the voltage between 0 and 1e-09 V"):
        ForceTask.of_model(inverse, model.initial_state(), (0.0, 1e-9), NOISE, MODEL_ERROR)


# What a controller knows comes from the model and its dynamics.


def test_no_number_of_a_specimen_stands_in_the_controllers():
    """Another muscle, k times as long, strong and slow, gets numbers k times as large, all of them."""
    stage = Preisach(uniform_levels(0.0, 3.0, 6), np.linspace(0.5, 1.0, 21), 0.0, None, (0.0, 3.0))

    def muscle(scale):
        first = replace(stage, density=scale * stage.density, input_unit="V", output_unit="N")
        reach = 2.0 * scale * float(stage.evaluate([3.0])[0])
        second = Preisach(
            uniform_levels(-reach, reach, 6), stage.density * 1e-3 / scale, 0.0, None, (-reach, reach), "N", "m"
        )
        return TwoStageInverse(TwoStage(first, second, pretension=0.1 * scale))

    def numbers(scale):
        inverse = muscle(scale)
        state = inverse.model.initial_state()
        found = {}
        for kind in (ForceTask, LengthTask):
            known = kind.of_model(
                inverse, state, LIMITS, {"force": 0.02 * scale, "length": 1e-5 * scale}, MODEL_ERROR
            )
            found[kind.quantity] = (
                [known.rise, *known.slopes],
                [known.walk_variance, known.reading_variance],
            )
        return found

    one, ten = numbers(1.0), numbers(10.0)
    for quantity in one:
        for power, (few, many) in enumerate(zip(one[quantity], ten[quantity], strict=True), 1):
            np.testing.assert_allclose(many, 10.0**power * np.array(few), rtol=1e-6)
    fast, slow = (
        InverseControlParameters.of_dynamics(
            IdentifiedDynamics(response=ResponseDynamics(lag, 2.0), fastest=0.1 * lag), duration=10.0 * lag
        )
        for lag in (2.0, 20.0)
    )
    assert (slow.period, slow.horizon) == pytest.approx((10.0 * fast.period, 10.0 * fast.horizon))
    gains = [ProportionalIntegralParameters.of_lag(-1e-3, each) for each in (fast, slow)]
    assert gains[1].integral_time == pytest.approx(10.0 * gains[0].integral_time)
    assert gains[1].gain == pytest.approx(gains[0].gain)


def test_a_model_without_dynamics_is_refused_unless_the_rig_file_gives_them(inverse):
    setup = ControllerSetup(
        name="closed-loop-inverse", model=ModelFile("two-stage", inverse.model), limits=LIMITS,
        options={"duration": 20.0},
    )  # fmt: skip
    with pytest.raises(ConfigurationError, match=r"does not say how fast .* time_constant"):
        LENGTH_CLOSED_LOOP.make(setup)
    given = replace(setup, options={"duration": 20.0, "time_constant": 5.0, "power": 2.0})
    assert LENGTH_CLOSED_LOOP.make(given).time_constant == 5.0
    with pytest.raises(ConfigurationError, match=r"duration = 20 s is too short .* 30 s"):
        LENGTH_CLOSED_LOOP.make(replace(setup, options={"duration": 20.0, "time_constant": 30.0}))


def test_what_a_lag_leaves_of_a_move_counts_in_favour_of_an_open_loop(inverse):
    def own_error(lag):
        dynamics = IdentifiedDynamics(response=ResponseDynamics(lag, 2.0))
        file = ModelFile("two-stage", inverse.model, dynamics=dynamics)
        return FORCE_OPEN_LOOP.own_error(ControllerSetup(model=file, limits=LIMITS, options={"duration": 20.0}))

    low, high = inverse.model.first.output_range()
    assert own_error(0.0) == 0.0
    assert own_error(8.0) == pytest.approx(math.exp(-20.0 / 8.0) * (high - low) / math.sqrt(6.0))
