"""The polynomial with a few plays: its sequence is its steps, and it is read as it is written."""

import numpy as np
import pytest
from cases import cases

from bench.identification import identify
from bench.models import PolynomialPlays

MODEL = PolynomialPlays([1.0, -0.4], [0.2, 0.5], [0.7, -0.3], (-1.0, 2.0), 0.25, "V", "mm")
INPUTS = np.random.default_rng(0).uniform(-1.0, 2.0, 60)


def test_plays_follow_from_far_beyond_the_other_end():
    assert MODEL.saturated_state(-1) == pytest.approx((-1.0, -0.8, -0.5))
    assert MODEL.saturated_state(1) == pytest.approx((2.0, 1.8, 1.5))
    assert MODEL.initial_state() == MODEL.saturated_state(-1)


def test_it_is_identified_and_inverted():
    found = identify("polynomial-plays", INPUTS, MODEL.evaluate(INPUTS), degree=2, plays=2, input_range=(-1.0, 2.0))
    assert found.errors.rms_percent < 5.0
    options = {"degree": 2, "plays": 2, "input_range": (-1.0, 2.0)}
    same = identify("polynomial-plays", INPUTS, found.model.evaluate(INPUTS), **options)
    assert same.errors.rms < 1e-9
    rising = PolynomialPlays([1.0], [0.2], [0.7], (-1.0, 2.0))
    targets = np.array([0.1, 0.5, -0.2])
    answers = rising.inverse().follow(targets)
    np.testing.assert_allclose(rising.evaluate(answers.setpoints), targets, atol=1e-6)


@cases(
    ("change", "message"),
    [
        ({"thresholds": [0.0, 0.5]}, "thresholds: expected positive"),
        ({"weights": [1.0]}, "weights: expected 2 values"),
        ({"series": []}, "series"),
        ({"input_range": (1.0, 0.0)}, "input_range"),
    ],
)
def test_wrong_parts_are_named(change, message):
    parts = {"series": [1.0], "thresholds": [0.2, 0.5], "weights": [1.0, 1.0], "input_range": (0.0, 1.0)} | change
    with pytest.raises(ValueError, match=message):
        PolynomialPlays(**parts)


def test_a_state_of_another_operator_is_refused():
    with pytest.raises(ValueError, match="state: expected 3 numbers"):
        MODEL.evaluate(INPUTS, (0.0, 1.0))
    with pytest.raises(ValueError, match="coefficients: expected 4"):
        MODEL.with_coefficients([1.0], 0.0)
    with pytest.raises(ValueError, match="value: expected a finite number"):
        MODEL.step(MODEL.initial_state(), float("nan"))
