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
from sim_devices.plants.coiled_polymer import CoiledPolymerMuscle, CoiledPolymerParameters

PLAIN = CoiledPolymerParameters()
LIVELY = CoiledPolymerParameters(ambient_sd=0.3)
ELASTIC = CoiledPolymerParameters(friction=0.0, friction_load=0.0, friction_coils=0.0)
LOADS = (0.98, 2.94, 4.90, 6.86, 8.82)
# The set-points of a damped oscillation, V, in steps of 0.3 V.
EXTREMES = (0.0, 3.0, 0.3, 2.7, 0.6, 2.4, 0.9, 2.1, 1.2, 1.8, 1.5)
VOLTAGES = [0.0] + [
    float(v) for a, b in itertools.pairwise(EXTREMES) for v in np.linspace(a, b, round(abs(b - a) / 0.3) + 1)[1:]
]


def make(parameters=PLAIN, seed=1):
    return CoiledPolymerMuscle(parameters, np.random.default_rng(seed))


def reset(muscle):
    muscle.hang(0.3)
    for voltage in (3.0, 0.0):
        muscle.apply(voltage)
        muscle.advance(120.0)


def coil(parameters, temperature, x):
    """Stiffness (N/m), free contraction (m) and tension (N) of the coil and its contact, as they read."""
    p = parameters

    def contraction(celsius):
        soft = math.log(1.0 + math.exp((celsius - p.softening) / p.softening_width))
        return p.expansion * celsius + p.expansion_above * p.softening_width * soft

    cold = 1.0 / (1.0 + math.exp((temperature - p.softening) / p.softening_width))
    stiffness = cold * p.cold_stiffness + (1.0 - cold) * p.hot_stiffness
    freed = contraction(temperature) - contraction(p.ambient_temperature)
    touch = p.coil_contact * (p.coil_length - x) ** 2 if x < p.coil_length else 0.0
    return stiffness, freed, stiffness * (x + freed), touch


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
        self.contacts = muscle._forces.copy()
        self.temperature = muscle.temperature
        self.arm = 0.0
        self.force = muscle.force
        self.position = muscle.position

    def trial(self, x, temperature, seconds):
        p = self.p
        stiffness, freed, tension, touch = coil(p, temperature, x)
        # The arm between two springs' ends that part evenly.
        left, mean = 1.0, 1.0
        if seconds > 0.0:
            left = math.exp(-seconds / p.arm_time)
            mean = (1.0 - left) * p.arm_time / seconds
        arm = left * self.arm + mean * p.arm_stiffness * (x - self.x)
        most = p.friction * stiffness / p.cold_stiffness + p.friction_coils * touch
        most += p.friction_load * max(tension + arm, 0.0)
        moved = x - self.x - self.share * p.slip * (freed - coil(p, self.temperature, 0.0)[1])
        contacts = np.clip(self.contacts + self.stiffness * moved, -self.weight * most, self.weight * most)
        return tension - touch + arm + contacts.sum(), contacts, arm

    def settle(self, temperature, seconds, load=None, position=None):
        def excess(x):
            wanted = load if position is None else (position + self.rest - x) * self.p.series_stiffness
            return self.trial(x, temperature, seconds)[0] - wanted

        x = brentq(excess, -0.05, 0.05, xtol=1e-15)
        force = load
        if position is not None:
            force = (position + self.rest - x) * self.p.series_stiffness
            if force < 0.0:
                x = brentq(lambda x: self.trial(x, temperature, seconds)[0], -0.05, 0.05, xtol=1e-15)
                force = 0.0
        _, self.contacts, self.arm = self.trial(x, temperature, seconds)
        self.x, self.temperature, self.force = x, temperature, force
        self.position = x - self.rest + force / self.p.series_stiffness if position is None else position

    def move(self, name, value):
        """Reach load or position in the plant's sub-steps."""
        begin, largest = (self.force, 0.1) if name == "hang" else (self.position, 0.1e-3)
        parts = math.ceil(abs(value - begin) / largest)
        for k in range(1, parts + 1):
            step = begin + (value - begin) * k / parts
            self.settle(self.temperature, 0.0, **{"load" if name == "hang" else "position": step})

    def heat(self, name, value, temperature):
        begin = self.temperature
        parts = max(math.ceil(abs(temperature - begin)), 1)
        for k in range(1, parts + 1):
            step = begin + (temperature - begin) * k / parts
            self.settle(step, 0.1 / parts, **{"load" if name == "hang" else "position": value})


class TestSpecimen:
    def test_contacts_are_those_of_the_population(self):
        stiffness, weight, share = kernels.contact_table(dataclasses.replace(PLAIN, contact_count=100_000))
        assert stiffness.sum() == pytest.approx(0.6)
        assert np.ptp(stiffness) == 0.0
        assert weight.sum() == pytest.approx(1.0)
        assert np.log(weight).std() == pytest.approx(0.8, rel=0.02)
        assert share.mean() == pytest.approx(1.0)
        assert share.min() >= 0.0
        assert share.std() == pytest.approx(1.0 / math.sqrt(3.0), rel=0.02)

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

    def test_starts_cold_unloaded_and_at_its_resting_length(self):
        muscle = make()
        assert muscle.snapshot() == pytest.approx((25.0, 25.0, 0.0, 0.0, 0.0, 0.0, 0.0), abs=1e-12)
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
            {"friction_load": 1.0},
            {"friction_coils": 1.0},
            {"pretension": 50.0},
            {"rated_voltage": 6.0},
            {"hot_stiffness": 2e3},
            {"ambient_temperature": -300.0},
        ],
    )
    def test_wrong_parameters_are_refused(self, wrong):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            CoiledPolymerParameters(**wrong)

    def test_parameters_are_frozen(self):
        with pytest.raises(dataclasses.FrozenInstanceError):
            PLAIN.softening = 2.0


class TestRanges:
    def test_force_at_constant_length(self):
        muscle = make()
        reset(muscle)
        muscle.clamp(muscle.position)
        force = []
        for voltage in VOLTAGES:
            muscle.apply(voltage)
            muscle.advance(60.0)
            force.append(muscle.force)
        assert force[0] == pytest.approx(0.3, abs=1e-4)
        assert max(force) == force[VOLTAGES.index(3.0)] == pytest.approx(8.7, abs=0.2)
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
                muscle.advance(60.0)
                travel.append(muscle.length * 1e3)
                assert muscle.force == pytest.approx(load)
            loops.append(voltage_loop(travel[-len(VOLTAGES) :]))
        travel = np.array(travel).reshape(len(LOADS), -1)
        assert travel.min() == pytest.approx(-7.1, abs=0.2)
        assert travel.max() == pytest.approx(6.5, abs=0.2)
        assert np.all(np.diff(travel, axis=0) > 0.0)
        # The coils touch under the lightest load: the last volts contract the muscle less than under the next.
        hot, warm = VOLTAGES.index(3.0), VOLTAGES.index(2.7)
        contraction = travel[:, warm] - travel[:, hot]
        assert contraction[0] < 0.5 * contraction[2]
        # The loops differ with the load.
        assert 0.07 < loops[0] < loops[-1] < 0.22
        assert loops[-1] > 1.5 * loops[0]

    def test_length_against_force_at_constant_voltage(self):
        muscle = make()
        for voltage in (0.0, 0.6, 1.2, 1.8, 2.4, 3.0):
            reset(muscle)
            muscle.apply(voltage)
            muscle.advance(120.0)
            loaded = copy.deepcopy(muscle)
            loaded.hang(10.5)
            loaded.advance(60.0)
            up = np.linspace(muscle.position, loaded.position, 12)
            force, length = [], []
            for place in [*up, *up[-2::-1]]:
                muscle.clamp(float(place))
                muscle.advance(60.0)
                force.append(muscle.force)
                length.append(muscle.length)
            assert force[0] == pytest.approx(0.3, abs=1e-4)
            assert force[11] == pytest.approx(10.5, abs=0.05)
            assert np.all(np.diff(force[:12]) > 0.0)
            assert np.all(np.diff(force[11:]) <= 0.0)
            assert 0.05 < widest((force[:12], length[:12]), (force[:10:-1], length[:10:-1])) < 0.20


class TestStatics:
    @pytest.mark.parametrize("voltage", [0.0, 1.5, 3.0])
    @pytest.mark.parametrize("load", [0.5, 4.9, 10.0])
    def test_without_friction_the_force_is_that_of_the_coil(self, voltage, load):
        muscle = make(ELASTIC)
        muscle.hang(load)
        muscle.apply(voltage)
        muscle.advance(600.0)
        assert muscle.temperature == pytest.approx(25.0 + 95.0 * (voltage / 3.0) ** 2)
        # Without friction the muscle as made is at its resting length.
        _, _, tension, touch = coil(ELASTIC, muscle.temperature, muscle.length)
        assert tension - touch == pytest.approx(load, abs=1e-8)
        assert (touch > 0.0) == (muscle.length < -6e-3)

    def test_touching_coils_end_the_contraction(self):
        free = make(dataclasses.replace(ELASTIC, coil_contact=0.0))
        touching = make(ELASTIC)
        for muscle in (free, touching):
            muscle.hang(0.5)
            muscle.apply(3.0)
            muscle.advance(300.0)
        assert free.length < -9e-3
        assert -9e-3 < touching.length < -6e-3

    def test_without_friction_nothing_is_remembered(self):
        muscle = make(ELASTIC)
        lengths = []
        for load, voltage in ((9.0, 3.0), (0.0, 0.0), (2.0, 1.0)):
            muscle.hang(load)
            muscle.apply(voltage)
            muscle.advance(300.0)
            muscle.hang(4.0)
            muscle.apply(2.0)
            muscle.advance(600.0)
            lengths.append(muscle.length)
        assert lengths == pytest.approx([lengths[0]] * 3, abs=1e-11)

    def test_arm_relaxes_after_a_step_of_the_load(self):
        muscle = make(ELASTIC)
        muscle.hang(5.0)
        muscle.advance(0.1)
        start = muscle.length
        lengths = []
        for _ in range(600):
            muscle.advance(0.1)
            lengths.append(muscle.length)
        steady = 5.0 / (1.3e3 - 0.4e3 * (1.0 - 1.0 / (1.0 + math.exp(-35.0 / 15.0))))
        # At once without the arm's share, then to the coil's alone, with the time constant of a standard solid.
        stiffness = 5.0 / steady
        assert start == pytest.approx(5.0 / (stiffness + 100.0), rel=2e-3)
        slowed = 6.0 * (1.0 + 100.0 / stiffness)
        expected = steady + (start - steady) * np.exp(-0.1 * np.arange(1, 601) / slowed)
        assert np.array(lengths) == pytest.approx(expected, abs=1e-8)

    def test_plant_equals_the_naive_equations(self):
        muscle = make(LIVELY, seed=5)
        naive = NaiveMuscle(muscle)
        script = np.random.default_rng(8)
        slack = touching = 0
        for k in range(300):
            if k % 25 == 0 and k < 225:
                name, value = "hang", float(script.uniform(0.0, 5.0))
                if script.random() < 0.5:
                    name, value = "clamp", float(script.uniform(-8e-3, 5e-3))
                getattr(muscle, name)(value)
            if k == 225:
                name, value = "hang", 0.5
                muscle.hang(value)
            if k % 60 == 0:
                muscle.apply(5.0 if k >= 180 else float(script.uniform(0.0, 5.0)))
            muscle.advance(0.1)
            naive.move(name, value)
            naive.heat(name, value, muscle.temperature)
            assert muscle.length == pytest.approx(naive.x - naive.rest, abs=1e-11)
            assert muscle.force == pytest.approx(naive.force, abs=1e-6)
            assert muscle.position == pytest.approx(naive.position, abs=1e-11)
            assert muscle._forces == pytest.approx(naive.contacts, abs=1e-7)
            slack += muscle.force == 0.0
            touching += naive.x < PLAIN.coil_length
        assert slack > 0
        assert touching > 0


# From a random past, one input is moved monotonically.
PASTS = st.lists(st.tuples(st.floats(0.0, 3.8), st.floats(0.0, 12.0)), max_size=5)


def with_past(past):
    muscle = make()
    for voltage, load in past:
        muscle.apply(voltage)
        muscle.hang(load)
        muscle.advance(200.0)
    return muscle


class TestDirections:
    @given(PASTS, st.floats(0.0, 12.0), st.lists(st.floats(0.0, 3.8), min_size=2, max_size=8), st.booleans())
    @settings(max_examples=40, deadline=None)
    def test_voltage_contracts(self, past, load, voltages, falling):
        muscle = with_past(past)
        muscle.hang(load)
        lengths = []
        for voltage in sorted(voltages, reverse=falling):
            muscle.apply(voltage)
            muscle.advance(200.0)
            lengths.append(muscle.length)
        # The first voltage may be reached from either side.
        assert np.all(np.diff(lengths) * (1 if falling else -1) >= -1e-11)

    @given(PASTS, st.floats(0.0, 3.8), st.lists(st.floats(0.0, 15.0), min_size=2, max_size=8), st.booleans())
    @settings(max_examples=40, deadline=None)
    def test_load_elongates(self, past, voltage, loads, falling):
        muscle = with_past(past)
        muscle.apply(voltage)
        muscle.advance(200.0)
        lengths = []
        for load in sorted(loads, reverse=falling):
            muscle.hang(load)
            muscle.advance(120.0)
            lengths.append(muscle.length)
        assert np.all(np.diff(lengths) * (-1 if falling else 1) >= -1e-11)

    @given(PASTS, st.floats(-6e-3, 4e-3), st.lists(st.floats(0.0, 3.8), min_size=2, max_size=8))
    @settings(max_examples=40, deadline=None)
    def test_voltage_pulls_at_constant_length(self, past, place, voltages):
        muscle = with_past(past)
        muscle.clamp(place)
        muscle.advance(120.0)
        forces = []
        for voltage in sorted(voltages):
            muscle.apply(voltage)
            muscle.advance(200.0)
            forces.append(muscle.force)
        assert np.all(np.diff(forces) >= -1e-7)

    @given(PASTS, st.booleans())
    @settings(max_examples=40, deadline=None)
    def test_nothing_changes_while_nothing_changes(self, past, held):
        muscle = with_past(past)
        muscle.advance(600.0)
        if held:
            muscle.clamp(muscle.position)
            muscle.advance(120.0)
        before = muscle.snapshot()
        muscle.advance(3600.0)
        assert muscle.snapshot() == before

    def test_settled_loops_hardly_depend_on_the_rate(self):
        lengths = []
        for parts in (1, 40):
            muscle = make()
            muscle.hang(4.0)
            for begin, end in ((0.0, 2.8), (2.8, 0.9), (0.9, 1.9)):
                for voltage in np.linspace(begin, end, parts + 1)[1:]:
                    muscle.apply(float(voltage))
                    muscle.advance(200.0 / parts)
                muscle.advance(200.0)
            lengths.append(muscle.length)
        # What is left is the yield force's dependence on the arm's tension.
        assert lengths[0] == pytest.approx(lengths[1], abs=2e-5)


class TestClamped:
    @given(
        st.lists(st.tuples(st.floats(-8e-3, 8e-3), st.floats(0.0, 3.0), st.integers(1, 60)), min_size=1, max_size=8)
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

    def test_slack_muscle_carries_nothing_and_tightens_when_heated(self):
        muscle = make()
        muscle.clamp(-4e-3)
        muscle.advance(60.0)
        assert muscle.force == 0.0
        assert muscle.length > muscle.position
        muscle.apply(3.0)
        muscle.advance(60.0)
        assert muscle.force > 5.0

    def test_overstretched_muscle_stays_at_the_limit(self):
        muscle = make()
        muscle.clamp(50e-3)
        muscle.advance(60.0)
        assert muscle.force == PLAIN.force_limit
        assert muscle.position == pytest.approx(50e-3)

    @pytest.mark.parametrize("voltage", [0.0, 1.5, 3.0])
    @pytest.mark.parametrize("load", [0.5, 4.9, 10.0])
    def test_changing_between_load_and_servo_is_continuous(self, load, voltage):
        muscle = make()
        muscle.hang(load)
        muscle.apply(voltage)
        muscle.advance(600.0)
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
    def test_heating_and_cooling_erases_the_memory(self):
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


class TestHeat:
    @pytest.mark.parametrize("voltage", [0.6, 1.5, 3.0])
    def test_time_constant(self, voltage):
        muscle = make()
        muscle.apply(voltage)
        rise = 95.0 * (voltage / 3.0) ** 2
        for k in range(1, 300):
            muscle.advance(0.1)
            assert muscle.temperature == pytest.approx(25.0 + rise * -math.expm1(-0.1 * k / 8.0), abs=1e-9)
        assert muscle.voltage == voltage
        assert muscle.current == pytest.approx(voltage / 12.0)

    def test_fan(self):
        muscle = make()
        muscle.apply(3.0)
        muscle.advance(600.0)
        muscle.apply(0.0)
        muscle.blow(True)
        muscle.advance(3.0)
        assert muscle.temperature == pytest.approx(25.0 + 95.0 / math.e)
        muscle.blow(False)
        muscle.advance(8.0)
        assert muscle.temperature == pytest.approx(25.0 + 95.0 / math.e**2)
        # More heat loss is less rise too.
        muscle.apply(3.0)
        muscle.blow(True)
        muscle.advance(200.0)
        assert muscle.temperature == pytest.approx(25.0 + 95.0 * 3.0 / 8.0)

    def test_ambient_statistics(self):
        muscle = make(CoiledPolymerParameters(contact_count=1, ambient_sd=0.3), seed=3)
        ambient = np.empty(6000)
        for k in range(ambient.size):
            muscle.advance(12.0)
            ambient[k] = muscle.ambient_temperature - 25.0
        assert ambient.std() == pytest.approx(0.3, rel=0.06)
        assert np.mean(ambient[:-10] * ambient[10:]) / ambient.var() == pytest.approx(math.exp(-1.0), abs=0.06)

    def test_ambient_changes_temperature_and_gain(self):
        # So slow that it stands still: the steady temperature is that of its deviation.
        muscle = make(CoiledPolymerParameters(contact_count=1, ambient_sd=2.0, ambient_time=1e12), seed=4)
        deviation = muscle.ambient_temperature - 25.0
        assert abs(deviation) > 0.1
        assert muscle.temperature == muscle.ambient_temperature
        muscle.apply(3.0)
        muscle.advance(600.0)
        expected = 25.0 + deviation + 95.0 * (1.0 + 0.004 * deviation)
        assert muscle.temperature == pytest.approx(expected, abs=1e-3)

    def test_ambient_is_off_by_default(self):
        muscle = make()
        muscle.advance(1000.0)
        assert muscle.ambient_temperature == muscle.temperature == 25.0


class TestTime:
    commands = st.one_of(
        st.tuples(st.just("apply"), st.floats(0.0, 3.0)),
        st.tuples(st.just("hang"), st.floats(0.0, 9.0)),
        st.tuples(st.just("clamp"), st.floats(-8e-3, 5e-3)),
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
        muscle = CoiledPolymerMuscle(LIVELY, rng)
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
            ("hang", 15.1, "load_newton"),
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
