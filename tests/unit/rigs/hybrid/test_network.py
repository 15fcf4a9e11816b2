"""The thermal network against Kirchhoff's laws, closed forms and an independent integration; its fit to steps."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from cases import cases
from scipy.integrate import solve_ivp

from rigs.hybrid.design import Design, Geometry, Materials, Tec
from rigs.hybrid.network import NODES, ThermalNetwork
from rigs.hybrid.network_identification import FREE_PARAMETERS, identify_network, room_influence

KELVIN = 273.15
NETWORK = Design().network()


def varied(rng, spread=1.0):
    """A network with every parameter somewhere else."""
    values = {each.name: getattr(NETWORK, each.name) for each in fields(NETWORK)}
    return ThermalNetwork(**{name: value * math.exp(rng.normal(0.0, spread)) for name, value in values.items()})


def kirchhoff(n, temperatures, current, ambient):
    """Currents into each node, with the massless one among the unknowns: K/s of the four others."""
    so, sf, t0, tl = temperatures + KELVIN
    ta = ambient + KELVIN
    joule = 0.5 * n.electrical_resistance * current**2
    # (T_x - T_sf)/R_c + (T_x - T_0)/R_th + alpha i T_x = J
    row = 1 / n.glue_resistance + 1 / n.tec_resistance + n.seebeck * current
    tx = (joule + sf / n.glue_resistance + t0 / n.tec_resistance) / row
    flows = [
        (ta - so) / n.block_side_resistance + (sf - so) / n.block_resistance,
        (ta - sf) / n.block_side_resistance
        + (ta - sf) / n.block_front_resistance
        + (so - sf) / n.block_resistance
        + (tx - sf) / n.glue_resistance,
        (ta - t0) / n.beam_side_resistance
        + (tl - t0) / n.beam_resistance
        + n.seebeck * t0 * current
        + joule
        + (tx - t0) / n.tec_resistance,
        (ta - tl) / n.beam_side_resistance + (ta - tl) / n.beam_end_resistance + (t0 - tl) / n.beam_resistance,
    ]
    return np.array(flows) / [n.block_capacity, n.block_capacity, n.beam_capacity + n.tec_capacity, n.beam_capacity]


def electrical_power(n, temperatures, current):
    """R_p i² + alpha (T_0 - T_x) i, with the back face that follows from the node before it, W."""
    _, front, t0, _ = temperatures + KELVIN
    joule = 0.5 * n.electrical_resistance * current**2
    row = 1 / n.glue_resistance + 1 / n.tec_resistance + n.seebeck * current
    tx = (joule + front / n.glue_resistance + t0 / n.tec_resistance) / row
    return n.electrical_resistance * current**2 + n.seebeck * (t0 - tx) * current


def heat_to_air(n, temperatures):
    """Into air of 22 °C, W."""
    rises = temperatures - 22.0
    sides = rises[:2].sum() / n.block_side_resistance + rises[2:].sum() / n.beam_side_resistance
    return sides + rises[1] / n.block_front_resistance + rises[3] / n.beam_end_resistance


def test_values_of_the_paper_put_right():
    expected = {
        "block_capacity": 23.14,
        "block_resistance": 0.148,
        "block_side_resistance": 23.0,
        "block_front_resistance": 46.3,
        "glue_resistance": 2.5,
        "seebeck": 12e-3,
        "electrical_resistance": 4.8,
        "tec_resistance": 83.3,
        "tec_capacity": 0.5,
        "beam_capacity": 0.01464,
        "beam_resistance": 195.0,
        "beam_side_resistance": 966.0,
        "beam_end_resistance": 5.56e4,
    }
    for name, value in expected.items():
        assert getattr(NETWORK, name) == pytest.approx(value, rel=2e-3), name


@cases("seed", range(5))
def test_thermal_sensitivity_is_that_of_timoshenkos_bimetal(seed):
    rng = np.random.default_rng(seed)
    e_p, e_c, s_p, s_c = np.exp(rng.normal(0.0, 1.0, 4)) * [2e-4, 1e-4, 15e-12, 9e-12]
    design = Design(
        Geometry(piezo_thickness=e_p, copper_thickness=e_c), Materials(piezo_compliance=s_p, copper_compliance=s_c)
    )
    # Timoshenko 1925: m of the thicknesses, n of the moduli, h in all.
    m, n, h = e_c / e_p, s_p / s_c, e_p + e_c
    curvature = 6.0 * (3.3e-6 - 17e-6) * (1 + m) ** 2 / (h * (3 * (1 + m) ** 2 + (1 + m * n) * (m**2 + 1 / (m * n))))
    assert design.thermal_sensitivity == pytest.approx(0.5 * curvature * 15e-3**2, rel=1e-12)


def test_piezo_and_thermal_strain_bend_alike():
    # A field U/e_p strains the layer by d31 U/e_p, a kelvin by the difference of the expansions.
    design = Design()
    strain = design.materials.piezo_coefficient / design.geometry.piezo_thickness
    expansion = design.materials.piezo_expansion - design.materials.copper_expansion
    assert design.piezo_sensitivity / design.thermal_sensitivity == pytest.approx(-strain / expansion)


@cases("seed", range(10))
def test_rates_follow_kirchhoff(seed):
    rng = np.random.default_rng(seed)
    network = varied(rng)
    temperatures, current, ambient = rng.uniform(-30.0, 60.0, 4), rng.uniform(-0.3, 0.3), rng.uniform(10.0, 30.0)
    expected = kirchhoff(network, temperatures, current, ambient)
    assert network.rates(temperatures, current, ambient) == pytest.approx(expected, rel=1e-9, abs=1e-10)


@cases("current", [-0.4, -0.1, -0.025, 0.0, 0.025, 0.1, 0.3])
def test_energy_balance_of_the_steady_state(current):
    settled = NETWORK.steady_state(current, 22.0)
    assert abs(heat_to_air(NETWORK, settled) - electrical_power(NETWORK, settled, current)) <= 1e-9
    assert np.abs(NETWORK.rates(settled, current, 22.0)).max() < 1e-12


def test_heat_at_a_tenth_of_an_ampere():
    settled = NETWORK.steady_state(-0.1, 22.0)
    assert heat_to_air(NETWORK, settled) == pytest.approx(0.074556, rel=1e-4)


@cases("ambient", [-5.0, 22.0, 37.3])
def test_rest_is_exactly_the_ambient_temperature(ambient):
    assert (NETWORK.steady_rises(0.0, ambient) == 0.0).all()
    assert (NETWORK.simulate(np.zeros(50), 7.0, ambient) == ambient).all()
    assert (NETWORK.rates(np.full(4, ambient), 0.0, ambient) == 0.0).all()


@cases(
    ("current", "base", "tip"),
    [(-0.1, -20.8, -17.3), (-0.05, -11.4, -9.5), (-0.025, -6.0, -5.0), (0.1, 30.1, 24.9)],
)
def test_swing(current, base, tip):
    rises = NETWORK.steady_rises(current, 22.0)
    assert rises[NODES.index("base")] == pytest.approx(base, abs=0.06)
    assert rises[NODES.index("tip")] == pytest.approx(tip, abs=0.06)


def test_linearisation_is_the_derivative():
    rng = np.random.default_rng(3)
    network = varied(rng, 0.2)
    for current in (-0.1, 0.0, 0.07):
        matrix, column = network.linearise(current, 22.0)
        settled = network.steady_state(current, 22.0)
        step = 1e-5
        slope = (network.rates(settled, current + step, 22.0) - network.rates(settled, current - step, 22.0)) / (
            2.0 * step
        )
        assert column == pytest.approx(slope, rel=1e-6)
        for node, direction in enumerate(1e-2 * np.eye(4)):
            change = network.rates(settled + direction, current, 22.0) - network.rates(settled, current, 22.0)
            assert matrix[:, node] == pytest.approx(100.0 * change, rel=1e-6, abs=1e-9)


def test_bandwidth_of_the_lumped_cooler():
    assert NETWORK.bandwidth("base") == pytest.approx(4.19e-3, rel=2e-3)
    assert 4e-3 < NETWORK.bandwidth("tip") < 5e-3
    assert NETWORK.bandwidth("tip") < NETWORK.bandwidth("base")


def test_simulation_equals_a_numerical_integration():
    rng = np.random.default_rng(0)
    currents, ambients, dt = rng.uniform(-0.15, 0.15, 12), rng.uniform(20.0, 24.0, 12), 20.0
    currents[4:7], ambients[4:7] = 0.05, 21.0
    start = np.array([23.0, 25.0, 10.0, 15.0])
    found = NETWORK.simulate(currents, dt, ambients, start=start)
    now = start
    for current, ambient, row in zip(currents, ambients, found, strict=True):
        assert row == pytest.approx(now, abs=1e-7)
        solution = solve_ivp(
            lambda _, y, i=current, a=ambient: kirchhoff(NETWORK, y, i, a),
            (0.0, dt),
            now,
            "Radau",
            rtol=1e-10,
            atol=1e-10,
        )
        now = solution.y[:, -1]


def test_weights_of_the_air_are_what_a_simulation_with_other_air_makes_of_the_sums():
    rng = np.random.default_rng(3)
    currents = np.repeat([0.0, -0.1, 0.05], 40)
    weights = rng.standard_normal((2, currents.size, len(NODES)))
    air, changed = np.full((2, currents.size), 22.0)
    changed[:70] += rng.standard_normal(70)
    moved = NETWORK.simulate(currents, 3.0, changed) - NETWORK.simulate(currents, 3.0, air)
    found = NETWORK.air_weights(currents, 3.0, weights) @ (changed - air)
    assert found == pytest.approx(np.tensordot(weights, moved, 2), rel=1e-9)


def test_the_influence_of_a_room_is_the_fit_times_the_covariance_of_its_temperatures():
    currents = np.repeat([-0.1, 0.0, 0.1, 0.0], 200)
    step, time = 3.0, 300.0
    clean = NETWORK.simulate(currents, step)[:, 2:]
    found = identify_network(currents, *clean.T, step, start=NETWORK)
    apart = np.abs(np.subtract.outer(np.arange(currents.size), np.arange(currents.size)))
    weights = np.concatenate([np.zeros_like(found.moves), found.moves], axis=2)
    moved = NETWORK.air_weights(currents, step, weights)
    variances = np.einsum("pi,ij,pj->p", moved, np.exp(-apart * step / time), moved)
    assert room_influence(found, currents, step, time) == pytest.approx(np.sqrt(variances), rel=1e-3)
    # Air that stays as it is has hardly an effect on what is relative to it.
    assert (room_influence(found, currents, step, math.inf) < 0.1 * np.sqrt(variances)).all()


def test_json():
    network = varied(np.random.default_rng(1))
    assert ThermalNetwork.from_json(network.to_json()) == network
    with pytest.raises(ValueError, match="thermal network: expected the key 'seebeck'"):
        ThermalNetwork.from_json({k: v for k, v in network.to_json().items() if k != "seebeck"})


TRUTH = replace(
    NETWORK,
    seebeck=11.6e-3,
    electrical_resistance=5.2,
    tec_resistance=75.0,
    tec_capacity=0.57,
    beam_resistance=230.0,
    beam_side_resistance=700.0,
    block_side_resistance=27.0,
)
STEPS = np.repeat([0.0, -0.1, 0.1, -0.05, 0.05, 0.0], [10, 300, 300, 300, 300, 400])


def measured(currents, noise, seed=0):
    temperatures = TRUTH.simulate(currents, 1.0, 22.7)[:, 2:]
    return (temperatures + noise * np.random.default_rng(seed).normal(size=temperatures.shape)).T


def test_fit_to_exact_steps_finds_the_network():
    found = identify_network(STEPS, *measured(STEPS, 0.0), 1.0)
    for name in FREE_PARAMETERS:
        assert getattr(found.network, name) == pytest.approx(getattr(TRUTH, name), rel=1e-6), name
    assert found.ambient == pytest.approx(22.7, abs=1e-8)
    assert found.base.maximum < 1e-6


@cases("seed", range(3))
def test_fit_to_noisy_steps_is_right_within_its_uncertainties(seed):
    found = identify_network(STEPS, *measured(STEPS, 0.02, seed), 1.0)
    errors = [
        (getattr(found.network, name) - getattr(TRUTH, name)) / found.uncertainties[name] for name in FREE_PARAMETERS
    ]
    assert np.abs(errors).max() < 4.0
    assert abs(found.ambient - 22.7) < 4.0 * found.uncertainties["ambient"]
    for name in FREE_PARAMETERS:
        assert found.uncertainties[name] < 0.03 * getattr(TRUTH, name), name
    assert found.base.rms == pytest.approx(0.02, rel=0.1)
    assert found.residuals.shape == (STEPS.size, 2)
    assert found.gradient < 1e-4
    assert found.network.bandwidth("base") == pytest.approx(TRUTH.bandwidth("base"), rel=5e-3)


def test_heat_has_no_scale_of_its_own():
    factor = 1.7
    scaled = ThermalNetwork(
        **{
            each.name: getattr(NETWORK, each.name)
            * (factor if each.name.endswith(("capacity", "seebeck", "electrical_resistance")) else 1.0 / factor)
            for each in fields(NETWORK)
        }
    )
    assert scaled.simulate(STEPS, 1.0) == pytest.approx(NETWORK.simulate(STEPS, 1.0), abs=1e-9)
    # What is then still held has too little effect to set the scale.
    steps = np.repeat([0.0, -0.1, 0.1], [10, 300, 300])
    scaleless = (*FREE_PARAMETERS, "block_capacity", "beam_capacity", "block_front_resistance", "glue_resistance")
    with pytest.raises(ValueError, match=r"the data do not tell seebeck, .* apart"):
        identify_network(steps, *measured(steps, 0.02), 1.0, free=scaleless)


@pytest.mark.slow
def test_data_that_do_not_identify_are_refused():
    still = np.zeros(50)
    with pytest.raises(ValueError, match="do not depend on seebeck"):
        identify_network(still, *measured(still, 0.02), 1.0)
    single = np.repeat([0.0, -0.1], [10, 300])
    with pytest.raises(ValueError, match="do not identify seebeck"):
        identify_network(single, *measured(single, 0.02), 1.0)


@cases(
    ("make", "message"),
    [
        (lambda: Geometry(beam_length=0.0), "beam_length: expected a positive"),
        (lambda: Geometry(tec_length=0.2), "does not fit on the front"),
        (lambda: Materials(glue_conductivity=-1.0), "glue_conductivity: expected a positive"),
        (lambda: Materials(copper_expansion=np.nan), "copper_expansion: expected a finite"),
        (lambda: Tec(seebeck=0.0), "seebeck: expected a positive"),
        (lambda: replace(NETWORK, tec_capacity=0.0), "tec_capacity: expected a positive"),
        (lambda: NETWORK.rates([1.0], 0.0, 22.0), "temperatures: expected 4 values"),
        (lambda: NETWORK.steady_rises(-40.0), "expected more than -34"),
        (lambda: NETWORK.steady_rises(1.5), "heats faster than it cools"),
        (lambda: NETWORK.steady_rises(np.inf), "current: expected a finite"),
        (lambda: NETWORK.steady_rises(0.0, -300.0), "ambient: expected °C above absolute zero"),
        (lambda: NETWORK.bandwidth("middle"), "node: expected one of block end"),
        (lambda: NETWORK.simulate([], 1.0), "currents: expected at least one"),
        (lambda: NETWORK.simulate([0.0], 0.0), "dt: expected a positive"),
        (lambda: NETWORK.simulate([0.0, 1.0], 1.0, [22.0]), "ambient: expected one value or 2"),
        (lambda: NETWORK.simulate([0.0], 1.0, [-280.0]), "ambient: expected °C above"),
        (lambda: NETWORK.simulate([0.0], 1.0, start=[22.0]), "start: expected 4 values"),
        (lambda: identify_network([0.0], [22.0, 22.0], [22.0], 1.0), "base: expected 1 values"),
        (lambda: identify_network([0.0], [22.0], [22.0, 1.0], 1.0), "tip: expected 1 values"),
        (lambda: identify_network([0.0] * 4, [22.0] * 4, [22.0] * 4, 1.0), "currents: expected more than 4 samples"),
        (lambda: identify_network([0.0], [22.0], [22.0], 1.0, free=["alpha"]), "free: expected different ones"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
