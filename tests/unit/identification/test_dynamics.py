"""Third-order dynamics against numerical integration and the published numbers; the prediction error method."""

import math

import numpy as np
import pytest
from cases import cases
from scipy import signal
from scipy.linalg import expm

from bench.identification import ThirdOrder, identify_dynamics
from rigs.hybrid.model import PUBLISHED_DYNAMICS

# 40 V of a piezo cantilever, about 0.27 µm/V.
VOLTAGE, GAIN = 40.0, 0.27e-6
PIEZO = ThirdOrder(
    GAIN,
    PUBLISHED_DYNAMICS.real_pole,
    PUBLISHED_DYNAMICS.frequency,
    PUBLISHED_DYNAMICS.damping,
    PUBLISHED_DYNAMICS.numerator,
)


def printed():
    """Equation 21 of the paper as numerator and denominator."""
    return [102.0, 102.0 * 2.58e4, 102.0 * 2.4e8], np.polymul([1.0, 1274.0], [1.0, 34.1, 1.9e7])


def measured(model, rate, *, seed=0, delay=0.0, offset=3e-6, noise=10e-9, before=20, duration=0.3):
    count = int(duration * rate)
    times = (np.arange(count) - before) / rate
    outputs = VOLTAGE * model.step_response(times - delay) + offset
    outputs = outputs + noise * np.random.default_rng(seed).normal(size=count)
    # The sensor's resolution is 10 nm.
    return np.where(np.arange(count) < before, 0.0, VOLTAGE), np.round(outputs, 8) if noise else outputs, 1.0 / rate


def test_published_poles_zeros_and_gain():
    zeros, poles = PUBLISHED_DYNAMICS.zeros, PUBLISHED_DYNAMICS.poles
    assert poles == pytest.approx([-1274.0, -17.05 + 4358.9j, -17.05 - 4358.9j], rel=1e-5)
    assert sorted(zeros, key=np.imag) == pytest.approx([-12900.0 - 8578.0j, -12900.0 + 8578.0j], rel=1e-4)
    assert PUBLISHED_DYNAMICS.gain == pytest.approx(1.0113, abs=5e-5)
    assert PUBLISHED_DYNAMICS.damping == pytest.approx(0.0039, abs=5e-5)
    assert poles[0].real / (-2.0 * math.pi) == pytest.approx(202.8, abs=0.1)
    assert PUBLISHED_DYNAMICS.frequency / (2.0 * math.pi) == pytest.approx(693.7, abs=0.1)


def test_overshoot_is_that_of_a_fine_grid():
    times = np.arange(0.0, 0.3, 1e-6)
    response = PUBLISHED_DYNAMICS.step_response(times) / PUBLISHED_DYNAMICS.gain
    assert PUBLISHED_DYNAMICS.overshoot() == pytest.approx(response.max() - 1.0, rel=1e-5)
    assert PUBLISHED_DYNAMICS.overshoot() == pytest.approx(0.265, abs=5e-4)
    assert ThirdOrder(-2.0, 10.0, 1000.0, 0.8).overshoot() == 0.0


def test_frequency_response():
    frequencies = np.geomspace(1.0, 1e5, 50)
    _, expected = signal.freqs(*printed(), worN=2.0 * np.pi * frequencies)
    assert PUBLISHED_DYNAMICS.response(frequencies) == pytest.approx(expected, rel=1e-12)
    assert PUBLISHED_DYNAMICS.bandwidth() == pytest.approx(276.0, abs=0.5)
    unit = PUBLISHED_DYNAMICS.normalised()
    # Back up at the resonance, and -3 dB for good at 809 Hz.
    assert abs(unit.response([693.7])[0]) == pytest.approx(37.0, rel=0.01)
    assert abs(unit.response([809.0])[0]) == pytest.approx(math.sqrt(0.5), rel=0.01)


@cases("numerator", [(0.0, 0.0), (1e-4, 0.0), (-1e-4, 0.0), (2e-4, 1e-8), (1e-4, -1e-8)])
def test_zeros_of_any_kind(numerator):
    model = ThirdOrder(0.7, 800.0, 3000.0, 0.1, numerator)
    zeros, poles = model.zeros, model.poles
    # The numerator is 1 at s = 0.
    factor = (model.gain * np.prod(-poles) / np.prod(-zeros)).real
    assert zeros.size == np.count_nonzero(numerator)
    frequencies = np.array([0.0, 10.0, 400.0, 5000.0])
    _, expected = signal.freqs_zpk(zeros, poles, factor, worN=2.0 * np.pi * frequencies)
    assert model.response(frequencies) == pytest.approx(expected, rel=1e-10)
    assert model.response([model.bandwidth()])[0] == pytest.approx(
        0.7 * math.sqrt(0.5) * np.exp(1j * np.angle(model.response([model.bandwidth()])[0])), rel=1e-9
    )
    times = np.linspace(0.0, 0.02, 300)
    _, response = signal.step(signal.ZerosPolesGain(zeros, poles, factor), T=times)
    assert model.step_response(times) == pytest.approx(response, abs=1e-9)


@cases("dt", [1e-7, 5e-5, 1e-3, 1.0])
def test_held_step_is_the_step_response_at_the_samples(dt):
    found = PUBLISHED_DYNAMICS.simulate(np.ones(500), dt)
    assert found == pytest.approx(PUBLISHED_DYNAMICS.step_response(dt * np.arange(500)), abs=1e-12)


def test_simulation_of_held_inputs_is_exact():
    rng = np.random.default_rng(0)
    inputs, dt = rng.normal(size=200), 3.7e-4
    # The matrix exponential of the state and its held input, in units of 1 ms.
    a, b, c, _ = signal.tf2ss(*printed())
    scale = np.diag([1e6, 1e3, 1.0])
    system = np.zeros((4, 4))
    system[:3, :3] = scale @ a @ np.linalg.inv(scale)
    system[:3, 3:] = scale @ b
    transition = expm(dt * system)
    state, expected = np.zeros(3), []
    for u in inputs:
        expected.append((c @ np.linalg.inv(scale) @ state)[0])
        state = transition[:3, :3] @ state + transition[:3, 3] * u
    assert PUBLISHED_DYNAMICS.simulate(inputs, dt) == pytest.approx(expected, abs=1e-9)


@cases(("rate", "seed"), [(5e3, 2), (1e4, 1), (2e4, 3)])
def test_poles_from_a_noisy_step(rate, seed):
    found = identify_dynamics(*measured(PIEZO, rate, seed=seed, delay=0.3 * seed / rate))
    for name in ("real_pole", "frequency", "damping"):
        assert getattr(found.model, name) == pytest.approx(getattr(PIEZO, name), rel=0.02), name
    poles = found.model.poles
    assert np.abs(poles - PIEZO.poles).max() < 0.02 * np.abs(PIEZO.poles[0])
    assert np.abs(poles[1] - PIEZO.poles[1]) < 0.02 * abs(PIEZO.poles[1].real)
    assert found.model.gain == pytest.approx(GAIN, rel=2e-3)
    assert found.offset == pytest.approx(3e-6, abs=1e-8)
    assert found.gradient < 1e-3
    assert found.condition < 1e4
    # 10 nm of noise and the rounding to 10 nm.
    assert found.errors.rms == pytest.approx(math.hypot(10e-9, 10e-9 / math.sqrt(12.0)), rel=0.1)
    # Noise moves the delay against the zeros.
    assert abs(found.delay * rate - 0.3 * seed) < (1.5 if rate < 1e4 else 0.6)
    assert found.model.overshoot() == pytest.approx(0.265, abs=0.01)


def test_exact_step_gives_the_exact_system():
    truth = ThirdOrder(-1.5, 900.0, 1.03 * PIEZO.frequency, 0.02, (5e-5, 2e-9))
    found = identify_dynamics(*measured(truth, 2e4, noise=0.0, delay=2.37e-4, offset=-0.4))
    assert found.model.real_pole == pytest.approx(900.0, rel=1e-5)
    assert found.model.frequency == pytest.approx(truth.frequency, rel=1e-6)
    assert found.model.damping == pytest.approx(0.02, rel=1e-5)
    assert found.model.gain == pytest.approx(-1.5, rel=1e-6)
    assert found.model.numerator == pytest.approx((5e-5, 2e-9), rel=1e-3)
    assert found.delay == pytest.approx(2.37e-4, abs=1e-8)
    assert found.offset == pytest.approx(-0.4)


@pytest.mark.slow
def test_uncertainties_are_the_scatter_of_the_estimates():
    found = [identify_dynamics(*measured(PIEZO, 1e4, seed=seed, delay=5e-5)) for seed in range(15)]
    for name in ("real_pole", "frequency", "damping", "gain"):
        scatter = np.std([getattr(each.model, name) for each in found], ddof=1)
        assert scatter == pytest.approx(np.mean([each.uncertainties[name] for each in found]), rel=0.5), name


def test_a_step_down_from_a_held_voltage():
    _, outputs, dt = measured(PIEZO, 1e4)
    inputs = np.where(np.arange(outputs.size) < 20, 25.0, 25.0 - VOLTAGE)
    found = identify_dynamics(inputs, -outputs, dt)
    assert found.model.gain == pytest.approx(GAIN, rel=2e-3)
    assert found.model.real_pole == pytest.approx(1274.0, rel=0.02)


def test_data_that_do_not_identify_are_refused():
    inputs, outputs, dt = measured(PIEZO, 1e4)
    rng = np.random.default_rng(2)
    with pytest.raises(ValueError, match="no resonance stands out"):
        identify_dynamics(inputs, 1e-8 * rng.normal(size=outputs.size), dt)
    with pytest.raises(ValueError, match="no resonance stands out"):
        identify_dynamics(inputs, np.full(outputs.size, 2.0), dt)
    # A real pole that is long over at the first sample.
    fast = ThirdOrder(GAIN, 2e5, PIEZO.frequency, PIEZO.damping)
    with pytest.raises(ValueError, match="does not identify real_pole"):
        identify_dynamics(*measured(fast, 1e4))


def test_json():
    assert ThirdOrder.from_json(PUBLISHED_DYNAMICS.to_json()) == PUBLISHED_DYNAMICS
    with pytest.raises(ValueError, match="third-order dynamics: expected the key 'gain'"):
        ThirdOrder.from_json({})


FLAT = np.zeros(100)
STEP = np.repeat([0.0, 1.0], 50)


@cases(
    ("make", "message"),
    [
        (lambda: ThirdOrder(0.0, 1.0, 1.0, 0.1), "gain: expected a number other than 0"),
        (lambda: ThirdOrder(1.0, -1.0, 1.0, 0.1), "real_pole: expected a positive"),
        (lambda: ThirdOrder(1.0, 1.0, 0.0, 0.1), "frequency: expected a positive"),
        (lambda: ThirdOrder(1.0, 1.0, 1.0, 1.0), "damping: expected less than 1"),
        (lambda: ThirdOrder(1.0, 1.0, 1.0, 0.1, (1.0, 2.0, 3.0)), "numerator: expected n1 and n2"),
        (lambda: PUBLISHED_DYNAMICS.simulate([1.0], 0.0), "dt: expected a positive"),
        (lambda: PUBLISHED_DYNAMICS.simulate([np.nan], 1.0), "inputs: expected finite"),
        (lambda: identify_dynamics(STEP, FLAT[:5], 1e-4), "outputs: expected 100 values"),
        (lambda: identify_dynamics(STEP, FLAT, 0.0), "dt: expected a positive"),
        (lambda: identify_dynamics(FLAT, FLAT, 1e-4), "expected exactly one step, got 0"),
        (lambda: identify_dynamics(np.arange(100.0), FLAT, 1e-4), "expected exactly one step, got 99"),
        (lambda: identify_dynamics(STEP[:99], FLAT[:99], 1e-4), "expected at least 50 samples"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
