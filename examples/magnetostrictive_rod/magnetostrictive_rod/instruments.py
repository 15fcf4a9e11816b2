"""The emulated instruments: they speak the messages that `devices` expects, and act on the rod.

Every message is one line of ASCII; one that is no question has no answer:

    ID?          Example,coil-source,1017,1.2      maker, kind of instrument, serial number, firmware
    SET 1.5                                        coil source: regulate the current to this, A; the output goes on
    SET?         1.500                             coil source: the current that it was set to, A
    OFF                                            coil source: switch the output off
    ON?          1                                 coil source: whether the output is on
    I?           1.4998                            coil source: current, A
    V?           0.0012345 0.0010021               strain bridge: voltages of both gauges, V
"""

from __future__ import annotations

import numpy as np

from magnetostrictive_rod.plant import MagnetostrictiveRod
from sim_devices.wire.text import LineServer
from sim_devices.world import World

GAUGE_FACTOR, EXCITATION = 2.1, 5.0
"""Of the strain gauges, each in a quarter bridge: a voltage of EXCITATION * GAUGE_FACTOR * strain / 4."""


class RodInstrument(LineServer):
    """An instrument at the rod."""

    def __init__(self, world: World, rod: MagnetostrictiveRod, rng: np.random.Generator) -> None:
        self._world, self._rod, self._rng = world, rod, rng

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""
        with self._world.at_present():
            return super().receive(data)


class EmulatedCoilSource(RodInstrument):
    """A bipolar current source of ±5 A with a resolution of 1 mA; its meter has 0.2 mA of noise."""

    def __init__(self, world: World, rod: MagnetostrictiveRod, rng: np.random.Generator) -> None:
        super().__init__(world, rod, rng)
        self.power_cycle()

    def power_cycle(self) -> None:
        """Switch it off and on: the output is off, and the set-point is forgotten."""
        self._rod.target, self._setpoint, self.on = 0.0, 0.0, False

    def answer(self, message: str) -> str | None:
        """Obey a message, and return its answer, or None if it has none."""
        match message.split():
            case ["ID?"]:
                return "Example,coil-source,1017,1.2"
            case ["SET", current] if abs(float(current)) <= 5.0:
                self._rod.target = self._setpoint = round(float(current), 3)
                self.on = True
            case ["SET?"]:
                return f"{self._setpoint:.3f}"
            case ["OFF"]:
                self._rod.target, self.on = 0.0, False
            case ["ON?"]:
                return f"{self.on:d}"
            case ["I?"]:
                return f"{self._rod.current + 2e-4 * self._rng.standard_normal():.4f}"
        return None


class EmulatedStrainBridge(RodInstrument):
    """An amplifier for two strain gauges on opposite sides of the rod; `noise` is its noise, V rms."""

    def __init__(self, world: World, rod: MagnetostrictiveRod, noise: float, rng: np.random.Generator) -> None:
        super().__init__(world, rod, rng)
        self._noise = noise

    def answer(self, message: str) -> str | None:
        """Obey a message, and return its answer, or None if it has none."""
        match message.split():
            case ["ID?"]:
                return "Example,strain-bridge,2203,3.0"
            case ["V?"]:
                voltages = 0.25 * EXCITATION * GAUGE_FACTOR * np.array(self._rod.strains)
                return "{:.7f} {:.7f}".format(*voltages + self._noise * self._rng.standard_normal(2))
        return None
