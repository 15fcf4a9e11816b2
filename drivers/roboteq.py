"""Driver of the Roboteq brushed motor controllers (SDC2160, SDC3260 and their family) as PWM voltage supplies.

CANopen through an slcan adapter. Sources: Roboteq CANBus Networking Manual V2.0 (objects, types, scales; its
SDO examples leave the bits e and s of the command byte clear, the device takes the standard ones that are used
here), the electronic data sheet `roboteq_motor_controllers_v60.eds` (communication objects), Roboteq Advanced
Digital Motor Controller User Manual V1.8 (watchdog `RWD`, emergency stop), CiA 301 (SDO, abort codes,
heartbeat).

The duty cycle of the output is D = command / 1000. Which voltage that is, depends on what is connected:

- `output = "average"`: behind an LC filter the load sees the average, D · Vbus.
- `output = "rms"`: without a filter a resistive load is heated as by the RMS voltage, Vbus · √D. One step of
  the command is a fine one near Vbus and a coarse one near zero: the lowest voltage beyond zero is 3.2 % of
  Vbus.

Vbus is the battery voltage that the device measures (object 0x210D, resolution 0.1 V). It is read with every
set-point and every measurement, and the command follows it when it has moved by more than the last digit, so
that the flicker of that digit does not reach the load.

Once, over USB and with the maker's software, the bench builder sets the node, the bit rate, `^RWD` (watchdog),
`^MXPF` (highest power) and `^ALIM` (highest current); CANopen has no objects for them.
"""

from __future__ import annotations

import math
import re
import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import serial
from can import CanError, Message
from can.interfaces.slcan import slcanBus
from pydantic import Field, model_validator

from bench.clock import Clock
from bench.devices import DriverSettings, Identity, Limits, Status, VoltageSupply
from bench.errors import ConfigurationError, DeviceConnectionError, DeviceError

DEVICE_TYPE = 0x000F0191
"""Object 0x1000 of a controller: device profile 401 (electronic data sheet)."""

_RESENDS = 2
_MOST_FRAMES = 4096  # looked at for one answer; a full buffer of the system has some 500
_MOST_READS = 4096
_LONGEST_LINE = 64
_LONGEST_TEXT = 256

_FULL = 1000  # command of a duty cycle of 1
_LAST_DIGIT = 0.1  # of the battery voltage, V
_ARRIVAL_TIMEOUT = 5.0
_STOP_TIMEOUT = 1.0  # for the ramp of the device
_STOP_POLL = 0.02

_SDO_REQUEST, _SDO_ANSWER, _HEARTBEAT = 0x600, 0x580, 0x700
_ABORT = 0x80
_BOOT_UP = 0
_NO_OBJECT = 0x0602_0000


@dataclass(frozen=True)
class _Object:
    """An object of the dictionary; `size` in bytes is what a download carries, 0 for read-only ones."""

    index: int
    title: str
    size: int = 0
    signed: bool = False


_DEVICE_TYPE = _Object(0x1000, "device type")
_DEVICE_NAME = _Object(0x1008, "device name")
_HARDWARE = _Object(0x1009, "hardware version")
_SOFTWARE = _Object(0x100A, "software version")
_HEARTBEAT_TIME = _Object(0x1017, "producer heartbeat time", 2)
_IDENTITY = _Object(0x1018, "identity")
_COMMAND = _Object(0x2000, "motor command", 4, signed=True)
_EMERGENCY_STOP = _Object(0x200C, "emergency stop", 1)
_RELEASE = _Object(0x200D, "release of the emergency stop", 1)
_STOP = _Object(0x200E, "stop", 1)
_AMPS = _Object(0x2100, "motor current", signed=True)
_POWER = _Object(0x2102, "applied power", signed=True)
_VOLTS = _Object(0x210D, "battery voltage")
_FAULTS = _Object(0x2112, "fault flags")
_CHANNEL_FLAGS = _Object(0x2122, "channel flags")

_BATTERY = 2  # subindex of the battery voltage
_EMERGENCY_STOPPED = 0x10  # fault flag

ABORT_CODES: Mapping[int, str] = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid or unknown",
    0x0504_0005: "out of memory",
    0x0601_0000: "unsupported access to an object",
    0x0601_0001: "the object can only be written",
    0x0601_0002: "the object can only be read",
    _NO_OBJECT: "the object does not exist",
    0x0604_0041: "the object cannot be mapped to the PDO",
    0x0604_0042: "the mapped objects exceed the length of the PDO",
    0x0604_0043: "parameters are incompatible",
    0x0604_0047: "internal incompatibility of the device",
    0x0606_0000: "hardware error",
    0x0607_0010: "the length of the value does not match",
    0x0607_0012: "the value is too long",
    0x0607_0013: "the value is too short",
    0x0609_0011: "the subindex does not exist; check the channel",
    0x0609_0030: "the value is out of range",
    0x0609_0031: "the value is too high",
    0x0609_0032: "the value is too low",
    0x0609_0036: "the highest value is below the lowest",
    0x0800_0000: "general error",
    0x0800_0020: "the value cannot be transferred or stored",
    0x0800_0021: "local control prevents it",
    0x0800_0022: "the present state of the device prevents it",
    0x0800_0023: "no object dictionary is there",
}
"""Why the device ends a transfer (CiA 301, SDO abort codes)."""

FAULT_FLAGS: Mapping[int, tuple[str, str]] = {
    0x01: ("overheat", "improve the cooling of the controller or lower the current"),
    0x02: ("over-voltage", "check the power supply"),
    0x04: ("under-voltage", "check the power supply, its cable and its current limit"),
    0x08: ("short circuit", "check the load and its cables"),
    0x10: ("emergency stop", "find out who stopped it and why, then release it by RoboteqSupply.recover"),
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


class SupplySettings(DriverSettings):
    """What a rig file says of a Roboteq controller as a voltage supply."""

    port: str = Field(
        min_length=1,
        pattern="^[^@]+$",
        description="line of the slcan adapter, as pyserial opens it: /dev/ttyACM0, socket://host:port, "
        "emulated://supply",
    )
    baudrate: int = Field(
        default=115_200, ge=9600, le=3_000_000, description="speed of the adapter's serial line, Bd; USB has none"
    )
    bitrate: Literal[125_000, 500_000] = Field(
        default=125_000, description="speed of the CAN bus, bit/s: 125000 as delivered, or 500000"
    )
    node: int = Field(default=1, ge=1, le=126, description="CANopen node of the controller, 1 to 126")
    channel: int = Field(default=1, ge=1, le=3, description="motor output, 1 to as many as the controller has")
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
        default=0.5,
        ge=0.03,
        le=60.0,
        description="age of the last heartbeat beyond which the controller counts as lost, s",
    )
    timeout: float = Field(
        default=0.1, gt=0.0, le=10.0, description="wait for an answer, s; a request is sent three times at most"
    )

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        low, high = self.voltage_limits
        if not (-60.0 <= low <= 0.0 <= high <= 60.0 and low < high):
            raise ValueError("voltage_limits: expected the lower limit first, within -60 to 60 V and around 0 V")
        if self.output == "rms" and low < 0.0:
            raise ValueError("voltage_limits: an rms voltage has no sign; expected a lower limit of 0 V")
        return self


class RoboteqSupply(VoltageSupply):
    """One channel of a Roboteq brushed motor controller as a PWM voltage supply.

    Made by `connect`, which checks the device and sends a command of 0.

    The controller watches its host: when no command has come for as long as its watchdog is set to, it drops
    its output by itself. Only commands feed the watchdog, queries do not (User Manual V1.8 says so of the
    serial commands; that CANopen is alike is an assumption). So `measure` and `glance` send the command again,
    and whoever holds a voltage asks for a reading more often than the watchdog is long. After a longer gap the
    next command would resume the power of before: the driver sends 0 first, and the reading that comes too late
    raises `DeviceError`, as the voltage was not held.

    The current is what the controller says, with its resolution of 0.1 A; of what it is the mean within a PWM
    period is not documented.

    Calls from several threads wait for each other; the adapter is this driver's alone.

    Parameters
    ----------
    name : str
        Name in the rig.
    settings : SupplySettings
        What the rig file says.
    clock : Clock
        The clock of the run.
    line : _Line
        The open line to the node.
    """

    Settings: ClassVar[type[SupplySettings]] = SupplySettings

    def __init__(self, name: str, settings: SupplySettings, clock: Clock, line: _Line) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._line = line
        self._lock = threading.RLock()
        self._limits = Limits(*settings.voltage_limits, "V")
        self._setpoint = math.nan
        self._command = 0
        self._battery = math.nan
        self._commanded_at = -math.inf
        self._powered = False
        self._order = 0
        self._identity = self._identify()

    @classmethod
    def connect(cls, name: str, settings: SupplySettings, clock: Clock) -> RoboteqSupply:
        """Open the line, check that a healthy Roboteq controller answers, and command 0.

        Parameters
        ----------
        name : str
            Name in the rig.
        settings : SupplySettings
            What the rig file says.
        clock : Clock
            The clock of the run.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened, nothing answers, or what answers is no Roboteq controller.
        DeviceError
            If the device reports a fault; `recover` releases its emergency stop.
        ConfigurationError
            If the controller has no such channel.
        """
        return cls._open(name, settings, clock, release=False)

    @classmethod
    def recover(cls, name: str, settings: SupplySettings, clock: Clock) -> RoboteqSupply:
        """Connect to a device in emergency stop: command 0 and release it.

        Use it once the cause of the stop is found. Parameters and errors are those of `connect`.
        """
        return cls._open(name, settings, clock, release=True)

    @classmethod
    def _open(cls, name: str, settings: SupplySettings, clock: Clock, *, release: bool) -> RoboteqSupply:
        line = _Line(name, settings, clock)
        try:
            device = cls(name, settings, clock, line)
            device._configure()
            if release:
                device.release()
            device._check()
        except BaseException:
            line.close()
            raise
        return device

    @property
    def identity(self) -> Identity:
        """Get maker, model and firmware, as the device said on connecting; CANopen tells no serial number."""
        return self._identity

    @property
    def output(self) -> str:
        """Get which voltage the set-point is: `average` behind an LC filter, or `rms` without one."""
        return self._settings.output

    @property
    def limits(self) -> Limits:
        """Get the allowed set-points, V: the settings' `voltage_limits`."""
        return self._limits

    @property
    def setpoint(self) -> float:
        """Get the set-point that was last sent, V; nan before the first, 0 after the output was dropped."""
        return self._setpoint

    def set(self, value: float) -> Status:
        """Apply a voltage.

        Parameters
        ----------
        value : float
            Voltage in V within `voltage_limits`, as `output` defines it. The command that comes nearest to it
            is sent, but none beyond the upper or the lower limit.

        Returns
        -------
        Status
            Complete when the device applies the power that was asked for, at the end of its ramp.

        Raises
        ------
        LimitError
            If the value is outside of `limits`; nothing is sent.
        DeviceError
            If the device reports a fault, or its power supply is too low for the voltage.
        """
        self.check(value)
        with self._lock:
            self._check()
            battery = self._read_battery()
            command = self._command_for(value, battery)
            if self._was_silent():
                self._send(0)
            self._send(command)
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

        Sends the present command again, adjusted to the battery voltage, which feeds the device's watchdog.

        Raises
        ------
        DeviceError
            If the device reports a fault, dropped its output, restarted, or does not answer.
        """
        with self._lock:
            power = self._read(_POWER, self._settings.channel)
            battery = self._read_battery()
            current = self._read(_AMPS, self._settings.channel) / 10
            self._check()
            self._keep(power, battery)
            voltage_signal, current_signal = self.signals
            return {voltage_signal.name: self._voltage(power, battery), current_signal.name: current}

    def safe(self) -> None:
        """Go to 0 V: command 0, stop, and the emergency stop if the device does not confirm.

        Raises
        ------
        DeviceError
            If the device does not confirm that it applies no power, after everything was tried.
        """
        with self._lock:
            self._order += 1
            failures: list[DeviceError] = []
            channel = self._settings.channel
            for item, value, sub in ((_COMMAND, 0, channel), (_STOP, channel, 0)):
                try:
                    self._write(item, value, sub)
                except DeviceError as error:
                    failures.append(error)
            self._setpoint, self._command = 0.0, 0
            if not failures and self._is_off():
                return
            try:
                self.emergency_stop()
            except DeviceError as error:
                failures.append(error)
            if not self._is_off():
                reason = f" ({failures[0]})" if failures else ""
                raise DeviceError(
                    self.name, f"does not confirm that its output is off{reason}; disconnect its power supply"
                )

    def emergency_stop(self) -> None:
        """Switch the power stage off until `release`, or until the device is switched off and on.

        Raises
        ------
        DeviceError
            If the device does not acknowledge.
        """
        with self._lock:
            self._order += 1
            self._write(_EMERGENCY_STOP, 1)
            self._setpoint, self._command = 0.0, 0

    def release(self) -> None:
        """End an emergency stop; the output stays at 0 V, as 0 is commanded before and after.

        Raises
        ------
        DeviceError
            If the device refuses, or reports a fault still.
        """
        with self._lock:
            self._order += 1
            # Whether the release brings the last command back is not documented.
            self._send(0)
            self._write(_RELEASE, 1)
            self._drop()
            self._check()

    def close(self) -> None:
        """Release the line. A voltage that is on stays on until the device's watchdog drops it."""
        with self._lock:
            self._line.close()

    def _identify(self) -> Identity:
        device_type = self._read(_DEVICE_TYPE)
        name = self._read_text(_DEVICE_NAME)
        # That the name begins or ends with the maker's own, as in the data sheet, is an assumption.
        if "roboteq" not in name.lower() if name else device_type != DEVICE_TYPE:
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

    def _configure(self) -> None:
        settings = self._settings
        try:
            self._line.read(_POWER, settings.channel)
        except _AbortedError as error:
            raise ConfigurationError(
                f"{self.name}: channel: the controller does not have channel {settings.channel} ({error})"
            ) from None
        self._send(0)
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
            silence = self._clock.now() - self._commanded_at
            self._drop()
            raise DeviceError(
                self.name,
                f"the output was dropped: the last command is {silence:.3g} s old and the watchdog "
                f"{self._settings.watchdog:g} s long; ask for readings more often or lengthen it (^RWD and the "
                "key watchdog)",
            )
        # The last digit flickers; following it would make the voltage flicker.
        if abs(battery - self._battery) > 1.5 * _LAST_DIGIT:
            self._command = self._command_for(self._setpoint, battery)
            self._battery = battery
        self._send(self._command)

    def _drop(self) -> None:
        """Command 0; what was set before is over."""
        self._order += 1
        self._setpoint = math.nan if math.isnan(self._setpoint) else 0.0
        self._send(0)

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
        """Raise whatever is wrong with the device."""
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

    def _send(self, command: int) -> None:
        # The device takes it somewhere between request and answer; the earlier one is the safe assumption.
        now, watchdog = self._clock.now(), self._settings.watchdog
        self._write(_COMMAND, command, self._settings.channel)
        if command and self._clock.now() - self._commanded_at >= watchdog > 0.0:
            # It had to be sent again, and may have come late enough to resume the power of before.
            now = self._clock.now()
            self._write(_COMMAND, command, self._settings.channel)
        self._commanded_at = now
        self._command = command

    def _read(self, item: _Object, sub: int = 0) -> int:
        try:
            return self._line.read(item, sub)
        except _AbortedError as error:
            raise DeviceError(self.name, f"refused to tell its {_described(item, sub)}: {error}") from None

    def _read_text(self, item: _Object) -> str:
        """Return a text; empty if the device does not have the object."""
        try:
            return self._line.read_text(item)
        except _AbortedError:
            return ""

    def _write(self, item: _Object, value: int, sub: int = 0) -> None:
        try:
            self._line.write(item, value, sub)
        except _AbortedError as error:
            raise DeviceError(self.name, f"refused {value} as its {_described(item, sub)}: {error}") from None


class _AbortedError(Exception):
    """The device ended a transfer with an abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(ABORT_CODES.get(code, f"abort code 0x{code:08X}"))
        self.code = code


class _Adapter(slcanBus):
    """python-can's slcan adapter, reading what has arrived rather than byte by byte.

    The port's own timeout is the only wait, so that it is also the port's that decides which clock it takes.
    An empty read is the silence of the whole timeout.

    Attributes
    ----------
    refused : bool
        Whether the adapter has answered with BEL since this was last cleared.
    """

    _buffer: bytearray

    def __init__(self, settings: SupplySettings) -> None:
        self.refused = False
        self._patient = True
        try:
            super().__init__(
                settings.port,
                tty_baudrate=settings.baudrate,
                bitrate=settings.bitrate,
                sleep_after_open=0,
                timeout=settings.timeout,
            )
        except BaseException:
            self._abandon()
            raise

    def frame(self) -> Message | None:
        """Return the next frame; None after the silence of the port's timeout."""
        for _ in range(_MOST_FRAMES):
            # A damaged line is no frame: the request is sent again when the answer does not come.
            with suppress(ValueError, IndexError, KeyError):
                return self.recv(0)
        return None

    def waiting_frames(self) -> list[Message]:
        """Return the frames that have arrived, without waiting."""
        frames: list[Message] = []
        self._patient = False
        try:
            while len(frames) < _MOST_FRAMES:
                frame = self.frame()
                if frame is None:
                    break
                frames.append(frame)
        finally:
            self._patient = True
        return frames

    def release(self) -> None:
        """Close the channel and the port, whatever state they are in."""
        with suppress(CanError, serial.SerialException, OSError):
            self.shutdown()
        self._abandon()

    def _abandon(self) -> None:
        port = getattr(self, "serialPortOrig", None)
        if port is not None:
            port.close()

    def _read(self, timeout: float | None) -> str | None:  # noqa: ARG002 - the port's timeout decides
        """Return the next line that carries a frame."""
        port, buffer = self.serialPortOrig, self._buffer
        for _ in range(_MOST_READS):
            while line := self._take_line():
                if line[0] in b"tTrR":
                    return line.decode("ascii", "replace")
            if len(buffer) > _LONGEST_LINE:
                buffer.clear()
            waiting = port.in_waiting
            if not (waiting or self._patient):
                return None
            received = port.read(max(waiting, 1))
            if not received:
                return None
            buffer += received
        return None

    def _take_line(self) -> bytes:
        """Return the next line with its end, nothing if there is none; BEL ends a line, too."""
        buffer = self._buffer
        end = buffer.find(b"\r")
        bell = buffer.find(b"\a", 0, end if end >= 0 else None)
        if bell >= 0:
            self.refused = True
            end = bell
        line = bytes(buffer[: end + 1])
        del buffer[: end + 1]
        return line


class _Line:
    """The service data objects of one node: requests, their answers, and the node's heartbeat.

    A request that brings no answer is sent again, twice at most; all of them may be carried out twice without
    harm. An answer for another object is a late one to an earlier request, and passed over.
    """

    def __init__(self, device: str, settings: SupplySettings, clock: Clock) -> None:
        self._device = device
        self._settings = settings
        self._clock = clock
        self._lock = threading.Lock()
        self._request_id = _SDO_REQUEST + settings.node
        self._answer_id = _SDO_ANSWER + settings.node
        self._heartbeat_id = _HEARTBEAT + settings.node
        self._heard: set[int] = set()
        self._restarted = False
        try:
            self._adapter = _Adapter(settings)
        except (CanError, serial.SerialException, OSError, ValueError) as error:
            raise DeviceConnectionError(device, f"cannot open {settings.port}: {_cause(error)}") from None
        self._heard_at = clock.now()

    def close(self) -> None:
        """Release the line."""
        self._adapter.release()

    def heartbeat_age(self) -> float:
        """Return how long ago the node's last heartbeat was heard, s."""
        return self._clock.now() - self._heard_at

    def take_restart(self) -> bool:
        """Return whether the node has restarted since this was last asked."""
        restarted, self._restarted = self._restarted, False
        return restarted

    def read(self, item: _Object, sub: int) -> int:
        """Read a number; errors are `_AbortedError` and `DeviceConnectionError`."""
        answer = self._exchange(0x40, item, sub)
        command = answer[0]
        # The maker's own examples leave the bits e and s clear and still say the size.
        data = answer[4 : 8 - (command >> 2 & 3)]
        if command >> 5 != 2 or command & 3 == 1:
            raise DeviceError(self._device, f"answered {answer.hex(' ')} for its {_described(item, sub)}")
        return int.from_bytes(data, "little", signed=item.signed)

    def read_text(self, item: _Object) -> str:
        """Read a text, in one piece or in segments; errors as of `read`."""
        for _ in range(_RESENDS):
            # A segment cannot be asked for again; the whole text can.
            with suppress(DeviceConnectionError):
                return self._read_text(item)
        return self._read_text(item)

    def _read_text(self, item: _Object) -> str:
        answer = self._exchange(0x40, item, 0)
        text, toggle = b"", 0
        if answer[0] & 2:
            text = answer[4 : 8 - (answer[0] >> 2 & 3 if answer[0] & 1 else 0)]
        else:
            last = False
            while not last and len(text) < _LONGEST_TEXT:
                segment = self._exchange(0x60 | toggle, item, 0)
                if segment[0] & 0x10 != toggle:
                    raise DeviceError(self._device, f"answered {segment.hex(' ')} for its {_described(item, 0)}")
                text += segment[1 : 8 - (segment[0] >> 1 & 7)]
                last = bool(segment[0] & 1)
                toggle ^= 0x10
        return text.split(b"\0")[0].decode("ascii", "replace").strip()

    def write(self, item: _Object, value: int, sub: int) -> None:
        """Write a number; errors are those of `read`."""
        data = value.to_bytes(item.size, "little", signed=item.signed)
        answer = self._exchange(0x23 | (4 - item.size) << 2, item, sub, data)
        if answer[0] != 0x60:
            raise DeviceError(self._device, f"answered {answer.hex(' ')} for its {_described(item, sub)}")

    def _exchange(self, command: int, item: _Object, sub: int, data: bytes = b"") -> bytes:
        """Send a request; return the eight bytes of its answer."""
        segment = command >> 5 == 3
        multiplexer = b"" if segment else struct.pack("<HB", item.index, sub)
        payload = (bytes((command,)) + multiplexer + data).ljust(8, b"\0")
        request = Message(arbitration_id=self._request_id, is_extended_id=False, data=payload)
        adapter = self._adapter
        try:
            with self._lock:
                for frame in adapter.waiting_frames():
                    self._notice(frame)
                adapter.refused = False
                # Twice the same segment would be a wrong toggle bit.
                for _ in range(1 if segment else 1 + _RESENDS):
                    adapter.send(request, timeout=self._settings.timeout)
                    answer = self._answer(multiplexer)
                    if answer is not None:
                        if answer[0] == _ABORT:
                            raise _AbortedError(int.from_bytes(answer[4:], "little"))
                        return answer
        except (CanError, serial.SerialException, OSError) as error:
            raise DeviceConnectionError(
                self._device, f"lost the line {self._settings.port} ({_cause(error)}); check the cable"
            ) from None
        raise DeviceConnectionError(self._device, self._silence())

    def _answer(self, multiplexer: bytes) -> bytes | None:
        """Return the answer, or None if it does not come in time."""
        adapter, clock = self._adapter, self._clock
        end = clock.now() + self._settings.timeout
        for _ in range(_MOST_FRAMES):
            frame = adapter.frame()
            if frame is None:
                return None
            data = frame.data
            if frame.arbitration_id == self._answer_id and len(data) == 8 and not frame.is_extended_id:
                answer = bytes(data)
                # An answer to a segment does not name its object; an abort and all others do.
                if answer[1:4] == multiplexer or (not multiplexer and (answer[0] >> 5 == 0 or answer[0] == _ABORT)):
                    return answer
            else:
                self._notice(frame)
            if clock.now() >= end:
                return None
        return None

    def _notice(self, frame: Message) -> None:
        """Take note of a heartbeat."""
        identifier = frame.arbitration_id
        if frame.is_extended_id or not _HEARTBEAT < identifier < _HEARTBEAT + 128 or len(frame.data) != 1:
            return
        if identifier == self._heartbeat_id:
            self._heard_at = self._clock.now()
            self._restarted = self._restarted or frame.data[0] == _BOOT_UP
        else:
            self._heard.add(identifier - _HEARTBEAT)

    def _silence(self) -> str:
        settings = self._settings
        others = ""
        if self._heard:
            others = f"; heard of node {', '.join(map(str, sorted(self._heard)))} instead"
        adapter = "; the adapter reports an error" if self._adapter.refused else ""
        return (
            f"no answer within {settings.timeout:g} s at {settings.port}, node {settings.node}, after "
            f"{1 + _RESENDS} requests{others}{adapter}; check power, cable, node and speed "
            f"({settings.bitrate} bit/s)"
        )


def _described(item: _Object, sub: int) -> str:
    return f"{item.title} (object 0x{item.index:04X}:{sub})"


def _cause(error: BaseException) -> BaseException:
    """Return what python-can's errors were raised for."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error
