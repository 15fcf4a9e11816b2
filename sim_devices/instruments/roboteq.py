"""Emulated Roboteq SDC2160: a brushed motor controller as a PWM voltage supply, with its CANopen objects.

The instrument is its object dictionary, its command watchdog and its protections; the plant behind it is the
load that it heats. Sources: Roboteq CANBus Networking Manual V2.0 (objects, their types and scales), the
electronic data sheet `roboteq_motor_controllers_v60.eds` (communication objects and their defaults), Roboteq
Advanced Digital Motor Controller User Manual V1.8 (watchdog `RWD`, limits `ALIM` and `MXPF`), CiA 301
(abort codes, heartbeat, NMT states).

The duty cycle is the applied power / 1000. With an LC filter the load sees the average, duty cycle × battery
voltage; without one a resistive load is heated by the RMS voltage, battery voltage × √(duty cycle).

Assumptions, where the manuals are silent or were not at hand:

- Only runtime commands (objects 0x2000 to 0x20FF) feed the watchdog: the user manual says so of the serial
  commands with `!`, of which these objects are the CANopen form. Queries do not.
- After the watchdog has expired, the first command of the channel that is not 0 resumes the previous power,
  and its own value counts only when it is sent again. This is the worst reading of "motor operation will
  resume at whichever speed motors were running prior"; a command of 0 resumes nothing.
- The power follows the command at once (a real device has a ramp), and is 0 as long as a fault stands.
- The amps limit acts when the power is applied, by scaling it down, and holds until it is applied anew.
- A command beyond ±1000 ‰ is refused rather than clipped.
- The device starts its node by itself (autostart); a reset by NMT clears command and emergency stop.
- Flags have 16 bits (0x2111, 0x2112, according to the manual; the data sheet says 8) and 32 bits (0x2122).
- The wording of device name, hardware and software version.

Kept in the dictionary without effect: the consumer heartbeat times (0x1016).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Literal, Protocol

import numpy as np

from bench.devices import Identity, Limits, Status
from bench.errors import DeviceError
from bench.roles import VoltageSupply
from sim_devices.instruments.emulated import EmulatedInstrument, RequestRefusedError
from sim_devices.world import World

CHANNELS = 2
"""Motor outputs of an SDC2160; the load is connected to the first."""

DEVICE_TYPE = 0x000F0191
"""Object 0x1000: device profile 401 (electronic data sheet)."""

BATTERY_NOISE = 0.02
"""Standard deviation of the battery voltage reading before it is rounded to 0.1 V, V."""

CURRENT_NOISE = 0.03
"""Standard deviation of the motor current reading before it is rounded to 0.1 A, A."""

LOWEST_BATTERY_VOLTAGE = 5.0
"""Battery voltage below which the device reports under-voltage, V."""

HIGHEST_BATTERY_VOLTAGE = 60.0
"""Battery voltage above which the device reports over-voltage, V."""

_FULL = 1000  # command and power of a duty cycle of 1
_INTERNAL_VOLTAGE = 118  # 0.1 V
_FIVE_VOLTS = 5000  # mV
_TEMPERATURES = (32, 30)  # °C: processor, power stage
_LONGEST_HEARTBEAT_BACKLOG = 4


class Fault(IntFlag):
    """Bits of the fault flags, object 0x2112."""

    OVERHEAT = 0x01
    OVER_VOLTAGE = 0x02
    UNDER_VOLTAGE = 0x04
    SHORT_CIRCUIT = 0x08
    EMERGENCY_STOP = 0x10
    SETUP = 0x20
    MOSFET = 0x40
    DEFAULT_CONFIGURATION = 0x80


class ChannelFlag(IntFlag):
    """Bits of the channel flags, object 0x2122."""

    AMPS_LIMIT = 0x01
    STALL = 0x02
    LOOP_ERROR = 0x04
    SAFETY_STOP = 0x08
    FORWARD_LIMIT = 0x10
    REVERSE_LIMIT = 0x20
    AMPS_TRIGGER = 0x40


class NodeState(IntEnum):
    """NMT states as a heartbeat reports them (CiA 301)."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class AbortCode(IntEnum):
    """Why an SDO transfer ends (CiA 301, SDO abort codes)."""

    TOGGLE = 0x0503_0000
    COMMAND = 0x0504_0001
    UNSUPPORTED = 0x0601_0000
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    LENGTH = 0x0607_0010
    NO_SUBINDEX = 0x0609_0011
    VALUE = 0x0609_0030


Kind = Literal["S8", "U8", "S16", "U16", "S32", "U32", "text"]


@dataclass(frozen=True)
class Entry:
    """One row of the object dictionary."""

    kind: Kind
    """Type of the value."""
    readable: bool = True
    writable: bool = False
    """Which ways it can be transferred."""


def _dictionary() -> dict[tuple[int, int], Entry]:
    command = {"readable": False, "writable": True}
    rows: dict[tuple[int, int], Entry] = {
        (0x1000, 0): Entry("U32"),
        (0x1001, 0): Entry("U8"),
        (0x1008, 0): Entry("text"),
        (0x1009, 0): Entry("text"),
        (0x100A, 0): Entry("text"),
        (0x1016, 0): Entry("U8"),
        **{(0x1016, sub): Entry("U32", writable=True) for sub in range(1, 5)},
        (0x1017, 0): Entry("U16", writable=True),
        **{(0x1018, sub): Entry("U32" if sub else "U8") for sub in range(4)},
        **{(index, 0): Entry("U8", **command) for index in (0x200C, 0x200D, 0x200E)},
        **{(0x210D, sub): Entry("U16") for sub in (1, 2, 3)},
        **{(0x210F, sub): Entry("S8") for sub in (1, 2)},
        (0x2111, 0): Entry("U16"),
        (0x2112, 0): Entry("U16"),
    }
    for channel in range(1, CHANNELS + 1):
        rows[0x2000, channel] = Entry("S32", **command)
        rows |= {(index, channel): Entry("S16") for index in (0x2100, 0x2101, 0x2102, 0x210C)}
        rows[0x2122, channel] = Entry("U32")
    return rows


DICTIONARY = _dictionary()
"""The emulated part of the object dictionary, by index and subindex."""

_INDICES = frozenset(index for index, _ in DICTIONARY)


class HeatingLoad(Protocol):
    """The load at the first motor output."""

    def apply(self, voltage: float) -> None:
        """Apply a voltage, V: the average with an LC filter, the RMS value without; held until the next."""

    @property
    def current(self) -> float:
        """Current through the load, A."""


class EmulatedRoboteq(EmulatedInstrument, VoltageSupply):
    """One SDC2160 with its load, as the object dictionary and as the role of a voltage supply.

    Parameters
    ----------
    output : {"average", "rms"}
        Whether an LC filter is between output and load, so that it sees the average, or none.
    voltage_limits : tuple of float
        Lowest and highest set-point of the role, V; the wire knows nothing of it.
    battery_voltage : float
        Voltage of the power supply, V.
    watchdog : float
        Silence of the host after which the output drops, s; 0 for never (`^RWD`, 1 s as delivered).
    amps_limit : float
        Highest motor current, A (`^ALIM`).
    power_limit : int
        Highest power, ‰ (`^MXPF`, which is in %).
    node : int
        CANopen node, 1 to 126.
    bitrate : int
        Speed of the bus, bit/s.
    rng : numpy.random.Generator, optional
        Noise of the readings of battery voltage and current; without it they are free of noise.
    """

    def __init__(
        self,
        name: str,
        world: World,
        load: HeatingLoad,
        *,
        output: Literal["average", "rms"] = "average",
        voltage_limits: tuple[float, float] = (0.0, 24.0),
        battery_voltage: float = 24.0,
        watchdog: float = 1.0,
        amps_limit: float = 20.0,
        power_limit: int = _FULL,
        node: int = 1,
        bitrate: int = 125_000,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(name, world, rng)
        self._load = load
        self._output = output
        self._limits = Limits(*voltage_limits, "V")
        self._battery = battery_voltage
        self._watchdog = watchdog
        self._amps_limit = amps_limit
        self._power_limit = power_limit
        self.node = node
        self.bitrate = bitrate
        self._texts = {0x1008: "Roboteq SDC2160", 0x1009: "1.0", 0x100A: "v2.0 11/20/2019"}
        # The objects have no serial number.
        self._identity = Identity("Roboteq", "SDC2160", "unknown", self._texts[0x100A])
        self._commands = [0] * CHANNELS
        self._held = False
        self._trips = Fault(0)
        self._channel_trips = ChannelFlag(0)
        self._limiting = False
        self._power = 0
        self._applied_voltage = 0.0
        self._watchdog_due = math.inf
        self._consumer_heartbeats = [0, 0, 0, 0]
        self._heartbeat_milliseconds = 100
        self._state = NodeState.OPERATIONAL
        self._boot_up_due = False
        self._heartbeat_since = world.clock.now()
        self._battery_used = math.nan
        self._readings: dict[int, Callable[[int], int]] = {
            0x1000: lambda _: DEVICE_TYPE,
            0x1001: lambda _: 1 if self._faults() else 0,
            0x1016: lambda sub: self._consumer_heartbeats[sub - 1] if sub else len(self._consumer_heartbeats),
            0x1017: lambda _: self._heartbeat_milliseconds,
            0x1018: lambda sub: (3, 0, 0xFFFF_FFFF, 0xFFFF_FFFF)[sub],
            0x2100: self._amps,
            0x2101: lambda sub: 0 if self._held else self._commands[sub - 1],
            0x2102: lambda sub: self._power if sub == 1 else 0,
            0x210C: lambda sub: round(self._amps(sub) * abs(self._power) / _FULL),
            0x210D: lambda sub: (_INTERNAL_VOLTAGE, self._battery_reading(), _FIVE_VOLTS)[sub - 1],
            0x210F: lambda sub: _TEMPERATURES[sub - 1],
            0x2111: lambda _: (0 if self._held else 0x01) | (0x08 if self._faults() & Fault.EMERGENCY_STOP else 0),
            0x2112: lambda _: int(self._faults()),
            0x2122: lambda sub: int(self._channel_flags()) if sub == 1 else 0,
        }
        world.add(self)

    # Objects and network management.

    @property
    def state(self) -> NodeState:
        """The NMT state."""
        return self._state

    @property
    def power(self) -> int:
        """The applied power at the clock's present time, ‰; does not feed the watchdog."""
        with self.world.at_present():
            return self._power

    @property
    def voltage(self) -> float:
        """The voltage that the load sees at the clock's present time, V."""
        with self.world.at_present():
            return self._applied_voltage

    def entry(self, index: int, sub: int) -> Entry:
        """Get a row of the object dictionary.

        Raises `RequestRefusedError` if there is no such object or no such subindex of it.
        """
        row = DICTIONARY.get((index, sub))
        if row is None:
            raise RequestRefusedError(AbortCode.NO_SUBINDEX if index in _INDICES else AbortCode.NO_OBJECT)
        return row

    def read_object(self, index: int, sub: int = 0) -> int | str:
        """Return the value of an object, in the unit of the manual.

        Raises `RequestRefusedError` if there is no such object, or it can only be written.
        """
        with self.world.lock:
            row = self.entry(index, sub)
            self.world.advance()
            if not row.readable:
                raise RequestRefusedError(AbortCode.WRITE_ONLY)
            return self._texts[index] if row.kind == "text" else self._readings[index](sub)

    def write_object(self, index: int, value: int, sub: int = 0) -> None:
        """Set an object.

        Raises `RequestRefusedError` if there is no such object, it can only be read, or the value is out of its
        range.
        """
        with self.world.lock:
            row = self.entry(index, sub)
            self.world.advance()
            if not row.writable:
                raise RequestRefusedError(AbortCode.READ_ONLY)
            if index == 0x1016:
                self._consumer_heartbeats[sub - 1] = value
            elif index == 0x1017:
                self._heartbeat_milliseconds = value
                self._heartbeat_since = self.world.time
            else:
                self._command(index, sub, value)

    def manage(self, command: int) -> None:
        """Obey a network management command (CiA 301): 1 start, 2 stop, 128, 129 and 130; others are ignored."""
        with self.world.at_present():
            if command == 1:
                self._state = NodeState.OPERATIONAL
            elif command == 2:
                self._state = NodeState.STOPPED
            elif command == 128:
                self._state = NodeState.PRE_OPERATIONAL
            elif command in (129, 130):
                self._restart(power=command == 129)

    def next_heartbeat(self) -> float:
        """Return the laboratory time (s) of the next heartbeat; infinity if none is sent."""
        if self._boot_up_due:
            return self._clock.now()
        period = 1e-3 * self._heartbeat_milliseconds
        return self._heartbeat_since + period if period > 0.0 else math.inf

    def heartbeats(self) -> list[NodeState]:
        """Take the heartbeats that are due since they were last asked for, the newest four at most.

        The line hands over what was sent meanwhile only when the host speaks, as nothing arrives on it
        unasked; a host that was silent for an hour finds no hour of heartbeats.
        """
        now = self._clock.now()
        due = [NodeState.BOOT_UP] if self._boot_up_due else []
        self._boot_up_due = False
        period = 1e-3 * self._heartbeat_milliseconds
        if period > 0.0:
            # A sum of periods may be short of the instant by its rounding.
            count = math.floor((now - self._heartbeat_since) / period + 1e-6)
            self._heartbeat_since += count * period
            due += [self._state] * min(count, _LONGEST_HEARTBEAT_BACKLOG)
        return due if self.plugged_in else []

    # Faults.

    @property
    def battery_voltage(self) -> float:
        """The voltage of the power supply, V."""
        return self._battery

    @battery_voltage.setter
    def battery_voltage(self, volts: float) -> None:
        with self.world.at_present():
            self._battery = volts
            self._apply()

    def trip(self, fault: Fault | ChannelFlag) -> None:
        """Report a fault, which drops the output, or a flag of the first channel."""
        with self.world.at_present():
            if isinstance(fault, Fault):
                self._trips |= fault
            else:
                self._channel_trips |= fault
            self._apply()

    def clear(self) -> None:
        """Take the causes of all faults away."""
        with self.world.at_present():
            self._trips, self._channel_trips = Fault(0), ChannelFlag(0)
            self._apply()

    def power_cycle(self) -> None:
        """Interrupt the supply of the device: it starts anew, and says so by its boot-up message."""
        with self.world.at_present():
            self._restart(power=True)

    def plug_in(self) -> None:
        """Undo `unplug`; the heartbeats of meanwhile are lost."""
        with self.world.at_present():
            self.heartbeats()
            self.plugged_in = True

    def _corrupted(self, answer: bytes) -> bytes:
        """Cut the adapter's line in its middle."""
        return answer[: len(answer) // 2] + b"\r"

    # Timed events.

    def deadline(self) -> float:
        """Return when the watchdog expires (s)."""
        return self._watchdog_due

    def expire(self) -> None:
        """Drop the output: the host was silent for too long."""
        self._watchdog_due = math.inf
        self._held = True
        self._apply()

    # The role of a voltage supply.

    @property
    def output(self) -> str:
        """Which voltage the load sees: `average` or `rms`."""
        return self._output

    @property
    def limits(self) -> Limits:
        """The allowed set-points, V."""
        return self._limits

    def set(self, value: float) -> Status:
        """Apply a voltage, V."""
        self.check(value)
        with self._request():
            self._refuse_fault()
            battery = self._battery_reading() / 10
            if self._held:
                self.write_object(0x2000, 0, 1)
            self._send(value, battery)
        return Status.completed(self.name, self._clock)

    def measure(self) -> dict[str, float]:
        """Measure voltage (V) and current (A), and send the set-point again, which feeds the watchdog."""
        with self._request():
            self._refuse_fault()
            battery = self._battery_reading() / 10
            voltage, current = self._voltage(self._power, battery), self._amps(1) / 10
            driven = not math.isnan(self._setpoint) and self._setpoint != 0.0
            if driven and self._held:
                self.write_object(0x2000, 0, 1)
                self._setpoint = 0.0
                raise DeviceError(
                    self.name, f"watchdog: the host was silent for {self._watchdog:g} s and the output dropped"
                )
            if driven:
                follow = abs(battery - self._battery_used) > 0.15
                self._send(self._setpoint, battery if follow else self._battery_used)
            return {f"{self.name}_voltage": voltage, f"{self.name}_current": current}

    def safe(self) -> None:
        """Go to 0 V."""
        with self._request():
            self.write_object(0x2000, 0, 1)
            self.write_object(0x200E, 1)
            self._setpoint = 0.0

    def _refuse_fault(self) -> None:
        faults, flags = self._faults(), self._channel_flags()
        if faults or flags:
            names = [str(bit.name).lower().replace("_", " ") for bit in (*faults, *flags)]
            raise DeviceError(self.name, f"reports {', '.join(names)}")

    def _send(self, volts: float, battery: float) -> None:
        if abs(volts) > battery + 0.05:
            raise DeviceError(self.name, f"the supply of {battery:.1f} V is too low for {volts:g} V")
        share = min(max(volts / battery, -1.0), 1.0) if volts else 0.0
        duty = share if self._output == "average" else math.copysign(share**2, share)
        self.write_object(0x2000, round(_FULL * duty), 1)
        self._setpoint, self._battery_used = volts, battery

    # The inner workings. The lock is held and the world stands at the present.

    def _command(self, index: int, sub: int, value: int) -> None:
        if index == 0x2000:
            if abs(value) > _FULL:
                raise RequestRefusedError(AbortCode.VALUE)
            if not (sub == 1 and self._held and value != 0):
                self._commands[sub - 1] = value
        elif index == 0x200C:
            self._trips |= Fault.EMERGENCY_STOP
        elif index == 0x200D:
            self._trips &= ~Fault.EMERGENCY_STOP
        elif 1 <= value <= CHANNELS:
            self._commands[value - 1] = 0
        self._held = False
        self._watchdog_due = self.world.time + self._watchdog if self._watchdog > 0.0 else math.inf
        self._apply()

    def _restart(self, *, power: bool) -> None:
        if power:
            self._commands = [0] * CHANNELS
            self._held = False
            self._trips &= ~Fault.EMERGENCY_STOP
            self._watchdog_due = math.inf
            self._apply()
        self._state = NodeState.OPERATIONAL
        self._boot_up_due = True
        self._heartbeat_since = self.world.time

    def _faults(self) -> Fault:
        faults = self._trips
        if self._battery < LOWEST_BATTERY_VOLTAGE:
            faults |= Fault.UNDER_VOLTAGE
        elif self._battery > HIGHEST_BATTERY_VOLTAGE:
            faults |= Fault.OVER_VOLTAGE
        return faults

    def _channel_flags(self) -> ChannelFlag:
        return self._channel_trips | (ChannelFlag.AMPS_LIMIT if self._limiting else ChannelFlag(0))

    def _apply(self) -> None:
        """Bring the output to what command, watchdog, limits and faults make of it."""
        power = 0 if self._held or self._faults() else self._commands[0]
        power = min(max(power, -self._power_limit), self._power_limit)
        voltage = self._voltage(power, self._battery)
        if voltage == self._applied_voltage and not self._limiting:
            self._power = power
            return
        self._limiting = False
        self._set_output(power)
        current = abs(self._load.current)
        if current > self._amps_limit:
            self._limiting = True
            share = self._amps_limit / current
            self._set_output(math.trunc(power * (share if self._output == "average" else share**2)))

    def _set_output(self, power: int) -> None:
        self._power = power
        self._applied_voltage = self._voltage(power, self._battery)
        self._load.apply(self._applied_voltage)

    def _voltage(self, power: int, battery: float) -> float:
        duty = power / _FULL
        return duty * battery if self._output == "average" else math.copysign(math.sqrt(abs(duty)), duty) * battery

    def _amps(self, channel: int) -> int:
        if channel != 1:
            return 0
        return round(10.0 * (self._load.current + self._draw(CURRENT_NOISE)))

    def _battery_reading(self) -> int:
        return max(round(10.0 * (self._battery + self._draw(BATTERY_NOISE))), 0)
