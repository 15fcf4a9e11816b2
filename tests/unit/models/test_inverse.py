"""The exact inverse against dense scans, at its limits and on plateaus."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.models import (
    MemoryCurve,
    PolynomialTerm,
    Preisach,
    PreisachInverse,
    QuadraticTerm,
    Reach,
    ThermalExpansion,
    uniform_levels,
)

LOW, HIGH = 21.0, 84.0


def film(order=20, zeros=0.6, seed=0, k0=2.8, k1=4.3):
    """A model as identified on VO2: many zero densities, non-monotonic."""
    rng = np.random.default_rng(seed)
    levels = uniform_levels(30.0, 70.0, order)
    middle = 0.5 * (levels[1:] + levels[:-1])
    i, j = np.tril_indices(order)
    density = np.exp(-0.5 * ((middle[i] - 62.0) / 3.0) ** 2 - 0.5 * ((middle[j] - 56.0) / 4.0) ** 2)
    density *= rng.uniform(0.5, 1.5, density.size)
    density[rng.random(density.size) < zeros] = 0.0
    density *= 1018.7 / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, 1026.7, ThermalExpansion(k0, k1, 30.0, 70.0, 20.0), (LOW, HIGH))


def plain(order=12, seed=0, zeros=0.3, term=None, signed=False):
    rng = np.random.default_rng(seed)
    levels = uniform_levels(0.0, 1.0, order)
    levels[1:-1] = np.sort(rng.uniform(0, 1, order - 1))
    density = rng.normal(size=order * (order + 1) // 2) if signed else rng.random(order * (order + 1) // 2)
    density[rng.random(density.size) < zeros] = 0.0
    return Preisach(levels, density, 0.5, term, (-0.2, 1.3))


def model_of(kind, seed):
    return {
        "plain": lambda: plain(seed=seed),
        "film": lambda: film(seed=seed),
        "term": lambda: plain(seed=seed, term=QuadraticTerm(-0.4, 0.3, 0.5)),
        "polynomial": lambda: plain(seed=seed, term=PolynomialTerm((0.3, -0.2, 0.4), 0.0, 1.0, 16)),
        "signed": lambda: plain(seed=seed, signed=True),
    }[kind]()


def random_state(rng, low, high):
    start = MemoryCurve((), low, -1) if rng.random() < 0.5 else MemoryCurve((), high, 1)
    return start.advance(rng.uniform(low, high, rng.integers(1, 14)))


def first_crossing(operator, state, direction, target):
    """The first input in one direction that meets the target, by dense scans, each within the last; else None."""
    start, end = state.input, operator.input_range[1] if direction > 0 else operator.input_range[0]
    for points in (6000, 300, 300, 300):
        inputs = np.linspace(start, end, points)
        error = operator.evaluate(inputs, state) - target
        hit = np.flatnonzero(error[:-1] * error[1:] <= 0.0)
        if hit.size:
            start, end = inputs[hit[0] : hit[0] + 2]
        elif points == 6000:
            return None
    return 0.5 * (start + end)


def targets_for(rng, operator, state):
    least, greatest = operator.output_range()
    minus, plus = operator.evaluate([operator.levels[0], operator.levels[-1]])
    return [
        rng.uniform(least, greatest),
        rng.uniform(plus, greatest) if plus < greatest else plus,
        rng.uniform(least, minus) if least < minus else minus,
        plus,
        minus,
        least,
        greatest,
        operator.value(state.step(rng.choice(operator.levels))),
        operator.value(state),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("make", [film, plain], ids=["non-monotonic", "monotone"])
def test_random_states_against_a_dense_scan(make):
    rng = np.random.default_rng(1)
    # Coarse and fine planes, most of whose cells are empty.
    inverses = [PreisachInverse(make(order)) for order in (5, 12, 20, 50)]
    compared = 0
    for i in range(160):
        inverse = inverses[i % len(inverses)]
        operator = inverse.operator
        state = random_state(rng, *operator.input_range)
        corners = len(state.corners(operator.levels[0], operator.levels[-1]))
        targets = targets_for(rng, operator, state)
        for target in targets[i % 8 : i % 8 + 2]:
            found = inverse.invert(state, target)
            assert found.reach is Reach.MET
            assert found.state.input == found.setpoints[-1]
            assert operator.value(found.state) == pytest.approx(target, abs=1e-9)
            assert found.outputs[-1] == pytest.approx(target, abs=1e-9)
            bound = corners + operator.order + 2
            assert found.iterations <= (bound if len(found.setpoints) == 1 else 4 * bound)
            ways = [first_crossing(operator, state, d, target) for d in (-1, 1)]
            distances = [abs(x - state.input) for x in ways if x is not None]
            if len(found.setpoints) == 2:
                # A target at the very end of the range may be crossed within the scan's rounding.
                assert not distances or target in operator.output_range()
                after = state.step(found.setpoints[0])
                assert found.setpoints[0] in (operator.levels[0], operator.levels[-1])
                assert operator.value(after) == pytest.approx(found.outputs[0], abs=1e-9)
                compared += 1
            elif distances:
                # The scan can miss a touch that the walk sees, not the other way round.
                travel = abs(found.setpoints[0] - state.input)
                assert travel <= min(distances) + 1e-6
                compared += travel >= min(distances) - 1e-6
    assert compared > 145


@settings(max_examples=200)
@given(st.integers(0, 10_000), st.booleans())
def test_paper_policy_goes_towards_the_target(seed, outside):
    rng = np.random.default_rng(seed)
    operator = film(seed=seed % 5)
    state = random_state(rng, LOW, HIGH) if outside else random_state(rng, 30.0, 70.0)
    here = operator.value(state)
    minus, plus = operator.evaluate([30.0, 70.0])
    target = rng.uniform(minus, plus)
    found = PreisachInverse(operator, "paper").invert(state, target)
    assert operator.value(found.state) == pytest.approx(target, abs=1e-9)
    direction = 1 if target > here else -1
    expected = first_crossing(operator, state, direction, target)
    if expected is not None and len(found.setpoints) == 1:
        assert found.setpoints[0] == pytest.approx(expected, abs=1e-6)


@cases("policy", ["nearest", "paper"])
@cases("order", [1, 3, 20])
def test_unreachable_targets_are_clamped_and_flagged(order, policy):
    operator = film(order, zeros=0.0)
    inverse = PreisachInverse(operator, policy)
    rng = np.random.default_rng(2)
    least, greatest = operator.output_range()
    for _ in range(50):
        state = random_state(rng, LOW, HIGH)
        high = inverse.invert(state, greatest + rng.uniform(1.0, 1e6))
        assert high.reach is Reach.TOO_HIGH
        assert high.outputs[-1] == pytest.approx(greatest, abs=1e-6)
        assert operator.value(high.state) == pytest.approx(greatest, abs=1e-6)
        low = inverse.invert(state, least - rng.uniform(1.0, 1e6))
        assert low.reach is Reach.TOO_LOW
        assert operator.value(low.state) == pytest.approx(least, abs=1e-6)
        assert max(len(high.setpoints), len(low.setpoints)) <= 2


def test_monotone_operator_clamps_at_the_end_of_its_range():
    operator = plain(zeros=0.0)
    state = MemoryCurve.from_negative_saturation(0.4)
    least, greatest = operator.output_range()
    found = PreisachInverse(operator).invert(state, greatest + 1.0)
    assert (found.reach, found.outputs[-1]) == (Reach.TOO_HIGH, pytest.approx(greatest))
    found = PreisachInverse(operator).invert(state, least - 1.0)
    assert (found.reach, found.outputs[-1]) == (Reach.TOO_LOW, pytest.approx(least))


def test_plateau_answers_with_the_nearest_point():
    # Only relays with α in [0.75, 1] and β in [0, 0.25] count: in between nothing moves.
    levels = uniform_levels(0.0, 1.0, 4)
    density = np.zeros(10)
    density[6] = 1.0
    operator = Preisach(levels, density)
    inverse = PreisachInverse(operator)
    state = MemoryCurve.from_negative_saturation(0.4)
    here = operator.value(state)
    assert inverse.invert(state, here).setpoints == (0.4,)
    assert inverse.invert(state, here).iterations == 0
    # The flat stretch ends at 0.75, which is the nearest point with more output.
    assert inverse.invert(state, here + 1e-3).setpoints[0] == pytest.approx(0.75, abs=0.01)
    on = state.step(1.0)
    top = operator.value(on)
    assert inverse.invert(on.step(0.5), top).setpoints == (0.5,)
    assert inverse.invert(on.step(0.1), top).reach is Reach.MET


def test_flat_operator_meets_its_only_value():
    operator = Preisach(uniform_levels(0.0, 1.0, 3), np.zeros(6), 2.0)
    state = MemoryCurve.from_negative_saturation(0.3)
    assert PreisachInverse(operator).invert(state, 2.0).setpoints == (0.3,)
    assert PreisachInverse(operator).invert(state, 3.0).reach is Reach.TOO_HIGH
    assert PreisachInverse(operator).invert(state, 1.0).reach is Reach.TOO_LOW


def test_small_move_against_the_target_where_reversal_raises_the_output():
    operator = film()
    state = MemoryCurve.from_negative_saturation(63.0)
    target = operator.value(state) + 2.0
    nearest = PreisachInverse(operator).invert(state, target)
    assert operator.value(state.step(62.999)) > operator.value(state)
    up = PreisachInverse(operator, "paper").invert(state, target)
    assert up.setpoints[0] > 63.0
    assert abs(nearest.setpoints[0] - 63.0) <= abs(up.setpoints[0] - 63.0)


def test_two_setpoints_above_positive_saturation():
    operator = film()
    _, plus = operator.evaluate([30.0, 70.0])
    _, greatest = operator.output_range()
    state = MemoryCurve.from_negative_saturation(45.0).step(40.0)
    found = PreisachInverse(operator).invert(state, 0.5 * (plus + greatest))
    assert len(found.setpoints) == 2
    assert found.setpoints[0] == 70.0
    assert found.outputs[0] == pytest.approx(plus)
    assert found.state == state.step(70.0).step(found.setpoints[1])


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.sampled_from(["plain", "film", "term", "signed"]))
def test_sequence_equals_single_inversions(seed, kind):
    rng = np.random.default_rng(seed)
    operator = model_of(kind, seed)
    inverse = PreisachInverse(operator, "paper" if seed % 2 else "nearest")
    least, greatest = operator.output_range()
    margin = 0.1 * (greatest - least)
    targets = rng.uniform(least - margin, greatest + margin, 40)
    start = random_state(rng, *operator.input_range)
    following = inverse.follow(targets, start)
    state = start
    for n, target in enumerate(targets):
        found = inverse.invert(state, target)
        state = found.state
        assert following.setpoints[n] == pytest.approx(found.setpoints[-1], abs=1e-7)
        assert following.met[n] == (found.reach is Reach.MET)
        assert np.isnan(following.saturating[n]) == (len(found.setpoints) == 1)
        assert following.outputs[n] == pytest.approx(operator.value(state), abs=1e-8)
    assert following.state.input == pytest.approx(state.input, abs=1e-7)


@settings(max_examples=100)
@given(st.integers(0, 10_000))
def test_signed_density_meets_what_either_direction_or_a_major_branch_meets(seed):
    rng = np.random.default_rng(seed)
    operator = plain(6, seed=seed, signed=True)
    state = random_state(rng, *operator.input_range)
    target = rng.uniform(*operator.output_range())
    found = PreisachInverse(operator).invert(state, target)
    crossings = [first_crossing(operator, state, d, target) for d in (-1, 1)]
    distances = [abs(x - state.input) for x in crossings if x is not None]
    if found.reach is Reach.MET:
        assert operator.value(found.state) == pytest.approx(target, abs=1e-9)
    else:
        assert not distances
    if distances and len(found.setpoints) == 1:
        assert abs(found.setpoints[0] - state.input) <= min(distances) + 1e-6


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.sampled_from(["film", "term", "polynomial", "signed"]))
def test_no_move_through_a_cell_gains_more_than_its_bound(seed, kind):
    rng, operator = np.random.default_rng(seed), model_of(kind, seed)
    gains, levels = PreisachInverse(operator).gains, operator.levels
    state = random_state(rng, levels[0], levels[-1])
    for way in (0, 1):
        cells = [
            k for k in range(operator.order) if (levels[k] >= state.input if way else levels[k + 1] <= state.input)
        ]
        for k in cells[:: 2 * way - 1]:
            moves = np.linspace(*(levels[k : k + 2] if way else levels[k : k + 2][::-1]), 40)
            outputs = operator.evaluate(moves, state)
            changes = outputs[:, None] - outputs
            later = changes[np.tril_indices(40)]
            assert later.max() <= gains[way, 1, k] + 1e-9
            assert -later.min() <= gains[way, 0, k] + 1e-9


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.sampled_from(["plain", "film", "term", "polynomial", "signed"]))
def test_major_branches_have_their_extremes(seed, kind):
    operator = model_of(kind, seed)
    (low, high), (lowest, highest) = operator.input_range, operator.plane
    for way, start, end in ((0, highest, low), (1, lowest, high)):
        inputs, outputs, least, greatest = PreisachInverse(operator).branches[way]
        dense = operator.evaluate(np.linspace(start, end, 5000), operator.saturated_state(2 * way - 1))
        assert outputs[0] == pytest.approx(dense[0])
        assert (inputs[0], inputs[-1]) == (start, end)
        assert (least[-1], greatest[-1]) == pytest.approx((dense.min(), dense.max()), abs=1e-2 * np.ptp(dense))
        assert least[-1] <= dense.min() + 1e-9
        assert greatest[-1] >= dense.max() - 1e-9


def test_tracks_what_forward_evaluation_made():
    operator = film(50)
    rng = np.random.default_rng(8)
    inputs = rng.uniform(LOW, HIGH, 300)
    outputs = operator.evaluate(inputs)
    following = PreisachInverse(operator).follow(outputs)
    assert following.met.all()
    path = np.column_stack([following.saturating, following.setpoints]).ravel()
    path = path[~np.isnan(path)]
    assert following.state == operator.initial_state().advance(path)


@cases(
    ("make", "message"),
    [
        (lambda: PreisachInverse(plain(), "fast"), "policy: expected 'nearest' or 'paper'"),
        (lambda: PreisachInverse(plain()).invert(plain().initial_state(), math.nan), "target: expected a finite"),
        (lambda: PreisachInverse(plain()).follow([]), "targets: expected at least one"),
        (lambda: PreisachInverse(plain()).follow([math.inf]), "targets: expected finite"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
