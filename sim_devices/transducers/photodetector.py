"""Position-sensitive photodetectors (PSD) that see the deflection of a cantilever by a laser spot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
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
    """White noise of the amplifier in V rms, drawn anew for every conversion; zero or positive."""
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


@dataclass(eq=False)
class TwoCurrentPSD:
    """A position-sensitive detector whose two photocurrents are amplified to two voltages.

    The spot at x on a detector of length L gives x = (L/2)(I2 − I1)/(I1 + I2) (Hamamatsu, S3270 datasheet).

    A spot beyond the end of the detector gives no current at all. The amplifiers saturate at 0 and 10 V.
    """

    SATURATION: ClassVar[float] = 10.0
    deflection: Callable[[], float]
    """The deflection in m, from the plant."""
    metres_per_metre: float = 185.0
    """Movement of the spot per deflection, by the optical lever."""
    psd_length: float = 0.037
    """Length of the detector in m."""
    sum_volts: float = 8.0
    """Sum of both voltages in V while the light is on."""
    noise_volts: float = 5e-3
    """White noise of either amplifier in V rms, drawn anew for every conversion; zero or positive."""
    _: KW_ONLY
    rng: np.random.Generator
    """Source of the noise; nothing else may draw from it."""
    light: float = field(default=1.0, init=False)
    """Share of the light that reaches the detector, 0 to 1; for faults and drift."""

    def __post_init__(self) -> None:
        self._normals = normals(self.rng)

    def first(self) -> float:
        """Return the voltage in V of current 1 at this instant."""
        return self._amplified(-1.0)

    def second(self) -> float:
        """Return the voltage in V of current 2 at this instant."""
        return self._amplified(1.0)

    def _amplified(self, side: float) -> float:
        ratio = self.deflection() * (2 * self.metres_per_metre / self.psd_length)
        share = (1 + side * ratio) / 2 if abs(ratio) <= 1 else 0.0
        volts = self.light * self.sum_volts * share + self.noise_volts * next(self._normals)
        return min(max(volts, 0.0), self.SATURATION)
