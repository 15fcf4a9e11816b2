"""Target controllers on a specimen whose response lags behind its drive, as one that is heated does."""

import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.control import Spans
from bench.control.tracking import Arrival, ClosedLoopInverse, CorrectionParameters, OpenLoopInverse
from bench.models import Preisach, ResponseDynamics, SeenInput, uniform_levels

LAG = 5.0
HEATED = ResponseDynamics(lag=LAG, power=2.0)


def model(gain):
    levels = uniform_levels(0.0, 3.0, 12)
    row, column = np.tril_indices(12)
    density = np.exp(-(((row - 7) / 2.0) ** 2) - ((column - 4) / 2.0) ** 2)
    return Preisach(levels, density * gain / density.sum())


MODEL = model(1.0)
SPECIMEN = model(0.9)
SPAN = float(np.ptp(SPECIMEN.output_range()))


class Wire:
    """The specimen behind a lag of the square of its drive, which follows its set-point at once."""

    def __init__(self):
        self.t, self.drive, self.level = 0.0, 0.0, 0.0
        self.stream = SPECIMEN.stream(SPECIMEN.saturated_state(-1, 0.0))

    def carry_out(self, command):
        self.drive = command.setpoint
        for _ in range(10):
            self.level += (self.drive**2 - self.level) * -math.expm1(-command.wait / 10.0 / LAG)
            self.stream.step(math.sqrt(self.level))
        self.t += command.wait

    def read(self):
        return self.t, self.drive, self.stream.value

    def reach(self, controller, target):
        """Return the error where the controller is done, and its moves of more than a tenth of the range."""
        command = controller.aim(target, *self.read())
        moves = [command.setpoint]
        while not command.done:
            self.carry_out(command)
            command = controller.update(*self.read())
            moves.append(command.setpoint)
        return self.stream.value - target, int(np.count_nonzero(np.abs(np.diff(moves)) > 0.3))


def closed_loop(response):
    numbers = CorrectionParameters.scaled(Spans.of(MODEL))
    arrival = Arrival(numbers.arrival.tolerance, patience=100.0)
    numbers = CorrectionParameters(numbers.close_enough, numbers.walk_variance, numbers.reading_variance, arrival)
    state = MODEL.saturated_state(-1, 0.0)
    return ClosedLoopInverse(MODEL.inverse(), state, (0.0, 3.0), numbers, response=response)


def rms_and_swings(response):
    low, high = SPECIMEN.output_range()
    wire, controller = Wire(), closed_loop(response)
    targets = low + (high - low) * np.random.default_rng(3).uniform(0.15, 0.85, 12)
    found = np.array([wire.reach(controller, float(target)) for target in targets])
    return float(np.sqrt(np.mean(found[:, 0] ** 2))) / SPAN, int(found[:, 1].sum())


def test_a_closed_loop_that_knows_the_lag_converges_where_one_without_chases_what_it_leaves():
    (error, swings), (blind, chased) = rms_and_swings(HEATED), rms_and_swings(None)
    assert error < 0.005
    assert blind > 5.0 * error
    assert chased > swings


@cases("power", [1.0, 2.0])
def test_the_seen_input_is_the_exact_response_to_a_drive_that_is_held(power):
    seen = SeenInput(ResponseDynamics(lag=LAG, power=power))
    assert seen.take(0.0, 1.0) == pytest.approx(1.0)
    whole = 4.0**power * (1.0 - math.exp(-2.0)) + math.exp(-2.0)
    for t in np.linspace(0.7, 10.0, 9):
        last = seen.take(float(t), 4.0)
    assert last == pytest.approx(whole ** (1.0 / power), rel=1e-12)


@given(st.floats(0.0, 3.0), st.floats(0.5, 20.0), st.floats(0.0, 3.0), st.floats(0.2, 20.0))
def test_lead_meets_its_target_unless_clipped(start, lag, target, horizon):
    limits = 0.0, 3.0
    seen = SeenInput(ResponseDynamics(lag, 2.0), start)
    lead = seen.lead(target, horizon, limits)
    seen.take(0.0, start)
    arrived = seen.take(horizon, lead)
    if lead in limits:
        # It falls short of the target, on the side where it comes from.
        assert (arrived - target) * (start - target) >= -1e-12
    else:
        assert arrived**2 == pytest.approx(target**2, abs=1e-9)
        assert limits[0] <= lead <= limits[1]


def test_levels_keep_the_sign_of_the_input():
    for value in (-2.0, 0.0, 3.0):
        assert HEATED.of_level(HEATED.level(value)) == pytest.approx(value)


def test_the_open_loop_keeps_its_memory_behind_the_lag():
    wire = Wire()
    controller = OpenLoopInverse(MODEL.inverse(), None, (0.0, 3.0), wait=2.0, response=HEATED)
    low, high = MODEL.output_range()
    for target in (0.3, 0.7, 0.4):
        wire.reach(controller, low + target * (high - low))
        assert MODEL.present_input(controller.state) == pytest.approx(math.sqrt(wire.level), abs=1e-6)
        assert abs(wire.drive - math.sqrt(wire.level)) > 0.05
