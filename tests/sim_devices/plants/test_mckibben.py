import copy
import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from sim_devices.plants import friction_muscle as kernels
from sim_devices.plants.mckibben import McKibbenMuscle, McKibbenParameters

PLAIN = McKibbenParameters()
LIVELY = McKibbenParameters(supply_sd=500.0)
SMOOTH = McKibbenParameters(friction=0.0, friction_coefficient=0.0, friction_jam=0.0, pressure_band=0.0)
LOADS = (0.98, 2.94, 4.90, 6.86, 8.82)
# The set-points of a damped oscillation, V, in steps of 0.3 V.
EXTREMES = (0.0, 3.0, 0.3, 2.7, 0.6, 2.4, 0.9, 2.1, 1.2, 1.8, 1.5)
VOLTAGES = [0.0] + [
    float(v) for a, b in itertools.pairwise(EXTREMES) for v in np.linspace(a, b, round(abs(b - a) / 0.3) + 1)[1:]
]


def make(parameters=PLAIN, seed=1):
    return McKibbenMuscle(parameters, np.random.default_rng(seed))


def reset(muscle):
    muscle.hang(0.3)
    for voltage in (3.0, 0.0):
        muscle.apply(voltage)
        muscle.advance(30.0)


def braid_force(parameters, pressure, length):
    """Chou and Hannaford 1996, in the braid's angle and diameter: N from Pa and m."""
    angle = math.acos(length / parameters.thread_length)
    diameter = parameters.thread_length * math.sin(angle) / (parameters.turns * math.pi)
    return pressure * math.pi * diameter**2 / 4.0 * (3.0 * math.cos(angle) ** 2 - 1.0) / math.sin(angle) ** 2


def widest(up, down):
    """Widest distance of two branches over their common abscissa, in parts of their range; rows x and y, x rising."""
    low, high = max(up[0][0], down[0][0]), min(up[0][-1], down[0][-1])
    x = np.linspace(low, high, 50)
    return np.max(np.abs(np.interp(x, *up) - np.interp(x, *down))) / np.ptp(np.append(up[1], down[1]))


def voltage_loop(values):
    top = VOLTAGES.index(3.0)
    bottom = top + 9
    return widest(
        (VOLTAGES[: top + 1], values[: top + 1]), (VOLTAGES[bottom : top - 1 : -1], values[bottom : top - 1 : -1])
    )


class NaiveMuscle:
    """The muscle's equations as they read, with a state of its own; SI units."""

    def __init__(self, muscle):
        self.p = muscle.parameters
        stiffness, self.weight, self.share = kernels.contact_table(self.p)
        self.stiffness = stiffness * 1e3
        self.rest = muscle._coefficients[kernels.REST] * 1e-3
        self.x = muscle.length + self.rest
        self.forces = muscle._forces.copy()
        self.pressure = muscle.pressure
        self.force = muscle.force
        self.position = muscle.position

    def trial(self, x, pressure):
        p = self.p
        jam = p.jam * x**2 if x > 0.0 else 0.0
        surface = math.pi * p.braid_diameter * p.rest_length
        most = self.weight * (p.friction + p.friction_coefficient * surface * pressure + p.friction_jam * jam)
        moved = x - self.x - self.share * p.slip * (pressure - self.pressure)
        contacts = np.clip(self.forces + self.stiffness * moved, -most, most)
        smooth = braid_force(p, pressure, p.rest_length + x) + p.bladder_stiffness * x + p.bladder_cube * x**3 + jam
        return smooth + contacts.sum(), contacts

    def settle(self, pressure, load=None, position=None):
        def excess(x):
            wanted = load if position is None else (position + self.rest - x) * self.p.series_stiffness
            return self.trial(x, pressure)[0] - wanted

        x = brentq(excess, -0.08, 0.02, xtol=1e-15)
        force = load
        if position is not None:
            force = (position + self.rest - x) * self.p.series_stiffness
            if force < 0.0:
                x = brentq(lambda x: self.trial(x, pressure)[0], -0.08, 0.02, xtol=1e-15)
                force = 0.0
        self.forces = self.trial(x, pressure)[1]
        self.x, self.pressure, self.force = x, pressure, force
        self.position = x - self.rest + force / self.p.series_stiffness if position is None else position

    def move(self, name, value):
        """Reach load or position in the plant's sub-steps."""
        begin, largest = (self.force, 0.1) if name == "hang" else (self.position, 0.25e-3)
        parts = math.ceil(abs(value - begin) / largest)
        for k in range(1, parts + 1):
            step = begin + (value - begin) * k / parts
            self.settle(self.pressure, **{"load" if name == "hang" else "position": step})

    def inflate(self, name, value, pressure):
        begin = self.pressure
        parts = max(math.ceil(abs(pressure - begin) / 2e3 - 1e-9), 1)
        for k in range(1, parts + 1):
            step = begin + (pressure - begin) * k / parts
            self.settle(step, **{"load" if name == "hang" else "position": value})


class TestSpecimen:
    def test_contacts_are_those_of_the_population(self):
        stiffness, weight, share = kernels.contact_table(dataclasses.replace(PLAIN, contact_count=100_000))
        assert stiffness.sum() == pytest.approx(1.2)
        assert np.ptp(stiffness) == 0.0
        assert weight.sum() == pytest.approx(1.0)
        assert np.log(weight).std() == pytest.approx(0.8, rel=0.02)
        assert share.mean() == pytest.approx(1.0)
        assert share.min() >= 0.0
        assert share.std() == pytest.approx(1.0 / math.sqrt(3.0), rel=0.02)

    def test_geometry(self):
        assert PLAIN.braid_diameter == pytest.approx(6.47e-3, abs=1e-5)
        assert math.degrees(math.acos(PLAIN.rest_length / PLAIN.thread_length)) == pytest.approx(32.9, abs=0.1)

    def test_specimen_does_not_depend_on_the_session(self):
        first, second = make(seed=1), make(seed=2)
        for muscle in (first, second):
            muscle.hang(5.0)
            muscle.apply(2.0)
            muscle.advance(20.0)
        assert first.snapshot() == second.snapshot()
        other = make(dataclasses.replace(PLAIN, specimen_seed=7))
        other.hang(5.0)
        other.apply(2.0)
        other.advance(20.0)
        assert other.length != first.length

    def test_starts_empty_unloaded_and_at_its_resting_length(self):
        muscle = make()
        assert muscle.snapshot() == pytest.approx((0.0,) * 6, abs=1e-12)
        before = muscle.snapshot()
        muscle.advance(3600.0)
        assert muscle.snapshot() == before

    @pytest.mark.parametrize(
        "wrong",
        [
            {"contact_count": 0},
            {"step": math.nan},
            {"time_constant": 0.0},
            {"friction": -0.1},
            {"friction_jam": 1.0},
            {"pretension": 50.0},
            {"rated_voltage": 6.0},
            {"rest_length": 70e-3},
            {"rest_length": 140e-3},
        ],
    )
    def test_wrong_parameters_are_refused(self, wrong):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            McKibbenParameters(**wrong)

    def test_parameters_are_frozen(self):
        with pytest.raises(dataclasses.FrozenInstanceError):
            PLAIN.turns = 2.0


class TestRanges:
    def test_force_at_constant_length(self):
        muscle = make()
        reset(muscle)
        muscle.clamp(muscle.position)
        force = []
        for voltage in VOLTAGES:
            muscle.apply(voltage)
            muscle.advance(30.0)
            force.append(muscle.force)
        assert force[0] == pytest.approx(0.3, abs=1e-6)
        assert max(force) == force[VOLTAGES.index(3.0)] == pytest.approx(16.6, abs=0.2)
        # Coming down, the same voltage holds more force than going up.
        assert 0.04 < voltage_loop(force) < 0.08
        assert force[VOLTAGES.index(3.0) + 5] > np.interp(
            VOLTAGES[VOLTAGES.index(3.0) + 5], VOLTAGES[:11], force[:11]
        )

    def test_length_at_constant_load(self):
        muscle = make()
        travel, loops = [], []
        for load in LOADS:
            reset(muscle)
            muscle.hang(load)
            for voltage in VOLTAGES:
                muscle.apply(voltage)
                muscle.advance(30.0)
                travel.append(muscle.length * 1e3)
                assert muscle.force == pytest.approx(load)
            loops.append(voltage_loop(travel[-len(VOLTAGES) :]))
        travel = np.array(travel).reshape(len(LOADS), -1)
        assert travel.min() == pytest.approx(-17.9, abs=0.2)
        assert travel.max() == pytest.approx(5.3, abs=0.2)
        assert np.all(np.diff(travel, axis=0) > 0.0)
        # The loops differ with the load.
        assert 0.10 < loops[0] < loops[-1] < 0.20
        assert loops[-1] > 1.2 * loops[0]

    def test_length_against_force_at_constant_voltage(self):
        muscle = make()
        loss = []
        for voltage in (0.0, 0.6, 1.2, 1.8, 2.4, 3.0):
            reset(muscle)
            muscle.apply(voltage)
            muscle.advance(30.0)
            loaded = copy.deepcopy(muscle)
            loaded.hang(10.5)
            loaded.advance(0.1)
            up = np.linspace(muscle.position, loaded.position, 12)
            force, length = [], []
            for place in [*up, *up[-2::-1]]:
                muscle.clamp(float(place))
                muscle.advance(30.0)
                force.append(muscle.force)
                length.append(muscle.length)
            assert force[0] == pytest.approx(0.3, abs=1e-6)
            assert force[11] == pytest.approx(10.5, abs=0.05)
            assert np.all(np.diff(force[:12]) > 0.0)
            assert np.all(np.diff(force[11:]) <= 0.0)
            assert 0.10 < widest((force[:12], length[:12]), (force[:10:-1], length[:10:-1])) < 0.25
            loss.append(np.trapezoid(force[:12], length[:12]) + np.trapezoid(force[11:], length[11:]))
            loss[-1] /= np.ptp(length)
        # Pressure presses the threads together: per travel, the loop's loss grows with it.
        assert loss[-1] > 2.0 * loss[1] > 2.0 * loss[0] > 0.0


class TestStatics:
    @pytest.mark.parametrize("voltage", [0.6, 1.5, 3.0])
    @pytest.mark.parametrize("load", [1.0, 4.9, 10.0])
    def test_without_friction_the_force_is_that_of_the_braid_and_the_bladder(self, voltage, load):
        muscle = make(SMOOTH)
        muscle.hang(load)
        muscle.apply(voltage)
        muscle.advance(60.0)
        assert muscle.pressure == pytest.approx(0.5e5 * voltage)
        x = muscle.length
        elastic = 300.0 * x + 0.12e6 * x**3 + 0.22e6 * max(x, 0.0) ** 2
        assert braid_force(SMOOTH, muscle.pressure, 110e-3 + x) + elastic == pytest.approx(load, abs=1e-8)

    def test_without_friction_nothing_is_remembered(self):
        muscle = make(SMOOTH)
        lengths = []
        for load, voltage in ((9.0, 3.0), (0.0, 0.0), (2.0, 1.0)):
            muscle.hang(load)
            muscle.apply(voltage)
            muscle.advance(60.0)
            muscle.hang(4.0)
            muscle.apply(2.0)
            muscle.advance(60.0)
            lengths.append(muscle.length)
        assert lengths == pytest.approx([lengths[0]] * 3, abs=1e-11)

    def test_plant_equals_the_naive_equations(self):
        muscle = make(LIVELY, seed=5)
        naive = NaiveMuscle(muscle)
        script = np.random.default_rng(8)
        slack = 0
        for k in range(120):
            if k % 12 == 0:
                name, value = "hang", float(script.uniform(0.0, 9.0))
                if script.random() < 0.5:
                    name, value = "clamp", float(script.uniform(-14e-3, 5e-3))
                getattr(muscle, name)(value)
            if k % 17 == 0:
                muscle.apply(float(script.uniform(0.0, 3.0)))
            muscle.advance(0.1)
            naive.move(name, value)
            naive.inflate(name, value, muscle.pressure)
            assert muscle.length == pytest.approx(naive.x - naive.rest, abs=1e-11)
            assert muscle.force == pytest.approx(naive.force, abs=1e-6)
            assert muscle.position == pytest.approx(naive.position, abs=1e-11)
            assert muscle._forces == pytest.approx(naive.forces, abs=1e-7)
            slack += muscle.force == 0.0
        assert slack > 0


# From a random past, one input is moved monotonically.
PASTS = st.lists(st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 20.0)), max_size=5)


def with_past(past):
    muscle = make()
    for voltage, load in past:
        muscle.apply(voltage)
        muscle.hang(load)
        muscle.advance(20.0)
    return muscle


class TestDirections:
    @given(PASTS, st.floats(0.0, 20.0), st.lists(st.floats(0.0, 5.0), min_size=2, max_size=8), st.booleans())
    @settings(max_examples=60, deadline=None)
    def test_voltage_contracts(self, past, load, voltages, falling):
        muscle = with_past(past)
        muscle.hang(load)
        lengths = []
        for voltage in sorted(voltages, reverse=falling):
            muscle.apply(voltage)
            muscle.advance(20.0)
            lengths.append(muscle.length)
        # The first voltage may be reached from either side.
        assert np.all(np.diff(lengths) * (1 if falling else -1) >= -1e-11)

    @given(PASTS, st.floats(0.0, 5.0), st.lists(st.floats(0.0, 40.0), min_size=2, max_size=8), st.booleans())
    @settings(max_examples=60, deadline=None)
    def test_load_elongates(self, past, voltage, loads, falling):
        muscle = with_past(past)
        muscle.apply(voltage)
        muscle.advance(20.0)
        lengths = []
        for load in sorted(loads, reverse=falling):
            muscle.hang(load)
            muscle.advance(1.0)
            lengths.append(muscle.length)
        assert np.all(np.diff(lengths) * (-1 if falling else 1) >= -1e-11)

    @given(PASTS, st.floats(-6e-3, 4e-3), st.lists(st.floats(0.0, 5.0), min_size=2, max_size=8))
    @settings(max_examples=40, deadline=None)
    def test_voltage_pulls_at_constant_length(self, past, place, voltages):
        muscle = with_past(past)
        muscle.clamp(place)
        muscle.advance(1.0)
        forces = []
        for voltage in sorted(voltages):
            muscle.apply(voltage)
            muscle.advance(20.0)
            forces.append(muscle.force)
        assert np.all(np.diff(forces) >= -1e-7)

    @given(PASTS, st.booleans())
    @settings(max_examples=40, deadline=None)
    def test_nothing_changes_while_nothing_changes(self, past, held):
        muscle = with_past(past)
        muscle.advance(60.0)
        if held:
            muscle.clamp(muscle.position)
            muscle.advance(1.0)
        before = muscle.snapshot()
        muscle.advance(3600.0)
        assert muscle.snapshot() == before

    def test_loops_do_not_depend_on_the_rate(self):
        lengths = []
        for parts in (1, 40):
            muscle = make()
            muscle.hang(4.0)
            for begin, end in ((0.0, 2.8), (2.8, 0.9), (0.9, 1.9)):
                for voltage in np.linspace(begin, end, parts + 1)[1:]:
                    muscle.apply(float(voltage))
                    muscle.advance(10.0 / parts)
                muscle.advance(30.0)
            lengths.append(muscle.length)
        assert lengths[0] == pytest.approx(lengths[1], abs=1e-10)

    def test_large_move_leaves_the_memory_of_small_ones(self):
        once, bit_by_bit = make(), make()
        for muscle in (once, bit_by_bit):
            muscle.apply(2.0)
            muscle.advance(30.0)
        once.hang(9.0)
        once.advance(0.1)
        for load in np.linspace(0.0, 9.0, 361):
            bit_by_bit.hang(float(load))
            bit_by_bit.advance(0.1)
        assert once.length == pytest.approx(bit_by_bit.length, abs=1e-11)


class TestClamped:
    @given(
        st.lists(st.tuples(st.floats(-20e-3, 8e-3), st.floats(0.0, 3.0), st.integers(1, 60)), min_size=1, max_size=8)
    )
    @settings(max_examples=30, deadline=None)
    def test_imposed_length_is_met_or_the_muscle_is_slack(self, script):
        muscle = make()
        for place, voltage, steps in script:
            muscle.clamp(place)
            muscle.apply(voltage)
            for _ in range(steps):
                muscle.advance(0.1)
                assert muscle.position == pytest.approx(place, abs=1e-15)
                over = muscle.length + muscle.force / PLAIN.series_stiffness - place
                if muscle.force == 0.0:
                    assert over >= -1e-12
                elif muscle.force < PLAIN.force_limit:
                    assert abs(over) <= 1e-12
                assert 0.0 <= muscle.force <= PLAIN.force_limit

    def test_slack_muscle_carries_nothing_and_tightens_when_inflated(self):
        muscle = make()
        muscle.clamp(-4e-3)
        muscle.advance(10.0)
        assert muscle.force == 0.0
        assert muscle.length > muscle.position
        muscle.apply(3.0)
        muscle.advance(10.0)
        assert muscle.force > 5.0

    def test_overstretched_muscle_stays_at_the_limit(self):
        muscle = make()
        muscle.clamp(50e-3)
        muscle.apply(3.0)
        muscle.advance(10.0)
        assert muscle.force == PLAIN.force_limit
        assert muscle.position == pytest.approx(50e-3)

    @pytest.mark.parametrize("voltage", [0.0, 1.5, 3.0])
    @pytest.mark.parametrize("load", [0.5, 4.9, 10.0])
    def test_changing_between_load_and_servo_is_continuous(self, load, voltage):
        muscle = make()
        muscle.hang(load)
        muscle.apply(voltage)
        muscle.advance(30.0)
        before = muscle.snapshot()
        muscle.clamp(muscle.position)
        assert muscle.snapshot() == before
        muscle.advance(1.0)
        assert muscle.snapshot() == pytest.approx(before, abs=1e-8)
        held = muscle.snapshot()
        muscle.hang(held.force)
        assert muscle.snapshot() == held
        muscle.advance(1.0)
        assert muscle.snapshot() == pytest.approx(held, abs=1e-8)

    def test_slack_end_comes_back_to_the_muscle(self):
        muscle = make()
        muscle.clamp(-5e-3)
        muscle.advance(1.0)
        length = muscle.length
        muscle.hang(0.0)
        muscle.advance(1.0)
        assert muscle.position == muscle.length == pytest.approx(length, abs=1e-12)


class TestReset:
    def test_inflating_and_emptying_erases_the_memory(self):
        script = np.random.default_rng(3)
        results = []
        for _ in range(4):
            muscle = make()
            for _ in range(6):
                if script.random() < 0.5:
                    muscle.hang(float(script.uniform(0.0, 9.0)))
                else:
                    muscle.clamp(float(script.uniform(-5e-3, 5e-3)))
                muscle.apply(float(script.uniform(0.0, 3.0)))
                muscle.advance(float(script.uniform(1.0, 30.0)))
            reset(muscle)
            results.append(muscle.snapshot())
        for result in results[1:]:
            assert result == pytest.approx(results[0], abs=1e-9)


class TestPressure:
    def test_time_constant_and_steady_pressure(self):
        muscle = make(McKibbenParameters(pressure_band=0.0))
        muscle.apply(2.0)
        for k in range(1, 40):
            muscle.advance(0.1)
            assert muscle.pressure == pytest.approx(1e5 * -math.expm1(-0.1 * k / 0.3))
        assert muscle.voltage == 2.0
        assert muscle.current == pytest.approx(0.2e-3)

    def test_regulator_lags_by_its_band(self):
        muscle = make()
        for voltage, expected in (
            (2.0, 0.9875e5),
            (2.04, 1.0075e5),
            (2.0, 1.0075e5),
            (1.0, 0.5125e5),
            (0.0, 0.0125e5),
        ):
            muscle.apply(voltage)
            muscle.advance(30.0)
            assert muscle.pressure == pytest.approx(expected)

    def test_exhaust_speeds_up_emptying_only(self):
        muscle = make(McKibbenParameters(pressure_band=0.0))
        muscle.blow(True)
        muscle.apply(2.0)
        muscle.advance(0.3)
        assert muscle.pressure == pytest.approx(1e5 * -math.expm1(-1.0))
        muscle.advance(30.0)
        muscle.apply(1.0)
        muscle.advance(0.1)
        assert muscle.pressure == pytest.approx(0.5e5 * (1.0 + math.exp(-1.0)))
        muscle.blow(False)
        muscle.advance(0.3)
        assert muscle.pressure == pytest.approx(0.5e5 * (1.0 + math.exp(-2.0)))

    def test_supply_statistics(self):
        muscle = make(McKibbenParameters(contact_count=1, supply_sd=500.0), seed=3)
        muscle.apply(2.0)
        muscle.advance(60.0)
        pressure = np.empty(4000)
        for k in range(pressure.size):
            muscle.advance(5.0)
            pressure[k] = muscle.pressure - 0.9875e5
        # A first-order lag of 0.3 s takes away 1.5 % of it.
        assert pressure.std() == pytest.approx(500.0 * math.sqrt(10.0 / 10.3), rel=0.06)
        assert np.mean(pressure[:-2] * pressure[2:]) / pressure.var() == pytest.approx(math.exp(-1.0), abs=0.08)


class TestTime:
    commands = st.one_of(
        st.tuples(st.just("apply"), st.floats(0.0, 3.0)),
        st.tuples(st.just("hang"), st.floats(0.0, 9.0)),
        st.tuples(st.just("clamp"), st.floats(-20e-3, 5e-3)),
        st.tuples(st.just("blow"), st.booleans()),
    )
    # Whole microseconds, from one call to many, that add up to what the other plant does at once.
    pieces = st.lists(st.integers(0, 700_000), min_size=1, max_size=12)

    @given(st.lists(st.tuples(commands, pieces), min_size=1, max_size=8), st.integers(0, 2**32 - 1))
    @settings(max_examples=60, deadline=None)
    def test_splitting_advance_changes_nothing(self, script, seed):
        whole, split = make(LIVELY, seed=seed), make(LIVELY, seed=seed)
        for (name, argument), parts in script:
            getattr(whole, name)(argument)
            getattr(split, name)(argument)
            whole.advance(sum(parts) * 1e-6)
            for part in parts:
                split.advance(part * 1e-6)
            assert split.snapshot() == whole.snapshot()

    def test_outputs_are_held_between_grid_points(self):
        muscle = make()
        muscle.hang(2.0)
        begin = muscle.snapshot()
        muscle.advance(0.06)
        assert muscle.snapshot() == begin
        muscle.advance(0.04)
        assert muscle.force == 2.0

    def test_one_seed_one_trajectory(self):
        def run(seed):
            muscle = make(LIVELY, seed=seed)
            rows = []
            for k in range(60):
                muscle.apply(1.5 + math.sin(0.7 * k))
                (muscle.clamp if k % 20 < 10 else muscle.hang)(1e-3 if k % 20 < 10 else 3.0)
                muscle.advance(3.0)
                rows.append(muscle.snapshot())
            return rows

        assert run(1) == run(1)
        assert run(1) != run(2)

    def test_other_users_of_the_generator_do_not_disturb(self):
        rng = np.random.default_rng(1)
        muscle = McKibbenMuscle(LIVELY, rng)
        rng.standard_normal(1000)
        reference = make(LIVELY, seed=1)
        for each in (muscle, reference):
            each.apply(1.0)
            each.advance(1000.0)
        assert muscle.snapshot() == reference.snapshot()

    def test_snapshot_agrees_with_the_outputs(self):
        muscle = make(LIVELY)
        muscle.hang(3.0)
        muscle.apply(2.0)
        muscle.advance(7.0)
        for name, value in muscle.snapshot()._asdict().items():
            assert value == getattr(muscle, name)
            assert type(value) is float


class TestRefusals:
    @pytest.mark.parametrize("dt", [-1e-9, math.nan, math.inf])
    def test_advance(self, dt):
        with pytest.raises(ValueError, match="dt must"):
            make().advance(dt)

    @pytest.mark.parametrize(
        ("command", "value", "name"),
        [
            ("apply", -0.1, "voltage"),
            ("apply", 5.1, "voltage"),
            ("apply", math.nan, "voltage"),
            ("hang", -0.1, "load_newton"),
            ("hang", 41.0, "load_newton"),
            ("hang", math.nan, "load_newton"),
            ("clamp", 0.06, "length_metre"),
            ("clamp", -0.06, "length_metre"),
            ("clamp", math.nan, "length_metre"),
        ],
    )
    def test_commands(self, command, value, name):
        muscle = make()
        before = muscle.snapshot()
        with pytest.raises(ValueError, match=f"{name} must lie"):
            getattr(muscle, command)(value)
        muscle.advance(1.0)
        assert muscle.snapshot() == before
