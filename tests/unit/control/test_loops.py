"""Loops that reach and follow, and the dynamics behind them, where their numbers make no sense."""

import math

import numpy as np
import pytest
from cases import cases

from bench.control import Command, FollowReference, Playback, ReachTarget, Trace
from bench.models import ActuatorDynamics, IdentifiedDynamics, ResponseDynamics


class Follower:
    """Sets what it is asked for, and keeps what it was told."""

    trace = Trace(predicted=5.0)
    horizon = 3

    def __init__(self):
        self.told, self.foreseen = [], []

    def foresee(self, references):
        self.foreseen.append(references.tolist())

    def update(self, t, measured_input, output, reference):
        self.told.append((t, measured_input, output, reference))
        return reference


@cases(("period", "duration"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (math.nan, 1.0), (1.0, math.nan)])
def test_times_that_make_no_sense(period, duration):
    with pytest.raises(ValueError, match="period, duration: expected positive numbers of s"):
        FollowReference(Follower(), abs, period, duration)
    FollowReference(Follower(), abs, 1e-9, 1e-9)


def test_a_reference_is_followed_at_the_ends_of_its_periods():
    follower = Follower()
    loop = FollowReference(follower, lambda t: 10.0 * t, 0.5, 1.5)
    commands = [loop.begin(100.0, 1.0, 2.0)]
    assert loop.trace.reference == 0.0
    # A late reading does not shift what follows.
    for t in (100.7, 101.0, 101.5):
        commands.append(loop.update(t, 1.0, 2.0))
    assert [(each.setpoint, each.wait, each.done) for each in commands] == [
        (5.0, pytest.approx(0.5), False),
        (10.0, pytest.approx(0.3), False),
        (15.0, pytest.approx(0.5), False),
        (15.0, 0.0, True),
    ]
    assert follower.told == [(100.0, 1.0, 2.0, 5.0), (100.7, 1.0, 2.0, 10.0), (101.0, 1.0, 2.0, 15.0)]
    assert follower.foreseen[0] == [5.0, 10.0, 15.0]
    assert follower.foreseen[1] == [10.0, 15.0, 20.0]
    assert loop.trace.reference == pytest.approx(15.0)
    assert loop.trace.predicted == 5.0
    # A loop may be begun again.
    assert not loop.begin(200.0, 1.0, 2.0).done


def test_a_loop_that_is_shorter_than_its_period_has_one_set_point():
    loop = FollowReference(Follower(), lambda t: t, 1.0, 0.2)
    assert not loop.begin(0.0, 0.0, 0.0).done
    assert loop.update(1.0, 0.0, 0.0).done


def test_a_target_is_aimed_at_and_then_updated():
    class Controller:
        trace = Trace(reference=7.0)

        def aim(self, *arguments):
            return Command(sum(arguments), 1.0)

        def update(self, *arguments):
            return Command(-sum(arguments), 1.0)

    task = ReachTarget(Controller(), 7.0)
    assert task.begin(1.0, 2.0, 3.0, 4.0).setpoint == 17.0
    assert task.update(1.0, 2.0, 3.0, 4.0).setpoint == -10.0
    assert task.trace.reference == 7.0


def test_playback():
    playback = Playback(lambda t: 2.0 * t, lambda _: 1.0)
    assert playback.update(3.0, ()) == (6.0, 1.0)
    out = np.zeros((2, 2))
    playback.step_block(np.array([1.0, 2.0]), np.zeros((0, 1)), out)
    assert out.tolist() == [[2.0, 1.0], [4.0, 1.0]]


@cases(
    ("make", "words"),
    [
        (lambda: IdentifiedDynamics(ActuatorDynamics(delay=-0.1)), "actuator.delay: expected a finite number"),
        (lambda: IdentifiedDynamics(ActuatorDynamics(damping=-1.0)), "actuator.damping"),
        (lambda: IdentifiedDynamics(ActuatorDynamics(rate=0.0)), "actuator.rate: expected a positive number, got 0"),
        (lambda: IdentifiedDynamics(response=ResponseDynamics(power=3.0)), "response.power: expected 1 or 2"),
        (lambda: IdentifiedDynamics(noise={"output": -1.0}), "noise.output"),
    ],
)
def test_dynamics_that_make_no_sense(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_dynamics_come_back_from_a_file():
    dynamics = IdentifiedDynamics(
        ActuatorDynamics(0.2, 2.5, 0.6, math.inf, 0.98, 0.1),
        ResponseDynamics(1.5, 2.0, 0.8, (0.1, 0.1), (5.0, 50.0)),
        {"output": 0.3},
        {"lag": 0.1},
        0.2,
        "run 7",
    )
    content = dynamics.to_json()
    assert content["actuator"]["rate"] is None
    assert IdentifiedDynamics.from_json(content) == dynamics
    limited = IdentifiedDynamics(ActuatorDynamics(rate=5.0))
    assert limited.to_json()["actuator"]["rate"] == 5.0
    assert IdentifiedDynamics.from_json(limited.to_json()) == limited
    assert IdentifiedDynamics.from_json({}) == IdentifiedDynamics()
    assert dynamics.time_constant == pytest.approx(0.2 + 1.2 / 2.5 + 1.5)
    assert [ActuatorDynamics(frequency=f, damping=d).order for f, d in ((0.0, 0.5), (1.0, 0.0), (1.0, 0.1))] == [
        0,
        1,
        2,
    ]
