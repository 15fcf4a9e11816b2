"""The Preisach operator against explicit relays, its own regressor and its laws."""

import math
import subprocess
import sys
from itertools import product

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.models import (
    MemoryCurve,
    PolynomialTerm,
    Preisach,
    QuadraticTerm,
    ThermalExpansion,
    operator_from_json,
    uniform_levels,
)

LOW, HIGH = 30.0, 70.0
TERMS = {
    "none": None,
    "linear": QuadraticTerm(1.5, origin=50.0),
    "quadratic": QuadraticTerm(1.5, -0.2, 40.0),
    "polynomial": PolynomialTerm((3.0, -1.0, 0.5), 21.0, 84.0, 12),
    "thermal": ThermalExpansion(2.8, 4.3, 30.0, 70.0, 20.0),
}


def make(order=10, seed=0, term="none", signed=True, uniform=True, zeros=0.0):
    rng = np.random.default_rng(seed)
    levels = uniform_levels(LOW, HIGH, order)
    if not uniform:
        levels[1:-1] = np.sort(rng.uniform(LOW, HIGH, order - 1))
    density = rng.normal(size=order * (order + 1) // 2)
    if not signed:
        density = np.abs(density)
    density[rng.random(density.size) < zeros] = 0.0
    return Preisach(levels, density, 3.0, TERMS[term], (21.0, 84.0), "°C", "1/m")


def relays(operator, inputs, side):
    """Explicit relays on a side x side grid of the plane, weight = density x area."""
    h = (HIGH - LOW) / side
    grid = LOW + (np.arange(side) + 0.5) * h
    beta, alpha = (x[np.tril_indices(side)] for x in np.meshgrid(grid, grid))
    i, j = (np.searchsorted(operator.levels, x, side="right") - 1 for x in (alpha, beta))
    weight = operator.density[i * (i + 1) // 2 + j] * h * h
    weight[alpha == beta] /= 2
    on = np.full(alpha.size, -1.0)
    outputs = []
    for value in inputs:
        on[alpha <= value] = 1.0
        on[beta > value] = -1.0
        outputs.append(operator.bias + weight @ on)
    outputs = np.array(outputs)
    if operator.reversible is not None:
        outputs += operator.reversible.columns(inputs) @ operator.reversible.coefficients
    return outputs


histories = st.lists(st.floats(22.0, 83.0), min_size=1, max_size=25)
seeds = st.integers(0, 50)


@cases("term", TERMS)
def test_equals_320000_relays(term):
    operator = make(term=term)
    rng = np.random.default_rng(1)
    # Inputs half way between the relays' thresholds: the sum over relays then errs only on the diagonal.
    inputs = LOW + np.round(rng.uniform(-0.2, 1.2, 60) * 800) * (HIGH - LOW) / 800
    exact = operator.evaluate(inputs)
    explicit = relays(operator, inputs, 800)
    assert np.abs(exact - explicit).max() < 2e-3 * np.ptp(exact)


@given(histories, seeds, st.sampled_from(list(TERMS)), st.booleans())
def test_regressor_step_and_sequence_agree(history, seed, term, uniform):
    operator = make(seed=seed, term=term, uniform=uniform)
    outputs = operator.evaluate(history)
    regressor = operator.regressor(history)
    dense = regressor.dense()
    np.testing.assert_allclose(dense @ operator.coefficients + operator.bias, outputs, atol=1e-9)
    np.testing.assert_allclose(regressor.product(operator.coefficients), dense @ operator.coefficients, atol=1e-9)
    state = operator.initial_state()
    for value, output in zip(history, outputs, strict=True):
        state, y = operator.step(state, value)
        assert y == pytest.approx(output, abs=1e-9)
    assert state == operator.initial_state().advance(history)


@given(histories, st.floats(0.0, 1.0), st.floats(0.0, 1.0), seeds)
def test_wiping_out(history, a, b, seed):
    operator = make(seed=seed)
    state = operator.initial_state().advance([*history, 25.0, 65.0])
    inner = [65.0 - 40.0 * a, 25.0 + 40.0 * b * (1 - a)]
    inner = [min(inner), max(inner), 25.0]
    direct = operator.evaluate([25.0, 75.0], state)
    detour = operator.evaluate([*inner, 75.0], state)
    assert direct[-1] == pytest.approx(detour[-1], abs=1e-9)
    assert direct[0] == pytest.approx(detour[2], abs=1e-9)


@given(histories, histories, st.floats(30.0, 50.0), st.floats(50.0, 70.0), seeds)
def test_congruency_of_minor_loops(first, second, low, high, seed):
    operator = make(seed=seed)
    loop = [*np.linspace(low, high, 5), *np.linspace(high, low, 5)]
    shapes = []
    for history in (first, second):
        state = operator.initial_state().advance([*history, low, high, low])
        outputs = operator.evaluate(loop, state)
        shapes.append(outputs - outputs[0])
    np.testing.assert_allclose(shapes[0], shapes[1], atol=1e-8)


@given(histories, st.lists(st.floats(22.0, 83.0), min_size=2, max_size=10), seeds)
def test_nonnegative_density_is_monotone(history, then, seed):
    operator = make(seed=seed, signed=False, zeros=0.5)
    state = operator.initial_state().advance(history)
    rising = operator.evaluate(sorted(v for v in [*then, 84.0] if v >= state.input), state)
    falling = operator.evaluate(sorted((v for v in [*then, 21.0] if v <= state.input), reverse=True), state)
    assert (np.diff(rising) >= -1e-9).all()
    assert (np.diff(falling) <= 1e-9).all()


@cases("term", TERMS)
def test_output_rises_only_where_the_reversible_part_does(term):
    operator, flat = make(term=term, signed=False), make(term=term, signed=False, zeros=1.0)
    inputs = np.linspace(21.0, 84.0, 20_001)
    slopes = np.diff(flat.evaluate(inputs)) / np.diff(inputs)
    least, greatest = operator.reversible_slopes(np.array([21.0, 50.0, 84.0]))
    for part, low, high in zip(np.split(slopes, [29 * 20_000 // 63]), least, greatest, strict=True):
        assert (low, high) == pytest.approx((part.min(), part.max()), rel=1e-2, abs=1e-9)
    assert operator.rises() == (slopes.min() >= -1e-9)
    assert not make(term="thermal").rises()


def test_saturates_beyond_the_plane_while_the_reversible_part_goes_on():
    operator = make(term="thermal", signed=False)
    y = operator.evaluate([21.0, 25.0, 30.0, 84.0, 77.0, 70.0])
    assert np.diff(y[:3]) == pytest.approx([-2.8 * 4, -2.8 * 5])
    assert np.diff(y[3:]) == pytest.approx([4.3 * 7, 4.3 * 7])


def test_output_equals_the_paper_at_saturation():
    # c0 = 1026.7, k0 = 2.8, k1 = 4.3 and an output of -20 at 30 °C imply about 1830 at 70 °C.
    levels = uniform_levels(30.0, 70.0, 20)
    density = np.full(210, 1.0)
    operator = Preisach(levels, density, 1026.7, ThermalExpansion(2.8, 4.3, 30.0, 70.0, 20.0), (21.0, 84.0))
    total = float(operator.density @ operator.cell_areas())
    operator = operator.with_coefficients([*(density * 1018.7 / total), 2.8, 4.3], 1026.7)
    assert operator.evaluate([30.0, 70.0]) == pytest.approx([-20.0, 1830.4], abs=1e-9)


@cases("signed", [True, False])
@cases("term", ["none", "quadratic", "thermal"])
@cases("order", [3, 7])
def test_output_range_bounds_and_is_reached(order, term, signed):
    operator = make(order, seed=order, term=term, signed=signed, uniform=order == 3)
    low, high = operator.output_range()
    rng = np.random.default_rng(2)
    least, greatest = math.inf, -math.inf
    branch = np.linspace(21.0, 84.0, 4001)
    parts = [branch, branch[::-1]]
    for _ in range(1500):
        # Corners on levels: that is where the extreme memory curves have theirs.
        extrema = rng.choice(operator.levels, 6)
        end = rng.uniform(21.0, 84.0)
        parts.append(np.concatenate([[rng.choice([21.0, 84.0])], extrema, np.linspace(extrema[-1], end, 15)]))
    outputs = operator.evaluate(np.concatenate(parts))
    least, greatest = outputs.min(), outputs.max()
    span = high - low
    assert low - 1e-9 * span <= least <= low + (0.02 if signed else 1e-6) * span
    assert high - (0.02 if signed else 1e-6) * span <= greatest <= high + 1e-9 * span


@cases("seed", range(8))
def test_output_range_of_a_nonnegative_density_is_that_of_the_major_branches(seed):
    operator = make(seed=seed, term="thermal", signed=False, uniform=bool(seed % 2))
    branch = np.linspace(21.0, 84.0, 200_001)
    outputs = operator.evaluate(np.concatenate([branch, branch[::-1]]))
    span = outputs.max() - outputs.min()
    assert operator.output_range() == pytest.approx((outputs.min(), outputs.max()), abs=1e-6 * span)


def test_output_range_of_a_signed_density_by_exhaustion():
    operator = make(4, seed=11, term="none")
    low, high = operator.output_range()
    best = [math.inf, -math.inf]
    # Every memory curve with corners on levels, then every end point between two levels.
    for extrema in product(operator.levels, repeat=4):
        state = operator.initial_state().advance(extrema)
        for end in operator.levels:
            y = operator.evaluate(np.linspace(extrema[-1], end, 9)[1:], state)
            best = [min(best[0], y.min()), max(best[1], y.max())]
    assert best[0] == pytest.approx(low, abs=0.01 * (high - low))
    assert best[1] == pytest.approx(high, abs=0.01 * (high - low))
    assert best[0] >= low - 1e-9
    assert best[1] <= high + 1e-9


def test_immutable():
    operator = make()
    with pytest.raises(AttributeError):
        operator.bias = 0.0
    with pytest.raises(ValueError, match="read-only"):
        operator.density[0] = 1.0


def test_density_matrix_and_areas():
    operator = make(4)
    matrix = operator.density_matrix()
    assert matrix[2, 1] == operator.density[2 * 3 // 2 + 1]
    assert np.isnan(matrix[1, 2])
    assert operator.cell_areas().sum() == pytest.approx(0.5 * 40.0**2)


@cases(
    ("make_it", "message"),
    [
        (lambda: Preisach([0, 1, 1], np.zeros(3)), "levels: expected strictly increasing"),
        (lambda: Preisach([0], np.zeros(0)), "levels: expected at least 2"),
        (lambda: Preisach([0, 1, math.nan], np.zeros(3)), "levels: expected finite"),
        (lambda: Preisach([0, 1, 2], np.zeros(4)), "density: expected 3 values"),
        (lambda: Preisach([0, 1, 2], [1, math.inf, 0]), "density: expected finite"),
        (lambda: Preisach([0, 1], [1.0], math.nan), "bias"),
        (lambda: Preisach([0, 1], [1.0], input_range=(0.5, 2.0)), "input_range: expected it to contain"),
        (lambda: make().evaluate([]), "inputs: expected at least one"),
        (lambda: make().evaluate([[1.0]]), "inputs: expected one dimension"),
        (lambda: make().evaluate(["x"]), "inputs: expected a sequence of numbers"),
        (lambda: make().evaluate([1.0, math.nan]), "inputs: expected finite numbers, got nan at index 1"),
        (lambda: make().with_coefficients([1.0], 0.0), "coefficients: expected 55"),
        (lambda: make().regressor([1.0]).product([1.0]), "coefficients: expected 55"),
        (lambda: uniform_levels(1.0, 0.0, 3), "low, high"),
        (lambda: uniform_levels(0.0, 1.0, 0), "intervals"),
        (lambda: operator_from_json({"type": "spline"}), "expected a model of the kind .*got 'spline'"),
        (lambda: operator_from_json({"type": "preisach"}), "levels"),
        (lambda: ThermalExpansion(0.0, 0.0, 70.0, 30.0, 20.0), "low"),
        (lambda: QuadraticTerm(math.nan), "linear"),
        (lambda: Preisach.from_json({**make().to_json(), "reversible": {"type": "x"}}), "reversible"),
        (lambda: Preisach.from_json({**make().to_json(), "reversible": {"type": "quadratic", "b": 1}}), "reversible"),
    ],
)
def test_wrong_input_is_named(make_it, message):
    with pytest.raises(ValueError, match=message):
        make_it()


def test_import_stays_light():
    code = (
        "import sys, bench.models, bench.identification; "
        "print(sorted({'numba', 'scipy', 'threadpoolctl'} & sys.modules.keys()))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_one_cell():
    operator = Preisach([0.0, 2.0], [0.5])
    # Rising to u covers a triangle u²/2 of the cell's area 2.
    assert operator.evaluate([0.0, 1.0, 2.0]) == pytest.approx([-1.0, -0.5, 1.0])
    assert operator.evaluate([1.0], MemoryCurve.from_positive_saturation(2.0)) == pytest.approx([0.5])
