import math

from hypothesis import given, strategies as st

from bench.control import LimitCycleWatch
from bench.control.convergence import MOST_SWINGS


def cycles(setpoints, reference=1.0, low=0.0, high=3.0):
    watch = LimitCycleWatch(low, high)
    return [watch.note(setpoint, reference) for setpoint in setpoints]


def test_a_limit_cycle_at_full_stroke_is_noticed_at_its_sixth_swing():
    assert cycles([0.0, 3.0] * 4) == [False] * MOST_SWINGS + [True, True]


def test_swings_are_counted_from_the_beginning_of_each_reference():
    watch = LimitCycleWatch(0.0, 3.0)
    counts = [watch.swings]
    for setpoint, reference in ((3.0, 1.0), (0.0, 1.0), (3.0, 1.0), (0.0, 2.0), (3.0, 2.0), (0.0, math.nan)):
        watch.note(setpoint, reference)
        counts.append(watch.swings)
    assert counts == [0, 0, 1, 2, 0, 1, 0]


def test_what_lies_between_the_ends_does_not_end_a_swing():
    assert cycles([0.1, 1.5, 2.9, 1.2, 1.8] * 5).index(True) == 5 * MOST_SWINGS // 2


def test_a_target_past_an_end_and_back_is_no_cycle():
    assert not any(cycles([0.0, 3.0, 0.2, 1.7, 1.65, 1.68, 1.67] + [1.67] * 100))


def test_a_reference_that_moves_may_ask_for_it():
    watch = LimitCycleWatch(0.0, 3.0)
    assert not any(watch.note(3.0 * (k % 2), math.sin(k)) for k in range(100))


def test_a_controller_without_a_reference_is_not_judged():
    assert not any(cycles([0.0, 3.0] * 20, reference=math.nan))


def test_the_ends_are_parts_of_the_range_wherever_it_lies():
    assert cycles([1.7, 3.3] * 4, low=1.0, high=4.0)[-1]
    assert not any(cycles([1.8, 3.3] * 20, low=1.0, high=4.0))
    assert not any(cycles([1.7, 3.2] * 20, low=1.0, high=4.0))


@given(st.lists(st.floats(0.8, 3.0), max_size=200))
def test_a_loop_that_stays_off_one_end_never_cycles(setpoints):
    assert not any(cycles(setpoints))
