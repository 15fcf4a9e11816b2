"""The memory curve against the history it stands for."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.models import MemoryCurve

inputs = st.lists(st.integers(-20, 100).map(lambda n: n / 2), min_size=1, max_size=30)


def relay_is_on(history, alpha, beta, before=False):
    """One hysteron, straight from its definition."""
    on = before
    for value in history:
        if value >= alpha:
            on = True
        elif value < beta:
            on = False
    return on


def driven(history, saturation=-1):
    start = MemoryCurve((), -1000.0 if saturation < 0 else 1000.0, saturation)
    for value in history:
        start = start.step(value)
    return start


@given(inputs, st.sampled_from([-1, 1]))
def test_staircase_tells_every_relay(history, saturation):
    low, high = -5.0, 40.0
    lefts, heights, present = driven(history, saturation).staircase(low, high)
    assert lefts == sorted(set(lefts))
    assert heights == sorted(set(heights), reverse=True)
    # Quarter offsets keep the relays off the half-integer corners.
    for alpha in np.arange(low + 0.25, high, 3.5):
        for beta in np.arange(low + 0.25, alpha, 3.5):
            piece = [h for left, h in zip(lefts, heights, strict=True) if left <= beta]
            on = beta <= present and bool(piece) and alpha <= piece[-1]
            assert on == relay_is_on(history, alpha, beta, before=saturation > 0)


@given(inputs, st.sampled_from([-1, 1]))
def test_sequence_equals_steps(history, saturation):
    start = MemoryCurve((), -1000.0 if saturation < 0 else 1000.0, saturation)
    assert start.advance(history) == driven(history, saturation)


@given(inputs, st.sampled_from([-1, 1]))
def test_stored_extrema_restore_the_memory(history, saturation):
    memory = driven(history, saturation)
    assert driven([*memory.extrema, memory.input], saturation) == memory


@given(inputs, st.integers(0, 20), st.integers(0, 20))
def test_inner_loops_are_wiped_out(history, a, b):
    memory = driven(history)
    if not memory.extrema:
        return
    last = memory.extrema[-1]
    inside = [memory.input + (last - memory.input) * x / 21 for x in (a, b)]
    there_and_back = memory
    for value in (*inside, memory.input):
        there_and_back = there_and_back.step(value)
    lefts, heights, present = memory.staircase(-10.0, 50.0)
    after = there_and_back.staircase(-10.0, 50.0)
    assert after[2] == present
    # A return to the last reversal closes the loop; one that went beyond may have wiped more.
    if memory.rising == (memory.input >= last):
        assert after == (lefts, heights, present)


def test_nested_extrema_are_kept_and_passed_ones_wiped():
    memory = driven([10.0, 2.0, 8.0, 4.0, 6.0])
    assert memory.extrema == (10.0, 2.0, 8.0, 4.0)
    assert memory.rising
    assert memory.step(8.0).extrema == (10.0, 2.0)
    assert memory.step(9.0).step(1.0).extrema == (10.0,)
    assert memory.step(11.0).extrema == ()
    assert memory.step(memory.input) is memory


def test_depth_stays_bounded_under_a_repeated_loop():
    memory = driven([10.0, 0.0])
    for _ in range(1000):
        memory = memory.step(5.0).step(3.0)
    assert len(memory.extrema) == 3


def test_corners_draw_the_staircase():
    memory = driven([60.0, 40.0, 50.0, 45.0])
    expected = [(30, 60), (40, 60), (40, 50), (45, 50), (45, 45)]
    np.testing.assert_array_equal(memory.corners(30.0, 70.0), expected)
    np.testing.assert_array_equal(driven([45.0]).corners(30.0, 70.0), [(30, 45), (45, 45)])
    np.testing.assert_array_equal(driven([10.0]).corners(30.0, 70.0), [(30, 30)])
    np.testing.assert_array_equal(driven([90.0]).corners(30.0, 70.0), [(30, 70), (70, 70)])


def test_saturations():
    assert MemoryCurve.from_negative_saturation(50.0).corners(30.0, 70.0)[0, 1] == 50.0
    assert MemoryCurve.from_positive_saturation(50.0).corners(30.0, 70.0)[0, 1] == 70.0


@cases(
    ("make", "message"),
    [
        (lambda: MemoryCurve((1.0, 5.0), 3.0), "extrema"),
        (lambda: MemoryCurve((5.0, math.nan), 3.0), "extrema"),
        (lambda: MemoryCurve((5.0,), 6.0), "input"),
        (lambda: MemoryCurve((), math.inf), "input"),
        (lambda: MemoryCurve((), 1.0, 0), "saturation"),
        (lambda: MemoryCurve((), 1.0).step(math.nan), "value"),
        (lambda: MemoryCurve((), 1.0).advance([]), "inputs"),
        (lambda: MemoryCurve((), 1.0).advance([1.0, math.nan]), "inputs: .* at index 1"),
        (lambda: MemoryCurve.from_json({"input": 1.0, "saturation": -1}), "extrema"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
