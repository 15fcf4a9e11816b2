import dataclasses
import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st
from plant_outputs import snapshot

from sim_devices.plants import _vo2_kernels as kernels
from sim_devices.plants.vo2 import VO2Cantilever, VO2Parameters, arc_deflection, relay_thresholds

QUIET = VO2Parameters(wander_sd=0.0, drift_sd=0.0)
SMALL = VO2Parameters(relay_count=512)


def make(parameters=QUIET, seed=1, **kwargs):
    return VO2Cantilever(parameters, np.random.default_rng(seed), **kwargs)


def quasi_static(plant, targets, dwell=3.0):
    """Film temperature, curvature and R fraction at each set-point."""
    rows = []
    for target in targets:
        plant.regulate(float(target))
        plant.advance(dwell)
        rows.append((plant.film_temperature, plant.curvature, plant.r_fraction))
    return np.array(rows)


def staircase(start, stop, step):
    return np.linspace(start, stop, round(abs(stop - start) / step) + 1)


@pytest.fixture(scope="module")
def major_loop():
    plant = make()
    quasi_static(plant, [21.0])
    up = quasi_static(plant, staircase(21.0, 84.0, 0.1))
    down = quasi_static(plant, staircase(84.0, 21.0, 0.1))
    return up, down


class TestSpecimen:
    def test_thresholds_are_those_of_two_populations(self):
        up, down = relay_thresholds(VO2Parameters())
        assert up.size == down.size == 16384
        assert np.all(np.diff(up) >= 0.0)
        assert np.all(down <= up)
        assert up.max() <= 69.8
        assert down.min() >= 30.2
        width = up - down
        # Reflection folds the upper tail of the up-thresholds, so compare what it leaves alone.
        assert np.median(up) == pytest.approx(63.4, abs=0.15)
        assert np.median(width) == pytest.approx(4.0 / math.sqrt(1.25), rel=0.06)
        assert np.mean(width > 12.0) == pytest.approx(0.03 + 0.004, abs=0.015)
        major_up, major_down = relay_thresholds(VO2Parameters(minor_share=0.0, highest_threshold=99.0))
        major_width = major_up - major_down
        assert major_up.mean() == pytest.approx(63.5, abs=0.02)
        assert major_up.std() == pytest.approx(3.0, abs=0.03)
        assert major_width.mean() == pytest.approx(4.0, abs=0.05)
        assert major_width.std() == pytest.approx(2.0, abs=0.1)
        assert np.corrcoef(major_up, np.log(major_width))[0, 1] == pytest.approx(-0.3, abs=0.02)

    @cases("seed", [0, 2013])
    def test_short_moves_sweep_as_many_relays_as_the_density_has(self, seed):
        """A random sample of as many relays would scatter by the root of their number."""

        def swept(parameters, move=0.15):
            up, down = relay_thresholds(parameters)
            numbers = [
                np.count_nonzero((up >= start) & (up < start + move) & (down > turn))
                for turn in np.arange(54.0, 64.0, 1.0)
                for start in np.arange(turn + 1.0, turn + 4.5, 0.3)
            ]
            return np.array(numbers) / up.size

        specimen = dataclasses.replace(QUIET, specimen_seed=seed)
        expected = QUIET.relay_count * swept(dataclasses.replace(specimen, relay_count=2**18, specimen_seed=5))
        found = QUIET.relay_count * swept(specimen)
        assert expected.min() < 5.0 < 50.0 < expected.max()
        assert np.sqrt(np.mean((found - expected) ** 2)) < 0.6 * math.sqrt(expected.mean())

    def test_specimen_does_not_depend_on_the_session(self):
        first, second = make(seed=1), make(seed=2)
        curves = [quasi_static(plant, [60.0, 66.0, 63.0])[:, 1:] for plant in (first, second)]
        assert np.array_equal(*curves)
        other = relay_thresholds(dataclasses.replace(QUIET, specimen_seed=7))
        assert not np.array_equal(other[0], relay_thresholds(QUIET)[0])


class TestHysteresis:
    def test_range_of_the_major_loop(self, major_loop):
        curvature = np.concatenate([branch[:, 1] for branch in major_loop])
        assert curvature.min() == pytest.approx(-96.0, abs=1.5)
        assert curvature.max() == pytest.approx(1838.0, abs=2.5)

    def test_coupling_breaks_congruency(self):
        """Minor loops between the same temperatures differ in height: no Preisach operator does that."""
        difference = {}
        for coupling in (0.0, 1.0):
            heights = []
            for history in (21.0, 84.0):
                plant = make(dataclasses.replace(QUIET, coupling=coupling))
                quasi_static(plant, [history], dwell=8.0)
                fraction = quasi_static(plant, [60.0, 64.0, 60.0, 64.0, 60.0], dwell=30.0)[:, 2]
                heights.append(fraction[3] - fraction[4])
            difference[coupling] = heights[0] - heights[1]
        assert difference[0.0] == 0.0
        assert abs(difference[1.0]) > 5e-4

    @given(
        path=st.lists(st.floats(20.0, 90.0), min_size=1, max_size=30),
        seed=st.integers(0, 5),
    )
    @settings(max_examples=40, deadline=None)
    def test_relays_equal_the_naive_rule(self, path, seed):
        parameters = dataclasses.replace(SMALL, specimen_seed=seed)
        up, down = relay_thresholds(parameters)
        order = np.argsort(down, kind="stable")
        counters = np.zeros(kernels.COUNTER_SIZE, dtype=np.int64)
        on = np.zeros(up.size, dtype=np.bool_)
        naive = on.copy()
        # A threshold itself is the edge case: neither above nor below.
        for drive in [*path, float(up[7]), float(down[7]), float(up[500]), float(down[500])]:
            kernels.switch_relays(drive, counters, up, down[order], order, on)
            naive[drive > up] = True
            naive[drive < down] = False
            assert np.array_equal(on, naive)
            assert counters[kernels.ON_COUNT] == naive.sum()

    def test_plant_equals_a_brute_force_of_all_relays(self):
        parameters = VO2Parameters(session_offset=0.1)
        plant = make(parameters, seed=5)
        up, down = relay_thresholds(parameters)
        on = np.zeros(up.size, dtype=bool)
        drive, fraction = 0.0, 0.0

        def settle():
            nonlocal drive, fraction
            while True:
                move = plant.film_temperature + parameters.coupling * (fraction - 0.5) - drive
                last = abs(move) <= parameters.relay_step
                drive = drive + move if last else drive + math.copysign(parameters.relay_step, move)
                on[drive > up] = True
                on[drive < down] = False
                fraction = np.count_nonzero(on) / on.size
                if last:
                    return

        # The sub-steps below every threshold switch nothing, so where the start counts from is free.
        settle()
        targets = np.random.default_rng(8)
        visited = []
        for k in range(1600):
            if k % 40 == 0:
                plant.regulate(float(targets.uniform(50.0, 74.0)))
            plant.advance(0.05)
            # Follow the plant's own rounding of the drive; that it agrees is a check as well.
            settle()
            assert drive == pytest.approx(float(plant._state[kernels.DRIVE]), abs=1e-9)
            drive = float(plant._state[kernels.DRIVE])
            assert plant.r_fraction == fraction
            assert np.array_equal(plant._parts.on, on)
            visited.append(fraction)
        assert min(visited) < 0.05
        assert max(visited) > 0.95

    def test_start_is_negative_saturation(self):
        assert make().r_fraction == 0.0
        assert make(initial_temperature=90.0).r_fraction == 1.0
        # Warm, but reached from the cold: like the heating branch.
        plant = make(initial_temperature=64.0)
        plant.regulate(64.0)
        plant.advance(1.0)
        reference = make()
        quasi_static(reference, staircase(22.0, 64.0, 0.1), dwell=2.0)
        assert plant.r_fraction == pytest.approx(reference.r_fraction, abs=0.005)


class TestRegulatedPlate:
    def test_matches_the_continuous_loop(self):
        plant = make()
        quasi_static(plant, [50.0], dwell=60.0)
        plant.regulate(52.0)
        frequency, damping = 2.2, 0.9
        swing = frequency * math.sqrt(1.0 - damping**2)
        for k in range(1, 100):
            plant.advance(0.05)
            t = 0.05 * k
            wave = math.cos(swing * t) + damping * frequency / swing * math.sin(swing * t)
            exact = 52.0 - 2.0 * math.exp(-damping * frequency * t) * wave
            assert plant.plate_temperature == pytest.approx(exact, abs=1e-9)

    def test_target_out_of_reach_of_the_limit(self):
        plant = make()
        plant.regulate(84.0, current_limit=0.5)
        plant.advance(3600.0)
        assert plant.current == pytest.approx(0.5)
        driven = make()
        driven.drive(0.5)
        driven.advance(3600.0)
        assert plant.plate_temperature == pytest.approx(driven.plate_temperature, abs=1e-3)
        assert plant.plate_temperature < 60.0

    def test_limits_are_kept_over_hard_work(self):
        plant = make()
        targets = np.random.default_rng(2)
        for _ in range(200):
            plant.regulate(float(targets.uniform(10.0, 90.0)), current_limit=2.0)
            for _ in range(20):
                plant.advance(0.05)
                assert abs(plant.current) <= 2.0 + 1e-9
                assert abs(plant.plate_rate) <= 15.0 + 1e-9

    def test_cooling_ends_where_joule_heat_wins(self):
        plant = make()
        plant.regulate(-200.0)
        plant.advance(600.0)
        # The module's strongest cooling, S T / R, whatever the target.
        best = QUIET.seebeck * (plant.plate_temperature + 273.15) / QUIET.resistance
        assert plant.current == pytest.approx(-best, rel=1e-3)
        assert -60.0 < plant.plate_temperature < -20.0
        assert plant.plate_rate == pytest.approx(0.0, abs=0.01)


class TestPeltier:
    @cases("mode", ["drive", "regulate"])
    def test_energy_is_conserved(self, mode):
        """Electrical work equals the heat stored in plate and sink plus what went into the room."""
        p = QUIET
        plant = make(initial_temperature=30.0)
        begin = snapshot(plant)
        work = loss = 0.0

        def flows():
            room = p.ambient_temperature
            out = (plant.sink_temperature - room) / p.sink_resistance
            return plant.voltage * plant.current, out + p.plate_loss * (plant.plate_temperature - room)

        for k in range(12000):
            if k % 1000 == 0 and mode == "drive":
                plant.drive([1.0, -1.5, 0.5, 2.0][k // 1000 % 4])
            elif k % 1000 == 0:
                plant.regulate([60.0, 20.0, 84.0, 50.0][k // 1000 % 4])
            before = flows()
            plant.advance(0.05)
            after = flows()
            work += 0.025 * (before[0] + after[0])
            loss += 0.025 * (before[1] + after[1])
        end = snapshot(plant)
        stored = p.plate_capacity * (end.plate_temperature - begin.plate_temperature)
        stored += p.sink_capacity * (end.sink_temperature - begin.sink_temperature)
        assert work > 1000.0
        assert stored + loss == pytest.approx(work, rel=0.01)

    def test_release_relaxes_to_ambient(self):
        plant = make()
        plant.regulate(84.0)
        plant.advance(600.0)
        assert plant.sink_temperature > 23.0
        plant.release()
        plates = []
        for _ in range(60):
            plant.advance(1.0)
            plates.append(plant.plate_temperature)
        assert np.all(np.diff(plates) < 0.0)
        assert plant.current == pytest.approx(0.0, abs=1e-9)
        # An idle module shows its Seebeck voltage.
        gap = plant.plate_temperature - plant.sink_temperature
        assert plant.voltage == pytest.approx(0.051 * gap)
        plant.advance(3600.0)
        assert plant.plate_temperature == pytest.approx(22.0, abs=1e-3)
        assert plant.sink_temperature == pytest.approx(22.0, abs=1e-3)

    def test_changing_modes_is_bumpless(self):
        plant = make()
        commands = [
            lambda: plant.regulate(80.0),
            lambda: plant.drive(4.0),
            lambda: plant.regulate(30.0, current_limit=1.0),
            lambda: plant.drive(-3.0),
            plant.release,
            lambda: plant.regulate(25.0),
        ]
        for command in commands * 3:
            before = snapshot(plant)
            command()
            assert snapshot(plant) == before
            plant.advance(0.05)
            assert abs(plant.plate_temperature - before.plate_temperature) < 0.05 * 45.0
            plant.advance(0.95)
        # What flows on is the same state: driving the present current does not change the rate.
        plant.regulate(60.0)
        plant.advance(0.5)
        rate = plant.plate_rate
        plant.drive(plant.current)
        plant.advance(0.05)
        assert plant.plate_rate == pytest.approx(rate, rel=0.03)

    def test_excess_speed_decays_into_the_slew_limit(self):
        plant = make()
        plant.drive(4.0)
        plant.advance(0.7)
        assert plant.plate_rate > 20.0
        plant.regulate(500.0)
        rates = [plant.plate_rate]
        for _ in range(40):
            plant.advance(0.05)
            rates.append(plant.plate_rate)
        assert np.all(np.diff(rates) <= 1e-9)
        assert np.max(-np.diff(rates)) < 0.2 * (rates[0] - 15.0)
        assert rates[-1] == pytest.approx(15.0, abs=0.05)


class TestNoise:
    def test_wander_and_drift_statistics(self):
        only_wander = make(VO2Parameters(relay_count=16, drift_sd=0.0), seed=3)
        only_wander.regulate(40.0)
        only_wander.advance(60.0)
        wander = np.empty(15000)
        for k in range(wander.size):
            only_wander.advance(1.0)
            wander[k] = only_wander.film_temperature - only_wander.plate_temperature
        assert wander.std() == pytest.approx(0.03, rel=0.06)
        assert wander.mean() == pytest.approx(0.0, abs=0.003)
        lagged = np.mean(wander[:-5] * wander[5:]) / wander.var()
        assert lagged == pytest.approx(math.exp(-1.0), abs=0.05)

        only_drift = make(VO2Parameters(relay_count=16, wander_sd=0.0), seed=3)
        drift = np.empty(700)
        for k in range(drift.size):
            only_drift.advance(600.0)
            drift[k] = only_drift.film_temperature - only_drift.plate_temperature
        assert drift.std() == pytest.approx(0.04, rel=0.15)
        lagged = np.mean(drift[:-3] * drift[3:]) / drift.var()
        assert lagged == pytest.approx(math.exp(-1.0), abs=0.12)

    def test_session_offset_shifts_the_film(self):
        path = [64.0, 60.0, 65.5]
        plain, shifted = (make(VO2Parameters(session_offset=x), seed=4) for x in (0.0, 0.2))
        quasi_static(plain, path)
        quasi_static(shifted, path)
        assert shifted.film_temperature - plain.film_temperature == pytest.approx(0.2)
        assert shifted.r_fraction > plain.r_fraction
        # The same film temperatures, reached by other plate temperatures, give the same film.
        other = make(VO2Parameters(session_offset=0.2), seed=4)
        quasi_static(other, [t - 0.2 for t in path])
        assert other.film_temperature == pytest.approx(plain.film_temperature, abs=1e-3)
        assert other.r_fraction == pytest.approx(plain.r_fraction, abs=5e-4)


class TestOutputs:
    @given(st.floats(-6000.0, 6000.0))
    def test_deflection_is_that_of_an_arc(self, curvature):
        length = 300e-6
        deflection = arc_deflection(curvature, length)
        assert arc_deflection(-curvature, length) == -deflection
        if abs(curvature) > 10.0:
            exact = (1.0 - math.cos(curvature * length)) / curvature
            assert deflection == pytest.approx(exact, rel=1e-8)
        assert abs(deflection) <= abs(curvature) * length**2 / 2 * (1 + 1e-12) + 1e-300

    def test_hot_deflection(self):
        assert arc_deflection(1846.0, 300e-6) == pytest.approx(80.97e-6, rel=1e-4)
        for residual in (0.0, 500.0):
            plant = make(dataclasses.replace(QUIET, residual_curvature=residual))
            quasi_static(plant, [84.0], dwell=20.0)
            total = residual + plant.curvature
            expected = arc_deflection(total, 300e-6) - arc_deflection(residual, 300e-6)
            assert plant.tip_deflection == expected
            assert plant.tip_deflection > 7e-5


class TestTime:
    commands = st.one_of(
        st.tuples(st.just("regulate"), st.floats(15.0, 84.0)),
        st.tuples(st.just("drive"), st.floats(-1.5, 1.5)),
        st.tuples(st.just("release")),
    )
    # Whole microseconds, from one call to many, that add up to what the other plant does at once.
    pieces = st.lists(st.integers(0, 700_000), min_size=1, max_size=12)

    @given(st.lists(st.tuples(commands, pieces), min_size=1, max_size=6), st.integers(0, 2**32 - 1))
    @settings(max_examples=60, deadline=None)
    def test_splitting_advance_changes_nothing(self, script, seed):
        whole, split = make(SMALL, seed=seed), make(SMALL, seed=seed)
        for (name, *arguments), parts in script:
            getattr(whole, name)(*arguments)
            getattr(split, name)(*arguments)
            whole.advance(sum(parts) * 1e-6)
            for part in parts:
                split.advance(part * 1e-6)
            assert snapshot(split) == snapshot(whole)


@cases(
    ("command", "value", "words"),
    [
        *(("advance", dt, "dt must") for dt in (-1e-9, math.nan, math.inf)),
        *(("regulate", target, "target_celsius") for target in (-300.0, math.nan, math.inf)),
        *(("drive", current, "current must lie") for current in (5.1, -6.0, math.nan)),
    ],
)
def test_wrong_commands_are_refused_and_change_nothing(command, value, words):
    plant = make(SMALL)
    with pytest.raises(ValueError, match=words):
        getattr(plant, command)(value)
    for limit in (-1.0, math.nan):
        with pytest.raises(ValueError, match="current_limit"):
            plant.regulate(50.0, current_limit=limit)
    plant.advance(1.0)
    assert plant.current == 0.0
