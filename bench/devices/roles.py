"""The roles that an instrument can play on the bench, and what each promises beyond a `Device`.

A role is a contract with a test suite (`bench.contracts`), not a gate: any `Device` may be on a rig. One that fits
none of the named roles is a `GeneralSensor` or a `GeneralActuator`, with quantities and units of its own.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bench.base import Clock, LimitError
from bench.devices.device import Actuator, Device, Identity, Limits, Signal, Status

Floats = NDArray[np.float64]


class TECMode(Enum):
    """What a TEC amplifier holds constant."""

    CURRENT = "current"
    TEMPERATURE = "temperature"


class TECAmplifier(Actuator):
    """Drives a thermoelectric cooler, as a current source or as a temperature controller.

    In temperature mode the set-point is the object temperature in °C, and `set` completes when the
    controller reports it stable. In current mode it is the current in A, positive heats, and `set`
    completes at once.

    The safe state is the output stage off: no current flows, the plate drifts to ambient.

    Signals: `NAME_temperature` °C (object), `NAME_sink_temperature` °C, `NAME_current` A, `NAME_voltage` V.
    """

    heats: ClassVar[bool] = True

    @property
    @abstractmethod
    def mode(self) -> TECMode:
        """What is held constant."""

    @abstractmethod
    def select_mode(self, mode: TECMode) -> None:
        """Choose what is held constant; the output is switched off by the change."""

    @property
    @abstractmethod
    def output_enabled(self) -> bool:
        """Whether the output stage is on, as the device says now."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (
            Signal(f"{self.name}_temperature", "°C", "object temperature", 3),
            Signal(f"{self.name}_sink_temperature", "°C", "sink temperature", 2),
            Signal(f"{self.name}_current", "A", "TEC current", 3),
            Signal(f"{self.name}_voltage", "V", "TEC voltage", 3),
        )

    @property
    def setpoint_signal(self) -> Signal:
        """The set-point in the present mode."""
        if self.mode is TECMode.TEMPERATURE:
            return Signal(f"{self.name}_setpoint", "°C", "temperature set-point", 3)
        return Signal(f"{self.name}_setpoint", "A", "current set-point", 4)


class VoltageSupply(Actuator):
    """A voltage source, switching or linear. The set-point is in V, as `output` defines it.

    The safe state is 0 V with the output stage off where the device has one.

    Signals: `NAME_voltage` V, `NAME_current` A.
    """

    heats: ClassVar[bool] = True

    @property
    @abstractmethod
    def output(self) -> str:
        """Which voltage the set-point is: `average` or `rms` of a switched waveform, or `dc`."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (
            Signal(f"{self.name}_voltage", "V", f"{self.output} output voltage", 3),
            Signal(f"{self.name}_current", "A", "output current", 2),
        )

    @property
    def setpoint_signal(self) -> Signal:
        """The voltage asked for."""
        return Signal(f"{self.name}_setpoint", "V", f"{self.output} voltage set-point", 3)


@runtime_checkable
class JointReader(Protocol):
    """A device that can be read together with others on the same line, in one request."""

    def joins(self, other: Device) -> bool:
        """Return whether `joined` takes another device."""

    def joined(self, others: Sequence[Device]) -> Callable[[], dict[str, float]]:
        """Return what takes a quick reading of this device and the others, in this order.

        It returns what the `glance` of each would have returned, and raises what the first that fails raises.
        """


@runtime_checkable
class BlockPlayer(Protocol):
    """An actuator whose instrument carries out blocks of samples by itself: read a sensor, send a set-point, wait."""

    def can_play(self, sensor: Device, period: float) -> bool:
        """Return whether `play` takes this sensor, and this time between two samples in s."""

    def play(self, setpoints: Floats, period: float, sensor: Device) -> Floats:
        """Carry a block out, from now on; returns after its last set-point.

        Parameters
        ----------
        setpoints : numpy.ndarray
            One for each sample, in the unit of the actuator's limits.
        period : float
            Time between two samples, s.
        sensor : Device
            Read in each sample before the set-point is sent.

        Returns
        -------
        numpy.ndarray
            What `sensor.glance` would have returned: a row for each sample, a column for each signal.

        Raises
        ------
        LimitError
            If a set-point is not allowed; nothing is sent.
        DeviceError
            If a device refuses or a reading is not valid.
        """


class LoadCell(Device):
    """Measures a force in N, positive in tension. It cannot harm anything: its safe state is any state.

    `measure` raises `DeviceError` when the cell is under or over its range.

    Signal: `NAME_force` N.
    """

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (Signal(f"{self.name}_force", "N", "force", 3),)

    @abstractmethod
    def tare(self) -> None:
        """Make the present force read zero from now on."""

    @abstractmethod
    def clear_tare(self) -> None:
        """Read gross force again."""


class PositionSensor(Device):
    """Measures a position or a deflection in m. Its safe state is any state.

    `measure` raises `DeviceError` when the input is outside of its range or of its calibration.

    Signal: `NAME_position` m.
    """

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (Signal(f"{self.name}_position", "m", "position", 9),)


class TemperatureSensor(Device):
    """Measures a temperature in °C. Its safe state is any state.

    Signal: `NAME_temperature` °C.
    """

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (Signal(f"{self.name}_temperature", "°C", "temperature", 3),)


class Servo(Actuator):
    """Holds an angle in rad, over several turns, counted from its homing position.

    `set` completes when the servo stands at the goal; `stop` holds the present angle. The safe state is
    torque off: the shaft turns freely.

    Signals: `NAME_position` rad, `NAME_velocity` rad/s, `NAME_load` 1 (share of the stall torque, as the
    servo infers it).
    """

    @property
    @abstractmethod
    def torque_enabled(self) -> bool:
        """Whether the servo holds its position, as the device says now."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (
            Signal(f"{self.name}_position", "rad", "angle", 4),
            Signal(f"{self.name}_velocity", "rad/s", "angular velocity", 3),
            Signal(f"{self.name}_load", "1", "inferred load", 3),
        )

    @property
    def setpoint_signal(self) -> Signal:
        """The angle asked for."""
        return Signal(f"{self.name}_setpoint", "rad", "angle set-point", 4)


class LinearStage(Actuator):
    """Holds a point at a position along a line, in m.

    `set` completes when the stage stands at the goal; `stop` holds the present position. The safe state is
    without force: the point can be moved by hand.

    Signals: `NAME_position` m, `NAME_velocity` m/s, `NAME_load` 1 (share of the greatest force, as the stage
    infers it).
    """

    @property
    @abstractmethod
    def force_enabled(self) -> bool:
        """Whether the stage holds its position, as the device says now."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (
            Signal(f"{self.name}_position", "m", "position", 6),
            Signal(f"{self.name}_velocity", "m/s", "velocity", 5),
            Signal(f"{self.name}_load", "1", "inferred load", 3),
        )

    @property
    def setpoint_signal(self) -> Signal:
        """The position asked for."""
        return Signal(f"{self.name}_setpoint", "m", "position set-point", 6)


class Switch(Actuator):
    """Switches something on (1) or off (0), such as a fan; no other set-point is allowed.

    The safe state is off.

    Signal: `NAME_state` 1, what the device drives its output to.
    """

    @property
    def limits(self) -> Limits:
        """Off and on."""
        return Limits(0.0, 1.0, "(0 is off, 1 is on)")

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        return (Signal(f"{self.name}_state", "1", "whether it is on", 0),)

    @property
    def setpoint_signal(self) -> Signal:
        """Whether it shall be on."""
        return Signal(f"{self.name}_setpoint", "1", "whether it shall be on", 0)

    def check(self, value: float) -> None:
        """Raise `LimitError` unless `value` is 0 or 1."""
        if value not in (0.0, 1.0):
            raise LimitError(self.name, f"set-point {value:g} is neither 0 (off) nor 1 (on)")


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

        The status completes when the device has arrived; return `Status.completed` where it does so at once.
        """

    @abstractmethod
    def switch_off(self) -> None:
        """Switch the output off from any state; raise `DeviceError` if that is not confirmed."""

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
