"""The Roboteq brushed motor controllers (SDC2160, SDC3260 and their family) as PWM voltage supplies.

Sources: Roboteq CANBus Networking Manual V2.0 (objects, types, scales), the electronic data sheet
`roboteq_motor_controllers_v60.eds` (communication objects), Roboteq Advanced Digital Motor Controller User Manual
V1.8 (watchdog `RWD`, p. 286; emergency stop).

The duty cycle of the output is D = command / 1000. The voltage depends on the load:

- `output = "average"`: behind an LC filter the load sees the average, D · Vbus.
- `output = "rms"`: without a filter a resistive load is heated as by the RMS voltage, Vbus · √D. One step of
  the command is a fine one near Vbus and a coarse one near zero: the lowest voltage beyond zero is 3.2 % of
  Vbus.

Vbus is the battery voltage that the device measures (object 0x210D, resolution 0.1 V). It is read with every
set-point and every reading, and the command follows it when it has moved by more than the last digit, so
that the flicker of that digit does not reach the load.

The bench builder sets these once, over USB and with the maker's software: the node, the bit rate, `^RWD` (watchdog),
`^MXPF` (highest power) and `^ALIM` (highest current); CANopen has no objects for them.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from bench.base import Clock, ConfigurationError, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import CheckFinding, Identity, Limits, Status, VoltageSupply
from drivers.device import RecoverableDevice, attempt
from drivers.roboteq.canopen import ABSENT, AbortedError, Entry, MissedError, NodeLine, NodeSettings, described
from drivers.roboteq.process_data import MOST_READINGS, ProcessData, Report

DEVICE_TYPE = 0x000F0191
"""Object 0x1000 of a controller: device profile 401 (electronic data sheet)."""

_MOST_CHANNELS = 3
_FULL = 1000  # command of a duty cycle of 1
_LAST_DIGIT = 0.1  # of the battery voltage, V
_ARRIVAL_TIMEOUT = 5.0
_STOP_TIMEOUT = 1.0  # for the ramp of the device
_STOP_POLL = 0.02
_HEARTBEAT_SHARE = 1.0 / 3.0  # three in the time allowed, so that one that is lost does not matter
_SAFE_WITHIN = 2.5  # the ramp twice, before and after the emergency stop
_MOST_READINGS = 6  # of one value until it has come twice

_DEVICE_TYPE = Entry(0x1000, "device type")
_DEVICE_NAME = Entry(0x1008, "device name")
_HARDWARE = Entry(0x1009, "hardware version")
_SOFTWARE = Entry(0x100A, "software version")
_HEARTBEAT_TIME = Entry(0x1017, "producer heartbeat time", 2)
_IDENTITY = Entry(0x1018, "identity")
_COMMAND = Entry(0x2000, "motor command", 4, signed=True)
_EMERGENCY_STOP = Entry(0x200C, "emergency stop", 1)
_RELEASE = Entry(0x200D, "release of the emergency stop", 1)
_STOP = Entry(0x200E, "stop", 1)
_AMPS = Entry(0x2100, "motor current", signed=True)
_POWER = Entry(0x2102, "applied power", signed=True)
_VOLTS = Entry(0x210D, "battery voltage")
_FAULTS = Entry(0x2112, "fault flags")
_CHANNEL_FLAGS = Entry(0x2122, "channel flags")

_BATTERY = 2  # subindex of the battery voltage

FAULT_FLAGS: Mapping[int, tuple[str, str]] = {
    0x01: ("overheat", "improve the cooling of the controller or lower the current"),
    0x02: ("over-voltage", "check the power supply"),
    0x04: ("under-voltage", "check the power supply, its cable and its current limit"),
    0x08: ("short circuit", "check the load and its cables"),
    0x10: (
        "emergency stop",
        "find out who stopped it and why, then run `bench rig clear`, or switch the controller off and on",
    ),
    0x20: ("setup fault", "check the configuration with the maker's software"),
    0x40: ("MOSFET failure", "the power stage is damaged: have the controller repaired"),
    0x80: ("default configuration loaded", "load the configuration again with the maker's software"),
}
"""Bits of the fault flags and what to do (CANBus Networking Manual V2.0, object 0x2112)."""

CHANNEL_FLAGS: Mapping[int, tuple[str, str]] = {
    0x01: ("amps limit", "the load takes more current than ^ALIM allows: check the load or lower the voltage"),
    0x02: ("stall", "switch the stall detection off: the load is no motor"),
    0x04: ("loop error", "select the open loop mode with the maker's software"),
    0x08: ("safety stop", "check the input of the safety stop"),
    0x10: ("forward limit", "check the input of the limit switch"),
    0x20: ("reverse limit", "check the input of the limit switch"),
    0x40: ("amps trigger", "check the load and the trigger level"),
}
"""Bits of the channel flags and what to do (CANBus Networking Manual V2.0, object 0x2122)."""


class SupplySettings(NodeSettings):
    """Rig-file settings of a Roboteq controller as a voltage supply."""

    channel: int = Field(
        default=1, ge=1, le=_MOST_CHANNELS, description="motor output, 1 to as many as the controller has"
    )
    output: Literal["average", "rms"] = Field(
        description="which voltage is set: average (behind an LC filter) or rms (heating, without a filter)"
    )
    voltage_limits: tuple[float, float] = Field(
        description="lowest and highest set-point, V, within -60 to 60 and around 0; rms from 0"
    )
    watchdog: float = Field(
        default=1.0,
        ge=0.0,
        le=65.0,
        description="silence of the host after which the controller drops its output, s, as set in it by ^RWD "
        "(which is in ms): 0.001 to 65, 0 for never; must exceed the longest pause between two readings",
    )
    heartbeat: float = Field(
        default=0.5, ge=0.03, le=60.0, description="age of the last heartbeat after which the controller is lost, s"
    )

    @property
    def longest_turn(self) -> float:
        """Longest time that a request and its repetitions keep the line while nothing answers, s.

        Process data are waited for up to two time-outs, as the neighbours answer a SYNC as well; then the mark is
        asked for.
        """
        return (2 * MOST_READINGS + 1) * self.timeout

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        low, high = self.voltage_limits
        if not (-60.0 <= low <= 0.0 <= high <= 60.0 and low < high):
            raise ValueError("voltage_limits: expected the lower limit first, within -60 to 60 V and around 0 V")
        if self.output == "rms" and low < 0.0:
            raise ValueError("voltage_limits: an rms voltage has no sign; expected a lower limit of 0 V")
        return self


class RoboteqSupply(RecoverableDevice[SupplySettings, NodeLine], VoltageSupply):
    """One channel of a Roboteq brushed motor controller as a PWM voltage supply.

    `connect` sends a command of 0 to every channel. A device with a fault is refused; `recover` releases its
    emergency stop.

    The controller watches its host: when no command has come for as long as its watchdog is set to, it drops
    its outputs by itself. Only commands feed the watchdog, from CAN as well; queries do not. So `measure` and
    `glance` send the command again; while a voltage is held, ask for readings more often than the watchdog is long.
    After a longer gap the next command resumes the previous power, on all channels. So the first one is 0, to every
    channel if one had a voltage, and a command that had to be sent again is not sent as late as that. The reading
    that comes too late raises `DeviceError`, as the voltage was not held. The set-point is 0 after the output was
    dropped.

    A reading is one SYNC and the process data that follow it (`drivers.roboteq.process_data`); a controller that does
    not take their configuration is asked object by object, and a value that has changed is then asked for until it
    has come twice. A restart is known by the boot-up message, and with process data by the mark that it loses; from
    then on every reading and every set-point is a `DeviceRestartedError`. A command that another host has sent is a
    `DeviceError` of the next reading with process data.

    The current is the one that the controller reports, with its resolution of 0.1 A; of what it is the mean within
    a PWM period is not documented.

    Calls from several threads wait for each other; the adapter is used by this driver only.
    """

    Settings: ClassVar[type[SupplySettings]] = SupplySettings

    def __init__(self, name: str, settings: SupplySettings, clock: Clock, line: NodeLine) -> None:
        super().__init__(name, settings, clock, line)
        self._lock = threading.RLock()
        self._limits = Limits(*settings.voltage_limits, "V")
        self._voltage_name, self._current_name = (signal.name for signal in self.signals)
        # The channel of this driver first.
        self._channels = tuple(sorted(range(1, _MOST_CHANNELS + 1), key=lambda number: number != settings.channel))
        self._process_data: ProcessData | None = None
        self._known: dict[tuple[int, int], int] = {}
        self._command: int
        self._battery = math.nan
        self._commanded_at = -math.inf
        self._powered = self._obeyed = self._restarted = False
        self._order = object()
        """What the present set-point is known by, as long as no other order replaces it."""

    @classmethod
    def _open_line(cls, name: str, settings: SupplySettings, clock: Clock) -> NodeLine:
        return NodeLine(name, settings, clock)

    @property
    def output(self) -> str:
        """Which voltage the set-point is: `average` behind an LC filter, or `rms` without one."""
        return self._settings.output

    @property
    def limits(self) -> Limits:
        """The allowed set-points, V: the settings' `voltage_limits`."""
        return self._limits

    @property
    def watchdog(self) -> float | None:
        """Silence of the host after which the controller drops its output (^RWD), s; None if it never does.

        Only commands end the silence: `glance`, `measure` and waiting for a status send the present one again.
        """
        return self._settings.watchdog or None

    @property
    def safe_within(self) -> float:
        """Longest time that `safe` takes on a line that works, s: the ramp, and again after the emergency stop."""
        return _SAFE_WITHIN

    def set(self, value: float) -> Status:
        """Apply a voltage in V, as `output` defines it.

        The nearest command is sent, but none beyond the upper or the lower limit. The status completes when the
        device applies the power that was asked for, at the end of its ramp. A power supply that is too low for the
        voltage is a `DeviceError`.
        """
        self.check(value)
        with self._lock:
            battery = self._look().battery / 10
            command = self._command_for(value, battery)
            if self._was_silent() or not self._send(command):
                self._zero()
                if not self._send(command):
                    self._drop()
                    raise DeviceError(
                        self.name,
                        f"no command arrives within the watchdog of {self._settings.watchdog:g} s; lengthen it (^RWD "
                        "and the key watchdog)",
                    )
            self._setpoint, self._battery = value, battery
            order = self._order = object()
        interval = min(0.1, 0.25 * self._settings.watchdog) if self._settings.watchdog else 0.1
        return Status(
            self.name, self._clock, lambda: self._arrived(order), timeout=_ARRIVAL_TIMEOUT, interval=interval
        )

    def measure(self) -> dict[str, float]:
        """Measure the voltage (V, from applied power and battery voltage) and the current (A, to 0.1 A).

        Sends the present command again, adjusted to the battery voltage, which feeds the device's watchdog. An
        output that was dropped and a restart of the device are each a `DeviceError`.
        """
        with self._lock:
            report = self._look()
            battery = report.battery / 10
            self._keep(report)
            return {self._voltage_name: self._voltage(report.power, battery), self._current_name: report.current / 10}

    def reconnect(self) -> None:
        """Open the line again after it was lost, and check that the controller is as it was left.

        Errors are those of `Device.reconnect`; an output that the watchdog has dropped meanwhile is a `DeviceError`.
        """
        with self._lock:
            super().reconnect()

    def _check_unchanged(self) -> None:
        if self._process_data is not None and not self._process_data.is_marked(self._line):
            raise self._found_restarted()
        # A node that answers but sends no heartbeat is not as it was left.
        opened = self._line.heartbeat_age()
        self._line.await_heartbeat(self._settings.heartbeat)
        if self._line.heartbeat_age() >= opened + self._settings.heartbeat:
            raise self._no_heartbeat()
        self.glance()

    def _make_safe(self) -> None:
        """Go to 0 V: command 0, stop, and the emergency stop if the device does not confirm."""
        with self._lock:
            self._order = object()
            line, channel = self._line, self._settings.channel
            first, *others = self._resumable()
            line.urgent = True
            try:
                failures = attempt(partial(self._write, _COMMAND, 0, first))
            finally:
                line.urgent = False
            if failures and isinstance(failures[0], DeviceConnectionError):
                if line.answered:
                    # Another line is tried before the emergency stop, which has to be released.
                    raise self._unconfirmed("output", failures)
                orders = [*((_COMMAND, 0, number) for number in others), (_STOP, channel, 0), (_EMERGENCY_STOP, 1, 0)]
                failures += attempt(*(partial(line.tell, *order) for order in orders))
            else:
                zeros = [partial(self._zero_channel, number) for number in others]
                failures += attempt(*zeros, partial(self._write, _STOP, channel))
            self._setpoint, self._command = 0.0, 0
            self._obeyed = False
            if not failures and self._is_off():
                return
            if line.answered:
                failures += attempt(self.emergency_stop)
            if not self._is_off():
                raise self._unconfirmed("output", failures)

    def emergency_stop(self) -> None:
        """Switch the power stage off until `release`, or until the device is switched off and on.

        Raises `DeviceError` if the device does not acknowledge.
        """
        with self._lock:
            self._order = object()
            self._write(_EMERGENCY_STOP, 1)
            self._setpoint, self._command = 0.0, 0

    def release(self) -> None:
        """End an emergency stop; the output stays at 0 V, as 0 is commanded before and after.

        Raises `DeviceError` if the device refuses, or reports a fault still.
        """
        with self._lock:
            self._order = object()
            # Whether the release brings the last command back is not documented.
            self._zero()
            self._write(_RELEASE, 1)
            self._drop()
            self._look()

    def close(self) -> None:
        """Release the line; a voltage that is on stays on until the device's watchdog drops it."""
        with self._lock:
            super().close()

    def _identify(self) -> Identity:
        name = self._read_text(_DEVICE_NAME)
        # That the name begins or ends with the maker's own, as in the data sheet, is an assumption.
        known = "roboteq" in name.lower()
        if not known:
            # Without a name the type decides.
            device_type = self._read(_DEVICE_TYPE)
            known = not name and device_type == DEVICE_TYPE
        if not known:
            vendor = ""
            with suppress(DeviceError):
                vendor = f", vendor 0x{self._read(_IDENTITY, 1):08X}"
            raise DeviceConnectionError(
                self.name,
                f"expected a Roboteq controller at {self._settings.port}, node {self._settings.node}, found "
                f"{name!r} (device type 0x{device_type:08X}{vendor}); check port and node",
            )
        versions = [text for text in (self._read_text(_SOFTWARE), self._read_text(_HARDWARE)) if text]
        firmware = versions[0] if versions else "unknown"
        model = re.sub("roboteq", "", name, flags=re.IGNORECASE).strip() or "motor controller"
        return Identity("Roboteq", model, "unknown", firmware)

    def _start(self) -> None:
        self._configure()
        self._look()

    def _restart(self) -> None:
        self._configure()
        self.release()

    def _configure(self) -> None:
        settings = self._settings
        now = self._clock.now()
        channels: tuple[int, ...] = ()
        for channel in self._channels:
            try:
                self._line.write(_COMMAND, 0, channel)
            except AbortedError as error:
                if error.code not in ABSENT:
                    raise self._refused(_COMMAND, 0, channel, error) from None
                if channel == settings.channel:
                    raise ConfigurationError(
                        f"{self.name}: channel: the controller does not have channel {channel} ({error})"
                    ) from None
            else:
                channels += (channel,)
        self._channels = channels
        self._commanded_at, self._command = now, 0
        allowed = int(1e3 * settings.heartbeat * _HEARTBEAT_SHARE)
        if not 0 < self._read(_HEARTBEAT_TIME) <= allowed:
            self._write(_HEARTBEAT_TIME, min(allowed, 0xFFFF))
        process_data = ProcessData(self.name, settings.node, settings.channel)
        self._process_data = process_data if process_data.configure(self._line) else None
        # What was heard of a start before this one does not count.
        self._line.restarted = False

    def _command_for(self, volts: float, battery: float) -> int:
        """Return the command that comes nearest to a voltage without going beyond the limits."""
        if abs(volts) > battery + 0.5 * _LAST_DIGIT:
            raise DeviceError(
                self.name, f"the power supply of {battery:.1f} V is too low for {volts:g} V; check the supply"
            )
        if volts == 0.0:
            return 0
        share = min(abs(volts) / battery, 1.0)
        command = round(_FULL * (share if self.output == "average" else share**2))
        if self._voltage(command, battery) > max(self._limits.high if volts > 0 else -self._limits.low, abs(volts)):
            command -= 1
        return command if volts > 0 else -command

    def _voltage(self, power: int, battery: float) -> float:
        duty = power / _FULL
        return duty * battery if self.output == "average" else math.copysign(math.sqrt(abs(duty)), duty) * battery

    def _was_silent(self) -> bool:
        """Return whether the device's watchdog may have expired since the last command."""
        watchdog = self._settings.watchdog
        return self._clock.now() - self._commanded_at >= watchdog > 0.0 or self._commanded_at == -math.inf

    def _keep(self, report: Report) -> None:
        """Send the present command again, or raise if the device does not obey it any more."""
        if self._command == 0:
            self._refuse_other(report)
            if self._process_data is not None:
                self._line.transmit(self._process_data.next_mark())
            return
        # Before it has seen any power of this set-point, the device may be in its ramp.
        dropped = self._powered and report.power == 0
        self._powered = self._powered or report.power * self._command > 0
        if self._was_silent() or dropped:
            raise self._dropped()
        self._refuse_other(report)
        # The last digit flickers; following it would make the voltage flicker.
        battery = report.battery / 10
        follow = abs(battery - self._battery) > 1.5 * _LAST_DIGIT
        if not self._send(self._command_for(self._setpoint, battery) if follow else self._command):
            raise self._dropped()
        if follow:
            self._battery = battery

    def _refuse_other(self, report: Report) -> None:
        """Raise if the device obeyed the present command and obeys another one now."""
        if abs(report.command - self._command) <= 1:
            self._obeyed = True
        elif self._obeyed:
            raise DeviceError(
                self.name,
                f"its command was changed to {report.command} by another host, from {self._command}; find out which",
            )

    def _dropped(self) -> DeviceError:
        """End the set-point that was not held; return the error."""
        silence = self._clock.now() - self._commanded_at
        self._drop()
        return DeviceError(
            self.name,
            f"the output was dropped: the last command is {silence:.3g} s old and the watchdog "
            f"{self._settings.watchdog:g} s long; ask for readings more often or lengthen it (^RWD and the "
            "key watchdog)",
        )

    def _drop(self) -> None:
        """Command 0, which ends the present set-point."""
        self._order = object()
        self._obeyed = False
        self._setpoint = math.nan if math.isnan(self._setpoint) else 0.0
        self._zero()

    def _zero(self) -> None:
        """Command 0 on every channel that this command may resume, back to back."""
        now = self._clock.now()
        for channel in self._resumable():
            self._zero_channel(channel)
        self._commanded_at, self._command = now, 0
        self._obeyed = False

    def _zero_channel(self, channel: int) -> None:
        """Command 0 on a channel; of the other channels it is not known before `connect` which there are."""
        try:
            self._line.write(_COMMAND, 0, channel)
        except AbortedError as error:
            if channel == self._settings.channel or error.code not in ABSENT:
                raise self._refused(_COMMAND, 0, channel, error) from None

    def _resumable(self) -> tuple[int, ...]:
        """Return the channels that the next command may resume, that of this driver first."""
        # All after a silence, unless the last command was 0: so were those to the other channels.
        resumable = self._was_silent() and (self._commanded_at == -math.inf or self._command != 0)
        return self._channels if resumable else self._channels[:1]

    def _arrived(self, order: object) -> bool:
        with self._lock:
            if order is not self._order:
                raise DeviceError(self.name, "was given another command before it arrived")
            report = self._look()
            arrived = abs(report.power - self._command) <= 1
            self._keep(report)
            return arrived

    def _is_off(self) -> bool:
        """Return whether the device applies no power, at the end of its ramp at the latest."""
        end = self._clock.now() + _STOP_TIMEOUT
        try:
            while self._read(_POWER, self._settings.channel) != 0:
                if self._clock.now() >= end:
                    return False
                self._clock.sleep(_STOP_POLL)
        except DeviceError:
            return False
        return True

    def _look(self) -> Report:
        """Return what the device reports; raise what is wrong with it."""
        if self._restarted:
            raise self._found_restarted()
        report = self._by_object() if self._process_data is None else self._by_process_data(self._process_data)
        if report.faults or report.channel_flags:
            raise self._reported(report.faults, report.channel_flags)
        if self._line.restarted:
            raise self._found_restarted()
        allowed = self._settings.heartbeat
        if self._line.heartbeat_age() > allowed:
            # After a loss of the line the next one is under way.
            self._line.await_heartbeat(_HEARTBEAT_SHARE * allowed)
            if self._line.heartbeat_age() > allowed:
                raise self._no_heartbeat()
        return report

    def _no_heartbeat(self) -> DeviceConnectionError:
        return DeviceConnectionError(
            self.name,
            f"no heartbeat of node {self._settings.node} for {self._line.heartbeat_age():.3g} s, "
            f"{self._settings.heartbeat:g} s are allowed; check the bus and the heartbeat of the controller (^CHB)",
        )

    def _by_process_data(self, process_data: ProcessData) -> Report:
        try:
            return process_data.report(
                self._line, self._command, lambda: self._command == 0 or not self._was_silent()
            )
        except DeviceConnectionError:
            if self._line.restarted or not process_data.is_marked(self._line):
                raise self._found_restarted() from None
            raise

    def _by_object(self) -> Report:
        channel = self._settings.channel
        return Report(
            self._read(_POWER, channel),
            self._read(_VOLTS, _BATTERY),
            self._read(_AMPS, channel),
            self._read(_FAULTS),
            self._read(_CHANNEL_FLAGS, channel),
            self._command,
        )

    def _found_restarted(self) -> DeviceRestartedError:
        """Take note of a restart, and return the error."""
        if not self._restarted:
            self._restarted = True
            self._order = object()
            self._setpoint = math.nan if math.isnan(self._setpoint) else 0.0
            self._command = 0
        return DeviceRestartedError(
            self.name,
            "the device has restarted and its output dropped; check its power supply, and connect it again",
        )

    def _reported(self, faults: int, flags: int) -> DeviceError:
        """Return the error for what the device reports."""
        problems = [f"fault: {text}; {advice}" for bit, (text, advice) in FAULT_FLAGS.items() if faults & bit]
        problems += [
            f"channel {self._settings.channel}: {text}; {advice}"
            for bit, (text, advice) in CHANNEL_FLAGS.items()
            if flags & bit
        ]
        unknown = faults & ~sum(FAULT_FLAGS)
        if unknown:
            problems.append(f"fault flags 0x{unknown:X}, unknown to this driver; look them up in the manual")
        return DeviceError(self.name, " | ".join(problems))

    def _send(self, command: int) -> bool:
        """Send a command; return whether it arrived before the device's watchdog could expire."""
        # The device takes it somewhere between request and answer; the earlier one is the safe assumption.
        now, watchdog = self._clock.now(), self._settings.watchdog
        end = self._commanded_at + watchdog if watchdog else math.inf
        mark = b"" if self._process_data is None else self._process_data.next_mark()
        try:
            self._write(_COMMAND, command, self._settings.channel, before=end, after=mark)
        except MissedError:
            return False
        except DeviceConnectionError:
            # It may have arrived.
            self._obeyed = False
            raise
        if self._clock.now() >= end:
            return False
        if command != self._command:
            self._powered = self._powered and command * self._command > 0
            self._obeyed = False
        self._commanded_at, self._command = now, command
        return True

    def _read(self, item: Entry, sub: int = 0) -> int:
        """Return a value that is the one known already, or that has come twice: slcan has no check sum."""
        key = item.index, sub
        seen: set[int | None] = {self._known.get(key)}
        try:
            for _ in range(_MOST_READINGS):
                value = self._line.read(item, sub)
                if value in seen:
                    self._known[key] = value
                    return value
                seen.add(value)
        except AbortedError as error:
            raise DeviceError(self.name, f"refused to report its {described(item, sub)}: {error}") from None
        raise DeviceError(self.name, f"never reports the same {described(item, sub)} twice; check the adapter's line")

    def _read_text(self, item: Entry) -> str:
        """Return a text; empty if the device does not have the object."""
        try:
            return self._line.read_text(item)
        except AbortedError:
            return ""

    def _write(self, item: Entry, value: int, sub: int = 0, *, before: float = math.inf, after: bytes = b"") -> None:
        try:
            self._line.write(item, value, sub, before=before, after=after)
        except AbortedError as error:
            raise self._refused(item, value, sub, error) from None

    def _refused(self, item: Entry, value: int, sub: int, error: AbortedError) -> DeviceError:
        return DeviceError(self.name, f"refused {value} as its {described(item, sub)}: {error}")

    def self_check(self) -> tuple[CheckFinding, ...]:
        """Compare the battery voltage with the limits; the watchdog cannot be read by CANopen.

        Raises DeviceError if the device does not answer.
        """
        with self._lock:
            battery = self._read(_VOLTS, _BATTERY) / 10
        highest = max(self._limits.high, -self._limits.low)
        advice = ""
        if battery < highest:
            advice = f"check the power supply, or lower voltage_limits: {highest:g} V cannot be reached"
        unread = f"^RWD cannot be read by CANopen; the rig file says {1e3 * self._settings.watchdog:g} ms"
        return CheckFinding("power supply", f"{battery:.1f} V", advice), CheckFinding("watchdog read back", unread)
