"""An emulated laboratory whose specimen is a functional mock-up unit."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field, InstanceOf

from bench.devices import DriverSettings
from bench.rig import LaboratorySettings
from bench.specimen import SetUpTable
from sim_devices.plants.fmu import FMUPlant
from sim_devices.twin_laboratory import Actuated, TwinLaboratory


class FMULaboratorySettings(SetUpTable):
    """What `[emulation]` says of a unit. Of `drive` the resolution counts; delay and lag are the unit's own."""

    file: Path = Field(description="the .fmu file")
    takes: str = Field(default="u", description="input of the unit that takes the set-points")
    gives: str = Field(default="y", description="output of the unit that is the response")
    drive_output: str = Field(
        default="", description="output of the unit that is the drive; the set-point itself if empty"
    )
    step: float = Field(gt=0, le=1, description="communication step of the unit, s")
    devices: dict[str, InstanceOf[DriverSettings]] = Field(
        default_factory=dict, description="the devices of the rig file, which the bench fills in"
    )


class _Unit:
    """A plant as the laboratory of a twin takes it."""

    def __init__(self, settings: FMULaboratorySettings) -> None:
        gives = [settings.gives, *([settings.drive_output] if settings.drive_output else [])]
        self._plant = FMUPlant(settings.file, settings.takes, gives, settings.step, settings.drive.rest)
        self._setpoint = settings.drive.rest

    def set(self, value: float) -> None:
        """Take a set-point."""
        self._setpoint = value
        self._plant.set(value)

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        self._plant.advance(dt)

    @property
    def response(self) -> float:
        """The response, output units."""
        return self._plant.outputs[0]

    @property
    def drive(self) -> float:
        """The drive, input units."""
        outputs = self._plant.outputs
        return outputs[1] if len(outputs) > 1 else self._setpoint


class FMULaboratory(TwinLaboratory):
    """A laboratory with the devices of a rig, around a functional mock-up unit; see the module."""

    Settings: ClassVar[type[LaboratorySettings]] = FMULaboratorySettings
    title: ClassVar[str] = "functional mock-up unit"

    def make_specimen(self, settings: FMULaboratorySettings, rng: np.random.Generator) -> Actuated:  # type: ignore[override]  # noqa: ARG002
        """Return the unit."""
        return _Unit(settings)
