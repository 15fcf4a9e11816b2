"""Several models on one sequence."""

import math

import numpy as np
import pytest
from cases import cases

from bench.identification import compare, measure_errors
from bench.models import MemoryCurve, Polynomial, PrandtlIshlinskii, Preisach, uniform_levels


def models():
    rng = np.random.default_rng(0)
    return {
        "hysterons": Preisach(uniform_levels(-1.0, 1.0, 4), rng.random(10), 0.2),
        "plays": PrandtlIshlinskii([0.0, 0.3], [1.0, 0.5], input_range=(-1.0, 1.0)),
        "line": Polynomial([1.5], (-1.0, 1.0)),
    }


def test_raw_and_rezeroed_errors():
    rng = np.random.default_rng(1)
    candidates, inputs = models(), rng.uniform(-1.0, 1.0, 50)
    noise = rng.normal(size=50)
    outputs = candidates["hysterons"].evaluate(inputs) + 3.0 + 0.01 * (noise - noise.mean())
    found = compare(candidates, inputs, outputs)
    assert list(found) == list(candidates)
    best = found["hysterons"]
    assert best.offset == pytest.approx(3.0)
    assert best.raw.average == pytest.approx(3.0, abs=0.01)
    assert best.rezeroed.rms == pytest.approx(0.01 * noise.std())
    for name, model in candidates.items():
        predicted = model.evaluate(inputs)
        np.testing.assert_allclose(found[name].residuals, outputs - predicted)
        assert found[name].raw == measure_errors(outputs, predicted)
        # No other offset does better.
        for shift in (-1e-3, 1e-3):
            other = measure_errors(outputs, predicted + found[name].offset + shift)
            assert other.rms > found[name].rezeroed.rms
        assert found[name].rezeroed.rms ** 2 + found[name].offset ** 2 == pytest.approx(found[name].raw.rms ** 2)


def test_states_and_skipped_samples():
    candidates, inputs = models(), np.array([0.5, -0.2, 0.1, 0.9])
    start = MemoryCurve.from_positive_saturation(1.0)
    outputs = candidates["hysterons"].evaluate(inputs, start)
    outputs[0] = 50.0
    found = compare(candidates, inputs, outputs, states={"hysterons": start}, skip=1)
    assert found["hysterons"].raw.maximum == pytest.approx(0.0, abs=1e-12)
    assert found["hysterons"].residuals[0] > 40.0


@cases(
    ("arguments", "message"),
    [
        (({}, [0.0], [0.0]), "models: expected at least one"),
        ((models(), [0.0, 1.0], [0.0]), "outputs: expected 2"),
        ((models(), [], []), "inputs"),
        ((models(), [0.0], [math.nan]), "outputs: expected finite"),
    ],
)
def test_wrong_comparison_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        compare(*arguments)


@cases(("options", "message"), [({"skip": 2}, "skip"), ({"states": {"spline": None}}, "states: .* got spline")])
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        compare(models(), [0.0, 1.0], [0.0, 1.0], **options)
