"""Regressor and constrained fit beside what a user would otherwise take. Prints, asserts no time."""

import time

import numpy as np
import pytest
from scipy.optimize import nnls

from bench.hysteresis import Preisach, uniform_levels
from bench.identification import fit

pytestmark = pytest.mark.benchmark


def timed(function):
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def problem(order, samples=3000, cycles=30):
    """A damped triangle with 1 % noise on a smooth density."""
    rng = np.random.default_rng(0)
    t = np.arange(samples) / samples * cycles
    inputs = (1 - t / cycles) * (4 * np.abs((t + 0.25) % 1 - 0.5) - 1)
    levels = uniform_levels(-1.0, 1.0, order)
    middle = 0.5 * (levels[1:] + levels[:-1])
    i, j = np.tril_indices(order)
    density = np.exp(-((middle[i] - 0.2) ** 2 + (middle[j] + 0.2) ** 2) / 0.1)
    operator = Preisach(levels, density)
    outputs = operator.evaluate(inputs)
    return operator, inputs, outputs + 0.01 * outputs.std() * rng.normal(size=samples)


def test_fit(capsys):
    operator, inputs, outputs = problem(5)
    fit(operator.regressor(inputs), outputs)
    rows = []
    for order in (20, 50, 100, 200):
        operator, inputs, outputs = problem(order)
        build, regressor = timed(lambda operator=operator, inputs=inputs: operator.regressor(inputs))
        solve, found = timed(lambda regressor=regressor, outputs=outputs: fit(regressor, outputs))
        dense = reference = float("nan")
        if order <= 50:
            dense, matrix = timed(regressor.dense)
            matrix -= matrix.mean(axis=0)
            reference, (expected, _) = timed(
                lambda matrix=matrix, outputs=outputs: nnls(matrix, outputs - outputs.mean())
            )
            np.testing.assert_allclose(found.coefficients, expected, atol=1e-5 * expected.max())
        assert found.certificate.kkt_residual < 1e-10
        rows.append((order, build, regressor.nbytes, dense, solve, reference, found.certificate))
    with capsys.disabled():
        print("\nN=3000: regressor (ms, MB), fit (s), dense matrix (ms), scipy nnls on it (s), passive, KKT")
        for order, build, size, dense, solve, reference, certificate in rows:
            line = f"  M={order:3d}  {build * 1e3:5.1f} {size / 1e6:5.1f}  {solve:7.3f}"
            if order <= 50:
                line += f"  {dense * 1e3:5.1f}  {reference:5.2f}  x{reference / solve:4.1f}"
            else:
                line += "      -      -      -"
            print(f"{line}  {certificate.passive:4d}  {certificate.kkt_residual:.0e}")
