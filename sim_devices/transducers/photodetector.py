"""A position-sensitive photodetector (PSD) that sees the deflection of a cantilever by a laser spot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from sim_devices.noise import normals


@dataclass(eq=False)
class NormalisedPSD:
    """A position-sensitive detector whose amplifier gives one voltage in proportion to the deflection.

    The amplifier saturates at ±10 V, noise included.
    """

    SATURATION: ClassVar[float] = 10.0

    deflection: Callable[[], float]
    """The deflection in m, from the plant."""
    volts_per_metre: float = 1e5
    """Sensitivity in V/m."""
    noise_volts: float = 5e-3
    """White noise of the amplifier in V rms, drawn for every conversion; zero or positive."""
    _: KW_ONLY
    rng: np.random.Generator
    """Source of the noise; nothing else may draw from it."""

    def __post_init__(self) -> None:
        self._normals = normals(self.rng)

    def __call__(self) -> float:
        """Return the voltage in V at this instant."""
        volts = self.deflection() * self.volts_per_metre + self.noise_volts * next(self._normals)
        limit = self.SATURATION
        return volts if -limit <= volts <= limit else min(max(volts, -limit), limit)
