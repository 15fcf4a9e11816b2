"""The rod in its coil: physics only, by the hysteresis model of Jiles and Atherton."""

from __future__ import annotations

import math
from dataclasses import dataclass

_FIELD_STEP = 50.0
"""Greatest step of the field in the integration, A/m."""


@dataclass(frozen=True)
class RodParameters:
    """Constants of rod and coil, of the order of those of Terfenol-D."""

    field_per_current: float = 12e3  # A/m per A: turns per metre of the coil
    time_constant: float = 0.02  # s, of the coil's current under the regulation of its source
    saturation: float = 7.65e5  # A/m, magnetization
    shape: float = 7e3  # A/m, of the anhysteretic curve
    pinning: float = 4e3  # A/m, half the width of the loop
    coupling: float = -0.01  # of the domains
    reversible: float = 0.18  # share of the magnetization
    saturation_strain: float = 1.005e-3  # magnetostriction
    bending: float = 4e-5  # strain at the surface for a full magnetization, as rod and coil are not concentric


class MagnetostrictiveRod:
    """A rod whose magnetization follows the current of its coil, and which lengthens with its square.

    The magnetization is that of Jiles and Atherton, *Theory of ferromagnetic hysteresis*, J. Magn. Magn. Mater. 61
    (1986); the strain is 3/2 λs (M/Ms)² (Calkins, Smith and Flatau, IEEE Trans. Magn. 36(2), 2000).

    Attributes
    ----------
    target : float
        Current that the source regulates to, A; it follows with a time constant.
    current, magnetization : float
        Of the coil, A, and of the rod, A/m.
    """

    def __init__(self, parameters: RodParameters) -> None:
        self.parameters = parameters
        self.target = self.current = self.magnetization = 0.0

    @property
    def strains(self) -> tuple[float, float]:
        """Strain at two opposite sides of the rod: the elongation, more and less the bending."""
        p, m = self.parameters, self.magnetization / self.parameters.saturation
        return 1.5 * p.saturation_strain * m**2 + p.bending * m, 1.5 * p.saturation_strain * m**2 - p.bending * m

    def advance(self, dt: float) -> None:
        """Integrate over `dt` seconds."""
        p = self.parameters
        before = self.current
        self.current = self.target + (before - self.target) * math.exp(-dt / p.time_constant)
        start, end = before * p.field_per_current, self.current * p.field_per_current
        count = math.ceil(abs(end - start) / _FIELD_STEP)
        step = (end - start) / max(count, 1)
        for i in range(count):
            # Heun's method, along the field.
            first = self._slope(start + i * step, self.magnetization, step)
            second = self._slope(start + (i + 1) * step, self.magnetization + step * first, step)
            self.magnetization += 0.5 * step * (first + second)

    def _slope(self, field: float, magnetization: float, direction: float) -> float:
        """Return dM/dH while the field rises (`direction` > 0) or falls."""
        p = self.parameters
        x = (field + p.coupling * magnetization) / p.shape
        # Langevin's function and its derivative; by their series near 0.
        small = abs(x) < 1e-3
        langevin = x / 3.0 if small else 1.0 / math.tanh(x) - 1.0 / x
        derivative = 1.0 / 3.0 if small else 1.0 / x**2 - 1.0 / math.sinh(x) ** 2
        anhysteretic = p.saturation * langevin
        irreversible = (magnetization - p.reversible * anhysteretic) / (1.0 - p.reversible)
        # Walls that are pinned never move against the field.
        pull = max(math.copysign(1.0, direction) * (anhysteretic - irreversible), 0.0)
        rate = (1.0 - p.reversible) * pull / p.pinning + p.reversible * p.saturation * derivative / p.shape
        return rate / (1.0 - p.coupling * rate)
