"""Errors of predicted outputs, as they are and after re-zeroing the sensor."""

import numpy as np
import pytest

from bench.identification import Comparison, measure_errors


def test_raw_and_rezeroed_errors():
    rng = np.random.default_rng(1)
    predicted, noise = rng.uniform(-1.0, 1.0, 50), rng.normal(size=50)
    measured = predicted + 3.0 + 0.01 * (noise - noise.mean())
    found = Comparison.of(measured, predicted)
    assert found.offset == pytest.approx(3.0)
    assert found.raw.average == pytest.approx(3.0, abs=0.01)
    assert found.rezeroed.rms == pytest.approx(0.01 * noise.std())
    np.testing.assert_array_equal(found.residuals, measured - predicted)
    assert found.raw == measure_errors(measured, predicted)
    # No other offset does better.
    for shift in (-1e-3, 1e-3):
        assert measure_errors(measured, predicted + found.offset + shift).rms > found.rezeroed.rms
    assert found.rezeroed.rms**2 + found.offset**2 == pytest.approx(found.raw.rms**2)


def test_skipped_samples_count_in_no_error():
    predicted = np.array([0.5, -0.2, 0.1, 0.9])
    found = Comparison.of(predicted + np.array([50.0, 0.0, 0.0, 0.0]), predicted, skip=1)
    assert found.raw.maximum == found.offset == 0.0
    assert found.residuals[0] == 50.0
    with pytest.raises(ValueError, match="skip: expected 0 <= skip < 4, got 4"):
        Comparison.of(predicted, predicted, skip=4)
