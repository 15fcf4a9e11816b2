"""Errors of fast loops, where their reference is held and where it moves."""

import numpy as np
import pytest

from bench.analysis.tracking_errors import LoopResult


def test_held_is_the_second_half_of_the_long_rests_after_the_first_move():
    reference = np.concatenate([np.zeros(20), np.linspace(0.0, 1.0, 11)[1:], np.ones(40), np.full(3, 1.0)])
    reference = np.concatenate([reference, np.linspace(1.0, 0.0, 11)[1:], np.zeros(5)])
    error = np.zeros(reference.size)
    error[:20] = 9.0  # before the first move
    error[20:30] = 3.0  # the first move, whose first sample does not count
    error[30:51] = 7.0  # not held yet
    error[60] = 0.4
    error[-5:] = 8.0  # a rest too short to count
    summary = LoopResult(reference, reference + error).summary()
    assert summary["hold_max"] == pytest.approx(0.4)
    assert 0.0 < summary["hold_rms"] < 0.4
    assert summary["move_max"] == pytest.approx(3.0)
    assert summary["move_rms"] == pytest.approx(3.0 * np.sqrt(9 / 18))


def test_a_reference_that_rests_is_held_and_a_step_is_no_move():
    assert LoopResult(np.zeros(10), np.full(10, 0.5)).summary() == {"hold_max": 0.5, "hold_rms": 0.5}
    step = np.concatenate([np.zeros(10), np.ones(30)])
    output = np.concatenate([np.zeros(10), np.full(15, 0.5), np.full(15, 0.9)])
    found = LoopResult(step, output).summary()
    assert set(found) == {"hold_max", "hold_rms"}
    assert found["hold_max"] == pytest.approx(0.1)
    assert "hold_rms" not in LoopResult(np.arange(5.0), np.arange(5.0)).summary()
