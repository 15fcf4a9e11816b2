"""Designed sequences: what they sweep, in how few set-points, and what that is worth on a plant."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.identification import (
    assess,
    covering_sequence,
    damped_oscillation,
    first_order_reversals,
    fit,
    identify,
    measure_errors,
    random_validation,
)
from bench.models import MemoryCurve, Preisach, QuadraticTerm, ThermalExpansion, uniform_levels
from sim_devices.plants.vo2 import VO2Cantilever, VO2Parameters


def plane(levels, term=None, span=None):
    order = len(levels) - 1
    return Preisach(levels, np.zeros(order * (order + 1) // 2), reversible=term, input_range=span)


def uneven(seed, order):
    return np.cumsum(np.random.default_rng(seed).uniform(0.5, 2.0, order + 1))


@given(st.integers(0, 1000), st.integers(1, 12))
def test_covering_sequence_determines_every_cell_with_no_set_point_to_spare(seed, order):
    operator = plane(uneven(seed, order))
    inputs = covering_sequence(operator.levels)
    cells = operator.density.size
    # A bias and K densities cannot be had from fewer readings.
    assert inputs.size == cells + 1
    found = assess(operator, inputs, dwell=1.0)
    assert (found.rank, found.covered, found.cells) == (cells, cells, cells)
    assert found.condition < 2.0 * order**2 + 1.0
    rows = operator.regressor(inputs).dense()
    assert np.linalg.matrix_rank(np.column_stack([rows, np.ones(cells + 1)])) == cells + 1
    # Whatever the specimen did before.
    np.testing.assert_allclose(
        rows, operator.regressor(inputs, MemoryCurve.from_positive_saturation(100.0)).dense(), atol=1e-12
    )


@given(st.integers(0, 1000), st.integers(1, 12), st.integers(1, 3))
def test_first_order_reversals_measure_every_pair_of_levels(seed, order, per_cell):
    operator = plane(uneven(seed, order))
    inputs = first_order_reversals(operator.levels, per_cell=per_cell)
    cells = operator.density.size
    assert inputs.size == per_cell * cells + order + 1
    assert assess(operator, inputs, dwell=1.0).rank == cells
    assert inputs[0] == inputs[-1] == operator.levels[-1]


@cases("design", [covering_sequence, first_order_reversals])
@cases("term", [QuadraticTerm(0.0), QuadraticTerm(0.0, 0.0), ThermalExpansion(0.0, 0.0, 30.0, 70.0, 20.0)])
def test_reversible_part_is_determined_too(design, term):
    operator = plane(uniform_levels(30.0, 70.0, 10), term, (21.0, 84.0))
    inputs = design(operator.levels, (21.0, 84.0), per_cell=2)
    found = assess(operator, inputs, dwell=8.0)
    assert found.rank == found.coefficients == 55 + term.coefficients.size
    assert inputs.min() == 21.0
    assert inputs.max() == 84.0
    rng = np.random.default_rng(0)
    truth = rng.random(found.coefficients)
    fitted = fit(operator.regressor(inputs), operator.with_coefficients(truth, 3.0).evaluate(inputs))
    np.testing.assert_allclose(fitted.coefficients, truth, atol=1e-6)


def test_designs_beside_the_damped_oscillation():
    operator = plane(uniform_levels(30.0, 70.0, 20), ThermalExpansion(0.0, 0.0, 30.0, 70.0, 20.0), (21.0, 84.0))
    sequences = [
        covering_sequence(operator.levels, (21.0, 84.0)),
        first_order_reversals(operator.levels, (21.0, 84.0)),
        damped_oscillation(21.0, 84.0, 54.0, 36, 0.35),
    ]
    found = [assess(operator, inputs, dwell=8.0) for inputs in sequences]
    assert all(entry.rank == 212 and entry.covered == 210 for entry in found)
    assert [entry.setpoints for entry in found] == [213, 234, 3439]
    assert found[0].time < found[1].time < 0.1 * found[2].time
    assert found[0].condition < found[1].condition < found[2].condition


def test_poor_sequences_are_told():
    operator = plane(uniform_levels(-1.0, 1.0, 4))
    found = assess(operator, [-1.0, -0.5, 0.0, -0.5, -1.0], dwell=2.0)
    assert (found.covered, found.rank) == (3, 3)
    assert found.time == 5 * 2.0
    still = assess(operator, [0.5, 0.5], dwell=2.0)
    assert (still.rank, still.covered) == (0, 0)
    assert math.isinf(still.condition)


def measure(setpoints, seed):
    """Readings of the film, each taken 8 s after its set-point."""
    rng = np.random.default_rng(seed)
    plant = VO2Cantilever(VO2Parameters(), rng, initial_temperature=21.0)
    readings = np.empty(setpoints.size)
    for n, target in enumerate(setpoints):
        plant.regulate(target)
        plant.advance(8.0)
        readings[n] = plant.curvature
    return readings + 0.37 * rng.standard_normal(setpoints.size)


@cases("seed", range(3))
def test_design_reaches_the_oscillation_in_half_the_time_on_the_film(seed):
    span = (21.0, 84.0)
    oscillation = damped_oscillation(21.0, 84.0, 54.0, 36, 0.35)
    # Loops 1 K apart, a reading every 0.5 K.
    design = covering_sequence(uniform_levels(30.0, 70.0, 40), span, per_cell=2)
    assert design.size <= 0.5 * oscillation.size
    models = [
        identify(
            "preisach-nonmonotonic", inputs, measure(inputs, seed), input_range=span, plane=(30, 70), reference=20
        ).model
        for inputs in (oscillation, design)
    ]
    errors = []
    for session in range(3):
        fresh = random_validation(
            np.random.default_rng(100 + session), 600, operating=(21.0, 84.0), transition=(40.0, 72.0), step=1.2
        )
        measured = measure(fresh, 500 + session)
        errors.append([measure_errors(measured, model.evaluate(fresh)).rms for model in models])
    usual, designed = np.mean(errors, axis=0)
    assert designed <= usual < 10.0


@cases(
    ("make", "message"),
    [
        (lambda: covering_sequence([1.0, 0.0]), "levels: expected strictly"),
        (lambda: covering_sequence([0.0, 1.0], (0.5, 2.0)), "input_range: expected it to contain"),
        (lambda: covering_sequence([0.0, 1.0], per_cell=0), "per_cell"),
        (lambda: first_order_reversals([0.0]), "levels: expected at least 2"),
        (lambda: assess(plane([0.0, 1.0]), [math.nan], dwell=1.0), "inputs"),
    ],
)
def test_wrong_design_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
