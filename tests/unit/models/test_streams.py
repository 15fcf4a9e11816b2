"""Streams are equal to whole sequences to the last bit, and to an oracle that keeps the whole past."""

import copy
import gc
import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.models import (
    DeadZones,
    Linear,
    MemoryCurve,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    Reach,
    Summed,
    ThermalExpansion,
    TwoStage,
)

SEEDS = st.integers(0, 2**32 - 1)
TERMS = (None, QuadraticTerm(0.7, -0.2, 0.3), ThermalExpansion(0.5, 0.9, 0.2, 0.8, 0.1))


def preisach(rng, order=None, low=0.0, high=1.0, *, signed=False, term=...):
    order = order or int(rng.integers(1, 12))
    levels = np.linspace(low, high, order + 1)
    if rng.random() < 0.5:
        levels[1:-1] += rng.uniform(-0.4, 0.4, order - 1) * (high - low) / order
    density = rng.uniform(-1.0 if signed else 0.0, 1.0, order * (order + 1) // 2)
    density[rng.random(density.size) < 0.3] = 0.0
    term = TERMS[rng.integers(len(TERMS))] if term is ... else term
    margin = 0.2 * (high - low)
    return Preisach(levels, density, float(rng.normal()), term, (low - margin, high + margin))


def plays(rng, *, zones=True):
    count = int(rng.integers(1, 9))
    thresholds = np.append(0.0, np.cumsum(rng.uniform(0.01, 0.2, count - 1)))

    def dead_zones():
        if not zones or rng.random() < 0.4:
            return None
        edges = np.sort(rng.uniform(-1.0, 1.0, int(rng.integers(1, 6))))
        return DeadZones(edges, rng.uniform(0.1, 2.0, edges.size + 1))

    weights = rng.uniform(0.05, 1.0, count)
    return PrandtlIshlinskii(thresholds, weights, float(rng.normal()), 0.4, dead_zones(), dead_zones(), (-0.5, 1.5))


def walk(rng, size, low=-0.5, high=1.5):
    """Return inputs that jump, repeat, return to earlier ones and pass the ends."""
    values = rng.uniform(low, high, size)
    for n in range(1, size):
        kind = rng.random()
        if kind < 0.15:
            values[n] = values[n - 1]
        elif kind < 0.4:
            values[n] = values[rng.integers(n)]
    return values


def by_whole_past(operator, inputs):
    """Outputs of a Preisach operator by the area of each cell that is on, from the reversals of the whole past."""
    outputs = []
    levels = operator.levels
    for count in range(1, len(inputs) + 1):
        # The staircase a(β): greatest input since the input was last below β.
        past = [operator.input_range[0], *inputs[:count]]
        present = past[-1]
        edges = sorted({*past, *levels.tolist()})
        total = 0.0
        cell = 0
        for i in range(operator.order):
            for j in range(i + 1):
                on = 0.0
                for left, right in pairwise(edges):
                    if left < levels[j] or right > levels[j + 1] or right > present:
                        continue
                    last = max((k for k, value in enumerate(past) if value <= left), default=-1)
                    top = min(max(past[last + 1 :]), levels[i + 1])
                    # The integral of max(0, top - max(β, lower end)) from left to right.
                    if i > j:
                        on += (right - left) * max(0.0, top - levels[i])
                    elif top > left:
                        on += 0.5 * ((top - left) ** 2 - (top - min(right, top)) ** 2)
                area = (levels[i + 1] - levels[i]) * (levels[j + 1] - levels[j]) * (1.0 if i > j else 0.5)
                total += operator.density[cell] * (2.0 * on - area)
                cell += 1
        if operator.reversible is not None:
            total += float(operator.reversible.columns([present])[0] @ operator.reversible.coefficients)
        outputs.append(total + operator.bias)
    return np.array(outputs)


@settings(max_examples=150)
@given(SEEDS)
def test_preisach_stream_equals_evaluate_to_the_last_bit(seed):
    rng = np.random.default_rng(seed)
    operator = preisach(rng, signed=rng.random() < 0.3)
    start = operator.initial_state() if rng.random() < 0.3 else operator.saturated_state(1).advance(walk(rng, 9))
    inputs = walk(rng, 60)
    stream = operator.stream(start)
    assert stream.value == operator.value(start)
    assert stream.state == start
    outputs = [stream.step(value) for value in inputs.tolist()]
    np.testing.assert_array_equal(outputs, operator.evaluate(inputs, start))
    assert stream.state == operator.advance(start, inputs)
    assert stream.value == outputs[-1]


@settings(max_examples=25)
@given(SEEDS)
def test_preisach_stream_equals_the_areas_of_the_whole_past(seed):
    rng = np.random.default_rng(seed)
    operator = preisach(rng, order=int(rng.integers(1, 5)))
    inputs = walk(rng, 14).tolist()
    stream = operator.stream()
    outputs = [stream.step(value) for value in inputs]
    np.testing.assert_allclose(outputs, by_whole_past(operator, inputs), atol=1e-13)


def test_room_grows_with_the_reversals_that_are_remembered():
    operator = preisach(np.random.default_rng(1), 7)
    sizes = np.linspace(0.5, 0.0, 700)
    inputs = 0.5 + sizes * np.where(np.arange(sizes.size) % 2, -1.0, 1.0)
    stream = operator.stream()
    outputs = [stream.step(value) for value in inputs.tolist()]
    np.testing.assert_array_equal(outputs, operator.evaluate(inputs))
    assert len(stream.state.extrema) == 699
    assert stream.state == operator.initial_state().advance(inputs)
    again = operator.stream(stream.state)
    assert again.step(1.1) == operator.evaluate([1.1], stream.state)[0]
    assert again.state.extrema == ()


@settings(max_examples=100)
@given(SEEDS)
def test_play_stream_equals_evaluate_to_the_last_bit(seed):
    rng = np.random.default_rng(seed)
    operator = plays(rng)
    start = operator.advance(operator.initial_state(), walk(rng, 5))
    inputs = walk(rng, 60)
    stream = operator.stream(start)
    assert stream.value == operator.value(start)
    outputs = [stream.step(value) for value in inputs.tolist()]
    np.testing.assert_array_equal(outputs, operator.evaluate(inputs, start))
    assert stream.state == operator.advance(start, inputs)
    assert stream.value == outputs[-1]
    # The states of the whole past, play by play.
    x = inputs - operator.origin if operator.before is None else operator.before(inputs - operator.origin)
    expected = list(start)
    for value in x.tolist():
        expected = [max(value - r, min(value + r, z)) for r, z in zip(operator.thresholds, expected, strict=True)]
    assert stream.state == tuple(expected)


@settings(max_examples=60)
@given(SEEDS, st.booleans())
def test_two_stage_stream_equals_evaluate_to_the_last_bit(seed, together):
    rng = np.random.default_rng(seed)
    first = preisach(rng, term=None) if rng.random() < 0.6 else plays(rng)
    second = preisach(rng, low=-3.0, high=2.0, term=None) if rng.random() < 0.6 else plays(rng)
    model = TwoStage(first, second, 0.3)
    start = model.advance(walk(rng, 4), walk(rng, 4))
    voltages, forces = walk(rng, 40), walk(rng, 40)
    stream = model.stream(start)
    outputs = [stream.step(*pair, together=together) for pair in zip(voltages, forces, strict=True)]
    np.testing.assert_array_equal(outputs, model.evaluate(voltages, forces, start, together=together))
    assert stream.state == model.advance(voltages, forces, start, together=together)
    assert stream.length == outputs[-1]


def test_a_two_stage_stream_moves_as_its_model_between_fixed_ends():
    rng = np.random.default_rng(8)
    model = TwoStage(preisach(rng, term=None), preisach(rng, low=-3.0, high=2.0, term=None), 0.3)
    state = model.advance(walk(rng, 4), walk(rng, 4))
    stream = model.stream(state)
    for voltage, argument in zip(walk(rng, 40).tolist(), np.repeat(walk(rng, 10), 4).tolist(), strict=True):
        state, length = model.move(state, voltage, argument)
        assert stream.move(voltage, argument) == length
        assert stream.state == state
    for wrong in ((math.nan, 0.1), (0.1, math.inf)):
        with pytest.raises(ValueError, match=r"(voltage|argument): expected a finite number"):
            stream.move(*wrong)
    assert stream.state == state


@cases("kind", ["summed", "linear"])
def test_every_other_model_has_a_stream(kind):
    rng = np.random.default_rng(3)
    inputs, forces = walk(rng, 50), walk(rng, 50)
    model = Summed(plays(rng), plays(rng)) if kind == "summed" else Linear(0.4, 0.1, plays(rng), (0.0, 1.0))
    stream = model.stream()
    outputs = [stream.step(*pair) for pair in zip(inputs, forces, strict=True)]
    np.testing.assert_allclose(outputs, model.evaluate(inputs, forces), rtol=1e-14)
    assert stream.state == model.advance(inputs, forces)


@cases("value", [math.nan, math.inf, -math.inf])
@cases("make", [preisach, plays])
def test_what_is_not_finite_is_refused_without_a_move(make, value):
    stream = make(np.random.default_rng(5)).stream()
    output = stream.step(0.7)
    before = stream.state
    with pytest.raises(ValueError, match="value: expected a finite number"):
        stream.step(value)
    assert stream.state == before
    assert stream.value == output
    inverse = stream.operator.inverse().stream(before)
    for ask in (inverse.find, inverse.step):
        with pytest.raises(ValueError, match="target: expected a finite number"):
            ask(value)
    assert inverse.state == before


@cases("inputs", [(math.nan, 0.1), (0.1, math.inf)])
def test_a_two_stage_stream_refuses_before_either_stage_moves(inputs):
    rng = np.random.default_rng(6)
    stream = TwoStage(preisach(rng, term=None), preisach(rng, low=-3.0, high=2.0)).stream()
    stream.step(0.6, 0.2)
    before = stream.state
    with pytest.raises(ValueError, match=r"(voltage|force): expected a finite number"):
        stream.step(*inputs)
    assert stream.state == before


def test_a_stream_keeps_what_it_reads():
    inputs = walk(np.random.default_rng(7), 200)
    expected = preisach(np.random.default_rng(8), 9).evaluate(inputs)
    stream = preisach(np.random.default_rng(8), 9).stream()
    inverse = preisach(np.random.default_rng(8), 9).inverse().stream()
    gc.collect()
    outputs = []
    for value in inputs.tolist():
        # Freed memory would be overwritten by these.
        _ = [np.full(size, math.nan) for size in (10, 19, 64, 192, 324)]
        outputs.append(stream.step(value))
        inverse.move(value)
    np.testing.assert_array_equal(outputs, expected)
    assert inverse.value == expected[-1]


@settings(max_examples=150)
@given(SEEDS, st.sampled_from(["nearest", "paper"]))
def test_preisach_inverse_stream_equals_follow_to_the_last_bit(seed, policy):
    rng = np.random.default_rng(seed)
    operator = preisach(rng, signed=rng.random() < 0.3)
    inverse = operator.inverse(policy)
    start = operator.saturated_state(-1).advance(walk(rng, 6))
    low, high = operator.output_range()
    margin = 0.1 * (high - low)
    targets = walk(rng, 30, low - margin, high + margin)
    followed, stream = inverse.follow(targets, start), inverse.stream(start)
    for n, target in enumerate(targets.tolist()):
        before = stream.state
        single = inverse.invert(before, target)
        assert stream.find(target) == single.setpoints[-1]
        assert stream.state == before
        assert stream.reach is single.reach
        assert stream.output == single.outputs[-1]
        assert stream.step(target) == followed.setpoints[n]
        np.testing.assert_equal(stream.saturating, followed.saturating[n])
        assert stream.output == followed.outputs[n]
        assert (stream.reach is Reach.MET) == followed.met[n]
        assert stream.state == single.state
    assert stream.state == followed.state
    assert stream.value == operator.value(followed.state)


@settings(max_examples=60)
@given(SEEDS)
def test_play_inverse_stream_equals_follow_to_the_last_bit(seed):
    rng = np.random.default_rng(seed)
    operator = plays(rng)
    inverse = operator.inverse()
    start = operator.advance(operator.initial_state(), walk(rng, 6))
    low, high = operator.output_range()
    targets = walk(rng, 30, low - 0.1, high + 0.1)
    followed, stream = inverse.follow(targets, start), inverse.stream(start)
    np.testing.assert_array_equal([stream.step(target) for target in targets.tolist()], followed.setpoints)
    assert stream.state == followed.state
    assert stream.output == stream.value == followed.outputs[-1]
    # After a measured input it goes on from there.
    stream.move(0.3)
    after = operator.advance(followed.state, [0.3])
    assert stream.find(targets[0]) == inverse.invert(after, targets[0]).setpoints[0]
    assert stream.state == after
    assert stream.step(targets[0]) == inverse.invert(after, targets[0]).setpoints[0]


def test_an_inverse_stream_follows_a_measured_input():
    operator = preisach(np.random.default_rng(11), 8, term=None)
    inverse = operator.inverse()
    stream = inverse.stream()
    state = operator.initial_state()
    target = 0.5 * sum(operator.output_range())
    for value in walk(np.random.default_rng(12), 40).tolist():
        state, output = operator.step(state, value)
        assert stream.move(value) == output
        assert stream.find(target) == inverse.invert(state, target).setpoints[-1]
    assert stream.state == state


def test_any_inverse_has_a_stream():
    operator = Polynomial(np.array([0.6, 0.0, 0.1]), (0.0, 1.0), 0.2)
    inverse = operator.inverse()
    stream = inverse.stream()
    for target in (0.1, 0.4, -9.0):
        found = inverse.invert(None, target)
        assert stream.step(target) == found.setpoints[-1]
        assert (stream.reach, stream.output) == (found.reach, found.outputs[-1])
    plateau = PrandtlIshlinskii([0.0, 0.2], [0.0, 1.0], input_range=(-1.0, 1.0))
    states = plateau.inverse().stream()
    followed = plateau.inverse().follow([0.3, -0.2, 0.1])
    assert [states.step(target) for target in (0.3, -0.2, 0.1)] == followed.setpoints.tolist()
    assert states.state == followed.state


def test_the_state_of_a_stream_is_a_value():
    operator = preisach(np.random.default_rng(13), 6)
    stream = operator.stream(MemoryCurve.from_positive_saturation(0.8))
    stream.step(0.2)
    kept = stream.state
    stream.step(0.5)
    assert kept == MemoryCurve.from_positive_saturation(0.8).step(0.2)
    assert operator.state_from_json(operator.state_to_json(stream.state)) == stream.state


@cases("copied", [copy.copy, copy.deepcopy, lambda stream: pickle.loads(pickle.dumps(stream))])
def test_a_copy_of_a_stream_has_a_memory_of_its_own(copied):
    rng = np.random.default_rng(14)
    operator, relaxed = preisach(rng, 6, term=None), plays(rng)
    for stream in (operator.stream(), relaxed.stream(), Polynomial(np.array([0.6]), (0.0, 1.0), 0.2).stream()):
        stream.step(0.6)
        other = copied(stream)
        assert other.step(0.3) == copied(stream).step(0.3)
        assert stream.step(0.6) == copied(stream).step(0.6)
    for stream in (operator.inverse().stream(), relaxed.inverse().stream()):
        stream.move(0.6)
        target = stream.value
        other = copied(stream)
        other.move(0.1)
        assert stream.value == target
    model = TwoStage(operator, preisach(rng, 5, -3.0, 2.0)).stream()
    length = model.step(0.6, 0.2)
    assert copied(model).step(0.6, 0.2) == length
