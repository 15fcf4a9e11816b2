"""Choice among models: the true structure is found, the rule of one standard error holds, and nothing is left out."""

from dataclasses import replace

import numpy as np
import pytest
from hysteretic_plants import bouc_wen, butterfly, duhem, jiles_atherton, random_reversals, settled, through

from bench.identification import (
    Candidate,
    Evaluation,
    Given,
    HeldOutInTime,
    Measurements,
    identify_in_time,
    select,
    set_up_problem,
)
from bench.identification.choose.evaluation import evaluate
from bench.identification.choose.near_best import (
    best_memory,
    best_of_few_rows,
    best_of_one_kind,
    best_smoothing,
    is_within_one_standard_error,
    simplest_near_best,
)
from bench.models import (
    LinearPart,
    ModelSpec,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    registered_models as models,
    uniform_levels,
)

INPUTS = random_reversals(np.random.default_rng(1), 400, 30)
NAMES = ("polynomial", "polynomial-plays", "prandtl-ishlinskii")


def noisy(outputs, part=0.005, seed=2):
    return outputs + part * np.ptp(outputs) * np.random.default_rng(seed).standard_normal(outputs.size)


def evaluation(blocks, units=(), free=1.0, smoothing=0.0):
    return Evaluation(Candidate("preisach", smoothing=smoothing), blocks=tuple(blocks), units=tuple(units), free=free)


class TestTheRuleOfOneStandardError:
    def test_differences_count_fold_by_fold(self):
        best = evaluation([1.0, 4.0, 9.0, 16.0, 25.0])
        # Worse by as much in every fold: certain, though far below the scatter of the folds.
        assert not is_within_one_standard_error(evaluation(np.array(best.blocks) * 1.06), best)
        # As much worse on average, by chance.
        uneven = np.add(best.blocks, [3.0, -3.0, 3.0, -3.0, 2.0])
        assert is_within_one_standard_error(evaluation(uneven), best)

    def test_two_percent_are_no_difference_and_more_than_five_are_never_taken(self):
        best = evaluation([1.0] * 5)
        assert is_within_one_standard_error(evaluation([1.01**2] * 5), best)
        assert not is_within_one_standard_error(evaluation([1.04**2] * 5), best)
        # Within one standard error, but too much.
        assert not is_within_one_standard_error(evaluation([3.0, 0.2, 2.5, 0.1, 0.8]), best)

    def test_of_models_about_as_simple_the_least_error_decides(self):
        alike = [
            evaluation([1.0] * 5, free=11.0),
            evaluation([1.01] * 5, free=10.3),
            evaluation([1.02] * 5, free=9.0),
        ]
        assert simplest_near_best(alike) == (alike[0], alike[0])
        clear = [*alike, evaluation([1.03] * 5, free=5.0)]
        assert simplest_near_best(clear) == (alike[0], clear[3])
        # What left nothing but noise is compared by its fit.
        free = replace(clear[0].candidate, orientation="auto")
        adequate = [replace(clear[0], candidate=free, akaike=-5.0, uncorrelated=True), *clear[1:3]]
        adequate.append(replace(clear[3], akaike=0.0))
        assert simplest_near_best(adequate)[1] is adequate[0]
        weak = [replace(adequate[0], akaike=-3.0), *adequate[1:]]
        assert simplest_near_best(weak)[1] is weak[3]

    def test_of_few_rows_the_least_error_of_those_that_the_fit_supports_is_taken(self):
        three = [
            replace(evaluation([square] * 5), akaike=criterion)
            for square, criterion in ((1.0, 7.1), (1.5, 6.9), (2.0, 0.0))
        ]
        assert best_of_few_rows(three) is three[1]
        many = [replace(each, akaike=float("inf")) for each in three]
        assert best_of_few_rows(many) is many[0]

    def test_of_one_kind_of_cycle_what_leaves_only_noise_is_chosen_and_the_best_if_nothing_does(self):
        def fitted(square, free, adequate=True):
            return replace(evaluation([square] * 5, free=free), uncorrelated=adequate)

        rough, fine, coarse = fitted(1.0, 5.0, False), fitted(1.01, 20.0), fitted(1.3, 4.0)
        assert best_of_one_kind([rough, fine, coarse], []) == (rough, fine)
        equation = fitted(0.9, 5.0)
        assert best_of_one_kind([rough, fine], [equation]) == (equation, equation)
        # So little error of so many coefficients that nothing bounds may be chance.
        many = fitted(0.9, 6.0)
        assert best_of_one_kind([rough, fine], [many]) == (rough, fine)
        correlated = fitted(0.9, 5.0, False)
        assert best_of_one_kind([rough], [correlated]) == (correlated, rough)

    def test_units_left_out_count_as_much_as_blocks(self):
        best = evaluation([1.0] * 5, [1.0] * 5)
        assert not is_within_one_standard_error(evaluation([1.0] * 5, [1.3] * 5), best)

    def test_the_smoothest_of_equal_errors_is_taken(self):
        tries = [evaluation([square] * 5, smoothing=weight) for weight, square in ((0, 1.0), (0.1, 1.03), (1, 1.1))]
        assert best_smoothing(tries).candidate.smoothing == 0.1


class TestTheTrueStructureIsFound:
    def test_a_polynomial_is_not_given_a_memory(self):
        found = select(Measurements.of(INPUTS, noisy(INPUTS**3 - 0.4 * INPUTS)), NAMES).chosen.candidate
        assert (found.model, found.options["degree"]) == ("polynomial", 3)

    def test_plays_are_plays(self):
        truth = PrandtlIshlinskii(np.arange(5) / 5.0, [0.5, 0.3, 0.6, 0.2, 0.4])
        found = select(Measurements.of(INPUTS, noisy(truth.evaluate(INPUTS))), NAMES)
        assert found.chosen.candidate.model == "prandtl-ishlinskii"
        assert found.chosen.candidate.options["plays"] == 5
        assert found.chosen.candidate.orientation == "rising"

    @pytest.mark.parametrize("sign", [1, -1])
    def test_a_density_is_a_density_and_its_orientation_is_found(self, sign):
        levels = uniform_levels(-1.0, 1.0, 10)
        density = np.random.default_rng(5).exponential(1.0, 55) * (np.random.default_rng(6).random(55) < 0.4)
        truth = Preisach(levels, density)
        given = Given({"levels": 10}, smoothing=0.0)
        measured = Measurements.of(INPUTS, sign * noisy(truth.evaluate(INPUTS)))
        found = select(measured, (*NAMES, "preisach"), given)
        assert found.chosen.candidate.model == "preisach"
        assert found.chosen.candidate.options["reversible"] == "none"
        assert found.chosen.candidate.orientation == ("rising" if sign > 0 else "falling")
        # The error left out is that of the noise.
        assert found.chosen.rms < 1.6 * 0.005 * np.ptp(measured.outputs)

    def test_a_first_part_from_another_memory_is_left_out_or_known(self):
        truth = Preisach(uniform_levels(-1.0, 1.0, 10), np.ones(55))
        path = np.concatenate([[1.0, -0.2], 0.1 * np.arange(-2, 11), INPUTS])
        outputs = noisy(truth.evaluate(path, truth.saturated_state(1)))[1:]
        found = select(Measurements.of(path[1:], outputs), ("preisach",), Given({"levels": 10, "reversible": "none"}))
        assert found.chosen.candidate.initial in ("positive", "estimate", "skip")


def test_settings_that_are_given_are_kept():
    given = Given({"plays": 7}, initial="positive", orientation="falling", smoothing=0.25)
    found = select(Measurements.of(INPUTS, -duhem(INPUTS)), ("prandtl-ishlinskii",), given)
    for each in found.evaluations:
        one = each.candidate
        assert (one.options["plays"], one.initial, one.orientation) == (7, "positive", "falling")


def test_a_polynomial_with_a_few_plays_bounds_the_error_of_few_samples():
    inputs = random_reversals(np.random.default_rng(0), 60, 8)
    measured = Measurements.of(inputs, noisy(settled(duhem, inputs), 0.01))
    found = select(measured, (*NAMES, "preisach"))
    plays = evaluate(measured, [Candidate("polynomial-plays", {"degree": 3, "plays": 3}, "auto")])[0]
    assert found.chosen.rms <= 1.5 * plays.rms


def test_one_kind_of_cycle_is_warned_of():
    inputs = np.tile(np.append(np.linspace(0, 1, 20), np.linspace(1, 0, 20)), 8)
    found = select(Measurements.of(inputs, noisy(inputs)), ("polynomial",))
    assert not found.chosen.units
    assert any("amplitude" in text for text in found.warnings())
    ratio = replace(found, chosen=evaluation([1.0] * 5, [16.0] * 5))
    assert any("4.0 times" in text for text in ratio.warnings())


@pytest.mark.slow
def test_of_one_kind_of_cycle_a_model_is_chosen_that_the_record_determines():
    turns = np.array([0.0, *[1.0, -1.0] * 8])
    inputs = np.interp(np.arange(17 * 15 - 14), np.arange(17) * 15, turns)
    measured = Measurements.of(inputs, noisy(settled(duhem, inputs), 0.01))
    found = select(measured, ("preisach", "generalized-prandtl-ishlinskii"), Given({"levels": 10}))
    assert found.has_one_kind
    assert found.chosen.candidate.model == "generalized-prandtl-ishlinskii"
    planes = [each for each in found.evaluations if each.candidate.model == "preisach" and len(each.blocks) == 5]
    assert min(each.rms for each in planes) < found.chosen.rms
    assert not any(each.determined for each in planes if each.rms < 1.5 * found.chosen.rms)


def test_of_one_kind_of_cycle_an_equation_that_runs_away_on_smaller_ones_is_never_chosen():
    """Not even if it is the only model that the record determines, as of a sine with little noise."""
    radii = np.linspace(0.0, 0.7, 60)
    weights = np.exp(-radii / 0.2)
    states, outputs = np.zeros(60), []
    inputs = -np.cos(np.linspace(0.0, 16.0 * np.pi, 1000))
    for value in inputs:
        low, high = np.tanh(1.2 * value - 0.2) - radii, np.tanh(value + 0.15) + radii
        states = np.maximum(low, np.minimum(high, states))
        outputs.append(weights @ states)
    measured = Measurements.of(inputs, noisy(np.array(outputs), 0.001))
    found = select(measured, ("preisach", "duhem"), Given({"levels": 20, "degree": 7}))
    assert found.has_one_kind
    equation = next(each for each in found.evaluations if each.candidate.model == "duhem" and not each.follows)
    assert equation.determined
    assert equation.rms < 1.5 * found.chosen.rms
    assert found.chosen.candidate.model == "preisach"


@pytest.mark.seeds
def test_of_one_kind_of_cycle_a_differential_equation_is_chosen_that_leaves_no_more_than_noise():
    inputs = through([0.0, *[1.0, -1.0] * 6], 1000)
    measured = Measurements.of(inputs, noisy(settled(bouc_wen, inputs), 0.01))
    # Sampled turning points do not all reach the ends.
    assert 0 < measured.known < 200
    found = select(measured, ("maxwell-slip", "bouc-wen"))
    assert found.has_one_kind
    assert found.chosen.candidate.model == "bouc-wen"


def test_one_rate_is_warned_of():
    slow = random_reversals(np.random.default_rng(0), 200, 12)
    inputs = np.append(slow, slow[-1] * (1 - slow[::10]))
    measured, one = Measurements.of(inputs, noisy(duhem(inputs))), Measurements.of(slow, noisy(duhem(slow)))
    assert HeldOutInTime(one, 0.1 * np.arange(slow.size), slow.size).has_one_rate()
    assert not HeldOutInTime(measured, 0.1 * np.arange(inputs.size), inputs.size).has_one_rate()
    found = select(one, ("polynomial",), in_time=HeldOutInTime(one, 0.1 * np.arange(slow.size), slow.size))
    assert any("one speed" in text for text in found.warnings())


@pytest.mark.seeds
def test_at_one_rate_a_lag_is_not_taken_for_hysteresis():
    rng = np.random.default_rng(1)
    inputs = random_reversals(rng, 600, 25)
    times = np.arange(600) / 960.0
    lag = LinearPart(0.0, (1e-3, 0.0), np.empty(0), np.empty(0))
    outputs = lag.respond(times, settled(jiles_atherton, inputs)[:, None])[0][:, 0]
    outputs = outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(600)
    measured = Measurements.of(inputs, outputs)
    in_time = HeldOutInTime(measured, times, 600)
    assert in_time.has_one_rate()
    found = select(measured, ("duhem", "generalized-prandtl-ishlinskii"), in_time=in_time)
    # A differential equation does as well without time, at this rate.
    assert found.evaluations[0].candidate.model == "duhem"
    assert found.chosen.candidate.model == "hammerstein"
    assert found.chosen.candidate.options["dynamics"] == "lag"


def mixed(plant, seed, rows=1500, turns=40):
    """Return a record of random reversals with 1 % noise, and another sequence with the true outputs."""
    rng = np.random.default_rng(seed)
    others, inputs = random_reversals(rng, rows, 3 * turns // 2), random_reversals(rng, rows, turns)
    outputs = plant(inputs)
    return inputs, outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(rows), others, settled(plant, others)


def error(inputs, outputs, others, truth, one):
    """Return the RMS error of a candidate on another sequence, % of the range, from where its memory is known."""
    known = Measurements.of(inputs, outputs).known if one.initial == "skip" else 0
    problem = set_up_problem(one.model, inputs, outputs, None, known, 0.0, one.initial, dict(one.options))
    found = problem.fit(0.0)
    predicted = problem.template.with_coefficients(found.coefficients, found.bias).evaluate(others)
    wrong = (truth - predicted)[Measurements.of(others, truth).known :]
    return 100.0 * float(np.sqrt(np.mean(wrong**2)) / np.ptp(truth))


class TestInitialMemory:
    def test_of_equations_that_do_not_saturate_the_first_rows_are_rather_left_out(self):
        """No word is their memory: wrong by less than the noise, it bends them."""
        record = mixed(lambda inputs: settled(duhem, inputs), 3)
        measured = Measurements.of(*record[:2])
        found = select(measured, ("duhem",))
        assert found.chosen.candidate.initial == "skip"
        kept = replace(found.chosen.candidate, initial=None)
        (with_first,) = evaluate(measured, [kept])
        assert with_first.rms < 1.02 * found.chosen.rms
        assert error(*record, found.chosen.candidate) < 0.5 * error(*record, kept)

    def test_of_one_kind_of_cycle_they_are_left_out_only_if_that_gains(self):
        inputs = through([0.0, *[1.0, -1.0] * 10], 1500)
        outputs = settled(duhem, inputs)
        outputs += 0.01 * np.ptp(outputs) * np.random.default_rng(1).standard_normal(1500)
        measured = Measurements.of(inputs, outputs)
        found = select(measured, ("duhem",))
        assert found.has_one_kind
        assert found.chosen.candidate.initial is None
        (left_out,) = evaluate(measured, [replace(found.chosen.candidate, initial="skip")])
        assert left_out.rms < 1.02 * found.chosen.rms

    def test_first_rows_that_alone_reach_an_end_are_left_out_of_a_shape_where_that_gains(self):
        """A virgin specimen begins with a memory that no word is."""
        record = mixed(bouc_wen, 3, 600, 20)
        measured = Measurements.of(*record[:2])
        assert not measured.covers_its_range()
        found = select(measured, ("bouc-wen",))
        assert found.chosen.candidate.initial == "skip"
        assert error(*record, found.chosen.candidate) < 0.3 * error(
            *record, replace(found.chosen.candidate, initial=None)
        )

    def test_what_leaves_out_first_rows_may_have_to_gain(self):
        memories = (None, 1.0), ("positive", 1.2), ("skip", 0.95)
        tries = [
            replace(evaluation([rms**2] * 5), candidate=Candidate("bouc-wen", initial=memory))
            for memory, rms in memories
        ]
        assert best_memory(tries).candidate.initial == "skip"
        assert best_memory(tries, skip_gains=1.1).candidate.initial is None
        assert best_memory(tries[1:], skip_gains=1.1).candidate.initial == "skip"
        assert best_memory([tries[2]], skip_gains=1.1).candidate.initial == "skip"
        alike = [replace(tries[0], start=0.1), replace(tries[2], blocks=tries[0].blocks, start=3.0)]
        assert best_memory(alike).candidate.initial is None
        for rms, expected in ((1.0, "skip"), (1.01, "skip"), (1.03, None)):
            little_more = replace(alike[1], blocks=(rms**2,) * 5)
            assert best_memory([alike[0], little_more], prefers_skip=True).candidate.initial == expected

    def test_of_many_rows_a_quarter_is_enough_to_test_by(self):
        """Minor loops overwrite what came before late."""
        first, then = np.linspace(-0.4, 0.4, 500), through([0.4, -1.0, 1.0, -0.5, 0.6, -0.3, 0.5, -0.4], 800)
        late = np.append(first, then)
        assert 800 <= Measurements.of(late, late).known <= 820
        assert Measurements.of(late[::10], late[::10]).known == 0


def test_times_that_were_not_asked_for_must_gain():
    """At one rate plays do nearly as well without a lag; asked for, the lag is taken all the same."""
    inputs = random_reversals(np.random.default_rng(1), 300, 10)
    times = np.arange(inputs.size) / 1500.0
    lag = LinearPart(0.0, (1e-3, 0.0), np.empty(0), np.empty(0))
    fixed = {"plays": 10, "dead_zones": 0}

    def found(times, is_asked):
        outputs = lag.respond(times, settled(duhem, inputs)[:, None])[0][:, 0]
        measured = Measurements.of(inputs, noisy(outputs, 0.01))
        in_time = HeldOutInTime(measured, times, inputs.size)
        return select(measured, ("prandtl-ishlinskii",), Given(fixed, is_time_asked=is_asked), in_time=in_time)

    asked, unasked = found(times, True), found(times, False)
    assert asked.chosen.candidate.static is not None
    assert unasked.chosen.candidate.static is None
    assert unasked.chosen.rms < 1.2 * asked.chosen.rms
    # They took part all the same.
    assert asked.chosen.candidate in [each.candidate for each in unasked.evaluations]
    assert any("one speed" in text for text in unasked.warnings())
    half = inputs.size // 2
    at_two_rates = np.append(times[:half], times[half] + 0.2 * (times[half:] - times[half]))
    assert found(at_two_rates, False).chosen.candidate.static is not None


def with_a_drift(plant, seed, part, rows=1500):
    """Return a record whose outputs drift by a part of their range, and what evaluates models with time."""
    inputs, outputs, _, _ = mixed(lambda path: settled(plant, path), seed, rows)
    drift = part * np.ptp(settled(plant, inputs)) * np.linspace(0.0, 1.0, inputs.size)
    measured = Measurements.of(inputs, outputs + drift)
    return measured, HeldOutInTime(measured, 0.01 * np.arange(inputs.size), inputs.size)


def test_a_drift_is_taken_unasked_where_the_errors_show_it():
    """Unlike a lag it is no hysteresis; of less than a fifth of the error, too."""
    plant = PrandtlIshlinskii(np.arange(5) / 5.0, [0.5, 0.3, 0.6, 0.2, 0.4])
    measured, in_time = with_a_drift(plant.evaluate, 1, 0.019, 600)
    model, fixed = "prandtl-ishlinskii", {"plays": 5, "dead_zones": 0}
    plain = select(measured, (model,), Given(fixed))
    found = select(measured, (model,), Given(fixed, is_time_asked=False), in_time=in_time)
    assert plain.trend is not None
    assert plain.trend.share > 0.15
    assert found.chosen.candidate.options == {"static": model, **fixed, "dynamics": "drift"}
    assert plain.chosen.rms / 1.2 < found.chosen.rms < 0.9 * plain.chosen.rms


def test_behind_a_lag_all_orders_of_an_equation_are_tried_without_first_rows():
    """A lag hides what memory the record begins with, and a higher order from there errs more than a lower one."""
    rng = np.random.default_rng(1)
    inputs = [random_reversals(rng, 1500, turns) for turns in (60, 40)][1]
    times = np.cumsum(np.where(np.arange(inputs.size) < 750, 1.0, 0.2)) / inputs.size
    lag = LinearPart(0.0, (1e-3, 0.0), np.empty(0), np.empty(0))
    outputs = lag.respond(times, settled(duhem, inputs)[:, None])[0][:, 0]
    measured = Measurements.of(inputs, outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(1500))
    found = select(measured, ("duhem",), in_time=HeldOutInTime(measured, times, inputs.size))
    timed = [each for each in found.evaluations if each.candidate.static]
    assert sorted(each.candidate.options["degree"] for each in timed) == [3, 5, 7]
    assert {each.candidate.initial for each in timed} == {"skip"}
    assert found.chosen.candidate.options["degree"] == 7


def test_of_few_rows_times_are_not_tried_unless_asked_for():
    inputs = random_reversals(np.random.default_rng(1), 60, 8)
    measured = Measurements.of(inputs, noisy(settled(duhem, inputs), 0.01))
    in_time = HeldOutInTime(measured, np.arange(60.0), 60)
    assert select(measured, ("duhem",), in_time=in_time).has_times
    assert not select(measured, ("duhem",), Given(is_time_asked=False), in_time=in_time).has_times


def test_a_drift_does_not_hide_an_equation_behind_a_finer_plane():
    """40 levels take the drift for hysteresis; with times the equation is tried as well."""
    measured, in_time = with_a_drift(bouc_wen, 2, 0.05)
    models = ("bouc-wen", "preisach")
    found = select(measured, models, Given({"levels": 40, "reversible": "linear"}, initial="skip"), in_time=in_time)
    plain = min((each for each in found.evaluations if each.candidate.static is None), key=lambda each: each.rms)
    assert plain.candidate.model == "preisach"
    assert found.chosen.candidate.options == {"static": "bouc-wen", "dynamics": "drift"}
    assert found.chosen.rms < 0.7 * plain.rms


def test_folds_that_are_all_harder_than_the_first_two_leave_a_model():
    inputs = through([-1.0, 1.0, 0.6, 0.9], 300)
    outputs = settled(butterfly, inputs)
    outputs = outputs + 0.002 * np.ptp(outputs) * np.random.default_rng(10).standard_normal(300)
    found = select(Measurements.of(inputs, outputs), ("bouc-wen", "preisach-signed", "duhem"))
    assert len(found.chosen.blocks) == 5


def with_a_lag(inputs, static):
    """Return outputs behind a lag at two rates, and what evaluates models with time."""
    times = np.cumsum(np.where(np.arange(inputs.size) < inputs.size // 2, 1.0, 0.1))
    lag = LinearPart(0.0, (1.0, 0.0), np.empty(0), np.empty(0))
    measured = Measurements.of(inputs, noisy(lag.respond(times, static[:, None])[0][:, 0]))
    return measured, HeldOutInTime(measured, times, inputs.size)


def test_behind_a_lag_it_is_found_too_that_the_memory_of_the_record_is_unknown():
    inputs = random_reversals(np.random.default_rng(5), 200, 12)
    measured, in_time = with_a_lag(inputs, bouc_wen(inputs))
    found = select(measured, ("bouc-wen",), in_time=in_time)
    static = [each for each in found.evaluations if each.candidate.static is None]
    assert min(static, key=lambda each: each.rms).candidate.initial is None
    assert found.chosen.candidate.initial == "skip"
    assert found.chosen.candidate.options == {"static": "bouc-wen", "dynamics": "lag"}
    kept = select(measured, ("prandtl-ishlinskii",), Given({"plays": 5}, initial="positive"), in_time=in_time)
    assert kept.chosen.candidate.static is not None
    assert {each.candidate.initial for each in kept.evaluations} == {"positive"}


def test_a_shape_and_what_follows_it_are_searched_to_the_end():
    """They stand for each other: an end too early left a larger model with a greater error."""
    inputs, outputs, _, _ = mixed(lambda path: settled(bouc_wen, path), 2, 750, 20)
    noise = outputs - settled(bouc_wen, inputs)
    half = inputs.size // 2
    times = np.cumsum(np.where(np.arange(inputs.size) < half, 1.0, 0.2)) / 1500.0
    lag = LinearPart(0.0, (1e-3, 0.0), np.empty(0), np.empty(0))
    outputs = lag.respond(times, settled(bouc_wen, inputs)[:, None])[0][:, 0] + noise
    errors = [
        identify_in_time("hammerstein", times, inputs, outputs, static="bouc-wen", dynamics=dynamics).errors.rms
        for dynamics in ("lag", "lag,delay")
    ]
    assert errors[1] <= 1.001 * errors[0]


def test_criteria_of_models_with_time_are_those_of_the_same_rows():
    inputs = random_reversals(np.random.default_rng(5), 300, 16)
    plays = PrandtlIshlinskii(np.arange(5) / 5.0, [0.5, 0.3, 0.6, 0.2, 0.4])
    _, in_time = with_a_lag(inputs, plays.evaluate(inputs))
    one = Candidate("prandtl-ishlinskii", {"plays": 5, "dead_zones": 0})
    (whole,), (without,) = (in_time.evaluate(replace(one, initial=memory), 2) for memory in (None, "skip"))
    assert whole.akaike == pytest.approx(without.akaike, abs=4.0)


def test_few_reversals_and_a_trend_of_the_errors_are_warned_of():
    rise = np.interp(np.arange(60), [0, 50, 59], [0.0, 1.0, 0.8])
    found = select(Measurements.of(rise, noisy(rise)), ("polynomial",))
    assert any("reverses only once" in text for text in found.warnings())
    still = select(Measurements.of(INPUTS, noisy(INPUTS)), ("polynomial",))
    assert not any("drift" in text or "reverses" in text for text in still.warnings())
    drifting = noisy(INPUTS) + np.linspace(0.0, 0.1, INPUTS.size)
    moved = select(Measurements.of(INPUTS, drifting), ("polynomial",))
    assert any("drift by 4.7 %" in text and "--time" in text for text in moved.warnings())
    assert moved.trend.change == pytest.approx(0.1, rel=0.15)


def test_a_model_of_another_package_takes_part_and_one_that_fails_says_so(monkeypatch):
    def template(inputs, *, order: int = 2):
        if order == 3:
            raise ValueError("order: not 3")
        return Polynomial(np.zeros(order), (float(inputs.min()), float(inputs.max())))

    def broken(inputs):
        raise ValueError("no such plant")

    foreign = {
        "foreign": ModelSpec("", Polynomial, template, constrained=False, variants={"order": (3, 2)}),
        "broken": ModelSpec("", Polynomial, broken),
    }
    known = models.identifiable_models
    monkeypatch.setattr(models, "identifiable_models", lambda: known() | foreign)
    found = select(Measurements.of(INPUTS, noisy(INPUTS**2)), ("broken", "foreign", "polynomial-plays"))
    assert found.chosen.candidate.model == "foreign"
    assert found.chosen.candidate.options == {"order": 2}
    assert {each.failure for each in found.evaluations if each.failure} == {"order: not 3", "no such plant"}
    with pytest.raises(ValueError, match="broken: no such plant"):
        select(Measurements.of(INPUTS, INPUTS), ("broken",))


def test_errors_left_out_are_those_of_fits_without_them():
    """Brute force: the normal equations of each fold, without the machinery."""
    measured = replace(Measurements.of(INPUTS, noisy(np.sin(2.0 * INPUTS))), gap=3)
    found = evaluate(measured, [Candidate("polynomial", {"degree": 4}, "auto")])[0]
    columns = np.vander(INPUTS, 5)
    expected = []
    for fold in measured.blocks():
        x = np.linalg.lstsq(columns[fold.trained], measured.outputs[fold.trained], rcond=None)[0]
        expected.append(np.mean((measured.outputs - columns @ x)[fold.tested] ** 2))
    np.testing.assert_allclose(found.blocks, expected, rtol=1e-8)


@pytest.mark.seeds
@pytest.mark.parametrize("plant", [duhem, jiles_atherton, butterfly])
@pytest.mark.parametrize("seed", [10, 11])
def test_penalties_of_all_rows_are_nearly_those_of_each_fold(plant, seed, capsys):
    rng = np.random.default_rng(seed)
    inputs = random_reversals(rng, 1500, 40)
    outputs = noisy(settled(plant, inputs), 0.01, seed)
    measured = Measurements.of(inputs, outputs)
    one = Candidate("preisach-signed", {"levels": 20, "reversible": "linear"}, "auto", "skip", None)
    found = evaluate(measured, [one])[0]
    problem = set_up_problem(
        one.model, inputs, outputs, None, measured.known, 0.0, one.initial, dict(one.options), orientation="auto"
    )
    errors = []
    for fold in measured.blocks():
        weights = fold.trained.astype(float)
        penalties = replace(problem, weights=weights).regularization(None, None)
        fit = problem.fit(penalties.smoothing, weights, ridge=penalties.ridge)
        rest = outputs - fit.bias - problem.regressor.product(fit.coefficients)
        errors.append(np.mean(rest[fold.tested] ** 2))
    ratio = np.sqrt(np.mean(errors) / np.mean(found.blocks))
    with capsys.disabled():
        print(
            f"\n{plant.__name__} {seed}: penalties of each fold, error {ratio:.3f} times that with those of all rows"
        )
    assert 0.85 <= ratio <= 1.15


def test_weights_of_plays_before_dead_zones_are_counted():
    plant = PrandtlIshlinskii([0.0, 0.2, 0.4], [1.0, 0.5, 0.5], input_range=(-1.0, 1.0))
    outputs = noisy(plant.evaluate(INPUTS))
    with_zones = Candidate("prandtl-ishlinskii", {"plays": 5, "dead_zones": 4})
    (found,) = evaluate(Measurements.of(INPUTS, outputs), [with_zones])
    problem = set_up_problem("prandtl-ishlinskii", INPUTS, outputs, None, 0, 0.0, None, dict(with_zones.options))
    plays = np.count_nonzero(problem.template.weights)
    assert plays > 1
    # A factor can be moved from the plays to the slopes.
    assert found.free == pytest.approx(5 + plays - 1, abs=0.5)


def test_plays_may_begin_at_negative_saturation():
    before = np.array([0.0, 1.0, -1.0])
    plant = PrandtlIshlinskii([0.0, 0.3, 0.6], [1.0, 0.5, 0.7], input_range=(-1.0, 1.0))
    inputs = through([0.2, -0.3, 0.5, -0.6, 1.0, -1.0, 0.4, -0.2, 0.8, -0.7], 300)
    outputs = plant.evaluate(np.append(before, inputs))[before.size :]
    found = select(Measurements.of(inputs, noisy(outputs)), ("prandtl-ishlinskii",))
    assert found.chosen.candidate.initial == "negative"


def test_what_is_left_out_still_drives_the_memory():
    truth = Preisach(uniform_levels(-1.0, 1.0, 4), np.ones(10))
    measured = Measurements.of(INPUTS, truth.evaluate(INPUTS))
    found = evaluate(measured, [Candidate("preisach", {"levels": 4})])[0]
    assert found.rms < 1e-9


def test_rows_between_do_not_change_the_memory():
    thin = Measurements.of(INPUTS, duhem(INPUTS)).thinned(150)
    assert thin.inputs.size < 220
    # Every row that is kept is one of the sequence, in its order.
    rows = np.searchsorted(np.arange(INPUTS.size), np.flatnonzero(np.isin(INPUTS, thin.inputs)))
    assert thin.inputs.tolist() == INPUTS[rows].tolist()
    truth = Preisach(uniform_levels(-1.0, 1.0, 10), np.random.default_rng(0).random(55))
    whole = truth.evaluate(INPUTS)
    np.testing.assert_allclose(truth.evaluate(thin.inputs), whole[rows], atol=0.01 * np.ptp(whole))
    assert thin.fitted.sum() == -(-INPUTS.size // 3)


def test_hopeless_candidates_are_given_up_after_two_folds():
    measured = Measurements.of(INPUTS, noisy(INPUTS**3))
    found = evaluate(measured, [Candidate("polynomial", {"degree": 1}, "auto")], hopeless=1e-3)[0]
    assert len(found.blocks) == 2
    assert not found.units
