"""Specimens of sensors: the errors that one sensor of a kind has, from what the data sheet of its kind states.

A typical value is taken as it is. A tolerance is drawn once for each specimen, uniformly within its limits
(JCGM 100:2008, 4.3.7), from a seed of the sensors: the same specimen in all runs of a laboratory, as the same sensor
stands there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from bench.rig import LaboratorySettings
from sim_devices.transducers.imperfect import Characteristic, SensorErrors


@dataclass(frozen=True)
class DataSheet:
    """What is known of the sensors of a kind.

    Attributes
    ----------
    range : pair of float
        Lowest and highest value of the quantity, in its unit; errors are shares of what lies between.
    typical : SensorErrors
        What all of them have.
    gain_tolerance : float
        Largest error of the gain of a specimen, either way, as a share.
    offset_tolerance : float
        Largest error of a specimen at zero, either way, in the unit of the quantity.
    """

    range: tuple[float, float]
    typical: SensorErrors
    gain_tolerance: float = 0.0
    offset_tolerance: float = 0.0

    def specimen(self, seed: int, name: str) -> SensorErrors:
        """Return the errors of the specimen of a seed at the place of a name."""
        gain, offset = np.random.default_rng([seed, *name.encode()]).uniform(-1.0, 1.0, 2).tolist()
        return self.typical.model_copy(
            update={
                "gain_error": self.typical.gain_error + gain * self.gain_tolerance,
                "offset": self.typical.offset + offset * self.offset_tolerance,
            }
        )


class SensorSettings(LaboratorySettings):
    """Settings of a laboratory whose sensors are specimens; each has a field of type `SensorErrors`."""

    sensors: Literal["data-sheet", "ideal"] = Field(
        default="data-sheet",
        description="whether sensors have the systematic errors that data sheets state for their kind, or none; a "
        "key in the table of a sensor replaces its one",
    )
    sensor_seed: int = Field(default=0, ge=0, description="seed of the specimens of the sensors")

    def errors_of(self, name: str, sheet: DataSheet) -> SensorErrors:
        """Return the errors of the sensor of a field: what is given there, and else its specimen's."""
        given: SensorErrors = getattr(self, name)
        if self.sensors == "ideal":
            return given
        return sheet.specimen(self.sensor_seed, name).model_copy(update=given.model_dump(exclude_unset=True))

    def characteristic_of(self, name: str, sheet: DataSheet, zero: float = 0.0) -> Characteristic:
        """Return what the sensor of a field makes of its quantity, counted from `zero` in the range of the sensor."""
        low, high = sheet.range
        return Characteristic(self.errors_of(name, sheet), low - zero, high - zero)
