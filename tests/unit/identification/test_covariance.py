"""The variance of predictions against dense linear algebra."""

import json

import numpy as np
import pytest
from cases import cases
from other_plants import damped, measured, random_reversals

from bench.identification import set_up_problem
from bench.identification.fit.cell_layout import CellLayout
from bench.identification.fit.covariance import PredictionVariance, prediction_variance


def problem_of(model, options, smoothing=0.0, weights=None, skip=0, seed=0):
    rng = np.random.default_rng(seed)
    inputs = random_reversals(rng)
    outputs = measured("duhem", inputs, rng)
    return set_up_problem(model, inputs, outputs, weights, skip, smoothing, None, dict(options))


def dense_variance(problem, found, smoothing, ridge, inputs):
    """Return s, ρ and the variance of predictions by the textbook, with the bias as a column like others."""
    kept = np.flatnonzero(found.coefficients)
    w = problem.weights.copy()
    w[: problem.skip] = 0.0
    rows = problem.regressor.dense()
    a = np.column_stack([np.ones(rows.shape[0]), rows[:, kept]])
    penalty = np.zeros((rows.shape[1], rows.shape[1]))
    cells = problem.regressor.base.size
    if smoothing or ridge:
        means = w @ rows / w.sum()
        square = (w @ (rows - means) ** 2)[:cells]
        swept = found.certificate.swept[:cells]
        rough = smoothing * CellLayout.of(cells).roughness().toarray() + ridge * np.eye(cells)
        penalty[:cells, :cells] = square[swept].mean() * rough
    penalty = np.pad(penalty[np.ix_(kept, kept)], (1, 0))
    information = a.T @ (w[:, None] * a)
    posterior = np.linalg.inv(information + penalty)
    freedom = float(np.trace(posterior @ information))
    used = w > 0.0
    residuals = (problem.outputs - found.bias - rows @ found.coefficients)[used]
    variance = w[used] @ residuals**2 / (used.sum() - freedom)
    rho = residuals[1:] @ residuals[:-1] / (residuals @ residuals)
    new = problem.template.regressor(inputs, problem.state).dense()
    b = np.column_stack([np.ones(inputs.size), new[:, kept]])
    inflation = (1.0 + max(rho, 0.0)) / (1.0 - max(rho, 0.0))
    return np.sqrt(variance), rho, freedom, variance * inflation * np.einsum("ij,jk,ik->i", b, posterior, b)


@cases(("model", "options", "smoothing", "ridge"), [
    ("preisach", {"levels": 8, "plane": (-1.0, 1.0), "reversible": "linear"}, 0.0, 0.0),
    ("preisach", {"levels": 8, "plane": (-1.0, 1.0)}, 0.1, 0.0),
    ("preisach-signed", {"levels": 8, "plane": (-1.0, 1.0)}, 0.01, 0.1),
    ("prandtl-ishlinskii", {"plays": 8}, 0.0, 0.0),
])  # fmt: skip
@cases("skip", [0, 40])
def test_it_is_the_dense_one(model, options, smoothing, ridge, skip):
    weights = np.random.default_rng(1).uniform(0.5, 2.0, problem_of(model, options).inputs.size)
    problem = problem_of(model, options, smoothing, weights, skip)
    found = problem.fit(smoothing, ridge=ridge)
    variance = prediction_variance(problem, found, smoothing, ridge)
    inputs = damped(np.random.default_rng(2))
    residual, rho, freedom, expected = dense_variance(problem, found, smoothing, ridge, inputs)
    assert variance.residual == pytest.approx(residual, rel=1e-4)
    assert variance.correlation == pytest.approx(rho, rel=1e-3, abs=1e-5)
    assert variance.freedom == pytest.approx(freedom, rel=1e-3)
    # Directions that carry a thousandth of the variance are left out, and added as a constant.
    got = variance.of(problem.template.regressor(inputs, problem.state))
    np.testing.assert_allclose(np.sqrt(got), np.sqrt(expected), rtol=0.05, atol=0.05 * np.sqrt(expected).max())


def test_directions_of_least_norm_that_the_data_do_not_tell_add_nothing():
    problem = problem_of("preisach-signed", {"levels": 30, "plane": (-1.0, 1.0)})
    found = problem.fit(0.0)
    variance = prediction_variance(problem, found, 0.0)
    assert variance.freedom <= found.certificate.passive + 1
    assert np.isfinite(variance.of(problem.regressor)).all()


def test_many_coefficients_are_kept_in_few_directions():
    problem = problem_of("preisach", {"levels": 40, "plane": (-1.0, 1.0)}, 0.01)
    variance = prediction_variance(problem, problem.fit(0.01), 0.01)
    assert variance.columns.size > 300
    assert variance.factor.size <= 16000
    again = PredictionVariance.from_json(json.loads(json.dumps(variance.to_json())))
    np.testing.assert_array_equal(again.of(problem.regressor), variance.of(problem.regressor))


def test_no_samples_to_spare():
    inputs = np.random.default_rng(0).uniform(-1.0, 1.0, 15)
    problem = set_up_problem("polynomial", inputs, inputs**2, None, 0, 0.0, None, {"degree": 14})
    with pytest.raises(ValueError, match=r"band: 15 samples on 15 free coefficients leave nothing"):
        prediction_variance(problem, problem.fit(0.0), 0.0)


@cases(("key", "value", "words"), [
    ("residual", -1.0, "expected a residual"),
    ("constant", "x", "constant: expected a number"),
    ("columns", [3, 1], "as many finite means and factors as columns"),
    ("means", "nan", "as many finite means"),
    ("columns", [3, 2, 1, 0], "as many finite means|columns that increase"),
])  # fmt: skip
def test_damaged_content(key, value, words):
    problem = problem_of("prandtl-ishlinskii", {"plays": 4})
    document = {**prediction_variance(problem, problem.fit(0.0), 0.0).to_json(), key: value}
    with pytest.raises(ValueError, match=words):
        PredictionVariance.from_json(document)
