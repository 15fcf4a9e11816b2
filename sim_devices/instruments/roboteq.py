"""Emulated Roboteq SDC2160: a brushed motor controller as a PWM voltage supply, with its CANopen objects.

The instrument is its objects, its command watchdog and its protections; the plant behind it is the load that it
heats, at the first motor output. Sources: Roboteq CANBus Networking Manual V2.0 (objects), Roboteq Advanced Digital
Motor Controller User Manual V1.8 (watchdog `RWD`, limits `ALIM` and `MXPF`), CiA 301 (heartbeat).

Runtime commands feed the watchdog, however they arrive, CAN included (User Manual V1.8, RWD): these are the objects
0x2000 to 0x20FF. Queries and all other traffic do not. "As soon as a valid command is received, motor operation will
resume at whichever speed motors were running prior to the watchdog timeout": any command of any channel does.

The duty cycle is the applied power / 1000. With an LC filter the load sees the average, duty cycle × battery
voltage; without one a resistive load is heated by the RMS voltage, battery voltage × √(duty cycle).

Assumptions, where the manuals are silent or were not at hand:

- The first command of the channel after an expiry that is not 0 resumes the previous power, and its own value
  counts only when it is sent again, which is the worst reading of the manual. A command of 0 resumes nothing on its
  own channel, an emergency stop on none.
- The power follows the command at once (a real device has a ramp), and is 0 as long as a fault stands.
- The amps limit acts when the power is applied, by scaling it down, and holds until it is applied again.
- A command beyond ±1000 ‰ is refused rather than clipped.
- The device starts its node by itself (autostart); a reset by NMT clears command and emergency stop.
- A reset by NMT brings the PDOs back to their configuration as delivered.
- The wording of device name, hardware and software version.

Kept in the dictionary without effect: consumer heartbeat times (0x1016), encoder counters (0x2003), and, as no script
runs, user variables (0x2005).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from bench.base import DeviceError
from bench.devices import Identity, Limits, Status, VoltageSupply
from sim_devices.instruments.emulated import EmulatedInstrument, FreezingReadings, RequestRefusedError
from sim_devices.instruments.roboteq_objects import (
    CHANNELS,
    DICTIONARY,
    FORMATS,
    INDICES,
    PDOS,
    VARIABLES,
    AbortCode,
    ChannelFlag,
    Entry,
    Fault,
    NodeState,
)
from sim_devices.instruments.roboteq_pdo import Objects, ProcessDataObjects
from sim_devices.world import World

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

_FIRST_COMMAND = 0x2000
_WITHOUT_EFFECT = frozenset((0x2003, 0x2005))  # commands that only feed the watchdog
_FULL = 1000  # command and power of a duty cycle of 1
_INTERNAL_VOLTAGE = 118  # 0.1 V
_FIVE_VOLTS = 5000  # mV
_TEMPERATURES = (32, 30)  # °C: processor, power stage
_LONGEST_HEARTBEAT_BACKLOG = 4


class _Report(NamedTuple):
    """What the frames that follow a SYNC carry."""

    sources: list[tuple[Callable[..., Any], int]]
    """Each reading, with its subindex."""
    carried: Callable[[Sequence[int]], tuple[int, ...]]
    """Returns what the frames carry of the readings, in their order."""
    form: struct.Struct
    """Form of the data of all frames."""
    frames: tuple[tuple[int, int], ...]
    """Identifier of each frame, and how many bytes it has."""


class HeatingLoad(Protocol):
    """The load at the first motor output."""

    def apply(self, voltage: float) -> None:
        """Apply a voltage, V: the average with an LC filter, the RMS value without; held until the next."""

    @property
    def current(self) -> float:
        """Current through the load, A."""


class EmulatedRoboteq(FreezingReadings, EmulatedInstrument, VoltageSupply):
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
    send_rates : sequence of int
        Interval of each TPDO, ms; 0 for never (`^CTPS`).
    rng : numpy.random.Generator, optional
        Noise of the readings of battery voltage and current; without it they are free of noise.
    """

    MEASURED = (0x2100, 0x2102, 0x210C, 0x210D)

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
        send_rates: Sequence[int] = (0,) * PDOS,
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
        self._counters = [0] * CHANNELS
        self._variables = [0] * VARIABLES
        self._forms: dict[Objects, struct.Struct] = {}
        self._reported: Sequence[tuple[int, Objects]] = ()
        self._report: _Report
        self._pdos = ProcessDataObjects(node, send_rates, world.clock.now())
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
        self.quiet_until = -math.inf
        """When it next says something by itself, s; minus infinity if that is not known."""
        self._heartbeat_since = world.clock.now()
        self._battery_used = math.nan
        self._readings: dict[int, Callable[..., Any]] = {
            0x1000: lambda _: DEVICE_TYPE,
            0x1001: lambda _: 1 if self._faults() else 0,
            0x1016: lambda sub: self._consumer_heartbeats[sub - 1] if sub else len(self._consumer_heartbeats),
            0x1017: lambda _: self._heartbeat_milliseconds,
            0x1018: lambda sub: (3, 0, 0xFFFF_FFFF, 0xFFFF_FFFF)[sub],
            0x2100: self._amps,
            0x2101: lambda sub: 0 if self._held else self._commands[sub - 1],
            0x2102: lambda sub: self._power if sub == 1 else 0,
            0x2104: lambda sub: self._counters[sub - 1],
            0x2106: lambda sub: self._variables[sub - 1],
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
            raise RequestRefusedError(AbortCode.NO_SUBINDEX if index in INDICES else AbortCode.NO_OBJECT)
        return row

    def read_object(self, index: int, sub: int = 0) -> int | str:
        """Return the value of an object, in the unit of the manual.

        Raises `RequestRefusedError` if there is no such object, or it can only be written.
        """
        with self.world.lock:
            row = self.entry(index, sub)
            self.world.advance_locked()
            if not row.readable:
                raise RequestRefusedError(AbortCode.WRITE_ONLY)
            if row.kind == "text":
                return self._texts[index]
            reading = self._readings.get(index)
            return self._pdos.read(index, sub) if reading is None else reading(sub)

    def write_object(self, index: int, value: int, sub: int = 0) -> None:
        """Set an object.

        Raises `RequestRefusedError` if there is no such object, it can only be read, or the value is out of its
        range.
        """
        with self.world.lock:
            row = self.entry(index, sub)
            self.world.advance_locked()
            if not row.writable:
                raise RequestRefusedError(AbortCode.READ_ONLY)
            if index >= _FIRST_COMMAND:
                self._command(index, sub, value)
                return
            self.quiet_until = -math.inf
            if index == 0x1016:
                self._consumer_heartbeats[sub - 1] = value
            elif index == 0x1017:
                self._heartbeat_milliseconds = value
                self._heartbeat_since = self.world.time
            else:
                self._pdos.write(index, sub, value)

    def manage(self, command: int) -> None:
        """Obey a network management command (CiA 301): 1 start, 2 stop, 128, 129 and 130; others are ignored."""
        with self.world.at_present():
            self.quiet_until = -math.inf
            if command == 1:
                self._state = NodeState.OPERATIONAL
            elif command == 2:
                self._state = NodeState.STOPPED
            elif command == 128:
                self._state = NodeState.PRE_OPERATIONAL
            elif command in (129, 130):
                self._restart(power=command == 129)

    def heartbeats(self) -> list[NodeState]:
        """Take the heartbeats that are due since they were last asked for, the newest four at most.

        A host that did not look at its line for an hour finds no hour of heartbeats there.
        """
        period = 1e-3 * self._heartbeat_milliseconds
        # A sum of periods may be short of the instant by its rounding.
        count = math.floor((self._clock.now() - self._heartbeat_since) / period + 1e-6) if period else 0
        if not (count or self._boot_up_due):
            return []
        due = [NodeState.BOOT_UP] if self._boot_up_due else []
        self._boot_up_due = False
        if count:
            self._heartbeat_since += count * period
            due += [self._state] * min(count, _LONGEST_HEARTBEAT_BACKLOG)
        return due if self.plugged_in else []

    def next_heartbeat(self) -> float:
        """Return when the next heartbeat or boot-up message is due, s; infinity if none is."""
        if not self.plugged_in:
            return math.inf
        if self._boot_up_due:
            return self._heartbeat_since
        return (
            self._heartbeat_since + 1e-3 * self._heartbeat_milliseconds if self._heartbeat_milliseconds else math.inf
        )

    # Process data.

    def receive_process_data(self, identifier: int, data: bytes) -> None:
        """Obey an RPDO; other frames, short ones, and values that are refused, change nothing."""
        objects = self._pdos.received(identifier)
        if not objects:
            return
        form = self._form(objects)
        if self._state is not NodeState.OPERATIONAL or len(data) < form.size:
            return
        for (index, sub), value in zip(objects, form.unpack_from(data), strict=True):
            try:
                self.write_object(index, value, sub)
            except RequestRefusedError:
                continue

    def process_data(self, *, synchronous: bool) -> tuple[tuple[tuple[int, int], ...], bytes]:
        """Take the TPDOs that a SYNC asks for, or that are due by their send rates.

        Returns
        -------
        tuple
            Identifier and number of bytes of each frame, and the data of all of them.
        """
        pdos = self._pdos.take_synchronous() if synchronous else self._pdos.take_due(self._clock.now())
        if not pdos or self._state is not NodeState.OPERATIONAL or not self.plugged_in:
            return (), b""
        if pdos is not self._reported:
            self._reported, self._report = pdos, self._report_of(pdos)
        report = self._report
        with self.world.lock:
            self.world.advance_locked()
            values = [read(sub) for read, sub in report.sources]
        return report.frames, report.form.pack(*report.carried(values))

    def next_process_data(self) -> float:
        """Return when the next TPDO is due by its send rate, s; infinity if none is."""
        return self._pdos.next_due() if self._state is NodeState.OPERATIONAL and self.plugged_in else math.inf

    def next_message(self) -> float:
        """Return when it next says something by itself, s; until then it is quiet, unless it is disturbed."""
        instant = min(self.next_heartbeat(), self.next_process_data())
        # A sum of periods may be short of the instant by its rounding.
        self.quiet_until = instant - 1e-6
        return instant

    def _form(self, objects: Objects) -> struct.Struct:
        """Return how a frame carries some objects."""
        form = self._forms.get(objects)
        if form is None:
            codes = (FORMATS[DICTIONARY[key].kind].format[1:] for key in objects)
            form = self._forms[objects] = struct.Struct("<" + "".join(codes))
        return form

    def _report_of(self, pdos: Sequence[tuple[int, Objects]]) -> _Report:
        """Return what frames carry; each object is measured once, however many of them carry it."""
        carried = tuple(key for _, objects in pdos for key in objects)
        keys = [*dict.fromkeys(carried)]
        return _Report(
            [(self._readings[index], sub) for index, sub in keys],
            itemgetter(*map(keys.index, carried)) if len(carried) > 1 else tuple,
            self._form(carried),
            tuple((identifier, self._form(objects).size) for identifier, objects in pdos),
        )

    def _readings_changed(self) -> None:
        self._reported = ()

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
        """Interrupt the supply of the device: it starts again, and says so by its boot-up message."""
        with self.world.at_present():
            self._restart(power=True)

    def plug_in(self) -> None:
        """Undo `unplug`; the heartbeats of meanwhile are lost."""
        with self.world.at_present():
            self.heartbeats()
            self.plugged_in = True
            self.quiet_until = -math.inf

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
            if not (self._held and value != 0):
                self._commands[sub - 1] = value
        elif index == 0x2003:
            self._counters[sub - 1] = value
        elif index == 0x2005:
            self._variables[sub - 1] = value
        elif index == 0x200C:
            self._trips |= Fault.EMERGENCY_STOP
        elif index == 0x200D:
            self._trips &= ~Fault.EMERGENCY_STOP
        elif 1 <= value <= CHANNELS:
            self._commands[value - 1] = 0
        resumes, self._held = self._held, False
        self._watchdog_due = self.world.time + self._watchdog if self._watchdog > 0.0 else math.inf
        if resumes or index not in _WITHOUT_EFFECT:
            self._apply()

    def _restart(self, *, power: bool) -> None:
        if power:
            self._commands = [0] * CHANNELS
            self._counters = [0] * CHANNELS
            self._variables = [0] * VARIABLES
            self._held = False
            self._trips &= ~Fault.EMERGENCY_STOP
            self._watchdog_due = math.inf
            self._apply()
        self._pdos.reset(self.world.time)
        self.quiet_until = -math.inf
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
        return self._channel_trips | ChannelFlag.AMPS_LIMIT if self._limiting else self._channel_trips

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
