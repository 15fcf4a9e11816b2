"""References for tracking: targets one after another, a moving reference, and whether an actuator can follow it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from bench.hysteresis import Inverse, _checks
from bench.hysteresis._checks import Floats

S = TypeVar("S")


def tracking_targets(rng: np.random.Generator, low: float, high: float, count: int = 60) -> Floats:
    """Return targets that visit a range in large and in small moves, up and down.

    The first half is a decaying oscillation about the middle of the range, of 2.5 targets a half-cycle so
    that targets fall on its flanks too; it calls up nested minor loops. The second half is uniformly random.
    Zhang et al. 2013, section V-B, have targets between -63 and 1814 1/m.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the random half.
    low, high : float
        Least and greatest target, output units.
    count : int
        Number of targets, >= 1.

    Returns
    -------
    ndarray, shape (count,)
        Targets within [low, high], output units.

    Raises
    ------
    ValueError
        If low >= high, a number is not finite, or there is no target.
    """
    bottom, top = _checks.increasing("low, high", [low, high]).tolist()
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    half = (count + 1) // 2
    n = np.arange(half)
    swing = (1.0 - n / half) * np.sin(0.4 * math.pi * (n + 1.25))
    oscillation = 0.5 * (bottom + top) + 0.5 * (top - bottom) * swing
    return np.concatenate([oscillation, rng.uniform(bottom, top, count - half)])


def modulated_sine(times: ArrayLike, low: float, high: float, period: float, depth: float = 0.6) -> Floats:
    """Return a sine whose amplitude swells and fades, at given times.

    It starts in the middle of the range and rises. Its envelope goes from 1 down to 1 - depth and back
    within 4.3 periods, so that successive reversals differ and minor loops are followed.

    Parameters
    ----------
    times : array_like, shape (N,)
        Times, s.
    low, high : float
        Range of the reference, output units; never left.
    period : float
        Period of the sine, s.
    depth : float
        Part of the amplitude that the envelope takes away, 0 to 1.

    Returns
    -------
    ndarray, shape (N,)
        The reference, output units.

    Raises
    ------
    ValueError
        If low >= high, the period is not positive, the depth is not within 0 to 1, or a time is not finite.
    """
    moments = _checks.samples("times", times)
    bottom, top = _checks.increasing("low, high", [low, high]).tolist()
    if not 0.0 < period < math.inf:
        raise ValueError(f"period: expected a positive number of seconds, got {period}")
    if not 0.0 <= depth <= 1.0:
        raise ValueError(f"depth: expected a number within 0 to 1, got {depth}")
    phase = 2.0 * math.pi * moments / period
    envelope = 1.0 - depth * np.sin(phase / 8.6) ** 2
    reference = 0.5 * (bottom + top) + 0.5 * (top - bottom) * envelope * np.sin(phase)
    return np.asarray(np.clip(reference, bottom, top))


@dataclass(frozen=True)
class Slope:
    """How fast the input must move for a reference.

    Parameters
    ----------
    rate : float
        Greatest rate of the input on continuous stretches, input units per second.
    time : float
        When that is, s.
    jump : float
        Greatest move of the input within one sample where it is not continuous: a reversal must first cross
        the stretch on which the output hardly answers, or goes the wrong way. Input units.
    """

    rate: float
    time: float
    jump: float

    def within(self, limit: float) -> bool:
        """Return whether an actuator of this rate limit, input units per second, can follow."""
        return self.rate <= limit


def fastest_slope(inverse: Inverse[S], times: ArrayLike, reference: ArrayLike, state: S | None = None) -> Slope:
    """Return the input rate that a moving reference asks for, by inverting it.

    A step from the present output to the start of the reference does not count, nor do the two samples about
    a reversal of the input: an inverse of a non-monotonic operator jumps there however slow the reference
    is, and the error while the actuator crosses the jump is bounded by the little that the output does there.

    Parameters
    ----------
    inverse : Inverse
        Inverse of the identified model.
    times : array_like, shape (N,)
        Increasing times, s, N >= 3.
    reference : array_like, shape (N,)
        Reference at these times, output units.
    state : object or None
        Memory before the reference; default that of the model.

    Raises
    ------
    ValueError
        If times do not increase, lengths differ, a number is not finite, or the reference leaves the range
        of the model.
    """
    moments = _checks.increasing("times", times, least=3)
    wanted = _checks.samples("reference", reference)
    if wanted.size != moments.size:
        raise ValueError(f"reference: expected {moments.size} values, one for each time, got {wanted.size}")
    followed = inverse.follow(wanted, state)
    if not followed.met.all():
        at = int(np.argmin(followed.met))
        low, high = inverse.operator.output_range()
        raise ValueError(
            f"reference: expected values within the model's range, {low:g} to {high:g} "
            f"{inverse.operator.output_unit}, got {wanted[at]:g} at {moments[at]:g} s"
        )
    moves = np.diff(followed.setpoints)
    rates = np.abs(moves) / np.diff(moments)
    direction = np.sign(moves)
    turned = np.zeros(moves.size, dtype=bool)
    turned[1:] = direction[1:] != direction[:-1]
    # The start is wherever the first target happens to be found; a passage through saturation is a jump too.
    turned |= ~np.isnan(followed.saturating[1:])
    smooth = np.where(turned, 0.0, rates)
    fastest = int(np.argmax(smooth))
    jump = float(np.abs(moves[turned]).max()) if turned.any() else 0.0
    return Slope(rate=float(smooth[fastest]), time=float(moments[fastest]), jump=jump)
