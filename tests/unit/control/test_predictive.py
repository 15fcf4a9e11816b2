"""The predictive follower, on simulated actuators with dynamics and specimens with hysteresis."""

import math

import numpy as np
import pytest

from bench.control import FollowReference
from bench.control.following import ClosedLoopFollower
from bench.control.loops import Foreseeing
from bench.control.predictive import PredictiveFollower
from bench.models import (
    ActuatorDynamics,
    IdentifiedDynamics,
    PrandtlIshlinskii,
    Preisach,
    ResponseDynamics,
    uniform_levels,
)

PERIOD = 0.5
FINE = 50
"""Steps of the simulation in a period."""
SECOND_ORDER = ActuatorDynamics(delay=0.2, frequency=2.2, damping=0.9, rate=8.0)


@pytest.fixture(scope="module")
def model():
    levels = uniform_levels(0.0, 10.0, 16)
    middle = 0.5 * (levels[1:] + levels[:-1])
    rows, columns = np.tril_indices(16)
    alpha, beta = middle[rows], middle[columns]
    density = np.exp(-(((alpha - 6.5) / 2.0) ** 2) - ((alpha - beta - 1.5) / 1.0) ** 2)
    density *= 100.0 / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, input_range=(-2.0, 12.0))


class Rig:
    """An actuator and a specimen that follow `dynamics`; the specimen has another lag if so given."""

    def __init__(self, plant, dynamics, lag=None):
        self.actuator, self.response = dynamics.actuator, dynamics.response
        self.lag = self.response.lag if lag is None else lag
        self.plant, self.state = plant, plant.saturated_state(-1, 0.0)
        self.place, self.velocity, self.level = 0.0, 0.0, 0.0
        self.sent = [0.0] * (1 + math.ceil(self.actuator.delay / PERIOD) * FINE)
        self.places = []

    def pass_period(self, setpoint):
        step, w = PERIOD / FINE, self.actuator.frequency
        late = round(self.actuator.delay / step)
        for _ in range(FINE):
            self.sent.append(setpoint)
            target = self.sent[-1 - late]
            if self.actuator.order == 0:
                self.place = target
            elif self.actuator.order == 1:
                self.place += step * w * (target - self.place)
            else:
                pull = w**2 * (target - self.place) - 2.0 * self.actuator.damping * w * self.velocity
                self.velocity += step * pull
                self.velocity = min(max(self.velocity, -self.actuator.rate), self.actuator.rate)
                self.place += step * self.velocity
            power = self.response.power
            level = math.copysign(abs(self.place) ** power, self.place)
            self.level = level + (self.level - level) * (math.exp(-step / self.lag) if self.lag else 0.0)
            self.state = self.state.step(math.copysign(abs(self.level) ** (1.0 / power), self.level))
        self.places.append(self.place)

    @property
    def output(self):
        return self.plant.value(self.state)


def followed(follower, rig, reference, seconds=60.0, noise=0.05, missing=()):
    """Return the RMS error at the ends of the periods after the first ten seconds, and the set-points."""
    rng = np.random.default_rng(1)
    task = FollowReference(follower, reference, PERIOD, seconds)
    errors, setpoints, t = [], [], 0.0
    command = task.begin(t, rig.place, rig.output)
    while not command.done:
        rig.pass_period(command.setpoint)
        setpoints.append(command.setpoint)
        t += PERIOD
        errors.append(rig.output - reference(t))
        place, output = rig.place, rig.output + noise * rng.normal()
        if len(errors) in missing:
            # Every other time of the output alone.
            place, output = (math.nan if len(errors) % 2 else place), math.nan
        command = task.update(t, place, output)
    return float(np.sqrt(np.mean(np.square(errors[20:])))), np.array(setpoints)


def sine(t):
    return 50.0 * math.sin(2.0 * math.pi * t / 20.0)


def saw(t):
    """Return ramps with corners, which only a reference that is known ahead allows for."""
    return float(np.interp(t % 24.0, [0.0, 8.0, 12.0, 18.0, 24.0], [-40.0, 40.0, 40.0, -10.0, -40.0]))


@pytest.mark.parametrize(
    ("dynamics", "reference"),
    [
        (IdentifiedDynamics(SECOND_ORDER), saw),
        (IdentifiedDynamics(ActuatorDynamics(delay=0.8, frequency=3.0)), sine),
        (IdentifiedDynamics(response=ResponseDynamics(lag=2.0, power=2.0)), saw),
    ],
    ids=["second order", "first order with delay", "lag of a square"],
)
def test_errors_are_less_than_half_of_those_of_the_follower_by_the_present_reference(model, dynamics, reference):
    plant = model.with_coefficients(1.03 * model.coefficients, 2.0)
    state = model.saturated_state(-1, 0.0)
    predictive, _ = followed(PredictiveFollower(model.inverse(), dynamics, state), Rig(plant, dynamics), reference)
    present, _ = followed(ClosedLoopFollower(model.inverse(), state), Rig(plant, dynamics), reference)
    assert predictive < 0.5 * present
    assert predictive < 4.0


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_lag_that_was_identified_wrongly_is_found_while_it_follows(model, factor):
    dynamics = IdentifiedDynamics(response=ResponseDynamics(lag=2.0, power=2.0))
    follower = PredictiveFollower(model.inverse(), dynamics, model.saturated_state(-1, 0.0))
    error, _ = followed(follower, Rig(model, dynamics, lag=2.0 * factor), sine, 80.0)
    found = -PERIOD / 4 / math.log(follower._lag.remains)
    assert found == pytest.approx(2.0 * factor, rel=0.2)
    assert error < 4.0


def test_no_setpoint_leaves_the_limits_and_what_is_beyond_them_is_said(model):
    dynamics = IdentifiedDynamics(SECOND_ORDER)
    state = model.saturated_state(-1, 0.0)
    follower = PredictiveFollower(model.inverse(), dynamics, state, (3.0, 8.0))
    _, setpoints = followed(follower, Rig(model, dynamics), lambda t: 2.0 * sine(t))
    assert setpoints.min() >= 3.0
    assert setpoints.max() <= 8.0
    assert follower.limits == (3.0, 8.0)


def test_missing_readings_do_not_stop_it(model):
    dynamics = IdentifiedDynamics(SECOND_ORDER)
    whole, some = (
        followed(
            PredictiveFollower(model.inverse(), dynamics, model.saturated_state(-1, 0.0)),
            Rig(model, dynamics), sine, missing=gone,
        )[0]
        for gone in ((), {30, 31, 60, 91})
    )  # fmt: skip
    assert some < whole + 4.0


def test_the_rate_limit_is_kept_in_mind(model):
    slow = ActuatorDynamics(frequency=4.0, damping=0.9, rate=0.8)
    state = model.saturated_state(-1, 0.0)
    errors = [
        followed(PredictiveFollower(model.inverse(), IdentifiedDynamics(known), state), Rig(model, rig), saw)[0]
        for rig in [IdentifiedDynamics(slow)]
        for known in (slow, ActuatorDynamics(frequency=4.0, damping=0.9))
    ]
    assert errors[0] < errors[1]


def test_an_actuator_that_follows_at_once_is_set_to_the_inverse_of_the_reference():
    model = PrandtlIshlinskii([0.0, 0.5, 1.0], [1.0, 0.6, 0.3], 0.0, input_range=(-5.0, 5.0))
    follower = PredictiveFollower(model.inverse(), IdentifiedDynamics())
    assert isinstance(follower, Foreseeing)
    follower.foresee(np.full(follower.horizon, 1.5))
    setpoint = follower.update(0.0, 0.0, 0.0, 1.5)
    assert setpoint == pytest.approx(model.inverse().invert(model.initial_state(), 1.5).setpoints[-1], abs=0.01)


@pytest.mark.parametrize(
    ("delay", "lag", "periods"), [(0.0, 0.0, 6), (0.6, 0.0, 6), (0.0, 1.0, 8), (1.1, 1.0, 11), (0.0, 60.0, 24)]
)
def test_the_horizon_is_the_delay_and_four_time_constants_within_bounds(model, delay, lag, periods):
    dynamics = IdentifiedDynamics(ActuatorDynamics(delay=delay), ResponseDynamics(lag))
    assert PredictiveFollower(model.inverse("nearest"), dynamics).horizon == periods


def test_a_reference_that_is_no_number_is_refused(model):
    with pytest.raises(ValueError, match="reference"):
        PredictiveFollower(model.inverse(), IdentifiedDynamics()).update(0.0, 0.0, 0.0, math.nan)
