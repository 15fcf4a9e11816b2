"""Prediction bands of models with time: coverage on a plant of another structure, files and commands."""

import json

import numpy as np
import pytest
from cases import cases

from bench.identification import Band, calibrate_band_in_time, identify_in_time
from bench.models import Hammerstein, LinearPart, RateDependentPlays

COLUMNS = ("--time", "time", "--input", "voltage", "--output", "displacement")
STEP = 0.01
LAG = {"static": "prandtl-ishlinskii", "dynamics": "lag"}


def reversals(rng, count=60, rows=1500):
    """Times, s, and triangles between random turning points."""
    points = rng.uniform(-1.0, 1.0, count)
    points[1:3] = 1.0, -1.0
    return STEP * np.arange(rows), np.interp(np.arange(rows), np.linspace(0.0, rows - 1.0, count), points)


def lagging(times, inputs, rng):
    """Bouc-Wen's hysteresis behind a lag of 40 ms, by small steps, with 1 % noise."""
    fine = np.linspace(times[0], times[-1], 20 * (times.size - 1) + 1)
    moves = np.diff(np.interp(fine, times, inputs))
    h, output, found = 0.0, 0.0, [0.0]
    for k, move in enumerate(moves, 1):
        h += move * (1.0 - abs(h) * (1.0 + np.sign(move * h)))
        output += (fine[1] - fine[0]) / 0.04 * (inputs[k // 20] + 0.8 * h - output)
        if k % 20 == 0:
            found.append(output)
    return np.array(found) + 0.02 * rng.normal(size=times.size)


def calibrated(name, times, inputs, outputs, **options):
    found = identify_in_time(name, times, inputs, outputs, **options)
    return found, calibrate_band_in_time(found, times, inputs, outputs, **options)


@pytest.mark.parametrize(
    ("name", "options", "sequences"),
    [
        ("hammerstein", {**LAG, "plays": 8, "skip": 50}, 2),
        pytest.param("hammerstein", {"dynamics": "lag", "levels": 10, "skip": 50}, 8, marks=pytest.mark.seeds),
        pytest.param("rate-dependent-plays", {"time_constants": 1, "skip": 50}, 8, marks=pytest.mark.seeds),
    ],
)
@pytest.mark.slow
def test_nine_of_ten_are_covered_at_the_rates_of_the_calibration(name, options, sequences):
    covered = []
    for seed in range(sequences):
        rng = np.random.default_rng(seed)
        record, other = reversals(rng), reversals(rng)
        found, band = calibrated(name, *record, lagging(*record, rng), **options)
        residuals = lagging(*other, rng) - found.model.evaluate(*other, found.initial_state)
        covered.append(float((np.abs(residuals) <= band.half_width)[50:].mean()))
    assert 0.85 <= np.mean(covered) <= 0.96


def test_what_the_fit_chose_is_kept_without_a_block():
    rng = np.random.default_rng(0)
    times, inputs = reversals(rng, 14, 280)
    outputs = lagging(times, inputs, rng)
    free = {"static": "prandtl-ishlinskii", "plays": 5}
    found, band = calibrated("hammerstein", times, inputs, outputs, **free)
    again, same = calibrated("hammerstein", times, inputs, outputs, **free, **found.model.structure())
    np.testing.assert_allclose(again.residuals, found.residuals, atol=1e-3)
    assert same.half_width == pytest.approx(band.half_width, rel=0.05)


@cases("dynamics", ["none", "lag", "resonance,drift", "lag,delay,creep", "resonance,kelvin-voigt", "fading-drift"])
def test_a_hammerstein_model_knows_what_follows_its_operator(dynamics):
    rng = np.random.default_rng(0)
    names = dynamics.split(",")
    strengths = [0.1, 0.1] if "creep" in names else [0.1, 0.2] if "kelvin-voigt" in names else []
    lag = (0.01, 1e-4 if "resonance" in names else 0.0) if {"lag", "resonance"} & set(names) else (0.0, 0.0)
    part = LinearPart(0.02 if "delay" in names else 0.0, lag, [1.0, 10.0][: len(strengths)], strengths)
    times, inputs = reversals(rng, 10, 100)
    static = identify_in_time("hammerstein", times, inputs, inputs, static="polynomial", dynamics="none").model.static
    drift = 0.1 if "drift" in dynamics else 0.0
    model = Hammerstein(static, part, drift, 5.0 if "fading-drift" in names else 0.0)
    assert set(model.structure()["dynamics"].split(",")) == set(names)


def test_plays_know_how_many_time_constants_they_have():
    model = RateDependentPlays(np.arange(3.0), [0.0, 0.1, 0.2], np.ones(3), (0.0, 5.0))
    assert model.structure() == {"time_constants": 2}


def test_few_samples_and_levels_are_refused():
    rng = np.random.default_rng(0)
    times, inputs = reversals(rng, 6, 12)
    found = identify_in_time("hammerstein", times, inputs, inputs**3, **LAG, plays=3)
    with pytest.raises(ValueError, match="too few to leave blocks"):
        calibrate_band_in_time(found, times[:9], inputs[:9], inputs[:9] ** 3, **LAG, plays=3)
    with pytest.raises(ValueError, match="level: expected a number between 0 and 1"):
        calibrate_band_in_time(found, times, inputs, inputs**3, **LAG, plays=3, level=1.0)


def test_commands_write_the_band_and_judge_the_rate(bench, tmp_path):
    rng = np.random.default_rng(0)
    times, inputs = reversals(rng, 40, 800)
    data, faster, model = tmp_path / "data.csv", tmp_path / "faster.csv", tmp_path / "model.json"
    head = "time [s],voltage [V],displacement [µm]"
    for path, clock in ((data, times), (faster, times / 3.0)):
        rows = np.column_stack([clock, inputs, lagging(clock, inputs, rng)])
        np.savetxt(path, rows, delimiter=",", header=head, comments="", encoding="utf-8")
    options = ("--model", "hammerstein", "-o", "static=prandtl-ishlinskii", "-o", "dynamics=lag", "--skip", 50)
    card = tmp_path / "card.md"
    arguments = (*COLUMNS, *options, "--band", "--out", model, "--card", card, "--json", tmp_path / "fit.json")
    code, out, text = bench("identify", data, *arguments)
    assert code == 0, text
    assert "90 % band" in out
    assert "90 %" in card.read_text(encoding="utf-8")
    band = Band.from_json(json.loads(model.read_text(encoding="utf-8"))["band"])
    fit = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    assert fit["band"]["half_width"] == pytest.approx(band.half_width)
    for path, is_flagged in ((data, False), (faster, True)):
        arguments = (*COLUMNS, "--out", tmp_path / "predicted.csv", "--json", tmp_path / "predicted.json")
        code, out, text = bench("predict", model, path, *arguments)
        assert code == 0, text
        beyond = json.loads((tmp_path / "predicted.json").read_text(encoding="utf-8"))["beyond"]
        assert (not beyond["faster"]["by_chance"]) is is_flagged
        assert ("faster than those fitted" in " ".join(text.split())) is is_flagged
        rows = np.genfromtxt(tmp_path / "predicted.csv", delimiter=",", names=True)
        widths = rows["predicted_upper_µm"] - rows["predicted_lower_µm"]
        np.testing.assert_allclose(widths, 2.0 * band.half_width, rtol=1e-9)
    code, out, text = bench("model", "test", model, "--data", data, "--bands")
    assert (code, "covers" in out) == (0, True), text
    targets = tmp_path / "targets.csv"
    np.savetxt(
        targets,
        np.column_stack([times, 0.3 * np.sin(times)]),
        delimiter=",",
        header="time [s],displacement [µm]",
        comments="",
        encoding="utf-8",
    )
    arguments = ("--column", "displacement", "--time", "time", "--out", tmp_path / "setpoints.csv")
    code, _, text = bench("invert", model, targets, *arguments)
    assert code == 0, text
    columns = (tmp_path / "setpoints.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert columns[-2:] == ["predicted lower [µm]", "predicted upper [µm]"]
    assert "setpoint lower [V]" not in columns
