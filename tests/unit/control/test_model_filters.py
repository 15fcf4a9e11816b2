"""Adaptation of a model while it controls."""

from dataclasses import replace

import numpy as np
import pytest
from cases import cases

from bench.control.model_filters import DensityFilter, SessionFilter, model_filter
from bench.control.tracking import ClosedLoopInverse, OpenLoopInverse
from bench.models import Polynomial, PrandtlIshlinskii, Preisach, QuadraticTerm, uniform_levels, widened

NOISE = 0.5
SPAN = 200.0


@pytest.fixture(scope="module")
def identified():
    levels = uniform_levels(0.0, 10.0, 16)
    middle = 0.5 * (levels[1:] + levels[:-1])
    rows, columns = np.tril_indices(16)
    alpha, beta = middle[rows], middle[columns]
    density = np.exp(-(((alpha - 6.5) / 1.5) ** 2) - ((alpha - beta - 1.5) / 1.0) ** 2)
    density *= 0.5 * SPAN / (density @ Preisach(levels, density).cell_areas())
    return Preisach(
        levels, density, bias=7.0, reversible=QuadraticTerm(-1.0), input_range=(-2.0, 12.0), output_unit="1/m"
    )


def specimen(identified, *, offset=0.0, gain=1.0, moved=0.0, width=1.0):
    inner = widened(identified, width).shifted(moved)
    return inner.with_coefficients(gain * inner.coefficients, gain * inner.bias + offset)


PERTURBED = {
    "offset": {"offset": 12.0},
    "gain": {"gain": 1.1},
    "shift": {"moved": 0.2},
    "width": {"width": 1.3},
    "all": {"offset": -6.0, "gain": 0.93, "moved": -0.15, "width": 0.85},
}


def readings(plant, count, seed=0):
    """Return (state, output) at inputs at random over the plane, with noise."""
    rng = np.random.default_rng(seed)
    state = plant.saturated_state(-1, -2.0)
    found = []
    for value in rng.uniform(-1.0, 11.0, count).tolist():
        state = state.step(value)
        found.append((state, plant.value(state) + NOISE * rng.normal()))
    return found


def rms(errors):
    return float(np.sqrt(np.mean(np.square(errors))))


def learnt(adaptation, found):
    """Return the error of the prediction of each reading before it is learnt."""
    errors = []
    for state, output in found:
        errors.append(output - adaptation.model.value(state))
        adaptation.update(state, output)
    return np.array(errors)


@pytest.mark.parametrize("name", ["session", "density"])
class TestBoth:
    @pytest.mark.parametrize(
        "changed",
        [each if each in ("gain", "all") else pytest.param(each, marks=pytest.mark.seeds) for each in PERTURBED],
    )
    def test_a_specimen_that_moved_is_explained_after_sixty_readings(self, identified, name, changed):
        found = readings(specimen(identified, **PERTURBED[changed]), 80)
        before = rms([output - identified.value(state) for state, output in found[60:]])
        after = rms(learnt(model_filter(name, identified), found)[60:])
        assert before > 3.0
        assert after < max(0.25 * before, 2.0 * NOISE)

    def test_the_model_that_is_right_stays_so(self, identified, name):
        adaptation = model_filter(name, identified)
        assert rms(learnt(adaptation, readings(identified, 100))) < 1.5 * NOISE
        assert adaptation.refused == 0

    def test_a_sensor_that_jumps_changes_nothing_for_however_long(self, identified, name):
        adaptation = model_filter(name, identified)
        found = readings(specimen(identified, gain=1.05), 100)
        learnt(adaptation, found[:40])
        model = adaptation.model
        learnt(adaptation, [(state, output + 0.3 * SPAN) for state, output in found[40:80]])
        assert adaptation.model is model
        assert adaptation.refused >= 36
        assert rms(learnt(adaptation, found[80:])) < 3.0 * NOISE

    def test_a_first_reading_that_is_wrong_is_got_over(self, identified, name):
        adaptation = model_filter(name, identified)
        found = readings(specimen(identified, gain=1.05), 70)
        learnt(adaptation, [(state, output + 0.25 * SPAN) for state, output in found[:1]])
        assert rms(learnt(adaptation, found[1:])[50:]) < 5.0 * NOISE

    def test_estimates_are_bounded_whatever_is_read(self, identified, name):
        rng = np.random.default_rng(3)
        adaptation = model_filter(name, identified)
        for state, _ in readings(identified, 60):
            adaptation.update(state, float(rng.uniform(-3.0, 3.0) * SPAN))
        inputs = rng.uniform(-1.0, 11.0, 100)
        moved = adaptation.model.evaluate(inputs) - identified.evaluate(inputs)
        assert np.isfinite(moved).all()
        assert np.abs(moved).max() < 0.8 * SPAN
        assert (adaptation.model.density >= 0.0).all()

    @cases("seed", [0, 7, 8])
    def test_readings_that_err_ten_times_as_much_as_expected_hardly_move_the_model(self, identified, name, seed):
        rng = np.random.default_rng(7)
        adaptation = model_filter(name, identified)
        found = readings(identified, 100, seed)
        learnt(adaptation, [(state, output + 0.05 * SPAN * rng.normal()) for state, output in found])
        moved = [adaptation.model.value(state) - identified.value(state) for state, _ in found]
        assert rms(moved) < 0.015 * SPAN
        assert adaptation.refused < 20

    def test_readings_that_are_missing_or_next_to_the_last_are_not_taken(self, identified, name):
        adaptation = model_filter(name, identified)
        state = identified.initial_state().step(5.0)
        assert not adaptation.update(state, np.nan)
        assert adaptation.update(state, identified.value(state))
        assert not adaptation.update(state.step(5.001), identified.value(state))
        assert adaptation.taken == 1

    def test_an_open_loop_learns_at_its_targets(self, identified, name):
        plant = specimen(identified, width=1.3, gain=1.05)
        errors = {}
        for adapts in (False, True):
            adaptation = model_filter(name, identified) if adapts else None
            controller = OpenLoopInverse(identified.inverse(), wait=1.0, adaptation=adaptation)
            errors[adapts] = self.tracked(controller, plant)
            assert controller.adaptation is adaptation
        assert errors[True] < 0.3 * errors[False]

    def test_a_closed_loop_that_learns_keeps_its_estimate_of_the_output(self, identified, name):
        plant = specimen(identified, width=1.3, gain=1.05)
        controller = ClosedLoopInverse(identified.inverse(), adaptation=model_filter(name, identified))
        assert self.tracked(controller, plant) < 1.0
        assert controller.trace.uncertainty > 0.0

    @staticmethod
    def tracked(controller, plant):
        """Return the RMS error of the last of some targets, with an actuator that follows at once."""
        rng = np.random.default_rng(5)
        state, t, errors = plant.saturated_state(-1, -2.0), 0.0, []
        for target in rng.uniform(-60.0, 70.0, 60).tolist():
            command = controller.aim(target, t, state.input, plant.value(state))
            while not command.done:
                state, t = state.step(command.setpoint), t + command.wait
                command = controller.update(t, state.input, plant.value(state))
            errors.append(plant.value(state) - target)
        return rms(errors[40:])


@pytest.mark.parametrize("name", ["session", "density"])
def test_other_units_of_the_output_change_nothing_but_the_units(identified, name):
    """A model in nm and one in km learn the same."""
    areas = np.ones(identified.coefficients.size)
    areas[:40:3] = -0.3
    plain = identified.with_coefficients(areas * identified.coefficients, identified.bias)
    found = [
        (state, output + 60.0 * (number in (20, 21)))
        for number, (state, output) in enumerate(readings(specimen(plain, **PERTURBED["all"]), 30))
    ]
    courses = []
    for unit in (1.0, 2.0**-30, 2.0**30):
        adaptation = model_filter(name, plain.with_coefficients(unit * plain.coefficients, unit * plain.bias))
        course = []
        for state, output in found:
            changed = adaptation.update(state, unit * output)
            value = adaptation.model.value(adaptation.model.shifted(0.0).initial_state()) / unit
            course.append([changed, adaptation.taken, adaptation.refused, adaptation.uncertainty / unit, value])
        courses.append(np.array(course))
    assert courses[0][-1][1] > 24
    for course in courses[1:]:
        assert course == pytest.approx(courses[0], rel=1e-6, nan_ok=True)


def test_refusals_that_lie_far_apart_do_not_begin_it_anew(identified):
    adaptation = SessionFilter(identified)
    moved = specimen(identified, offset=25.0)
    learnt(adaptation, readings(moved, 40))
    for k, (state, output) in enumerate(readings(moved, 60, seed=1)):
        adaptation.update(state, identified.value(state) if k % 30 < 5 else output)
    assert adaptation.refused >= 8
    assert adaptation.restarts == 0
    assert adaptation.estimates()["offset"].value == pytest.approx(25.0, abs=3.0)


def test_the_mass_of_a_density_is_given_in_parts_of_the_identified_one(identified):
    adaptation = DensityFilter(identified)
    mass = adaptation.estimates()["mass"]
    assert mass.value == pytest.approx(1.0)
    assert 0.05 < mass.uncertainty < 0.3
    learnt(adaptation, readings(specimen(identified, gain=1.1), 100))
    mass = adaptation.estimates()["mass"]
    assert abs(mass.value - 1.1) < 3.0 * mass.uncertainty < 0.15


def test_the_session_is_found_within_its_uncertainty(identified):
    adaptation = SessionFilter(identified)
    learnt(adaptation, readings(specimen(identified, **PERTURBED["all"]), 100))
    truth = dict(zip(("offset", "gain", "input-offset", "width"), (-6.0, 0.93, -0.15, 0.85), strict=True))
    for name, estimate in adaptation.estimates().items():
        assert abs(estimate.value - truth[name]) < 4.0 * estimate.uncertainty, name
    assert f"{adaptation.taken} readings" in adaptation.summary()


def test_other_models_learn_offset_and_gain():
    operator = PrandtlIshlinskii([0.0, 0.5, 1.0, 2.0], [1.0, 0.7, 0.4, 0.2], 0.0, input_range=(-5.0, 5.0))
    plant = operator.with_coefficients(1.2 * operator.coefficients, 0.8)
    adaptation = SessionFilter(operator)
    rng, state = np.random.default_rng(0), operator.initial_state()
    for value in rng.uniform(-5.0, 5.0, 60).tolist():
        state, output = plant.step(state, value)
        adaptation.update(state, output)
    found = adaptation.estimates()
    assert list(found) == ["offset", "gain"]
    assert found["gain"].value == pytest.approx(1.2, abs=0.01)


def test_a_density_that_falls_stays_without_positive_values(identified):
    falling = replace(identified, density=-identified.density)
    adaptation = DensityFilter(falling)
    learnt(adaptation, readings(specimen(falling, gain=1.1), 60))
    assert (adaptation.model.density <= 0.0).all()


@cases(
    ("name", "operator", "words"),
    [
        ("session", Polynomial([0.0, 1.0], (0.0, 1.0)), "memory"),
        ("density", PrandtlIshlinskii([0.0, 0.5], [1.0, 0.7], 0.0, input_range=(-5.0, 5.0)), "Preisach"),
    ],
)
def test_a_model_that_cannot_be_adapted_is_refused(name, operator, words):
    with pytest.raises(ValueError, match=words):
        model_filter(name, operator)
    assert model_filter("off", operator) is None
