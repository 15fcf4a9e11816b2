"""The Hammerstein model and its identification."""

import json

import numpy as np
import pytest
from cases import cases

from bench.identification import (
    Candidate,
    Measurements,
    evaluate,
    identify,
    identify_in_time,
    measure_errors,
    ramps,
)
from bench.models import (
    BoucWen,
    Hammerstein,
    LinearPart,
    PrandtlIshlinskii,
    Preisach,
    logarithmic_creep,
    uniform_levels,
)

CREEP = logarithmic_creep(0.05, 0.02, 2.0)


def specimen(**linear):
    rng = np.random.default_rng(3)
    static = Preisach(uniform_levels(-1.0, 1.0, 6), rng.random(21) + 0.2, 0.3)
    return Hammerstein(static, LinearPart(**linear), drift=0.2)


def record(rng, samples=900):
    """Return uneven times, and an input that oscillates at several amplitudes and rates."""
    t = np.cumsum(rng.uniform(0.001, 0.003, samples))
    phase = 2.0 * np.pi * np.cumsum(np.diff(t, prepend=0.0) * rng.choice([4.0, 20.0, 60.0], samples // 90).repeat(90))
    return t, np.sin(phase) * (1.0 - 0.7 * t / t[-1])


def test_a_sequence_in_two_parts_is_the_whole():
    t, u = record(np.random.default_rng(0), 180)
    model = specimen(delay=0.0071, lag=(4e-4, 1e-5), creep_times=CREEP[0], creep_strengths=CREEP[1])
    whole, end = model.run(t, u)
    for cut in (2, 90, 178):
        first, state = model.run(t[:cut], u[:cut])
        state = model.state_from_json(json.loads(json.dumps(model.state_to_json(state))))
        rest, again = model.run(t[cut:], u[cut:], state)
        np.testing.assert_allclose(np.concatenate([first, rest]), whole, atol=1e-12)
        assert again.memory == end.memory


def test_a_model_is_the_same_after_json():
    t, u = record(np.random.default_rng(0), 90)
    model = specimen(delay=0.0071, lag=(4e-4, 1e-5), creep_times=CREEP[0], creep_strengths=CREEP[1])
    again = Hammerstein.from_json(json.loads(json.dumps(model.to_json())))
    np.testing.assert_array_equal(again.evaluate(t, u), model.evaluate(t, u))
    assert again.input_range == model.input_range
    np.testing.assert_array_equal(again.densities()[0].values, model.densities()[0].values)


@pytest.mark.parametrize("wrong", [[1.0], "hammerstein", None])
def test_a_part_of_another_type_is_refused(wrong):
    document = specimen(delay=0.0071).to_json()
    document["linear"]["type"] = wrong
    with pytest.raises(ValueError, match="linear-part"):
        Hammerstein.from_json(document)


@cases("sign", [1.0, -1.0])
def test_every_element_is_found_again_on_uneven_times(sign):
    rng = np.random.default_rng(5)
    t, u = record(rng)
    model = specimen(delay=0.0031, lag=(2 * 0.2 / 250.0, 250.0**-2))
    y = sign * model.evaluate(t, u)
    options = {"levels": 6, "plane": (-1.0, 1.0), "reversible": "none"}
    found = identify_in_time("hammerstein", t, u, y, dynamics="resonance,delay,drift", **options)
    assert found.errors.rms_percent < 1e-4
    numbers = {name: value for name, (value, _) in found.model.parameters().items()}
    assert numbers["frequency"] == pytest.approx(250.0 / (2.0 * np.pi), rel=1e-4)
    assert numbers["damping ratio"] == pytest.approx(0.2, rel=1e-3)
    assert numbers["delay"] == pytest.approx(0.0031, rel=1e-3)
    assert numbers["drift"] == pytest.approx(sign * 0.2, rel=1e-3)
    assert found.orientation == ("rising" if sign > 0 else "falling")
    assert found.certificate.kkt_residual < 1e-10


def test_creep_and_a_lag_are_found_again():
    t, u = record(np.random.default_rng(6))
    plays = PrandtlIshlinskii(np.array([0.0, 0.2, 0.5]), np.array([1.0, 0.5, 0.3]), 0.1)
    times, strengths = logarithmic_creep(0.08, 10.0 * np.median(np.diff(t)), t[-1] - t[0])
    y = Hammerstein(plays, LinearPart(0.0, (0.004, 0.0), times, strengths)).evaluate(t, u)
    found = identify_in_time("hammerstein", t, u, y, static="prandtl-ishlinskii", dynamics="lag,creep")
    numbers = {name: value for name, (value, _) in found.model.parameters().items()}
    assert numbers["time constant"] == pytest.approx(0.004, rel=0.05)
    assert numbers["creep per decade"] == pytest.approx(8.0, rel=0.05)
    assert found.errors.rms_percent < 0.2


def piezo(t, u):
    """A plant of another structure: Bouc-Wen hysteresis, log-like creep behind it, and mechanics of 300 Hz."""
    substeps, taus = 10, np.array([0.02, 0.2, 2.0])
    force = position = speed = 0.0
    crept, omega, before, result = np.zeros(3), 2.0 * np.pi * 300.0, u[0], []
    for k in range(t.size):
        dt = (t[k] - t[k - 1] if k else t[1] - t[0]) / substeps
        for s in range(substeps):
            value, change = before + (u[k] - before) * (s + 1) / substeps, (u[k] - before) / substeps
            force += 0.15 * change - 0.04 * abs(change) * force - 0.006 * change * force
            static = 0.283 * value + 2.5e-4 * value**2 - force
            crept += dt / taus * (static - crept)
            speed += dt * (omega**2 * (static + 0.012 * crept.sum() - position) - 2.0 * 0.3 * omega * speed)
            position += dt * speed
        before = u[k]
        result.append(position)
    return np.array(result)


def tone(frequency, cycles, amplitudes, rate=3000.0):
    t = np.arange(round(cycles * rate / frequency)) / rate
    return np.concatenate([50.0 * a * (1.0 - np.cos(2.0 * np.pi * frequency * t)) for a in amplitudes])


def test_a_piezo_at_two_rates_is_predicted_at_the_faster():
    rng = np.random.default_rng(1)
    u = np.concatenate([tone(20.0, 1, [1.0, 0.6, 0.3]), tone(100.0, 2, np.linspace(1.0, 0.1, 8))])
    t = np.arange(u.size) / 3000.0
    y = piezo(t, u) + rng.normal(0.0, 0.01, u.size)
    fresh = np.concatenate([tone(20.0, 1, [0.9, 0.5]), tone(100.0, 1, rng.uniform(0.2, 1.0, 10))])
    later = np.arange(fresh.size) / 3000.0
    truth = piezo(later, fresh)
    fast = slice(300, None)

    def held_out(**options):
        found = identify_in_time("hammerstein", t, u, y, levels=6, **options)
        return measure_errors(truth[fast], found.model.evaluate(later, fresh)[fast]).rms_percent

    static = identify("preisach", u, y, levels=6, reversible="linear").model
    alone = measure_errors(truth[fast], static.evaluate(fresh)[fast]).rms_percent
    chosen = held_out()
    by_hand = min(held_out(dynamics=text) for text in ("lag", "resonance", "resonance,creep"))
    assert chosen <= 1.2 * by_hand
    assert chosen < 0.5 * alone


def test_a_shape_and_a_lag_at_one_rate_are_found_together():
    rng = np.random.default_rng(0)
    turns = np.concatenate([[-1.0, 1.0], rng.uniform(-1.0, 1.0, 30)])
    lengths = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(turns)))])
    inputs = np.interp(np.linspace(0.0, lengths[-1], 900), lengths, turns)
    times = 1e-3 * np.arange(inputs.size)
    plant = Hammerstein(BoucWen(0.6, 1.0, beta=3.0, gamma=3.0, exponent=1.5), LinearPart(lag=(1.5e-3, 0.0)))
    outputs = plant.evaluate(times, inputs)
    outputs += 0.01 * np.ptp(outputs) * rng.standard_normal(outputs.size)
    found = identify_in_time("hammerstein", times, inputs, outputs, static="bouc-wen").model
    # Nothing but the lag: a delay that stood for it in the first step is left out again.
    assert found.linear.delay == 0.0
    assert found.linear.lag == (pytest.approx(1.5e-3, rel=0.2), 0.0)


@cases("static", ["preisach", "preisach-signed"])
def test_smoothing_is_that_of_the_operators(static):
    rng = np.random.default_rng(0)
    t, u = record(rng)
    y = Preisach(uniform_levels(-1.0, 1.0, 6), rng.random(21) + 0.2, 0.3).evaluate(u) + rng.normal(0.0, 0.02, t.size)
    options = {"levels": 12, "reversible": "linear", "smoothing": 1e-2}
    alone = identify(static, u, y, ridge=0.0, **options)
    found = identify_in_time("hammerstein", t, u, y, static=static, dynamics="none", **options)
    np.testing.assert_allclose(found.model.static.density, alone.model.density, atol=1e-8)
    assert found.errors.rms == pytest.approx(alone.errors.rms, rel=1e-9)
    assert found.regularization.smoothing == 1e-2


@pytest.mark.slow
def test_smoothing_chosen_on_blocks_left_out_predicts_better_from_a_fine_plane():
    rng = np.random.default_rng(1)
    # A density that falls from the diagonal, on a plane that is twice as fine.
    i, j = np.tril_indices(40)
    density = np.exp(-0.15 * (i - j) - 0.0045 * (i + j - 33.0) ** 2)
    plant = Hammerstein(Preisach(uniform_levels(-1.0, 1.0, 40), density), LinearPart(lag=(0.01, 0.0)))

    def measured(turns):
        inputs = ramps([0.0, *turns], 0.05)
        times = 2e-3 * np.arange(inputs.size)
        return times, inputs, plant.evaluate(times, inputs)

    t, u, y = measured([-1.0, 1.0, *rng.uniform(-1.0, 1.0, 40)])
    y += 0.02 * np.ptp(y) * rng.standard_normal(y.size)
    later, fresh, truth = measured([-1.0, 1.0, *rng.uniform(-1.0, 1.0, 40)])

    def held_out(smoothing):
        options = {"levels": 20, "dynamics": "lag", "smoothing": smoothing}
        found = identify_in_time("hammerstein", t, u, y, **options)
        assert found.certificate.kkt_residual < 1e-10
        return measure_errors(truth, found.model.evaluate(later, fresh)).rms, found.regularization

    tried = (0.0, 1e-2, 1e-1)
    errors = {weight: held_out(weight)[0] for weight in tried}
    chosen, penalties = held_out(tried)
    assert penalties.smoothing > 0.0
    assert penalties.rms > penalties.training_rms > 0.0
    assert chosen < 0.8 * errors[0.0]
    assert chosen < 1.1 * min(errors.values())


def test_cells_that_only_rows_left_out_have_moved_stay_at_zero():
    rng = np.random.default_rng(0)
    inputs = ramps([0.0, 10.0, 0.0, *rng.uniform(0.0, 10.0, 14)], 0.4)
    times = 0.01 * np.arange(inputs.size)
    plays = PrandtlIshlinskii(np.arange(5.0), [1.0, 0.4, 0.8, 0.3, 0.5], input_range=(0.0, 10.0))
    columns = plays.evaluate(inputs)[:, None]
    outputs = LinearPart(0.0, (0.03, 0.0), np.empty(0), np.empty(0)).respond(times, columns)[0][:, 0]
    outputs = outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(outputs.size)
    measured = Measurements.of(inputs, outputs, times=times)
    (found,) = evaluate(measured, [Candidate("preisach", {"levels": 20}, "rising", "skip", dynamics="lag")])
    # The lag leaves 1e-9 of a cell in the rows of a fold, and noise over that is no density.
    assert found.blocks_rms < 0.03 * np.ptp(outputs)


def test_viscosity_and_friction_are_found_again_and_kept_by_the_file():
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.001, 0.003, 900))
    u = np.sin(9.0 * t) * (1.0 - 0.5 * t / t[-1]) + 0.3 * np.sin(31.0 * t)
    static = Preisach(uniform_levels(-1.4, 1.4, 6), rng.random(21) + 0.2, 0.3)
    true = Hammerstein(static, LinearPart(), viscous=0.2, friction=3.0, friction_speed=2.0)
    y = true.evaluate(t, u)
    found = identify_in_time(
        "hammerstein", t, u, y, levels=6, plane=(-1.4, 1.4), reversible="none", dynamics="viscous,friction"
    ).model
    numbers = [found.viscous, found.friction, found.friction_speed]
    np.testing.assert_allclose(numbers, [0.2, 3.0, 2.0], rtol=1e-4)
    again = Hammerstein.from_json(json.loads(json.dumps(true.to_json())))
    np.testing.assert_array_equal(again.evaluate(t, u), y)
    assert again.structure()["dynamics"] == "viscous,friction"
    with pytest.raises(ValueError, match="viscous"):
        again.follow(t, y)
    # In two parts, all but the row at the cut is as it was: its velocity is taken from the row before alone.
    first, state = true.run(t[:400], u[:400])
    rest, _ = true.run(t[400:], u[400:], true.state_from_json(json.loads(json.dumps(true.state_to_json(state)))))
    np.testing.assert_allclose(np.delete(np.concatenate([first, rest]), 399), np.delete(y, 399), atol=1e-9)


def test_what_the_data_do_not_determine_is_said():
    t = np.arange(400) * 1.0
    u = np.sin(0.02 * t) * (1.0 - t / 800.0)
    y = Preisach(uniform_levels(-1.0, 1.0, 6), np.ones(21)).evaluate(u)
    y += np.random.default_rng(0).normal(0.0, 1e-3, t.size)
    options = {"levels": 6, "plane": (-1.0, 1.0)}
    found = identify_in_time("hammerstein", t, u, y, dynamics="lag", **options)
    assert any("do not determine" in text for text in found.warnings)
    assert not identify_in_time("hammerstein", t, u, y, **options).model.parameters()


@cases(
    ("options", "message"),
    [
        ({"dynamics": "lag,echo"}, "echo"),
        ({"dynamics": "lag,resonance"}, "one of lag and resonance"),
        ({"dynamics": "none", "plays": 3}, "options of preisach"),
        ({"static": "hammerstein"}, "model_name"),
        ({"static": "polynomial", "smoothing": 0.1}, "polynomial has no cells"),
        ({"smoothing": -0.1}, "smoothing: expected a finite number >= 0"),
    ],
)
def test_wrong_options_are_refused(options, message):
    t = np.arange(50.0)
    with pytest.raises(ValueError, match=message):
        identify_in_time("hammerstein", t, np.sin(t), np.sin(t), **options)


def test_times_must_increase():
    t = np.array([0.0, 1.0, 1.0, 2.0])
    with pytest.raises(ValueError, match=r"times: expected strictly increasing values, got 1.0 then 1.0 at index 1"):
        identify_in_time("hammerstein", t, t, t)
