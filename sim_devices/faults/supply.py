"""A power supply behind a TEC controller that gives less current than it is asked for."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

from sim_devices.faults.fault import Fault, Quantity
from sim_devices.instruments.meerstetter_tec import PeltierLoad


class ClippedPeltier:
    """A Peltier element whose current can be clipped; a `sim_devices.instruments.meerstetter_tec.PeltierLoad`."""

    def __init__(self, load: PeltierLoad) -> None:
        self._load = load
        self._highest = math.inf
        self._repeat: Callable[[], None] = load.release
        self.terminals = load.terminals

    def fault(self, amperes: float) -> Fault:
        """Return the fault, with the highest current (A) where none is chosen."""
        highest = Quantity(amperes, "A", 0.0, 100.0, "highest current of either sign")
        undo = partial(self._clip, math.inf)
        return Fault("the supply of the TEC controller is clipped", self._clip, {"amperes": highest}, undo)

    @property
    def plate_temperature(self) -> float:
        """Temperature of the plate with the object sensor, °C."""
        return self._load.plate_temperature

    @property
    def sink_temperature(self) -> float:
        """Temperature of the heat sink, °C."""
        return self._load.sink_temperature

    @property
    def current(self) -> float:
        """Peltier current, A."""
        return self._load.current

    @property
    def voltage(self) -> float:
        """Voltage across the Peltier element, V."""
        return self._load.voltage

    def regulate(self, target_celsius: float, current_limit: float = math.inf) -> None:
        """Close the temperature loop, with a current of at most `current_limit` A of either sign."""
        self._repeat = lambda: self._load.regulate(target_celsius, min(current_limit, self._highest))
        self._repeat()

    def drive(self, current_ampere: float) -> None:
        """Drive a constant current."""
        self._repeat = lambda: self._load.drive(min(max(current_ampere, -self._highest), self._highest))
        self._repeat()

    def release(self) -> None:
        """Switch the output off."""
        self._repeat = self._load.release
        self._repeat()

    def _clip(self, amperes: float) -> None:
        self._highest = amperes
        self._repeat()
