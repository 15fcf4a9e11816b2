"""Coverage of the plane, checks of the data, and cross-validation."""

import math
import re

import numpy as np
import pytest
from cases import cases

from bench.identification import Candidate, check_data, cross_validate, fit, identify, ramps, set_up_problem
from bench.models import MemoryCurve, PrandtlIshlinskii, Preisach, uniform_levels


def plane(order=4):
    return Preisach(uniform_levels(-1.0, 1.0, order), np.zeros(order * (order + 1) // 2))


def test_cells_never_swept_are_listed_with_their_centres():
    # From -1 to 0 and back: only cells with α below 0 are swept.
    found = plane().coverage([-1.0, -0.5, 0.0, -0.5, -1.0])
    assert found.never.tolist() == [3, 4, 5, 6, 7, 8, 9]
    np.testing.assert_allclose(found.centres[0], [-0.75, 0.25])
    # The centre of mass of the triangle 0 <= β <= α <= 0.5.
    np.testing.assert_allclose(found.centres[2], [1 / 6, 1 / 3])
    assert found.fraction == pytest.approx(0.3)
    assert found.summary().startswith("3 of 10 cells swept (30%); never swept: 7 with centres β from -0.75")
    regressor = plane().regressor([-1.0, -0.5, 0.0, -0.5, -1.0])
    np.testing.assert_array_equal(found.swept, fit(regressor, [0.0, 1.0, 2.0, 1.5, 0.0]).certificate.swept)


def test_full_coverage_and_the_first_move():
    whole = plane().coverage([-1.0, 1.0])
    assert not whole.never.size
    assert whole.centres.shape == (0, 2)
    assert whole.summary() == "all 10 cells swept"
    # What the specimen did before the first reading was not measured.
    assert plane().coverage([1.0]).fraction == 0.0
    assert plane().coverage([0.0, 1.0], MemoryCurve.from_positive_saturation(0.0)).fraction < 1.0


def test_unobtrusive_data_raise_no_warning():
    inputs = ramps([-1.0, 1.0, -0.5, 0.5, -1.0], 0.1)
    assert check_data(inputs, inputs**3) == []


@cases(
    ("inputs", "outputs", "message"),
    [
        ([0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.2, 0.1, 1.0, 0.5], "2 of 5 inputs repeat .* up to 0.2 "),
        ([0.0, 0.0, 0.0, 1.0, 0.0], None, "no information$"),
        ([*(np.linspace(1.0, 0.0, 9)), *(np.linspace(1.0, 0.2, 9))], None, "1 of 1 ascending .* to be missing"),
        ([*(np.linspace(0.0, 1.0, 9)), *(np.linspace(0.1, 1.0, 9))], None, "1 of 1 descending .* missing"),
        (np.linspace(1.0, 0.0, 9), None, "there is no ascending branch"),
        (np.linspace(0.0, 1.0, 9), None, "there is no descending branch"),
        ([0.0, 1.0, 0.0], [2.0, 2.0, 2.0], "output is 2 throughout"),
        ([0.3, 0.3], None, "input is 0.3 throughout"),
    ],
)
def test_odd_data_are_told(inputs, outputs, message):
    found = check_data(inputs, outputs)
    assert len(found) == 1
    assert re.search(message, str(found[0]))


def test_identification_passes_the_warnings_on():
    inputs = np.repeat(ramps([-1.0, 0.0, -1.0], 0.1), 2)
    found = identify("preisach", inputs, inputs, levels=4, plane=(-1.0, 1.0))
    assert "repeat the one before" in found.warnings[0]
    assert "3 of 10 cells swept" in found.warnings[1]


def noisy(order=10, noise=0.05):
    rng = np.random.default_rng(5)
    levels = uniform_levels(-1.0, 1.0, order)
    middle = 0.5 * (levels[1:] + levels[:-1])
    i, j = np.tril_indices(order)
    operator = Preisach(levels, np.exp(-4.0 * ((middle[i] - 0.2) ** 2 + (middle[j] + 0.2) ** 2)))
    inputs = ramps([-1.0, *(((-1) ** n) * (1.0 - n / 20) for n in range(20)), -1.0], 0.1)
    outputs = operator.evaluate(inputs)
    return operator, inputs, outputs + noise * np.ptp(outputs) * rng.normal(size=outputs.size)


def test_cross_validation_chooses_a_smoothing_that_predicts_better():
    operator, inputs, outputs = noisy()
    weights = (0.0, 1e-4, 1e-2, 1.0, 1e3)
    table = cross_validate("preisach", inputs, outputs, smoothing=weights, levels=(10,))
    assert [trial.smoothing for trial in table.trials] == list(weights)
    assert 0.0 < table.best.smoothing < 1e3
    rms = {trial.smoothing: trial.rms for trial in table.trials}
    assert rms[table.best.smoothing] < rms[0.0]
    assert table.trials[0].training_rms < table.trials[-1].training_rms
    assert table.trials[0].training_rms < table.trials[0].rms
    fresh = np.random.default_rng(9).uniform(-1.0, 1.0, 400)
    truth = operator.evaluate(fresh)

    def true_error(smoothing):
        found = identify("preisach", inputs, outputs, levels=10, smoothing=smoothing)
        return np.sqrt(np.mean((found.model.evaluate(fresh) - truth) ** 2))

    assert true_error(table.best.smoothing) < 0.7 * true_error(0.0)
    lines = table.table().splitlines()
    assert len(lines) == 6
    assert sum(line.startswith(" *") for line in lines) == 1


def test_each_fold_is_predicted_without_it():
    _, inputs, outputs = noisy(order=4)
    # The plane is given, as that of a fit is the range of the rows that are fitted.
    plane = inputs.min(), inputs.max()
    table = cross_validate("preisach", inputs, outputs, levels=(3, 4), skip=10, plane=plane)
    assert [trial.levels for trial in table.trials] == [3, 4]
    problem = set_up_problem(Candidate("preisach", {"levels": 4, "plane": plane}), inputs, outputs, skip=10)
    block = np.arange(inputs.size - 10) * 20 // (inputs.size - 10)
    squares = np.empty(inputs.size - 10)
    for fold in range(5):
        left_out = np.concatenate([np.zeros(10, dtype=bool), block % 5 == fold])
        found = identify("preisach", inputs, outputs, levels=4, plane=plane, skip=10, weights=~left_out)
        squares[left_out[10:]] = found.residuals[left_out] ** 2
    assert table.trials[1].rms == pytest.approx(np.sqrt(np.mean(squares)))
    assert problem.skip == 10


def test_cross_validation_of_models_without_smoothing():
    _, inputs, outputs = noisy()
    rms = {
        name: cross_validate(name, inputs, outputs).best.rms
        for name in ("preisach", "prandtl-ishlinskii", "polynomial")
    }
    assert rms["preisach"] < rms["polynomial"]


@cases(
    ("options", "message"),
    [
        ({"smoothing": ()}, "smoothing: expected at least one"),
        ({"levels": ()}, "levels: expected at least one"),
        ({"weights": "few"}, "weights: expected a positive weight in each of 5 folds, got 3 in all"),
    ],
)
def test_wrong_cross_validation_is_named(options, message):
    _, inputs, outputs = noisy()
    if options.get("weights") == "few":
        options = {"weights": np.arange(inputs.size) % (inputs.size // 3) == 1}
    with pytest.raises(ValueError, match=message):
        cross_validate("preisach", inputs, outputs, **options)


def test_wrong_data_are_named():
    with pytest.raises(ValueError, match="outputs: expected 2"):
        check_data([0.0, 1.0], [0.0])
    with pytest.raises(ValueError, match="inputs: expected finite"):
        check_data([0.0, math.nan])


def piezo(after=None):
    thresholds = 20.0 * np.arange(15) / 15
    weights = 0.02 * np.exp(-np.arange(15) / 6.0)
    weights[0] += 0.15
    return PrandtlIshlinskii(thresholds, weights, 0.4, after=after, input_range=(-20.0, 20.0))


def test_plays_are_identified():
    operator = piezo()
    inputs = ramps([0.0, 20.0, *(((-1) ** n) * -20.0 * (1.0 - n / 30) for n in range(30))], 0.7)
    outputs = operator.evaluate(inputs)
    found = identify("prandtl-ishlinskii", inputs, outputs, input_unit="V")
    np.testing.assert_allclose(found.model.thresholds, operator.thresholds)
    np.testing.assert_allclose(found.model.weights, operator.weights, atol=1e-9)
    assert found.model.bias == pytest.approx(0.4)
    assert found.certificate.kkt_residual < 1e-10
    assert found.model.input_unit == "V"
    back = found.model.inverse_operator().evaluate(outputs, found.model.inverse_state(found.initial_state))
    np.testing.assert_allclose(back, inputs, atol=1e-6)


def test_dead_zones_catch_saturation_and_asymmetry():
    from bench.models import DeadZones

    operator = piezo(DeadZones([-2.0, 1.5, 3.0], [1.6, 1.0, 0.6, 0.3]))
    rng = np.random.default_rng(0)
    inputs = ramps([0.0, *(((-1) ** n) * 20.0 * (1.0 - n / 30) for n in range(30))], 0.4)
    outputs = operator.evaluate(inputs)
    outputs += 0.001 * np.ptp(outputs) * rng.normal(size=outputs.size)
    plain = identify("prandtl-ishlinskii", inputs, outputs)
    found = identify("prandtl-ishlinskii", inputs, outputs, dead_zones=12)
    assert found.errors.rms < 0.15 * plain.errors.rms
    assert found.errors.rms_percent < 0.25
    fresh = rng.uniform(-20.0, 20.0, 300)
    error = found.model.evaluate(fresh) - operator.evaluate(fresh)
    assert np.sqrt(np.mean(error**2)) < 0.004 * np.ptp(outputs)
    inverse = found.model.inverse_operator()
    back = inverse.evaluate(found.model.evaluate(fresh), found.model.inverse_state(found.initial_state))
    np.testing.assert_allclose(back, fresh, atol=1e-9)


@cases(
    ("options", "message"),
    [
        ({"plays": 0}, "plays: expected at least 1"),
        ({"maximum": -1.0}, "maximum: expected a positive"),
        ({"maximum": 0.0}, "maximum: expected a positive"),
        ({"dead_zones": -1}, "dead_zones: expected an integer >= 0"),
        ({"dead_zones": 1.5}, "dead_zones: expected an integer, got 1.5"),
        ({"degree": 3}, "options of prandtl-ishlinskii"),
    ],
)
def test_wrong_plays_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        identify("prandtl-ishlinskii", [0.0, 1.0, 0.5], [0.0, 1.0, 0.7], **options)


def test_a_sensor_that_stands_still_is_named():
    inputs = ramps([0.0, 10.0, 0.0, 10.0, 0.0], 0.1)
    rng = np.random.default_rng(0)
    outputs = inputs + 0.01 * rng.standard_normal(inputs.size)

    def found(*sequences):
        return [str(one) for one in check_data(*sequences) if one.code == "frozen-output"]

    assert not found(inputs, outputs)
    frozen = outputs.copy()
    frozen[150:200] = frozen[150]
    (text,) = found(inputs, frozen)
    assert "from row 150 to row 199" in text
    assert "--train" in text
    # Coarse readings repeat everywhere, a saturated specimen where the input hardly moves.
    assert not found(inputs, np.round(frozen))
    assert not found(np.where(frozen == frozen[150], 5.0, inputs), frozen)
