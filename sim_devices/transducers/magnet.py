"""A linear magnet sensor with a ratiometric output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from sim_devices.noise import normals


@dataclass(eq=False)
class RatiometricSensor:
    """A linear magnet sensor, of the kind of the SPS-L035-LATS, whose output is a share of its supply.

    Assumption: the output goes from 10 to 90 % of a supply of 5 V over the stroke, and stays at its end for a
    magnet that is beyond it.
    """

    position: Callable[[], float]
    """The position of the magnet in m, counted from the start of the stroke, from the plant."""
    stroke: float = 0.035
    """Stroke in m."""
    noise: float = 0.01e-3
    """White noise in m rms, drawn for every conversion; zero or positive."""
    resolution: float = 0.04e-3
    """Steps in which the sensor gives the position, in m."""
    supply_error: float = 20e-3
    """Deviation of the supply of one instance from 5 V, V rms; drawn once."""
    _: KW_ONLY
    rng: np.random.Generator
    """Source of the noise and of the error of the supply; nothing else may draw from it."""
    supply_volts: float = field(init=False)
    """Voltage of the supply in V; for faults and drift."""

    def __post_init__(self) -> None:
        self.supply_volts = 5.0 + self.supply_error * self.rng.standard_normal()
        self._normals = normals(self.rng)

    def output(self) -> float:
        """Return the output voltage in V at this instant."""
        noisy = self.position() + self.noise * next(self._normals)
        step = round(noisy / self.resolution) * self.resolution
        share = min(max(step / self.stroke, 0.0), 1.0)
        return self.supply_volts * (0.1 + 0.8 * share)

    def supply(self) -> float:
        """Return the voltage in V of the supply at this instant."""
        return self.supply_volts
