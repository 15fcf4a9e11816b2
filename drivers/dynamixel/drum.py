"""A Dynamixel MX-28 with a drum on its shaft: a linear stage that winds a wire."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from bench.devices import LinearStage
from drivers.dynamixel.mx28 import MX28, MX28Settings


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
