"""The whole hybrid model against its parts put together independently, and the fits of its static parts."""

import json
import math
from functools import cache

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st
from scipy import signal
from scipy.integrate import solve_ivp

from bench.models import Polynomial, PrandtlIshlinskii
from rigs.hybrid.design import Design
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel, choose_order, identify_pi, identify_polynomial
from rigs.hybrid.network import NODES

NETWORK = Design().network()
TIP = NODES.index("tip")
MICRO = 1e-6


def quartic(rises):
    """A thermal deflection of fourth order, m, falling over -16 to 24 K."""
    x = np.asarray(rises)
    return MICRO * (-7.36 * x - 0.05 * x**2 + 2e-3 * x**3 + 4e-5 * x**4)


def polynomial():
    rises = np.linspace(-20.0, 28.0, 9)
    return identify_polynomial(rises, quartic(rises), 4).model


def plays(count=15, maximum=40.0):
    """Weights falling off with the threshold, m/V."""
    thresholds = maximum * np.arange(count) / count
    weights = 0.02 * MICRO * np.exp(-thresholds / 15.0)
    weights[0] = 0.17 * MICRO
    return PrandtlIshlinskii(thresholds, weights, input_range=(-maximum, maximum), input_unit="V", output_unit="m")


def model(**changes):
    parts = {"polynomial": polynomial(), "hysteresis": plays(), "dynamics": PUBLISHED_DYNAMICS, **changes}
    return HybridModel(NETWORK, **parts)


def loop(amplitude=40.0, periods=2, count=2000):
    return amplitude * np.sin(2.0 * np.pi * periods * np.arange(count) / count)


def bouc_wen(voltages):
    """A hysteresis that no Prandtl-Ishlinskii operator represents, µm."""
    h, outputs, last = 0.0, [], 0.0
    for u in voltages:
        steps = max(1, math.ceil(abs(u - last) / 0.1))
        for du in [(u - last) / steps] * steps:
            h += 0.30 * 0.283 * du - 0.040 * abs(du) * h - 0.006 * du * abs(h)
        last = u
        outputs.append(0.283 * u - h + 2.5e-4 * u**2)
    return np.array(outputs)


def test_equals_an_independent_integration():
    hybrid = model()
    rng = np.random.default_rng(0)
    dt, count = 2e-4, 400
    currents = np.repeat(rng.uniform(-0.15, 0.15, 4), count // 4)
    voltages = np.repeat(rng.uniform(-40.0, 40.0, count // 20), 20)
    response = hybrid.simulate(currents, voltages, dt, 23.5)
    # Piezo: plays one by one with their own memory, then the printed D(s) over its gain.
    states = np.zeros(15)
    static = []
    for u in voltages:
        states = np.maximum(u - hybrid.hysteresis.thresholds, np.minimum(u + hybrid.hysteresis.thresholds, states))
        static.append(hybrid.hysteresis.weights @ states)
    system = signal.TransferFunction(
        [102.0, 102.0 * 2.58e4, 102.0 * 2.4e8], 1.0113195075601091 * np.polymul([1.0, 1274.0], [1.0, 34.1, 1.9e7])
    )
    fine = 20
    times = dt / fine * np.arange(count * fine)
    # Held inputs, as lsim does without interpolation.
    _, piezo, _ = signal.lsim(system, np.repeat(static, fine), times, interp=False)
    assert response.piezo == pytest.approx(piezo[::fine], abs=1e-6 * MICRO)

    def rates(t, y):
        return NETWORK.rates(y, currents[min(int(t / dt), count - 1)], 23.5)

    grid = dt * np.arange(count)
    solution = solve_ivp(
        rates, (0.0, grid[-1]), np.full(4, 23.5), "Radau", grid, max_step=1e-3, rtol=1e-8, atol=1e-10
    )
    assert response.temperatures == pytest.approx(solution.y.T, abs=1e-4)
    thermal = quartic(solution.y[TIP] - 22.0)
    assert response.thermal == pytest.approx(thermal, abs=1e-3 * MICRO)
    assert (response.deflections == response.thermal + response.piezo).all()


def test_settles_at_polynomial_and_hysteresis():
    response = model().simulate(np.full(400, 0.1), np.full(400, 30.0), 20.0)
    rise = NETWORK.steady_rises(0.1)[TIP]
    assert response.thermal[-1] == pytest.approx(quartic(rise), abs=1e-6 * MICRO)
    assert response.piezo[-1] == pytest.approx(plays().evaluate([30.0])[0], rel=1e-12)


def test_rests_at_zero_whatever_the_zero_of_the_sensor():
    shifted = model(
        polynomial=polynomial().with_coefficients(polynomial().coefficients, 5e-6),
        hysteresis=plays().with_coefficients(plays().coefficients, -3e-6),
    )
    rest = shifted.simulate(np.zeros(10), np.zeros(10), 0.1)
    assert (rest.deflections == 0.0).all()
    driven = shifted.simulate(np.full(10, 0.1), np.full(10, 5.0), 0.1)
    plain = model().simulate(np.full(10, 0.1), np.full(10, 5.0), 0.1)
    assert driven.deflections == pytest.approx(plain.deflections, abs=1e-9 * MICRO)


def test_room_that_warms_bends_the_cantilever():
    air = np.where(np.arange(200) < 5, 22.0, 24.0)
    response = model().simulate(np.zeros(200), np.zeros(200), 30.0, air)
    assert (response.deflections[:6] == 0.0).all()
    assert response.thermal[-1] == pytest.approx(quartic(2.0), rel=1e-3)
    assert model(reference=24.0).simulate([0.0], [0.0], 1.0, 24.0).deflections[0] == 0.0


def test_json():
    hybrid = model(reference=21.0)
    document = json.loads(json.dumps(hybrid.to_json()))
    again = HybridModel.from_json(document)
    assert again.to_json() == hybrid.to_json()
    inputs = np.full(20, 0.05), loop(30.0, 1, 20), 0.3
    assert (again.simulate(*inputs).deflections == hybrid.simulate(*inputs).deflections).all()
    del document["dynamics"]
    with pytest.raises(ValueError, match="hybrid: expected the key 'dynamics'"):
        HybridModel.from_json(document)


def test_order_is_four_for_a_fourth_order_curve():
    rng = np.random.default_rng(0)
    rises = np.linspace(-16.0, 24.0, 60)
    curve = MICRO * (-7.36 * rises - 0.05 * rises**2 + 2e-3 * rises**3 + 2e-4 * rises**4)
    found = choose_order(rises, curve + 0.02 * MICRO * rng.normal(size=60))
    assert found.order == 4
    assert len(found.rms) == 8
    assert list(found.rms) == sorted(found.rms, reverse=True)
    assert found.rms[3] == pytest.approx(0.02 * MICRO, rel=0.3)
    assert found.rms[2] > 10.0 * found.rms[3]
    expected = np.polynomial.Polynomial.fit(rises, curve, 1)(rises)
    assert found.rms[0] == pytest.approx(np.sqrt(np.mean((curve - expected) ** 2)), rel=0.01)


def test_polynomial_is_found_and_its_offset_is_the_sensors():
    rng = np.random.default_rng(1)
    rises = rng.uniform(-16.0, 24.0, 200)
    measured = quartic(rises) + 4e-6 + 10e-9 * rng.normal(size=200)
    found = identify_polynomial(rises, measured, 4)
    assert found.errors.rms == pytest.approx(10e-9, rel=0.15)
    hybrid = model(polynomial=found.model)
    inside = np.linspace(-15.0, 23.0, 50)
    assert hybrid.thermal_deflection(inside) == pytest.approx(quartic(inside), abs=20e-9)
    assert identify_polynomial(rises, measured).model.degree == choose_order(rises, measured).order
    assert (found.model.input_unit, found.model.output_unit) == ("K", "m")


def test_plays_are_found():
    truth = plays()
    voltages = np.concatenate([[0.0], loop()])
    rng = np.random.default_rng(0)
    found = identify_pi(voltages, truth.evaluate(voltages) + 2e-6 + 1e-9 * rng.normal(size=voltages.size))
    assert found.model.thresholds == pytest.approx(40.0 * np.arange(15) / 15)
    assert found.model.weights == pytest.approx(truth.weights, abs=0.002 * MICRO)
    assert found.model.bias == pytest.approx(2e-6, abs=2e-9)
    assert (found.model.weights >= 0.0).all()
    assert found.model.input_range == pytest.approx((-40.0, 40.0))
    assert found.errors.rms == pytest.approx(1e-9, rel=0.1)
    assert found.certificate.converged


@given(
    seed=st.integers(0, 2**32 - 1),
    start=st.lists(st.floats(-40.0, 40.0), max_size=6),
    targets=st.lists(st.floats(-9.0, 9.0), min_size=1, max_size=20),
)
def test_composition_with_the_inverse_from_any_start(seed, start, targets):
    forward, inverse = fitted(), fitted().inverse_operator()
    state = forward.advance(forward.initial_state(), start) if start else forward.initial_state()
    back = forward.inverse_state(state)
    for target in MICRO * np.array(targets):
        back, voltage = inverse.step(back, float(target))
        state, reached = forward.step(state, voltage)
        assert abs(reached - target) <= 1e-12 * MICRO


@cache
def fitted():
    """The operator fitted to another hysteresis."""
    voltages = loop()
    return identify_pi(voltages, MICRO * bouc_wen(voltages)).model


RISES = np.linspace(-10.0, 10.0, 21)


@cases(
    ("make", "message"),
    [
        (lambda: model(polynomial=Polynomial([1e-6], (5.0, 10.0))), "expected a range of rises that extends to 0 K"),
        (lambda: model(reference=np.nan), "reference: expected a finite"),
        (lambda: model().simulate([0.0], [0.0, 1.0], 1.0), "voltages: expected 1 values"),
        (lambda: model().simulate([0.0], [50.0], 1.0), "voltages: expected -40 to 40 V, the range of the hysteresis"),
        (lambda: model().simulate([0.15] * 9, [0.0] * 9, 60.0), "tip above the reference: expected -20 to 28 K"),
        (lambda: model().simulate([0.0], [0.0], 0.0), "dt: expected a positive"),
        (lambda: choose_order(RISES, RISES, maximum=0), "maximum: expected at least 1"),
        (lambda: choose_order(RISES, RISES, fraction=0.0), "fraction: expected a number between"),
        (lambda: choose_order(RISES[:8], RISES[:8]), "rises: expected more than 8 different values"),
        (lambda: identify_polynomial(RISES + 20.0, RISES, 1), "extends to 0 K, got 10 to 30 K"),
        (lambda: identify_polynomial(RISES, RISES, 0), "degree: expected at least 1"),
        (lambda: identify_pi(np.zeros(5), np.zeros(5)), "voltages: expected values that vary"),
        (lambda: identify_pi(loop(), loop(), maximum=30.0), "up to ±30 V, got up to ±40 V"),
        (lambda: identify_pi(loop(), -loop()), "expected a positive weight of the first play"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
