"""Compiled inner loop of the DAD 141.1: the conversions of a while, made together."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bench.base import kernel

Floats = NDArray[np.float64]

LEAST_LAGS = 1e-6
"""Time constants in which nothing changes."""
COARSE = 0.05
"""Time between two looks for the motion detection, s."""

# State: instant of the last conversion (s), its signal, what is behind the first and the second lag, the noise behind
# these (units); since when the signal is still (s), the digits that this is counted from, the present digits, gross
# weight, peak, and zero (all in digits).
CONVERTED, INPUT, FIRST, SECOND, NOISE_FIRST, NOISE_SECOND, STILL_SINCE = range(7)
REFERENCE, DIGITS, GROSS, PEAK, ZERO = range(7, 12)


class Course(Protocol):
    """The course of the force on a cell, as its plant keeps it: one value a step of a time grid."""

    step: float
    tolerance: float
    """Step of the grid, and how far before a point that counts as reached, s."""

    @property
    def forces(self) -> Floats:
        """Force at the last grid points, N, in a ring, and behind it the number of the last; see `convert_along`."""

    @property
    def is_known(self) -> bool:
        """Whether the force goes by these values alone, whatever the instruments do until the next request."""

    def since_point(self) -> float:
        """Return the time for which the plant has stood at the last grid point, s."""


class SetUp(NamedTuple):
    """What the conversions need of the settings."""

    lag: float
    """Time constant of either lag, s."""
    spread: float
    """Noise behind the second lag, units."""
    memory: float
    """Time before a reading for which the force matters to it, s."""
    fine: float
    fine_until: float
    """Time between two looks at the force up to some time before a reading, s."""
    motion_range: float
    """Digits."""
    span: float
    """Largest weight that the converter takes, of either sign, units."""
    newtons_per_unit: float
    zero_newtons: float
    scale: float
    """Digits of a unit."""
    step: float
    """Step of the last digit, digits."""


@kernel
def fading(lags: float) -> tuple[float, float, float, float]:
    """Return how the noise behind two lags fades within some time constants, exactly for white noise before them.

    Returns
    -------
    tuple of float
        What remains of a lag's output. What of the two fresh numbers is added behind the second lag: of the one that
        also goes into the first, and of the other; and what of the one behind the first.
    """
    decay = math.exp(-lags)
    # The stationary covariance is 2, 1, 1 in units of the output's variance. What the known values still say of it
    # fades by `known`; the rest is new.
    known = decay * decay
    first = -2 * math.expm1(-2 * lags)
    both = 1 - known * (1 + 2 * lags)
    second = 1 - known * (1 + 2 * lags + 2 * lags * lags)
    along = both / math.sqrt(first)
    return decay, along, math.sqrt(max(second - along * along, 0.0)), math.sqrt(first)


@kernel
def next_look(converted: float, asked: float, s: SetUp) -> float:
    """Return when the filter next looks at the force (s) after a conversion, for a reading that is asked for."""
    waiting = asked - converted
    # The margins of one coarse step keep a clock that runs on from drawing these instants along with it.
    if waiting <= s.fine_until:
        return converted + s.fine
    if waiting > s.memory + COARSE:
        return asked - s.memory
    return converted + COARSE


@kernel
def convert_along(
    state: Floats,
    s: SetUp,
    asked: Floats,
    since: float,
    until: float,
    forces: Floats,
    step: float,
    point: float,
    tolerance: float,
    normals: Floats,
) -> tuple[int, float, int]:
    """Make all conversions for readings that were asked for at some instants, up to one of these at most.

    Parameters
    ----------
    state, s
        State and settings of the converter.
    asked : ndarray
        The instants in their order, s.
    since, until : float
        Instants where the plant stood before the first of them, and up to where its course is known, s.
    forces : ndarray
        The force (N) at the last grid points, in a ring: at the n-th in place n modulo its size. Behind it stands n.
    step, point, tolerance : float
        Step of the grid, the instant of its last point, and how far before a point that counts as reached, s.
    normals : ndarray
        Numbers of the standard normal distribution; two are taken for each conversion.

    Returns
    -------
    tuple
        How many instants are done, where the plant stood at the last conversion or instant that is done (s), and how
        many normal numbers were taken. If these were too few, the rest follows in another call.
    """
    size = forces.size - 1
    latest = int(forces[size])
    taken = 0
    for i in range(asked.size):
        while True:
            look = next_look(state[CONVERTED], asked[i], s)
            if look > asked[i]:
                break
            if look > until or taken + 2 > normals.size:
                return i, since, taken
            since = max(look, since)
            back = max(math.ceil((point - since - tolerance) / step), 0)
            weight = (forces[(latest - back) % size] - s.zero_newtons) / s.newtons_per_unit
            signal = min(max(weight, -s.span), s.span)
            lags = (since - state[CONVERTED]) / s.lag
            if lags < LEAST_LAGS:
                break
            decay, along, across, alone = fading(lags)
            # Two equal lags with an input that runs straight from the last look to this one.
            trail = (signal - state[INPUT]) / lags
            first = state[FIRST] - state[INPUT] + trail
            second = state[SECOND] - state[INPUT] + 2 * trail
            state[FIRST] = signal - trail + first * decay
            state[SECOND] = signal - 2 * trail + (second + first * lags) * decay
            state[INPUT] = signal
            state[CONVERTED] = since
            fresh, other = s.spread * normals[taken], s.spread * normals[taken + 1]
            taken += 2
            state[NOISE_SECOND] = (
                decay * (state[NOISE_SECOND] + lags * state[NOISE_FIRST]) + along * fresh + across * other
            )
            state[NOISE_FIRST] = decay * state[NOISE_FIRST] + alone * fresh
            state[DIGITS] = round((state[SECOND] + state[NOISE_SECOND]) * s.scale / s.step) * s.step
            state[GROSS] = state[DIGITS] - state[ZERO]
            state[PEAK] = max(state[PEAK], state[GROSS])
            if abs(state[DIGITS] - state[REFERENCE]) > s.motion_range:
                state[REFERENCE] = state[DIGITS]
                state[STILL_SINCE] = since
        since = max(since, asked[i])
    return asked.size, since, taken
