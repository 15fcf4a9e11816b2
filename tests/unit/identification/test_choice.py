"""The choice of a model: folds, scores, the rule, and what a record cannot decide."""

from dataclasses import replace

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st
from hysteretic_plants import PLANTS, damped, random_reversals, settled, through

from bench.identification import (
    Candidate,
    Given,
    Measurements,
    Score,
    choose,
    compared_models,
    evaluate,
    identify,
    ramps,
    select,
)
from bench.identification.choose.splits import block_folds, cycle_folds, has_one_kind, run_folds

FAST = ("polynomial", "polynomial-plays", "preisach")


def scored(model: str, error: float, freedom: float) -> Score:
    return Score(Candidate(model), blocks=(error**2,), freedom=freedom)


@given(st.integers(20, 200), st.integers(0, 3), st.integers(2, 5))
def test_every_row_is_tested_once_and_never_fitted_beside_its_block(rows, gap, folds):
    usable = np.random.default_rng(rows).uniform(size=rows) < 0.9
    made = block_folds(usable, folds=folds, blocks=2 * folds, gap=gap)
    np.testing.assert_array_equal(sum(fold.tested.astype(int) for fold in made), usable.astype(int))
    for fold in made:
        assert not (fold.trained & ~usable).any()
        tested = np.flatnonzero(fold.tested)
        distance = np.abs(np.flatnonzero(fold.trained)[:, None] - tested).min(axis=1, initial=rows)
        assert (distance > gap).all()


def test_kinds_of_cycles_are_left_out_whole_and_the_major_loop_stays():
    inputs = through([0.0, 1.0, -1.0, 0.5, -0.5, 0.5, -0.5, 0.2, -0.2, 0.2, -0.2, 1.0, -1.0], 600)
    usable = np.ones(inputs.size, dtype=bool)
    assert not has_one_kind(inputs, usable)
    for fold in cycle_folds(inputs, usable):
        assert np.ptp(inputs[fold.trained]) == pytest.approx(2.0, abs=0.05)
        assert np.ptp(inputs[fold.tested]) < 1.6
    major = through([0.0, *[1.0, -1.0] * 5], 400)
    assert has_one_kind(major, np.ones(major.size, dtype=bool))
    assert cycle_folds(major, np.ones(major.size, dtype=bool)) == ()


def test_of_several_runs_whole_ones_are_left_out():
    runs = np.repeat([1, 2, 3], 20)
    folds = run_folds(runs, np.ones(60, dtype=bool))
    assert [set(runs[fold.tested]) for fold in folds] == [{1}, {2}, {3}]
    assert all(not set(runs[fold.tested]) & set(runs[fold.trained]) for fold in folds)


@cases(
    ("scores", "one_kind", "expected"),
    [
        ([("preisach", 1.0, 20.0), ("polynomial", 1.5, 3.0)], False, "preisach"),
        ([("preisach", 1.0, 20.0), ("polynomial", 1.015, 3.0)], False, "polynomial"),
        ([("preisach", 1.1, 20.0), ("duhem", 1.0, 3.0)], False, "duhem"),
        ([("preisach", 1.1, 20.0), ("duhem", 1.0, 3.0)], True, "preisach"),
        ([("preisach", 2.1, 20.0), ("duhem", 1.0, 3.0)], True, "duhem"),
        ([("duhem", 2.0, 20.0), ("polynomial", 1.99, 30.0)], True, "duhem"),
    ],
)
def test_the_least_score_wins_and_of_ties_the_fewest_degrees_of_freedom(scores, one_kind, expected):
    assert choose([scored(*each) for each in scores], one_kind).candidate.model == expected


@cases("plant", ["duhem", "jiles-atherton"])
def test_the_choice_tries_nothing_twice_and_errs_less_than_a_cubic_with_plays_on_other_inputs(plant):
    rng = np.random.default_rng(5)
    respond = PLANTS[plant]
    inputs, others = random_reversals(rng, 200, 25), random_reversals(rng, 200, 25)
    outputs, truth = settled(respond, inputs), settled(respond, others)
    noisy = outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(outputs.size)
    selection = select(Measurements.of(inputs, noisy), FAST)
    found = selection.chosen.candidate
    tried = [repr(score.candidate) for score in selection.scores]
    assert len(set(tried)) == len(tried)

    def error(candidate):
        name, options = candidate.fitted
        model = identify(
            name, inputs, noisy, initial=candidate.initial, smoothing=candidate.smoothing, ridge=candidate.ridge,
            **options,
        ).model  # fmt: skip
        known = Measurements.of(others, truth).known
        return float(np.sqrt(np.mean((model.evaluate(others) - truth)[known:] ** 2))) / float(np.ptp(truth))

    assert error(found) < 0.03
    assert error(found) < 1.1 * error(Candidate("polynomial-plays", {"degree": 3, "plays": 3}))


def test_a_force_with_friction_and_viscosity_takes_the_velocity():
    """A damper of another structure: an equation of Dahl for the friction, and quadratic viscosity."""
    rng = np.random.default_rng(2)
    times = 0.01 * np.arange(400)
    inputs = np.sin(4.0 * times) * (0.4 + 0.6 * np.abs(np.sin(0.7 * times))) + 0.2 * np.sin(11.0 * times)
    speeds = np.gradient(inputs, times)
    friction = np.zeros(times.size)
    for row in range(1, times.size):
        move = inputs[row] - inputs[row - 1]
        friction[row] = friction[row - 1] + 30.0 * move * (1.0 - friction[row - 1] * np.sign(move))
    outputs = friction + 0.3 * speeds + 0.02 * speeds * np.abs(speeds) + 0.01 * rng.standard_normal(times.size)
    fitted = np.arange(times.size) < 270
    timed = Measurements.of(inputs, outputs, fitted, times)
    found, without = (select(each, ("polynomial-plays",)) for each in (timed, replace(timed, times=None)))
    assert {"viscous", "friction"} & set(found.chosen.candidate.dynamics.split(","))
    assert found.chosen.error < 0.6 * without.chosen.error


@cases(("turns", "known"), [([0.0, 1.0, -1.0, 0.1], 0), ([0.0, 1.0, -1.0, 1.0], 60), ([0.0, *[1.0, -1.0] * 2], 60)])
def test_rows_of_known_memory_are_tested_alone_if_they_go_through_the_range(turns, known):
    inputs = np.append(ramps(turns, 0.05), [2.0, -2.0])
    fitted = np.abs(inputs) <= 1.0
    measured = Measurements.of(inputs, 2.0 * inputs, fitted, np.arange(float(inputs.size)))
    assert measured.inputs.size == measured.times.size == fitted.sum() == measured.thinned(fitted.sum()).inputs.size
    assert measured.known == known


def test_after_each_dynamic_element_the_better_half_of_the_models_goes_on():
    rng = np.random.default_rng(2)
    times = 0.01 * np.arange(300)
    inputs = np.sin(4.0 * times) * (0.4 + 0.6 * np.abs(np.sin(0.7 * times))) + 0.2 * np.sin(11.0 * times)
    speeds = np.gradient(inputs, times)
    outputs = settled(PLANTS["bouc-wen"], inputs) + 0.3 * speeds + 0.1 * np.tanh(speeds / 2.0)
    measured = Measurements.of(inputs, outputs + 0.01 * rng.standard_normal(300), times=times)
    models = ("polynomial", "polynomial-plays", "prandtl-ishlinskii")
    best: dict[int, dict[str, float]] = {1: {}, 2: {}}
    for score in select(measured, models).scores:
        count = len(score.candidate.dynamics.split(",")) if score.candidate.dynamics else 0
        if count in best:
            best[count][score.candidate.model] = min(best[count].get(score.candidate.model, np.inf), score.error)
    assert set(best[1]) == set(models)
    assert set(best[2]) == set(sorted(models, key=lambda model: best[1][model])[:2])


def test_what_starts_from_the_parameters_that_were_found_scores_the_same():
    rng = np.random.default_rng(4)
    times = 0.01 * np.arange(300)
    inputs = random_reversals(rng, 300, 25)
    outputs = settled(PLANTS["bouc-wen"], inputs) + 0.1 * np.tanh(np.gradient(inputs, times) / 2.0)
    measured = Measurements.of(inputs, outputs + 0.01 * rng.standard_normal(300), times=times)
    for dynamics in ("", "friction"):
        (once,) = evaluate(measured, [Candidate("bouc-wen", dynamics=dynamics)])
        (again,) = evaluate(measured, [once.candidate], reshaped=True)
        assert len(once.candidate.shape) == 3
        assert set(once.candidate.parameters) == ({dynamics} if dynamics else set())
        assert again.error == pytest.approx(once.error, rel=1e-3)


def test_settings_that_are_given_are_kept():
    rng = np.random.default_rng(1)
    inputs = random_reversals(rng, 200, 20)
    outputs = settled(PLANTS["bouc-wen"], inputs) + 0.01 * rng.standard_normal(200)
    wanted = Given({"levels": 7, "plays": 4}, initial="positive", smoothing=0.05, ridge=0.003)
    for score in select(Measurements.of(inputs, outputs), FAST, wanted).scores:
        one = score.candidate
        assert one.options.get("levels", 7) == 7
        assert one.options.get("plays", 4) == 4
        assert one.initial == (None if one.model == "polynomial" else "positive")
        assert one.smoothing == (0.05 if one.model == "preisach" else 0.0)
        assert one.ridge == (0.0 if one.model == "preisach" else 0.003)


def test_what_fails_is_kept_with_its_reason_and_ends_nothing():
    inputs = ramps([0.0, 1.0, 0.0, 1.0], 0.1)
    measured = Measurements.of(inputs, 2.0 * inputs)
    broken, sound = evaluate(
        measured, [Candidate("polynomial", {"degree": 0}), Candidate("polynomial", {"degree": 1})]
    )
    assert "degree" in broken.failure
    assert sound.error < 1e-9
    with pytest.raises(ValueError, match="polynomial"):
        select(measured, ("polynomial",), Given({"degree": 0}))


def test_a_mistake_in_the_program_is_no_failure_of_a_candidate():
    inputs = ramps([0.0, 1.0, 0.0, 1.0], 0.1)
    with pytest.raises(TypeError):
        evaluate(Measurements.of(inputs, inputs), [Candidate("preisach", smoothing="much")])


@cases(
    ("inputs", "codes"),
    [
        (np.linspace(0.0, 1.0, 60), {"few-reversals", "one-run"}),
        (through([0.0, *[1.0, 0.0] * 6], 300), {"one-kind", "one-run"}),
        (damped(300, 15), {"one-run"}),
    ],
)
def test_what_the_record_cannot_decide_is_said(inputs, codes):
    outputs = inputs + 0.001 * np.random.default_rng(0).standard_normal(inputs.size)
    found = select(Measurements.of(inputs, outputs), ("polynomial",))
    assert {advice.code for advice in found.advice} == codes


def test_one_speed_is_said():
    inputs = random_reversals(np.random.default_rng(3), 200, 12)
    times = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(inputs)) + 1e-3)])
    found = select(Measurements.of(inputs, inputs**2, times=times), ("polynomial",))
    assert "one-rate" in {advice.code for advice in found.advice}


def test_models_of_one_input_are_compared_by_default():
    assert {"preisach", "polynomial-plays", "bouc-wen", "duhem", "polynomial"} == set(compared_models())


def test_of_many_rows_the_best_of_two_models_are_scored_on_all():
    inputs = random_reversals(np.random.default_rng(1), 2200, 40)
    outputs = settled(PLANTS["duhem"], inputs) + 0.01 * np.random.default_rng(2).standard_normal(2200)
    found = select(Measurements.of(inputs, outputs), ("polynomial", "polynomial-plays"))
    decided = [score for score in found.scores if score.rows > found.rows]
    assert found.rows <= 2000 < found.of
    assert {score.candidate.model for score in decided} == {"polynomial", "polynomial-plays"}
    assert {score.rows for score in decided} == {found.of}
    assert any(score is found.chosen for score in decided)


def test_a_response_that_rings_is_followed_by_a_resonance():
    times = 0.01 * np.arange(800)
    inputs = np.repeat(np.random.default_rng(5).uniform(-1.0, 1.0, 20), 40)
    position, speed, outputs = 0.0, 0.0, np.empty(800)
    for row, target in enumerate(inputs):
        for _ in range(50):
            speed += 2e-4 * (100.0 * (target - position) - 3.0 * speed)
            position += 2e-4 * speed
        outputs[row] = position
    found = select(Measurements.of(inputs, outputs, times=times), ("polynomial",))
    assert "resonance" in found.chosen.candidate.dynamics


def test_the_error_on_another_run_stands_beside_that_on_blocks():
    inputs = np.tile(damped(200, 10), 3)
    runs = np.repeat([1, 2, 3], 200)
    found = select(Measurements.of(inputs, (1.0 + 0.1 * runs) * inputs, runs=runs), ("polynomial",))
    assert found.on_runs > 1.2 * found.on_blocks > 0.0
    alone = select(Measurements.of(inputs, inputs), ("polynomial",))
    assert np.isnan(alone.on_runs)
