"""The inverse of a Prandtl-Ishlinskii operator sample by sample, beside the inverse operator."""

from dataclasses import replace

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.models import DeadZones, PrandtlIshlinskii
from rigs.hybrid.play_inverse import SampledPlayInverse

MICRO, NANO = 1e-6, 1e-9


def plays():
    thresholds = 40.0 * np.arange(15) / 15
    weights = 0.02 * MICRO * np.exp(-thresholds / 15.0)
    weights[0], weights[5] = 0.17 * MICRO, 0.0
    return PrandtlIshlinskii(thresholds, weights, bias=0.3 * MICRO, input_range=(-40.0, 40.0))


@given(st.lists(st.floats(-12.0, 12.0), min_size=1, max_size=60))
def test_inverse_by_samples_equals_the_inverse_operator(wanted):
    operator = plays()
    low, high = operator.output_range()
    stroke = 9 * MICRO
    bounded = np.clip(MICRO * np.array(wanted), max(low - operator.bias, -stroke), min(high - operator.bias, stroke))
    inverse = SampledPlayInverse(operator, stroke)
    assert inverse.output == 0.0
    voltages = []
    for each, within in zip(wanted, bounded, strict=True):
        voltages.append(inverse.input(each * MICRO))
        assert inverse.output == within
    assert voltages == pytest.approx(operator.inverse_operator().evaluate(bounded + operator.bias), abs=1e-9)
    assert operator.evaluate(voltages) - operator.bias == pytest.approx(bounded, abs=1e-6 * NANO)
    assert np.abs(voltages).max() <= 40.0 + 1e-9


def test_inverse_by_samples_does_not_drift():
    operator, rng = plays(), np.random.default_rng(0)
    wanted = np.clip(np.cumsum(0.2 * MICRO * rng.standard_normal(50_000)), -8 * MICRO, 8 * MICRO)
    inverse = SampledPlayInverse(operator)
    voltages = [inverse.input(each) for each in wanted.tolist()]
    assert voltages == pytest.approx(operator.inverse_operator().evaluate(wanted + operator.bias), abs=1e-9)


@cases(
    ("make", "message"),
    [
        (lambda: SampledPlayInverse(plays(), 0.0), "stroke: expected a positive"),
        (lambda: SampledPlayInverse(replace(plays(), after=DeadZones([0.0], [1.0, 0.0]))), "expected values > 0"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
