"""Where a model is valid: what was fitted, and how far other inputs lie beyond it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from other_plants import cycles, damped, random_reversals

from bench.identification import Validity, ramps

LOOPS = ramps([0.0, 4.0, 0.0, 8.0, 2.0, 10.0, 0.0], 0.5)
TIMES = 0.1 * np.arange(LOOPS.size)


def of(inputs, times=None):
    return Validity.of_rows(inputs, np.ones(len(inputs), dtype=bool), times)


def moved(beyond):
    return {kind: (each.count, each.of, each.farthest) for kind, each in beyond.moves.items() if each.count}


def said(beyond):
    return {kind for kind, each in beyond.moves.items() if not each.by_chance}


def test_range_moves_and_rates_are_those_of_the_rows_fitted():
    known = of(LOOPS, TIMES)
    # The first and the last move are cut by the record.
    assert (known.low, known.high, known.moves, known.count) == (0.0, 10.0, (4.0, 8.0), 4)
    assert known.rates == pytest.approx((5.0, 5.0))
    fitted = np.arange(LOOPS.size) < 50
    part = Validity.of_rows(LOOPS, fitted & (np.arange(LOOPS.size) >= 8), skipped=8)
    assert (part.low, part.high, part.moves, part.rates) == (0.0, 8.0, (4.0, 8.0), None)
    assert (part.rows, part.skipped, part.left_out) == (42, 8, LOOPS.size - 50)
    assert of(np.arange(5.0)).moves is None


def test_inputs_beyond_the_range_are_counted_with_their_rows_and_distance():
    found = of(LOOPS).judge([1.0, 11.0, 12.5, 9.0, -1.0, 0.0], first=100, unit="V").to_json()
    assert (found["count"], found["of"], found["rows"]) == (3, 6, [[102, 103], [105, 105]])
    assert (found["distance"], found["distance_percent"]) == (2.5, 25.0)
    # Sampled turning points that are meant to be equal differ by less than a hundredth of the range.
    for inputs in (LOOPS, 1.009 * LOOPS):
        inside = of(LOOPS).judge(inputs)
        assert (inside.text(), inside.to_json()["rows"], moved(inside)) == ("", [], {})


def test_a_sentence_says_how_many_and_how_far():
    assert of(LOOPS).judge([0.0, 12.5], unit="V").text() == (
        "1 of 2 inputs lie beyond those fitted, 0 to 10 V, by up to 25 % of their range; the errors there are unknown"
    )


def test_smaller_and_larger_moves_are_counted():
    known = of(ramps([0.0, 4.0, 1.0, 5.0, 2.0, 6.0, 3.0, 7.0], 0.5))
    small = known.judge(ramps([0.0, *[3.0, 2.0] * 6], 0.5))
    assert moved(small) == {"smaller": (10, 10, 1.0)}
    assert said(small) == {"smaller"}
    large = known.judge(ramps([0.0, *[0.0, 6.0] * 6], 0.5))
    assert said(large) == {"larger"}
    # What leaves the range is counted as that.
    assert not moved(known.judge(ramps([0.0, *[-4.0, 11.0] * 6], 0.5)))


@pytest.mark.parametrize(("factor", "kind"), [(0.3, "faster"), (3.0, "slower")])
def test_other_rates_are_counted_where_times_are_known(factor, kind):
    inputs = cycles(np.random.default_rng(0))
    known = of(inputs, 0.1 * np.arange(inputs.size))
    other = cycles(np.random.default_rng(1))
    times = 0.1 * np.arange(other.size)
    assert said(known.judge(other, factor * times)) == {kind}
    assert said(known.judge(other, times)) == said(known.judge(other)) == set()


def test_another_record_of_one_kind_is_seldom_named():
    rng = np.random.default_rng(0)
    for make, most in ((random_reversals, 3), (damped, 3)):
        named = [bool(said(of(make(rng)).judge(make(rng)))) for _ in range(40)]
        assert sum(named) <= most


def test_noise_of_the_input_is_no_move():
    rng = np.random.default_rng(0)
    inputs = cycles(rng)
    noisy = inputs + 0.002 * rng.normal(size=inputs.size)
    assert of(noisy).count == of(inputs).count
    assert not said(of(inputs).judge(noisy))


def test_what_is_written_is_read():
    known = of(LOOPS, TIMES)
    for each in (known, replace(known, moves=None, rates=None)):
        assert Validity.from_json(json.loads(json.dumps(each.to_json()))) == each
    for key, value in (("low", "x"), ("low", 20.0), ("moves", [2.0]), ("rates", [2.0, 1.0]), ("rows", None)):
        with pytest.raises(ValueError, match="validity"):
            Validity.from_json({**known.to_json(), key: value})


def test_an_input_beyond_the_range_by_rounding_is_within_it():
    beyond = of(LOOPS).judge(np.array([0.0, 10.0 * (1.0 + 1e-14), 5.0]))
    assert (beyond.rows.size, beyond.distance, beyond.text()) == (0, 0.0, "")
