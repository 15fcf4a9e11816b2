"""Controllers by name: the numbers that a rig puts in place of their defaults."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import cases

from bench.base import ConfigurationError
from bench.control import ControllerSetup, controller_names, controller_spec, make_controller, saturated_below
from bench.identification import ModelFile
from bench.models import (
    ActuatorDynamics,
    IdentifiedDynamics,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    ResponseDynamics,
    uniform_levels,
)

PREISACH = ModelFile("preisach", Preisach(uniform_levels(0.0, 3.0, 4), np.ones(10), input_range=(0.0, 3.0)))
POLYNOMIAL = ModelFile("polynomial", Polynomial([1.0], (0.0, 3.0)))


def setup(model=PREISACH, dwell=6.0, **options):
    return ControllerSetup(model=model, limits=(0.0, 3.0), dwell=dwell, options=options)


@cases(("name", "model"), [("open-loop-inverse", PREISACH), ("polynomial", POLYNOMIAL)])
def test_the_time_at_each_target_is_that_of_the_rig(name, model):
    for options, wait in (({}, 6.0), ({"wait": 40}, 40.0), ({"wait": 3, "dwell": None}, 3.0)):
        controller = make_controller("target", name, setup(model, **options))
        command, t = controller.aim(1.0, 0.0, 0.0, 0.0), 0.0
        while not command.done:
            t += command.wait
            command = controller.update(t, command.setpoint, 0.0)
        assert t == pytest.approx(wait)


def time_at_target(given):
    return controller_spec("target", "open-loop-inverse").numbers(given).wait


def test_a_rig_without_a_dwell_leaves_it_to_the_dynamics():
    dynamics = IdentifiedDynamics(
        actuator=ActuatorDynamics(delay=0.5, frequency=2.0), response=ResponseDynamics(lag=1.0)
    )
    assert time_at_target(setup(replace(PREISACH, dynamics=dynamics), dwell=None)) == pytest.approx(10.0 * 2.0)
    for unknown in (PREISACH, replace(PREISACH, dynamics=IdentifiedDynamics())):
        with pytest.raises(ConfigurationError, match=r"how long the specimen takes .* \[roles.drive\] dwell"):
            time_at_target(setup(unknown, dwell=None))


def test_the_closed_loop_knows_the_lag_and_has_ten_of_them_to_arrive():
    slow = replace(PREISACH, dynamics=IdentifiedDynamics(response=ResponseDynamics(lag=4.0)))
    numbers = controller_spec("target", "closed-loop-inverse").numbers
    here, there = (numbers(setup(model)).arrival for model in (PREISACH, slow))
    assert there == replace(here, patience=here.patience + 40.0)
    for name in ("closed-loop-inverse", "open-loop-inverse"):
        controller = make_controller("target", name, setup(slow))
        low, high = controller.limits
        controller.aim(0.5 * sum(slow.operator.output_range()), 0.0, low, 0.0)
        controller.update(0.1, high, 0.0)
        assert slow.operator.present_input(controller.state) < low + 0.05 * (high - low)


@cases("task", ["target", "follow"])
def test_a_number_that_a_controller_does_not_have_is_refused(task):
    for name in controller_names(task):
        if name in ("latched", "polynomial"):
            continue
        with pytest.raises(ConfigurationError, match=f"controller {name}: colour: there is no such number"):
            make_controller(task, name, setup(colour=1.0))


def test_a_controller_that_does_not_exist_is_refused_with_those_that_do():
    with pytest.raises(
        ConfigurationError, match=r"there is no controller 'magic' for the task target; there are: .*latched"
    ):
        make_controller("target", "magic", setup())


def test_a_reset_reaches_the_end_of_a_plane_to_the_noise_of_its_readings():
    density = np.ones(10)
    measured = Preisach(uniform_levels(-40.05, 40.05, 4), density, 0.0, None, (-40.05, 40.05), "V", "m")
    assert saturated_below(measured, -40.0)
    assert not saturated_below(measured, -39.6)
    assert not saturated_below(measured, math.nan)
    assert saturated_below(PrandtlIshlinskii([0.0], [1.0]), 0.0)
