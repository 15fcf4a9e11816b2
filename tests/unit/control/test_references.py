"""References: their ranges, their repeatability, and whether an input can follow them."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.control import (
    AddedSine,
    ApproachedReference,
    SmoothMoves,
    fastest_slope,
    modulated_sine,
    staircase,
    tracking_targets,
)
from bench.models import Preisach, PreisachInverse, QuadraticTerm, uniform_levels

MICRO, NANO = 1e-6, 1e-9
SPEED = 3 * MICRO


class TestTargets:
    @given(st.integers(0, 1000), st.integers(1, 200))
    def test_stay_within_the_range(self, seed, count):
        targets = tracking_targets(np.random.default_rng(seed), -63.0, 1814.0, count)
        assert targets.size == count
        assert targets.min() >= -63.0
        assert targets.max() <= 1814.0

    def test_start_large_decay_and_are_random_then(self):
        first = tracking_targets(np.random.default_rng(1), -1.0, 1.0, 60)
        second = tracking_targets(np.random.default_rng(2), -1.0, 1.0, 60)
        assert (first[:30] == second[:30]).all()
        assert (first[30:] != second[30:]).all()
        assert np.abs(first[:6]).max() == pytest.approx(1.0)
        assert np.abs(first[24:30]).max() < 0.25
        assert (tracking_targets(np.random.default_rng(1), -1.0, 1.0, 60) == first).all()

    def test_they_begin_at_the_top_of_the_range(self):
        targets = tracking_targets(np.random.default_rng(1), 10.0, 30.0, 20)
        assert targets[0] == pytest.approx(30.0)
        assert targets[1] == pytest.approx(20.0 + 10.0 * 0.9 * math.sin(0.9 * math.pi))

    def test_wrong_arguments(self):
        with pytest.raises(ValueError, match="low, high"):
            tracking_targets(np.random.default_rng(1), 1.0, 1.0)
        with pytest.raises(ValueError, match="count"):
            tracking_targets(np.random.default_rng(1), 0.0, 1.0, 0)


class TestSine:
    def test_range_start_and_modulation(self):
        times = np.arange(0.0, 1000.0, 0.5)
        reference = modulated_sine(times, 200.0, 1500.0, 60.0)
        assert reference[0] == pytest.approx(850.0)
        assert reference[1] > reference[0]
        assert reference.min() >= 200.0
        assert reference.max() <= 1500.0
        peaks = reference[1:-1][(reference[1:-1] > reference[:-2]) & (reference[1:-1] >= reference[2:])]
        assert peaks.max() > 1450.0
        assert peaks.min() < 1200.0

    @cases(
        ("arguments", "match"),
        [
            (([0.0], 1.0, 0.0, 60.0), "low, high"),
            (([0.0], 0.0, 1.0, 0.0), "period"),
            (([0.0], 0.0, 1.0, math.nan), "period"),
            (([0.0], 0.0, 1.0, 60.0, 1.5), "depth"),
            (([math.nan], 0.0, 1.0, 60.0), "times"),
        ],
    )
    def test_wrong_arguments(self, arguments, match):
        with pytest.raises(ValueError, match=match):
            modulated_sine(*arguments)


class TestFastestSlope:
    def test_of_a_line_is_the_slope_of_the_reference(self):
        levels = uniform_levels(0.0, 10.0, 4)
        line = Preisach(levels, np.zeros(10), 0.0, QuadraticTerm(2.0))
        times = np.linspace(0.0, 4.0, 401)
        slope = fastest_slope(PreisachInverse(line), times, 5.0 + 4.0 * np.sin(times))
        assert slope.rate == pytest.approx(2.0, rel=1e-3)
        assert slope.time == pytest.approx(0.0, abs=0.02) or slope.time == pytest.approx(math.pi, abs=0.02)
        assert slope.within(2.1)
        assert not slope.within(1.9)

    def test_references_that_cannot_be_met(self, models):
        with pytest.raises(ValueError, match=r"reference: expected values within .* got 2000 at 1 s"):
            fastest_slope(PreisachInverse(models.film), [0.0, 1.0, 2.0], [100.0, 2000.0, 100.0])
        with pytest.raises(ValueError, match="one for each time"):
            fastest_slope(PreisachInverse(models.film), [0.0, 1.0, 2.0], [100.0, 200.0])
        with pytest.raises(ValueError, match="times"):
            fastest_slope(PreisachInverse(models.film), [0.0, 2.0, 1.0], [100.0, 200.0, 100.0])


def test_smooth_moves_visit_the_positions():
    moves = SmoothMoves([10 * MICRO, 40 * MICRO, 39.9 * MICRO], SPEED, hold=7.0, blend=4.0)
    assert moves.duration == pytest.approx(10.0 + 4.0 + 7.0 + 0.1 / 3.0 + 4.0 + 7.0)
    assert moves(-1.0) == moves(0.0) == 10 * MICRO
    assert moves(14.0) == moves(20.9) == 40 * MICRO
    assert moves(26.0) == moves(1e6) == 39.9 * MICRO
    assert moves(7.0) == pytest.approx(25 * MICRO)
    assert moves(7.1) - moves(7.0) == pytest.approx(0.1 * SPEED)
    # Too short for the top speed.
    places = np.array([moves(t) for t in np.linspace(21.0, 25.1, 200)])
    assert np.abs(np.diff(places)).max() < 0.1 * SPEED * 4.1 / 199


@given(
    st.lists(st.integers(-200, 200), min_size=2, max_size=5),
    st.floats(0.1, 10.0),
    st.floats(0.5, 20.0),
    st.floats(0.0, 20.0),
)
def test_smooth_moves_are_never_above_the_top_speed_and_change_it_smoothly(places, speed, blend, hold):
    moves = SmoothMoves(MICRO * np.array(places), speed * MICRO, blend=blend, hold=hold)
    h = 1e-4 * blend
    times = np.linspace(-1.0, moves.duration + 1.0, 200)
    before, here, after = (np.array([moves(t + n * h) for t in times]) for n in (-1, 0, 1))
    assert np.abs(after - before).max() <= 2 * h * speed * MICRO * (1 + 1e-6)
    # The slope of a minimum-jerk curve is 15/8 of the mean one at most.
    assert np.abs(after - 2 * here + before).max() <= 1.9 * h**2 * speed * MICRO / blend + 1e-9 * MICRO


def test_staircase_and_sine():
    stairs = staircase(-10 * MICRO, 10 * MICRO, 2, SPEED, start=3 * MICRO, hold=5.0, blend=2.0)
    assert stairs(0.0) == 3 * MICRO
    ends = np.cumsum([13 / 3, 10 / 3, 10 / 3, 10 / 3, 10 / 3]) + 7.0 * np.arange(1, 6)
    assert [stairs(t - 0.1) for t in ends] == pytest.approx(MICRO * np.array([-10, 0, 10, 0, -10]), abs=1e-15)
    sine = AddedSine(stairs, 2 * MICRO, 0.5)
    # The end of the swelling is after four seconds.
    times = np.linspace(4.0, 30.0, 50)
    expected = [stairs(t) + 2 * MICRO * math.sin(math.pi * t) for t in times]
    assert [sine(t) for t in times] == pytest.approx(expected, abs=1e-15)
    assert sine(0.0) == stairs(0.0)
    assert abs(sine(0.01) - stairs(0.01)) < 1e-3 * NANO


@cases(("output", "is_near"), [(3.1, True), (5.0, False)])
def test_a_reference_that_begins_elsewhere_is_put_off_until_it_is_approached(output, is_near):
    reference = ApproachedReference(lambda t: 3.0 + math.sin(t), 0.5, 2.0)
    reference.begin(output)
    assert (reference.delay == 0.0) is is_near
    assert reference(0.0) == (3.0 if is_near else output)
    assert reference(reference.delay) == 3.0
    assert reference(reference.delay + 1.0) == pytest.approx(3.0 + math.sin(1.0))
    assert (reference.from_here is reference) is not is_near


@cases(
    ("make", "message"),
    [
        (lambda: SmoothMoves([0.0], SPEED), "positions: expected at least 2"),
        (lambda: SmoothMoves([0.0, math.nan], SPEED), "positions: expected finite"),
        (lambda: SmoothMoves([0.0, 1.0], SPEED, blend=math.inf), "speed, blend, hold: expected positive"),
        (lambda: staircase(0.0, 1.0, 0, SPEED), "steps: expected at least 1"),
        (lambda: staircase(1.0, 0.0, 2, SPEED), "low, high: expected strictly increasing"),
        (lambda: AddedSine(abs, MICRO, 0.0), "frequency: expected a positive"),
        (lambda: AddedSine(abs, math.nan, 1.0), "amplitude: expected a finite"),
    ],
)
def test_wrong_input_of_moves_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
