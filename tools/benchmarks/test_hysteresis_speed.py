"""Forward evaluation and exact inverse beside what one would otherwise take. Prints, asserts no time."""

import time

import numpy as np
import pytest
from scipy.optimize import brentq

from bench.identification import damped_oscillation
from bench.models import PrandtlIshlinskii, Preisach, PreisachInverse, ThermalExpansion, uniform_levels

pytestmark = pytest.mark.benchmark


def median_of(function, repeats=9):
    """Return the median wall time, s, after one call to compile and warm up."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def film(order):
    levels = uniform_levels(30.0, 70.0, order)
    middle = 0.5 * (levels[1:] + levels[:-1])
    i, j = np.tril_indices(order)
    density = np.exp(-0.5 * ((middle[i] - 62.0) / 3.0) ** 2 - 0.5 * ((middle[j] - 56.0) / 4.0) ** 2)
    density *= 1018.7 / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, 1026.7, ThermalExpansion(2.8, 4.3, 30.0, 70.0, 20.0), (21.0, 84.0))


def by_relays(operator, inputs, per_cell):
    """A numpy sum over point relays, per_cell² in each cell."""
    side = operator.order * per_cell
    h = 40.0 / side
    grid = 30.0 + (np.arange(side) + 0.5) * h
    beta, alpha = (x[np.tril_indices(side)] for x in np.meshgrid(grid, grid))
    i, j = (np.searchsorted(operator.levels, x, side="right") - 1 for x in (alpha, beta))
    weight = operator.density[i * (i + 1) // 2 + j] * h * h
    weight[alpha == beta] /= 2
    on = np.full(alpha.size, -1.0)
    outputs = np.empty(inputs.size)
    for n, value in enumerate(inputs):
        on[alpha <= value] = 1.0
        on[beta > value] = -1.0
        outputs[n] = weight @ on
    outputs += operator.bias
    return outputs + operator.reversible.columns(inputs) @ operator.reversible.coefficients


def by_dense_areas(operator, inputs):
    """A dense regressor row for each sample."""
    return operator.regressor(inputs).dense() @ operator.coefficients + operator.bias


def test_forward(capsys):
    inputs = damped_oscillation(21.0, 84.0, 54.0, 36, 0.35)
    many = np.tile(inputs, 30)
    rows = []
    for order in (20, 50, 100, 200):
        operator = film(order)
        ours = median_of(lambda operator=operator: operator.evaluate(many)) / many.size
        state = operator.initial_state()

        def steps(operator=operator, state=state):
            for value in inputs[:1000]:
                state, _ = operator.step(state, value)

        single = median_of(steps) / 1000
        exact = operator.evaluate(inputs[:300])
        relays = median_of(lambda operator=operator: by_relays(operator, inputs[:300], 4), 1) / 300
        error = np.abs(by_relays(operator, inputs[:300], 4) - exact).max() / np.ptp(exact)
        rows.append((order, ours, single, relays, relays / ours, error))
        np.testing.assert_allclose(by_dense_areas(operator, inputs[:300]), exact, atol=1e-8)
    with capsys.disabled():
        print("\nforward, per sample: sequence, one step, 16 point relays a cell in numpy (their error)")
        for order, ours, single, relays, ratio, error in rows:
            print(
                f"  M={order:3d}  {ours * 1e9:6.1f} ns  {single * 1e6:5.1f} µs  {relays * 1e6:8.1f} µs"
                f"  x{ratio:9.0f}  ({error:.1%})"
            )


def by_bisection(operator, state, target):
    """The first sign change upwards or downwards, by a scan over the lattice and Brent's method."""
    for end in operator.input_range[::-1]:
        inputs = np.linspace(state.input, end, 2 * operator.order)
        error = operator.evaluate(inputs, state) - target
        hit = np.flatnonzero(error[:-1] * error[1:] <= 0.0)
        if hit.size:
            low, high = inputs[hit[0]], inputs[hit[0] + 1]
            return brentq(lambda u: operator.step(state, u)[1] - target, low, high, xtol=1e-12)
    return None


def test_inverse(capsys):
    rows = []
    for order in (20, 50, 100, 200):
        operator = film(order)
        inverse = PreisachInverse(operator)
        least, greatest = operator.output_range()
        t = np.arange(100_000)
        middle, reach = 0.5 * (least + greatest), 0.45 * (greatest - least)
        smooth = middle + reach * np.sin(2 * np.pi * t / 1000) * (1 - 0.5 * t / t.size)
        jumps = np.random.default_rng(0).uniform(least, greatest, 20_000)
        sequence = median_of(lambda inverse=inverse, smooth=smooth: inverse.follow(smooth)) / smooth.size
        random = median_of(lambda inverse=inverse, jumps=jumps: inverse.follow(jumps)) / jumps.size
        start = operator.initial_state().advance([60.0, 55.0])
        state, times, worst = start, [], 0.0
        for target in smooth[:2000]:
            begin = time.perf_counter()
            found = inverse.invert(state, target)
            times.append(time.perf_counter() - begin)
            state = found.state
            worst = max(worst, abs(operator.value(state) - target))
        state, slow = start, []
        for target in smooth[:200]:
            begin = time.perf_counter()
            u = by_bisection(operator, state, target)
            slow.append(time.perf_counter() - begin)
            state = state.step(state.input if u is None else u)
        rows.append((order, sequence, random, np.median(times), np.median(slow), worst))
        assert worst < 1e-9
    with capsys.disabled():
        print("\nexact inverse, per target: smooth sequence, random jumps, one call, scan and Brent, residual")
        for order, sequence, random, single, slow, worst in rows:
            print(
                f"  M={order:3d}  {sequence * 1e9:6.0f} ns  {random * 1e9:6.0f} ns  {single * 1e6:5.1f} µs"
                f"  {slow * 1e6:6.1f} µs  x{slow / single:4.0f} (x{slow / sequence:6.0f})  {worst:.0e}"
            )


def by_play_loop(operator, inputs):
    """Plays in numpy, one sample at a time."""
    plays, outputs = np.zeros(operator.thresholds.size), np.empty(inputs.size)
    for n, value in enumerate(inputs):
        plays = np.maximum(value - operator.thresholds, np.minimum(value + operator.thresholds, plays))
        outputs[n] = operator.weights @ plays
    return outputs + operator.bias


def test_plays(capsys):
    thresholds = 40.0 * np.arange(15) / 15
    operator = PrandtlIshlinskii(thresholds, np.exp(-np.arange(15) / 5.0) / 50.0, input_range=(-40.0, 40.0))
    inputs = 40.0 * np.sin(np.arange(100_000) / 300.0)
    forward = median_of(lambda: operator.evaluate(inputs)) / inputs.size
    outputs, inverse = operator.evaluate(inputs), operator.inverse_operator()
    backward = median_of(lambda: inverse.evaluate(outputs)) / inputs.size
    worst = np.abs(inverse.evaluate(outputs) - inputs).max()
    slow = median_of(lambda: by_play_loop(operator, inputs[:5000]), 3) / 5000
    with capsys.disabled():
        print(
            f"\n15 plays, per sample: forward {forward * 1e9:.0f} ns, inverse {backward * 1e9:.0f} ns"
            f" (error {worst:.0e}), numpy loop {slow * 1e6:.1f} µs x{slow / forward:.0f}"
        )
