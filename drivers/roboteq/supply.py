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
set-point and every measurement, and the command follows it when it has moved by more than the last digit, so
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

from bench.clock import Clock
from bench.devices import Finding, Identity, Limits, Status
from bench.errors import ConfigurationError, DeviceConnectionError, DeviceError
from bench.roles import VoltageSupply
from drivers.device import RecoverableDevice, attempt
from drivers.roboteq.canopen import ABSENT, AbortedError, Entry, MissedError, NodeLine, NodeSettings, described

DEVICE_TYPE = 0x000F0191
"""Object 0x1000 of a controller: device profile 401 (electronic data sheet)."""

_MOST_CHANNELS = 3
_FULL = 1000  # command of a duty cycle of 1
_LAST_DIGIT = 0.1  # of the battery voltage, V
_ARRIVAL_TIMEOUT = 5.0
_STOP_TIMEOUT = 1.0  # for the ramp of the device
_STOP_POLL = 0.02

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
        "find out who stopped it and why, then run `bench recover`, or switch the controller off and on",
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
        self._channels: tuple[int, ...] = (settings.channel,)
        self._command = 0
        self._battery = math.nan
        self._commanded_at = -math.inf
        self._powered = False
        self._order = 0

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

    def set(self, value: float) -> Status:
        """Apply a voltage in V, as `output` defines it.

        The nearest command is sent, but none beyond the upper or the lower limit. The status completes when the
        device applies the power that was asked for, at the end of its ramp. A power supply that is too low for the
        voltage is a `DeviceError`.
        """
        self.check(value)
        with self._lock:
            self._check()
            battery = self._read_battery()
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
            self._powered = False
            self._order += 1
            order = self._order
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
            power = self._read(_POWER, self._settings.channel)
            battery = self._read_battery()
            current = self._read(_AMPS, self._settings.channel) / 10
            self._check()
            self._keep(power, battery)
            return {self._voltage_name: self._voltage(power, battery), self._current_name: current}

    def _make_safe(self) -> None:
        """Go to 0 V: command 0, stop, and the emergency stop if the device does not confirm."""
        with self._lock:
            self._order += 1
            channel = self._settings.channel
            zeros = [partial(self._write, _COMMAND, 0, number) for number in self._resumable()]
            failures = attempt(*zeros, partial(self._write, _STOP, channel))
            self._setpoint, self._command = 0.0, 0
            if not failures and self._is_off():
                return
            failures += attempt(self.emergency_stop)
            if not self._is_off():
                raise self._unconfirmed("output", failures)

    def emergency_stop(self) -> None:
        """Switch the power stage off until `release`, or until the device is switched off and on.

        Raises `DeviceError` if the device does not acknowledge.
        """
        with self._lock:
            self._order += 1
            self._write(_EMERGENCY_STOP, 1)
            self._setpoint, self._command = 0.0, 0

    def release(self) -> None:
        """End an emergency stop; the output stays at 0 V, as 0 is commanded before and after.

        Raises `DeviceError` if the device refuses, or reports a fault still.
        """
        with self._lock:
            self._order += 1
            # Whether the release brings the last command back is not documented.
            self._zero()
            self._write(_RELEASE, 1)
            self._drop()
            self._check()

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
        self._check()

    def _restart(self) -> None:
        self._configure()
        self.release()
        self._check()

    def _configure(self) -> None:
        settings = self._settings
        now = self._clock.now()
        self._channels = ()
        # The channel of this driver first; which others there are shows in the same way.
        for channel in sorted(range(1, _MOST_CHANNELS + 1), key=lambda number: number != settings.channel):
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
                self._channels += (channel,)
        self._commanded_at, self._command = now, 0
        self._line.take_restart()
        # Three heartbeats in the time allowed, so that one that is lost does not matter.
        allowed = int(1e3 * settings.heartbeat / 3.0)
        if not 0 < self._read(_HEARTBEAT_TIME) <= allowed:
            self._write(_HEARTBEAT_TIME, min(allowed, 0xFFFF))

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

    def _keep(self, power: int, battery: float) -> None:
        """Send the present command again, or raise if the device has dropped it; `power` is what it applies."""
        if self._command == 0:
            return
        # Before it has seen any power of this set-point, the device may be in its ramp.
        dropped = self._powered and power == 0
        self._powered = self._powered or power * self._command > 0
        if self._was_silent() or dropped:
            raise self._dropped()
        # The last digit flickers; following it would make the voltage flicker.
        if abs(battery - self._battery) > 1.5 * _LAST_DIGIT:
            self._command = self._command_for(self._setpoint, battery)
            self._battery = battery
        if not self._send(self._command):
            raise self._dropped()

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
        self._order += 1
        self._setpoint = math.nan if math.isnan(self._setpoint) else 0.0
        self._zero()

    def _zero(self) -> None:
        """Command 0 on every channel that this command may resume, back to back."""
        now = self._clock.now()
        for channel in self._resumable():
            self._write(_COMMAND, 0, channel)
        self._commanded_at, self._command = now, 0

    def _resumable(self) -> tuple[int, ...]:
        """Return the channels that the next command may resume, that of this driver first.

        All of them after a silence, unless the last command was 0: so were those to the other channels.
        """
        return self._channels if self._command and self._was_silent() else self._channels[:1]

    def _arrived(self, order: int) -> bool:
        with self._lock:
            if order != self._order:
                raise DeviceError(self.name, "was given another command before it arrived")
            power = self._read(_POWER, self._settings.channel)
            battery = self._read_battery()
            self._check()
            arrived = abs(power - self._command) <= 1
            self._keep(power, battery)
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

    def _check(self) -> None:
        """Raise what is wrong with the device."""
        faults = self._read(_FAULTS)
        flags = self._read(_CHANNEL_FLAGS, self._settings.channel)
        problems = [f"fault: {text}; {advice}" for bit, (text, advice) in FAULT_FLAGS.items() if faults & bit]
        problems += [
            f"channel {self._settings.channel}: {text}; {advice}"
            for bit, (text, advice) in CHANNEL_FLAGS.items()
            if flags & bit
        ]
        unknown = faults & ~sum(FAULT_FLAGS)
        if unknown:
            problems.append(f"fault flags 0x{unknown:X}, unknown to this driver; look them up in the manual")
        if problems:
            raise DeviceError(self.name, " | ".join(problems))
        if self._line.take_restart():
            self._drop()
            raise DeviceError(self.name, "the device has restarted and its output dropped; check its power supply")
        age = self._line.heartbeat_age()
        if age > self._settings.heartbeat:
            raise DeviceConnectionError(
                self.name,
                f"no heartbeat of node {self._settings.node} for {age:.3g} s, {self._settings.heartbeat:g} s are "
                "allowed; check the bus and the heartbeat of the controller (^CHB)",
            )

    def _read_battery(self) -> float:
        return self._read(_VOLTS, _BATTERY) / 10

    def _send(self, command: int) -> bool:
        """Send a command; return whether it arrived before the device's watchdog could expire."""
        # The device takes it somewhere between request and answer; the earlier one is the safe assumption.
        now, watchdog = self._clock.now(), self._settings.watchdog
        end = self._commanded_at + watchdog if watchdog else math.inf
        try:
            self._write(_COMMAND, command, self._settings.channel, before=end)
        except MissedError:
            return False
        if self._clock.now() >= end:
            return False
        self._commanded_at, self._command = now, command
        return True

    def _read(self, item: Entry, sub: int = 0) -> int:
        try:
            return self._line.read(item, sub)
        except AbortedError as error:
            raise DeviceError(self.name, f"refused to report its {described(item, sub)}: {error}") from None

    def _read_text(self, item: Entry) -> str:
        """Return a text; empty if the device does not have the object."""
        try:
            return self._line.read_text(item)
        except AbortedError:
            return ""

    def _write(self, item: Entry, value: int, sub: int = 0, *, before: float = math.inf) -> None:
        try:
            self._line.write(item, value, sub, before=before)
        except AbortedError as error:
            raise self._refused(item, value, sub, error) from None

    def _refused(self, item: Entry, value: int, sub: int, error: AbortedError) -> DeviceError:
        return DeviceError(self.name, f"refused {value} as its {described(item, sub)}: {error}")

    def self_check(self) -> tuple[Finding, ...]:
        """Compare the battery voltage with the limits; the watchdog cannot be read by CANopen.

        Raises DeviceError if the device does not answer.
        """
        with self._lock:
            battery = self._read_battery()
        highest = max(self._limits.high, -self._limits.low)
        advice = ""
        if battery < highest:
            advice = f"check the power supply, or lower voltage_limits: {highest:g} V cannot be reached"
        unread = f"^RWD cannot be read by CANopen; the rig file says {1e3 * self._settings.watchdog:g} ms"
        return Finding("power supply", f"{battery:.1f} V", advice), Finding("watchdog read back", unread)
