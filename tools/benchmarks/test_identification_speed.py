"""Regressor and constrained fit beside what a user would otherwise take. Prints, asserts no time."""

import inspect
import statistics
import subprocess
import sys
import time

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from bench.identification import fit
from bench.models import Preisach, uniform_levels

pytestmark = pytest.mark.benchmark


def timed(function, repeats=5):
    """Return the median wall time of several runs, s, and the last result."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
    return statistics.median(times), result


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


def by_projected_quasi_newton(matrix, outputs):
    """L-BFGS-B on the dense matrix, columns scaled."""
    from scipy.optimize import minimize

    norms = np.linalg.norm(matrix, axis=0)
    scaled = matrix / norms

    def cost(x):
        residual = scaled @ x - outputs
        return 0.5 * residual @ residual, scaled.T @ residual

    options = {"maxiter": 20_000, "maxfun": 20_000, "ftol": 1e-15, "gtol": 1e-9}
    start = np.zeros(norms.size)
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(0, None)] * norms.size, options=options)
    return found.x / norms


def test_fit(capsys):
    from scipy.optimize import nnls  # No part of the memory of a large problem.

    operator, inputs, outputs = problem(5)
    fit(operator.regressor(inputs), outputs)
    fit(operator.regressor(inputs), outputs, smoothing=1e-3)
    rows = []
    with threadpool_limits(limits=1, user_api="blas"):
        for order in (20, 50, 100, 200):
            operator, inputs, outputs = problem(order)
            build, regressor = timed(lambda operator=operator, inputs=inputs: operator.regressor(inputs))
            solve, found = timed(lambda regressor=regressor, outputs=outputs: fit(regressor, outputs))
            smooth = dense = peer = gradient = float("nan")
            if order <= 100:
                smooth, _ = timed(lambda r=regressor, y=outputs: fit(r, y, smoothing=1e-3), 3)
                dense, matrix = timed(regressor.dense, 3)
                matrix = matrix - matrix.mean(axis=0)
                target = outputs - outputs.mean()
                peer, (expected, norm) = timed(lambda m=matrix, y=target: nnls(m, y), 3 if order < 100 else 1)
                reached = np.linalg.norm(outputs - found.bias - regressor.product(found.coefficients))
                assert reached <= norm * (1 + 1e-9)
                if order <= 50:
                    np.testing.assert_allclose(found.coefficients, expected, atol=1e-5 * expected.max())
                    gradient, _ = timed(lambda m=matrix, y=target: by_projected_quasi_newton(m, y), 1)
            assert found.certificate.kkt_residual < 1e-10
            rows.append((order, build, regressor.nbytes, dense, solve, smooth, peer, gradient, found.certificate))
    with capsys.disabled():
        print("\nN=3000, one BLAS thread, medians: regressor (ms, MB), dense matrix (ms), fit (s), smooth fit (s),")
        print("  scipy nnls on the dense matrix (s, times as long), L-BFGS-B on it (s, times as long), passive, KKT")
        for order, build, size, dense, solve, smooth, peer, gradient, certificate in rows:
            print(
                f"  M={order:3d}  {build * 1e3:5.1f} {size / 1e6:5.1f}  {dense * 1e3:6.1f}  {solve:6.3f}"
                f"  {smooth:6.3f}  {peer:6.2f} x{peer / solve:5.1f}  {gradient:6.2f} x{gradient / solve:6.1f}"
                f"  {certificate.passive:4d}  {certificate.kkt_residual:.0e}"
            )


# Nothing else is loaded there: the test framework would count in the memory. On Linux `ru_maxrss` begins at what the
# process that started this one had; the high-water mark of its own address space does not.
LONG = """
import resource, sys, time
import numpy as np
from bench.models import Preisach, uniform_levels
from bench.identification import fit
{problem}
operator, inputs, outputs = problem(5)
fit(operator.regressor(inputs), outputs)
operator, inputs, outputs = problem({order}, {samples}, {cycles})
start = time.process_time()
found = fit(operator.regressor(inputs), outputs, smoothing={smoothing})
seconds = time.process_time() - start
if sys.platform == "linux":
    peak = next(int(line.split()[1]) / 1e3 for line in open("/proc/self/status") if line.startswith("VmHWM"))
else:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
print(f"{{seconds:.2f}} s of CPU time, {{peak:.0f}} MB peak, {{found.certificate.passive}} passive, "
      f"KKT {{found.certificate.kkt_residual:.0e}}")
"""


@pytest.mark.parametrize(
    ("order", "samples", "cycles", "smoothing"),
    [(200, 30_000, 300, 0.0), (100, 1_000_000, 30, 0.0), (200, 3000, 30, 1e-3)],
)
def test_large_problem(capsys, order, samples, cycles, smoothing):
    source = inspect.getsource(problem)
    script = LONG.format(problem=source, order=order, samples=samples, cycles=cycles, smoothing=smoothing)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    with capsys.disabled():
        print(
            f"\nN={samples}, M={order}, smoothing {smoothing:g}, regressor and fit in a process of its own: "
            f"{run.stdout.strip()}"
        )
