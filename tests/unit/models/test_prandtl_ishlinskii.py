"""The Prandtl-Ishlinskii operator against its definition, and its inverse against it."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.models import DeadZones, PrandtlIshlinskii

volts = st.lists(st.floats(-40.0, 40.0), min_size=1, max_size=40)
seeds = st.integers(0, 10_000)


def actuator(seed=0, after=False, before=False, origin=0.0, zeros=0.3):
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.05, 1.0, 15) / 15
    weights[1:][rng.random(14) < zeros] = 0.0
    weights[0] += 0.1
    thresholds = 40.0 * np.arange(15) / 15
    maps = [
        DeadZones(np.sort(rng.uniform(-8, 8, 4)), rng.uniform(0.3, 2.0, 5)) if wanted else None
        for wanted in (before, after)
    ]
    return PrandtlIshlinskii(thresholds, weights, 0.7, origin, *maps, (origin - 40.0, origin + 40.0), "V", "µm")


def dead_zone_sum(zones, x):
    """The map as Kuhnen writes it: one-sided dead zones whose weights are the changes of slope."""
    at_zero = zones.slopes[np.searchsorted(zones.thresholds, 0.0)]
    total = at_zero * x
    for r, below, above in zip(zones.thresholds, zones.slopes[:-1], zones.slopes[1:], strict=True):
        total += (above - below) * max(x - r, 0.0) if r >= 0.0 else (below - above) * min(x - r, 0.0)
    return total


def by_definition(operator, inputs, plays):
    plays, outputs = list(plays), []
    for value in inputs:
        x = value - operator.origin
        if operator.before is not None:
            x = dead_zone_sum(operator.before, x)
        for i, r in enumerate(operator.thresholds):
            if plays[i] > x + r:
                plays[i] = x + r
            elif plays[i] < x - r:
                plays[i] = x - r
        total = sum(w * z for w, z in zip(operator.weights, plays, strict=True))
        outputs.append(operator.bias + (total if operator.after is None else dead_zone_sum(operator.after, total)))
    return outputs, plays


@given(volts, seeds, st.booleans(), st.booleans())
def test_equals_the_definition(inputs, seed, after, before):
    operator = actuator(seed, after, before, origin=3.0)
    expected, plays = by_definition(operator, inputs, operator.initial_state())
    np.testing.assert_allclose(operator.evaluate(inputs), expected, atol=1e-12)
    np.testing.assert_allclose(operator.advance(operator.initial_state(), inputs), plays, atol=1e-12)
    state = operator.initial_state()
    for value, output in zip(inputs, expected, strict=True):
        state, found = operator.step(state, value)
        assert found == pytest.approx(output, abs=1e-12)
        assert operator.value(state) == pytest.approx(output, abs=1e-12)
    regressor = operator.regressor(inputs)
    np.testing.assert_allclose(regressor.product(operator.coefficients) + operator.bias, expected, atol=1e-12)
    np.testing.assert_allclose(regressor.dense() @ operator.coefficients + operator.bias, expected, atol=1e-12)


@given(volts, volts, seeds, st.booleans(), st.booleans())
def test_inverse_gives_the_input_back_from_any_state(history, inputs, seed, after, before):
    operator = actuator(seed, after, before, origin=-2.0)
    start = operator.advance(operator.initial_state(), history)
    inverse = operator.inverse_operator()
    outputs = operator.evaluate(inputs, start)
    scale = 40.0 if after or before else 1.0
    np.testing.assert_allclose(inverse.evaluate(outputs, operator.inverse_state(start)), inputs, atol=1e-12 * scale)


@given(volts, volts, seeds)
def test_operator_meets_what_the_inverse_asks_for(history, targets, seed):
    operator = actuator(seed)
    start = operator.advance(operator.initial_state(), history)
    wanted = np.array(targets) / 5.0
    inputs = operator.inverse_operator().evaluate(wanted, operator.inverse_state(start))
    np.testing.assert_allclose(operator.evaluate(inputs, start), wanted, atol=1e-12)


def test_inverse_of_the_inverse_is_the_operator():
    operator = actuator(3, after=True, before=True)
    twice = operator.inverse_operator().inverse_operator()
    np.testing.assert_allclose(twice.thresholds, operator.thresholds, atol=1e-12)
    np.testing.assert_allclose(twice.weights, operator.weights, atol=1e-14)
    np.testing.assert_allclose(twice.after.slopes, operator.after.slopes)
    np.testing.assert_allclose(twice.before.thresholds, operator.before.thresholds, atol=1e-12)
    assert (twice.bias, twice.origin) == (operator.bias, operator.origin)


@given(seeds, st.booleans(), st.booleans())
def test_output_range_bounds_every_walk_and_is_reached(seed, after, inverted):
    operator = actuator(seed, after)
    if inverted:
        operator = operator.inverse_operator()
    rng = np.random.default_rng(seed)
    low, high = operator.input_range
    least, greatest = operator.output_range()
    walks = [operator.evaluate(rng.uniform(low, high, 50)) for _ in range(5)]
    walks += [operator.evaluate([v, w]) for v in np.linspace(low, high, 81) for w in (low, high)]
    found = np.concatenate(walks)
    assert found.min() >= least - 1e-12
    assert found.max() <= greatest + 1e-12
    assert found.min() == pytest.approx(least, abs=0.02)
    assert found.max() == pytest.approx(greatest, abs=0.02)


@given(seeds, st.booleans())
def test_output_rises_with_the_input(seed, after):
    operator = actuator(seed, after)
    state = operator.advance(operator.initial_state(), np.random.default_rng(seed).uniform(-40, 40, 20))
    rise = operator.evaluate(np.linspace(state[0], 40.0, 50), state)
    assert (np.diff(rise) >= -1e-12).all()


def test_saturated_states_are_what_a_long_way_leaves():
    operator = actuator()
    for direction in (-1, 1):
        state = operator.advance(operator.initial_state(), [-direction * 1000.0, direction * 40.0])
        np.testing.assert_allclose(operator.saturated_state(direction), state)


def test_dead_zones():
    zones = DeadZones([-1.0, 2.0], [0.5, 1.0, 0.25])
    np.testing.assert_allclose(zones([-3.0, -1.0, 0.0, 2.0, 6.0]), [-2.0, -1.0, 0.0, 2.0, 3.0])
    x = np.linspace(-5, 5, 41)
    np.testing.assert_allclose(zones.inverse()(zones(x)), x, atol=1e-14)
    np.testing.assert_allclose([zones.value(v) for v in x], zones(x), atol=1e-15)
    one_sided = DeadZones([1.0, 3.0], [2.0, 1.0, 0.5])
    np.testing.assert_allclose(one_sided([-1.0, 0.0, 1.0, 3.0, 5.0]), [-2.0, 0.0, 2.0, 4.0, 5.0])


@cases(
    ("make", "message"),
    [
        (lambda: PrandtlIshlinskii([1.0, 2.0], [1.0, 1.0]), "thresholds: expected the first to be 0"),
        (lambda: PrandtlIshlinskii([0.0, 0.0], [1.0, 1.0]), "thresholds: expected strictly"),
        (lambda: PrandtlIshlinskii([0.0, 1.0], [1.0]), "weights: expected 2 values"),
        (lambda: PrandtlIshlinskii([0.0, 1.0], [1.0, -2.0]), "weights: expected running sums >= 0"),
        (lambda: PrandtlIshlinskii([0.0, 1.0], [1.0, math.nan]), "weights"),
        (lambda: PrandtlIshlinskii([0.0, 1.0], [0.0, 1.0]).inverse_operator(), "weights: expected running sums > 0"),
        (lambda: PrandtlIshlinskii([0.0], [1.0], input_range=(1.0, 1.0)), "input_range"),
        (lambda: PrandtlIshlinskii([0.0], [1.0], origin=math.inf), "origin"),
        (lambda: DeadZones([0.0], [1.0]), "slopes: expected 2"),
        (lambda: DeadZones([0.0], [1.0, -1.0]), "slopes: expected values >= 0"),
        (lambda: DeadZones([0.0], [1.0, 0.0]).inverse(), "slopes: expected values > 0"),
        (lambda: DeadZones([], [1.0]), "thresholds"),
        (lambda: actuator().evaluate([math.nan]), "inputs"),
        (lambda: actuator().evaluate([1.0], (0.0,)), "state: expected 15"),
        (lambda: actuator().step((0.0,) * 15, math.nan), "value"),
        (lambda: actuator().step((0.0,), 1.0), "state: expected 15"),
        (lambda: actuator().saturated_state(0), "direction"),
        (lambda: actuator().with_coefficients([1.0], 0.0), "coefficients: expected 15"),
        (lambda: PrandtlIshlinskii.from_json({"type": "prandtl-ishlinskii", "thresholds": [0.0]}), "weights"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
