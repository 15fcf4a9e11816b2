"""Identification of a specimen whose memory before the first sample is unknown."""

import numpy as np
import pytest
from cases import cases

from bench.identification import identify, measure_errors, ramps
from bench.models import MemoryCurve, PrandtlIshlinskii, Preisach, QuadraticTerm, uniform_levels


def specimen(seed=0, order=8):
    rng = np.random.default_rng(seed)
    levels = uniform_levels(-1.0, 1.0, order)
    density = rng.uniform(0.2, 1.0, order * (order + 1) // 2)
    return Preisach(levels, density, 0.4, QuadraticTerm(0.5))


def wandering(seed=0, start=0.05):
    """Loops that grow from the middle: much of the sequence depends on the start."""
    extrema = [start, *(((-1) ** n) * (0.12 + 0.88 * n / 22) for n in range(23)), -1.0, 0.3, -0.6, 0.9, -0.2, 0.5]
    return ramps(extrema, 0.06)


HISTORIES = ([-1.0, 0.8, -0.7, 0.5, -0.3], [1.0, -0.9, 0.6, -0.2], [-1.0, 1.0, -0.25], [-1.0, 0.35])


@cases("history", HISTORIES)
def test_estimate_finds_the_start(history):
    operator, inputs = specimen(), wandering()
    start = MemoryCurve.from_negative_saturation(-1.0).advance(history)
    rng = np.random.default_rng(1)
    outputs = operator.evaluate(inputs, start)
    outputs += 0.002 * np.ptp(outputs) * rng.normal(size=outputs.size)
    options = {"levels": 8, "reversible": "linear"}
    assumed = {
        initial: identify("preisach", inputs, outputs, initial=initial, **options)
        for initial in ("negative", "positive", "skip", "estimate")
    }
    estimated = assumed["estimate"]
    best = min(assumed["negative"].errors.rms, assumed["positive"].errors.rms)
    assert estimated.errors.rms < 0.5 * best
    np.testing.assert_allclose(
        estimated.residuals, outputs - estimated.model.evaluate(inputs, estimated.initial_state)
    )
    # The memory after the sequence is the same whatever the start: it forgot it.
    after = [start.advance(inputs), estimated.initial_state.advance(inputs)]
    assert after[0].staircase(-1.0, 1.0) == after[1].staircase(-1.0, 1.0)
    fresh = wandering(start=0.0)[::-1].copy()
    again = MemoryCurve.from_positive_saturation(1.0)
    truth = operator.evaluate(fresh, again)

    def validation(found):
        return measure_errors(truth, found.model.evaluate(fresh, again)).rms

    assert validation(estimated) < 0.7 * max(validation(assumed["negative"]), validation(assumed["positive"]))


def test_without_noise_a_start_on_the_lattice_is_found_exactly():
    operator, inputs = specimen(), wandering(start=0.1)
    start = MemoryCurve.from_negative_saturation(-1.0).advance([0.75, -0.75, 0.5, -0.25, 0.1])
    outputs = operator.evaluate(inputs, start)
    found = identify("preisach", inputs, outputs, levels=8, reversible="linear", initial="estimate")
    assert found.initial_state.staircase(-1.0, 1.0) == start.staircase(-1.0, 1.0)
    assert found.errors.maximum < 1e-8


def test_saturation_at_either_end_is_taken_as_told():
    operator, inputs = specimen(), wandering()
    for initial, start in (
        ("negative", MemoryCurve.from_negative_saturation(-1.0)),
        ("positive", MemoryCurve.from_positive_saturation(1.0)),
    ):
        outputs = operator.evaluate(inputs, start)
        found = identify("preisach", inputs, outputs, levels=8, reversible="linear", initial=initial)
        assert found.errors.maximum < 1e-8
        assert found.initial_state.saturation == start.saturation
    assert identify("preisach", inputs, outputs, levels=8).initial_state.saturation == -1


@cases("history", HISTORIES)
@cases("plane", [(-1.0, 1.0), (-2.0, 0.5), (-0.5, 3.0), (-4.0, 4.0)])
def test_skip_leaves_out_just_what_depends_on_the_start(history, plane):
    rng = np.random.default_rng(2)
    operator = Preisach(uniform_levels(*plane, 10), rng.random(55))
    inputs = np.concatenate([wandering(), wandering()[::-1]])
    start = MemoryCurve.from_negative_saturation(-9.0).advance(history)
    found = identify("preisach", inputs, operator.evaluate(inputs, start), levels=operator.levels, initial="skip")
    both = [
        operator.evaluate(inputs, saturation) for saturation in (MemoryCurve((), -9.0, -1), MemoryCurve((), 9.0, 1))
    ]
    difference = both[1] - both[0]
    changing = np.flatnonzero(np.abs(np.diff(difference)) > 1e-9)
    assert found.skip == (changing[-1] + 1 if changing.size else 0)
    assert found.errors.maximum < 1e-8


def test_plays_start_where_told():
    thresholds = np.arange(5) / 5.0
    operator = PrandtlIshlinskii(thresholds, [0.5, 0.2, 0.0, 0.3, 0.1], 0.3, input_range=(-1.0, 1.0))
    inputs = wandering()
    for initial, state in (
        (None, operator.initial_state()),
        ("negative", operator.saturated_state(-1)),
        ("positive", operator.saturated_state(1)),
    ):
        outputs = operator.evaluate(inputs, state)
        found = identify("prandtl-ishlinskii", inputs, outputs, plays=5, initial=initial)
        np.testing.assert_allclose(found.model.weights, operator.weights, atol=1e-9)
        assert found.initial_state == state
    found = identify("prandtl-ishlinskii", inputs, outputs, plays=5, initial="skip")
    np.testing.assert_allclose(found.model.weights, operator.weights, atol=1e-9)
    assert found.skip > 0


@cases(
    ("name", "options", "message"),
    [
        ("preisach", {"initial": "unknown"}, "initial: expected 'negative'"),
        ("preisach-signed", {"initial": "estimate"}, "initial: 'estimate' needs a nonnegative"),
        ("prandtl-ishlinskii", {"initial": "estimate"}, "initial: 'estimate' needs a nonnegative"),
    ],
)
def test_wrong_start_is_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        identify(name, [0.0, 1.0, 0.5], [0.0, 1.0, 0.7], **options)
