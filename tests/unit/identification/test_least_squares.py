"""The constrained fit against a dense reference solver, and its certificate on hard cases."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import example, given, settings, strategies as st
from scipy.linalg.lapack import dpocon
from scipy.optimize import lsq_linear, nnls

from bench.identification import fit, fit_minimum_norm, ramps
from bench.identification.fit import least_squares
from bench.identification.fit.cholesky_factor import CholeskyFactor
from bench.models import Preisach, QuadraticTerm, Regressor, uniform_levels


def oscillation(count=25, step=0.05):
    return ramps([-1.0, *(((-1) ** n) * (1.0 - n / count) for n in range(count))], step)


def problem(order=8, seed=0, term=None, noise=0.05):
    rng = np.random.default_rng(seed)
    cells = order * (order + 1) // 2
    operator = Preisach(uniform_levels(-1.0, 1.0, order), np.zeros(cells), reversible=term)
    truth = np.where(rng.random(cells) < 0.5, 0.0, rng.random(cells))
    if term is not None:
        truth = np.concatenate([truth, term.coefficients])
    operator = operator.with_coefficients(truth, 0.7)
    inputs = np.concatenate([oscillation(), rng.uniform(-1, 1, 200)])
    outputs = operator.evaluate(inputs)
    return operator, inputs, outputs + noise * rng.normal(size=inputs.size)


def dense_problem(columns, seed=0, rows=60):
    """A regressor that is dense throughout."""
    extra = np.asarray(columns, dtype=float)
    return Regressor(
        np.empty(0),
        np.zeros(extra.shape[0] + 1, dtype=np.int64),
        np.empty(0, dtype=np.int32),
        np.empty(0),
        np.ascontiguousarray(extra),
    )


def centred(matrix, outputs, weights=None):
    w = np.ones(len(outputs)) if weights is None else np.asarray(weights)
    root = np.sqrt(w)[:, None]
    mean = w @ matrix / w.sum()
    level = w @ outputs / w.sum()
    return (matrix - mean) * root, (outputs - level) * root[:, 0]


def kkt(matrix, outputs, found, nonnegative, weights=None):
    """The conditions straight from their definition, on the dense matrix."""
    a, b = centred(matrix, outputs, weights)
    norms = np.linalg.norm(a, axis=0)
    norms[norms < 1e-9] = np.inf
    g = a.T @ (b - a @ found.coefficients) / norms / np.linalg.norm(b)
    held = nonnegative & (found.coefficients == 0.0)
    return np.where(held, np.maximum(g, 0.0), np.abs(g)).max()


@cases("seed", range(2))
def test_equals_dense_nnls(seed):
    operator, inputs, outputs = problem(seed=seed)
    regressor = operator.regressor(inputs)
    found = fit(regressor, outputs)
    a, b = centred(regressor.dense(), outputs)
    expected, norm = nnls(a, b)
    np.testing.assert_allclose(found.coefficients, expected, atol=1e-8 * expected.max())
    residual = outputs - found.bias - regressor.product(found.coefficients)
    assert np.linalg.norm(residual) == pytest.approx(norm, rel=1e-12)
    assert residual.mean() == pytest.approx(0.0, abs=1e-12)
    assert found.certificate.kkt_residual < 1e-10
    assert found.certificate.converged
    assert found.certificate.passive == np.count_nonzero(expected > 0)
    assert found.certificate.passive + found.certificate.active == expected.size


def test_mixed_signs_weights_and_skip_equal_a_dense_reference():
    seed = 2
    operator, inputs, outputs = problem(seed=seed, term=QuadraticTerm(-0.8, -0.3), noise=0.1)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.1, 2.0, inputs.size)
    skip = 37
    signs = np.ones(38, dtype=bool)
    signs[36:] = False
    regressor = operator.regressor(inputs)
    found = fit(regressor, outputs, nonnegative=signs, weights=weights, skip=skip)
    matrix = regressor.dense()
    a, b = centred(matrix[skip:], outputs[skip:], weights[skip:])
    bounds = (np.where(signs, 0.0, -np.inf), np.inf)
    expected = lsq_linear(a, b, bounds, method="bvls", tol=1e-15).x
    np.testing.assert_allclose(found.coefficients, expected, atol=1e-6)
    assert kkt(matrix[skip:], outputs[skip:], found, signs, weights[skip:]) < 1e-10
    assert found.certificate.kkt_residual < 1e-10


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.integers(2, 40), st.integers(1, 30), st.booleans())
def test_kkt_on_random_dense_problems(seed, rows, columns, duplicates):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, columns)) * 10.0 ** rng.uniform(-6, 6, columns)
    if duplicates:
        matrix = np.column_stack([matrix, matrix[:, ::2], np.zeros(rows), np.full(rows, 3.0)])
    outputs = rng.normal(size=rows)
    signs = rng.random(matrix.shape[1]) < 0.7
    found = fit(dense_problem(matrix), outputs, nonnegative=signs)
    assert found.certificate.kkt_residual < 1e-10
    assert (found.coefficients[signs] >= 0.0).all()
    assert kkt(matrix, outputs, found, signs) < 1e-9


def test_constant_input_identifies_nothing_but_the_bias():
    operator, _, _ = problem()
    outputs = np.array([1.0, 2.0, 3.0])
    found = fit(operator.regressor([0.3, 0.3, 0.3]), outputs)
    assert found.bias == pytest.approx(2.0)
    assert not found.coefficients.any()
    assert found.certificate.coverage == 0.0
    assert found.certificate.kkt_residual == 0.0
    assert found.certificate.passive == 0


def test_constant_outputs():
    operator, inputs, _ = problem()
    found = fit(operator.regressor(inputs), np.full(inputs.size, 5.0))
    assert found.bias == pytest.approx(5.0)
    np.testing.assert_allclose(found.coefficients, 0.0, atol=1e-12)


def test_unswept_cells_are_reported():
    operator, _, _ = problem(order=4)
    # From -1 to 0 and back: only cells with α below 0 are swept.
    found = fit(operator.regressor([-1.0, -0.5, 0.0, -0.5, -1.0]), [0.0, 1.0, 2.0, 1.5, 0.0])
    expected = np.zeros(10, dtype=bool)
    expected[:3] = True
    np.testing.assert_array_equal(found.certificate.swept, expected)
    assert found.certificate.coverage == pytest.approx(0.3)
    # What only the skipped samples swept does not count.
    later = fit(operator.regressor([-1.0, 1.0, 0.5, 0.6]), [0.0, 1.0, 1.0, 1.0], skip=2)
    assert later.certificate.swept.sum() == 1


def test_uncertainties_are_those_of_repeated_measurements():
    operator, inputs, clean = problem(order=3, noise=0.0)
    operator = operator.with_coefficients(np.full(6, 5.0), 0.0)
    clean = operator.evaluate(inputs)
    regressor = operator.regressor(inputs)
    rng = np.random.default_rng(5)
    fits = [fit(regressor, clean + 0.01 * rng.normal(size=clean.size)) for _ in range(80)]
    spread = np.std([f.coefficients for f in fits], axis=0)
    claimed = np.mean([f.uncertainties for f in fits], axis=0)
    np.testing.assert_allclose(claimed, spread, rtol=0.25)


def test_smoothing_fills_gaps_and_lowers_roughness():
    operator, inputs, outputs = problem(order=10, noise=0.3)
    regressor = operator.regressor(inputs)
    plain, smooth = fit(regressor, outputs), fit(regressor, outputs, smoothing=0.1)

    def roughness(found):
        plane = operator.with_coefficients(found.coefficients, 0.0).density_matrix()
        return np.nansum(np.diff(plane, axis=0) ** 2) + np.nansum(np.diff(plane, axis=1) ** 2)

    assert roughness(smooth) < 0.3 * roughness(plain)
    assert smooth.certificate.kkt_residual < 1e-10
    # Half of the plane unswept: smoothness carries the density over.
    half = operator.regressor([-1.0, -0.4, 0.0, -0.6, -0.2, -1.0])
    carried = fit(half, half.product(np.ones(55)), smoothing=1e-6)
    assert carried.coefficients[-1] > 0.5
    assert carried.certificate.coverage < 0.5


def test_smoothed_uncertainties_are_those_of_the_penalised_normal_equations():
    operator, inputs, outputs = problem(order=5, noise=0.3)
    regressor = operator.regressor(inputs)
    found = fit(regressor, outputs, nonnegative=False, smoothing=0.05)
    a, b = centred(regressor.dense(), outputs)
    gram = a.T @ a
    mean_square = np.diag(gram).mean()
    rows, columns = np.tril_indices(5)
    distance = np.abs(rows[:, None] - rows) + np.abs(columns[:, None] - columns)
    laplacian = np.diag((distance == 1).sum(axis=1)) - (distance == 1)
    inverse = np.linalg.inv(gram + 0.05 * mean_square * laplacian @ laplacian)
    residual = b - a @ found.coefficients
    spare = len(b) - 1 - np.trace(inverse @ gram)
    expected = np.sqrt(np.diag(inverse) * (residual @ residual) / spare)
    np.testing.assert_allclose(found.uncertainties, expected, rtol=1e-9)
    assert (found.uncertainties < fit(regressor, outputs, nonnegative=False).uncertainties).all()


@pytest.mark.parametrize(("order", "smoothing", "many"), [(25, 1e-3, 1000), (31, 1e-5, 0), (48, 1e-2, 0)])
def test_smoothing_from_a_coarser_plane_equals_that_from_scratch(order, smoothing, many, monkeypatch):
    operator, inputs, outputs = problem(order=order, noise=0.2, term=QuadraticTerm(-0.8, -0.3))
    regressor = operator.regressor(inputs)
    signs = np.arange(regressor.shape[1]) < regressor.base.size
    # Conjugate gradients come before the passive set from so many columns on.
    monkeypatch.setattr(least_squares, "_MANY", many)
    found = fit(regressor, outputs, nonnegative=signs, smoothing=smoothing)
    monkeypatch.setattr(least_squares, "_COARSEST", 1000)
    expected = fit(regressor, outputs, nonnegative=signs, smoothing=smoothing)
    assert found.certificate.kkt_residual < 1e-10
    np.testing.assert_allclose(found.coefficients, expected.coefficients, atol=1e-6)


@cases("start", ["zeros", "ones", "other weights"])
def test_smoothing_from_any_start_is_the_same(start):
    operator, inputs, outputs = problem(order=10, noise=0.3)
    regressor = operator.regressor(inputs)
    expected = fit(regressor, outputs, smoothing=1e-3)
    half = fit(regressor, outputs, weights=np.arange(outputs.size) % 2, smoothing=1e-3)
    points = {"zeros": np.zeros(55), "ones": np.ones(55), "other weights": half.coefficients}
    found = fit(regressor, outputs, smoothing=1e-3, start=points[start])
    assert found.certificate.kkt_residual < 1e-10
    np.testing.assert_allclose(found.coefficients, expected.coefficients, atol=1e-8 * expected.coefficients.max())
    assert found.certificate.effective == pytest.approx(expected.certificate.effective, rel=1e-8)


def condition_by_lapack(block):
    """The estimate of dpocon."""
    norm = np.abs(block).sum(axis=0).max(initial=0.0)
    reciprocal, _ = dpocon(np.linalg.cholesky(block), norm, uplo="L")
    return norm, np.sqrt(1.0 / reciprocal)


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.one_of(st.integers(1, 30), st.integers(250, 600)))
@example(1, 257)
def test_factor_follows_the_columns(seed, size):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(size + 10, size))
    gram = matrix.T @ matrix / size
    right = rng.normal(size=size)
    factor = CholeskyFactor()
    chosen = np.empty(0, dtype=np.int64)
    for _ in range(8 if size < 100 else 3):
        new = np.setdiff1d(rng.permutation(size)[: rng.integers(0, size + 1)], chosen)
        while new.size:
            some, new = np.split(new, [factor.room])
            entries = gram[np.ix_(some, np.concatenate([chosen, some]))]
            assert factor.append(entries, right[some]).all()
            chosen = np.concatenate([chosen, some])
        gone = np.flatnonzero(rng.random(chosen.size) < (0.4 if size < 100 else 0.05))
        factor.delete(gone)
        chosen = np.delete(chosen, gone)
        if rng.random() < 0.2:
            chosen = chosen[: chosen.size // 2]
            factor.truncate(chosen.size)
        block = gram[np.ix_(chosen, chosen)]
        np.testing.assert_allclose(block @ factor.solution(), right[chosen], atol=1e-6)
        other = rng.normal(size=chosen.size)
        np.testing.assert_allclose(block @ factor.solve(other), other, atol=1e-6)
        places = np.flatnonzero(rng.random(chosen.size) < 0.5)
        step = np.zeros(chosen.size)
        step[places] = other[places]
        if places.size:
            assert factor.length(places, other[places]) ** 2 == pytest.approx(step @ block @ step, abs=1e-9)
        if chosen.size:
            norm, expected = condition_by_lapack(block)
            assert factor.condition(norm) == pytest.approx(expected, rel=1e-6)
    factor.invert()
    inverse = np.linalg.inv(block)
    second, first = np.tril_indices(chosen.size)
    entries = factor.inverse_entries(first, second)
    np.testing.assert_allclose(entries, inverse[first, second], rtol=1e-6, atol=1e-9 * np.abs(inverse).max(initial=0))
    np.testing.assert_allclose(factor.inverse_diagonal(), np.diag(inverse), rtol=1e-6)


def test_uncertainties_of_signed_coefficients_are_those_of_least_squares():
    """From the definition: s² times the diagonal of the inverse of the centred, weighted Gram matrix."""
    rng = np.random.default_rng(3)
    operator = Preisach(uniform_levels(-1.0, 1.0, 4), np.zeros(10))
    regressor = operator.regressor(ramps(rng.uniform(-1.0, 1.0, 40), 12))
    rows = regressor.shape[0]
    weights, outputs = rng.uniform(0.5, 2.0, rows), rng.normal(size=rows)
    found = fit_minimum_norm(regressor, outputs, weights=weights)
    matrix = np.column_stack([np.ones(rows), regressor.dense()])
    inverse = np.linalg.inv(matrix.T @ (weights[:, None] * matrix))
    x = inverse @ matrix.T @ (weights * outputs)
    variance = weights @ (outputs - matrix @ x) ** 2 / (rows - matrix.shape[1])
    np.testing.assert_allclose(found.coefficients, x[1:], rtol=1e-8)
    np.testing.assert_allclose(found.uncertainties, np.sqrt(variance * np.diag(inverse))[1:], rtol=1e-8)
    repeated = np.repeat(regressor.dense()[:, :1], 2, axis=1)
    assert np.isnan(fit_minimum_norm(dense_problem(repeated), outputs).uncertainties).all()


def test_minimum_norm_equals_the_pseudo_inverse():
    operator, _, _ = problem()
    rng = np.random.default_rng(3)
    inputs = rng.uniform(-1, 1, 30)
    outputs = rng.normal(size=30)
    regressor = operator.regressor(inputs)
    found = fit_minimum_norm(regressor, outputs)
    a, b = centred(regressor.dense(), outputs)
    np.testing.assert_allclose(found.coefficients, np.linalg.pinv(a) @ b, atol=1e-9)
    assert found.certificate.kkt_residual < 1e-10
    weights = rng.uniform(0.5, 2, 30)
    weighted = fit_minimum_norm(regressor, outputs, weights=weights, skip=4)
    a, b = centred(regressor.dense()[4:], outputs[4:], weights[4:])
    np.testing.assert_allclose(weighted.coefficients, np.linalg.pinv(a) @ b, atol=1e-9)


def test_blas_is_limited_to_one_thread_only_inside():
    from threadpoolctl import threadpool_info, threadpool_limits

    operator, inputs, outputs = problem()
    with threadpool_limits(2, user_api="blas"):
        before = [(p["filepath"], p["num_threads"]) for p in threadpool_info() if p["user_api"] == "blas"]
        fit(operator.regressor(inputs), outputs)
        after = {p["filepath"]: p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"}
    assert all(after[path] == threads for path, threads in before)


@cases(
    ("options", "outputs", "message"),
    [
        ({}, np.zeros(3), "outputs: expected 4 values"),
        ({}, [0.0, math.nan, 0.0, 0.0], "outputs: expected finite"),
        ({"weights": [1.0, 1.0]}, np.zeros(4), "weights: expected 4 values"),
        ({"weights": [1.0, -1.0, 1.0, 1.0]}, np.zeros(4), "weights: expected values >= 0"),
        ({"weights": np.zeros(4)}, np.zeros(4), "weights: expected at least one positive"),
        ({"skip": 4}, np.zeros(4), "skip: expected 0 <= skip < 4"),
        ({"skip": -1}, np.zeros(4), "skip"),
        ({"smoothing": -1.0}, np.zeros(4), "smoothing"),
        ({"smoothing": math.nan}, np.zeros(4), "smoothing"),
    ],
)
def test_wrong_input_is_named(options, outputs, message):
    operator, _, _ = problem()
    regressor = operator.regressor([-1.0, 0.0, 1.0, 0.5])
    with pytest.raises(ValueError, match=message):
        fit(regressor, outputs, **options)
