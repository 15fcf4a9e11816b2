"""A Dynamixel MX-28 that holds an angle."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from bench.devices import Limits, Servo
from drivers.dynamixel.mx28 import MX28, MX28Settings


class AngleSettings(MX28Settings):
    """Rig-file settings of a Dynamixel MX-28 that holds an angle."""

    position_limits: tuple[float, float] = Field(
        description="lowest and highest angle set-point, rad; both within ±1048575 counts of the servo"
    )

    @model_validator(mode="after")
    def _check_position_limits(self) -> Self:
        self._check_limits("position_limits", self.position_limits, "rad")
        return self

    @property
    def limits(self) -> Limits:
        """The allowed angles, rad."""
        return Limits(*self.position_limits, "rad")

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
