"""Mid-ranging control on the plant, with a model that was identified on another plant of the same kind."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from cases import cases
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from bench.base import ConfigurationError, ConvergenceError
from bench.control import AddedSine, SmoothMoves
from bench.identification import identify_dynamics
from bench.rig import load_rig
from rigs.hybrid.control import (
    HybridController,
    MidRangingParameters,
    OpenLoopHybrid,
    ThermalFeedback,
    make_fine,
)
from rigs.hybrid.design import Design
from rigs.hybrid.estimates import Bending, ReducedNetwork, UnscentedEstimate
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel, identify_pi, identify_polynomial
from rigs.hybrid.network_identification import identify_network
from rigs.hybrid.notch_loop import NotchLoopParameters
from sim_devices.plants.hybrid import HybridCantilever
from sim_devices.plants.hybrid_parameters import HybridParameters

MICRO, NANO = 1e-6, 1e-9
TUNING = load_rig("hybrid").protocols["hybrid-control"]["tuning"]
MID_RANGING = TUNING["mid-ranging"]
PERIOD, FAST = 5e-3, 5e-5
SPEED = 3 * MICRO
NOISE = (10 * NANO, 0.02, 0.02)


def settings(**changes):
    return MidRangingParameters.at_rate(1.0 / PERIOD, {**MID_RANGING, **changes}, maximum_current=0.15)


def fine(model, reference, rate=20e3, integral=300.0):
    return make_fine(
        model, reference, NotchLoopParameters(rate=rate, integral=integral, stroke=MID_RANGING["stroke"])
    )


def plant_of(*seed, **parameters):
    return HybridCantilever(HybridParameters(**parameters), np.random.default_rng(list(seed)))


def sensed(deflection, noise):
    """The displacement sensor: white noise, rounding to 10 nm, a range of ±200 µm."""
    return min(max(round((deflection + noise) / (10 * NANO)) * 10 * NANO, -200 * MICRO), 200 * MICRO)


def readings(plant, noise):
    return (
        sensed(plant.deflection, noise[0]),
        plant.base_temperature + noise[1],
        plant.tip_temperature + noise[2],
    )


def identified(seed):
    """Identify as a protocol would: steps of the current, a static curve, a slow loop of the voltage, a step."""
    rng = np.random.default_rng([1, seed])

    def read(plant):
        return readings(plant, NOISE * rng.standard_normal(3))

    plant, currents, rows = plant_of(2, seed), [], []
    for current, count in ((0.0, 30), (-0.1, 210), (0.0, 210), (0.1, 210), (0.0, 210), (-0.05, 210), (0.05, 210)):
        plant.drive(current)
        for _ in range(count):
            currents.append(current)
            rows.append(read(plant))
            plant.advance(2.0)
    temperatures = np.array(rows)
    network = identify_network(currents, temperatures[:, 1], temperatures[:, 2], 2.0).network

    plant, points = plant_of(3, seed), []
    for current in [*np.linspace(0.0, -0.14, 8), *np.linspace(-0.12, 0.11, 12), *np.linspace(0.1, 0.0, 6)]:
        plant.drive(current)
        plant.advance(150.0)
        several = []
        for _ in range(20):
            several.append(read(plant))
            plant.advance(0.5)
        points.append(np.mean(several, axis=0))
    static = np.array(points)
    polynomial = identify_polynomial(static[:, 2] - 22.0, static[:, 0]).model

    plant, loop = plant_of(4, seed), []
    voltages = 40.0 * np.sin(2.0 * np.pi * 0.1 * 0.01 * np.arange(2500))
    for voltage in voltages:
        plant.apply(voltage)
        plant.advance(0.01)
        loop.append(read(plant)[0])
    hysteresis = identify_pi(voltages, loop).model

    plant, response = plant_of(5, seed), []
    steps = np.where(np.arange(8000) < 200, 0.0, 20.0)
    for voltage in steps:
        plant.apply(voltage)
        response.append(read(plant)[0])
        plant.advance(FAST)
    return HybridModel(network, polynomial, hysteresis, identify_dynamics(steps, response, FAST).model)


@pytest.fixture(scope="module")
def model():
    return identified(11)


@dataclass
class Run:
    """Errors at and between the samples (m), and what was set."""

    t: np.ndarray
    errors: np.ndarray
    between: np.ndarray
    currents: np.ndarray
    voltages: np.ndarray

    def worst(self, since, until=math.inf):
        chosen = (self.t >= since) & (self.t < until)
        return max(np.abs(self.errors[chosen]).max(), np.abs(self.between[chosen]).max())

    def rms(self, chosen):
        return math.sqrt(0.5 * np.mean(self.errors[chosen] ** 2 + self.between[chosen] ** 2))

    def holds(self, reference, settling=5.0):
        chosen = self.rested(reference, settling) & (self.t > settling)
        return self.rms(chosen), np.abs(self.errors[chosen]).max()

    def moves(self, reference):
        chosen = ~self.rested(reference, 0.01) & (self.t > 1.0)
        return self.rms(chosen), np.abs(self.errors[chosen]).max()

    def rested(self, reference, since):
        """Return at which samples the reference stands where it stood a time (s) before."""
        return np.array([reference(t) == reference(t - since) for t in self.t])


def follow(controller, reference, duration, seed, room=None, **parameters):
    """Let a controller work on a plant; `room` is a time and a change of the room's temperature then."""
    plant = plant_of(6, seed, **parameters)
    count = round(duration / PERIOD)
    noise = (NOISE * np.random.default_rng([7, seed]).standard_normal((count, 3))).tolist()
    rows = []
    for k in range(count):
        t = k * PERIOD
        if room is not None and k == round(room[0] / PERIOD):
            plant.step_ambient(room[1])
        error = plant.deflection - reference(t)
        current, voltage = controller.update(t, readings(plant, noise[k]))
        plant.drive(current)
        plant.apply(voltage)
        plant.advance(PERIOD / 2)
        rows.append((t, error, plant.deflection - reference(t + PERIOD / 2), current, voltage))
        plant.advance(PERIOD / 2)
    return Run(*np.array(rows).T)


def resting(model, error):
    """Return an open loop after 45 s with a reference that rests, while the deflection is off by an error (m)."""
    controller = OpenLoopHybrid(model, lambda _: 0.0, settings())
    controller.update(0.0, (0.0, 22.0, 22.0))
    for k in range(1, round(45.0 / PERIOD)):
        controller.update(k * PERIOD, (error, 22.0, 22.0))
    return controller


def step_response(controller, size, seed, at=0.1, duration=0.4, **parameters):
    """Return settling time (2 %, s), overshoot, and RMS error 100 ms after the step (m)."""
    plant = plant_of(8, seed, **parameters)
    noise = NOISE[0] * np.random.default_rng([9, seed]).standard_normal(round(duration / FAST))
    deflections = []
    for k, each in enumerate(noise.tolist()):
        deflections.append(plant.deflection)
        (voltage,) = controller.update(k * FAST, (sensed(plant.deflection, each),))
        assert abs(voltage) <= 40.0
        plant.apply(voltage)
        plant.advance(FAST)
    after = np.array(deflections[round(at / FAST) :])
    outside = np.flatnonzero(np.abs(after - size) > 0.02 * abs(size))
    tail = after[round(0.1 / FAST) :] - size
    return FAST * (outside[-1] + 1), float(np.max(after / size)) - 1.0, math.sqrt(np.mean(tail**2))


def step(size, at=0.1, before=0.0):
    return lambda t: size if t >= at - 1e-9 else before


# Goals.


RANGE = SmoothMoves([0.0, 85 * MICRO, -120 * MICRO, 0.0], SPEED, hold=20.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.seeds) for seed in (1, 2, 3))])
def test_holds_and_moves_over_more_than_200_micrometres(model, seed):
    run = follow(HybridController(model, RANGE, settings()), RANGE, RANGE.duration, seed)
    rms, greatest = run.holds(RANGE)
    assert rms < 6 * NANO
    assert greatest < 30 * NANO
    rms, greatest = run.moves(RANGE)
    assert rms < 10 * NANO
    assert greatest < 50 * NANO
    # In the end the thermal part has taken over: the piezo part is back in its middle.
    assert np.abs(run.voltages[-100:]).max() < 3.0


def test_kalman_filter_is_at_least_as_good_as_a_low_pass(model):
    moves = SmoothMoves([0.0, 40 * MICRO, -50 * MICRO], SPEED, hold=15.0)
    runs = {
        name: follow(HybridController(model, moves, settings(), estimator=name), moves, moves.duration, 5)
        for name in ("unscented", "low-pass")
    }
    for part in (Run.holds, Run.moves):
        filtered, passed = part(runs["unscented"], moves)[0], part(runs["low-pass"], moves)[0]
        assert filtered < passed
        assert passed < 10 * NANO


@pytest.mark.slow
def test_comparisons_are_far_worse(model):
    moves = SmoothMoves([0.0, 40 * MICRO, -50 * MICRO], SPEED, hold=20.0)
    hybrid, thermal, blind = (
        follow(make(model, moves, settings(**changes)), moves, moves.duration, 6)
        for make, changes in (
            (HybridController, {}),
            (ThermalFeedback, TUNING["thermal-feedback"]),
            (OpenLoopHybrid, {}),
        )
    )
    # Feedback alone gets there at last, the piezo part is what follows; without the sensor the model's error stays.
    assert 10 * hybrid.moves(moves)[0] < thermal.moves(moves)[0] < 3 * MICRO
    assert 5 * hybrid.holds(moves)[0] < thermal.holds(moves)[0] < blind.holds(moves)[0] < 2 * MICRO
    assert (thermal.voltages == 0.0).all()


@cases(("seed", "offset"), [(0, 0.0), (1, 0.03), (2, -0.03)])
def test_fine_step(model, seed, offset):
    for size in (5 * MICRO, -5 * MICRO):
        settling, overshoot, rest = step_response(fine(model, step(size)), size, seed, resonance_offset=offset)
        assert settling < 12e-3
        assert overshoot < 0.01
        assert rest < 4 * NANO


@cases("current", [-0.08, 0.08])
def test_fine_step_where_the_thermal_part_has_gone(model, current):
    """Far from the middle, on a beam that is some 15 K colder or warmer, while its temperature still drifts."""
    plant = plant_of(8, 5)
    plant.drive(current)
    plant.advance(600.0)
    place, size = plant.deflection, 5 * MICRO
    controller = fine(model, step(place + size, 0.1, place))
    noise = NOISE[0] * np.random.default_rng(9).standard_normal(8000)
    deflections = []
    for k, each in enumerate(noise.tolist()):
        deflections.append(plant.deflection)
        plant.apply(controller.update(k * FAST, (sensed(plant.deflection, each),))[0])
        plant.advance(FAST)
    assert abs(place) > 60 * MICRO
    after = np.array(deflections[2000:]) - place
    assert np.abs(after[240:] - size).max() < 0.02 * size
    assert after.max() < 1.01 * size


def test_fine_loop_needs_its_notch(model):
    # With zeros damped as the poles are, it is none; half the gain then rings already.
    without = replace(model, dynamics=replace(model.dynamics, damping=0.7))
    controller = fine(without, step(5 * MICRO), integral=150.0)
    settling, overshoot, _ = step_response(controller, 5 * MICRO, 0)
    assert settling > 20e-3
    assert overshoot > 0.015


@cases(("seed", "change", "place"), [(0, 5.0, 0.0), (1, -5.0, -40 * MICRO)])
def test_step_of_the_room_by_5_kelvin(model, seed, change, place):
    moves = SmoothMoves([0.0, place], SPEED, hold=40.0)
    at = moves.duration - 30.0
    run = follow(HybridController(model, moves, settings()), moves, moves.duration, seed, room=(at, change))
    assert run.worst(at) < 120 * NANO
    assert run.worst(at + 15.0) < 30 * NANO


def test_slow_ramp_and_a_sine_on_it(model):
    ramp = SmoothMoves([0.0, 20 * MICRO], 0.5 * MICRO, hold=10.0)
    run = follow(HybridController(model, ramp, settings()), ramp, 40.0, 3)
    assert run.rms(run.t > 1.0) < 6 * NANO
    sine = AddedSine(ramp, 2 * MICRO, 1.0)
    run = follow(HybridController(model, sine, settings()), sine, 40.0, 3)
    assert run.rms(run.t > 3.0) < 60 * NANO
    # The thermal part does not take part in the sine.
    assert np.abs(run.currents).max() < 0.05


def test_errors_of_the_model_do_not_matter_much(model):
    n, h = model.network, model.hysteresis
    wrong = replace(
        model,
        network=replace(n, tec_capacity=1.2 * n.tec_capacity, tec_resistance=0.8 * n.tec_resistance),
        polynomial=model.polynomial.with_coefficients(0.95 * model.polynomial.coefficients, 2 * MICRO),
        hysteresis=h.with_coefficients(1.15 * h.coefficients, -1 * MICRO),
        reference=21.0,
    )
    moves = SmoothMoves([0.0, 40 * MICRO, -50 * MICRO], SPEED, hold=20.0)
    run = follow(HybridController(wrong, moves, settings()), moves, moves.duration, 4)
    assert run.holds(moves)[0] < 10 * NANO
    assert run.moves(moves)[0] < 30 * NANO


# Limits.


@cases("estimator", ["unscented", "low-pass"])
def test_a_jump_beyond_the_limits_comes_in_without_overshoot(model, estimator):
    reference = step(60 * MICRO, 5.0)
    run = follow(HybridController(model, reference, settings(), estimator=estimator), reference, 40.0, 0)
    assert np.abs(run.currents).max() == 0.15
    assert np.abs(run.voltages).max() <= 40.0
    late = run.t > 5.1
    assert run.errors[late].max() < 60 * NANO
    assert run.worst(25.0) < 40 * NANO


def test_what_is_out_of_reach_does_not_wind_up(model):
    # Far beyond what the current can do, and back.
    reference = SmoothMoves([0.0, 180 * MICRO, 60 * MICRO], 20 * MICRO, hold=60.0, blend=1.0)
    run = follow(HybridController(model, reference, settings()), reference, reference.duration, 0)
    assert run.worst(20.0, 60.0) > 10 * MICRO
    assert np.abs(run.currents).max() == 0.15
    assert np.abs(run.voltages).max() <= 40.0
    assert run.worst(reference.duration - 20.0) < 60 * NANO


def test_fine_integral_does_not_wind_up(model):
    # 30 µm is out of reach of the piezo part; from there back to 2 µm in no more than the usual time. Not as long as
    # the loop would bear it.
    controller = fine(model, step(2 * MICRO, 0.04, 30 * MICRO))
    plant = plant_of(8, 0, ambient_sd=0.0)
    deflections, voltages = [], []
    for k in range(round(0.14 / FAST)):
        deflections.append(plant.deflection)
        (voltage,) = controller.update(k * FAST, (plant.deflection,))
        voltages.append(voltage)
        plant.apply(voltage)
        plant.advance(FAST)
    assert max(voltages) <= 40.0
    assert max(deflections) > 8 * MICRO
    assert np.abs(np.array(deflections[round(0.055 / FAST) :]) - 2 * MICRO).max() < 0.02 * 7 * MICRO


@cases("estimator", ["unscented", "low-pass"])
def test_missing_readings_hold_and_are_got_over(model, estimator):
    moves = SmoothMoves([0.0, 30 * MICRO], SPEED, hold=30.0)
    controller = HybridController(model, moves, settings(), estimator=estimator)
    plant, rng = plant_of(6, 0), np.random.default_rng(3)
    # Nothing at the start, and nothing for 0.3 s in the middle of the move.
    assert controller.update(0.0, (math.nan, 22.0, 22.0)) == (0.0, 0.0)
    errors, held = [], []
    for k in range(round(45.0 / PERIOD)):
        t = k * PERIOD
        measured = readings(plant, NOISE * rng.standard_normal(3))
        errors.append(plant.deflection - moves(t))
        if 8.0 <= t < 8.3:
            measured = (measured[0], measured[1], math.inf) if k % 2 else (math.nan, math.nan, math.nan)
        # Time counts from the first complete reading.
        setpoints = controller.update(t + 1.0, measured)
        if 8.0 <= t < 8.3:
            held.append(setpoints)
        plant.drive(setpoints[0])
        plant.apply(setpoints[1])
        plant.advance(PERIOD)
    assert len(set(held)) == 1
    assert np.abs(errors[round(1.0 / PERIOD) : round(8.0 / PERIOD)]).max() < 60 * NANO
    assert np.abs(errors[round(9.5 / PERIOD) :]).max() < 60 * NANO


def test_fine_loop_holds_at_a_missing_reading(model):
    controller = fine(model, step(1 * MICRO, 0.0))
    assert controller.update(0.0, (math.nan,)) == (0.0,)
    first = [controller.update(FAST * k, (0.0, 25.0)) for k in range(1, 4)]
    assert first[0] != first[2]
    assert controller.update(FAST * 4, (math.nan, 25.0)) == first[2]
    trace = controller.trace
    assert trace.reference == 1 * MICRO
    assert trace.predicted == 0.0
    assert -1 * MICRO < trace.disturbance < 0.0


@cases(
    ("part", "said"),
    [(0.07, ""), (0.09, "its error at rest is 8.1e-07 m RMS, and that of a model that holds at most 1.1e-06")],
)
def test_an_open_loop_that_errs_is_warned_of(model, part, said):
    controller = resting(model, part * MID_RANGING["stroke"])
    notice = controller.take_notice()
    assert bool(notice) == bool(said)
    assert said in notice
    assert not controller.take_notice()


def test_an_open_loop_whose_model_does_not_hold_ends(model):
    with pytest.raises(ConvergenceError, match="the model does not hold for this specimen: its error at rest is"):
        resting(model, 0.13 * MID_RANGING["stroke"])


# Traces.


def test_traces(model):
    place = 20 * MICRO
    moves = SmoothMoves([0.0, place], SPEED, hold=20.0)
    kalman, plain = (
        HybridController(model, moves, settings()),
        HybridController(model, moves, settings(), estimator="low-pass"),
    )
    blind = OpenLoopHybrid(model, moves, settings())
    for controller in (kalman, plain, blind):
        follow(controller, moves, moves.duration, 0)
        assert controller.trace.reference == place
    assert kalman.trace.predicted == pytest.approx(place, abs=20 * NANO)
    assert plain.trace.predicted == pytest.approx(place, abs=20 * NANO)
    # What the model lacks: far less than the thermal deflection, and much more than its stated uncertainty.
    assert abs(kalman.trace.disturbance) < 2 * MICRO
    assert abs(kalman.trace.disturbance - plain.trace.disturbance) < 5 * kalman.trace.uncertainty + 0.3 * MICRO
    assert 0.0 < kalman.trace.uncertainty < 0.3 * MICRO
    assert math.isnan(plain.trace.uncertainty)
    assert math.isnan(blind.trace.disturbance)


# Parts.


def test_reduced_network_agrees_with_the_whole_one():
    whole = Design().network()
    reduced = ReducedNetwork(whole, 22.0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        base, tip, reduced.numbers[-1] = rng.uniform(-20.0, 20.0, 3)
        current = rng.uniform(-0.15, 0.15)
        expected = whole.rates(22.0 + np.array([reduced.numbers[-1], reduced.numbers[-1], base, tip]), current, 22.0)
        constant, slope = reduced.heat_flow(current)
        into_base = constant + slope * base - (base - tip) * reduced.along
        assert into_base / reduced.base_capacity == pytest.approx(expected[2], rel=1e-9)
        before = reduced.numbers[-1]
        reduced.advance(base, current, 1e-3)
        assert (reduced.numbers[-1] - before) / 1e-3 == pytest.approx(expected[:2].mean(), rel=1e-6)


@cases("current", [-0.15, -0.05, 0.02, 0.1])
def test_heat_fed_forward_is_that_of_the_steady_state(current):
    whole = Design().network()
    reduced = ReducedNetwork(whole, 22.0)
    end, front, base, tip = whole.steady_rises(current, 22.0).tolist()
    reduced.numbers[-1] = front
    assert reduced.current_for(reduced.heat_for(tip, 0.0, base, current), base) == pytest.approx(current, rel=1e-6)
    # The lumped block comes to the same.
    reduced.numbers[-1] = 0.0
    for _ in range(5000):
        reduced.advance(base, current, 1.0)
    assert reduced.numbers[-1] == pytest.approx(0.5 * (end + front), rel=0.02)


def test_bending_is_inverted_and_goes_on_straight(model):
    bending = Bending(model.polynomial)
    for rise in np.linspace(bending.low, bending.high, 50).tolist():
        expected = model.thermal_deflection([rise])[0]
        assert bending.deflection(rise) == pytest.approx(expected, abs=1e-3 * NANO)
        assert bending.rise(expected) == pytest.approx(rise, abs=1e-3)
        numeric = (bending.deflection(rise + 1e-4) - bending.deflection(rise - 1e-4)) / 2e-4
        assert bending.slope(rise) == pytest.approx(numeric, rel=1e-3)
    end = bending.high
    assert bending.deflection(end + 2.0) == pytest.approx(bending.deflection(end) + 2.0 * bending.slope(end))
    assert bending.rise(-1.0) == bending.high
    assert bending.rise(1.0) == bending.low


def test_kalman_filter_is_that_of_an_independent_package():
    noise, rng, every = settings().noise, np.random.default_rng(2), 4
    rises = np.linspace(-20.0, 25.0, 12)
    bending = Bending(identify_polynomial(rises, MICRO * (-7.4 * rises - 0.05 * rises**2), 2).model)
    reduced = ReducedNetwork(Design().network(), 22.0)
    current = 0.06

    def move(state, dt):
        base, tip, heat, offset = state
        constant, slope = reduced.heat_flow(current)
        along = (base - tip) * reduced.along
        base += dt * (constant + slope * base + heat - along) / reduced.base_capacity
        return [base, tip + dt * (along - reduced.tip_air * tip) / reduced.tip_capacity, heat, offset]

    def observe(state):
        return [state[0], state[1], bending.deflection(state[1]) + state[3]]

    points = MerweScaledSigmaPoints(4, alpha=1.0, beta=0.0, kappa=0.0)
    reference = UnscentedKalmanFilter(4, 3, every * PERIOD, observe, move, points)
    reference.Q = np.diag(np.square([noise.base, noise.tip, noise.heat, noise.offset])) * every * PERIOD
    reference.R = np.diag(np.square([noise.thermistor, noise.thermistor, noise.deflection / math.sqrt(every)]))
    spread = 2.0 * abs(bending.slope(0.0)) * noise.thermistor
    reference.P = np.diag(np.square([noise.thermistor, noise.thermistor, 10.0 * noise.heat, spread]))

    kalman = UnscentedEstimate(bending, reduced, noise, PERIOD, every)
    kalman.begin(0.0, 0.0, 0.0)
    for k in range(300):
        base, tip, deflection = 0.002 * k, 0.0015 * k, -0.011 * k * MICRO
        base, tip = np.array([base, tip]) + 0.02 * rng.standard_normal(2)
        kalman.sample(deflection)
        kalman.correct(base, tip, current)
        reference.predict()
        reference.update(np.array([base, tip, deflection]))
        thermal = bending.deflection(reference.x[1]) + reference.x[3]
        assert kalman.value == pytest.approx(thermal, rel=1e-9, abs=1e-15)
        offset, uncertainty = kalman.describe(0.0)
        assert offset == pytest.approx(reference.x[3], rel=1e-6, abs=1e-15)
        assert uncertainty == pytest.approx(math.sqrt(reference.P[3, 3]), rel=1e-6)


# Wrong input.


def folded():
    rises = np.linspace(-10.0, 10.0, 9)
    return identify_polynomial(rises, MICRO * rises**2, 2).model


@cases(
    ("make", "message"),
    [
        (lambda: settings(gain=-1.0), "gain: expected a positive"),
        (lambda: settings(integral=100.0), "integral: expected less than 100 1/s"),
        (lambda: settings(noise=3), "noise = 3: expected a table of numbers"),
        (lambda: settings(noise={"heat": 2e-3}), "nothing says of this cantilever: noise.thermistor"),
        (lambda: settings(stork=9e-6), "stork: there is no such number; did you mean .*stroke"),
        (
            lambda: MidRangingParameters.at_rate(200.0, {"noise": MID_RANGING["noise"]}, maximum_current=0.1),
            r"gain, .*, stroke, approach; give them in the rig file, \[protocols\.hybrid-control\.tuning",
        ),
        (lambda: MidRangingParameters.at_rate(200.0, {}, maximum_current=0.1), r"cantilever: gain, .*, approach"),
        (lambda: settings(noise={**MID_RANGING["noise"], "heat": 0.0}), "heat: expected a positive"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()


@cases(
    ("make", "message"),
    [
        (lambda m: fine(m, RANGE, rate=1e3), "frequency: expected rad/s between"),
        (lambda m: HybridController(m, RANGE, settings(), estimator="none"), "estimator: expected unscented or"),
        (lambda m: HybridController(m, RANGE, settings()).update(0.0, (0.0, 22.0)), "measured: expected deflection"),
        (
            lambda m: HybridController(replace(m, polynomial=folded()), RANGE, settings()),
            "polynomial: expected one that rises",
        ),
    ],
)
def test_wrong_input_of_a_controller_is_named(model, make, message):
    with pytest.raises(ValueError, match=message):
        make(model)


def test_published_dynamics_do_as_well(model):
    """The published dynamics serve where the resonance was not measured."""
    published = replace(model, dynamics=PUBLISHED_DYNAMICS)
    settling, overshoot, _ = step_response(fine(published, step(5 * MICRO)), 5 * MICRO, 1)
    assert settling < 12e-3
    assert overshoot < 0.01
