"""A drum on the shaft of an emulated MX-28: a linear stage."""

from __future__ import annotations

import math

from bench.devices import Identity, Limits, LinearStage, Status
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.dynamixel_table import COUNT
from sim_devices.instruments.emulated import EmulatedDevice


class EmulatedDrum(EmulatedDevice, LinearStage):
    """An emulated MX-28 with a drum on its shaft, as the role of a linear stage and as a plant sees it.

    Called directly, positions are those of the position registers, as `zero_counts`, `direction` and `radius`
    turn them into m; the stage resolves `COUNT` · `radius`. It has the name of its servo; on the wire the servo
    answers.

    Parameters
    ----------
    servo : EmulatedMX28
        The servo that turns the drum.
    radius : float
        Distance from the axis to the middle of the wire, m.
    zero_counts : int
        Where the position zero is, counts.
    direction : int
        1 if the position grows with the counts, -1 if against them.

    Raises
    ------
    ValueError
        If the radius is not positive, or the direction is neither 1 nor -1.
    """

    def __init__(self, servo: EmulatedMX28, radius: float, *, zero_counts: int = 0, direction: int = 1) -> None:
        if not 0.0 < radius < math.inf:
            raise ValueError(f"radius: expected a positive length, got {radius} m")
        if direction not in (1, -1):
            raise ValueError(f"direction: expected 1 or -1, got {direction}")
        super().__init__(servo.name, servo.world)
        self._servo = servo
        self._scale = direction * radius
        self._zero = zero_counts * COUNT
        self._asked = self._sent = math.nan

    # As a plant sees it.

    @property
    def position(self) -> float:
        """Position of the wire's end itself, m, by the angle of the shaft; asking does not let time pass.

        It agrees with the registers' as long as these have lost no turn and have no homing offset.
        """
        return self._metres(self._servo.position)

    @property
    def is_moving(self) -> bool:
        """Whether the wire's end is on its way; asking does not let time pass."""
        return self._servo.is_moving

    def position_after(self, seconds: float) -> float:
        """Return where the profile brings the wire's end within some seconds, m, for a plant on its way there."""
        return self._metres(self._servo.position_after(seconds))

    # The role of a linear stage.

    @property
    def identity(self) -> Identity:
        """Maker, model, id on the bus (there is no serial number) and firmware of the servo."""
        return self._servo.identity

    @property
    def limits(self) -> Limits:
        """The range of the goal position in the servo's present operating mode, m."""
        limits = self._servo.limits
        low, high = sorted((self._metres(limits.low), self._metres(limits.high)))
        return Limits(low, high, "m")

    @property
    def setpoint(self) -> float:
        """The position that `set` or `stop` last took, m; nan before the first."""
        angle = self._servo.setpoint
        return self._asked if angle == self._sent else self._metres(angle)

    def set(self, value: float) -> Status:
        """Move to a position (m), and switch the torque on if it is off."""
        self.check(value)
        limits = self._servo.limits
        # Within the limits, rounding alone can bring it beyond them.
        angle = min(max(value / self._scale + self._zero, limits.low), limits.high)
        status = self._servo.set(angle)
        self._asked, self._sent = value, angle
        return status

    @property
    def force_enabled(self) -> bool:
        """Whether the torque is on."""
        return self._servo.torque_enabled

    def measure(self) -> dict[str, float]:
        """Measure position (m), velocity (m/s) and load (share of the stall torque)."""
        angle, angular_velocity, load = self._servo.measure().values()
        values = (self._metres(angle), angular_velocity * self._scale, math.copysign(1.0, self._scale) * load)
        return {signal.name: value for signal, value in zip(self.signals, values, strict=True)}

    def stop(self, success: bool = True) -> None:
        """Hold the present position; does nothing while the torque is off."""
        self._servo.stop(success)

    def safe(self) -> None:
        """Switch the torque off, and clear a watchdog that has expired."""
        self._servo.safe()

    def _metres(self, angle: float) -> float:
        return (angle - self._zero) * self._scale
