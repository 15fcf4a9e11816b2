"""The complete inverse of the two-stage model, over random memories, at its limits and on plateaus."""

import math
from functools import cache

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.models import (
    DeadZones,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    Reach,
    TwoStage,
    uniform_levels,
)
from rigs.muscles.two_stage_inverse import TwoStageInverse


def preisach(low, high, least, greatest, seed, order=20, zeros=0.85):
    """A rising operator with as many zero densities as identification leaves, from `least` to `greatest`."""
    rng = np.random.default_rng(seed)
    levels = uniform_levels(low, high, order)
    density = rng.random(order * (order + 1) // 2)
    density[rng.random(density.size) < zeros] = 0.0
    density *= 0.5 * (greatest - least) / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, 0.5 * (least + greatest))


def plays(low, high, gain, seed, bias=0.0, first=0.4, after=None):
    rng = np.random.default_rng(seed)
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    weights = np.append(first, rng.random(7)) * gain
    return PrandtlIshlinskii(half * np.arange(8) / 8, weights, bias, middle, None, after, (low, high))


FIRST = {
    "preisach": lambda seed: preisach(0.0, 3.0, 0.3, 11.2, seed),
    "plays": lambda seed: plays(0.0, 3.0, 1.5, seed, 5.0),
    # Without a play of threshold 0 every reversal begins with a plateau.
    "plateaus": lambda seed: plays(0.0, 3.0, 1.5, seed, 5.0, first=0.0),
    "line": lambda seed: Polynomial([5.0], (0.0, 3.0), 5.0 + seed % 2),
}
SECOND = {
    "preisach": lambda seed: preisach(-11.5, 11.5, -1.0, 5.0, seed + 1000),
    "plays": lambda seed: plays(-11.5, 11.5, 0.1, seed + 1000),
    "plateaus": lambda seed: plays(-11.5, 11.5, 0.1, seed + 1000, first=0.0),
    "saturating": lambda seed: plays(-11.5, 11.5, 0.1, seed, after=DeadZones([-1.0, 1.0], [0.5, 1.0, 0.3])),
}
KINDS = [
    ("preisach", "preisach"),
    ("plays", "preisach"),
    ("preisach", "plays"),
    ("plays", "saturating"),
    ("plateaus", "plateaus"),
    ("line", "preisach"),
]
# The pair that identification gives is tried most.
COUNTS = {kinds: 200 if kinds == KINDS[0] else 80 for kinds in KINDS}


@cache
def wire(seed=0, first="preisach", second="preisach"):
    return TwoStage(FIRST[first](seed), SECOND[second](seed), 0.3)


def random_state(rng, model):
    count = rng.integers(1, 14)
    return model.advance(rng.uniform(0.0, 3.0, count), rng.uniform(0.0, 11.0, count))


def random_states(rng, kinds):
    """Models with their inverses, a new one every 40 times, each in a random state."""
    for n in range(COUNTS[kinds]):
        if n % 40 == 0:
            model = wire(n, *kinds)
            inverse = TwoStageInverse(model)
        yield n, model, inverse, random_state(rng, model)


def reachable_lengths(model, state, force=None):
    tension = state.force if force is None else force
    low, high = model.first.input_range
    ends = min(low, state.voltage), max(high, state.voltage)
    return tuple(model.step(state, voltage, tension)[1] for voltage in ends[::-1])


def reachable_forces(model, state, argument):
    low, high = model.first.input_range
    ends = min(low, state.voltage), max(high, state.voltage)
    return tuple(model.first.step(state.first, voltage)[1] + argument for voltage in ends)


@cases("kinds", KINDS)
def test_random_states_at_a_known_force(kinds):
    rng = np.random.default_rng(1)
    met = 0
    for n, model, inverse, state in random_states(rng, kinds):
        force = state.force if n % 3 == 0 else rng.uniform(0.0, 11.0)
        low, high = reachable_lengths(model, state, force)
        target = rng.uniform(1.2 * low - 0.2 * high, 1.2 * high - 0.2 * low)
        found = inverse.voltage_for_length(state, target, force)
        assert 0.0 <= found.voltage <= 3.0
        # What it says is what the model does, with the force first.
        after, length = model.step(state, found.voltage, force)
        assert (found.state, found.length, found.force) == (after, length, force)
        if low <= target <= high:
            assert found.reach is Reach.MET
            assert abs(length - target) <= 1e-9
            met += 1
        else:
            assert found.reach is (Reach.TOO_HIGH if target > high else Reach.TOO_LOW)
            assert length == pytest.approx(high if target > high else low, abs=1e-9)
    assert met > COUNTS[kinds] // 2


@cases("kinds", KINDS)
def test_random_states_between_fixed_ends(kinds):
    rng = np.random.default_rng(2)
    met = 0
    for n, model, inverse, state in random_states(rng, kinds):
        length = None if n % 2 else model.step(state, rng.uniform(0.0, 3.0), rng.uniform(0.0, 11.0))[1]
        argument = inverse.voltage_for_force(state, 0.0, length).state.argument
        low, high = reachable_forces(model, state, argument)
        target = rng.uniform(low - 0.5, high + 0.5)
        found = inverse.voltage_for_force(state, target, length)
        after = found.state
        assert after.first == model.first.step(state.first, found.voltage)[0]
        assert after.force - after.argument == pytest.approx(after.blocked, abs=1e-13)
        if length is None:
            # Held: the second stage sees nothing at all.
            assert (after.argument, after.second, after.length) == (state.argument, state.second, state.length)
        if found.imposed is Reach.MET:
            assert found.length == pytest.approx(state.length if length is None else length, abs=1e-9)
        if low <= target <= high:
            assert found.reach is Reach.MET
            assert abs(found.force - target) <= 1e-9
            met += 1
        else:
            assert found.reach is (Reach.TOO_HIGH if target > high else Reach.TOO_LOW)
            assert found.force == pytest.approx(high if target > high else low, abs=1e-9)
    assert met > COUNTS[kinds] // 2


@pytest.mark.slow
@settings(max_examples=400)
@given(st.integers(0, 100_000))
def test_lengths_and_forces_are_monotone_in_the_voltage(seed):
    rng = np.random.default_rng(seed)
    model = wire(seed % 20, *KINDS[seed % len(KINDS)])
    state = random_state(rng, model)
    force = rng.uniform(0.0, 11.0)
    voltages = np.sort(rng.uniform(0.0, 3.0, 12))
    lengths = [model.step(state, v, force)[1] for v in voltages]
    assert (np.diff(lengths) <= 1e-12).all()
    forces = [model.move(state, v, state.argument)[0].force for v in voltages]
    assert (np.diff(forces) >= -1e-12).all()
    # So does the inverse.
    inverse = TwoStageInverse(model)
    low, high = reachable_lengths(model, state, force)
    found = [inverse.voltage_for_length(state, x, force) for x in np.linspace(low, high, 8)]
    assert (np.diff([f.voltage for f in found]) <= 1e-9).all()
    assert all(f.reach is Reach.MET for f in found)


def test_sequence_of_targets_keeps_the_memory():
    rng = np.random.default_rng(6)
    model = wire(4)
    inverse = TwoStageInverse(model)
    state = model.initial_state()
    voltages, forces, lengths = [], [], []
    for _ in range(200):
        force = rng.choice([0.98, 2.94, 4.9, 8.82])
        low, high = reachable_lengths(model, state, force)
        target = rng.uniform(low, high)
        found = inverse.voltage_for_length(state, target, force)
        assert found.reach is Reach.MET
        state = found.state
        voltages.append(found.voltage)
        forces.append(force)
        lengths.append(target)
    assert model.evaluate(voltages, forces) == pytest.approx(lengths, abs=1e-9)


def flat(low, high, scale):
    """Only relays with far apart thresholds count: in between nothing moves."""
    density = np.zeros(10)
    density[6] = scale
    return Preisach(uniform_levels(low, high, 4), density, 5.0)


def test_plateau_of_the_second_stage_answers_with_the_present_voltage():
    model = TwoStage(preisach(0.0, 3.0, 0.3, 11.2, 0, zeros=0.0), flat(-12.0, 12.0, 0.1), 0.3)
    inverse = TwoStageInverse(model)
    state = model.advance([1.0, 1.4], [3.0, 3.0])
    assert inverse.voltage_for_length(state, state.length).voltage == 1.4
    assert inverse.voltage_for_length(state, state.length, 3.5).voltage == 1.4
    # Nothing switches between -6 and 6 N: at 3 N no voltage changes the length.
    assert reachable_lengths(model, state) == (state.length, state.length)
    assert inverse.voltage_for_length(state, state.length + 0.1).reach is Reach.TOO_HIGH
    # Relays that a load has switched on go off below -6 N: there the plateau has its nearest end.
    on = model.advance([0.0, 0.0], [11.0, 3.0], state)
    found = inverse.voltage_for_length(on, on.length - 1e-6)
    assert found.reach is Reach.MET
    assert found.state.blocked == pytest.approx(9.0, abs=0.05)
    assert inverse.voltage_for_length(found.state, found.length).voltage == found.voltage


def test_plateau_of_the_first_stage_answers_with_its_nearest_end():
    model = TwoStage(flat(0.0, 3.0, 4.0), plays(-11.5, 11.5, 0.1, 3), 0.3)
    inverse = TwoStageInverse(model)
    state = model.advance([0.5, 1.0], [4.0, 4.0])
    assert inverse.voltage_for_length(state, state.length).voltage == 1.0
    assert inverse.voltage_for_force(state, state.force).voltage == 1.0
    # Relays switch on above 2.25 V only.
    found = inverse.voltage_for_length(state, state.length - 1e-6)
    assert found.reach is Reach.MET
    assert found.voltage == pytest.approx(2.25, abs=0.01)
    # Every relay is on at 3 V; on the way down none switches before 0.75 V.
    hot = model.step(state, 3.0, 4.0)[0]
    cooler = model.step(hot, 2.0, 4.0)[0]
    assert inverse.voltage_for_length(cooler, hot.length).voltage == 2.0
    assert inverse.voltage_for_length(cooler, hot.length - 1.0).voltage == 2.0


def test_clamps_and_flags():
    model = wire(5)
    inverse = TwoStageInverse(model)
    state = model.advance([1.0, 1.4], [3.0, 3.0])
    low, high = reachable_lengths(model, state)
    short, long = (inverse.voltage_for_length(state, x) for x in (-100.0, 100.0))
    assert (short.reach, long.reach) == (Reach.TOO_LOW, Reach.TOO_HIGH)
    assert (short.length, long.length) == (pytest.approx(low), pytest.approx(high))
    least, greatest = reachable_forces(model, state, state.argument)
    weak, strong = (inverse.voltage_for_force(state, x) for x in (-100.0, 100.0))
    assert (weak.reach, strong.reach) == (Reach.TOO_LOW, Reach.TOO_HIGH)
    assert (weak.force, strong.force) == (pytest.approx(least), pytest.approx(greatest))
    assert weak.imposed is Reach.MET
    stretched = inverse.voltage_for_force(state, 5.0, 100.0)
    assert stretched.imposed is Reach.TOO_HIGH
    assert stretched.length == pytest.approx(model.second.output_range()[1])


def test_argument_beyond_the_plane():
    model = wire(2)
    inverse = TwoStageInverse(model)
    state = model.advance([1.0, 0.0], [3.0, 20.0])
    assert state.argument > 11.5
    assert inverse.voltage_for_length(state, state.length).voltage == 0.0


def signed():
    return Preisach(uniform_levels(0.0, 3.0, 2), [1.0, -0.5, 1.0])


@cases(
    ("make", "message"),
    [
        (lambda: TwoStageInverse(TwoStage(signed(), SECOND["preisach"](0))), "first: expected an operator that"),
        (
            lambda: TwoStageInverse(
                TwoStage(FIRST["line"](0), Preisach([0.0, 1.0], [1.0], reversible=QuadraticTerm(-9.0)))
            ),
            "second: expected an operator that rises",
        ),
        (
            lambda: TwoStageInverse(TwoStage(Polynomial([0.0, 1.0], (0.0, 3.0)), SECOND["plays"](0))),
            "first: expected an operator that rises",
        ),
        (lambda: ask("voltage_for_length", math.nan), "length: expected a finite"),
        (lambda: ask("voltage_for_length", 1.0, math.inf), "force: expected a finite"),
        (lambda: ask("voltage_for_force", math.nan), "force: expected a finite"),
        (lambda: ask("voltage_for_force", 1.0, math.nan), "length: expected a finite"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def ask(task, *arguments):
    model = wire()
    return getattr(TwoStageInverse(model), task)(model.initial_state(), *arguments)
