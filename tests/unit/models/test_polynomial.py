"""The polynomial baseline."""

import math

import numpy as np
import pytest
from cases import cases
from numpy.polynomial import chebyshev

from bench.models import Polynomial


def make(seed=0, degree=6):
    series = np.random.default_rng(seed).normal(size=degree)
    return Polynomial(series, (21.0, 84.0), 2.0, "°C", "1/m")


def test_evaluates_its_series():
    p = make()
    u = np.linspace(21.0, 84.0, 50)
    expected = chebyshev.Chebyshev([2.0, *p.series], domain=[21.0, 84.0])(u)
    np.testing.assert_allclose(p.evaluate(u), expected)
    np.testing.assert_allclose(p.regressor(u).product(p.coefficients) + p.bias, expected)
    np.testing.assert_allclose(p.regressor(u).dense() @ p.coefficients + p.bias, expected)
    assert p.step(p.initial_state(), u[7]) == (None, pytest.approx(expected[7]))


@cases("seed", range(10))
def test_output_range_is_that_of_a_dense_scan(seed):
    p = make(seed)
    y = p.evaluate(np.linspace(21.0, 84.0, 20001))
    low, high = p.output_range()
    assert low == pytest.approx(y.min(), abs=1e-5)
    assert high == pytest.approx(y.max(), abs=1e-5)
    assert low <= y.min() + 1e-12
    assert high >= y.max() - 1e-12


def test_output_range_of_a_line():
    assert Polynomial([2.0], (0.0, 1.0), 1.0).output_range() == (-1.0, 3.0)
    assert Polynomial([0.0, 0.0], (0.0, 1.0), 1.0).output_range() == (1.0, 1.0)


@cases(
    ("make_it", "message"),
    [
        (lambda: Polynomial([], (0.0, 1.0)), "series"),
        (lambda: Polynomial([1.0], (1.0, 0.0)), "input_range"),
        (lambda: Polynomial([1.0], (0.0, 1.0), math.inf), "bias"),
        (lambda: make().with_coefficients([1.0], 0.0), "coefficients: expected 6"),
        (lambda: make().evaluate([math.nan]), "inputs"),
    ],
)
def test_wrong_input_is_named(make_it, message):
    with pytest.raises(ValueError, match=message):
        make_it()


def test_goes_on_by_its_tangents_beyond_its_range():
    p = make()
    expected = chebyshev.Chebyshev([2.0, *p.series], domain=[21.0, 84.0])
    for end, beyond in ((84.0, [90.0, 200.0]), (21.0, [15.0, -100.0])):
        tangents = expected(end) + expected.deriv()(end) * (np.array(beyond) - end)
        np.testing.assert_allclose(p.evaluate(beyond), tangents)
        np.testing.assert_allclose(p.regressor(beyond).dense() @ p.coefficients + p.bias, tangents)
