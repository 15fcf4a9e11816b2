"""The reversible part that follows a polynomial."""

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.identification import damped_oscillation, identify
from bench.models import PolynomialTerm, Preisach, ThermalExpansion, reversible_from_json, uniform_levels


def value(term, inputs):
    """The term by its pieces, as the compiled loops take it."""
    breaks, quadratics = term.pieces()
    c = quadratics[np.searchsorted(breaks, inputs)]
    return c[:, 0] + c[:, 1] * inputs + c[:, 2] * inputs**2


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=6), st.integers(1, 40))
def test_columns_and_pieces_are_the_same_term(series, knots):
    term = PolynomialTerm(tuple(series), -1.0, 3.0, knots)
    inputs = np.linspace(-2.0, 4.0, 301)
    np.testing.assert_allclose(term.columns(inputs) @ term.coefficients, value(term, inputs), atol=1e-9)


def test_it_follows_the_polynomial_as_closely_as_it_says():
    inputs = np.linspace(2.0, 7.0, 5001)
    x = (2 * inputs - 9.0) / 5.0
    for k in range(1, 8):
        term = PolynomialTerm((0.0,) * (k - 1) + (1.0,), 2.0, 7.0)
        error = np.max(np.abs(value(term, inputs) - np.cos(k * np.arccos(np.clip(x, -1, 1)))))
        bound = k**2 * (k**2 - 1) * abs(k**2 - 4) / 15 * (2 / 128) ** 3 / (72 * np.sqrt(3))
        # The greatest third derivative is taken at the ends only, so the bound is met by one interval at most.
        assert error <= 8 * bound + 1e-12


def test_it_is_continuous_from_knot_to_knot():
    term = PolynomialTerm((1.0, -2.0, 0.5, 3.0), 0.0, 1.0, 9)
    breaks, _ = term.pieces()
    np.testing.assert_allclose(value(term, breaks - 1e-12), value(term, breaks + 1e-12), atol=1e-8)


def test_json_round_trip():
    term = PolynomialTerm((1.0, -2.0), 0.0, 1.0, 9)
    assert reversible_from_json(term.to_json()) == term


def test_it_is_identified_beside_a_density():
    rng = np.random.default_rng(3)
    levels = uniform_levels(0.0, 10.0, 8)
    truth = Preisach(levels, rng.random(36), 0.5, PolynomialTerm((-4.0, 3.0, -1.0, 2.0), 0.0, 10.0))
    inputs = damped_oscillation(0.0, 10.0, 5.2, 30, 0.1)
    found = identify("preisach", inputs, truth.evaluate(inputs), levels=levels, reversible="polynomial", degree=4)
    assert found.errors.rms < 1e-8
    np.testing.assert_allclose(found.model.evaluate(inputs), truth.evaluate(inputs), atol=1e-7)
    worse = identify("preisach", inputs, truth.evaluate(inputs), levels=levels, reversible="quadratic")
    assert worse.errors.rms > 100 * found.errors.rms


@cases(
    ("arguments", "word"),
    [
        (((), 0.0, 1.0), "series"),
        (((np.nan,), 0.0, 1.0), "series"),
        (((1.0,), 1.0, 0.0), "low, high"),
        (((1.0,), 0.0, 1.0, 0), "knots"),
    ],
)
def test_wrong_arguments_are_named(arguments, word):
    with pytest.raises(ValueError, match=word):
        PolynomialTerm(*arguments)


@cases(
    ("numbers", "word"),
    [
        ((1.0, 2.0, 30.0, 30.0, 20.0), "low: expected a value below high = 30"),
        ((1.0, 2.0, 30.0, np.inf, 20.0), "high"),
        ((np.nan, 2.0, 30.0, 70.0, 20.0), "k0"),
        ((1.0, np.nan, 30.0, 70.0, 20.0), "k1"),
        ((1.0, 2.0, 30.0, 70.0, np.nan), "reference"),
    ],
)
def test_wrong_numbers_of_a_thermal_expansion_are_named(numbers, word):
    with pytest.raises(ValueError, match=word):
        ThermalExpansion(*numbers)


@cases("coefficients", [[1.0], [1.0, 2.0, 3.0]])
def test_a_thermal_expansion_has_two_coefficients(coefficients):
    with pytest.raises(ValueError, match="expected 2 values"):
        ThermalExpansion(1.0, 2.0, 30.0, 70.0, 20.0).with_coefficients(coefficients)
