import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from sim_devices.plants import _sma_kernels as kernels
from sim_devices.plants.sma import SMAParameters, SMAWire, grain_table

PLAIN = SMAParameters()
SMALL = SMAParameters(grain_count=200)
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
    strain -= wire._coefficients["rest_strain"][0]
    return p.rest_length * strain + stress * 1e6 * p.area / p.series_stiffness


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
        scratch, quiet = np.empty((2, martensite.size)), np.zeros(kernels.QUIET_SIZE)
        found = kernels.solve_stress(
            millimetres,
            temperature,
            committed,
            kernels.Parts(wire._state, wire._coefficients, grains, martensite, oriented, scratch, quiet),
        )
        assert found == pytest.approx(expected, abs=1e-7)
        # A trial leaves the committed state alone.
        assert np.array_equal(martensite, before[0])
        assert np.array_equal(oriented, before[1])

    def test_plant_equals_a_brute_force_of_all_grains(self):
        """Follow a wire under dead loads through every sub-step."""
        wire = make(SMAParameters(ambient_sd=0.3), seed=5)
        grains = grain_table(wire.parameters)
        state = wire._parts.martensite.copy(), wire._parts.oriented.copy()
        temperature, stress = wire.temperature, 0.0
        script = np.random.default_rng(8)
        visited = []
        for k in range(1200):
            if k % 60 == 0:
                load = float(script.uniform(0.0, 9.0))
                wire.hang(load)
            if k % 90 == 0:
                wire.apply(float(script.uniform(0.0, 3.0)))
            target = load / wire._coefficients["area"][0]
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
            assert np.array_equal(wire._parts.martensite, state[0])
            assert np.array_equal(wire._parts.oriented, state[1])
            expected = naive_position(wire, temperature, stress, *state)
            assert wire.position == pytest.approx(expected, abs=1e-12)
            assert wire.length == pytest.approx(expected - load / 20e3, abs=1e-12)
            visited.append(wire.martensite_fraction)
        assert min(visited) < 0.05
        assert max(visited) > 0.7

    @given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([0.0, 0.3, 2.0]))
    @settings(max_examples=25, deadline=None)
    def test_quiet_surroundings_change_no_bit(self, seed, clamped, ambient_sd):
        """Compare with a wire that forgets its quiet surroundings and so looks at every grain in each step."""
        parameters = SMAParameters(grain_count=200, ambient_sd=ambient_sd)
        wire, thorough = make(parameters, seed), make(parameters, seed)
        script = np.random.default_rng(seed)
        used = 0
        for _ in range(12):
            voltage, load, place = script.uniform([0.0, 0.0, -1e-3], [3.0, 9.0, 5e-3])
            for each in (wire, thorough):
                each.apply(voltage)
                if clamped:
                    each.clamp(place)
                else:
                    each.hang(load)
            for _ in range(40):
                before = wire._parts.quiet.copy()
                wire.advance(0.1)
                used += before[kernels.KELVIN] > 0.0 and np.array_equal(wire._parts.quiet, before)
                thorough._parts.quiet[:] = 0.0
                thorough.advance(0.1)
                assert np.array_equal(wire._state, thorough._state)
                assert np.array_equal(wire._parts.martensite, thorough._parts.martensite)
                assert np.array_equal(wire._parts.oriented, thorough._parts.oriented)
        assert used > 40


class TestClamped:
    def test_finer_grains_meet_the_length_more_closely(self):
        parameters = SMAParameters(grain_count=10_000)
        wire = make(parameters)
        for place in (1e-3, 2e-3, 1.3e-3):
            wire.clamp(place)
            wire.advance(0.1)
            assert wire.force > 0.1
            # One grain's worth of transformation strain: closer the imposed length cannot be met.
            one_grain = parameters.transformation_strain * parameters.rest_length / parameters.grain_count
            assert abs(wire.position - wire.length - wire.force / parameters.series_stiffness) <= 1.01 * one_grain


class TestConditioning:
    def test_conditioning_has_a_purpose(self):
        """Isometric cycles lengthen the wire against one that has only been reset."""
        wire = make()
        wire.hang(0.3)
        wire.advance(1.0)
        conditioned = wire.length
        reset(wire)
        assert 0.1e-3 < conditioned - wire.length < 1.5e-3
