"""Prediction bands: their coverage on plants of another structure."""

import json

import numpy as np
import pytest
from other_plants import STEP, measured, random_reversals

from bench.identification import Band, Candidate, calibrate_band, ramps, set_up_problem

PREISACH = ("preisach", {"levels": 20, "plane": (-1.0, 1.0), "reversible": "linear"})
PLAYS = ("prandtl-ishlinskii", {})


def calibrated(model, inputs, outputs, **options):
    name, given = model
    problem = set_up_problem(Candidate(name, given), inputs, outputs, skip=options.pop("skip", 0))
    found = problem.fit(0.0)
    return problem.template.with_coefficients(found.coefficients, found.bias), calibrate_band(problem, **options)


def coverage(model, band, inputs, outputs):
    return float((np.abs(outputs - model.evaluate(inputs)) <= band.half_width).mean())


@pytest.mark.parametrize(
    ("model", "plant"),
    [
        pytest.param(PREISACH, "bouc-wen", id="preisach-bouc-wen"),
        pytest.param(PLAYS, "duhem", id="plays-duhem"),
        pytest.param(PREISACH, "duhem", id="preisach-duhem", marks=pytest.mark.seeds),
        pytest.param(PLAYS, "bouc-wen", id="plays-bouc-wen", marks=pytest.mark.seeds),
    ],
)
@pytest.mark.slow
def test_nine_of_ten_are_covered_on_other_inputs_of_one_kind(plant, model):
    covered = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        inputs, others = random_reversals(rng), random_reversals(rng)
        found, band = calibrated(model, inputs, measured(plant, inputs, rng))
        outputs = measured(plant, others, rng)
        covered.append(coverage(found, band, others, outputs))
    assert 0.85 <= np.mean(covered) <= 0.95
    assert min(covered) >= 0.7


def test_independent_noise_on_a_line_gives_the_quantile_of_the_noise():
    rng = np.random.default_rng(0)
    inputs = rng.uniform(-1.0, 1.0, 4000)
    _, band = calibrated(("polynomial", {"degree": 1}), inputs, inputs + 0.1 * rng.normal(size=inputs.size))
    assert band.half_width == pytest.approx(0.1645, rel=0.04)
    assert band.held_out == pytest.approx(0.1, rel=0.03)


def test_scale_offset_and_sign_of_the_output_go_through():
    rng = np.random.default_rng(4)
    inputs = random_reversals(rng)
    outputs = measured("bouc-wen", inputs, rng)
    for model, factor, offset in ((PREISACH, 1024.0, 0.0), (PREISACH, -1.0, 0.0), (PLAYS, 1000.0, 7.0)):
        band = calibrated(model, inputs, outputs)[1]
        wider = calibrated(model, inputs, factor * outputs + offset)[1]
        assert wider.half_width == pytest.approx(abs(factor) * band.half_width, rel=1e-3)


def test_the_record_is_not_cut_and_skipped_rows_do_not_count():
    rng = np.random.default_rng(5)
    inputs = random_reversals(rng)
    outputs = measured("duhem", inputs, rng)
    strange = outputs.copy()
    strange[:100] = 1e3
    _, band = calibrated(PREISACH, inputs, outputs, skip=100)
    _, other = calibrated(PREISACH, inputs, strange, skip=100)
    assert other.to_json() == band.to_json()
    assert band.rows <= inputs.size - 100


def test_the_outermost_loop_is_left_out_of_the_scores():
    # Only the first two ramps leave the middle; all else is within it.
    rng = np.random.default_rng(6)
    inner = 0.3 * random_reversals(rng)
    inputs = np.concatenate([ramps([-1.0, 1.0, -0.3], STEP), inner])
    outputs = measured("duhem", inputs, rng)
    _, band = calibrated(PREISACH, inputs, outputs)
    assert band.rows < inputs.size
    assert band.held_out < 0.1 * np.ptp(outputs)


def test_few_samples_and_other_levels_are_refused():
    inputs = ramps([-1.0, 1.0, -0.5, 0.5, 0.0], 0.15)
    outputs = measured("bouc-wen", inputs, np.random.default_rng(7))
    with pytest.raises(ValueError, match="too few to leave blocks of them out"):
        calibrated(("polynomial", {"degree": 2}), inputs[:9], outputs[:9])
    for level in (0.0, 1.0):
        with pytest.raises(ValueError, match="level: expected a number between 0 and 1"):
            calibrated(("polynomial", {"degree": 1}), inputs, outputs, level=level)


def test_a_higher_level_is_wider():
    rng = np.random.default_rng(8)
    inputs = random_reversals(rng)
    outputs = measured("duhem", inputs, rng)
    widths = [calibrated(PLAYS, inputs, outputs, level=level)[1].half_width for level in (0.5, 0.9, 0.95)]
    assert widths == sorted(widths)
    assert widths[0] < widths[-1]


def test_what_is_written_is_read():
    band = Band(0.9, 0.1, 400, 40, 0.05)
    assert Band.from_json(json.loads(json.dumps(band.to_json()))) == band
    for key, value in (("level", 1.5), ("half_width", -1.0), ("rows", None)):
        with pytest.raises(ValueError, match="band"):
            Band.from_json({**band.to_json(), key: value})
