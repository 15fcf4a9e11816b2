"""A laboratory for controllers."""

from itertools import pairwise

import numpy as np
import pytest

from bench.identification import damped_oscillation, identify
from sim_devices.plants.vo2 import VO2Cantilever, VO2Parameters

OPERATING = (21.0, 84.0)
READING_NOISE = 0.37
SENSOR_NOISE = 0.002


class Models:
    """What the characterization of the plant gives."""

    def __init__(self, film, polynomial):
        self.film, self.polynomial = film, polynomial

    def __repr__(self):
        return "Models(...)"


@pytest.fixture(scope="session")
def models():
    """Identify the plant once, as a protocol would: steps of 8 s, one reading each."""
    rng = np.random.default_rng(11)
    plant = VO2Cantilever(VO2Parameters(), rng, 21.0)
    setpoints, readings = damped_oscillation(21.0, 84.0, 54.0, 36, 0.35), []
    for setpoint in setpoints:
        plant.regulate(float(setpoint))
        plant.advance(8.0)
        readings.append(plant.curvature + READING_NOISE * rng.standard_normal())
    film = identify(
        "preisach-nonmonotonic", setpoints, readings, input_range=OPERATING, plane=(30, 70), reference=20
    ).model
    polynomial = identify("polynomial", setpoints, readings, input_range=OPERATING).model
    return Models(film, polynomial)


class Laboratory:
    """The plant in another session than that of the characterization: other wander, and an offset."""

    def __init__(self, seed, **parameters):
        self.rng = np.random.default_rng([7, seed])
        offset = 0.12 if seed % 2 == 0 else -0.12
        self.plant = VO2Cantilever(VO2Parameters(session_offset=offset, **parameters), self.rng, 21.0)
        self.plant.regulate(21.0)
        self.t = 0.0
        self.wait(5.0)

    def wait(self, seconds):
        self.plant.advance(seconds)
        self.t += seconds

    def read(self):
        return (
            self.plant.plate_temperature + SENSOR_NOISE * self.rng.standard_normal(),
            self.plant.curvature + READING_NOISE * self.rng.standard_normal(),
        )

    def carry_out(self, command):
        self.plant.regulate(command.setpoint)
        self.wait(command.wait)

    def reach(self, controller, target):
        """Return error (by the mean of ten readings while it holds) and time taken."""
        start = self.t
        command = controller.aim(float(target), self.t, *self.read())
        while not command.done:
            self.carry_out(command)
            command = controller.update(self.t, *self.read())
        taken, readings = self.t - start, []
        for _ in range(10):
            measured, output = self.read()
            readings.append(output)
            held = controller.update(self.t, measured, output)
            assert held.done
            assert held.setpoint == command.setpoint
            self.plant.regulate(held.setpoint)
            self.wait(0.1)
        return target - np.mean(readings), taken

    def follow(self, follower, reference, period):
        """Return the errors at the end of each period."""
        errors = []
        for now, coming in pairwise(reference):
            measured, output = self.read()
            errors.append(now - output)
            self.plant.regulate(follower.update(self.t, measured, output, float(coming)))
            self.wait(period)
        return np.array(errors)


@pytest.fixture(scope="session")
def laboratory():
    """Return the class: call it with a seed."""
    return Laboratory
