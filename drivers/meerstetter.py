"""Driver of the Meerstetter TEC controllers (TEC-1089, TEC-1091 and their family) by the MeCom protocol.

Sources: Meerstetter 5117 (MeCom protocol specification: frames, CRC, server errors), Meerstetter 5136 (TEC
controller communication protocol: parameters and commands), Meerstetter 5216 (TEC-family user manual: error
numbers).

Everything that the driver writes goes to the device's RAM: saving to the flash is switched off first
(parameter 108), as the flash endures about 100 000 writes, and set-points go to the live parameters (50000
and up), which are zero again after each reset. The error thresholds of object and sink temperature (4010 to
4012, 5010 to 5012), the sensor and the PID set-up are the bench builder's: the driver leaves them alone.
"""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar

import serial
from pydantic import Field, field_validator

from bench.clock import Clock
from bench.devices import DriverSettings, Identity, Limits, Status, TECAmplifier, TECMode
from bench.errors import ConfigurationError, DeviceConnectionError, DeviceError

_RESENDS = 2
_MOST_STALE_ANSWERS = 8
_ACKNOWLEDGE_LENGTH = 12  # !, address, sequence, CRC, carriage return
_ERROR_LENGTH = 15  # the same and + with two digits
_LONGEST_NONSENSE = 64  # characters without an end; the longest answer has 32
_START_TIMEOUT = 5.0
_START_POLL = 0.1
_RESET_DELAY = 0.3  # the device restarts 0.2 s after the command
_OUT_OF_RANGE = 7

_OFF, _LIVE_ENABLE = 0, 2  # values of the output stage enable
_LIVE_INPUT, _CONTROLLER_INPUT = 1, 2  # values of the output stage input selection
_STABLE = 2  # value of "temperature is stable"

FAMILY = frozenset({1089, 1090, 1091, 1092, 1122, 1123, 1161, 1162, 1163, 1166, 1167})
"""Device types (parameter 100) that are taken for TEC controllers. Meerstetter 5136 covers 1089 to 1123; that
the 116x obey the same parameters is an assumption."""


class _State(IntEnum):
    """Values of the device status, parameter 104."""

    INIT = 0
    READY = 1
    RUN = 2
    ERROR = 3
    BOOTLOADER = 4
    RESET_PENDING = 5


@dataclass(frozen=True)
class _Parameter:
    """A device parameter: INT32 or FLOAT32, of a channel or of the whole device."""

    number: int
    title: str
    real: bool = False
    of_channel: bool = True


_DEVICE_TYPE = _Parameter(100, "device type", of_channel=False)
_SERIAL_NUMBER = _Parameter(102, "serial number", of_channel=False)
_FIRMWARE = _Parameter(103, "firmware version", of_channel=False)
_STATUS = _Parameter(104, "device status", of_channel=False)
_ERROR_NUMBER = _Parameter(105, "error number", of_channel=False)
_ERROR_INSTANCE = _Parameter(106, "error instance", of_channel=False)
_ERROR_PARAMETER = _Parameter(107, "error parameter", of_channel=False)
_SAVING_OFF = _Parameter(108, "saving to flash off", of_channel=False)
_OBJECT_TEMPERATURE = _Parameter(1000, "object temperature", real=True)
_SINK_TEMPERATURE = _Parameter(1001, "sink temperature", real=True)
_CURRENT = _Parameter(1020, "output current", real=True)
_VOLTAGE = _Parameter(1021, "output voltage", real=True)
_STABILITY = _Parameter(1200, "temperature is stable")
_INPUT = _Parameter(2000, "output stage input selection")
_ENABLE = _Parameter(2010, "output stage enable")
_CURRENT_LIMIT = _Parameter(2030, "current limitation", real=True)
_VOLTAGE_LIMIT = _Parameter(2031, "voltage limitation", real=True)
_WATCHDOG = _Parameter(2060, "communication watchdog", real=True, of_channel=False)
_TARGET = _Parameter(3000, "target object temperature", real=True)
_POLARITY = _Parameter(3034, "positive current heats")
_STABLE_WINDOW = _Parameter(4040, "temperature window of stability", real=True)
_STABLE_TIME = _Parameter(4041, "minimum time in the window of stability", real=True)
_RESTART_DELAY = _Parameter(6310, "delay till restart", real=True, of_channel=False)
_LIVE_ENABLED = _Parameter(50000, "live enable")
_LIVE_CURRENT = _Parameter(50001, "live current", real=True)
_LIVE_VOLTAGE = _Parameter(50002, "live voltage", real=True)
_LIVE_TARGET_SELECTED = _Parameter(50011, "live target selected")
_LIVE_TARGET = _Parameter(50012, "live target object temperature", real=True)

SERVER_ERRORS: Mapping[int, str] = {
    1: "the command is not available",
    2: "the device is busy",
    3: "general communication error",
    4: "format error",
    5: "the parameter is not available",
    6: "the parameter is read-only",
    7: "the value is out of range",
    8: "the instance is not available; check the channel",
    9: "general error of the parameter",
}
"""Why the device refuses a request (Meerstetter 5117, server error codes)."""

_CALL_MAKER = "ask Meerstetter if it comes again after a power cycle"
_SET_UP = "load a parameter file for this firmware with the maker's service software"
_WIRING = "check the Peltier element and its cables for a short circuit or an insulation defect"
_OBJECT_SENSOR = "check the object sensor, its cable and the sensor set-up"
_SINK_SENSOR = "check the sink sensor, its cable and the sensor set-up"
_THRESHOLD = "check the load, or raise the error threshold with the maker's service software"

DEVICE_ERRORS: Mapping[int, tuple[str, str]] = {
    **dict.fromkeys(range(1, 11), ("processor malfunction", _CALL_MAKER)),
    11: ("emergency stop", "find out who stopped it and why"),
    12: ("operator panel timed out", "check the operator panel"),
    **dict.fromkeys((20, 21, 25, 26, 27, 28, 29), ("malfunction of the parameter system", _CALL_MAKER)),
    22: ("the parameter set in the flash is corrupt", _SET_UP),
    23: ("the parameter set does not fit the firmware", _SET_UP),
    24: ("the firmware does not know the hardware", _CALL_MAKER),
    30: ("supply voltage too low", "check the power supply, its cable and its current limit"),
    31: ("supply voltage too high", "check the power supply"),
    32: ("internal medium voltage too low", "check the power supply"),
    33: ("internal medium voltage too high", "check the power supply"),
    36: ("internal 3.3 V too low", _CALL_MAKER),
    37: ("internal 3.3 V too high", _CALL_MAKER),
    **dict.fromkeys((50, 51, 52), ("flash failure", _CALL_MAKER)),
    53: ("the serial send buffer overflowed", "ask the device less often"),
    60: ("the device is too hot", "improve its cooling or lower the current"),
    61: ("factory test hardware does not answer", _CALL_MAKER),
    100: ("over-current, positive at OUT+", _WIRING),
    101: ("over-current, negative at OUT+", _WIRING),
    102: ("over-current, positive at OUT−", _WIRING),
    103: ("over-current, negative at OUT−", _WIRING),
    104: ("over-voltage at OUT+", "check that the Peltier element is connected"),
    105: ("over-voltage at OUT−", "check that the Peltier element is connected"),
    106: ("the currents of OUT+ and OUT− differ", _WIRING),
    107: ("over-current, fast switch-off", _WIRING),
    108: (
        "the output stage is in saturation",
        "lower the current or the voltage limitation, or raise the supply voltage",
    ),
    109: ("the currents of OUT+ and OUT− are too unequal", _WIRING),
    110: ("the allowed output power is reached", "lower the current limitation"),
    111: ("the resistance of the load is too low", "lower the current limitation or the supply voltage"),
    **dict.fromkeys(range(120, 124), ("the current measurement has an offset", _CALL_MAKER)),
    **dict.fromkeys((130, 131, 132), ("object temperature circuit failure", _CALL_MAKER)),
    133: ("the object sensor reads below its range", _OBJECT_SENSOR),
    134: ("the object sensor reads above its range, as without a sensor", _OBJECT_SENSOR),
    137: ("the object temperature is below its error threshold", _THRESHOLD),
    138: ("the object temperature is above its error threshold", _THRESHOLD),
    139: ("the object temperature changes too fast", _OBJECT_SENSOR),
    140: ("the sink sensor reads below its range", _SINK_SENSOR),
    141: ("the sink sensor reads above its range, as without a sensor", _SINK_SENSOR),
    142: ("the sink temperature is below its error threshold", _THRESHOLD),
    143: ("the sink temperature is above its error threshold", "check fan and water of the heat sink"),
    144: ("the sink temperature changes too fast", _SINK_SENSOR),
    **dict.fromkeys(range(150, 154), ("object temperature circuit failure", _CALL_MAKER)),
    **dict.fromkeys(range(160, 166), ("the connection of the boards fails", "check the board connection")),
    **dict.fromkeys(range(170, 174), ("auto tuning failed", "tune again with the maker's service software")),
    175: ("the fan does not reach its speed", "check the fan"),
    176: ("the fan is blocked", "check the fan"),
    **dict.fromkeys((180, 181), ("the lookup table is wrong", "check the lookup table")),
    182: ("the temperature was not stable in time", "check the PID set-up and the load"),
    183: (
        "communication watchdog: the host was silent for too long and the output went off",
        "find out why the host stopped, or allow it more time with the key watchdog",
    ),
    184: ("the display format is wrong", "check the display set-up"),
}
"""What the error numbers mean and what to do (Meerstetter 5216, error numbers)."""

_UNKNOWN_ERROR = ("unknown to this driver", "look it up in the manual of the device")


class TECSettings(DriverSettings):
    """What a rig file says of a Meerstetter TEC controller."""

    port: str = Field(
        min_length=1, description="line, as pyserial opens it: /dev/ttyUSB0, socket://host:port, emulated://tec"
    )
    address: int = Field(default=1, ge=1, le=254, description="device address (parameter 2051), 1 to 254")
    channel: int = Field(default=1, ge=1, le=4, description="output channel, 1 to 4")
    baudrate: int = Field(default=57600, ge=4800, le=1_000_000, description="speed of the line, Bd")
    timeout: float = Field(
        default=0.2, gt=0.0, le=10.0, description="wait for an answer, s; a request is sent three times at most"
    )
    mode: TECMode = Field(default=TECMode.TEMPERATURE, description="what is held constant: temperature or current")
    temperature_limits: tuple[float, float] = Field(
        description="lowest and highest temperature set-point, °C, within -100 to 200"
    )
    current_limit: float = Field(
        gt=0.0, le=10.0, description="highest current of either sign, A; a TEC-1091 gives 4, a TEC-1089 10"
    )
    voltage_limit: float = Field(gt=0.0, le=21.0, description="highest voltage of either sign, V")
    watchdog: float = Field(
        default=5.0,
        ge=0.0,
        le=600.0,
        description="silence of the host after which the device switches its output off, s: 0.1 to 600, 0 for "
        "never; must exceed the longest pause between two readings, which is 2 s in a long hold",
    )
    stable_window: float = Field(
        default=0.1, gt=0.0, le=50.0, description="deviation that counts as having arrived, K"
    )
    stable_time: float = Field(
        default=1.0, ge=0.0, le=86400.0, description="time within the deviation that counts as arrived, s"
    )
    stable_timeout: float = Field(
        default=300.0, gt=0.0, description="time after which a temperature that is not stable has failed, s"
    )

    @field_validator("temperature_limits")
    @classmethod
    def _check_temperature_limits(cls, value: tuple[float, float]) -> tuple[float, float]:
        low, high = value
        if not -100.0 <= low < high <= 200.0:
            raise ValueError("expected the lower limit first, both within -100 to 200 °C")
        return value

    @field_validator("watchdog")
    @classmethod
    def _check_watchdog(cls, value: float) -> float:
        if 0.0 < value < 0.1:
            raise ValueError("expected 0.1 to 600 s, or 0 for no watchdog")
        return value


class MeerstetterTEC(TECAmplifier):
    """A Meerstetter TEC controller as a current source or as a temperature controller.

    Made by `connect`, which checks and configures the device and leaves its output off.

    While the output is on, the device watches its host (`watchdog` of the settings, 5 s unless told
    otherwise): if the host is silent for that long, the device switches its output off by itself and stays
    in error 183. That any exchange feeds the watchdog, a reading as well as a write, is an assumption; the
    manual does not say. So whoever holds a set-point asks for a reading (`glance`) more often than that: the
    longest pause between two ticks of the bench is 2 s, hence the default. The watchdog is armed just before
    the output is switched on and disarmed once it is confirmed to be off, so that a device at rest does not
    end in an error.

    The device reports current and voltage by its own sign; whether a positive current heats is parameter
    3034, which the driver reads once and takes into account, as the role counts heating as positive. That
    it applies to the live current in the same way is an assumption.

    Parameters
    ----------
    name : str
        Name in the rig.
    settings : TECSettings
        What the rig file says.
    clock : Clock
        The clock of the run.
    line : _Line
        The open line to the device.
    """

    Settings: ClassVar[type[TECSettings]] = TECSettings

    def __init__(self, name: str, settings: TECSettings, clock: Clock, line: _Line) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._line = line
        self._mode = settings.mode
        self._setpoint = math.nan
        self._polarity = 1
        self._identity = self._identify()

    @classmethod
    def connect(cls, name: str, settings: TECSettings, clock: Clock) -> MeerstetterTEC:
        """Open the line, check that a healthy TEC controller answers, and configure it; nothing moves.

        Parameters
        ----------
        name : str
            Name in the rig.
        settings : TECSettings
            What the rig file says.
        clock : Clock
            The clock of the run.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened, nothing answers, or what answers is not a TEC controller.
        DeviceError
            If the device is in its error state; `recover` resets it.
        ConfigurationError
            If the device does not allow a value of the settings; nothing was written then.
        """
        return cls._open(name, settings, clock, reset=False)

    @classmethod
    def recover(cls, name: str, settings: TECSettings, clock: Clock) -> MeerstetterTEC:
        """Connect to a device in its error state: open the line, reset the device, and configure it.

        Use it once the cause of the error is found. Parameters and errors are those of `connect`.
        """
        return cls._open(name, settings, clock, reset=True)

    @classmethod
    def _open(cls, name: str, settings: TECSettings, clock: Clock, *, reset: bool) -> MeerstetterTEC:
        line = _Line(name, settings)
        try:
            device = cls(name, settings, clock, line)
            if reset:
                device.reset()
            else:
                device._wait_until_started()
                device._check()
                device._configure()
        except BaseException:
            line.close()
            raise
        return device

    @property
    def identity(self) -> Identity:
        """Get maker, model, serial number and firmware, as the device said on connecting."""
        return self._identity

    @property
    def mode(self) -> TECMode:
        """Get what is held constant."""
        return self._mode

    def select_mode(self, mode: TECMode) -> None:
        """Set what is held constant; a change switches the output off first.

        Raises
        ------
        DeviceError
            If the output does not go off, or the device refuses.
        """
        if mode is self._mode:
            return
        self.safe()
        self._write(_LIVE_CURRENT, 0.0)
        self._write(_INPUT, _CONTROLLER_INPUT if mode is TECMode.TEMPERATURE else _LIVE_INPUT)
        self._mode = mode
        self._setpoint = math.nan

    @property
    def limits(self) -> Limits:
        """Get the allowed set-points: the settings' `temperature_limits` in °C, or ± `current_limit` in A."""
        if self._mode is TECMode.TEMPERATURE:
            return Limits(*self._settings.temperature_limits, "°C")
        return Limits(-self._settings.current_limit, self._settings.current_limit, "A")

    @property
    def setpoint(self) -> float:
        """Get the set-point that was last sent, °C or A by mode; nan before the first."""
        return self._setpoint

    def set(self, value: float) -> Status:
        """Control the object temperature or the current; switches the output on if it is off.

        Parameters
        ----------
        value : float
            Temperature in °C within `temperature_limits`, or current in A within ± `current_limit`, by mode;
            a positive current heats.

        Returns
        -------
        Status
            Complete when the device reports the temperature stable; at once in current mode.

        Raises
        ------
        LimitError
            If the value is outside of `limits`; nothing is sent.
        DeviceError
            If the device is in its error state or refuses.
        """
        self.check(value)
        state = self._check()
        if self._mode is TECMode.TEMPERATURE:
            self._write(_LIVE_TARGET, value)
        else:
            self._write(_LIVE_CURRENT, self._polarity * value)
        self._setpoint = value
        if state is not _State.RUN:
            self._switch_on()
        if self._mode is TECMode.CURRENT:
            return Status.completed(self.name, self._clock)
        timeout = self._settings.stable_timeout
        return Status(self.name, self._clock, lambda: self._arrived(value), timeout=timeout)

    @property
    def output_enabled(self) -> bool:
        """Get whether the output stage is on, as the device says now."""
        return self._state() is _State.RUN

    def measure(self) -> dict[str, float]:
        """Measure object and sink temperature (°C), current (A, positive heats) and voltage (V).

        Raises
        ------
        DeviceError
            If the device is in its error state, restarts, or does not answer.
        """
        values = (
            self._read(_OBJECT_TEMPERATURE),
            self._read(_SINK_TEMPERATURE),
            self._polarity * self._read(_CURRENT),
            self._polarity * self._read(_VOLTAGE),
        )
        # Asked last: an error that comes up while the values are read spoils them, too.
        self._check()
        if not all(map(math.isfinite, values)):
            raise DeviceError(self.name, "reports a value that is not a number; check the sensors")
        return {signal.name: value for signal, value in zip(self.signals, values, strict=True)}

    def stop(self, success: bool = True) -> None:  # noqa: ARG002 - bluesky's form
        """Hold the present temperature as the set-point; in current mode the current stays as it is."""
        if self._mode is TECMode.CURRENT or self._state() is not _State.RUN:
            return
        limits = self.limits
        present = min(max(self._read(_OBJECT_TEMPERATURE), limits.low), limits.high)
        self._write(_LIVE_TARGET, present)
        self._setpoint = present

    def safe(self) -> None:
        """Switch the output stage off by every way there is, and see that it is off.

        Live enable and output stage enable are both switched off; if either fails, or the device still
        reports a running output, the emergency stop (`ES`, error 11 on the device) follows.

        Raises
        ------
        DeviceError
            If the device does not confirm that the output is off, after everything was tried.
        """
        failures = []
        for parameter in (_LIVE_ENABLED, _ENABLE):
            try:
                self._write(parameter, _OFF)
            except DeviceError as error:
                failures.append(error)
        if failures or not self._is_off():
            try:
                self._line.order("ES")
            except (DeviceError, _RefusedError) as error:
                failures.append(DeviceError(self.name, f"emergency stop: {error}"))
            if not self._is_off():
                reason = f" ({failures[0]})" if failures else ""
                raise DeviceError(
                    self.name, f"does not confirm that its output is off{reason}; disconnect its power supply"
                )
        # The output is off, so whether the watchdog could be disarmed does not matter for safety.
        with suppress(DeviceError):
            self._write(_WATCHDOG, 0.0)

    def reset(self) -> None:
        """Restart the device and configure it again: clears an error whose cause is gone. The output is off.

        Raises
        ------
        DeviceError
            If the device does not come back within 5 s, or comes back with an error.
        """
        # The acknowledge may be lost in the restart; whether the device comes back is what counts.
        with suppress(DeviceConnectionError, _RefusedError):
            self._line.order("RS")
        self._clock.sleep(_RESET_DELAY)
        self._wait_until_started()
        self._check()
        self._configure()

    def close(self) -> None:
        """Release the line. An output that is on stays on until the device's watchdog switches it off."""
        self._line.close()

    def _identify(self) -> Identity:
        device_type = int(self._read(_DEVICE_TYPE))
        if device_type not in FAMILY:
            try:
                described = f"device type {device_type}, {self._line.ask('?IF', 20).strip()}"
            except _RefusedError:
                described = f"device type {device_type}"
            raise DeviceConnectionError(
                self.name,
                f"expected a Meerstetter TEC controller at {self._settings.port}, address "
                f"{self._settings.address}, found {described}; check port and address",
            )
        return Identity(
            "Meerstetter Engineering",
            f"TEC-{device_type}",
            str(int(self._read(_SERIAL_NUMBER))),
            f"{self._read(_FIRMWARE) / 100:.2f}",
        )

    def _configure(self) -> None:
        settings = self._settings
        low, high = settings.temperature_limits
        # The watchdog is left out: real firmware reports a wrong range for it.
        for key, parameter, value in (
            ("current_limit", _CURRENT_LIMIT, settings.current_limit),
            ("voltage_limit", _VOLTAGE_LIMIT, settings.voltage_limit),
            ("temperature_limits", _TARGET, low),
            ("temperature_limits", _TARGET, high),
            ("stable_window", _STABLE_WINDOW, settings.stable_window),
            ("stable_time", _STABLE_TIME, settings.stable_time),
        ):
            self._check_range(key, parameter, value)
        self._polarity = 1 if self._read(_POLARITY) else -1
        self._write(_SAVING_OFF, 1)
        self._write(_LIVE_ENABLED, _OFF)
        self._write(_ENABLE, _OFF)
        self._write(_LIVE_CURRENT, 0.0)
        self._write(_INPUT, _CONTROLLER_INPUT if self._mode is TECMode.TEMPERATURE else _LIVE_INPUT)
        self._write(_CURRENT_LIMIT, settings.current_limit)
        self._write(_VOLTAGE_LIMIT, settings.voltage_limit)
        self._write(_STABLE_WINDOW, settings.stable_window)
        self._write(_STABLE_TIME, settings.stable_time)
        # No restart by itself after an error: what tripped stays off until somebody looks.
        self._write(_RESTART_DELAY, 0.0)
        self._write(_WATCHDOG, 0.0)
        self._setpoint = math.nan

    def _check_range(self, key: str, parameter: _Parameter, value: float) -> None:
        lowest, highest = self._range(parameter)
        if not lowest <= _single(value) <= highest:
            raise ConfigurationError(
                f"{self.name}: {key}: {value:g} is outside of what the {self._identity.model} allows, "
                f"{lowest:g} to {highest:g}"
            )

    def _switch_on(self) -> None:
        if self._mode is TECMode.TEMPERATURE:
            self._write(_LIVE_TARGET_SELECTED, 1)
        else:
            self._write(_LIVE_VOLTAGE, self._settings.voltage_limit)
        self._write(_WATCHDOG, self._settings.watchdog)
        self._write(_ENABLE, _LIVE_ENABLE)
        self._write(_LIVE_ENABLED, 1)
        self._check()

    def _arrived(self, target: float) -> bool:
        if self._read(_STABILITY) != _STABLE:
            if self._check() is not _State.RUN:
                raise DeviceError(self.name, f"the output was switched off before it reached {target:g} °C")
            return False
        # The device may still report the previous target as stable; three windows leave room for noise.
        return abs(self._read(_OBJECT_TEMPERATURE) - target) <= 3.0 * self._settings.stable_window

    def _is_off(self) -> bool:
        # In its error state, too, the device keeps the output off.
        with suppress(DeviceError):
            return self._state() is not _State.RUN
        return False

    def _state(self) -> _State:
        value = int(self._read(_STATUS))
        try:
            return _State(value)
        except ValueError:
            raise DeviceError(self.name, f"reports a device status {value} that the protocol lacks") from None

    def _check(self) -> _State:
        """Return the state if it is ready or run; raise what is wrong otherwise."""
        state = self._state()
        if state is _State.ERROR:
            raise self._fault()
        if state not in (_State.READY, _State.RUN):
            title = state.name.lower().replace("_", " ")
            raise DeviceError(
                self.name, f"is not ready (device status {state.value}, {title}); try again or power-cycle it"
            )
        return state

    def _fault(self) -> DeviceError:
        number = int(self._read(_ERROR_NUMBER))
        instance, parameter = int(self._read(_ERROR_INSTANCE)), int(self._read(_ERROR_PARAMETER))
        text, advice = DEVICE_ERRORS.get(number, _UNKNOWN_ERROR)
        return DeviceError(
            self.name,
            f"error {number} ({text}; instance {instance}, parameter {parameter}): {advice}, "
            "then clear the error by a power cycle or by MeerstetterTEC.recover",
        )

    def _wait_until_started(self) -> None:
        end = self._clock.now() + _START_TIMEOUT
        while True:
            problem: DeviceError | None = None
            try:
                state = self._state()
                if state not in (_State.INIT, _State.RESET_PENDING):
                    return
            except DeviceConnectionError as error:
                problem = error
            if self._clock.now() >= end:
                raise problem or DeviceError(self.name, f"did not start within {_START_TIMEOUT:g} s")
            self._clock.sleep(_START_POLL)

    def _read(self, parameter: _Parameter) -> float:
        answer = self._ask("?VR", parameter, 8)
        return _decode(self.name, parameter, answer)

    def _range(self, parameter: _Parameter) -> tuple[float, float]:
        answer = self._ask("?VL", parameter, 18)
        return _decode(self.name, parameter, answer[2:10]), _decode(self.name, parameter, answer[10:])

    def _ask(self, command: str, parameter: _Parameter, digits: int) -> str:
        try:
            return self._line.ask(f"{command}{self._selector(parameter)}", digits)
        except _RefusedError as error:
            raise DeviceError(
                self.name, f"refused to tell its {parameter.title} (parameter {parameter.number}): {error}"
            ) from None

    def _write(self, parameter: _Parameter, value: float) -> None:
        try:
            self._line.order(f"VS{self._selector(parameter)}{_encode(parameter, value)}")
        except _RefusedError as error:
            allowed = ""
            if error.code == _OUT_OF_RANGE:
                lowest, highest = self._range(parameter)
                allowed = f"; allowed are {lowest:g} to {highest:g}"
            raise DeviceError(
                self.name,
                f"refused {value:g} as its {parameter.title} (parameter {parameter.number}): {error}{allowed}",
            ) from None

    def _selector(self, parameter: _Parameter) -> str:
        instance = self._settings.channel if parameter.of_channel else 1
        return f"{parameter.number:04X}{instance:02X}"


class _RefusedError(Exception):
    """The device answered a request with a server error."""

    def __init__(self, code: int) -> None:
        super().__init__(SERVER_ERRORS.get(code, f"server error {code}"))
        self.code = code


class _Line:
    """The serial line to one device: frames, their CRC and sequence numbers, and sending again.

    A request that brings no answer, or a damaged one, is sent again with its own sequence number, twice at
    most. An answer with another sequence number is a late one to an earlier request, and passed over.
    """

    def __init__(self, device: str, settings: TECSettings) -> None:
        self._device = device
        self._settings = settings
        self._sequence = 0
        self._received = bytearray()
        self._silence = f"no answer within {settings.timeout:g} s"
        try:
            self._port: Any = serial.serial_for_url(
                settings.port,
                baudrate=settings.baudrate,
                timeout=settings.timeout,
                write_timeout=settings.timeout,
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise DeviceConnectionError(device, f"cannot open {settings.port}: {error}") from None

    def close(self) -> None:
        """Release the line."""
        self._port.close()

    def ask(self, request: str, digits: int) -> str:
        """Send a query; return the `digits` characters of its answer.

        Raises
        ------
        _RefusedError
            If the device answers with a server error.
        DeviceConnectionError
            If no good answer comes.
        """
        return self._exchange(request, digits).decode("ascii", "replace")

    def order(self, request: str) -> None:
        """Send what the device acknowledges only; errors are those of `ask`."""
        self._exchange(request, 0)

    def _exchange(self, request: str, digits: int) -> bytes:
        self._sequence = (self._sequence + 1) & 0xFFFF
        head = b"%02X%04X" % (self._settings.address, self._sequence)
        body = b"#" + head + request.encode("ascii")
        crc = b"%04X" % crc_hqx(body, 0)
        frame = body + crc + b"\r"
        try:
            for _ in range(1 + _RESENDS):
                self._port.write(frame)
                problem, content = self._answer(b"!" + head, crc, digits)
                if problem == "":
                    return content
                if content[:1] == b"+":
                    raise _RefusedError(int(content[1:3], 16))
                if problem != self._silence:
                    # Whatever else has come belongs to the damage; after silence, a late answer may come.
                    self._received.clear()
                    self._port.reset_input_buffer()
        except (serial.SerialException, OSError) as error:
            raise DeviceConnectionError(
                self._device, f"lost the line {self._settings.port} ({error}); check the cable"
            ) from None
        raise DeviceConnectionError(
            self._device,
            f"{problem} at {self._settings.port}, address {self._settings.address}, after {1 + _RESENDS} "
            f"requests; check power, cable, address and speed ({self._settings.baudrate} Bd)",
        )

    def _answer(self, head: bytes, crc: bytes, digits: int) -> tuple[str, bytes]:
        """Return what is wrong with the answer, if anything, and its payload."""
        for _ in range(_MOST_STALE_ANSWERS):
            answer = self._read_answer(_ACKNOWLEDGE_LENGTH + digits)
            if answer is None:
                return self._silence, b""
            answer = answer[max(answer.rfind(b"!"), 0) :]
            if answer[:7] != head:
                continue
            content, received_crc = answer[7:-4], answer[-4:]
            # An acknowledge carries the CRC of the request.
            expected_crc = b"%04X" % crc_hqx(answer[:-4], 0) if content else crc
            if received_crc != expected_crc:
                return "damaged answer", b""
            if content[:1] == b"+" and len(content) == 3 and content[1:].isdigit():
                return "refused", content
            if len(content) != digits:
                return f"answer of {len(content)} instead of {digits} characters", b""
            return "", content
        return "only late or damaged answers", b""

    def _read_answer(self, length: int) -> bytes | None:
        """Read up to the next carriage return, without waiting for more than the shortest answer has."""
        received = self._received
        while (end := received.find(b"\r")) < 0:
            if len(received) < _ACKNOWLEDGE_LENGTH:
                missing = _ACKNOWLEDGE_LENGTH - len(received)
            elif received[7:8] == b"+" and len(received) < _ERROR_LENGTH:
                missing = _ERROR_LENGTH - len(received)
            else:
                missing = max(length - len(received), 1)
            chunk = self._port.read(missing)
            received += chunk
            if len(chunk) < missing and b"\r" not in chunk:
                # What came is kept: the rest of a slow answer may still follow.
                return None
            if len(received) > _LONGEST_NONSENSE:
                received.clear()
                return b""
        answer = bytes(received[:end])
        del received[: end + 1]
        return answer


def _encode(parameter: _Parameter, value: float) -> str:
    """Return a value as 8 hex digits: IEEE 754 single precision, or two's complement."""
    if parameter.real:
        return struct.pack(">f", value).hex().upper()
    return f"{int(value) & 0xFFFFFFFF:08X}"


def _decode(device: str, parameter: _Parameter, digits: str) -> float:
    try:
        value: float = struct.unpack(">f" if parameter.real else ">i", bytes.fromhex(digits))[0]
    except (ValueError, struct.error):
        raise DeviceError(
            device, f"answered {digits!r} for its {parameter.title} (parameter {parameter.number})"
        ) from None
    return value


def _single(value: float) -> float:
    """Return a value as single precision has it."""
    return float(struct.unpack(">f", struct.pack(">f", value))[0])
