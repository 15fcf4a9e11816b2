"""An optical displacement sensor with a voltage output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule
from sim_devices.noise import normals

if TYPE_CHECKING:
    from sim_devices.transducers import _voltage_kernels as kernels
else:
    kernels = DeferredModule("sim_devices.transducers._voltage_kernels")


@dataclass(eq=False)
class DisplacementSensor:
    """An optical displacement sensor with a voltage in proportion to the displacement."""

    displacement: Callable[[], float]
    """The displacement in m, from the plant."""
    volts_per_metre: float = 5e4
    """Sensitivity in V/m."""
    reach: float = 200e-6
    """Displacement of either sign in m beyond which the output stays where it is."""
    noise: float = 10e-9
    """White noise in m rms, drawn for every conversion; zero or positive."""
    resolution: float = 10e-9
    """Steps in which the sensor gives the displacement, in m."""
    _: KW_ONLY
    rng: np.random.Generator
    """Source of the noise."""

    def __post_init__(self) -> None:
        self.draw: Callable[[], float] = normals(self.rng).__next__
        """Gives the next number of the standard normal distribution, for the noise of a conversion."""
        # Compiled before a driver waits for an answer.
        kernels.displacement_volts(0.0, self.resolution, self.reach, self.volts_per_metre)

    def __call__(self) -> float:
        """Return the voltage in V at this instant."""
        noisy = self.displacement() + self.noise * self.draw()
        return float(kernels.displacement_volts(noisy, self.resolution, self.reach, self.volts_per_metre))
