"""At one rate, the time constant of a lag is that of the operator that fits best."""

from itertools import pairwise

import numpy as np
import pytest
from hysteretic_plants import bouc_wen, duhem, jiles_atherton, random_reversals, settled, through

from bench.identification import Candidate, Given, HeldOutInTime, Measurements, identify_in_time, select
from bench.identification.choose.near_best import simplest_near_best
from bench.identification.choose.time_stage import is_smooth_plane
from bench.models import LinearPart, identifiable_models

STEP = 1.0 / 1500.0
LAG = LinearPart(0.0, (1e-3, 0.0), np.empty(0), np.empty(0))


def relays(inputs):
    """Return the mean of 4000 relays, with thresholds about 0 and widths that vary, and a line."""
    rng = np.random.default_rng(5)
    centres, widths = 0.35 * rng.standard_normal(4000), np.abs(0.25 * rng.standard_normal(4000)) + 0.02
    states, outputs = -np.ones(4000), np.empty(inputs.size)
    for row, value in enumerate(inputs):
        states = np.where(value >= centres + widths, 1.0, np.where(value <= centres - widths, -1.0, states))
        outputs[row] = states.mean() + 0.1 * value
    return outputs


def respond(plant, inputs, step):
    times = step * np.arange(inputs.size)
    return times, LAG.respond(times, settled(plant, inputs)[:, None])[0][:, 0]


def record(plant, seed, rows):
    """Return times, inputs and noisy outputs of a record of one rate."""
    rng = np.random.default_rng(seed)
    inputs = random_reversals(rng, rows, rows // 37)
    times, outputs = respond(plant, inputs, STEP)
    return times, inputs, outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(rows)


def with_time(found):
    return [each for each in found.evaluations if "static" in each.candidate.options and each.blocks]


def test_a_plane_without_a_reversible_part_is_tried_and_the_least_misfit_is_chosen():
    times, inputs, outputs = record(jiles_atherton, 3, 500)
    measured = Measurements.of(inputs, outputs)
    in_time = HeldOutInTime(measured, times, inputs.size)
    found = select(measured, ("preisach",), Given({"levels": 10}, orientation="rising"), in_time=in_time)
    tried = with_time(found)
    assert "none" in [each.candidate.options.get("reversible") for each in tried]
    assert found.chosen is min(tried, key=lambda each: each.misfit)
    assert found.chosen is not min(tried, key=lambda each: each.rms)


def error(plant, seed, others, **options):
    """Return the error of a model of one record at five times the rate, % of the range, and its time constant, s."""
    times, inputs, outputs = record(plant, seed, 1500)
    fast, truth = respond(plant, others, STEP / 5.0)
    model = identify_in_time("hammerstein", times, inputs, outputs, **options).model
    wrong = (truth - model.evaluate(fast, others))[Measurements.of(others, truth).known :]
    return 100.0 * np.sqrt(np.mean(wrong**2)) / np.ptp(truth), model.linear.lag[0]


OTHERS = random_reversals(np.random.default_rng(100), 1500, 60)


def test_even_the_true_structure_does_not_know_its_lag_at_one_rate(capsys):
    skip = Measurements.of(*record(duhem, 1, 1500)[1:]).known
    found = [
        error(duhem, seed, OTHERS, static="duhem", degree=7, dynamics="lag", initial="skip", skip=skip)
        for seed in range(1, 7)
    ]
    errors, lags = np.array(found).T
    with capsys.disabled():
        print(f"\n{min(errors):.1f} to {max(errors):.1f} % of the range over {errors.size} records")
        print(f"time constants {1e3 * min(lags):.2f} to {1e3 * max(lags):.2f} ms of {1e3 * LAG.lag[0]:g} ms")
    assert max(errors) > 3.0 * min(errors)


@pytest.mark.seeds
@pytest.mark.timeout(1200)
def test_the_least_misfit_errs_less_at_another_rate_than_the_least_error_left_out(capsys):
    by_fit, by_blocks = [], []
    for plant in (jiles_atherton, relays):
        for seed in range(3, 7):
            times, inputs, outputs = record(plant, seed, 1500)
            measured = Measurements.of(inputs, outputs)
            in_time = HeldOutInTime(measured, times, inputs.size)
            found = select(measured, tuple(identifiable_models()), in_time=in_time)
            if "static" not in found.chosen.candidate.options:
                continue
            for each, errors in ((found.chosen, by_fit), (simplest_near_best(with_time(found))[1], by_blocks)):
                one = each.candidate
                start = {"initial": one.initial, "skip": measured.known if one.initial == "skip" else 0}
                start |= {"orientation": one.orientation, "smoothing": one.smoothing or 0.0}
                errors.append(error(plant, seed, OTHERS, **start, **one.options)[0])
    first, second = (np.exp(np.mean(np.log(each))) for each in (by_fit, by_blocks))
    with capsys.disabled():
        print(f"\ngeometric means of {len(by_fit)}, % of the range: {first:.2f} by the fit, {second:.2f} by blocks")
    assert first < second


CYCLE = 0.028
"""Time of a cycle, s: 28 time constants of the lag."""
STEP_OF_CYCLES = CYCLE / 100.0
DRIFT = 0.02
"""Over the record, by the range."""


def major_loops(plant, seed, rows=3000, part=LAG, drift=DRIFT):
    """Return times, inputs and noisy outputs of cycles of the whole range, all at one rate, 100 rows each."""
    inputs = through([0.0, *[1.0, -1.0] * (rows // 100), 0.0], rows)
    times = STEP_OF_CYCLES * np.arange(rows)
    outputs = part.respond(times, settled(plant, inputs)[:, None])[0][:, 0]
    noise = 0.003 * np.random.default_rng(seed).standard_normal(rows)
    return times, inputs, outputs + np.ptp(outputs) * (noise + drift * times / times[-1])


def error_on_smaller_cycles(plant, times, inputs, outputs, one):
    """Return the standard deviation, % of the range, of the errors of a model with time on cycles that fade."""
    known = Measurements.of(inputs, outputs).known if one.initial == "skip" else 0
    model = identify_in_time(
        "hammerstein", times, inputs, outputs, initial=one.initial, skip=known, orientation=one.orientation,
        smoothing=one.smoothing or 0.0, **one.options,
    ).model  # fmt: skip
    ends = np.repeat(np.linspace(1.0, 0.1, 10), 2) * np.tile([1.0, -1.0], 10)
    smaller = np.concatenate([np.linspace(a, b, 50, endpoint=False) for a, b in pairwise([0.0, *ends])])
    moments = STEP_OF_CYCLES * np.arange(smaller.size)
    truth = LAG.respond(moments, settled(plant, smaller)[:, None])[0][:, 0]
    wrong = (truth - model.evaluate(moments, smaller))[100:]
    return 100.0 * np.std(wrong) / np.ptp(truth)


def choose_of_major_loops(plant, seed, models=None, given=None, **record_of):
    times, inputs, outputs = major_loops(plant, seed, **record_of)
    measured = Measurements.of(inputs, outputs)
    in_time = HeldOutInTime(measured, times, inputs.size)
    found = select(measured, models or tuple(identifiable_models()), given, in_time=in_time)
    assert found.has_one_kind
    assert found.has_one_rate
    return found, (times, inputs, outputs)


def test_of_one_kind_of_cycle_at_one_rate_a_smooth_plane_is_chosen():
    given = Given({"levels": 20}, orientation="rising", initial="skip")
    found, sequence = choose_of_major_loops(relays, 0, ("preisach",), given, rows=600)
    assert is_smooth_plane(found.chosen)
    assert found.chosen is not simplest_near_best(with_time(found))[1]
    assert "lag" in found.chosen.candidate.options["dynamics"]
    assert error_on_smaller_cycles(relays, *sequence, found.chosen.candidate) < 2.0


@pytest.mark.seeds
@pytest.mark.timeout(1200)
def test_a_smooth_plane_costs_little_on_smaller_cycles_beside_the_least_error_left_out(capsys):
    by_plane, by_blocks = [], []
    for plant in (bouc_wen, duhem, jiles_atherton, relays):
        for seed in (0, 1):
            found, sequence = choose_of_major_loops(plant, seed)
            if not is_smooth_plane(found.chosen):
                continue
            for each, errors in ((found.chosen, by_plane), (simplest_near_best(with_time(found))[1], by_blocks)):
                errors.append(error_on_smaller_cycles(plant, *sequence, each.candidate))
    first, second = (np.exp(np.mean(np.log(each))) for each in (by_plane, by_blocks))
    with capsys.disabled():
        print(
            f"\n{len(by_plane)} records, % of the range, geometric mean and worst: "
            f"{first:.2f}, {max(by_plane):.2f} by the smooth plane, {second:.2f}, {max(by_blocks):.2f} by blocks"
        )
    assert first < 1.1 * second
    assert max(by_plane) < 1.1 * max(by_blocks)


# A tenth of a move long.
_RATE = 2.0 * np.pi * 20.0 / CYCLE
RINGING = LinearPart(0.0, (2.0 * 0.05 / _RATE, _RATE**-2), np.empty(0), np.empty(0))


@pytest.mark.parametrize(
    ("plant", "operator", "part", "has_resonance"),
    [
        (duhem, Candidate("duhem", {"degree": 3}, "auto", "skip"), LAG, False),
        (bouc_wen, Candidate("bouc-wen", {}, "rising", "skip"), RINGING, True),
    ],
    ids=["lag", "ringing"],
)
def test_at_one_rate_a_resonance_rings_out_within_a_move(plant, operator, part, has_resonance):
    times, inputs, outputs = major_loops(plant, 0, 1000, part, drift=0.0)
    measured = Measurements.of(inputs, outputs)
    (found,) = HeldOutInTime(measured, times, inputs.size).evaluate(operator, 5)
    assert ("resonance" in found.candidate.options["dynamics"].split(",")) is has_resonance
