"""What can be known of a connected rig without asking an instrument, also where another process holds the lines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from bench.base import ConfigurationError, closest
from bench.devices import DeviceDescription, Limits, Signal
from bench.rig.file import RigFile
from bench.rig.interlocks.config import SETPOINT
from bench.rig.slots import Slots, SlotsAsked, bind
from bench.rig.uncertainty import UncertainSignals


@dataclass(frozen=True)
class RigDescription:
    """A connected rig: its file, its devices, and the signals that they give.

    Attributes
    ----------
    file : RigFile
        What was connected.
    devices : mapping of str to DeviceDescription
        By name, in the order of the file.
    signals : tuple of Signal
        Set-points, readings and derived signals.
    """

    file: RigFile
    devices: Mapping[str, DeviceDescription]
    signals: tuple[Signal, ...]

    @cached_property
    def by_name(self) -> dict[str, Signal]:
        """The signals by name."""
        return {signal.name: signal for signal in self.signals}

    @cached_property
    def limits(self) -> dict[str, Limits]:
        """The set-points that are allowed, of each device that takes one."""
        return {name: device.limits for name, device in self.devices.items() if device.limits is not None}

    @cached_property
    def reading_limits(self) -> dict[str, Limits]:
        """The readings beyond which a device raises, by signal."""
        return {name: limits for device in self.devices.values() for name, limits in device.reading_limits.items()}

    def uncertain(self) -> UncertainSignals:
        """Return the signals as uncertain numbers, as the rig file states them.

        Raises ConfigurationError if it states what does not fit a signal.
        """
        units = {signal.name: signal.unit for signal in self.signals}
        return UncertainSignals(self.file.uncertainty, self.file.derived, units, self.file.path)

    def extent(self, signal: str) -> float | None:
        """Return the greatest magnitude that limits and interlocks allow of a signal, in its unit."""
        allowed = [self.reading_limits.get(signal)]
        if signal.endswith(SETPOINT):
            allowed.append(self.limits.get(signal.removesuffix(SETPOINT)))
        locks = [lock for lock in self.file.interlocks if lock.label == signal]
        ends = [(each.low, each.high) for each in (*allowed, *locks) if each is not None]
        greatest = [max(abs(low), abs(high)) for low, high in ends]
        return min((each for each in greatest if 0.0 < each < math.inf), default=None)

    def limits_of(self, name: str) -> Limits:
        """Return the set-points that a device allows; raises ConfigurationError if it takes none."""
        if name not in self.limits:
            known = closest(name, self.limits)
            raise ConfigurationError(f"{name} is not a device that takes a set-point; {known}")
        return self.limits[name]

    def unit(self, signal: str) -> str:
        """Return the unit of a signal."""
        return self.by_name[signal].unit

    def slots(self, definition: SlotsAsked) -> Slots:
        """Return the slots of a protocol, bound as the rig file says.

        Raises ConfigurationError if one is not bound, or bound to something of another kind.
        """
        used = {name: kind for name, kind in definition.may_use.items() if name in self.file.roles}
        wanted = {**definition.slots, **used}
        return bind(definition.name, wanted, self.file.roles, self.devices, self.by_name, self.file.path)

    def check_needs(self, protocol: str, needs: Sequence[str]) -> None:
        """Check that the devices and signals that a protocol names are there.

        Raises ConfigurationError if a device or a signal is missing.
        """
        have = {*self.devices, *self.by_name}
        missing = [need for need in needs if need not in have]
        if missing:
            raise ConfigurationError(
                f"protocol {protocol} needs {', '.join(missing)}, which rig {self.file.name} does not have; "
                f"it has: {', '.join(sorted(have))}"
            )
