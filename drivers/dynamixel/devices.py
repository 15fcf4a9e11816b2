"""The devices that a Dynamixel MX-28 is: a servo that holds an angle, and a linear stage with a drum on its shaft."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from bench.devices import LinearStage, Servo
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


class DrumSettings(MX28Settings):
    """Rig-file settings of a Dynamixel MX-28 that winds a wire on a drum.

    Profile and tolerance are those of the shaft, in rad; times `drum_radius` they are those of the stage.
    """

    drum_radius: float = Field(
        gt=0.0,
        le=1.0,
        description="distance from the axis to the middle of the wire, which lies in one layer, m: above 0, up to 1; "
        "the stage resolves 2π/4096 rad · drum_radius",
    )
    stage_limits: tuple[float, float] = Field(
        description="lowest and highest position set-point, m; both within ±1048575 counts of the servo, each "
        "2π/4096 rad · drum_radius"
    )

    _LIMITS = ("stage_limits", "m")

    @property
    def per_radian(self) -> float:
        """Wire wound per angle, m/rad."""
        return self.drum_radius


class DynamixelDrum(MX28[DrumSettings], LinearStage):
    """A Dynamixel MX-28 with a drum on its shaft: the end of the wire that it winds is the stage.

    The position is the angle times `drum_radius`, with the sign and the zero that `direction` and `zero_counts`
    give to the angle. The stage resolves 2π/4096 rad · `drum_radius`, which is 15 µm on a drum of 10 mm.

    After a power cycle or a reboot the position is off by whole circumferences of the drum, so check `zero_counts`
    before the next set-point.
    """

    Settings: ClassVar[type[DrumSettings]] = DrumSettings
    _DIGITS = 6

    @property
    def force_enabled(self) -> bool:
        """Whether the servo holds its position, as it reports now."""
        return self._holds()
