"""The two general roles: a sensor and an actuator with quantities and units of their own."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace

from bench.clock import Clock
from bench.devices import Actuator, Device, Identity, Limits, Signal, Status


class GeneralSensor(Device):
    """Measures quantities of its own. It cannot harm anything: any state is its safe state.

    Signals: `NAME_` and the name of each quantity.

    Parameters
    ----------
    name : str
        Name in the rig.
    clock : Clock
        The clock of the run.
    identity : Identity
        What the instrument said of itself when it was connected.
    quantities : sequence of Signal
        What it measures; names without that of the device.
    """

    def __init__(self, name: str, clock: Clock, identity: Identity, quantities: Sequence[Signal]) -> None:
        super().__init__(name, clock)
        self._identity = identity
        self._signals = tuple(replace(quantity, name=f"{name}_{quantity.name}") for quantity in quantities)

    @property
    def identity(self) -> Identity:
        """What the instrument said of itself when it was connected."""
        return self._identity

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What `measure` and `glance` deliver."""
        return self._signals

    @abstractmethod
    def measure_quantities(self) -> Mapping[str, float]:
        """Measure every quantity; values by its name without that of the device. Raises as `measure` does."""

    def measure(self) -> dict[str, float]:
        """Measure every signal; values by signal name."""
        return {f"{self.name}_{name}": value for name, value in self.measure_quantities().items()}

    def safe(self) -> None:
        """Do nothing: a sensor is always safe."""


class GeneralActuator(GeneralSensor, Actuator):
    """Takes a set-point of a quantity and unit of its own, and measures what it is given to measure.

    The safe state is what `switch_off` reaches: no power in the specimen.

    Signals: as for a `GeneralSensor`; the set-point is `NAME_setpoint`.

    Parameters
    ----------
    name, clock, identity, quantities
        As for a `GeneralSensor`.
    limits : Limits
        Set-points that are allowed, with their unit.
    description : str
        What the set-point is, for axes and columns.
    precision : int
        Digits after the point of the set-point that are worth showing.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        identity: Identity,
        quantities: Sequence[Signal],
        limits: Limits,
        *,
        description: str = "set-point",
        precision: int = 3,
    ) -> None:
        super().__init__(name, clock, identity, quantities)
        self._limits = limits
        self._setpoint = math.nan
        self._setpoint_signal = Signal(f"{name}_setpoint", limits.unit, description, precision)

    @property
    def limits(self) -> Limits:
        """The set-points that are allowed."""
        return self._limits

    @property
    def setpoint(self) -> float:
        """The set-point that was last sent; nan before the first, and after the output was switched off."""
        return self._setpoint

    @property
    def setpoint_signal(self) -> Signal:
        """What the set-point is."""
        return self._setpoint_signal

    @abstractmethod
    def send(self, value: float) -> Status:
        """Send a set-point that is within the limits, and switch the output on if it is off.

        Returns
        -------
        Status
            Completes when the device has arrived; `Status.completed` where it does so at once.
        """

    @abstractmethod
    def switch_off(self) -> None:
        """Switch the output off, whatever state the device is in; raise `DeviceError` if that is not confirmed."""

    def set(self, value: float) -> Status:
        """Send a set-point; raises `LimitError` if it is outside of the limits, and then nothing is sent."""
        self.check(value)
        status = self.send(value)
        self._setpoint = value
        return status

    def safe(self) -> None:
        """Switch the output off."""
        try:
            self.switch_off()
        finally:
            self._setpoint = math.nan
