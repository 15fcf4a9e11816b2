"""Return points and congruency: what a Preisach model has, and what ratchets, drifts or bends does not."""

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st
from hysteretic_plants import random_reversals, through

from bench.identification import check_congruency, check_return_points, first_order_reversals
from bench.models import PrandtlIshlinskii, Preisach, uniform_levels

NOISE = np.random.default_rng(3).standard_normal(4000)
LEVELS = uniform_levels(-1.0, 1.0, 12)
REPEATED = through([-1.0, 1.0, -1.0, 1.0, *([0.2, 0.8] * 5), -1.0, *([-0.5, 0.5] * 4), 1.0, *([0.2, 0.8] * 3)], 1500)


def preisach(seed=0):
    return Preisach(LEVELS, np.random.default_rng(seed).random(78))


def ratcheting(inputs):
    """Return the Bouc-Wen state of exponent 1, whose minor loops do not close."""
    z, states = 0.0, [0.0]
    for step in np.diff(inputs):
        z += step * (1.0 - (0.8 * np.sign(step * z) + 0.6) * abs(z))
        states.append(z)
    return np.array(states)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_a_preisach_model_has_both(seed):
    rng = np.random.default_rng(seed)
    inputs = random_reversals(rng, 1500, 40)
    outputs = preisach(seed).evaluate(inputs)
    assert check_return_points(inputs, outputs).holds
    assert check_congruency(inputs, outputs).holds in (True, None)


def test_visits_are_counted_and_said():
    outputs = preisach().evaluate(REPEATED)
    found = check_return_points(REPEATED, outputs + 0.002 * np.ptp(outputs) * NOISE[: REPEATED.size])
    assert found.holds
    # 0.2, 0.8, -0.5, 0.5 and the ends.
    assert "visited" in found.text
    assert found.text.startswith("return-point memory: ")
    assert found.percent < 0.5
    assert found.to_json()["holds"] is True


@cases("inputs", [REPEATED, first_order_reversals(uniform_levels(-1.0, 1.0, 24), (-1.0, 1.0))])
def test_what_ratchets_may_not_be_a_preisach_model(inputs):
    found = check_return_points(inputs, ratcheting(inputs))
    assert found.holds is False
    assert "ratchets by" in found.text
    assert "may not be used" in found.text


def test_drift_is_found():
    outputs = preisach().evaluate(REPEATED)
    drift = 0.4 * np.ptp(outputs) * np.linspace(0.0, 1.0, REPEATED.size)
    assert check_return_points(REPEATED, outputs + drift).holds is False


def test_plays_in_a_bent_map_lack_congruency_only():
    """Loops of one input range have another height where the map is steeper; they still close."""
    plays = PrandtlIshlinskii(np.arange(4) * 0.2, np.ones(4))
    extrema = [-1.0, 1.0, -0.5, *([0.0, -0.5] * 2), -1.0, *([0.0, -0.5] * 2), 1.0, -1.0]
    inputs = through(extrema, 1200)
    bent = np.exp(-0.5 * plays.evaluate(inputs, plays.saturated_state(-1)))
    assert check_return_points(inputs, bent).holds
    found = check_congruency(inputs, bent)
    assert found.holds is False
    assert found.text.startswith("no congruency")
    straight = plays.evaluate(inputs, plays.saturated_state(-1))
    assert check_congruency(inputs, straight).holds


def test_nothing_to_compare_is_said():
    inputs = np.linspace(0.0, 1.0, 20)
    for found in (check_return_points(inputs, inputs), check_congruency(inputs, inputs)):
        assert found.holds is None
        assert "not tested" in found.text
        assert found.to_json() == {"holds": None, "compared": 0, "text": found.text}


def test_an_unknown_memory_at_the_start_is_no_violation():
    """Before the first turns nothing is known: the first ascent from a virgin state repeats nowhere."""
    inputs = through([0.0, *([1.0, -1.0] * 6)], 800)
    outputs = preisach().evaluate(inputs, preisach().saturated_state(1))
    outputs[: 800 // 25] += 0.3 * np.ptp(outputs)
    assert check_return_points(inputs, outputs).holds


def test_lengths_must_agree():
    with pytest.raises(ValueError, match="outputs: expected 3 values"):
        check_return_points([0.0, 1.0, 2.0], [0.0, 1.0])
