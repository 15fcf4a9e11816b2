import itertools

import numpy as np
import pytest
from cases import cases

from bench.control import Approach
from sim_devices.plants.sma import SMAParameters, SMAWire

TOLERANCE = 0.03
LARGEST_STEP = 0.2e-3
STIFFEST = 12e3
SLACK = -6e-3


def approach(target, **arguments):
    given = {"slopes": (0.8e3, STIFFEST), "largest_step": LARGEST_STEP, "tolerance": TOLERANCE, **arguments}
    return Approach(target, **given)


def slack_wire(voltage):
    """A wire that was reset under 0.3 N, and then went slack at a voltage (V)."""
    wire = SMAWire(SMAParameters(), np.random.default_rng(1))
    wire.hang(0.3)
    wire.advance(30.0)
    wire.clamp(SLACK)
    wire.apply(voltage)
    wire.advance(60.0)
    assert wire.force == 0.0
    return wire


def stretch(loop, wire, position, latest=900.0):
    """Let a loop stretch a wire; return times, positions and forces at its steps."""
    t, rows = 0.0, []
    command = loop.begin(t, position, wire.force)
    while True:
        rows.append((t, command.setpoint, wire.force))
        if command.done:
            return np.array(rows).T
        assert t < latest
        wire.clamp(command.setpoint)
        wire.advance(command.wait)
        t += command.wait
        command = loop.update(t, command.setpoint, wire.force)


# At 0 V the wire is soft martensite, at 3 V stiff austenite, and softer than both while it changes.
@pytest.mark.parametrize("voltage", [0.0, 1.2, 2.4, 3.0])
class TestOnTheWire:
    @pytest.mark.parametrize("force", [4.9, 10.5])
    def test_a_force_is_reached_from_slack_and_from_one_side(self, voltage, force):
        _, positions, forces = stretch(approach(force), slack_wire(voltage), SLACK)
        assert forces[-1] == pytest.approx(force, abs=TOLERANCE)
        assert forces.max() <= force + TOLERANCE
        assert np.abs(np.diff(positions)).max() <= LARGEST_STEP * (1 + 1e-9)
        assert np.all(np.diff(positions) > -1e-9)

    def test_a_small_force_is_passed_by_no_more_than_a_step_can_make(self, voltage):
        times, positions, forces = stretch(approach(0.3), slack_wire(voltage), SLACK)
        assert forces[-1] == pytest.approx(0.3, abs=TOLERANCE)
        assert forces.max() <= LARGEST_STEP * STIFFEST
        assert np.abs(np.diff(positions)).max() <= LARGEST_STEP * (1 + 1e-9)
        assert times[-1] < 60.0

    def test_a_force_is_let_go_from_one_side(self, voltage):
        wire = slack_wire(voltage)
        _, positions, _ = stretch(approach(9.0), wire, SLACK)
        _, positions, forces = stretch(approach(3.0), wire, positions[-1])
        assert forces[-1] == pytest.approx(3.0, abs=TOLERANCE)
        # The soft wire creeps, so that it seems softer than it is.
        assert forces.min() >= 3.0 - 2 * TOLERANCE
        assert np.abs(np.diff(positions)).max() <= LARGEST_STEP * (1 + 1e-9)


def test_a_force_is_held_while_the_wire_lengthens():
    wire = slack_wire(3.0)
    _, positions, _ = stretch(approach(0.3), wire, SLACK)
    wire.apply(0.0)
    times, held, forces = stretch(approach(0.3, duration=50.0), wire, positions[-1])
    assert times[-1] == pytest.approx(50.0, abs=0.5)
    # The cooling wire gives way by millimetres.
    assert held[-1] - held[0] > 2e-3
    late = times > 10.0
    np.testing.assert_allclose(forces[late], 0.3, atol=0.25)
    assert forces[-1] == pytest.approx(0.3, abs=0.1)


class TestLoop:
    def test_begins_where_the_end_is(self):
        command = approach(1.0).begin(3.0, 0.7e-3, 0.0)
        # The first step has nothing to go by but the greatest slope.
        assert command.setpoint == pytest.approx(0.7e-3 + 0.5 * 1.0 / STIFFEST)
        assert not command.done
        assert command.wait == 0.5

    @cases(("output", "met"), [(1.02, True), (1.25, True), (0.75, True), (1.25 + 1e-9, False)])
    def test_what_is_met_is_not_moved(self, output, met):
        command = approach(1.0, tolerance=0.25).begin(0.0, 0.7e-3, output)
        assert command.done is met
        assert (command.setpoint == 0.7e-3) is met

    def test_can_be_begun_again(self):
        loop = approach(1.0)
        first = loop.begin(0.0, 0.0, 0.0)
        loop.update(0.5, first.setpoint, 0.4)
        assert loop.begin(10.0, 0.0, 0.0) == first

    @cases("seed", range(2))
    def test_never_leaves_its_step_limit_whatever_is_measured(self, seed):
        rng = np.random.default_rng(seed)
        loop = approach(5.0, largest_step=0.1e-3)
        last = 1e-3
        commands = [loop.begin(0.0, last, 0.0)]
        for i in range(300):
            output = float(rng.choice([rng.normal(5.0, 50.0), 0.0, 4.0, 1e9, -1e9]))
            commands.append(loop.update(0.5 * (i + 1), float(rng.normal()), output))
        setpoints = np.array([last, *(command.setpoint for command in commands)])
        assert np.abs(np.diff(setpoints)).max() <= 0.1e-3 * (1 + 1e-9)
        assert all(command.wait == 0.5 for command in commands)

    def test_holds_for_its_duration_also_when_the_target_is_met_at_once(self):
        loop = approach(1.0, duration=2.0, period=0.25)
        commands = [loop.begin(10.0, 0.0, 1.0)]
        for t in itertools.count(10.25, 0.25):
            commands.append(loop.update(t, 0.0, 1.0))
            if commands[-1].done:
                break
        assert t == 12.0
        assert {command.setpoint for command in commands} == {0.0}

    @cases(
        ("arguments", "words"),
        [
            ({"slopes": (0.0, 1e3)}, "slopes: expected two positive numbers"),
            ({"slopes": (2e3, 1e3)}, "the lower one first, got"),
            ({"tolerance": -0.1}, "expected positive numbers"),
            ({"duration": -1.0}, "duration ≥ 0"),
            ({"target": float("nan")}, "target: expected a finite number, got nan"),
        ],
    )
    def test_wrong_numbers_are_refused(self, arguments, words):
        with pytest.raises(ValueError, match=words):
            approach(**{"target": 1.0, **arguments})
