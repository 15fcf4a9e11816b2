"""Models of elements find themselves again in their own noisy data, by name and without an option."""

import numpy as np
import pytest

from bench.identification import identify
from bench.models import BoucWen, Duhem, GeneralizedPrandtlIshlinskii, KrasnoselskiiPokrovskii, MaxwellSlip

NOISE = 0.01
ROWS = 1500
RANGE = (-2.0, 2.0)


def inputs_of(rows=ROWS):
    """A damped oscillation, then one about changing centres."""
    time = np.linspace(0.0, 1.0, rows)
    damped = np.sin(2 * np.pi * 12 * time) * (1.0 - 0.9 * time)
    centred = 0.6 * np.sin(2 * np.pi * 9 * time) + 0.4 * np.sin(2 * np.pi * 2.3 * time)
    return 2.0 * np.where(time < 0.5, damped, centred)


def plants():
    rng = np.random.default_rng(1)
    return {
        "bouc-wen": BoucWen(1.0, -0.6, 0.3, 3.0, 1.0, 1.0, 2.0, 0.0, RANGE),
        "duhem": Duhem([0.8, 0.1, -0.1], [0.3, 0.0, 0.1], 3.0, 0.3, 0.0, RANGE),
        "generalized-prandtl-ishlinskii": GeneralizedPrandtlIshlinskii(
            np.arange(15) / 15, rng.uniform(0.0, 0.2, 15), 2.0, 0.6, 1.5, -0.45, 0.2, 0.0, RANGE
        ),
        "krasnoselskii-pokrovskii": KrasnoselskiiPokrovskii(
            -2.0 + 4.0 / 15 * np.arange(15), rng.uniform(0.0, 0.02, 120), 4.0 / 15, 0.2, RANGE
        ),
        "maxwell-slip": MaxwellSlip(2.0 * np.arange(1, 16) / 15, rng.uniform(0.0, 1.0, 15), 0.5, 0.2, 0.0, RANGE),
    }


@pytest.mark.parametrize("name", plants())
def test_a_plant_of_its_own_kind_is_found(name):
    # Of as many coefficients as a plane has, more rows.
    plant, inputs = plants()[name], inputs_of(2 * ROWS if name == "krasnoselskii-pokrovskii" else ROWS)
    clean = plant.evaluate(inputs)
    noise = NOISE * np.ptp(clean) * np.random.default_rng(0).normal(size=clean.size)
    found = identify(name, inputs, clean + noise)
    assert found.errors.rms_percent == pytest.approx(100.0 * NOISE, rel=0.1)
    # Of K coefficients about σ √(K / N) remains; what was not measured is predicted as well.
    fresh = 1.9 * np.sin(np.linspace(0.0, 40.0, 2000)) * np.cos(np.linspace(0.0, 3.0, 2000))
    error = found.model.evaluate(fresh) - plant.evaluate(fresh)
    assert np.sqrt(np.mean(error**2)) < 0.6 * NOISE * np.ptp(clean)
    assert found.certificate.converged


@pytest.mark.slow
def test_the_parameters_of_bouc_wen_are_found():
    plant, inputs = plants()["bouc-wen"], inputs_of()
    found = identify("bouc-wen", inputs, plant.evaluate(inputs), input_range=RANGE).model
    assert found.shape_parameters().values == pytest.approx(plant.shape_parameters().values, rel=1e-5)
    assert found.coefficients == pytest.approx(plant.coefficients, rel=1e-5)


@pytest.mark.slow
def test_bouc_wen_of_other_exponents_and_stiffening_is_found():
    inputs = inputs_of(800)
    for beta, gamma, exponent, hysteretic in ((30.0, 10.0, 3.0, -0.4), (0.4, -1.1, 1.0, 1.0), (4.0, 2.0, 1.7, 1.0)):
        plant = BoucWen(1.0, hysteretic, 0.3, beta, gamma, exponent, 2.0, 0.0, RANGE)
        found = identify("bouc-wen", inputs, plant.evaluate(inputs))
        assert found.errors.rms_percent < 1e-4


def test_the_rate_of_duhem_is_found():
    plant, inputs = plants()["duhem"], inputs_of()
    found = identify("duhem", inputs, plant.evaluate(inputs), input_range=RANGE).model
    assert found.rate == pytest.approx(3.0, rel=1e-6)


@pytest.mark.slow
def test_a_loop_that_saturates_suits_envelopes_better_than_plain_plays():
    inputs = inputs_of(800)
    outputs = np.tanh(1.5 * plants()["generalized-prandtl-ishlinskii"].evaluate(inputs))
    generalized = identify("generalized-prandtl-ishlinskii", inputs, outputs)
    assert generalized.errors.rms < 0.3 * identify("prandtl-ishlinskii", inputs, outputs).errors.rms


@pytest.mark.parametrize("name", plants())
def test_the_relaxed_state_of_a_heater_is_at_the_low_end(name):
    inputs = 30.0 + 20.0 * (1.0 - np.cos(np.linspace(0.0, 20.0, 500)))
    found = identify(name, inputs, 0.1 * inputs)
    assert found.model.present_input(found.model.initial_state()) == pytest.approx(30.0)
    assert found.errors.rms_percent < 1.0


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("bouc-wen", {"levels": 3}, "there is no levels"),
        ("duhem", {"degree": 0}, "degree: expected at least 1"),
        ("generalized-prandtl-ishlinskii", {"plays": 0}, "plays: expected at least 1"),
        ("krasnoselskii-pokrovskii", {"plane": (1.0, 0.0)}, "plane: expected two increasing inputs"),
        ("maxwell-slip", {"maximum": -1.0}, "maximum: expected a positive number"),
    ],
)
def test_a_wrong_option_is_refused(name, options, words):
    with pytest.raises(ValueError, match=words):
        identify(name, inputs_of(100), np.zeros(100), **options)


def test_a_shape_that_the_data_do_not_determine_is_said():
    inputs = inputs_of()
    quick, slow = (Duhem([0.8], [2.0], rate, input_range=RANGE).evaluate(inputs) for rate in (100.0, 3.0))
    found = identify("duhem", inputs, quick, degree=1)
    assert any("rate = 20 is at the end of its range" in warning for warning in found.warnings)
    found = identify("duhem", inputs, slow, degree=1)
    assert not any("at the end of its range" in warning for warning in found.warnings)
