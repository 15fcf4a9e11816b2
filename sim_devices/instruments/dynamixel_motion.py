"""The motion of a Dynamixel servo's shaft: its profiles, and its balance with a load.

The torque and the speed are those of the ROBOTIS e-Manual, MX-28(2.0), specifications.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

STALL_TORQUE_PER_VOLT = 2.5 / 12.0
"""Stall torque over supply voltage, N·m/V: 2.5 N·m at 12 V."""

NO_LOAD_SPEED_PER_VOLT = 55.0 * 2.0 * math.pi / 60.0 / 12.0
"""No-load speed over supply voltage, rad/s/V: 55 rev/min at 12 V."""

GEAR_FRICTION = 0.1
"""Torque of a load that the gear holds while the torque is off, N·m; an assumption."""

_BALANCE_PRECISION = 1e-6  # rad


class ShaftLoad(Protocol):
    """The load on the shaft."""

    def torque(self, angle: float) -> float:
        """Return the torque on the shaft at an angle (rad), N·m; positive towards larger angles.

        It must be the answer of the load's present state, and asking must not change that.
        """


@dataclass(frozen=True)
class Trajectory:
    """A motion from one angle to another, piecewise of constant acceleration."""

    start: float
    """When it begins, s."""
    origin: float
    target: float
    """Where it begins and where it ends, rad."""
    pieces: tuple[tuple[float, float, float], ...] = ()
    """Duration (s), velocity at its beginning (rad/s) and acceleration (rad/s²) of each piece."""

    @cached_property
    def end(self) -> float:
        """When it has ended, s."""
        return self.start + sum(duration for duration, _, _ in self.pieces)

    def at(self, instant: float) -> tuple[float, float]:
        """Return angle (rad) and velocity (rad/s) at an instant (s)."""
        if instant >= self.end:
            return self.target, 0.0
        left, angle = max(instant - self.start, 0.0), self.origin
        for duration, velocity, acceleration in self.pieces:
            if left <= duration:
                return angle + (velocity + 0.5 * acceleration * left) * left, velocity + acceleration * left
            angle += (velocity + 0.5 * acceleration * duration) * duration
            left -= duration
        return self.target, 0.0

    @classmethod
    def to_position(
        cls, start: float, origin: float, initial: float, target: float, velocity: float, acceleration: float
    ) -> Trajectory:
        """Plan the way to a standstill at an angle.

        Parameters
        ----------
        start : float
            When it begins, s.
        origin : float
            Where it begins, rad.
        initial : float
            Velocity at the beginning, rad/s.
        target : float
            Where it ends, rad.
        velocity : float
            Highest velocity, rad/s, positive.
        acceleration : float
            Acceleration and deceleration, rad/s²; infinity for a rectangular profile.
        """
        if math.isinf(acceleration):
            distance = target - origin
            if distance == 0.0:
                return cls(start, origin, target)
            return cls(start, origin, target, ((abs(distance) / velocity, math.copysign(velocity, distance), 0.0),))
        # Where a braking begun now would end decides about the direction.
        distance = target - origin - initial * abs(initial) / (2.0 * acceleration)
        sign = math.copysign(1.0, distance)
        way, speed = sign * (target - origin), sign * initial
        peak = min(math.sqrt(max(acceleration * way + 0.5 * speed * speed, 0.0)), velocity)
        first = abs(peak - speed) / acceleration
        change = math.copysign(acceleration, peak - speed)
        last = peak / acceleration
        cruise = 0.0
        if peak == velocity:
            cruise = max(way - 0.5 * (speed + peak) * first - 0.5 * peak * last, 0.0) / peak
        pieces = (
            (first, initial, sign * change),
            (cruise, sign * peak, 0.0),
            (last, sign * peak, -sign * acceleration),
        )
        return cls(start, origin, target, tuple(piece for piece in pieces if piece[0] > 0.0))

    @classmethod
    def at_velocity(
        cls, start: float, origin: float, initial: float, velocity: float, acceleration: float
    ) -> Trajectory:
        """Plan an endless motion at a velocity (rad/s); parameters as for `to_position`."""
        if velocity == 0.0 and (initial == 0.0 or math.isinf(acceleration)):
            return cls(start, origin, origin)
        change = math.copysign(acceleration, velocity - initial)
        ramp = (abs(velocity - initial) / acceleration, initial, change if math.isfinite(change) else 0.0)
        if velocity == 0.0:
            return cls(start, origin, origin + 0.5 * initial * ramp[0], (ramp,))
        pieces = (ramp, (math.inf, velocity, 0.0)) if ramp[0] > 0.0 else ((math.inf, velocity, 0.0),)
        return cls(start, origin, math.nan, pieces)


def balance(load: ShaftLoad, near: float, reach: float, drive: Callable[[float], float] | None = None) -> float:
    """Find the angle at which servo and load balance, by bisection.

    Parameters
    ----------
    near : float
        Angle where the shaft is, rad.
    reach : float
        Angle that it can turn by at most, rad.
    drive : callable, optional
        Torque of the servo (N·m) at an angle (rad); without it the torque is off and the gear holds by friction.

    Returns
    -------
    float
        Angle, rad, to `_BALANCE_PRECISION`.
    """

    def net(angle: float) -> float:
        torque = load.torque(angle)
        if drive is None:
            return math.copysign(max(abs(torque) - GEAR_FRICTION, 0.0), torque)
        return torque + drive(angle)

    push = net(near)
    if push == 0.0:
        return near
    far = near + math.copysign(reach, push)
    if net(far) * push > 0.0:
        return far
    while abs(far - near) > _BALANCE_PRECISION:
        middle = 0.5 * (near + far)
        if net(middle) * push > 0.0:
            near = middle
        else:
            far = middle
    return near
