"""The Bouc-Wen oscillator and its identification."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cases import cases
from scipy.integrate import solve_ivp

from bench.identification import identify_in_time
from bench.models import BoucWenOscillator

# Noël and Schoukens 2016, in N and mm.
PUBLISHED = BoucWenOscillator(0.002, 0.01, 50.0, 50.0, 0.8, -1.1, 0.05, (-100.0, 100.0))
RATE = 750.0


def multisine(rng, samples, size=50.0):
    """Return one period of a random-phase multisine, 5 to 150 Hz."""
    lines = np.fft.rfftfreq(samples, 1.0 / RATE)
    spectrum = ((lines >= 5.0) & (lines <= 150.0)) * np.exp(2j * np.pi * rng.random(lines.size))
    u = np.fft.irfft(spectrum, samples)
    return size * u / u.std()


def reference(t, u_of, m=PUBLISHED):
    def slope(moment, state):
        y, v, z = state
        force = (u_of(moment) - m.damping * v - m.stiffness * y - z) / m.mass
        rate = m.hysteretic_stiffness * v - m.loop_rate * abs(v) * z - m.loop_shape * v * abs(z)
        return [v, force, rate]

    found = solve_ivp(slope, (t[0], t[-1]), [0.0, 0.0, 0.0], "RK45", t_eval=t, rtol=1e-9, atol=1e-11, max_step=5e-4)
    return found.y[0] + m.offset


@cases("interpolation", ["linear", "smooth"])
def test_responses_on_uneven_times_are_those_of_the_differential_equations(interpolation):
    t = np.cumsum(np.random.default_rng(0).uniform(5e-4, 2e-3, 200))

    def smooth(moment):
        return 60.0 * np.sin(2.0 * np.pi * 30.0 * (moment - t[0]))

    u = smooth(t)
    model = replace(PUBLISHED, interpolation=interpolation)
    expected = reference(t, smooth if interpolation == "smooth" else lambda moment: np.interp(moment, t, u))
    tolerance = 1e-3 if interpolation == "smooth" else 2e-5
    np.testing.assert_allclose(model.evaluate(t, u), expected, atol=tolerance)


def test_a_band_limited_input_is_interpolated_between_samples():
    t = np.arange(300) / RATE

    def swept(moment):
        return 40.0 * np.sin(2.0 * np.pi * (100.0 + 60.0 * moment) * moment)

    np.testing.assert_allclose(PUBLISHED.evaluate(t, swept(t))[:-32], reference(t, swept)[:-32], atol=2e-4)


def test_a_sequence_in_two_parts_and_a_model_from_json_are_the_same():
    t = np.arange(300) / RATE
    u = multisine(np.random.default_rng(0), 300)
    model = BoucWenOscillator.from_json(json.loads(json.dumps(replace(PUBLISHED, interpolation="linear").to_json())))
    whole, end = model.run(t, u)
    first, state = model.run(t[:120], u[:120])
    rest, again = model.run(
        t[120:], u[120:], model.state_from_json(json.loads(json.dumps(model.state_to_json(state))))
    )
    np.testing.assert_allclose(np.concatenate([first, rest]), whole, atol=1e-12)
    np.testing.assert_allclose(again, end, rtol=1e-9)
    assert model.state_from_json("periodic") == "periodic"


def test_a_periodic_start_repeats_itself():
    t = np.arange(512) / RATE
    u = multisine(np.random.default_rng(1), 512)
    once = PUBLISHED.evaluate(t, u, "periodic")
    long = np.arange(512 * 12) / RATE
    twelfth = PUBLISHED.evaluate(long, np.tile(u, 12))[-512:]
    np.testing.assert_allclose(once[:-64], twelfth[:-64], atol=2e-3)
    with pytest.raises(ValueError, match="even steps"):
        PUBLISHED.evaluate(t**1.01, u, "periodic")


@pytest.mark.parametrize("sign", [1.0, pytest.param(-1.0, marks=pytest.mark.seeds)])
def test_a_noisy_record_identifies_it_without_help(sign):
    rng = np.random.default_rng(2)
    t = np.arange(640) / RATE
    u = multisine(rng, 640)
    y = sign * PUBLISHED.evaluate(t, u, "periodic") + rng.normal(0.0, 8e-3, 640)
    found = identify_in_time("bouc-wen-oscillator", t, u, y)
    assert found.initial_state == "periodic"
    assert found.certificate.converged
    assert found.errors.rms < 9e-3
    assert found.model.mass == pytest.approx(sign * 0.002, rel=0.01)
    assert found.model.loop_rate == pytest.approx(0.8, rel=0.1)
    fresh = multisine(rng, 640)
    error = sign * PUBLISHED.evaluate(t, fresh, "periodic") - found.model.evaluate(t, fresh, "periodic")
    # The output is in mm; the benchmark counts in dB of 1 m.
    assert 20.0 * np.log10(1e-3 * np.sqrt(np.mean(error**2))) < -115.0


def test_what_cannot_be_an_oscillator_is_refused():
    t = np.arange(200) / RATE
    u = multisine(np.random.default_rng(3), 200)
    with pytest.raises(ValueError, match="at least 50 samples"):
        identify_in_time("bouc-wen-oscillator", t[:20], u[:20], u[:20])
    with pytest.raises(ValueError, match="several frequencies"):
        identify_in_time("bouc-wen-oscillator", t, np.sin(2 * np.pi * 3.75 * t), u)
    with pytest.raises(ValueError, match="that vary"):
        identify_in_time("bouc-wen-oscillator", t, u, np.zeros(200))
    with pytest.raises(ValueError, match="'rest', 'periodic' or None"):
        identify_in_time("bouc-wen-oscillator", t, u, u, initial="positive")
