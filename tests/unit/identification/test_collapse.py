"""Long records collapsed: the same normal equations and the same fit, on every kind of run."""

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from bench.identification import fit
from bench.identification.fit import least_squares
from bench.identification.fit.collapse import collapse
from bench.models import Preisach, QuadraticTerm, ThermalExpansion, uniform_levels


def problem(seed, term=None, order=8, samples=4000, digits=None):
    """A slow damped oscillation with plateaus, random reversals, noise, weights and samples left out."""
    rng = np.random.default_rng(seed)
    levels = uniform_levels(-1.0, 1.0, order)
    operator = Preisach(levels, rng.random(order * (order + 1) // 2), reversible=term, input_range=(-1.2, 1.2))
    corners = np.concatenate([[-1.2, 1.2], rng.uniform(-1.1, 1.1, 8)])
    inputs = np.interp(np.linspace(0.0, corners.size - 1.0, samples), np.arange(corners.size), corners)
    inputs[samples // 3 : samples // 3 + 150] = inputs[samples // 3]
    if digits is not None:
        inputs = np.round(inputs, digits)
    outputs = operator.evaluate(inputs) + 0.05 * rng.normal(size=samples)
    weights = rng.uniform(0.5, 2.0, samples)
    weights[rng.integers(0, samples, samples // 10)] = 0.0
    weights[samples // 2 : samples // 2 + 200] = 0.0
    return operator.regressor(inputs), outputs, weights


def normal_equations(regressor, outputs, weights):
    columns = np.column_stack([np.ones(outputs.size), regressor.dense(), outputs])
    return columns.T @ (weights[:, None] * columns)


TERMS = [None, QuadraticTerm(-0.8, -0.3), ThermalExpansion(2.0, 3.0, -0.5, 0.5, -1.0)]


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("digits", [None, 2])
def test_normal_equations_are_the_same(term, digits):
    regressor, outputs, weights = problem(1, term, digits=digits)
    short = collapse(regressor, outputs, weights)
    assert short.outputs.size < 0.5 * outputs.size
    assert (short.weights >= 0.0).all()
    expected = normal_equations(regressor, outputs, weights)
    found = normal_equations(short.regressor, short.outputs, short.weights)
    # The squares of the outputs alone lack what no column reaches.
    found[-1, -1] += short.left
    size = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(found / size, expected / size, atol=1e-13)


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.sampled_from(TERMS), st.sampled_from([0.0, 1e-3]))
@example(1540, None, 0.0)
@example(1411, None, 0.0)
def test_the_fit_is_the_same(seed, term, smoothing):
    regressor, outputs, weights = problem(seed, term)
    signs = np.arange(regressor.shape[1]) < regressor.base.size
    with pytest.MonkeyPatch.context() as patch:
        expected = fit(regressor, outputs, nonnegative=signs, weights=weights, skip=7, smoothing=smoothing)
        patch.setattr(least_squares, "LONG", 1000)
        found = fit(regressor, outputs, nonnegative=signs, weights=weights, skip=7, smoothing=smoothing)
    assert found.certificate.kkt_residual < 1e-12
    np.testing.assert_array_equal(found.certificate.swept, expected.certificate.swept)
    size = np.abs(expected.coefficients).max()
    fitted = expected.bias + regressor.product(expected.coefficients)
    # Samples without weight tell nothing of which minimiser is taken.
    counted = np.flatnonzero(weights)[7:]
    again = found.bias + regressor.product(found.coefficients)
    np.testing.assert_allclose(again[counted], fitted[counted], atol=1e-7 * size)
    # Where cells can replace each other, those of either choice are a minimiser.
    if np.array_equal(found.coefficients == 0.0, expected.coefficients == 0.0):
        np.testing.assert_allclose(found.coefficients, expected.coefficients, atol=1e-7 * size)
        np.testing.assert_allclose(found.uncertainties, expected.uncertainties, rtol=1e-5, atol=1e-9 * size)
    # The residual, that of the whole record, is the least.
    errors = outputs - again
    least = outputs - fitted
    assert weights[7:] @ errors[7:] ** 2 <= weights[7:] @ least[7:] ** 2 * (1.0 + 1e-12)


def test_a_record_without_runs_is_left_alone():
    operator = Preisach(uniform_levels(-1.0, 1.0, 8), np.zeros(36))
    inputs = np.random.default_rng(0).uniform(-1.0, 1.0, 500)
    assert collapse(operator.regressor(inputs), inputs, np.ones(500)) is None
