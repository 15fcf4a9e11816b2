"""Sixty samples with 1 % noise: on any plane the choice errs little more than a polynomial with plays."""

from dataclasses import replace

import numpy as np
import pytest
from hysteretic_plants import PLANTS, butterfly, duhem, random_reversals, settled, through

from bench.hysteresis import identifiable_models
from bench.identification import identify
from bench.identification.evaluation import Candidate, Measurements
from bench.identification.selection import Given, select

MOST = 1.5
ALL = PLANTS | {"butterfly": butterfly}
PLANES = ("preisach", "preisach-signed", "polynomial-plays")


def records(plant, seed):
    """Return sixty samples, and others without noise."""
    rng = np.random.default_rng(seed)
    few, others = random_reversals(rng, 60, 8), random_reversals(rng, 600, 30)
    outputs, truth = (settled(ALL[plant], each) for each in (few, others))
    return few, outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(60), others, truth


def error(candidate: Candidate, inputs, outputs, others, truth):
    """Return the RMS error on other inputs, from where their memory no longer depends on what came before."""
    known = Measurements.of(inputs, outputs).known if candidate.initial == "skip" else 0
    found = identify(
        candidate.model, inputs, outputs, skip=known, initial=candidate.initial, orientation=candidate.orientation,
        smoothing=candidate.smoothing, ridge=None if candidate.smoothing is None else 0.0, **candidate.options,
    )  # fmt: skip
    after = Measurements.of(others, truth).known
    return float(np.sqrt(np.mean((truth - found.model.evaluate(others))[after:] ** 2)))


def ratio(plant, seed, models, options):
    inputs, outputs, others, truth = records(plant, seed)
    chosen = select(Measurements.of(inputs, outputs), models, Given(options)).chosen.candidate
    simple = Candidate("polynomial-plays", {"degree": 3, "plays": 3}, "auto")
    return error(chosen, inputs, outputs, others, truth) / error(simple, inputs, outputs, others, truth)


@pytest.mark.slow
@pytest.mark.parametrize("plant", ALL)
def test_a_plane_that_is_asked_for_does_not_make_it_worse(plant):
    assert ratio(plant, 10, PLANES, {"levels": 20, "reversible": "linear"}) <= MOST


def test_first_rows_that_alone_reach_an_end_of_the_range_are_not_left_out():
    # The lower half is swept once, before the memory is known.
    inputs = through([-1.0, 1.0, 0.1, 0.9, 0.2, 1.0, 0.1, 0.8, 0.3, 0.9], 60)
    _, _, others, truth = records("duhem", 10)
    outputs = settled(duhem, inputs) + 0.01 * np.random.default_rng(0).standard_normal(60)
    measured = Measurements.of(inputs, outputs)
    assert not measured.covers_its_range()
    # What no row may be fitted to reaches beyond in any case.
    fitted = inputs >= 0.09
    assert replace(measured, fitted=fitted).covers_its_range()
    found = select(measured, ("duhem", "polynomial-plays"))
    assert "skip" not in {each.candidate.initial for each in found.evaluations}
    left_out = replace(found.chosen.candidate, initial="skip")
    assert error(left_out, inputs, outputs, others, truth) > 0.1 * np.ptp(truth)
    assert error(found.chosen.candidate, inputs, outputs, others, truth) < 0.05 * np.ptp(truth)


@pytest.mark.seeds
@pytest.mark.parametrize("plant", ALL)
@pytest.mark.parametrize("seed", [10, 11])
@pytest.mark.parametrize("options", [{}, {"levels": 40}])
def test_the_choice_among_all_models_is_no_worse(plant, seed, options):
    assert ratio(plant, seed, tuple(identifiable_models()), options) <= MOST
