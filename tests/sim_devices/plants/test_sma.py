import copy
import dataclasses
import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.plants import _sma_kernels as kernels
from sim_devices.plants.sma import SMAParameters, SMAWire, grain_table

PLAIN = SMAParameters()
SMALL = SMAParameters(grain_count=200)
LIVELY = SMAParameters(grain_count=200, ambient_sd=0.3)
LOADS = (0.98, 2.94, 4.90, 6.86, 8.82)


def make(parameters=PLAIN, seed=1):
    return SMAWire(parameters, np.random.default_rng(seed))


def reset(wire):
    """Heat to 3 V and cool to 0 V under 0.3 N."""
    wire.hang(0.3)
    wire.apply(3.0)
    wire.advance(60.0)
    wire.apply(0.0)
    wire.advance(120.0)


def voltages():
    """Set-points between ever closer extremes, in steps of about 0.46 V."""
    path = [0.0]
    for extreme in (3.0, 0.3, 2.7, 0.6, 2.4, 0.9, 2.1, 1.2, 1.8, 1.5):
        parts = max(round(abs(extreme - path[-1]) / 0.46), 1)
        path.extend(np.linspace(path[-1], extreme, parts + 1)[1:])
    return [float(v) for v in path]


def naive_update(temperature, stress, share, grains, martensite, oriented):
    """The rule of the grains, written as it reads."""
    finish, width, slope, detwin, orient, retwin = grains
    k = np.where(oriented, 1.0, share)
    wants_martensite = temperature - stress / slope < finish - width
    wants_austenite = temperature - k * stress / slope > finish
    leaves = martensite & wants_austenite & ~wants_martensite
    comes = ~martensite & wants_martensite
    martensite = (martensite & ~leaves) | comes
    oriented = np.where(comes, stress > orient, oriented)
    oriented = np.where(stress > detwin, True, np.where(stress < retwin, False, oriented))
    return martensite, oriented & martensite


def naive_position(wire, temperature, stress, martensite, oriented):
    """Position of the moving end, m, from the parameters."""
    p = wire.parameters
    share = martensite.mean()
    strain = stress * 1e6 * (share / p.martensite_modulus + (1.0 - share) / p.austenite_modulus)
    strain += p.expansion * (temperature - 25.0) + p.transformation_strain * oriented.mean()
    strain -= wire._coefficients[kernels.REST_STRAIN]
    return p.rest_length * strain + stress * 1e6 * p.area / p.series_stiffness


def taut_residual(wire):
    """How far the imposed position is from the one that wire and frame add up to, m."""
    return wire.position - wire.length - wire.force / wire.parameters.series_stiffness


# One grain's worth of transformation strain: closer the imposed length cannot be met.
def one_grain(parameters):
    return parameters.transformation_strain * parameters.rest_length / parameters.grain_count


class TestSpecimen:
    def test_grains_are_those_of_the_population(self):
        finish, width, slope, detwin, orient, retwin = grain_table(SMAParameters(grain_count=200_000))
        for values, mean, spread in ((finish, 48, 15), (width, 11, 3), (slope, 7, 0.8), (orient, -5, 60)):
            assert values.mean() == pytest.approx(mean, abs=0.02 * spread)
            assert values.std() == pytest.approx(spread, rel=0.02)
        assert np.median(detwin) == pytest.approx(110.0, abs=1.0)
        assert np.median(retwin) == pytest.approx(-40.0, abs=1.0)
        inner = detwin > 5.0
        # The regression, unlike the correlation, is not changed by leaving out the cut-off tail.
        assert np.polyfit(detwin[inner], orient[inner], 1)[0] == pytest.approx(0.6, abs=0.01)
        assert width.min() == 3.0
        assert detwin.min() == 5.0
        assert np.all(retwin <= detwin - 10.0)

    def test_specimen_does_not_depend_on_the_session(self):
        first, second = make(seed=1), make(seed=2)
        for wire in (first, second):
            wire.hang(5.0)
            wire.apply(2.0)
            wire.advance(20.0)
        assert first.snapshot() == second.snapshot()
        other = grain_table(dataclasses.replace(PLAIN, specimen_seed=7))
        assert not np.array_equal(other, grain_table(PLAIN))

    def test_starts_cold_unloaded_and_at_its_resting_length(self):
        wire = make()
        assert wire.temperature == 25.0
        assert wire.force == 0.0
        assert wire.length == pytest.approx(0.0, abs=1e-12)
        assert wire.position == pytest.approx(0.0, abs=1e-12)
        assert 0.5 < wire.oriented_fraction < wire.martensite_fraction < 1.0
        before = wire.snapshot()
        wire.advance(3600.0)
        assert wire.snapshot() == before

    @pytest.mark.parametrize(
        "wrong",
        [
            {"grain_count": 0},
            {"step": math.nan},
            {"unoriented_share": 1.5},
            {"orient_correlation": -1.1},
            {"ambient_sd": -0.1},
            {"martensite_modulus": 60e9},
            {"pretension": 20.0},
            {"ambient_temperature": -300.0},
        ],
    )
    def test_wrong_parameters_are_refused(self, wrong):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            SMAParameters(**wrong)

    def test_parameters_are_frozen(self):
        with pytest.raises(dataclasses.FrozenInstanceError):
            PLAIN.width = 2.0


class TestRanges:
    def test_force_at_constant_length(self):
        wire = make()
        wire.hang(0.3)
        wire.advance(0.1)
        wire.clamp(wire.position)
        force = []
        for voltage in voltages():
            wire.apply(voltage)
            wire.advance(30.0)
            force.append(wire.force)
        assert force[0] == pytest.approx(0.3, abs=0.02)
        assert min(force) < 0.3
        assert max(force) == pytest.approx(11.4, abs=0.3)
        # The memory: coming down, the same voltage holds more force than going up, by a tenth of the range.
        top, bottom = voltages().index(3.0), voltages().index(0.3)
        up = np.interp(1.8, voltages()[: top + 1], force[: top + 1])
        down = np.interp(1.8, voltages()[bottom : top - 1 : -1], force[bottom : top - 1 : -1])
        assert down > up + 1.0

    def test_length_at_constant_load(self):
        wire = make()
        travel = []
        for load in LOADS:
            reset(wire)
            wire.hang(load)
            for voltage in voltages():
                wire.apply(voltage)
                wire.advance(30.0)
                travel.append(wire.length * 1e3)
                assert wire.force == pytest.approx(load)
        travel = np.array(travel).reshape(len(LOADS), -1)
        assert np.ptp(travel) == pytest.approx(5.7, abs=0.1)
        # A heavier load stretches the cold wire further, and heat contracts it always.
        assert np.all(np.diff(travel[:, 0]) > 0.0)
        # Once all is austenite, thermal expansion is left.
        hottest = travel[:, np.argmax(voltages())]
        assert np.all(hottest - travel.min(axis=1) < 0.02)
        assert np.all(np.ptp(travel, axis=1) > 2.5)

    def test_length_against_force_at_constant_voltage(self):
        wire = make()
        travel, force = [], []
        for voltage in (0.0, 0.6, 1.2, 1.8, 2.4, 3.0):
            reset(wire)
            wire.hang(0.0)
            wire.apply(voltage)
            wire.advance(60.0)
            loaded = copy.deepcopy(wire)
            loaded.hang(10.5)
            loaded.advance(0.1)
            up = np.linspace(wire.position, loaded.position, 12)
            branch = []
            for place in [*up, *up[-2::-1]]:
                wire.clamp(float(place))
                wire.advance(30.0)
                travel.append(wire.length * 1e3)
                branch.append(wire.force)
            assert branch[11] == pytest.approx(10.5, abs=0.1)
            assert np.all(np.diff(branch[:12]) > 0.0)
            assert np.all(np.diff(branch[11:]) <= 0.0)
            # Unloading goes below loading: the loop dissipates.
            assert np.all(np.array(branch[12:22]) < np.array(branch[10:0:-1]) + 0.05)
            force += branch
        assert np.ptp(travel) == pytest.approx(6.0, abs=0.15)
        assert len(travel) == 138
        assert min(force) >= 0.0


def random_grains(seed, count=300):
    rng = np.random.default_rng(seed)
    grains = grain_table(SMAParameters(grain_count=count, specimen_seed=seed))
    martensite = rng.random(count) < 0.5
    return grains, martensite, martensite & (rng.random(count) < 0.5)


class TestGrains:
    paths = st.lists(
        st.tuples(st.floats(0.0, 140.0), st.one_of(st.just(0.0), st.floats(0.0, 600.0))), min_size=1, max_size=25
    )

    @given(paths, st.integers(0, 20), st.sampled_from([0.4, 1.0]))
    @settings(max_examples=80, deadline=None)
    def test_kernel_equals_the_naive_rule(self, path, seed, share):
        grains, martensite, oriented = random_grains(seed)
        expected = martensite.copy(), oriented.copy()
        for temperature, stress in path:
            counts = kernels.update_grains(temperature, stress, share, grains, martensite, oriented)
            expected = naive_update(temperature, stress, share, grains, *expected)
            assert np.array_equal(martensite, expected[0])
            assert np.array_equal(oriented, expected[1])
            assert counts == (expected[0].sum(), expected[1].sum())

    @given(st.floats(0.0, 140.0), st.floats(0.0, 600.0), st.integers(0, 20))
    @settings(max_examples=60, deadline=None)
    def test_nothing_changes_while_nothing_changes(self, temperature, stress, seed):
        grains, martensite, oriented = random_grains(seed)
        # Twice: a grain that has lost its orientation is less stable, which the next update sees.
        for _ in range(2):
            kernels.update_grains(temperature, stress, 0.4, grains, martensite, oriented)
        before = martensite.copy(), oriented.copy()
        kernels.update_grains(temperature, stress, 0.4, grains, martensite, oriented)
        assert np.array_equal(martensite, before[0])
        assert np.array_equal(oriented, before[1])

    @given(st.floats(0.0, 140.0), st.lists(st.floats(0.0, 600.0), min_size=2, max_size=30), st.integers(0, 20))
    @settings(max_examples=60, deadline=None)
    def test_trial_length_never_falls_with_stress(self, temperature, stresses, seed):
        wire = make(SMALL)
        grains, martensite, oriented = random_grains(seed)
        places = []
        for stress in sorted(stresses):
            trial = naive_update(temperature, stress, 0.4, grains, martensite, oriented)
            places.append(naive_position(wire, temperature, stress, *trial))
        assert np.all(np.diff(places) >= 0.0)

    @given(st.floats(0.0, 140.0), st.floats(-6.0, 8.0), st.floats(0.0, 400.0), st.integers(0, 20))
    @settings(max_examples=80, deadline=None)
    def test_solution_equals_bisection_on_naive_trials(self, temperature, millimetres, committed, seed):
        wire = make(SMALL)
        grains, martensite, oriented = random_grains(seed)

        def place(stress):
            trial = naive_update(temperature, stress, 0.4, grains, martensite, oriented)
            return naive_position(wire, temperature, stress, *trial) * 1e3

        low, high = 0.0, 600.0
        if place(low) >= millimetres:
            expected = low
        elif place(high) <= millimetres:
            expected = high
        else:
            for _ in range(34):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if place(middle) <= millimetres else (low, middle)
            expected = low if low >= committed else high
        before = martensite.copy(), oriented.copy()
        scratch = np.empty((2, martensite.size))
        found = kernels.solve_stress(
            millimetres, temperature, committed, wire._coefficients, grains, martensite, oriented, scratch
        )
        assert found == pytest.approx(expected, abs=1e-7)
        # A trial leaves the committed state alone.
        assert np.array_equal(martensite, before[0])
        assert np.array_equal(oriented, before[1])

    @pytest.mark.parametrize("celsius_volt", [0.0, 1.2, 1.8, 3.0])
    def test_length_is_monotone_along_a_monotone_load(self, celsius_volt):
        wire = make()
        wire.apply(celsius_volt)
        wire.advance(100.0)
        loads = np.linspace(0.0, 18.0, 120)
        for path in (loads, loads[::-1]):
            lengths = []
            for load in path:
                wire.hang(float(load))
                wire.advance(0.1)
                lengths.append(wire.length)
            assert np.all(np.diff(lengths) * (path[-1] - path[0]) >= -1e-12)

    def test_plant_equals_a_brute_force_of_all_grains(self):
        """Follow a wire under dead loads through every sub-step."""
        wire = make(SMAParameters(ambient_sd=0.3), seed=5)
        grains = grain_table(wire.parameters)
        state = wire._martensite.copy(), wire._oriented.copy()
        temperature, stress = wire.temperature, 0.0
        script = np.random.default_rng(8)
        visited = []
        for k in range(1200):
            if k % 60 == 0:
                load = float(script.uniform(0.0, 9.0))
                wire.hang(load)
            if k % 90 == 0:
                wire.apply(float(script.uniform(0.0, 3.0)))
            target = load / wire._coefficients[kernels.AREA]
            wire.advance(0.1)
            parts = math.ceil(abs(target - stress) / 4.0)
            for part in range(1, parts + 1):
                state = naive_update(temperature, stress + (target - stress) * part / parts, 0.4, grains, *state)
            stress = target
            parts = math.ceil(abs(wire.temperature - temperature))
            for part in range(1, parts + 1):
                warm = temperature + (wire.temperature - temperature) * part / parts
                state = naive_update(warm, stress, 0.4, grains, *state)
            temperature = wire.temperature
            assert np.array_equal(wire._martensite, state[0])
            assert np.array_equal(wire._oriented, state[1])
            expected = naive_position(wire, temperature, stress, *state)
            assert wire.position == pytest.approx(expected, abs=1e-12)
            assert wire.length == pytest.approx(expected - load / 20e3, abs=1e-12)
            visited.append(wire.martensite_fraction)
        assert min(visited) < 0.05
        assert max(visited) > 0.7

    def test_memory_of_a_large_step_is_that_of_small_ones(self):
        once, bit_by_bit = make(), make()
        once.hang(9.0)
        once.advance(0.1)
        for load in np.linspace(0.0, 9.0, 73):
            bit_by_bit.hang(float(load))
            bit_by_bit.advance(0.1)
        assert np.array_equal(once._oriented, bit_by_bit._oriented)
        assert once.length == bit_by_bit.length


class TestClamped:
    @given(
        st.lists(st.tuples(st.floats(-3e-3, 4e-3), st.floats(0.0, 3.0), st.integers(1, 150)), min_size=1, max_size=8)
    )
    @settings(max_examples=25, deadline=None)
    def test_imposed_length_is_met_or_the_wire_is_slack(self, script):
        wire = make()
        tolerance = 1.5 * one_grain(PLAIN)
        for place, voltage, steps in script:
            wire.clamp(place)
            wire.apply(voltage)
            for _ in range(steps):
                wire.advance(0.1)
                assert wire.position == pytest.approx(place, abs=1e-15)
                if wire.force == 0.0:
                    # Slack: longer than the room it has.
                    assert taut_residual(wire) <= tolerance
                else:
                    assert abs(taut_residual(wire)) <= tolerance
                assert 0.0 <= wire.force < PLAIN.largest_load

    def test_finer_grains_meet_the_length_more_closely(self):
        parameters = SMAParameters(grain_count=10_000)
        wire = make(parameters)
        for place in (1e-3, 2e-3, 1.3e-3):
            wire.clamp(place)
            wire.advance(0.1)
            assert wire.force > 0.1
            assert abs(taut_residual(wire)) <= 1.01 * one_grain(parameters)

    def test_slack_wire_carries_nothing_and_tightens_when_heated(self):
        wire = make()
        wire.clamp(-1e-3)
        wire.advance(10.0)
        assert wire.force == 0.0
        assert wire.length > wire.position
        wire.apply(3.0)
        wire.advance(60.0)
        assert wire.force > 5.0
        assert wire.length < wire.position

    def test_overstretched_wire_stays_at_the_limit(self):
        wire = make()
        wire.clamp(50e-3)
        wire.advance(0.1)
        assert wire.force == pytest.approx(PLAIN.largest_load)

    @pytest.mark.parametrize("voltage", [0.0, 1.4])
    def test_solution_stays_the_solution(self, voltage):
        """A solved state, solved again, is the same: on the way out and back, at every grain's switch."""
        wire = make()
        wire.apply(voltage)
        wire.advance(200.0)
        out = np.linspace(0.0, 4e-3, 60)
        for place in [*out, *out[::-1]]:
            wire.clamp(float(place))
            wire.advance(0.1)
            stress = float(wire._state[kernels.STRESS])
            again = kernels.solve_stress(
                float(wire._state[kernels.POSITION]),
                wire.temperature,
                stress,
                wire._coefficients,
                wire._grains,
                wire._martensite,
                wire._oriented,
                wire._scratch,
            )
            assert again == pytest.approx(stress, abs=1e-7)

    def test_holding_still_holds_the_force(self):
        wire = make()
        wire.clamp(1.5e-3)
        wire.apply(1.6)
        wire.advance(300.0)
        before = wire.snapshot()
        wire.advance(600.0)
        after = wire.snapshot()
        assert after.force == pytest.approx(before.force, abs=1e-6)
        assert after.oriented_fraction == before.oriented_fraction

    @pytest.mark.parametrize("voltage", [0.0, 1.5, 3.0])
    @pytest.mark.parametrize("load", [0.5, 4.9, 10.0])
    def test_changing_between_load_and_servo_is_continuous(self, load, voltage):
        wire = make()
        wire.hang(load)
        wire.apply(voltage)
        wire.advance(300.0)
        before = wire.snapshot()
        wire.clamp(wire.position)
        assert wire.snapshot() == before
        wire.advance(1.0)
        # One grain of 2000 more or less is worth some 0.02 N.
        assert wire.force == pytest.approx(before.force, abs=0.02)
        assert wire.length == pytest.approx(before.length, abs=2.0 * one_grain(PLAIN))
        held = wire.snapshot()
        wire.hang(held.force)
        assert wire.snapshot() == held
        wire.advance(1.0)
        assert wire.force == pytest.approx(held.force, abs=1e-9)
        assert wire.length == pytest.approx(held.length, abs=2.0 * one_grain(PLAIN))
        assert wire.position == pytest.approx(held.position, abs=2.0 * one_grain(PLAIN))

    def test_slack_end_comes_back_to_the_wire(self):
        wire = make()
        wire.clamp(-2e-3)
        wire.advance(1.0)
        assert wire.position == pytest.approx(-2e-3)
        length = wire.length
        wire.hang(0.0)
        wire.advance(1.0)
        assert wire.position == wire.length == pytest.approx(length, abs=1e-9)


class TestReset:
    def test_heating_and_cooling_erases_the_memory(self):
        """Whatever was done to the wire, after a reset it is the same."""
        script = np.random.default_rng(3)
        wires = [make() for _ in range(4)]
        results = []
        for wire in wires:
            for _ in range(6):
                if script.random() < 0.5:
                    wire.hang(float(script.uniform(0.0, 9.0)))
                else:
                    wire.clamp(float(script.uniform(-2e-3, 3e-3)))
                wire.apply(float(script.uniform(0.0, 3.0)))
                wire.advance(float(script.uniform(1.0, 30.0)))
            reset(wire)
            results.append(wire.snapshot())
        for result in results[1:]:
            assert result == pytest.approx(results[0], abs=1e-8)
        assert wires[0].temperature == pytest.approx(25.0, abs=1e-8)

    def test_conditioning_has_a_purpose(self):
        """Isometric cycles lengthen the wire against one that has only been reset."""
        wire = make()
        wire.hang(0.3)
        wire.advance(1.0)
        conditioned = wire.length
        reset(wire)
        assert 0.1e-3 < conditioned - wire.length < 1.5e-3


class TestHeat:
    @pytest.mark.parametrize("voltage", [0.6, 1.5, 3.0])
    def test_time_constant(self, voltage):
        wire = make(SMALL)
        wire.apply(voltage)
        rise = 85.0 * (voltage / 3.0) ** 2
        for k in range(1, 200):
            wire.advance(0.1)
            assert wire.temperature == pytest.approx(25.0 + rise * -math.expm1(-0.1 * k / 5.0), abs=1e-9)
        wire.advance(300.0)
        assert wire.temperature == pytest.approx(25.0 + rise, abs=1e-9)
        assert wire.voltage == voltage
        assert wire.current == pytest.approx(voltage / 3.05)

    def test_fan(self):
        wire = make(SMALL)
        wire.apply(3.0)
        wire.advance(300.0)
        wire.apply(0.0)
        wire.blow(True)
        wire.advance(2.0)
        assert wire.temperature == pytest.approx(25.0 + 85.0 / math.e)
        wire.blow(False)
        wire.advance(5.0)
        assert wire.temperature == pytest.approx(25.0 + 85.0 / math.e**2)
        # More heat loss is less rise too.
        wire.apply(3.0)
        wire.blow(True)
        wire.advance(100.0)
        assert wire.temperature == pytest.approx(25.0 + 85.0 * 2.0 / 5.0)

    def test_ambient_statistics(self):
        wire = make(SMAParameters(grain_count=1, ambient_sd=0.3), seed=3)
        ambient = np.empty(6000)
        for k in range(ambient.size):
            wire.advance(12.0)
            ambient[k] = wire.ambient_temperature - 25.0
        assert ambient.std() == pytest.approx(0.3, rel=0.06)
        assert np.mean(ambient[:-10] * ambient[10:]) / ambient.var() == pytest.approx(math.exp(-1.0), abs=0.06)
        starts = [make(SMAParameters(grain_count=1, ambient_sd=0.3), seed=s).ambient_temperature for s in range(300)]
        assert np.std(starts) == pytest.approx(0.3, rel=0.15)

    def test_ambient_changes_temperature_and_gain(self):
        # So slow that it stands still: the steady temperature is that of its deviation.
        wire = make(SMAParameters(grain_count=1, ambient_sd=2.0, ambient_time=1e12), seed=4)
        deviation = wire.ambient_temperature - 25.0
        assert abs(deviation) > 0.1
        assert wire.temperature == wire.ambient_temperature
        wire.apply(3.0)
        wire.advance(300.0)
        expected = 25.0 + deviation + 85.0 * (1.0 + 0.004 * deviation)
        assert wire.temperature == pytest.approx(expected, abs=1e-3)

    def test_ambient_is_off_by_default(self):
        wire = make()
        wire.advance(1000.0)
        assert wire.ambient_temperature == wire.temperature == 25.0


class TestTime:
    commands = st.one_of(
        st.tuples(st.just("apply"), st.floats(0.0, 3.0)),
        st.tuples(st.just("hang"), st.floats(0.0, 9.0)),
        st.tuples(st.just("clamp"), st.floats(-3e-3, 4e-3)),
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

    @pytest.mark.parametrize("part", [0.01, 0.0123, 1.0 / 3.0, 0.7, 60.0])
    def test_hours_in_parts(self, part):
        """Rounding does not add up, and blocks of noise are used up alike."""
        whole, split = make(LIVELY), make(LIVELY)
        parts = min(20000, round(3600.0 / part))
        for wire in (whole, split):
            wire.clamp(1e-3)
            wire.apply(1.7)
        for _ in range(parts):
            split.advance(part)
        whole.advance(part * parts)
        assert split.snapshot() == whole.snapshot()

    def test_outputs_are_held_between_grid_points(self):
        wire = make(SMALL)
        wire.hang(2.0)
        begin = wire.snapshot()
        wire.advance(0.06)
        assert wire.snapshot() == begin
        wire.advance(0.04)
        assert wire.force == pytest.approx(2.0)

    def test_one_seed_one_trajectory(self):
        def run(seed):
            wire = make(LIVELY, seed=seed)
            rows = []
            for k in range(60):
                wire.apply(1.5 + math.sin(0.7 * k))
                (wire.clamp if k % 20 < 10 else wire.hang)(1e-3 if k % 20 < 10 else 3.0)
                wire.advance(3.0)
                rows.append(wire.snapshot())
            return rows

        assert run(1) == run(1)
        assert run(1) != run(2)

    def test_other_users_of_the_generator_do_not_disturb(self):
        rng = np.random.default_rng(1)
        wire = SMAWire(LIVELY, rng)
        rng.standard_normal(1000)
        reference = make(LIVELY, seed=1)
        for each in (wire, reference):
            each.advance(1000.0)
        assert wire.snapshot() == reference.snapshot()

    def test_snapshot_agrees_with_the_outputs(self):
        wire = make(LIVELY)
        wire.hang(3.0)
        wire.apply(2.0)
        wire.advance(7.0)
        for name, value in wire.snapshot()._asdict().items():
            assert value == getattr(wire, name)
            assert type(value) is float

    def test_four_hours_take_seconds(self):
        wire = make(SMAParameters(ambient_sd=0.3))
        wire.clamp(1e-3)
        wire.advance(1.0)
        begin = time.perf_counter()
        for k in range(450):
            # The share of points at constant length that an identification campaign has.
            (wire.clamp if k % 5 < 2 else wire.hang)(1e-3 if k % 5 < 2 else 4.9)
            wire.apply(1.5 + 1.5 * math.sin(0.7 * k))
            wire.advance(30.0)
        # Measured 2 s; the bound leaves room for a loaded machine.
        assert time.perf_counter() - begin < 30.0


class TestRefusals:
    @pytest.mark.parametrize("dt", [-1e-9, math.nan, math.inf])
    def test_advance(self, dt):
        with pytest.raises(ValueError, match="dt must"):
            make(SMALL).advance(dt)

    @pytest.mark.parametrize(
        ("command", "value", "name"),
        [
            ("apply", -0.1, "voltage"),
            ("apply", 5.1, "voltage"),
            ("apply", math.nan, "voltage"),
            ("hang", -0.1, "load_newton"),
            ("hang", 19.0, "load_newton"),
            ("hang", math.nan, "load_newton"),
            ("clamp", 0.2, "length_metre"),
            ("clamp", -0.2, "length_metre"),
            ("clamp", math.nan, "length_metre"),
        ],
    )
    def test_commands(self, command, value, name):
        wire = make(SMALL)
        before = wire.snapshot()
        with pytest.raises(ValueError, match=f"{name} must lie"):
            getattr(wire, command)(value)
        wire.advance(1.0)
        assert wire.snapshot() == before
