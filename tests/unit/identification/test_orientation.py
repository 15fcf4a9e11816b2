"""Outputs that fall with the input: found, fitted and inverted as those that rise."""

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.identification import cross_validate, identify, ramps
from bench.identification.fit.orientation import possible_signs
from bench.models import (
    DeadZones,
    ModelSpec,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    ThermalExpansion,
    uniform_levels,
)

INPUTS = ramps([0.0, *(5.0 + 5.0 * (-1) ** n * (1.0 - n / 24) for n in range(24))], 0.11)

CONSTRAINED = [
    ("preisach", {}),
    ("preisach", {"levels": 8, "reversible": "linear"}),
    ("preisach", {"levels": 8, "reversible": "polynomial", "initial": "positive"}),
    ("preisach", {"levels": 8, "initial": "estimate"}),
    ("preisach", {"levels": 8, "initial": "skip", "smoothing": 1e-3}),
    ("preisach-nonmonotonic", {"levels": 8}),
    ("prandtl-ishlinskii", {}),
    ("prandtl-ishlinskii", {"dead_zones": 4, "initial": "skip"}),
]
SPECIMEN = Preisach(uniform_levels(0.0, 10.0, 12), np.random.default_rng(0).random(78), 3.0, input_range=(0.0, 10.0))


def measured(seed=1):
    return SPECIMEN.evaluate(INPUTS) + 0.2 * np.random.default_rng(seed).normal(size=INPUTS.size)


@cases(("name", "options"), CONSTRAINED)
def test_the_opposite_output_gives_the_opposite_model(name, options):
    rising, falling = (identify(name, INPUTS, sign * measured(), **options) for sign in (1, -1))
    assert (rising.orientation, falling.orientation) == ("rising", "falling")
    np.testing.assert_array_equal(falling.model.coefficients, -rising.model.coefficients)
    assert falling.model.bias == -rising.model.bias
    assert falling.errors == rising.errors
    assert falling.certificate.kkt_residual == rising.certificate.kkt_residual < 1e-10
    assert falling.errors.rms_percent < 6.0
    assert falling.skip == rising.skip
    assert falling.model.output_range() == pytest.approx([-end for end in rising.model.output_range()[::-1]])
    if rising.model.rises():
        assert not falling.model.rises()
    asked = identify(name, INPUTS, -measured(), orientation="falling", **options)
    np.testing.assert_array_equal(asked.model.coefficients, falling.model.coefficients)
    wrong = identify(name, INPUTS, -measured(), orientation="rising", **options)
    assert wrong.orientation == "rising"
    assert wrong.errors.rms > falling.errors.rms


def test_friction_on_a_spring_falls_though_its_force_rises():
    """The correlation says rising, the loops turn the other way: both are fitted, and the better one is taken."""
    friction = PrandtlIshlinskii([0.0, 1.0, 2.0], [0.2, 0.3, 0.1], origin=5.0)
    force = 2.0 * INPUTS - friction.evaluate(INPUTS, friction.saturated_state(-1, 0.0))
    assert np.corrcoef(INPUTS, force)[0, 1] > 0.9
    found = identify("preisach", INPUTS, force, reversible="linear")
    assert found.orientation == "falling"
    assert found.errors.rms_percent < 0.5
    assert identify("preisach", INPUTS, force, reversible="linear", orientation="rising").errors.rms_percent > 2.0


def test_models_of_free_signs_have_no_orientation():
    for name in ("preisach-signed", "polynomial"):
        found = identify(name, INPUTS, -measured())
        assert found.orientation is None
        np.testing.assert_allclose(
            found.model.evaluate(INPUTS), -identify(name, INPUTS, measured()).model.evaluate(INPUTS)
        )
        with pytest.raises(ValueError, match=f"orientation: {name} has coefficients of either sign"):
            identify(name, INPUTS, measured(), orientation="falling")
    with pytest.raises(ValueError, match="orientation: expected 'auto', 'rising' or 'falling', got 'down'"):
        identify("preisach", INPUTS, measured(), orientation="down")


def test_cross_validation_is_the_same_for_the_opposite_output():
    rising, falling = (
        cross_validate("preisach", INPUTS, sign * measured(), smoothing=(0.0, 1e-2), levels=[6]) for sign in (1, -1)
    )
    assert falling.trials == rising.trials
    wrong = cross_validate("preisach", INPUTS, measured(), smoothing=(0.0,), levels=[6], orientation="falling")
    assert wrong.best.rms > 5.0 * rising.best.rms


def make_falling(kind, seed):
    rng = np.random.default_rng(seed)
    if kind == "plays":
        weights = -rng.uniform(0.05, 1.0, 6)
        before, after = (
            DeadZones(np.sort(rng.uniform(-3.0, 3.0, 3)), sign * rng.uniform(0.4, 2.0, 4))
            if rng.random() < 0.7
            else None
            for sign in rng.choice([-1.0, 1.0], 2)
        )
        falls = np.prod([1.0 if zones is None else zones.sign for zones in (before, after)]) > 0
        return PrandtlIshlinskii(np.arange(6.0), weights if falls else -weights, 0.7, 5.0, before, after, (0.0, 10.0))
    density = -rng.random(21) * (rng.random(21) < 0.6)
    density[0] = -1.0
    terms = {
        "density": None,
        "linear": QuadraticTerm(-0.3, None, 5.0),
        "thermal": ThermalExpansion(-0.5, -0.8, 0.0, 10.0, 0.0),
    }
    return Preisach(uniform_levels(0.0, 10.0, 6), density, 2.0, terms[kind], (-1.0, 11.0))


@given(
    st.sampled_from(["plays", "density", "linear", "thermal"]),
    st.integers(0, 10_000),
    st.lists(st.floats(0.0, 10.0), min_size=1, max_size=12),
    st.lists(st.floats(0.0, 1.0), min_size=1, max_size=6),
    st.sampled_from(["nearest", "paper"]),
)
def test_the_inverse_of_a_falling_operator_is_exact(kind, seed, history, shares, policy):
    operator = make_falling(kind, seed)
    if kind in ("plays", "density", "linear"):
        assert not operator.rises()
    state = operator.advance(operator.initial_state(), history)
    inverse = operator.inverse(policy)
    low, high = operator.output_range()
    targets = low + (high - low) * np.array(shares)
    followed = inverse.follow(targets, state)
    present = state
    for target, setpoint, output in zip(targets.tolist(), followed.setpoints, followed.outputs, strict=True):
        found = inverse.invert(present, target)
        assert found.setpoints[-1] == pytest.approx(setpoint, abs=1e-9)
        for value in found.setpoints:
            present, reached = operator.step(present, value)
        assert reached == pytest.approx(output, abs=1e-10 * max(1.0, high - low))
        assert found.outputs[-1] == pytest.approx(reached, abs=1e-10 * max(1.0, high - low))
        if found.reach.value == "met":
            assert reached == pytest.approx(target, abs=1e-10 * max(1.0, high - low))
        else:
            assert (target > reached) == (found.reach.value == "too high")
    stream, forward = inverse.stream(state), operator.stream(state)
    for target, setpoint in zip(targets.tolist(), followed.setpoints, strict=True):
        assert stream.step(target) == pytest.approx(setpoint, abs=1e-9)
        assert stream.output == pytest.approx(stream.value, abs=1e-10 * max(1.0, high - low))
    for value in history:
        state_after, output = operator.step(forward.state, value)
        assert forward.step(value) == pytest.approx(output, abs=1e-12 * max(1.0, high - low))
        assert forward.state == state_after
    beyond = inverse.invert(state, high + 1.0), inverse.invert(state, low - 1.0)
    assert [found.reach.value for found in beyond] == ["too high", "too low"]


@given(
    st.sampled_from(["plays", "density", "linear"]),
    st.integers(0, 10_000),
    st.lists(st.floats(0.0, 10.0), min_size=1, max_size=12),
    st.floats(0.0, 1.0),
)
def test_the_nearest_input_of_a_falling_operator_meets_the_target(kind, seed, history, share):
    operator = make_falling(kind, seed)
    state = operator.advance(operator.initial_state(), history)
    present = operator.present_input(state)
    ends = [operator.step(state, end)[1] for end in operator.input_range]
    target = min(ends) + share * (max(ends) - min(ends))
    found = operator.inverse().nearest_input(state, present, target)
    assert operator.step(state, found)[1] == pytest.approx(target, abs=1e-9)
    assert operator.inverse().nearest_input(state, present, operator.value(state)) == pytest.approx(present, abs=1e-9)


def test_the_nearest_input_of_a_falling_polynomial():
    line = Polynomial([-2.0], (0.0, 10.0), 1.0)
    inverse = line.inverse()
    for wanted in (0.5, 3.0, 7.0):
        assert inverse.nearest_input(None, 3.0, line.step(None, wanted)[1]) == pytest.approx(wanted)


class OnlyRising(PrandtlIshlinskii):
    """An operator of another package that takes no coefficients below 0."""

    def with_coefficients(self, coefficients, bias):
        if min(coefficients) < 0.0:
            raise ValueError("coefficients: expected values >= 0")
        return super().with_coefficients(coefficients, bias)


def test_a_model_that_cannot_fall_is_taken_to_rise():
    spec = ModelSpec("", OnlyRising, lambda _: OnlyRising([0.0, 1.0], [0.0, 0.0]))
    rest = spec, spec.template(INPUTS), INPUTS, measured() * np.sin(INPUTS), np.ones(INPUTS.size)
    assert possible_signs("auto", "plays", *rest) == (1,)
    assert possible_signs("rising", "plays", *rest) == (1,)
    with pytest.raises(ValueError, match="orientation: plays cannot fall: coefficients: expected values >= 0"):
        possible_signs("falling", "plays", *rest)
