"""The emulated instruments: they speak the bytes that `devices` expects, and act on the rod.

Every request is one line of ASCII, a word and its arguments; the answer repeats the word, or begins with `ERR`:

    ID?          ID coil-source 1017 1.2       kind of instrument, serial number, firmware
    SET 1.5      SET 1.500                     coil source: regulate the current to this, A; the output goes on
    OFF          OFF                           coil source: switch the output off
    I?           I 1.4998 ON                   coil source: current, A, and state of the output
    V?           V 0.0012345 0.0010021         strain bridge: voltages of both gauges, V
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from magnetostrictive_rod.plant import MagnetostrictiveRod
from sim_devices.wire import WireServer
from sim_devices.world import World

GAUGE_FACTOR, EXCITATION = 2.1, 5.0
"""Of the strain gauges, each in a quarter bridge: a voltage of EXCITATION * GAUGE_FACTOR * strain / 4."""


class AsciiInstrument(WireServer):
    """The serial side of an instrument: what goes in and out of its line."""

    def __init__(self, identity: str, world: World, commands: Mapping[str, Callable[..., str]]) -> None:
        self._world = world
        self._commands = {"ID?": lambda: f"ID {identity}", **commands}
        self._received = b""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""
        with self._world.at_present():
            *lines, self._received = (self._received + data).split(b"\n")
            return b"".join(self._answer(line.decode("ascii", "replace").split()) for line in lines)

    def _answer(self, words: Sequence[str]) -> bytes:
        try:
            answer = self._commands[words[0]](*words[1:])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            answer = f"ERR {error}"
        return f"{answer}\n".encode("ascii", "replace")


class EmulatedCoilSource(AsciiInstrument):
    """A bipolar current source of ±5 A with a resolution of 1 mA; its meter has 0.2 mA of noise."""

    def __init__(self, world: World, rod: MagnetostrictiveRod, rng: np.random.Generator) -> None:
        super().__init__("coil-source 1017 1.2", world, {"SET": self._set, "OFF": self._off, "I?": self._measure})
        self._rod, self._rng, self.on = rod, rng, False

    def _set(self, value: str) -> str:
        if not abs(float(value)) <= 5.0:
            raise ValueError("range is 5 A")
        self._rod.target, self.on = round(float(value), 3), True
        return f"SET {self._rod.target:.3f}"

    def _off(self) -> str:
        self._rod.target, self.on = 0.0, False
        return "OFF"

    def _measure(self) -> str:
        current = self._rod.current + 2e-4 * self._rng.standard_normal()
        return f"I {current:.4f} {'ON' if self.on else 'OFF'}"


class EmulatedStrainBridge(AsciiInstrument):
    """An amplifier for two strain gauges on opposite sides of the rod; `noise` is its noise, V rms."""

    def __init__(self, world: World, rod: MagnetostrictiveRod, noise: float, rng: np.random.Generator) -> None:
        super().__init__("strain-bridge 2203 3.0", world, {"V?": self._measure})
        self._rod, self._noise, self._rng = rod, noise, rng

    def _measure(self) -> str:
        voltages = 0.25 * EXCITATION * GAUGE_FACTOR * np.array(self._rod.strains)
        return "V {:.7f} {:.7f}".format(*voltages + self._noise * self._rng.standard_normal(2))
