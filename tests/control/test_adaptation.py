"""Adaptation sample by sample: against its definition, and on a plant that drifts."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.control.adaptation import DensityAdapter
from bench.models import MemoryCurve, Preisach, PreisachInverse, QuadraticTerm, uniform_levels


def plant(order=20, seed=0, term=None, bias=0.3):
    rng = np.random.default_rng(seed)
    levels = uniform_levels(0.0, 1.0, order)
    middle = 0.5 * (levels[1:] + levels[:-1])
    i, j = np.tril_indices(order)
    density = np.exp(-8.0 * ((middle[i] - 0.6) ** 2 + (middle[j] - 0.4) ** 2)) * rng.uniform(0.5, 1.5, i.size)
    density[rng.random(i.size) < 0.3] = 0.0
    return Preisach(levels, density / (density @ Preisach(levels, density).cell_areas()), bias, term, (-0.1, 1.2))


def by_definition(model, state, before, value, output, step, bias_step, regularisation):
    """One update in plain numpy, from the dense regressor."""
    cells = model.density.size
    rows = model.regressor([state.input, value], state).dense()
    areas = model.cell_areas()
    on = (rows[1] - rows[0])[:cells] / areas
    predicted = (rows[1] - rows[0]) @ model.coefficients
    masses = model.density * areas
    error = output - before - predicted
    if on @ on > 0.0:
        masses = np.maximum(0.0, masses + step * on * error / (on @ on + regularisation))
    coefficients = model.coefficients.copy()
    coefficients[:cells] = masses / areas
    adapted = model.with_coefficients(coefficients, model.bias)
    left = output - adapted.value(state.step(value))
    return adapted.with_coefficients(coefficients, model.bias + bias_step * left), error


@pytest.mark.slow
@given(st.integers(0, 1000), st.booleans(), st.sampled_from([1e-4, 0.05]))
def test_equals_the_definition(seed, uneven, noise):
    rng = np.random.default_rng(seed)
    model = plant(6, seed, QuadraticTerm(0.3, -0.1) if seed % 2 else None)
    if uneven:
        levels = np.append(0.0, np.cumsum(rng.uniform(0.5, 2.0, 6)))
        levels /= levels[-1]
        model = Preisach(levels, model.density, 0.1, model.reversible, (-0.1, 1.2))
    start = MemoryCurve.from_negative_saturation(-0.1).advance(rng.uniform(-0.1, 1.2, 6))
    adapter = DensityAdapter(model, start, step=0.7, bias_step=0.2, noise=noise, uncertainty=0.5)
    masses = model.density * model.cell_areas()
    regularisation = 2.0 * noise**2 / (0.25 * np.mean(masses**2))
    expected, state, before = model, start, math.nan
    for value in rng.uniform(-0.1, 1.2, 12):
        output = rng.normal()
        adapter = adapter.update(value, output)
        if math.isnan(before):
            left = output - expected.value(state.step(value))
            expected = expected.with_coefficients(expected.coefficients, expected.bias + 0.2 * left)
            assert math.isnan(adapter.error)
        else:
            expected, error = by_definition(expected, state, before, value, output, 0.7, 0.2, regularisation)
            assert adapter.error == pytest.approx(error, abs=1e-10)
        state, before = state.step(value), output
        np.testing.assert_allclose(adapter.model.density, expected.density, atol=1e-9)
        assert adapter.model.bias == pytest.approx(expected.bias, abs=1e-10)
        assert adapter.state == state
        # The tables are those that the density makes.
        fresh = expected.lattice
        np.testing.assert_allclose(adapter.model.lattice.table, fresh.table, atol=1e-9)
        np.testing.assert_allclose(adapter.model.lattice.below, fresh.below, atol=1e-9)
        assert adapter.model.lattice.offset == pytest.approx(fresh.offset, abs=1e-9)
        assert adapter.model.value(state) == pytest.approx(expected.value(state), abs=1e-9)
        target = rng.normal()
        found, wanted = adapter.inverse.invert(state, target), PreisachInverse(expected).invert(state, target)
        assert found.outputs == pytest.approx(wanted.outputs, abs=1e-8)
        assert found.reach == wanted.reach


def test_nothing_is_changed_in_place():
    model = plant()
    density = model.density.copy()
    first = DensityAdapter(model)
    second = first.update(0.5, 0.1).update(0.8, 5.0)
    np.testing.assert_array_equal(model.density, density)
    assert first.model is model
    assert second.model.bias != model.bias
    assert (second.model.density != density).any()
    assert not second.model.density.flags.writeable
    copy = Preisach.from_json(second.model.to_json())
    assert copy.evaluate([0.3, 0.7]) == pytest.approx(second.model.evaluate([0.3, 0.7]), abs=1e-12)


def test_samples_without_output_move_the_memory_only():
    adapter = DensityAdapter(plant()).update(0.5, 0.2)
    moved = adapter.update(0.9, None)
    assert moved.model is adapter.model
    assert moved.state == adapter.state.step(0.9)
    assert math.isnan(moved.update(0.7, 0.4).error)


def track(adapter, truth, references, drift, noise, seed, adapting=True):
    """Open loop through the inverse; the plant's gain drifts. Returns the tracking error and the adapter."""
    rng = np.random.default_rng(seed)
    actual, errors = truth.initial_state(), np.empty(references.size)
    model_state, inverse = adapter.state, adapter.inverse
    for n, target in enumerate(references):
        found = inverse.invert(model_state, target)
        for value in found.setpoints:
            actual = actual.step(value)
            output = drift[n] * truth.value(actual)
            if adapting:
                adapter = adapter.update(value, output + noise * rng.normal())
                model_state, inverse = adapter.state, adapter.inverse
            else:
                model_state = model_state.step(value)
        errors[n] = output - target
    return errors, adapter


def reference(count=4000):
    t = np.arange(count)
    return 0.3 + 0.6 * np.sin(2 * np.pi * t / 200) * (0.7 + 0.3 * np.sin(2 * np.pi * t / 1370))


@cases("seed", range(2))
@cases(("noise", "ratio"), [(0.0, 0.15), (0.002, 0.2)])
def test_adaptation_follows_a_drifting_gain(seed, noise, ratio):
    truth, targets = plant(seed=seed), reference()
    drift = np.linspace(1.0, 1.05, targets.size)
    fixed, _ = track(DensityAdapter(truth), truth, targets, drift, noise, seed, adapting=False)
    adapter = DensityAdapter(truth, noise=noise or None)
    adapted, after = track(adapter, truth, targets, drift, noise, seed)
    half = targets.size // 2
    assert np.sqrt(np.mean(adapted[half:] ** 2)) < ratio * np.sqrt(np.mean(fixed[half:] ** 2))
    # What was learnt is the plant, not the last samples only.
    fresh = np.random.default_rng(9).uniform(0.0, 1.0, 300)
    now = 1.05 * truth.evaluate(fresh)
    assert np.std(after.model.evaluate(fresh) - now) < 0.7 * np.std(truth.evaluate(fresh) - now)


def test_density_stays_bounded_under_noise():
    truth = plant()
    # Half a percent of the output's span in each reading.
    targets = np.tile(reference(), 3)
    errors, after = track(DensityAdapter(truth, noise=0.01), truth, targets, np.ones(targets.size), 0.01, 1)
    masses = after.model.density * after.model.cell_areas()
    assert (after.model.density >= 0.0).all()
    assert masses.sum() == pytest.approx(1.0, abs=0.05)
    assert np.sqrt(np.mean(errors**2)) < 0.01
    fresh = np.random.default_rng(2).uniform(0.0, 1.0, 500)
    assert np.std(after.model.evaluate(fresh) - truth.evaluate(fresh)) < 0.03


@cases(
    ("make", "message"),
    [
        (lambda: DensityAdapter(Preisach([0.0, 1.0], [-1.0])), "model: expected a density >= 0"),
        (lambda: DensityAdapter(plant(), step=2.0), "step: expected 0 <= step < 2"),
        (lambda: DensityAdapter(plant(), bias_step=1.5), "bias_step: expected"),
        (lambda: DensityAdapter(plant(), noise=0.0), "noise: expected a positive"),
        (lambda: DensityAdapter(plant(), uncertainty=0.0), "uncertainty: expected"),
        (lambda: DensityAdapter(plant()).update(math.nan, 0.0), "value: expected a finite"),
        (lambda: DensityAdapter(plant()).update(0.5, math.nan), "output: expected a finite"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
