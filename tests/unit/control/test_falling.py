"""Controllers of an actuator whose output falls: each does what it does with the opposite output."""

import numpy as np
import pytest
from cases import cases

from bench.control import ControllerSetup, controller_names, make_controller
from bench.identification import ModelFile
from bench.models import IdentifiedDynamics, Polynomial, Preisach, QuadraticTerm, Reach, uniform_levels

LIMITS = (0.0, 3.0)


def actuator(sign):
    levels = uniform_levels(*LIMITS, 12)
    rows, columns = np.tril_indices(12)
    # No hysteron narrower than a cell: behind a reversal the output is held.
    density = sign * np.where(rows - columns >= 2, np.exp(-0.1 * (rows + columns - 11.0) ** 2), 0.0)
    return Preisach(levels, density, sign * 1.5, QuadraticTerm(sign * 0.1), LIMITS)


def reach(controller, plant, sign, targets):
    """Return set-points and outputs of a plant that follows at once and is a little off."""
    state, t, rows = plant.initial_state(), 0.0, []
    for target in targets:
        command = controller.aim(sign * target, t, state.input, plant.value(state) + sign * 0.05)
        for _ in range(400):
            state, t = state.step(command.setpoint), t + command.wait
            output = plant.value(state) + sign * 0.05
            rows.append((command.setpoint, sign * output, sign * controller.trace.predicted))
            if command.done:
                break
            command = controller.update(t, state.input, output)
    return np.array(rows)


@cases("name", controller_names("target"))
def test_targets_are_reached_as_with_the_opposite_output(name):
    found = {}
    low, high = actuator(1).output_range()
    targets = low + (high - low) * np.array([0.3, 0.7, 0.5, 0.55, 0.2])
    for sign in (1, -1):
        plant = actuator(sign)
        model = Polynomial([sign * 2.0], LIMITS, sign * 1.5) if name == "polynomial" else plant
        setup = ControllerSetup(model=ModelFile("m", model), limits=LIMITS, dwell=8.0)
        controller = make_controller("target", name, setup)
        found[sign] = reach(controller, plant, sign, targets)
        assert controller.reach is Reach.MET
    np.testing.assert_allclose(found[-1], found[1], atol=1e-9)
    if name in ("closed-loop-inverse", "latched"):
        assert found[-1][-1, 1] == pytest.approx(targets[-1], abs=0.01 * (high - low))


@cases("name", controller_names("follow"))
def test_a_reference_is_followed_as_with_the_opposite_output(name):
    found = {}
    low, high = actuator(1).output_range()
    times = np.arange(0.0, 200.0, 0.5)
    reference = 0.5 * (low + high) + 0.3 * (high - low) * np.sin(2.0 * np.pi * times / 100.0)
    for sign in (1, -1):
        plant = actuator(sign)
        model = ModelFile("m", plant, dynamics=IdentifiedDynamics())
        controller = make_controller("follow", name, ControllerSetup(model=model, limits=LIMITS, dwell=8.0))
        state, rows = plant.initial_state(), []
        for t, wanted in zip(times.tolist(), reference.tolist(), strict=True):
            output = plant.value(state) + sign * 0.05
            state = state.step(controller.update(t, state.input, output, sign * wanted))
            rows.append((state.input, sign * plant.value(state)))
        found[sign] = np.array(rows)
    np.testing.assert_allclose(found[-1], found[1], atol=1e-9)
    if name == "closed-loop-inverse":
        assert np.abs(found[-1][20:, 1] + 0.05 - reference[20:]).max() < 0.05 * (high - low)
