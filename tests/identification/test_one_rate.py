"""At one rate, the time constant of a lag is that of the operator that fits best."""

import numpy as np
import pytest
from hysteretic_plants import duhem, jiles_atherton, random_reversals, settled

from bench.hysteresis import identifiable_models
from bench.identification.evaluation import Measurements
from bench.identification.near_best import simplest_near_best
from bench.identification.selection import select
from bench.timed import LinearPart, identify_in_time
from bench.timed.held_out import HeldOutInTime

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
    found = select(
        measured, ("preisach", "generalized-prandtl-ishlinskii"), in_time=HeldOutInTime(measured, times, inputs.size)
    )
    tried = with_time(found)
    assert "none" in [each.candidate.options.get("reversible") for each in tried]
    assert found.chosen is min(tried, key=lambda each: each.misfit)


def error(plant, seed, others, **options):
    """Return the RMS error at five times the rate, % of the range, of a model of one record."""
    times, inputs, outputs = record(plant, seed, 1500)
    fast, truth = respond(plant, others, STEP / 5.0)
    model = identify_in_time("hammerstein", times, inputs, outputs, **options).model
    wrong = (truth - model.evaluate(fast, others))[Measurements.of(others, truth).known :]
    return 100.0 * np.sqrt(np.mean(wrong**2)) / np.ptp(truth)


OTHERS = random_reversals(np.random.default_rng(100), 1500, 60)


def test_even_the_true_structure_does_not_know_its_lag_at_one_rate(capsys):
    skip = Measurements.of(*record(duhem, 1, 1500)[1:]).known
    errors = [
        error(duhem, seed, OTHERS, static="duhem", degree=7, dynamics="lag", initial="skip", skip=skip)
        for seed in range(1, 7)
    ]
    with capsys.disabled():
        print(f"\n{min(errors):.1f} to {max(errors):.1f} % of the range over {len(errors)} records")
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
                errors.append(error(plant, seed, OTHERS, **start, **one.options))
    first, second = (np.exp(np.mean(np.log(each))) for each in (by_fit, by_blocks))
    with capsys.disabled():
        print(f"\ngeometric means of {len(by_fit)}, % of the range: {first:.2f} by the fit, {second:.2f} by blocks")
    assert first < second
