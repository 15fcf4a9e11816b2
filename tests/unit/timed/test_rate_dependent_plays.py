"""Rate-dependent plays: the plays themselves, their inverse and their identification."""

import json

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.analysis import invert_targets
from bench.identification import (
    ModelFile,
    identify,
    identify_in_time,
    measure_errors,
)
from bench.identification.timed.rate_dependent_plays_fit import PlaysSearch
from bench.models import PlaysState, PrandtlIshlinskii, RateDependentPlays

seeds = st.integers(0, 10**6)


def specimen(rng, count=8, sign=1.0, slowest=0.0):
    """Return a model whose first play is its input, the others with time constants from 10 µs to 10**slowest s."""
    thresholds = np.append(0.0, rng.uniform(0.0, 0.5, count))
    lags = np.append(0.0, np.where(rng.random(count) < 0.2, 0.0, 10.0 ** rng.uniform(-5.0, slowest, count)))
    weights = sign * np.append(1.0, rng.random(count))
    return RateDependentPlays(thresholds, lags, weights, (-2.0, 2.0), 0.3, origin=0.1)


def record(rng, samples=200):
    """Return uneven times, and ramps between random turns."""
    t = 3.0 + np.cumsum(rng.uniform(0.0005, 0.003, samples))
    return t, np.interp(t, np.linspace(t[0], t[-1], samples // 20), rng.uniform(-1.0, 1.0, samples // 20))


def integrated(model, times, inputs, substeps):
    """Return the plays by Euler's implicit rule, each substep in plain Python."""
    elements = list(zip(model.thresholds.tolist(), model.time_constants.tolist(), strict=True))
    plays = [max(inputs[0] - r, min(inputs[0] + r, model.origin)) for r, _ in elements]
    rows = [plays.copy()]
    for n in range(1, times.size):
        step = (times[n] - times[n - 1]) / substeps
        for s in range(1, substeps + 1):
            x = inputs[n - 1] + (inputs[n] - inputs[n - 1]) * s / substeps
            for k, (r, lag) in enumerate(elements):
                plays[k] += step / (step + lag) * (max(x - r, min(x + r, plays[k])) - plays[k])
        rows.append(plays.copy())
    return np.array(rows)


@cases("seed", range(2))
def test_the_plays_solve_their_differential_equation(seed):
    rng = np.random.default_rng(seed)
    model, (t, u) = specimen(rng), record(rng, 60)
    coarse, fine = (integrated(model, t, u, substeps) for substeps in (100, 200))
    found = model.columns(t, u)
    # The rule is of first order: the finer result errs by what the two differ.
    error = np.abs(coarse - fine).max()
    assert error < 3e-4
    np.testing.assert_allclose(found, fine, rtol=0.0, atol=1.5 * error)
    np.testing.assert_allclose(model.evaluate(t, u), 0.3 + found @ model.weights, rtol=0.0, atol=1e-14)


@given(seeds)
def test_without_time_constants_the_plays_do_not_depend_on_the_rate(seed):
    rng = np.random.default_rng(seed)
    t, u = record(rng)
    thresholds, weights = np.append(0.0, np.cumsum(rng.uniform(0.05, 0.2, 5))), rng.random(6)
    model = RateDependentPlays(thresholds, np.zeros(6), weights, (-1.0, 1.0), 0.3)
    static = PrandtlIshlinskii(thresholds, weights, 0.3)
    np.testing.assert_allclose(model.evaluate(t, u), static.evaluate(u), rtol=0.0, atol=1e-14)
    np.testing.assert_array_equal(model.evaluate(7.0 * t, u), model.evaluate(t, u))


@given(seeds)
def test_rows_between_on_the_straight_line_change_nothing(seed):
    rng = np.random.default_rng(seed)
    model, (t, u) = specimen(rng), record(rng)
    between = np.sort(rng.choice(t.size - 1, 50, replace=False))
    share = rng.uniform(0.1, 0.9, 50)
    times = np.insert(t, between + 1, t[between] + share * np.diff(t)[between])
    inputs = np.insert(u, between + 1, u[between] + share * np.diff(u)[between])
    kept = np.insert(np.ones(t.size, dtype=bool), between + 1, np.zeros(50, dtype=bool))
    np.testing.assert_allclose(model.evaluate(times, inputs)[kept], model.evaluate(t, u), rtol=0.0, atol=1e-12)


@given(seeds)
def test_a_greater_input_never_gives_a_smaller_output(seed):
    rng = np.random.default_rng(seed)
    model, (t, u) = specimen(rng), record(rng)
    above = u + rng.uniform(0.0, 0.3, u.size)
    assert (model.evaluate(t, above) - model.evaluate(t, u) >= -1e-12).all()


@cases("rate", [0.01, 1.0, 50.0])
def test_the_threshold_of_a_dragged_play_grows_with_the_rate(rate):
    model = RateDependentPlays([0.2], [0.03], [1.0], (-10.0, 10.0))
    # Ramps of 40 time constants and 10 thresholds.
    length = max(40.0 * 0.03 * rate, 2.0)
    u = np.concatenate([np.linspace(0.0, length, 300), np.linspace(length, 0.0, 300)[1:]])
    t = np.append(0.0, np.cumsum(np.abs(np.diff(u)))) / rate
    y = model.evaluate(t, u)
    assert u[299] - y[299] == pytest.approx(0.2 + 0.03 * rate, rel=1e-9)
    assert y[-1] - u[-1] == pytest.approx(0.2 + 0.03 * rate, rel=1e-9)


@cases("seed", range(2))
def test_a_sequence_in_two_parts_is_the_whole(seed):
    rng = np.random.default_rng(seed)
    model, (t, u) = specimen(rng), record(rng)
    whole, end = model.run(t, u)
    for cut in (2, 90, 198):
        first, state = model.run(t[:cut], u[:cut])
        state = model.state_from_json(json.loads(json.dumps(model.state_to_json(state))))
        rest, again = model.run(t[cut:], u[cut:], state)
        np.testing.assert_array_equal(np.concatenate([first, rest]), whole)
        assert again == end
    # A record with a clock of its own follows after its own first step.
    own, _ = model.run(t[90:] - t[90], u[90:], model.run(t[:90], u[:90])[1])
    later = np.concatenate([t[:90], t[89] + t[91] - t[90] + t[90:] - t[90]])
    np.testing.assert_allclose(own, model.evaluate(later, u)[90:], rtol=0.0, atol=1e-10)


def test_a_model_is_the_same_after_json_and_saturation_forgets_the_rest():
    rng = np.random.default_rng(0)
    model, (t, u) = specimen(rng), record(rng)
    again = RateDependentPlays.from_json(json.loads(json.dumps(model.to_json())))
    np.testing.assert_array_equal(again.evaluate(t, u), model.evaluate(t, u))
    slow = np.array([0.0, 1e3, 2e3, 3e3, 3.1e3])
    for word, far, near in (("negative", 9.0, -2.0), ("positive", -9.0, 2.0)):
        driven = model.evaluate(slow, [0.0, far, near, near, 0.3])
        saturated = model.evaluate(slow[3:], [near, 0.3], model.start(word))
        np.testing.assert_allclose(saturated, driven[3:], rtol=0.0, atol=1e-9)
    assert model.initial_state() == PlaysState((0.1,) * 9)


@cases(
    ("state", "message"),
    [
        ({"plays": [0.0]}, "the key 'last'"),
        ({"plays": [0.0, 1.0], "last": None}, "expected 1 plays"),
        ({"plays": [0.0], "last": [1.0]}, "time and input"),
    ],
)
def test_a_wrong_memory_is_refused(state, message):
    with pytest.raises(ValueError, match=message):
        RateDependentPlays([0.0], [0.0], [1.0], (0.0, 1.0)).state_from_json(state)


@cases(
    ("fields", "message"),
    [
        ({"thresholds": [0.0]}, "one for each weight"),
        ({"thresholds": [0.0, -0.1]}, "thresholds: expected values >= 0"),
        ({"time_constants": [0.0, -0.1]}, "time_constants: expected values >= 0"),
        ({"weights": [1.0, -0.1]}, "all <= 0, got both"),
        ({"input_range": (1.0, 1.0)}, "input_range"),
    ],
)
def test_a_wrong_model_is_refused(fields, message):
    usual = {"thresholds": [0.0, 0.1], "time_constants": [0.0, 1.0], "weights": [1.0, 0.5], "input_range": (0.0, 1.0)}
    with pytest.raises(ValueError, match=message):
        RateDependentPlays(**usual | fields)


@given(seeds, st.sampled_from([1.0, -1.0]))
def test_the_prediction_of_the_setpoints_is_the_targets(seed, sign):
    rng = np.random.default_rng(seed)
    model, (t, u) = specimen(rng, sign=sign), record(rng)
    wanted = model.evaluate(t, u)
    wanted = wanted[0] + np.cumsum(np.append(0.0, np.diff(wanted)) * rng.uniform(0.5, 0.9))
    found = invert_targets(ModelFile("m", model), wanted, times=t)
    met = np.array([flag == "met" for flag in found.flags])
    np.testing.assert_allclose(found.predicted[met], wanted[met], rtol=0.0, atol=1e-9 * np.ptp(wanted))
    # What is not met is at an end of the range.
    assert np.isin(found.setpoints[~met], model.input_range).all()
    assert met.mean() > 0.9


def test_targets_are_followed_on_from_a_state_and_those_out_of_reach_are_clamped():
    rng = np.random.default_rng(3)
    model, (t, u) = specimen(rng), record(rng)
    wanted = model.evaluate(t, u)
    np.testing.assert_allclose(model.follow(t, wanted), u, rtol=0.0, atol=1e-9)
    _, state = model.run(t[:120], u[:120])
    np.testing.assert_allclose(model.follow(t[120:], wanted[120:], state), u[120:], rtol=0.0, atol=1e-9)
    wanted[50:60] += 100.0
    found = invert_targets(ModelFile("m", model), wanted, times=t)
    assert set(found.flags[50:60]) == {"too high"}
    np.testing.assert_array_equal(found.setpoints[50:60], 2.0)
    assert set(found.flags[150:]) == {"met"}


def cycles(frequencies, amplitudes, rate=2000.0, most=400):
    """Return times and sines, one a frequency (Hz) and amplitude, at a rate or of so many samples at most."""
    times, inputs, now = [], [], 0.0
    for frequency, amplitude in zip(frequencies, amplitudes, strict=True):
        count = min(round(rate / frequency), most)
        shares = np.arange(count) / count
        times.append(now + shares / frequency)
        inputs.append(amplitude * np.sin(2.0 * np.pi * shares))
        now += 1.0 / frequency
    return np.concatenate(times), np.concatenate(inputs)


def activated(times, inputs, substeps=10):
    """A plant of another structure: plays slip with sinh of what is beyond their band, as with thermal activation.

    Their loops widen with the logarithm of the rate.
    """
    thresholds = np.linspace(0.05, 0.8, 24)
    slipped, before, result = np.zeros(24), (times[0], inputs[0]), []
    for time, value in zip(times.tolist(), inputs.tolist(), strict=True):
        step = (time - before[0]) / substeps
        for s in range(1, substeps + 1):
            x = before[1] + (value - before[1]) * s / substeps
            beyond = x - np.clip(x, slipped - thresholds, slipped + thresholds)
            slip = 0.05 * np.sinh(np.minimum(np.abs(beyond) / 0.03, 30.0)) * step
            slipped += np.sign(beyond) * np.minimum(slip, np.abs(beyond))
        before = time, value
        result.append(1.8 * value + 0.12 * slipped.sum())
    return np.array(result)


@pytest.mark.slow
def test_loops_that_widen_with_the_rate_are_predicted_at_other_rates():
    rng = np.random.default_rng(0)
    t, u = cycles(
        [1, 1, 1, 5, 5, 5, *[20] * 4, *[50] * 5],
        [1, 0.6, 0.3, 1, 0.6, 0.3, 1, 0.7, 0.5, 0.2, 1, 0.8, 0.6, 0.4, 0.2],
        most=120,
    )
    y = activated(t, u)
    y += 0.002 * np.ptp(y) * rng.standard_normal(y.size)
    later, fresh = cycles([1, 2, 10, 10, 30, 30, 30, 30, 3], [0.9, 0.5, 0.9, 0.5, 0.8, 1, 0.4, 0.6, 0.7], most=120)
    truth = activated(later, fresh)

    def held_out(predicted):
        return measure_errors(truth, predicted).rms_percent

    found = identify_in_time("rate-dependent-plays", t, u, y)
    alone = held_out(identify("prandtl-ishlinskii", u, y).model.evaluate(fresh))
    assert held_out(found.model.evaluate(later, fresh)) < 0.4 * alone
    assert found.certificate.kkt_residual < 1e-8
    assert len(found.model.parameters()) == 6


@cases("sign", [1.0, -1.0])
def test_a_time_constant_is_found_again(sign):
    t, u = cycles([2, 2, 20, 20, 60, 60, 60], [1.0, 0.5, 1.0, 0.4, 1.0, 0.7, 0.3])
    thresholds = np.arange(8) / 10.0
    lags = np.append(0.0, np.full(7, 0.004))
    plant = RateDependentPlays(thresholds, lags, sign * np.append(1.0, 0.5 ** np.arange(1, 8)), (-1.0, 1.0), 0.2)
    y = plant.evaluate(t, u) + np.random.default_rng(0).normal(0.0, 2e-3, t.size)
    found = identify_in_time("rate-dependent-plays", t, u, y, plays=10)
    numbers = {name: value for name, (value, _) in found.model.parameters().items()}
    assert numbers.keys() == {"time constant 1", "part with time constant 1"}
    assert numbers["time constant 1"] == pytest.approx(0.004, rel=0.02)
    assert found.orientation == ("rising" if sign > 0 else "falling")
    assert measure_errors(plant.evaluate(t, u), found.model.evaluate(t, u)).rms_percent < 0.05


@cases("sign", [1.0, -1.0])
def test_the_slopes_of_the_search_give_the_gradient_of_the_cost(sign):
    rng = np.random.default_rng(0)
    t, u = cycles([2, 20, 60, 60], [1.0, 0.6, 0.9, 0.4], 500.0)
    y = sign * activated(t, u) + rng.normal(0.0, 0.01, t.size)
    search = PlaysSearch.of(t, u, y, rng.uniform(0.5, 2.0, t.size), 30, "negative", "auto", plays=8, origin=0.1)
    problem, logarithms, far = search.problem(), np.log([0.004, 0.05]), np.full(2, np.inf)

    def cost(moved):
        return 0.5 * float(np.sum(problem.residuals(moved) ** 2))

    expected = [(cost(logarithms + e) - cost(logarithms - e)) / 2e-4 for e in 1e-4 * np.eye(2)]
    found = problem.jacobian(logarithms, -far, far).T @ problem.residuals(logarithms)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_plays_that_only_rows_left_out_have_moved_stay_at_zero():
    t, u = cycles([10] * 6, [0.4, 0.4, 1.0, 0.4, 0.4, 0.4], 1000.0)
    y = u + 0.01 * np.random.default_rng(0).standard_normal(u.size)
    search = PlaysSearch.of(t, u, y, None, 0, None, "auto", plays=40)
    columns = search.columns(np.array([1.0]))
    # Without the large cycle, of the plays of which the small ones reach but the edge.
    weights = np.where((t >= 0.2) & (t < 0.3), 0.0, 1.0)
    moved = np.ptp(columns[weights > 0.0], axis=0) / np.ptp(columns, axis=0)
    traces = (moved < 0.01) & (moved > 1e-9)
    assert traces.any()
    assert not search.fit_columns(columns, weights).coefficients[traces].any()


def test_plays_without_a_rate_are_given_none():
    t, u = cycles([2, 2, 20, 20, 60, 60], [1.0, 0.5, 1.0, 0.4, 1.0, 0.7])
    y = PrandtlIshlinskii(np.arange(5) / 5.0, np.ones(5)).evaluate(u)
    y += np.random.default_rng(0).normal(0.0, 2e-3, t.size)
    found = identify_in_time("rate-dependent-plays", t, u, y)
    assert not found.model.parameters()
    assert not found.warnings
    exact = PrandtlIshlinskii(np.arange(5) / 5.0, np.ones(5)).evaluate(u)
    assert not identify_in_time("rate-dependent-plays", t, u, exact, plays=5).model.parameters()
    forced = identify_in_time("rate-dependent-plays", t, u, y, time_constants=2)
    assert any("do not determine every time constant" in text for text in forced.warnings)


@cases(
    ("model", "options"),
    [("rate-dependent-plays", {"time_constants": 2}), ("hammerstein", {"levels": 10, "dynamics": "lag"})],
)
def test_few_samples_are_warned_of(model, options):
    rng = np.random.default_rng(0)
    t = np.arange(24.0)
    u = np.sin(0.9 * t)
    found = identify_in_time(model, t, u, u + 0.1 * rng.standard_normal(24), **options)
    assert any("24 samples are few" in text for text in found.warnings)


@cases(
    ("options", "message"),
    [
        ({"time_constants": 4}, "time_constants: expected 0 to 3"),
        ({"plays": 0}, "plays: expected at least 1"),
        ({"dead_zones": 2}, "options of rate-dependent-plays"),
        ({"initial": "estimate"}, "'estimate' needs"),
    ],
)
def test_wrong_options_are_refused(options, message):
    t = np.arange(50.0)
    with pytest.raises(ValueError, match=message):
        identify_in_time("rate-dependent-plays", t, np.sin(t), np.sin(t), **options)
