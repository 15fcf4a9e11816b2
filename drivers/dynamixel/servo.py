"""A Dynamixel MX-28 that holds an angle."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from bench.devices import Servo
from drivers.dynamixel.mx28 import MX28, MX28Settings


class AngleSettings(MX28Settings):
    """Rig-file settings of a Dynamixel MX-28 that holds an angle."""

    position_limits: tuple[float, float] = Field(
        description="lowest and highest angle set-point, rad; both within ±1048575 counts of the servo"
    )

    _LIMITS = ("position_limits", "rad")

    @property
    def per_radian(self) -> float:
        """1: the set-point is the angle."""
        return 1.0


class DynamixelMX28(MX28[AngleSettings], Servo):
    """A Dynamixel MX-28 as a servo."""

    Settings: ClassVar[type[AngleSettings]] = AngleSettings
    _DIGITS = 4

    @property
    def torque_enabled(self) -> bool:
        """Whether the servo holds its position, as it reports now."""
        return self._holds()
