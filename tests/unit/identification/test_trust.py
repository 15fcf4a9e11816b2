"""What is refused before a fit, and what is warned of after it; no warning where there is no reason."""

import re

import numpy as np
import pytest
from cases import cases

from bench.identification import cross_validate, identify, ramps
from bench.models import PrandtlIshlinskii, Preisach, QuadraticTerm, uniform_levels

TURNS = [0.0, *(5.0 + 5.0 * (-1) ** n * (1.0 - n / 24) for n in range(24))]
INPUTS = ramps(TURNS, 0.05)
LEVELS = uniform_levels(0.0, 10.0, 10)
SPECIMEN = Preisach(LEVELS, np.random.default_rng(0).random(55), 3.0, QuadraticTerm(0.5), (0.0, 10.0))
PLAYS = PrandtlIshlinskii(np.arange(5.0), np.linspace(1.0, 0.2, 5), origin=5.0)


def measured(inputs, state=None, noise=0.01, seed=1):
    outputs = SPECIMEN.evaluate(inputs, state)
    return outputs + noise * np.ptp(outputs) * np.random.default_rng(seed).normal(size=inputs.size)


def butterfly():
    """The square of a polarization, over inputs of both signs."""
    inputs = ramps([-5.0, *([5.0, -5.0] * 3)], 0.05)
    switching = Preisach(uniform_levels(-5.0, 5.0, 10), np.exp(-np.linspace(0.0, 3.0, 55)), 0.0)
    polarization = switching.evaluate(inputs)
    return inputs, (polarization - 0.5 * (polarization.min() + polarization.max())) ** 2


@cases("name", ["preisach", "preisach-nonmonotonic", "prandtl-ishlinskii", "polynomial"])
@cases("sign", [1, -1])
def test_good_data_give_no_warning(name, sign):
    assert identify(name, INPUTS, sign * measured(INPUTS)).warnings == ()


@cases("name", ["preisach", "preisach-nonmonotonic", "polynomial"])
def test_rows_after_the_last_that_is_fitted_give_no_warning(name):
    later = 30.0 * np.sin(0.1 * np.arange(400.0)) ** 3
    weights = np.append(np.ones(INPUTS.size), np.zeros(later.size))
    for initial in ("negative", "skip"):
        found = identify(
            name, np.append(INPUTS, later), np.append(measured(INPUTS), 0.0 * later), weights=weights, initial=initial
        )
        assert found.warnings == ()


@cases(
    "options",
    [{"smoothing": 1e-3}, {"reversible": "polynomial"}, {"initial": "skip"}, {"initial": "estimate"}, {"levels": 12}],
)
def test_good_data_give_no_warning_with_any_option(options):
    assert identify("preisach", INPUTS, measured(INPUTS), **options).warnings == ()


def few():
    inputs = np.interp(np.linspace(0.0, 1.0, 61), np.linspace(0.0, 1.0, 5), [0.0, 10.0, 1.0, 8.0, 3.0])
    return inputs, measured(inputs)


def of_another_start():
    inputs = INPUTS[60:]
    return inputs, measured(inputs, SPECIMEN.saturated_state(1))


def noise():
    return INPUTS, np.random.default_rng(3).normal(size=INPUTS.size)


@cases(
    ("data", "name", "options", "message"),
    [
        (few(), "preisach", {}, r"^61 samples are few for 210 coefficients, .*--cross-validate$"),
        (few(), "preisach", {"reversible": "polynomial"}, r"^61 samples are few for 215 coefficients"),
        (few(), "preisach-signed", {"smoothing": 0.0, "ridge": 0.0}, r"^61 samples are few for 210 coefficients"),
        (of_another_start(), "preisach", {}, r"^the largest errors stand in the first \d+ .*--initial estimate or"),
        (of_another_start(), "prandtl-ishlinskii", {}, r"^the largest errors stand in the first .*--initial skip$"),
        ((INPUTS, measured(INPUTS)), "preisach", {"orientation": "falling"}, r"^free coefficients: only 0 of 210"),
        (noise(), "preisach", {"levels": 3}, r"explains \d+% of the variance .*--model preisach-signed"),
        (noise(), "polynomial", {}, r"explains \d% of the variance .*--model preisach$"),
        (butterfly(), "preisach", {"reversible": "polynomial"}, r"butterfly.*--model preisach-signed$"),
        (butterfly(), "preisach", {}, r"butterfly.*--model preisach-signed$"),
        ((INPUTS, measured(INPUTS)), "preisach", {"plane": (30.0, 70.0)}, r"^the plane from 30 to 70 .*--plane 0"),
        ((INPUTS, measured(INPUTS)), "preisach", {"plane": (4.0, 5.0)}, r"^the plane from 4 to 5 .*--plane 0 10,"),
        ((INPUTS, measured(INPUTS)), "preisach", {"plane": (3.0, 7.0)}, r"^the plane from 3 to 7 .*--plane 0 10,"),
        ((INPUTS, measured(INPUTS)), "preisach-nonmonotonic", {"input_unit": "V"}, r"^the reversible part .* in"),
    ],
)
def test_a_fit_that_cannot_be_trusted_says_so_with_a_remedy(data, name, options, message):
    found = identify(name, *data, **options)
    assert [warning for warning in found.warnings if re.search(message, warning)], found.warnings


def test_the_remedies_help():
    """What the warnings name takes them away, and the errors with them."""
    inputs, outputs = of_another_start()
    worse = identify("preisach", inputs, outputs)
    for initial in ("estimate", "skip"):
        better = identify("preisach", inputs, outputs, initial=initial)
        assert better.errors.maximum < 0.3 * worse.errors.maximum
        assert not [warning for warning in better.warnings if "first" in warning]
    assert not [w for w in identify("preisach-signed", *butterfly()).warnings if "butterfly" in w or "R²" in w]
    assert identify("preisach-nonmonotonic", INPUTS, measured(INPUTS), input_unit="°C").warnings == ()


@cases("name", ["preisach", "preisach-signed", "prandtl-ishlinskii", "polynomial"])
def test_a_constant_record_is_refused(name):
    with pytest.raises(ValueError, match=rf"^outputs: constant at 0.1 in all {INPUTS.size} samples that count"):
        identify(name, INPUTS, np.full(INPUTS.size, 0.1))
    with pytest.raises(ValueError, match=r"constant at 4"):
        cross_validate(name, np.full(50, 4.0), np.arange(50.0))
    outputs = measured(INPUTS)
    outputs[100:] = 7.0
    with pytest.raises(ValueError, match=r"^outputs: constant at 7 in all \d+ samples that count"):
        identify(name, INPUTS, outputs, skip=100)


def test_an_unknown_memory_that_leaves_too_little_is_refused():
    # A growing oscillation: its greatest input comes last, its least shortly before.
    inputs = INPUTS[::-1][: -int(np.argmax(INPUTS))]
    outputs = PLAYS.evaluate(inputs)
    for name, others in (("prandtl-ishlinskii", "negative or positive"), ("preisach", "estimate, negative or")):
        with pytest.raises(
            ValueError, match=rf"'skip' leaves \d+ of {inputs.size} samples, .*use --initial {others}"
        ):
            identify(name, inputs, outputs, initial="skip")
        with pytest.raises(ValueError, match="'skip' leaves"):
            cross_validate(name, inputs, outputs, initial="skip")
    inputs = np.append(INPUTS[:40], 10.5 - 0.5 * np.arange(12.0))
    with pytest.raises(ValueError, match="'skip' leaves 12 of 52 samples"):
        identify("prandtl-ishlinskii", inputs, PLAYS.evaluate(inputs), initial="skip")
