"""Recalibration: what moved between two sessions is found, with an uncertainty that holds."""

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st
from other_plants import random_reversals

from bench.identification import Recalibration, parse_kinds, recalibrate
from bench.identification.recalibration import KINDS
from bench.models import (
    DeadZones,
    Polynomial,
    PolynomialTerm,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    ThermalExpansion,
    TwoStage,
    uniform_levels,
)

DENSITY = np.random.default_rng(0).uniform(0.2, 1.0, 55)
PREISACH = Preisach(
    uniform_levels(-1.0, 1.0, 10), DENSITY, 0.3, QuadraticTerm(0.4, 0.1, 0.2), input_range=(-1.5, 1.5)
)
LEVELS = uniform_levels(-1.0, 1.0, 10)
OPERATORS = {
    "preisach": PREISACH,
    "polynomial part": Preisach(LEVELS, DENSITY, 0.1, PolynomialTerm((0.5, 0.1, -0.2), -1.0, 1.0)),
    "nonmonotonic": Preisach(
        uniform_levels(-1.0, 1.0, 10), DENSITY, 0.1, ThermalExpansion(0.2, 0.5, -1.0, 1.0, -1.5)
    ),
    "plays": PrandtlIshlinskii(
        [0.0, 0.3, 0.6], [1.0, 0.5, 0.2], 0.1, origin=0.2, after=DeadZones([0.0], [1.0, 0.7]), input_range=(-1.0, 1.0)
    ),
    "line": Polynomial([1.5, 0.3], (-1.0, 1.0)),
}
TRUE = {"offset": 0.5, "gain": 1.04, "drift": 2e-4, "input-offset": -0.03}


def session(rng, kinds=KINDS, noise=0.0):
    inputs = random_reversals(rng)
    moved = {kind: TRUE[kind] for kind in kinds}
    outputs = Recalibration(moved, {}, 0, 0.0).predict(PREISACH, inputs)
    return inputs, outputs + noise * rng.normal(size=inputs.size)


@cases("kinds", [("offset",), ("gain",), ("input-offset",), ("gain", "drift"), KINDS])
@cases("rows", [None, 400])
def test_what_moved_is_found(kinds, rows):
    inputs, outputs = session(np.random.default_rng(1), kinds)
    found = recalibrate(PREISACH, inputs, outputs, kinds, rows=rows)
    assert list(found.values) == list(kinds)
    for kind in kinds:
        assert found.values[kind] == pytest.approx(TRUE[kind], rel=1e-4)
    assert found.rows == (rows or inputs.size)
    np.testing.assert_allclose(found.predict(PREISACH, inputs), outputs, atol=1e-5)


def test_uncertainties_are_those_of_repeated_sessions():
    kinds = ("offset", "gain", "drift", "input-offset")
    runs = []
    inputs, clean = session(np.random.default_rng(2))
    for seed in range(60):
        noise = 0.05 * np.random.default_rng(seed).normal(size=inputs.size)
        runs.append(recalibrate(PREISACH, inputs, clean + noise, kinds, rows=300))
    for kind in kinds:
        scatter = np.std([run.values[kind] for run in runs], ddof=1)
        assert np.median([run.uncertainties[kind] for run in runs]) == pytest.approx(scatter, rel=0.3)
        assert np.mean([run.values[kind] for run in runs]) == pytest.approx(TRUE[kind], abs=3.0 * scatter / 60**0.5)


def test_correlated_residuals_count_less():
    inputs, clean = session(np.random.default_rng(3), ("offset",))
    rng = np.random.default_rng(4)
    white = 0.05 * rng.normal(size=inputs.size)
    wandering = np.convolve(white, np.ones(20) / 20**0.5, mode="same")
    found = [recalibrate(PREISACH, inputs, clean + noise, ["offset"]) for noise in (white, wandering)]
    assert found[1].uncertainties["offset"] > 3.0 * found[0].uncertainties["offset"]


def test_later_rows_change_nothing_and_skipped_ones_neither():
    inputs, outputs = session(np.random.default_rng(5), noise=0.01)
    first = recalibrate(PREISACH, inputs, outputs, KINDS, rows=300, skip=20)
    outputs[300:] = 9.0
    outputs[:20] = -9.0
    assert recalibrate(PREISACH, inputs, outputs, KINDS, rows=300, skip=20) == first


@cases(("kinds", "rows", "words"), [
    ((), 100, "expected at least one of offset"),
    (("zero",), 100, "expected some of offset, gain, drift, input-offset, got 'zero'"),
    (("gain", "gain"), 100, "gain is given twice"),
    (("gain",), 4, "too few for 1 numbers; at least 5"),
    (("gain",), 10**6, "too few"),
])  # fmt: skip
def test_what_is_refused(kinds, rows, words):
    inputs, outputs = session(np.random.default_rng(6))
    with pytest.raises(ValueError, match=words):
        recalibrate(PREISACH, inputs, outputs, kinds, rows=rows)


def test_rows_that_do_not_tell_offset_and_gain_apart():
    inputs = np.concatenate([np.full(50, 0.3), random_reversals(np.random.default_rng(7))])
    with pytest.raises(ValueError, match="do not tell offset and gain apart"):
        recalibrate(PREISACH, inputs, PREISACH.evaluate(inputs), ["offset", "gain"], rows=50)


def test_an_input_that_moved_too_far():
    inputs = 0.5 * random_reversals(np.random.default_rng(8))
    with pytest.raises(ValueError, match="10 % of the operating range"):
        recalibrate(PREISACH, inputs, PREISACH.evaluate(inputs + 0.7), ["input-offset"])


@pytest.mark.parametrize("name", OPERATORS)
@given(offset=st.floats(-0.3, 0.3), seed=st.integers(0, 99))
def test_a_shifted_operator_is_the_operator_at_shifted_inputs(name, offset, seed):
    operator = OPERATORS[name]
    inputs = np.random.default_rng(seed).uniform(-1.0, 1.0, 30)
    moved = operator.shifted(offset)
    expected = operator.evaluate(inputs + offset, operator.saturated_state(-1))
    np.testing.assert_allclose(moved.evaluate(inputs, moved.saturated_state(-1)), expected, atol=1e-9)
    low, high = operator.input_range
    assert moved.input_range == pytest.approx((low - offset, high - offset))


def test_a_corrected_model_gives_what_the_session_does():
    inputs, outputs = session(np.random.default_rng(9), ("offset", "gain", "input-offset"))
    corrected = recalibrate(PREISACH, inputs, outputs, ("offset", "gain", "input-offset")).corrected(PREISACH)
    np.testing.assert_allclose(corrected.evaluate(inputs), outputs, atol=1e-5)
    targets = np.linspace(*corrected.output_range(), 9)[1:-1]
    found = corrected.inverse().follow(targets, None)
    np.testing.assert_allclose(found.outputs, targets)


def test_a_model_that_cannot_be_corrected():
    with pytest.raises(ValueError, match="gain: expected a positive number, got -1"):
        Recalibration({"gain": -1.0}, {}, 9, 0.0).corrected(PREISACH)
    assert not hasattr(TwoStage, "shifted")


@cases("text", ["", "offset,,x", "gain,gain", "zero"])
def test_kinds_that_are_not_understood(text):
    with pytest.raises(ValueError, match="expected some of offset, gain, drift, input-offset, each once"):
        parse_kinds(text)
    assert parse_kinds("drift, offset") == ("offset", "drift")
