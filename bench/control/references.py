"""References for tracking: sequences of targets, moving references, and the input rate that a reference needs."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models import Inverse

S = TypeVar("S")
Reference: TypeAlias = Callable[[float], float]
"""Wanted output at a time in s from the start; also defined before 0 and after the end."""


def tracking_targets(rng: np.random.Generator, low: float, high: float, count: int = 60) -> Floats:
    """Return targets within [low, high], shape (count,), in large and in small moves, up and down.

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
    """Return a sine whose amplitude swells and fades, at given times, shape (N,), output units.

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


def _blend(x: float) -> float:
    """Return the share of the top speed after the share x of the blend: the minimum-jerk curve."""
    if x <= 0.0:
        return 0.0
    return x**3 * (10.0 + x * (6.0 * x - 15.0)) if x < 1.0 else 1.0


def _blended(x: float) -> float:
    """Return the integral of `_blend`."""
    if x <= 0.0:
        return 0.0
    return x**4 * (2.5 + x * (x - 3.0)) if x < 1.0 else x - 0.5


class SmoothMoves:
    """A reference that moves from position to position on S-curves of a given top speed and holds at each.

    Speed rises and falls on minimum-jerk curves, so that position, speed and acceleration are continuous. A move
    too short to reach the top speed is slower.

    Parameters
    ----------
    positions : sequence of float
        Output units; the first is where it starts, without a hold.
    speed : float
        Top speed, output units per second.
    hold : float
        Time at each position but the first, s, >= 0.
    blend : float
        Time to the top speed, s.

    Raises
    ------
    ValueError
        If there are not two positions, one is not finite, or a number is out of range.
    """

    def __init__(self, positions: Sequence[float], speed: float, *, hold: float = 60.0, blend: float = 10.0) -> None:
        places = _checks.samples("positions", positions)
        if places.size < 2:
            raise ValueError(f"positions: expected at least 2, got {places.size}")
        if not (0.0 < speed < math.inf and 0.0 < blend < math.inf and 0.0 <= hold < math.inf):
            raise ValueError(
                f"speed, blend, hold: expected positive numbers (hold may be 0), got {speed}, {blend} and {hold}"
            )
        self._blend = blend
        moves = np.diff(places)
        # A move takes its time at top speed and one blend.
        ends = np.cumsum(np.abs(moves) / speed + blend + hold)
        starts, spots = [0.0, *ends.tolist()[:-1]], places.tolist()
        cruises, rises = (np.abs(moves) / speed / blend).tolist(), (np.sign(moves) * speed * blend).tolist()
        self._starts: list[float] = starts
        # Of each move: start, time at top speed in blends, places before and behind, rise in a blend at top speed.
        self._moves: list[tuple[float, float, float, float, float]] = list(
            zip(starts, cruises, spots, spots[1:], rises, strict=False)
        )
        self.duration = float(ends[-1])
        """Time to the end of the last hold, s."""

    def __call__(self, t: float) -> float:
        """Return the position at a time (s), output units; it rests before the start and after the end."""
        # Few calls, as a fast loop asks several times for each sample.
        start, cruise, before, behind, rise = self._moves[bisect_right(self._starts, t, 1) - 1]
        x = (t - start) / self._blend
        if x >= cruise + 1.0:
            return behind
        begun = x - 0.5 if x >= 1.0 else _blended(x)
        ended = _blended(x - cruise) if x > cruise else 0.0
        return before + rise * (begun - ended)


def staircase(
    low: float,
    high: float,
    steps: int,
    speed: float,
    *,
    start: float = 0.0,
    hold: float = 60.0,
    blend: float = 10.0,
) -> SmoothMoves:
    """Return a reference from the start to low, to high and back in equal steps; others as `SmoothMoves`.

    Raises ValueError if there is no step, low and high are not increasing, or as `SmoothMoves`.
    """
    bottom, top = _checks.increasing("low, high", [low, high]).tolist()
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    up = np.linspace(bottom, top, steps + 1)
    return SmoothMoves([start, *up.tolist(), *up[-2::-1].tolist()], speed, hold=hold, blend=blend)


class AddedSine:
    """A sine on top of another reference, with an amplitude that rises within its first two periods.

    Parameters
    ----------
    base : callable
        The other reference.
    amplitude : float
        Output units.
    frequency : float
        Hz.

    Raises
    ------
    ValueError
        If the amplitude is not finite or the frequency not positive.
    """

    def __init__(self, base: Reference, amplitude: float, frequency: float) -> None:
        if not 0.0 < frequency < math.inf:
            raise ValueError(f"frequency: expected a positive number of Hz, got {frequency}")
        self._base = base
        self._amplitude = _checks.number("amplitude", amplitude)
        self._frequency = frequency

    def __call__(self, t: float) -> float:
        """Return the position at a time (s), output units."""
        periods = self._frequency * t
        return self._base(t) + self._amplitude * _blend(0.5 * periods) * math.sin(2.0 * math.pi * periods)


class ApproachedReference:
    """A reference that begins where the output is, where that is far from its own beginning.

    Parameters
    ----------
    reference : callable
        The other reference.
    near : float
        Distance from its beginning, output units, up to which it is left as it is.
    speed : float
        Top speed of the move to its beginning, output units per second.
    """

    def __init__(self, reference: Reference, near: float, speed: float) -> None:
        self._reference = reference
        self._near = near
        self._speed = speed
        self._approach: SmoothMoves | None = None
        self.delay = 0.0
        """Time by which the other reference is put off, s."""

    @property
    def from_here(self) -> Reference:
        """What gives the position from `begin` on: the other reference itself, where nothing is put before it."""
        return self._reference if self._approach is None else self

    def begin(self, output: float) -> None:
        """Begin at the output of the moment (output units)."""
        first = self._reference(0.0)
        if abs(output - first) > self._near:
            self._approach = SmoothMoves([output, first], self._speed, hold=0.0)
            self.delay = self._approach.duration

    def __call__(self, t: float) -> float:
        """Return the position at a time (s), output units."""
        if self._approach is not None and t < self.delay:
            return self._approach(t)
        return self._reference(t - self.delay)


@dataclass(frozen=True)
class Slope:
    """How fast the input must move for a reference."""

    rate: float  # greatest rate of the input on continuous stretches, input units per second
    time: float  # when that is, s

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
    wanted = _checks.counted("reference", reference, moments.size, "values, one for each time")
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
    return Slope(rate=float(smooth[fastest]), time=float(moments[fastest]))
