import dataclasses
import math

import numpy as np
import pytest

from sim_devices.plants.coiled_polymer import CoiledPolymerMuscle, CoiledPolymerParameters

ELASTIC = CoiledPolymerParameters(friction=0.0, friction_load=0.0, friction_coils=0.0)


def make(parameters, seed=1):
    return CoiledPolymerMuscle(parameters, np.random.default_rng(seed))


def test_touching_coils_end_the_contraction():
    free = make(dataclasses.replace(ELASTIC, coil_contact=0.0))
    touching = make(ELASTIC)
    for muscle in (free, touching):
        muscle.hang(0.5)
        muscle.apply(3.0)
        muscle.advance(300.0)
    assert free.length < -9e-3
    assert -9e-3 < touching.length < -6e-3


def test_arm_relaxes_after_a_step_of_the_load():
    muscle = make(ELASTIC)
    muscle.hang(5.0)
    muscle.advance(0.1)
    start = muscle.length
    lengths = []
    for _ in range(600):
        muscle.advance(0.1)
        lengths.append(muscle.length)
    steady = 5.0 / (1.3e3 - 0.4e3 * (1.0 - 1.0 / (1.0 + math.exp(-35.0 / 15.0))))
    # At once without the arm's share, then to the coil's alone, with the time constant of a standard solid.
    stiffness = 5.0 / steady
    assert start == pytest.approx(5.0 / (stiffness + 100.0), rel=2e-3)
    slowed = 6.0 * (1.0 + 100.0 / stiffness)
    expected = steady + (start - steady) * np.exp(-0.1 * np.arange(1, 601) / slowed)
    assert np.array(lengths) == pytest.approx(expected, abs=1e-8)
