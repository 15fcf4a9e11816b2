"""Signed densities: what their penalties do, how these are chosen, and the errors on inputs never fitted."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hysteretic_plants import PLANTS, butterfly as butterfly_of_duhem, settled
from scipy.optimize import lsq_linear

from bench.identification import choose_regularization, cross_validate, fit, fit_minimum_norm, identify, ramps
from bench.identification.fit.cell_layout import CellLayout
from bench.models import Preisach, uniform_levels

OTHER_PLANTS = PLANTS | {"butterfly": butterfly_of_duhem}


def operator(order=6):
    return Preisach(uniform_levels(-1.0, 1.0, order), np.zeros(order * (order + 1) // 2))


def butterfly(inputs, seed):
    """The square of a Jiles-Atherton magnetization (J. Magn. Magn. Mater. 61, 48, 1986): no Preisach operator."""
    rng = np.random.default_rng(seed)
    shape, pinning, reversible = rng.uniform(0.15, 0.3), rng.uniform(0.1, 0.3), rng.uniform(0.05, 0.4)
    coupling = 3.0 * shape * rng.uniform(0.0, 0.1)
    field, magnetization, found = 0.0, 0.0, np.empty(inputs.size)
    for n, value in enumerate(inputs.tolist()):
        count = max(1, int(abs(value - field) / 0.01))
        step = (value - field) / count
        for _ in range(count):
            x = (field + 0.5 * step + coupling * magnetization) / shape
            if abs(x) > 1e-3:
                langevin, slope = 1 / np.tanh(x) - 1 / x, (1 / x**2 - 1 / np.sinh(x) ** 2) / shape
            else:
                langevin, slope = x / 3, 1 / (3 * shape)
            away = langevin - magnetization
            sign = 1.0 if step > 0 else -1.0
            moved = away / (pinning * sign - coupling * away) if away * sign > 0 else 0.0
            rate = ((1 - reversible) * moved + reversible * slope) / (1 - coupling * reversible * slope)
            magnetization += step * rate
            field += step
        found[n] = magnetization**2
    return found


def reversals(seed, count=30):
    return ramps([-1.0, 1.0, *np.random.default_rng(seed).uniform(-1, 1, count)], 0.05)


def damped(count=30):
    return ramps([-1.0, *(((-1) ** n) * (1.0 - n / count) for n in range(count))], 0.05)


def held_out(found, inputs, outputs, known=0):
    return float(np.sqrt(np.mean((outputs - found.model.evaluate(inputs))[known:] ** 2)))


@pytest.mark.parametrize(("seed", "noise"), [(0, 0.0), (1, 0.005)])
def test_error_on_other_reversals_is_below_three_times_the_cross_validated_one(seed, noise):
    inputs, others = reversals(seed), reversals(seed + 100)
    outputs, expected = butterfly(inputs, seed), butterfly(others, seed)
    span = np.ptp(outputs)
    outputs = outputs + noise * span * np.random.default_rng(seed).normal(size=outputs.size)
    found = identify("preisach-signed", inputs, outputs, plane=(-1.0, 1.0))
    error = held_out(found, others, expected)
    assert error <= 3.0 * found.regularization.rms
    assert error <= 0.1 * span
    least_norm = identify("preisach-signed", inputs, outputs, plane=(-1.0, 1.0), smoothing=0.0, ridge=0.0)
    assert least_norm.regularization is None
    assert error < held_out(least_norm, others, expected)


def ratio_to_cross_validated(plant, seed, options):
    """Return the error on other random reversals without noise, in cross-validated errors."""
    inputs, others = reversals(seed), reversals(seed + 100)
    outputs, expected = (settled(plant, each) for each in (inputs, others))
    outputs = outputs + 0.01 * np.ptp(outputs) * np.random.default_rng(seed).normal(size=outputs.size)
    found = identify("preisach-signed", inputs, outputs, skip=80, **options)
    return held_out(found, others, expected, 80) / found.regularization.rms


@pytest.mark.parametrize(
    ("plant", "seed", "plane"),
    [
        ("bouc-wen", 0, None),
        ("duhem", 1, (-3.0, 3.0)),
        ("jiles-atherton", 0, None),
        ("butterfly", 1, (-3.0, 3.0)),
    ],
)
def test_that_holds_with_60_samples(plant, seed, plane):
    rng = np.random.default_rng(seed)
    inputs = np.interp(np.linspace(0.0, 8.0, 60), np.arange(9.0), [-1.0, 1.0, -1.0, *rng.uniform(-1.0, 1.0, 6)])
    others = ramps([-1.0, 1.0, *rng.uniform(-1.0, 1.0, 30)], 0.05)
    raw = OTHER_PLANTS[plant]
    outputs, expected = settled(raw, inputs), settled(raw, others)
    noisy = outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(60)
    options = {"levels": 20, "reversible": "linear"} | ({} if plane is None else {"plane": plane})
    found = identify("preisach-signed", inputs, noisy, **options)
    assert held_out(found, others, expected, 81) <= 3.0 * found.regularization.rms


@pytest.mark.parametrize("plant", OTHER_PLANTS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.seeds) for seed in range(1, 4))])
@pytest.mark.parametrize("options", [
    {"levels": 5, "reversible": "polynomial"},
    *(pytest.param(options, marks=pytest.mark.seeds) for options in (
        {"levels": 30, "spacing": "quantiles"},
        {"levels": 20, "plane": (-2.0, 2.0)},
        {"levels": 20, "plane": (-0.5, 0.5)},
        {"levels": 60, "spacing": "quantiles", "reversible": "linear"},
    )),
])  # fmt: skip
def test_that_holds_on_any_plane(plant, seed, options):
    assert ratio_to_cross_validated(OTHER_PLANTS[plant], seed, options) <= 3.0


def test_weights_from_a_damped_oscillation_are_near_the_best_for_random_reversals():
    seed = 1
    inputs, others = damped(), reversals(seed + 100)
    outputs, expected = butterfly(inputs, seed), butterfly(others, seed)

    def error(**penalties):
        found = identify("preisach-signed", inputs, outputs, plane=(-1.0, 1.0), **penalties)
        return held_out(found, others, expected)

    tried = [error(smoothing=s, ridge=r) for s in (1e-4, 1e-2, 1.0) for r in (0.0, 1e-2)]
    assert error() <= 2.0 * min(tried)


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.integers(2, 7), st.floats(-5, 1), st.floats(-5, 1), st.booleans())
def test_penalised_fit_equals_stacked_least_squares(seed, order, smoothing, ridge, nonnegative):
    rng = np.random.default_rng(seed)
    inputs = rng.uniform(-1.1, 1.1, 60)
    outputs, weights = rng.normal(size=60), rng.uniform(0.1, 2.0, 60)
    smoothing, ridge = 10.0**smoothing, 10.0**ridge
    regressor = operator(order).regressor(inputs)
    found = fit(regressor, outputs, nonnegative=nonnegative, weights=weights, smoothing=smoothing, ridge=ridge)
    matrix = regressor.dense()
    root = np.sqrt(weights)
    a = root[:, None] * (matrix - weights @ matrix / weights.sum())
    b = root * (outputs - weights @ outputs / weights.sum())
    squares = (a**2).sum(axis=0)
    unit = squares[squares > 1e-20].mean()
    values, vectors = np.linalg.eigh(CellLayout.of(matrix.shape[1]).roughness.toarray())
    rough = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    stacked = np.vstack([a, np.sqrt(smoothing * unit) * rough, np.sqrt(ridge * unit) * np.eye(a.shape[1])])
    bounds = (0.0 if nonnegative else -np.inf, np.inf)
    expected = lsq_linear(stacked, np.concatenate([b, np.zeros(2 * a.shape[1])]), bounds, "bvls", tol=1e-15).x
    np.testing.assert_allclose(found.coefficients, expected, atol=1e-7 * max(1.0, np.abs(expected).max()))
    assert found.certificate.kkt_residual < 1e-10


def test_without_penalties_it_is_the_least_norm_to_the_last_bit():
    inputs = reversals(3)
    outputs = butterfly(inputs, 3)
    found = identify("preisach-signed", inputs, outputs, levels=6, plane=(-1.0, 1.0), smoothing=0.0, ridge=0.0)
    expected = fit_minimum_norm(operator().regressor(inputs), outputs)
    np.testing.assert_array_equal(found.model.density, expected.coefficients)


@pytest.mark.parametrize("order", [6, 30])
def test_cross_validated_error_is_that_of_explicit_folds(order):
    """The choice by normal equations, on a merged plane if it is fine, beside fits of each fold."""
    inputs = reversals(1)
    outputs = butterfly(inputs, 1)
    regressor = operator(order).regressor(inputs)
    chosen = choose_regularization(regressor, outputs, np.ones(outputs.size), 10, None, 1e-3)
    assert chosen.ridge == 1e-3
    table = cross_validate(
        "preisach-signed", inputs, outputs, smoothing=[chosen.smoothing], ridge=1e-3, skip=10, levels=[order],
        plane=(-1.0, 1.0),
    )  # fmt: skip
    (trial,) = table.trials
    # A merged plane has other cells.
    tolerance = 1e-2 if order == 6 else 0.2
    assert chosen.rms == pytest.approx(trial.rms, rel=tolerance)
    assert chosen.training_rms == pytest.approx(trial.training_rms, rel=tolerance)


def test_a_given_weight_is_kept():
    inputs = reversals(2)
    outputs = butterfly(inputs, 2)
    for given_, other in (({"smoothing": 0.0}, "ridge"), ({"ridge": 0.0}, "smoothing")):
        found = identify("preisach-signed", inputs, outputs, levels=6, **given_).regularization
        assert all(getattr(found, name) == value for name, value in given_.items())
        assert getattr(found, other) > 0.0
    both = identify("preisach-signed", inputs, outputs, levels=6, smoothing=1e-3, ridge=1e-2).regularization
    assert (both.smoothing, both.ridge, np.isnan(both.rms)) == (1e-3, 1e-2, True)
    assert identify("preisach", inputs, outputs, levels=6).regularization is None
    assert identify("polynomial", inputs, outputs).regularization is None


def test_a_plane_too_fine_for_a_dense_matrix_is_refused():
    inputs = reversals(2, 3)
    with pytest.raises(ValueError, match=r"levels: penalties .* at most 8001 cells .*, got 20100; give fewer levels"):
        identify("preisach-signed", inputs, inputs**2, levels=200)


def test_few_samples_are_fitted_and_a_constant_record_is_refused():
    few = identify("preisach-signed", [0.0, 1.0, 0.5], [0.0, 1.0, 0.7], levels=4)
    assert np.isfinite(few.model.density).all()
    with pytest.raises(ValueError, match="constant"):
        identify("preisach-signed", np.zeros(30), np.ones(30), levels=4, plane=(-1.0, 1.0))
