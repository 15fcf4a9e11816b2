"""Rank, resolution and uniqueness, by brute force on small planes."""

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.identification import fit, fit_minimum_norm, resolve
from bench.models import Preisach, QuadraticTerm, uniform_levels


def problem(seed, order, samples, term=None):
    rng = np.random.default_rng(seed)
    operator = Preisach(uniform_levels(-1.0, 1.0, order), np.zeros(order * (order + 1) // 2), reversible=term)
    # To tenths: no cell is swept by next to nothing, and the rank is plain.
    regressor = operator.regressor(np.round(rng.uniform(-1.1, 1.1, samples), 1))
    weights = rng.uniform(0.2, 2.0, samples)
    matrix = regressor.dense()
    centred = np.sqrt(weights)[:, None] * (matrix - weights @ matrix / weights.sum())
    return rng, regressor, weights, centred


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 8), st.integers(3, 60))
def test_equals_the_singular_value_decomposition(seed, order, samples):
    _, regressor, weights, centred = problem(seed, order, samples)
    found = resolve(regressor, weights)
    _, singular, right = np.linalg.svd(centred, full_matrices=False)
    kept = singular > 1e-6 * max(singular.max(), 1e-300)
    assert found.rank == kept.sum()
    np.testing.assert_allclose(found.diagonal, (right[kept] ** 2).sum(axis=0), atol=1e-6)
    assert found.diagonal.sum() == pytest.approx(found.rank, abs=1e-6)


@cases("term", [None, QuadraticTerm(1.0, 0.0)])
@cases("seed", range(3))
def test_with_penalties_it_is_the_map_from_true_to_found_coefficients(seed, term):
    """Found coefficients are linear in the outputs, so that the map's columns are fits of the regressor's."""
    _, regressor, weights, _ = problem(seed, 4, 80, term)
    penalties = {"smoothing": 1e-2, "ridge": 1e-3}
    found = resolve(regressor, weights, 5, **penalties)
    matrix = regressor.dense()
    expected = [
        fit(regressor, matrix[:, c], nonnegative=False, weights=weights, skip=5, **penalties).coefficients[c]
        for c in range(matrix.shape[1])
    ]
    np.testing.assert_allclose(found.diagonal, expected, atol=1e-6)


def test_a_constant_record_determines_nothing():
    operator = Preisach(uniform_levels(-1.0, 1.0, 4), np.zeros(10))
    found = resolve(operator.regressor(np.zeros(5)), np.ones(5))
    assert (found.rank, found.diagonal.max()) == (0, 0.0)


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(2, 8), st.integers(5, 60))
def test_exchangeable_cells_can_take_over_and_the_others_cannot(seed, order, samples):
    rng, regressor, weights, centred = problem(seed, order, samples)
    outputs = rng.normal(size=samples)
    found = fit(regressor, outputs, weights=weights)
    passive = found.coefficients > 0.0
    target = np.sqrt(weights) * (outputs - weights @ outputs / weights.sum())
    norms = np.linalg.norm(centred, axis=0)
    usable = norms > 1e-9
    slopes = np.zeros(norms.size)
    slopes[usable] = (centred.T @ (target - centred @ found.coefficients))[usable] / norms[usable]
    level = ~passive & usable & (np.abs(slopes) < 1e-9 * np.linalg.norm(target))
    assert found.certificate.exchangeable == level.sum()
    # Each of them lies in the span of the passive columns, which are positive and can give way to it.
    for c in np.flatnonzero(level):
        rest = (
            centred[:, c] - centred[:, passive] @ np.linalg.lstsq(centred[:, passive], centred[:, c], rcond=None)[0]
        )
        assert np.linalg.norm(rest) < 1e-6 * norms[c]


def test_more_cells_than_samples_are_not_unique_until_smoothed():
    rng, regressor, _, _ = problem(4, 8, 20)
    outputs = regressor.product(rng.random(36))
    assert fit(regressor, outputs).certificate.exchangeable > 0
    assert fit(regressor, outputs, smoothing=1e-3).certificate.exchangeable == 0
    least = fit_minimum_norm(regressor, outputs).certificate
    assert least.exchangeable == least.swept.sum() - least.passive > 0
