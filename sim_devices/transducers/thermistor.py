"""An NTC thermistor in a voltage divider (Steinhart and Hart 1968, Deep-Sea Research 15)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule
from sim_devices.noise import normals

if TYPE_CHECKING:
    from sim_devices.transducers import _voltage_kernels as kernels
else:
    kernels = DeferredModule("sim_devices.transducers._voltage_kernels")

STEINHART_HART = (1.129148e-3, 2.34125e-4, 8.76741e-8)
"""A, B and C of a common thermistor of 10 kΩ at 25 °C, in 1/K, for the resistance in Ω."""


@dataclass(eq=False)
class Thermistor:
    """An NTC thermistor from the input of a divider to ground, with a reference resistor to the excitation.

    Assumptions: no self-heating, an exact reference resistor.
    """

    temperature: Callable[[], float]
    """The temperature in °C, from the plant."""
    reference_ohms: float = 10e3
    """Reference resistor in Ω."""
    steinhart_hart: tuple[float, float, float] = STEINHART_HART
    """A, B and C of 1/T = A + B ln R + C (ln R)³, T in K and R in Ω; B and C positive."""
    excitation_volts: float = 2.5
    """Excitation in V; a fault or drift changes it."""
    excitation_error: float = 10e-3
    """Deviation of the excitation of one instance, V rms; drawn once."""
    noise: float = 0.02
    """White noise in K rms, drawn for every conversion; zero or positive."""
    _: KW_ONLY
    rng: np.random.Generator
    """Source of the noise and of the error of the excitation."""
    open: bool = field(default=False, init=False)
    shorted: bool = field(default=False, init=False)
    """Whether a wire of the thermistor is broken, or its wires are shorted; for faults."""

    def __post_init__(self) -> None:
        self.excitation_volts += self.excitation_error * self.rng.standard_normal()
        self.draw: Callable[[], float] = normals(self.rng).__next__
        """Gives the next number of the standard normal distribution, for the noise of a conversion."""
        a, b, c = self.steinhart_hart
        self.circuit = self.reference_ohms, a, c, (b / (3 * c)) ** 3
        """Reference resistor (Ω), A and C (1/K), and (B / 3C)³."""
        # Compiled before a driver waits for an answer.
        kernels.divider_volts(25.0, self.excitation_volts, *self.circuit)

    def divider(self) -> float:
        """Return the voltage in V at the input of the divider at this instant."""
        if self.shorted:
            return 0.0
        if self.open:
            return self.excitation_volts
        celsius = self.temperature() + self.noise * self.draw()
        return float(kernels.divider_volts(celsius, self.excitation_volts, *self.circuit))

    def excitation(self) -> float:
        """Return the voltage in V of the excitation at this instant."""
        return self.excitation_volts
