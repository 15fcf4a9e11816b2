"""Identification by name, error measures and excitation."""

import math

import numpy as np
import pytest
from cases import cases

from bench.identification import damped_oscillation, identify, measure_errors, ramps, random_validation
from bench.models import Preisach, QuadraticTerm, ThermalExpansion, identifiable_models, uniform_levels

FILM = {"plane": (30.0, 70.0), "reference": 20.0, "input_unit": "°C", "output_unit": "1/m"}

FRESH = {"operating": (21.0, 84.0), "transition": (40.0, 72.0), "step": 1.2}


def film(seed=0):
    """A VO2-like specimen on a finer lattice than the model's."""
    rng = np.random.default_rng(seed)
    levels = uniform_levels(30.0, 70.0, 80)
    middle = 0.5 * (levels[1:] + levels[:-1])
    i, j = np.tril_indices(80)
    alpha, beta = middle[i], middle[j]
    density = np.exp(-0.5 * ((alpha - 62.0) / 2.5) ** 2 - 0.5 * ((beta - 57.0) / 2.5) ** 2)
    density *= 1018.0 / (density @ Preisach(levels, density).cell_areas())
    specimen = Preisach(levels, density, 1027.0, ThermalExpansion(3.0, 4.3, 30.0, 70.0, 20.0), (21.0, 84.0))
    inputs = damped_oscillation(21.0, 84.0, 54.0, 36, 0.35)
    return specimen, inputs, specimen.evaluate(inputs) + 0.4 * rng.normal(size=inputs.size)


def test_nonmonotonic_beats_signed_beats_polynomial():
    specimen, inputs, outputs = film()
    span = (21.0, 84.0)
    best = identify("preisach-nonmonotonic", inputs, outputs, input_range=span, **FILM)
    signed = identify("preisach-signed", inputs, outputs, plane=span)
    polynomial = identify("polynomial", inputs, outputs)
    assert best.errors.maximum < signed.errors.maximum < polynomial.errors.maximum
    assert best.errors.rms_percent < 1.0 < polynomial.errors.rms_percent
    assert (best.model.density >= 0.0).all()
    assert (signed.model.density < 0.0).any()
    assert best.model.reversible.k0 == pytest.approx(3.0, abs=0.3)
    assert best.model.reversible.k1 == pytest.approx(4.3, abs=0.3)
    assert best.model.output_range() == pytest.approx(specimen.output_range(), abs=15.0)
    assert best.certificate.kkt_residual < 1e-10
    assert (best.model.input_unit, best.model.output_unit) == ("°C", "1/m")
    fresh = random_validation(np.random.default_rng(1), 600, **FRESH)
    validation = measure_errors(specimen.evaluate(fresh), best.model.evaluate(fresh))
    assert validation.rms_percent < 2.0


@pytest.mark.parametrize("name", list(identifiable_models()))
def test_every_model_reports_what_it_did(name):
    _, inputs, outputs = film()
    inputs, outputs = inputs[::4], outputs[::4]
    found = identify(name, inputs, outputs, skip=50)
    assert found.model_name == name
    assert found.skip == 50
    np.testing.assert_allclose(found.residuals, outputs - found.model.evaluate(inputs))
    assert found.errors.maximum == pytest.approx(np.abs(found.residuals[50:]).max())
    assert found.errors.rms == pytest.approx(np.sqrt(np.mean(found.residuals[50:] ** 2)))
    assert found.uncertainties.shape == found.model.coefficients.shape
    assert found.certificate.kkt_residual < 1e-10


@pytest.mark.parametrize(("kind", "term"), [("linear", QuadraticTerm(-2.0)), ("quadratic", QuadraticTerm(-2.0, 0.5))])
def test_reversible_part_of_either_sign(kind, term):
    rng = np.random.default_rng(4)
    specimen = Preisach(uniform_levels(-1.0, 1.0, 6), rng.random(21), 0.3, term)
    inputs = ramps([-1.0, *(((-1) ** n) * (1.0 - n / 20) for n in range(20))], 0.03)
    outputs = specimen.evaluate(inputs)
    found = identify("preisach", inputs, outputs, levels=6, reversible=kind)
    assert found.errors.maximum < 1e-8
    np.testing.assert_allclose(found.model.coefficients, specimen.coefficients, atol=1e-7)
    assert identify("preisach", inputs, outputs, levels=6).errors.maximum > 0.01


@cases(
    ("name", "options"),
    [("duhem", {"degree": 5}), ("polynomial", {"degree": 5}), ("polynomial-plays", {"degree": 3})],
)
def test_a_model_of_small_cycles_does_not_run_away_on_large_ones(name, options):
    inputs = np.concatenate(
        [damped_oscillation(-1.0, 1.0, 0.0, 12, 0.05), damped_oscillation(-4.0, 4.0, 0.0, 4, 0.1)]
    )
    outputs = np.tanh(inputs) + 0.01 * np.random.default_rng(3).standard_normal(inputs.size)
    small = np.arange(inputs.size) < damped_oscillation(-1.0, 1.0, 0.0, 12, 0.05).size
    model = identify(name, inputs, outputs, weights=small.astype(float), **options).model
    assert model.input_range == (inputs[small].min(), inputs[small].max())
    # tanh is at most 1, and its secant over the small cycles reaches 3 at the ends of the large ones.
    assert np.abs(model.evaluate(inputs)).max() < 5.0


def test_the_thresholds_of_plays_spread_up_to_the_maximum():
    inputs = ramps([0.0, 8.0, 1.0, 6.0, 2.0], 0.5)
    found = identify("prandtl-ishlinskii", inputs, inputs, plays=4, maximum=3.0)
    assert found.model.thresholds.tolist() == [0.0, 0.75, 1.5, 2.25]
    single = identify("prandtl-ishlinskii", inputs, inputs, plays=1, maximum=3.0)
    assert single.model.thresholds.tolist() == [0.0]


def test_skip_removes_the_effect_of_an_unknown_start():
    specimen, inputs, _ = film()
    truth = specimen.evaluate(inputs, specimen.initial_state().advance([84.0, 55.0]))
    outputs = truth.copy()
    outputs[:100] += 500.0
    whole = identify("preisach-nonmonotonic", inputs, outputs, **FILM)
    skipped = identify("preisach-nonmonotonic", inputs, outputs, skip=100, **FILM)
    assert skipped.errors.rms < 0.2 * whole.errors.rms


def test_given_levels_and_ranges():
    _, inputs, outputs = film()
    levels = [30.0, 50.0, 55.0, 60.0, 65.0, 70.0]
    found = identify("preisach-nonmonotonic", inputs[::9], outputs[::9], levels=levels, input_range=(20, 90))
    np.testing.assert_array_equal(found.model.levels, levels)
    assert found.model.input_range == (20.0, 90.0)
    found = identify("preisach", inputs[::9], outputs[::9], levels=5)
    assert found.model.levels[[0, -1]] == pytest.approx([21.0, 84.0])
    assert found.model.input_range == (21.0, 84.0)


@pytest.mark.parametrize(
    ("name", "inputs", "outputs", "options", "message"),
    [
        (
            "spline",
            [0.0, 1.0],
            [0.0, 1.0],
            {},
            "model_name: expected one of bouc-wen, duhem, .*, polynomial, polynomial-plays, "
            "prandtl-ishlinskii, preisach",
        ),
        ("preisach", [0.0, 1.0], [0.0], {}, "outputs: expected 2 values"),
        ("preisach", [], [], {}, "inputs: expected at least one"),
        ("preisach", [0.0, math.nan], [0.0, 1.0], {}, "inputs: expected finite"),
        ("preisach", [1.0, 1.0], [0.0, 1.0], {}, "inputs: constant at 1.0; give plane"),
        ("polynomial", [1.0, 1.0], [0.0, 1.0], {}, "inputs: constant"),
        ("preisach", [0.0, 1.0], [0.0, 1.0], {"degree": 3}, "degree: belongs to"),
        ("preisach", [0.0, 1.0], [0.0, 1.0], {"reversible": "cubic"}, "reversible: expected one of none"),
        ("preisach", [0.0, 1.0], [0.0, 1.0], {"levels": 0}, "intervals"),
        ("preisach", [0.0, 1.0], [0.0, 1.0], {"levels": [1.0, 0.0]}, "levels: expected strictly"),
        ("preisach-signed", [0.0, 1.0], [0.0, 1.0], {"smoothing": -1.0}, "smoothing: expected a finite number >= 0"),
        ("preisach-signed", [0.0, 1.0], [0.0, 1.0], {"ridge": -1.0}, "ridge: expected a finite number >= 0"),
        ("polynomial", [0.0, 1.0], [0.0, 1.0], {"smoothing": 1.0}, "smoothing: this model has no cells"),
        ("polynomial", [0.0, 1.0], [0.0, 1.0], {"degree": 0}, "degree"),
    ],
)
def test_wrong_input_is_named(name, inputs, outputs, options, message):
    with pytest.raises(ValueError, match=message):
        identify(name, inputs, outputs, **options)


def test_error_measures():
    errors = measure_errors([0.0, 1.0, 2.0, 4.0], [0.0, 2.0, 2.0, 2.0])
    assert (errors.maximum, errors.average, errors.span) == (2.0, 0.75, 4.0)
    assert errors.rms == pytest.approx(math.sqrt(5 / 4))
    assert errors.rms_percent == pytest.approx(100 * math.sqrt(5 / 4) / 4)
    assert errors.average_percent == pytest.approx(18.75)
    assert errors.maximum_percent == pytest.approx(50.0)
    assert math.isnan(measure_errors([1.0, 1.0], [1.0, 2.0]).rms_percent)
    with pytest.raises(ValueError, match="predicted: expected 2"):
        measure_errors([1.0, 2.0], [1.0])


def test_damped_oscillation_nests_towards_the_center():
    points = damped_oscillation(21.0, 84.0, 54.0, 36, 0.35)
    assert points.size == 3439
    assert (points[0], points.max(), points[-1]) == (21.0, 84.0, 54.0)
    steps = np.diff(points)
    assert np.abs(steps).max() <= 0.35 + 1e-9
    turns = points[1:-1][steps[1:] * steps[:-1] < 0]
    assert turns.size == 36
    assert (np.diff(turns[0::2]) < 0).all()
    assert (np.diff(turns[1::2]) > 0).all()


def test_random_validation_follows_the_recipe():
    points = random_validation(np.random.default_rng(7), 5000, **FRESH)
    assert points.size == 5000
    assert points.min() >= 21.0
    assert points.max() <= 84.0
    assert np.abs(np.diff(points)).max() <= 1.2 + 1e-9
    assert 0.6 < np.mean((points >= 40.0) & (points <= 72.0)) < 0.95
    again = random_validation(np.random.default_rng(7), 5000, **FRESH)
    np.testing.assert_array_equal(points, again)
    assert random_validation(np.random.default_rng(7), 1, **FRESH).tolist() == [21.0]


def test_ramps_divide_evenly_and_keep_the_extrema():
    np.testing.assert_allclose(ramps([0.0, 1.0, 0.5], 0.25), [0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5])
    np.testing.assert_allclose(ramps([0.0, 1.0], 0.3), [0.0, 0.25, 0.5, 0.75, 1.0])
    assert 0.1 in ramps([0.0, 0.1, 0.3], 0.07)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: damped_oscillation(21.0, 84.0, 90.0, 36, 0.35), "low, center, high"),
        (lambda: damped_oscillation(21.0, 84.0, 54.0, 0, 0.35), "half_cycles"),
        (lambda: damped_oscillation(21.0, 84.0, 54.0, 36, 0.0), "step"),
        (lambda: ramps([], 1.0), "extrema"),
        (lambda: random_validation(np.random.default_rng(0), 0, **FRESH), "count"),
        (
            lambda: random_validation(np.random.default_rng(0), 600, **(FRESH | {"operating": (1.0, 0.0)})),
            "operating",
        ),
    ],
)
def test_wrong_excitation_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
