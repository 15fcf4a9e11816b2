"""The course of a voltage that goes to a new value as a lag of first order does, in even steps.

Each step comes at the instant at which the lag passes its middle, so that the voltage is half a step off at most.
"""

from __future__ import annotations

import math

from bench.base import kernel
from sim_devices.plants.grid import Floats

START, TARGET, STEPS, TAKEN, TIME_CONSTANT = range(5)
"""Places of a course: where it begins and ends (V), number of its steps and of those taken, time constant (s)."""
SIZE = 5


@kernel
def next_instant(course: Floats) -> float:
    """Return when the next step comes, s from the beginning of the course; infinity after the last."""
    left = course[STEPS] - course[TAKEN] - 0.5
    return course[TIME_CONSTANT] * math.log(course[STEPS] / left) if left > 0.0 else math.inf


@kernel
def take_step(voltage: float, course: Floats) -> float:
    """Take the next step; return the voltage after it."""
    course[TAKEN] += 1.0
    share = course[TAKEN] / course[STEPS]
    target = course[TARGET]
    return within(voltage, course[START] + share * (target - course[START]) if share < 1.0 else target, target)


@kernel
def within(voltage: float, end: float, target: float) -> float:
    """Return the voltage, brought to `end` unless it is between that and the target already.

    One that is ahead of the lag waits for it: going back would be a loop of the load's hysteresis.
    """
    low, high = min(end, target), max(end, target)
    return min(max(voltage, low), high)
