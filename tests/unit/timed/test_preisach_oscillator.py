"""The Preisach oscillator and its identification."""

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.identification import identify_in_time
from bench.models import PrandtlIshlinskii, Preisach, PreisachOscillator, QuadraticTerm, uniform_levels

RATE = 750.0


def plant(sign=1.0, interpolation="smooth"):
    rows, columns = np.tril_indices(8)
    density = -6.0 * np.exp(-(((rows - columns) / 3.0) ** 2))
    force = Preisach(uniform_levels(-3.0, 3.0, 8), sign * density, 0.3, QuadraticTerm(140.0 * sign))
    return PreisachOscillator(0.002 * sign, 0.02 * sign, force, 0.1, (-150.0, 150.0), interpolation)


def multisine(rng, samples):
    """Return one period of a random-phase multisine, 5 to 150 Hz."""
    lines = np.fft.rfftfreq(samples, 1.0 / RATE)
    u = np.fft.irfft(((lines >= 5.0) & (lines <= 150.0)) * np.exp(2j * np.pi * rng.random(lines.size)), samples)
    return 50.0 * u / u.std()


def reference(t, u, model):
    """Integrate from reversal to reversal: between them the force depends on the displacement alone."""
    memory, state, now, samples = model.rest, np.zeros(2), t[0], [0.0]

    def slope(moment, state):
        force = model.force.evaluate([state[0]], memory)[0]
        return [state[1], (np.interp(moment, t, u) - model.damping * state[1] - force) / model.mass]

    def reversal(_, state):
        return state[1]

    reversal.terminal = True
    while len(samples) < t.size:
        wanted = t[len(samples) :]
        found = solve_ivp(
            slope, (now, t[-1]), state, "RK45", t_eval=wanted, events=reversal, rtol=1e-8, atol=1e-9, max_step=4e-4
        )
        samples += found.y[0].tolist() if len(found.t) else []
        if found.status == 1:
            now, at = found.t_events[0][0], found.y_events[0][0]
            memory = memory.step(float(at[0]))
            # The velocity takes the sign of the acceleration, or the same reversal would be found again.
            rise = slope(now, [at[0], 0.0])[1]
            state = np.array([at[0], 1e-9 * np.sign(rise)])
    return np.array(samples) + model.offset


def test_responses_are_those_of_the_differential_equations():
    t = np.cumsum(np.random.default_rng(0).uniform(5e-4, 2e-3, 120))
    u = 90.0 * np.sin(2.0 * np.pi * 33.0 * (t - t[0])) + 40.0 * np.sin(2.0 * np.pi * 51.0 * (t - t[0]))
    model = plant(interpolation="linear")
    expected = reference(t, u, model)
    assert np.ptp(expected) > 3.0
    np.testing.assert_allclose(model.evaluate(t, u), expected, atol=2e-4 * np.ptp(expected))


def test_a_sequence_in_two_parts_and_a_model_from_json_are_the_same():
    t = np.arange(300) / RATE
    u = multisine(np.random.default_rng(0), 300)
    model = PreisachOscillator.from_json(json.loads(json.dumps(plant(interpolation="linear").to_json())))
    whole, end = model.run(t, u)
    np.testing.assert_array_equal(whole, plant(interpolation="linear").evaluate(t, u))
    first, state = model.run(t[:120], u[:120])
    rest, again = model.run(
        t[120:], u[120:], model.state_from_json(json.loads(json.dumps(model.state_to_json(state))))
    )
    np.testing.assert_allclose(np.concatenate([first, rest]), whole, atol=1e-9)
    np.testing.assert_allclose(again[:3], end[:3], rtol=1e-6)
    assert len(again.memory.extrema) == len(end.memory.extrema)
    assert model.state_from_json("periodic") == "periodic"
    with pytest.raises(ValueError, match="velocity, memory, got 3"):
        model.state_from_json(3)


@pytest.mark.parametrize("sign", [pytest.param(1.0, marks=pytest.mark.seeds), -1.0])
def test_a_noisy_record_identifies_it_without_help(sign):
    rng = np.random.default_rng(0)
    t = np.arange(1024) / RATE
    u, model = multisine(rng, 1024), plant(sign)
    clean = model.evaluate(t, u, "periodic")
    found = identify_in_time("preisach-oscillator", t, u, clean + rng.normal(0.0, 8e-3, 1024), levels=8)
    assert found.initial_state == "periodic"
    assert found.errors.rms < 9e-3
    assert found.orientation == ("falling" if sign > 0.0 else "rising")
    assert found.model.mass == pytest.approx(0.002 * sign, rel=0.01)
    assert found.model.stiffness == pytest.approx(140.0 * sign, rel=0.05)
    fresh = multisine(rng, 1024)
    expected = model.evaluate(t, fresh, "periodic")
    assert np.std(found.model.evaluate(t, fresh, "periodic") - expected) < 0.05 * np.std(expected)


def test_what_does_not_fit_is_refused():
    t = np.arange(200) / RATE
    u = multisine(np.random.default_rng(3), 200)
    with pytest.raises(ValueError, match="levels: expected 2 to 40"):
        identify_in_time("preisach-oscillator", t, u, u, levels=1)
    with pytest.raises(ValueError, match="at least 50 samples"):
        identify_in_time("preisach-oscillator", t[:20], u[:20], u[:20])
    with pytest.raises(ValueError, match="that vary"):
        identify_in_time("preisach-oscillator", t, u, np.zeros(200))
    with pytest.raises(ValueError, match="'rest', 'periodic' or None"):
        identify_in_time("preisach-oscillator", t, u, u, initial="positive")
    with pytest.raises(ValueError, match="expected a Preisach operator"):
        PreisachOscillator(1.0, 1.0, PrandtlIshlinskii([0.0], [1.0]), 0.0, (0.0, 1.0))
