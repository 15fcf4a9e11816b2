"""An optical displacement sensor with a voltage output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import numpy as np

from sim_devices.noise import normals


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
    """White noise in m rms, drawn anew for every conversion; zero or positive."""
    resolution: float = 10e-9
    """Steps in which the sensor gives the displacement, in m."""
    _: KW_ONLY
    rng: np.random.Generator
    """Source of the noise."""

    def __post_init__(self) -> None:
        self._normals = normals(self.rng)

    def __call__(self) -> float:
        """Return the voltage in V at this instant."""
        noisy = self.displacement() + self.noise * next(self._normals)
        shown = round(noisy / self.resolution) * self.resolution
        reach = self.reach
        if not -reach <= shown <= reach:
            shown = min(max(shown, -reach), reach)
        return self.volts_per_metre * shown
