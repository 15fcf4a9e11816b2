import math

import pytest
from cases import cases

from bench.base import Expectation, RemainingTime

TEN_STEPS = Expectation(tuple((i, 10.0 * i) for i in range(1, 11)), 100.0)


def after(steps, *, factor=1.0, slower=1.0, expectation=TEN_STEPS):
    remaining = RemainingTime(expectation, factor)
    for step in range(1, steps + 1):
        remaining.step(step, 10.0 * slower * step)
    return remaining


class TestRemainingTime:
    def test_at_the_start_it_is_what_was_expected(self):
        left = after(0, factor=20.0).at(0.0, 0.0)
        assert (left.laboratory, left.wall, left.share, left.at_most) == (100.0, 5.0, 0.0, math.inf)

    def test_within_a_step(self):
        left = after(3).at(34.0, 34.0)
        assert (left.laboratory, left.share) == (66.0, 0.34)

    def test_a_step_that_lasts_longer_than_expected_waits_for_its_end(self):
        left = after(3, slower=1.0).at(60.0, 60.0)
        assert left.share == 0.4
        assert left.laboratory > 60.0

    @cases("slower", [0.7, 1.5])
    def test_a_pace_that_differs_is_found(self, slower):
        t = 10.0 * slower * 4
        assert t + after(4, slower=slower).at(t, t).laboratory == pytest.approx(100.0 * slower, rel=0.05)

    def test_the_wall_clock_has_a_pace_of_its_own(self):
        # x20 was asked for, x10 is reached.
        assert after(5, factor=20.0).at(50.0, 5.0).wall == pytest.approx(5.0, rel=0.03)
        assert after(5, factor=math.inf).at(50.0, 0.5).wall == pytest.approx(0.5)

    def test_pauses_are_no_pace(self):
        remaining = after(5)
        remaining.pause(50.0)
        assert remaining.at(500.0, 500.0).laboratory == 50.0
        remaining.resume(1050.0)
        assert remaining.at(1054.0, 1054.0).laboratory == 46.0
        remaining.step(6, 1060.0)
        assert remaining.at(1060.0, 1060.0).laboratory == 40.0

    def test_an_operator_who_takes_his_time_is_no_pace(self):
        remaining = after(5)
        remaining.prompt(50.0)
        assert remaining.at(650.0, 650.0).laboratory == 40.0
        remaining.step(6, 650.0)
        assert remaining.at(650.0, 650.0).laboratory == 40.0
        assert remaining.at(655.0, 655.0).laboratory == 35.0

    def test_the_bound_shrinks_with_what_is_done(self):
        bounded = Expectation(TEN_STEPS.marks, 100.0, 180.0)
        assert after(5, expectation=bounded).at(50.0, 50.0).at_most == 130.0
        assert after(10, expectation=bounded).at(100.0, 100.0).laboratory == 0.0

    def test_more_steps_than_expected(self):
        left = after(13).at(130.0, 130.0)
        assert (left.laboratory, left.share) == (0.0, 1.0)


class TestExpectation:
    def test_between_the_marks_that_were_kept(self):
        thinned = Expectation(((4, 40.0), (8, 60.0)), 61.0)
        assert [thinned.end_of(steps) for steps in (0, 1, 4, 6, 8, 9)] == [0.0, 10.0, 40.0, 50.0, 60.0, 60.0]
        assert thinned.steps == 8

    def test_nothing_is_expected_of_an_empty_run(self):
        left = RemainingTime(Expectation((), 0.0), 1.0).at(0.0, 0.0)
        assert (left.laboratory, left.share) == (0.0, 0.0)
