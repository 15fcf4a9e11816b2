"""The inverse of Hammerstein models, from Python and from the command line."""

import json

import numpy as np
import pytest
from cases import cases

from bench.analysis import invert_targets
from bench.base import ConfigurationError
from bench.identification import ModelFile
from bench.models import (
    BoucWenOscillator,
    Hammerstein,
    LinearPart,
    PrandtlIshlinskii,
    Preisach,
    logarithmic_creep,
    uniform_levels,
)

TIMES, STRENGTHS = logarithmic_creep(0.05, 0.02, 2.0)
CREEP = {"creep_times": TIMES, "creep_strengths": STRENGTHS}
PARTS = {
    "none": {},
    "lag": {"lag": (0.004, 0.0)},
    "long lag": {"lag": (0.2, 0.0)},
    "creep": CREEP,
    "lag and creep": {"lag": (0.004, 0.0), **CREEP},
    "resonance, slow steps": {"lag": (2e-4, 1e-8)},
}


DRIFTS = [{}, {"drift": 0.2}, {"drift": -0.3, "drift_time": 0.4}]


def preisach(rng):
    return Preisach(uniform_levels(-1.0, 1.0, 6), rng.random(21) + 0.2, 0.3)


def plays(rng):
    return PrandtlIshlinskii([0.0, 0.1, 0.3], rng.random(3) + 0.2, bias=-2.0, input_range=(-1.0, 1.0))


def targets(model, rng, samples=600):
    """Return uneven times, and targets well within reach."""
    t = 5.0 + np.cumsum(rng.uniform(0.001, 0.003, samples))
    low, high = model.static.output_range()
    phase = rng.uniform(0.0, 2.0 * np.pi)
    return t, 0.5 * (low + high) + 0.2 * (high - low) * np.sin(phase + 9.0 * t) * np.cos(2.3 * t)


def span(model):
    return float(np.ptp(model.static.output_range()))


@cases(("part", "make", "drift"), zip(PARTS, [preisach, plays] * 3, DRIFTS * 2, strict=True))
def test_the_prediction_of_the_setpoints_is_the_targets(part, make, drift):
    rng = np.random.default_rng(0)
    model = Hammerstein(make(rng), LinearPart(**PARTS[part]), **drift)
    t, wanted = targets(model, rng)
    # Ringing after the first row, where the targets begin with a slope, takes more room beside a long lag.
    wanted = wanted[0] + (wanted - wanted[0]) * (0.02 if part == "long lag" else 1.0)
    found = invert_targets(ModelFile("m", model), wanted, times=t)
    np.testing.assert_allclose(model.evaluate(t, found.setpoints), wanted, rtol=0.0, atol=1e-9 * span(model))
    assert set(found.flags) == {"met"}
    assert np.ptp(found.setpoints) > 0.01


def test_targets_are_followed_on_from_a_state():
    rng = np.random.default_rng(0)
    model = Hammerstein(preisach(rng), LinearPart(**PARTS["lag and creep"]), drift=0.2)
    t, wanted = targets(model, rng)
    first = model.follow(t[:250], wanted[:250])
    _, state = model.run(t[:250], first)
    rest = model.follow(t[250:], wanted[250:], state)
    np.testing.assert_allclose(model.evaluate(t[250:], rest, state), wanted[250:], rtol=0.0, atol=1e-9 * span(model))
    np.testing.assert_allclose(np.concatenate([first, rest]), model.follow(t, wanted), atol=1e-6)


def test_a_target_out_of_reach_is_named_and_those_after_it_are_met():
    rng = np.random.default_rng(1)
    model = Hammerstein(preisach(rng), LinearPart(**PARTS["lag and creep"]))
    t, wanted = targets(model, rng)
    wanted[300:310] += 2.0 * span(model)
    found = invert_targets(ModelFile("m", model), wanted, times=t)
    missed = [row for row, flag in enumerate(found.flags, 1) if flag != "met"]
    assert missed[0] == 301
    assert set(found.flags[300:310]) == {"too high"}
    assert set(found.flags[400:]) == {"met"}
    np.testing.assert_allclose(found.setpoints[300:310], 1.0)
    np.testing.assert_array_equal(found.predicted, model.evaluate(t, found.setpoints))
    assert f"{len(missed)} of 600 targets cannot be met (first: row 301, too high)" in found.warnings()[0]


def test_ringing_is_warned_of_where_steps_are_short_beside_the_lag():
    model = Hammerstein(preisach(np.random.default_rng(2)), LinearPart(lag=(0.05, 0.0)))
    t = 0.002 * np.arange(200)
    middle = 0.5 * sum(model.static.output_range())
    ramp = invert_targets(ModelFile("m", model), middle + 0.5 * span(model) * t, times=t)
    assert set(ramp.flags) == {"met"}
    assert [text for text in ramp.warnings() if "the set-points alternate" in text]
    smooth = invert_targets(ModelFile("m", model), middle + span(model) * t**3, times=t)
    assert smooth.warnings() == []


@cases(
    ("linear", "step", "message"),
    [
        ({"delay": 0.038}, 0.002, r"delay of 0.038 s is as long as the 0.038 s of the targets"),
        ({"lag": (4e-4, 1e-5)}, 0.002, "the inverse is unstable"),
        ({"lag": (10.0, 0.0)}, 1e-5, "too short"),
    ],
)
def test_what_cannot_be_inverted_is_refused(linear, step, message):
    model = Hammerstein(preisach(np.random.default_rng(0)), LinearPart(**linear))
    with pytest.raises(ConfigurationError, match=f"^model m cannot be inverted: .*{message}"):
        invert_targets(ModelFile("m", model), np.linspace(0.0, 0.1, 20), times=step * np.arange(20))


@cases("drift", DRIFTS)
def test_what_is_ahead_is_the_output_a_delay_later(drift):
    rng = np.random.default_rng(4)
    model = Hammerstein(preisach(rng), LinearPart(0.014, **PARTS["lag and creep"]), **drift)
    t = 0.002 * np.arange(300)
    u = np.sin(40.0 * t) * np.cos(9.0 * t)
    prompt, state = model.ahead(model.initial_state())
    np.testing.assert_allclose(prompt.evaluate(t, u, state)[:-7], model.evaluate(t, u)[7:], rtol=0.0, atol=1e-12)
    _, later = model.run(t[:100], u[:100])
    prompt, state = model.ahead(later)
    outputs = model.evaluate(t[100:], u[100:], later)
    np.testing.assert_allclose(prompt.evaluate(t[100:], u[100:], state)[:-7], outputs[7:], rtol=0.0, atol=1e-12)


@cases(("part", "drift"), zip(["none", "lag", "lag and creep"], DRIFTS, strict=True))
def test_targets_behind_a_delay_of_whole_steps_are_met_after_it(part, drift):
    rng = np.random.default_rng(0)
    model = Hammerstein(preisach(rng), LinearPart(0.014, **PARTS[part]), **drift)
    low, high = model.static.output_range()
    t = 5.0 + 0.002 * np.arange(400)
    wanted = 0.5 * (low + high) + 0.2 * (high - low) * np.sin(9.0 * t) * np.cos(2.3 * t)
    found = invert_targets(ModelFile("m", model), wanted, times=t)
    assert found.flags == ("too early",) * 7 + ("met",) * 393
    predicted = model.evaluate(t, found.setpoints)
    np.testing.assert_allclose(predicted[7:], wanted[7:], rtol=0.0, atol=1e-9 * span(model))
    # No set-point reaches the first targets, and the last ones reach none.
    np.testing.assert_allclose(predicted[:7], predicted[0] + model.drift_after(t[:7] - t[0]), rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(found.setpoints[-7:], found.setpoints[-8])
    assert found.setpoints[-8] != found.setpoints[-9]
    warning = found.warnings()[0]
    assert "an effect after 0.014 s: on the first 7 targets" in warning
    assert "the last 7 set-points" in warning


def test_targets_behind_any_delay_are_met_but_for_the_interpolation():
    rng = np.random.default_rng(0)
    model = Hammerstein(preisach(rng), LinearPart(0.0131, **PARTS["lag and creep"]))
    errors = []
    for parts in (1, 4):
        t = np.cumsum(np.repeat(np.random.default_rng(1).uniform(0.001, 0.003, 300) / parts, parts))
        low, high = model.static.output_range()
        wanted = 0.5 * (low + high) + 0.2 * (high - low) * np.sin(9.0 * t) * np.cos(2.3 * t)
        wanted[t > 0.3] += span(model) * (t[t > 0.3] > 0.5)
        found = invert_targets(ModelFile("m", model), wanted, times=t)
        near = np.array([flag == "near" for flag in found.flags])
        np.testing.assert_array_equal(np.array(found.flags) == "too early", t < t[0] + 0.0131)
        assert {"met", "near", "too early"} >= set(np.array(found.flags)[t < 0.45])
        # What is clamped is no matter of interpolation.
        assert set(np.array(found.flags)[t > 0.52]) == {"too high"}
        error = np.abs(found.predicted - wanted)[near].max()
        assert any(f"{near.sum()} rows err by up to {error:.3g}" in text for text in found.warnings())
        errors.append(
            [np.abs(found.predicted - wanted)[(t > a) & (t < 0.45)].max() / span(model) for a in (0.02, 0.1)]
        )
    (first, smooth), (first_finer, smooth_finer) = errors
    assert first < 1e-3
    # Of first order in the steps after the kink of the first row, then of second.
    assert first_finer < 0.3 * first
    assert smooth_finer < 0.2 * smooth


def test_targets_behind_a_delay_follow_on_from_a_state():
    rng = np.random.default_rng(0)
    model = Hammerstein(preisach(rng), LinearPart(0.014, **PARTS["lag and creep"]), drift=0.2)
    t = 0.002 * np.arange(300)
    u = 0.8 * np.sin(40.0 * t) * np.cos(9.0 * t)
    whole = model.evaluate(t, u)
    _, state = model.run(t[:100], u[:100])
    file = ModelFile("m", model, memory=state)
    found = invert_targets(file, whole[100:], times=t[100:], continue_memory=True)
    np.testing.assert_allclose(found.setpoints[:-7], u[100:-7], rtol=0.0, atol=1e-6)
    # What came before is what it was.
    np.testing.assert_allclose(found.predicted, whole[100:], rtol=0.0, atol=1e-9 * span(model))


@pytest.fixture
def files(tmp_path):
    rng = np.random.default_rng(0)
    static = Preisach(uniform_levels(-1.0, 1.0, 6), rng.random(21) + 0.2, 0.3, input_unit="V", output_unit="µm")
    model = Hammerstein(static, LinearPart(**PARTS["lag"]), drift=0.2)
    ModelFile("film", model).save(tmp_path / "model.json")
    ModelFile("static", static).save(tmp_path / "static.json")
    swinging = BoucWenOscillator(0.002, 0.01, 50.0, 50.0, 0.8, -1.1, 0.0, (-200.0, 200.0))
    ModelFile("beam", swinging).save(tmp_path / "oscillator.json")
    t, wanted = targets(model, rng)
    rows = np.column_stack([1e3 * t, wanted])
    np.savetxt(
        tmp_path / "targets.csv", rows, delimiter=",", header="t [ms],displacement [um]", comments="", fmt="%.17g"
    )
    return tmp_path


def test_the_setpoints_of_the_command_predict_the_targets(bench, files):
    setpoints, predicted, summary = files / "setpoints.csv", files / "predicted.csv", files / "inverted.json"
    model, wanted = files / "model.json", files / "targets.csv"
    options = ("--column", "displacement", "--out", setpoints, "--json", summary)
    code, _, text = bench("invert", model, wanted, *options)
    assert code == 0, text
    assert setpoints.read_text(encoding="utf-8").startswith(
        "time [s],target [µm],passing [V],setpoint [V],predicted [µm],flag"
    )
    assert json.loads(summary.read_text())["met"] == 600
    code, _, text = bench("predict", model, setpoints, "--time", "time", "--input", "setpoint", "--out", predicted)
    assert code == 0, text
    found = np.loadtxt(predicted, delimiter=",", skiprows=1)
    given = np.loadtxt(wanted, delimiter=",", skiprows=1)
    np.testing.assert_allclose(found[:, 2], given[:, 1], rtol=0.0, atol=1e-9 * np.ptp(given[:, 1]))


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        ("model", ("--time", "displacement"), "column displacement is in µm; expected a time"),
        ("static", ("--time", "t"), "--time: static is a model without time"),
        ("oscillator", ("--time", "t"), "model beam cannot be inverted: a model of the kind bouc-wen-oscillator"),
    ],
)
def test_time_belongs_to_models_with_time(bench, files, model, options, message):
    out = files / "out.csv"
    code, _, text = bench(
        "invert", files / f"{model}.json", files / "targets.csv", "--column", "displacement", "--out", out, *options
    )
    assert code != 0
    assert message in " ".join(text.split())
    assert not out.exists()


def test_the_command_says_what_a_delay_leaves(bench, files):
    rng = np.random.default_rng(0)
    static = Preisach(uniform_levels(-1.0, 1.0, 6), rng.random(21) + 0.2, 0.3, input_unit="V", output_unit="µm")
    ModelFile("late", Hammerstein(static, LinearPart(0.0052, (0.004, 0.0)))).save(files / "late.json")
    setpoints, summary = files / "setpoints.csv", files / "inverted.json"
    options = ("--time", "t", "--column", "displacement", "--out", setpoints, "--json", summary)
    code, out, err = bench("invert", files / "late.json", files / "targets.csv", *options)
    assert code == 0, err
    counts = json.loads(summary.read_text())
    assert counts["near"] + counts["too_early"] == 600
    assert f"{counts['near']} near, {counts['too_early']} too early" in " ".join(out.split())
    assert "an effect after 0.0052 s" in " ".join(err.split())
