"""Slots of a protocol, bound to the devices and signals of a rig.

A rig file binds a slot by a table::

    [roles.drive]
    device = "plate"                    # takes the set-points
    reading = "plate_temperature"       # signal that says what it did; the device's first signal if not given
    unit = "°C"                         # of the reading, checked when the device is connected
    range = [21.0, 84.0]                # default range of protocols
    rest = 21.0                         # where it idles

    [roles.drive.reset]                 # how the memory is reset: held at `setpoint` until steady, or for `seconds`
    setpoint = 21.0
    drift = 0.02
    noise = 0.01
    timeout = 300.0

    [roles.response]
    signal = "bending"

A protocol names the slots that it needs and the kind of each, and takes its defaults from the binding.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol, Self

from pydantic import Field, field_validator, model_validator

from bench.base import CheckedTable, ConfigurationError, Display, closest, difference_unit
from bench.devices import Device, DeviceDescription, Dwell, Settle, Signal, UntilSteady
from bench.rig.interlocks.config import SETPOINT
from bench.rig.layout import Range


class ResetTable(CheckedTable):
    """The table `[roles.NAME.reset]`: how the memory of the specimen is reset."""

    setpoint: float | None = Field(
        default=None, description="set-point that saturates the specimen; the low end of the range if not given"
    )
    signal: str = Field(default="", description="signal that becomes steady; the role's reading if not given")
    drift: float | None = Field(default=None, gt=0, description="largest drift of a steady signal, its unit per s")
    noise: float | None = Field(default=None, gt=0, description="standard deviation of one quick reading, its unit")
    timeout: float = Field(default=300.0, gt=0, le=86400, description="time after which a reset has failed, s")
    seconds: float | None = Field(
        default=None, ge=0, le=86400, description="fixed time in place of drift and noise, s"
    )

    @model_validator(mode="after")
    def _one_rule(self) -> Self:
        steady = self.drift is not None and self.noise is not None
        if (self.drift is None) != (self.noise is None) or steady == (self.seconds is not None):
            raise ValueError("expected either drift and noise, or seconds")
        return self


class RoleTable(CheckedTable):
    """A table `[roles.NAME]`: a device that takes set-points, or a signal."""

    device: str = Field(default="", description="device that takes the set-points")
    reading: str = Field(default="", description="signal that says what the device did")
    signal: str = Field(default="", description="signal, for a role that only measures")
    unit: str | None = Field(default=None, description="unit of the reading or signal, checked when connected")
    range: Range | None = Field(default=None, description="default range of protocols")
    rest: float | None = Field(default=None, description="set-point at which the device idles")
    dwell: float | None = Field(
        default=None, gt=0, le=86400, description="hold at each set-point before a reading, s"
    )
    increment: float | None = Field(default=None, gt=0, description="difference of neighbouring set-points")
    rate: float | None = Field(default=None, gt=0, description="fastest change that the specimen follows, per s")
    prompt: str = Field(
        default="Set {value:g} {unit}",
        description="instruction to an operator who sets this by hand, with {value} and {unit}",
    )
    task: str = Field(default="", description="the same for an emulated laboratory; the role's name if not given")
    tolerance: float = Field(default=0.05, gt=0, le=1, description="tolerance of a value set by hand, as a fraction")
    reset: ResetTable | None = Field(default=None, description="how the memory of the specimen is reset")

    @model_validator(mode="after")
    def _device_or_signal(self) -> Self:
        if bool(self.device) == bool(self.signal):
            raise ValueError("expected either device (and reading) or signal")
        if self.signal and self.reading:
            raise ValueError("reading belongs to a device; a role that only measures has a signal")
        return self

    @field_validator("prompt")
    @classmethod
    def _can_be_filled_in(cls, text: str) -> str:
        try:
            text.format(value=0.0, unit="")
        except (KeyError, IndexError, ValueError, AttributeError) as error:
            raise ValueError(f"only {{value}} and {{unit}} can stand in: {type(error).__name__}: {error}") from None
        return text

    @property
    def low(self) -> float | None:
        """Low end of the range."""
        return self.range[0] if self.range else None

    @property
    def high(self) -> float | None:
        """High end of the range."""
        return self.range[1] if self.range else None

    @property
    def saturating(self) -> float | None:
        """Set-point at which the memory is reset."""
        return self.reset.setpoint if self.reset and self.reset.setpoint is not None else self.low

    def at(self, fraction: float) -> float | None:
        """Return the set-point at a fraction of the range, 0 at the low end, to three digits."""
        if self.range is None:
            return None
        low, high = self.range
        return float(f"{low + fraction * (high - low):.3g}")

    def tolerance_of(self, value: float) -> float:
        """Return how far what is set by hand may be off, in the unit of the role."""
        return self.tolerance * abs(value)


@dataclass(frozen=True)
class Slot:
    """A slot of a protocol, bound to a device or a signal of the rig at hand.

    Attributes
    ----------
    name : str
        Name of the slot, such as `drive`.
    device : str
        Device that takes the set-points; empty for a slot that only measures.
    signal : str
        Signal that says what the device did, or that is measured.
    unit, description : str
        Of the signal.
    setpoint_unit : str
        Unit of the set-points; empty for a slot that only measures.
    display : Display
        How values of the signal are shown.
    table : RoleTable
        What the rig file says of it.
    accuracy : float or None
        Standard uncertainty of the signal against a reference; None if it was not calibrated.
    """

    name: str
    device: str
    signal: str
    unit: str
    description: str
    setpoint_unit: str
    display: Display
    table: RoleTable
    accuracy: float | None = None

    @property
    def rate_unit(self) -> str:
        """Unit of the rate of change of the signal."""
        return rate_unit(self.unit)

    @property
    def setpoint_signal(self) -> str:
        """Signal with the set-points of the device."""
        return f"{self.device}{SETPOINT}"

    def show(self, value: float) -> str:
        """Return a value of the signal with its unit, for notes."""
        return self.display.text(value)

    def settle(self, minimum: float) -> Settle:
        """Return how a reset settles: by the rule of the rig file, but at least `minimum` s."""
        reset = self.table.reset
        if reset is None:
            return Dwell(minimum)
        if reset.drift is None or reset.noise is None:
            return Dwell(max(minimum, reset.seconds or 0.0))
        return UntilSteady(
            reset.signal or self.signal, drift=reset.drift, noise=reset.noise, timeout=reset.timeout, minimum=minimum
        )


def rate_unit(unit: str) -> str:
    """Return the unit of a rate of change: a difference of temperatures is in K."""
    return f"{difference_unit(unit)}/s"


Slots = Mapping[str, Slot]
"""The slots of a protocol by name."""


class SlotsAsked(Protocol):
    """What a protocol says of its slots: its name, and the kinds that it needs and that it may use, by slot."""

    @property
    def name(self) -> str:
        """Name of the protocol."""

    @property
    def slots(self) -> Mapping[str, type[Device] | type[Signal]]:
        """Kinds of the slots that it needs."""

    @property
    def may_use(self) -> Mapping[str, type[Device] | type[Signal]]:
        """Kinds of the slots that it uses if the rig binds them."""


def bind(
    protocol: str,
    needs: Mapping[str, type[Device] | type[Signal]],
    roles: Mapping[str, RoleTable],
    devices: Mapping[str, DeviceDescription],
    signals: Mapping[str, Signal],
    path: str,
) -> Slots:
    """Bind the slots that a protocol needs, by name and kind, to the devices and signals of a rig by its roles.

    A kind is the role that the device has to play, or `Signal` where something is only measured; protocol and path
    of the rig file are for messages. Raises ConfigurationError if a slot is not bound, or bound to something of
    another kind; names file, key and what is allowed.
    """
    check_bound(protocol, needs, roles, path)
    return {name: _bind(protocol, name, kind, roles[name], devices, signals, path) for name, kind in needs.items()}


def check_bound(protocol: str, needs: Iterable[str], roles: Mapping[str, RoleTable], path: str) -> None:
    """Raise ConfigurationError, which names what is missing, if a rig file binds not all slots of a protocol."""
    if missing := [name for name in needs if name not in roles]:
        bound = ", ".join(roles) or "none"
        raise ConfigurationError(
            f"{path}: protocol {protocol} needs {', '.join(f'[roles.{name}]' for name in missing)}; "
            f"the file binds: {bound}"
        )


def _bind(
    protocol: str,
    name: str,
    kind: type[Device] | type[Signal],
    table: RoleTable,
    devices: Mapping[str, DeviceDescription],
    signals: Mapping[str, Signal],
    path: str,
) -> Slot:
    device = devices.get(table.device)
    if kind is not Signal and (device is None or not issubclass(device.kind, kind)):
        fitting = ", ".join(key for key, each in devices.items() if issubclass(each.kind, kind)) or "none"
        bound = f"device {table.device!r}" if table.device else f"signal {table.signal!r}"
        raise ConfigurationError(
            f"{path}: roles.{name}: protocol {protocol} needs a {kind.__name__}, and {bound} is none; "
            f"fitting devices: {fitting}"
        )
    signal = signals[reading_of(table, devices)]
    setpoint = device.setpoint_signal if device is not None else None
    return Slot(
        name=name,
        device=table.device,
        signal=signal.name,
        unit=signal.unit,
        description=signal.description,
        setpoint_unit=setpoint.unit if setpoint else "",
        display=signal.display,
        table=table,
        accuracy=signal.accuracy,
    )


def reading_of(table: RoleTable, devices: Mapping[str, DeviceDescription]) -> str:
    """Return the signal of a role: the one that is named, else the first of its device."""
    if table.signal or table.reading:
        return table.signal or table.reading
    # A device without signals of its own has its set-point.
    return next((signal.name for signal in devices[table.device].signals), f"{table.device}{SETPOINT}")


def check_roles(
    roles: Mapping[str, RoleTable], devices: Mapping[str, DeviceDescription], signals: Mapping[str, Signal], path: str
) -> None:
    """Check that each role is bound to devices and signals that the rig has, in the unit that it says.

    Raises ConfigurationError if one is not; names file, key and what is allowed.
    """
    for name, table in roles.items():
        if table.device:
            actuators = [key for key, device in devices.items() if device.setpoint_signal is not None]
            if table.device not in actuators:
                what = "takes no set-point" if table.device in devices else "is not a device of this rig"
                raise ConfigurationError(
                    f"{path}: roles.{name}.device = {table.device!r} {what}; {closest(table.device, actuators)}"
                )
        used = {"signal" if table.signal else "reading": reading_of(table, devices)}
        if table.reset is not None and table.reset.signal:
            used["reset.signal"] = table.reset.signal
        for key, signal in used.items():
            if signal not in signals:
                raise ConfigurationError(
                    f"{path}: roles.{name}.{key} = {signal!r}: there is no such signal; {closest(signal, signals)}"
                )
        found = signals[reading_of(table, devices)]
        if table.unit is not None and found.unit != table.unit:
            raise ConfigurationError(f"{path}: roles.{name}.unit = {table.unit!r}: {found.name} is in {found.unit}")
