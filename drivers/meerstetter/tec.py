"""The Meerstetter TEC controllers (TEC-1089, TEC-1091 and their family).

Sources: Meerstetter 5136AL (TEC controller communication protocol: parameters and commands); Meerstetter 5216G
(TEC-family user manual: table 32, communication watchdog); release notes of firmware 6.32 (the family).

The driver writes to the device's RAM only: saving to the flash is switched off first (parameter 108), as the
flash endures about 100 000 writes, and set-points go to the live parameters (50000 and up), which are zero again
after each reset. The error thresholds of object and sink temperature (4010 to 4012, 5010 to 5012), the sensor and
the PID set-up are left as the bench builder set them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum
from functools import partial
from typing import ClassVar

from pydantic import Field, field_validator

from bench.base import (
    Clock,
    ConfigurationError,
    DeviceConnectionError,
    DeviceError,
    DeviceRestartedError,
    WatchdogError,
)
from bench.devices import CheckFinding, Identity, Limits, Status, TECAmplifier, TECMode
from drivers.device import STATUS_AGE, RecoverableDevice, attempt, watchdog_field
from drivers.meerstetter.device_errors import DEVICE_ERRORS, UNKNOWN_ERROR
from drivers.meerstetter.mecom import (
    Block,
    Parameter,
    RefusedError,
    TECLine,
    TECLineSettings,
    decode,
    encode,
    selector,
    single,
)

_START_TIMEOUT = 5.0
_RESET_DELAY = 0.3  # the device restarts 0.2 s after the command
_LOOKS, _LOOK_INTERVAL = (
    10,
    0.02,
)  # how often, and every how many s, the output is looked for after it was switched on
_BLOCK = 5  # parameters read at once, as many as a measurement has
_OUT_OF_RANGE = 7

_OFF, _STATIC_ON, _LIVE_ENABLE = 0, 1, 2  # values of the output stage enable
_LIVE_INPUT, _CONTROLLER_INPUT = 1, 2  # values of the output stage input selection
_STABLE = 2  # value of "temperature is stable"

FAMILY = frozenset({1089, 1090, 1091, 1092, 1122, 1123, 1161, 1162, 1163, 1166, 1167})
"""Device types (parameter 100) that count as TEC controllers: one firmware serves them all."""


class _State(IntEnum):
    """Values of the device status, parameter 104."""

    INIT = 0
    READY = 1
    RUN = 2
    ERROR = 3
    BOOTLOADER = 4
    RESET_PENDING = 5


_STATES = {int(state): state for state in _State}
"""States by their value, sooner than by the class."""

_RUNNING = f"{_State.RUN:08X}"
"""The status of an output that is on, in the digits of an answer."""


_DEVICE_TYPE = Parameter(100, "device type", of_channel=False)
_SERIAL_NUMBER = Parameter(102, "serial number", of_channel=False)
_FIRMWARE = Parameter(103, "firmware version", of_channel=False)
_STATUS = Parameter(104, "device status", of_channel=False)
_ERROR_NUMBER = Parameter(105, "error number", of_channel=False)
_ERROR_INSTANCE = Parameter(106, "error instance", of_channel=False)
_ERROR_PARAMETER = Parameter(107, "error parameter", of_channel=False)
_SAVING_OFF = Parameter(108, "saving to flash off", of_channel=False)
_OBJECT_TEMPERATURE = Parameter(1000, "object temperature", real=True)
_SINK_TEMPERATURE = Parameter(1001, "sink temperature", real=True)
_CURRENT = Parameter(1020, "output current", real=True)
_VOLTAGE = Parameter(1021, "output voltage", real=True)
_SUPPLY_VOLTAGE = Parameter(1060, "driver input voltage", real=True, of_channel=False)
_BASE_TEMPERATURE = Parameter(1063, "base plate temperature", real=True, of_channel=False)
_STABILITY = Parameter(1200, "temperature is stable")
_INPUT = Parameter(2000, "output stage input selection")
_ENABLE = Parameter(2010, "output stage enable")
_CURRENT_LIMIT = Parameter(2030, "current limitation", real=True)
_VOLTAGE_LIMIT = Parameter(2031, "voltage limitation", real=True)
_WATCHDOG_EXPIRED = 183  # error number
_WATCHDOG = Parameter(2060, "communication watchdog", real=True, of_channel=False)
_TARGET = Parameter(3000, "target object temperature", real=True)
_POLARITY = Parameter(3034, "positive current heats")
_LOWEST_OBJECT = Parameter(4010, "lower error threshold of the object temperature", real=True)
_HIGHEST_OBJECT = Parameter(4011, "upper error threshold of the object temperature", real=True)
_STABLE_WINDOW = Parameter(4040, "temperature window of stability", real=True)
_STABLE_TIME = Parameter(4041, "minimum time in the window of stability", real=True)
_HIGHEST_SINK = Parameter(5011, "upper error threshold of the sink temperature", real=True)
_RESTART_DELAY = Parameter(6310, "delay till restart", real=True, of_channel=False)
_LIVE_ENABLED = Parameter(50000, "live enable")
_LIVE_CURRENT = Parameter(50001, "live current", real=True)
_LIVE_VOLTAGE = Parameter(50002, "live voltage", real=True)
_LIVE_TARGET_SELECTED = Parameter(50011, "live target selected")
_LIVE_TARGET = Parameter(50012, "live target object temperature", real=True)


class TECSettings(TECLineSettings):
    """Rig-file settings of a Meerstetter TEC controller."""

    channel: int = Field(default=1, ge=1, le=4, description="output channel, 1 to 4")
    mode: TECMode = Field(default=TECMode.TEMPERATURE, description="what is held constant: temperature or current")
    temperature_limits: tuple[float, float] = Field(
        description="lowest and highest temperature set-point, °C, within -100 to 200"
    )
    current_limit: float = Field(
        gt=0.0, le=10.0, description="highest current of either sign, A; a TEC-1091 gives 4, a TEC-1089 10"
    )
    voltage_limit: float = Field(gt=0.0, le=21.0, description="highest voltage of either sign, V")
    watchdog: float = watchdog_field(5.0, 600.0, "the device switches its output off, s: 0.1 to 600, 0 for never")
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


class MeerstetterTEC(RecoverableDevice[TECSettings, TECLine], TECAmplifier):
    """A Meerstetter TEC controller as a current source or as a temperature controller.

    `connect` leaves the output off. A device in its error state is refused; `recover` resets it. A value of the
    settings that the device does not allow is refused before anything is written.

    While the output is on, the device watches its host (`watchdog` of the settings, 5 s by default): if the host is
    silent for that long, the device switches its output off by itself and stays in error 183, as the automatic
    restart after an error (6310) is switched off. Any valid package feeds the watchdog, a reading as well as a write;
    so ask for a reading (`glance`) more often than that while a set-point is held: the longest pause between two
    ticks of the bench is 2 s, hence the default. The watchdog is armed just before the output is switched on and
    disarmed once it is confirmed to be off, so that a device at rest does not end in an error.

    A measurement is one request for all its values and the status (`?VX`), so that they are of one instant. A device
    whose firmware does not know it is asked for one value after the other; `connect` finds out which.

    The limits are in the RAM of the device, and a restart loses them. It brings "saving to flash off" back, which is
    read before the output is switched on, and where a status is not the expected one. So a restart is found by the
    status in the next measurement, as the output is off after it, and before the output goes on. A device whose
    output would come back by itself (output stage enable "static on") is refused. No restart fits between the
    requests that switch on without one of them staying unanswered: after one that did, all settings are read back
    before the last step and after it.

    An output that another program has switched is an error at the next measurement. A set-point or a limit that it
    has changed is found by `reconnect` only, as each parameter more would lengthen each measurement.

    The device reports current and voltage by its own sign; whether a positive current heats is parameter
    3034, which the driver reads once and takes into account, as the role counts heating as positive. That
    it applies to the live current in the same way is an assumption.
    """

    Settings: ClassVar[type[TECSettings]] = TECSettings

    def __init__(self, name: str, settings: TECSettings, clock: Clock, line: TECLine) -> None:
        super().__init__(name, settings, clock, line)
        self._mode = settings.mode
        self._polarity: int
        """1 if a positive current heats, else -1; known from `connect` on, as the next two."""
        self._on: bool
        """Whether the driver has switched the output on."""
        self._looked = -math.inf
        """When `set` has last looked at the status of an output that is on, s."""
        self._reads_blocks: bool
        self._restarted = False
        self._configured: dict[Parameter, float] = {}
        """What the parameters are that `connect` has written, and a change of the mode."""
        self._sent_in_vain = False
        self._measured = Block(settings.channel, _OBJECT_TEMPERATURE, _SINK_TEMPERATURE, _CURRENT, _VOLTAGE, _STATUS)
        self._names = tuple(signal.name for signal in self.signals)
        self._sent = Status.completed(name, clock)
        self._limits = self._limits_of(settings.mode)

    @classmethod
    def _open_line(cls, name: str, settings: TECSettings, clock: Clock) -> TECLine:  # noqa: ARG003
        return TECLine(name, settings)

    @property
    def mode(self) -> TECMode:
        """What is held constant."""
        return self._mode

    def select_mode(self, mode: TECMode) -> None:
        """Choose what is held constant; a change switches the output off first.

        Raises `DeviceError` if the output does not go off, or the device refuses.
        """
        if mode is self._mode:
            return
        self.safe()
        self._write(_LIVE_CURRENT, 0.0)
        self._configured[_INPUT] = _CONTROLLER_INPUT if mode is TECMode.TEMPERATURE else _LIVE_INPUT
        self._write(_INPUT, self._configured[_INPUT])
        self._mode, self._limits = mode, self._limits_of(mode)
        self._setpoint = math.nan

    @property
    def limits(self) -> Limits:
        """The allowed set-points: the settings' `temperature_limits` in °C, or ± `current_limit` in A."""
        return self._limits

    def _limits_of(self, mode: TECMode) -> Limits:
        if mode is TECMode.TEMPERATURE:
            return Limits(*self._settings.temperature_limits, "°C")
        return Limits(-self._settings.current_limit, self._settings.current_limit, "A")

    def set(self, value: float) -> Status:
        """Control the object temperature in °C or the current in A, by mode; switches the output on if it is off.

        The status completes when the device reports the temperature stable; at once in current mode. That the output
        is still on is looked at before, in current mode every 0.1 s, as a fast loop sets more often.
        """
        limits = self._limits
        if not limits.low <= value <= limits.high:
            self.check(value)
        if not self._on:
            self._check_restart()
        elif self._mode is TECMode.TEMPERATURE or self._clock.now() - self._looked >= STATUS_AGE:
            status = self._ask("?VR", _STATUS, 8)
            if status != _RUNNING:
                self._check_output(decode(self.name, _STATUS, status))
            self._looked = self._clock.now()
        repeats = self._line.repeats
        # Whether the device has taken one that it does not acknowledge is not known.
        self._sent_in_vain = True
        if self._mode is TECMode.TEMPERATURE:
            self._write(_LIVE_TARGET, value)
        else:
            self._write(_LIVE_CURRENT, self._polarity * value)
        self._sent_in_vain = False
        self._setpoint = value
        if not self._on:
            self._switch_on(repeats)
        elif self._line.repeats != repeats:
            self._check_output(self._read(_STATUS))
        if self._mode is TECMode.CURRENT:
            return self._sent
        timeout = self._settings.stable_timeout
        return Status(self.name, self._clock, lambda: self._arrived(value), timeout=timeout)

    @property
    def watchdog(self) -> float | None:
        """Silence of the host, s, after which the device switches its output off; None if it never does."""
        return self._settings.watchdog or None

    @property
    def output_enabled(self) -> bool:
        """Whether the output stage is on, as the device reports now."""
        return self._state() is _State.RUN

    def measure(self) -> dict[str, float]:
        """Measure object and sink temperature (°C), current (A, positive heats) and voltage (V)."""
        # The status comes last: an error that comes up while the values are read invalidates them, too.
        measured, sink, current, voltage, status = self._read_block(self._measured)
        self._check_output(status)
        values = (measured, sink, self._polarity * current, self._polarity * voltage)
        if not all(map(math.isfinite, values)):
            raise DeviceError(self.name, "reports a value that is not a number; check the sensors")
        return dict(zip(self._names, values, strict=True))

    def stop(self, success: bool = True) -> None:  # noqa: ARG002 - bluesky's form
        """Hold the present temperature as the set-point; in current mode the current stays as it is."""
        if self._mode is TECMode.CURRENT or self._state() is not _State.RUN:
            return
        limits = self.limits
        present = min(max(self._read(_OBJECT_TEMPERATURE), limits.low), limits.high)
        self._write(_LIVE_TARGET, present)
        self._setpoint = present

    def _make_safe(self) -> None:
        """Switch the output stage off in every possible way, the emergency stop last, and see that it is off."""
        with self._line.in_haste():
            failures = attempt(partial(self._write, _LIVE_ENABLED, _OFF), partial(self._write, _ENABLE, _OFF))
            if failures or not self._is_off():
                refused = attempt(self._stop_at_once)
                failures += refused
                # A line that is dead would not answer either whether the output is off.
                dead = any(isinstance(failure, DeviceConnectionError) for failure in refused)
                if dead or not self._is_off():
                    unconfirmed = self._unconfirmed("output", failures)
                    if dead:
                        # Another line is tried then.
                        raise DeviceConnectionError(self.name, unconfirmed.text)
                    raise unconfirmed
            self._on = False
            # The output is off, so whether the watchdog could be disarmed does not matter for safety. A device that
            # has restarted would write it to its flash.
            if not self._restarted:
                with suppress(DeviceError):
                    self._write(_WATCHDOG, 0.0)

    def _stop_at_once(self) -> None:
        try:
            self._line.order("ES")
        except RefusedError as error:
            raise DeviceError(self.name, f"emergency stop: {error}") from None

    def _renew_line(self) -> None:
        before = self._line
        super()._renew_line()
        self._line.follow(before)

    def reset(self) -> None:
        """Restart the device and configure it again: clears an error whose cause is gone. The output is off.

        Raises `DeviceError` if the device does not come back within 5 s, or comes back with an error.
        """
        # The acknowledge may be lost in the restart; whether the device comes back is what counts.
        with suppress(DeviceConnectionError, RefusedError):
            self._line.order("RS", resends=0)
        self._clock.sleep(_RESET_DELAY)
        self._start()

    def _identify(self) -> Identity:
        device_type = int(self._read(_DEVICE_TYPE))
        if device_type not in FAMILY:
            try:
                described = f"device type {device_type}, {self._line.ask('?IF', 20).strip()}"
            except RefusedError:
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

    def _start(self) -> None:
        self._wait_until(lambda: self._state() not in (_State.INIT, _State.RESET_PENDING), _START_TIMEOUT)
        self._check()
        self._choose_reading()
        self._configure()

    def _restart(self) -> None:
        self.reset()

    def _choose_reading(self) -> None:
        """Find out whether the device reads several parameters at once, and whether it has the channel."""
        block = Block(self._settings.channel, _SINK_TEMPERATURE, _STATUS)
        try:
            self._line.ask(block.request, block.digits)
        except RefusedError:
            self._reads_blocks = False
        else:
            self._reads_blocks = True
        sink, enable = self._read_block(Block(self._settings.channel, _SINK_TEMPERATURE, _ENABLE))
        if math.isnan(sink):
            channel = self._settings.channel
            raise DeviceError(
                self.name,
                f"channel {channel} reports no sink temperature: the {self._identity.model} has no such channel, or "
                "its sink sensor is missing; check `channel` and the sensor",
            )
        if enable == _STATIC_ON:
            raise DeviceError(
                self.name,
                f"its output stage enable (parameter {_ENABLE.number}) is static on, with which a restart may bring "
                "the output back without its limits; save it as static off with the maker's service software",
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
            self._check_allowed(key, parameter, value)
        self._polarity = 1 if self._read(_POLARITY) else -1
        # No automatic restart after an error: what tripped stays off until the operator has looked.
        self._configured = {
            _SAVING_OFF: 1,
            _INPUT: _CONTROLLER_INPUT if self._mode is TECMode.TEMPERATURE else _LIVE_INPUT,
            _CURRENT_LIMIT: settings.current_limit,
            _VOLTAGE_LIMIT: settings.voltage_limit,
            _STABLE_WINDOW: settings.stable_window,
            _STABLE_TIME: settings.stable_time,
            _RESTART_DELAY: 0.0,
        }
        self._write(_SAVING_OFF, 1)
        self._write(_LIVE_ENABLED, _OFF)
        self._write(_ENABLE, _OFF)
        self._write(_LIVE_CURRENT, 0.0)
        for parameter, value in self._configured.items():
            if parameter is not _SAVING_OFF:
                self._write(parameter, value)
        self._write(_WATCHDOG, 0.0)
        self._on = self._restarted = False
        self._setpoint = math.nan

    def _check_allowed(self, key: str, parameter: Parameter, value: float) -> None:
        lowest, highest = self._range(parameter)
        if not lowest <= single(value) <= highest:
            raise ConfigurationError(
                f"{self.name}: {key}: {value:g} is outside of what the {self._identity.model} allows, "
                f"{lowest:g} to {highest:g}"
            )

    def _switch_on(self, repeats: int) -> None:
        """Switch the output on; `repeats` is the number before the first request that belongs to it."""
        for parameter, value in self._output_settings().items():
            # The set-point has been sent already.
            if parameter not in (_LIVE_TARGET, _LIVE_CURRENT):
                self._write(parameter, value)
        # A device that restarts from here on is not enabled by the last step alone.
        if self._line.repeats != repeats:
            self._check_settings(self._configured | self._output_settings())
        try:
            self._write(_LIVE_ENABLED, 1)
            self._on = True
            for _ in range(_LOOKS):
                if self._check() is _State.RUN:
                    break
                self._clock.sleep(_LOOK_INTERVAL)
            else:
                self._check_output(self._read(_STATUS))
            if self._line.repeats != repeats:
                self._check_unchanged()
        except BaseException:
            attempt(partial(self._write, _LIVE_ENABLED, _OFF), partial(self._write, _ENABLE, _OFF))
            raise

    def _output_settings(self) -> dict[Parameter, float]:
        """Return what the parameters are while the output is on, beside those that are configured."""
        settings: dict[Parameter, float] = (
            {_LIVE_TARGET: self._setpoint, _LIVE_TARGET_SELECTED: 1}
            if self._mode is TECMode.TEMPERATURE
            else {_LIVE_CURRENT: self._polarity * self._setpoint, _LIVE_VOLTAGE: self._settings.voltage_limit}
        )
        return settings | {_WATCHDOG: self._settings.watchdog, _ENABLE: _LIVE_ENABLE}

    def _check_unchanged(self) -> None:
        """Raise `DeviceError` unless the device is as the driver left it: not restarted, without an error."""
        expected = self._configured | (self._output_settings() if self._on else {})
        if self._sent_in_vain:
            expected.pop(_LIVE_TARGET if self._mode is TECMode.TEMPERATURE else _LIVE_CURRENT, None)
        self._check_settings(expected)
        self._check_output(self._read(_STATUS))

    def _check_settings(self, expected: Mapping[Parameter, float]) -> None:
        """Raise `DeviceError` if a parameter differs."""
        parameters = list(expected)
        for first in range(0, len(parameters), _BLOCK):
            block = Block(self._settings.channel, *parameters[first : first + _BLOCK])
            for parameter, found in zip(block.parameters, self._read_block(block), strict=True):
                if found != (single(expected[parameter]) if parameter.real else expected[parameter]):
                    self._check_restart()
                    raise DeviceError(
                        self.name,
                        f"its {parameter.title} (parameter {parameter.number}) is {found:g} where "
                        f"{expected[parameter]:g} was written; end the program that changed it, then connect again",
                    )

    def _check_restart(self) -> None:
        """Raise `DeviceRestartedError` if the device saves to its flash again, as it does after each restart."""
        self._restarted = self._restarted or not self._read(_SAVING_OFF)
        if self._restarted:
            raise DeviceRestartedError(
                self.name,
                f"the {self._identity.model} has restarted, and its limits and settings are lost; find out why its "
                "power failed, then connect again",
            )

    def _check_output(self, status: float) -> None:
        """Raise what is wrong with a device status, also if the output is on that was off, or off that was on."""
        running = self._judge(status) is _State.RUN
        if running is self._on:
            return
        self._check_restart()
        raise DeviceError(
            self.name,
            f"its output is {'on' if running else 'off'} although it was switched {'on' if self._on else 'off'}; end "
            "the program that has switched it, and bring the device into its safe state",
        )

    def _arrived(self, target: float) -> bool:
        if self._read(_STABILITY) != _STABLE:
            if self._check() is not _State.RUN:
                self._check_restart()
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
        return self._named_state(self._read(_STATUS))

    def _named_state(self, value: float) -> _State:
        state = _STATES.get(int(value))
        if state is None:
            raise DeviceError(self.name, f"reports a device status {value:g} that the protocol lacks")
        return state

    def _check(self) -> _State:
        """Return the state if it is ready or run; raise what is wrong otherwise."""
        return self._judge(self._read(_STATUS))

    def _judge(self, status: float) -> _State:
        """Return the state that a device status means if it is ready or run; raise what is wrong otherwise."""
        state = self._named_state(status)
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
        text, advice = DEVICE_ERRORS.get(number, UNKNOWN_ERROR)
        kind = WatchdogError if number == _WATCHDOG_EXPIRED else DeviceError
        return kind(
            self.name,
            f"error {number} ({text}; instance {instance}, parameter {parameter}): {advice}, "
            f"then clear it by `bench rig clear RIG {self.name}`, or switch the device off and on",
        )

    def _read(self, parameter: Parameter) -> float:
        answer = self._ask("?VR", parameter, 8)
        return decode(self.name, parameter, answer)

    def _read_block(self, block: Block) -> tuple[float, ...]:
        """Read parameters, at once if the device can."""
        if not self._reads_blocks:
            return tuple(self._read(parameter) for parameter in block.parameters)
        try:
            return block.decode(self.name, self._line.ask(block.request, block.digits))
        except RefusedError as error:
            titles = ", ".join(parameter.title for parameter in block.parameters)
            raise DeviceError(self.name, f"refused to report its {titles}: {error}") from None

    def _range(self, parameter: Parameter) -> tuple[float, float]:
        answer = self._ask("?VL", parameter, 18)
        return decode(self.name, parameter, answer[2:10]), decode(self.name, parameter, answer[10:])

    def _ask(self, command: str, parameter: Parameter, digits: int) -> str:
        try:
            return self._line.ask(command + selector(parameter, self._settings.channel), digits)
        except RefusedError as error:
            raise DeviceError(
                self.name, f"refused to report its {parameter.title} (parameter {parameter.number}): {error}"
            ) from None

    def _write(self, parameter: Parameter, value: float) -> None:
        try:
            self._line.order(f"VS{selector(parameter, self._settings.channel)}{encode(parameter, value)}")
        except RefusedError as error:
            allowed = ""
            if error.code == _OUT_OF_RANGE:
                lowest, highest = self._range(parameter)
                allowed = f"; allowed are {lowest:g} to {highest:g}"
            raise DeviceError(
                self.name,
                f"refused {value:g} as its {parameter.title} (parameter {parameter.number}): {error}{allowed}",
            ) from None

    def self_check(self) -> tuple[CheckFinding, ...]:
        """Compare limits with the settings, and temperature limits with the device's error thresholds.

        Raises DeviceError if the device does not answer.
        """
        settings = self._settings
        findings = []
        for key, parameter, wanted, unit in (
            ("current_limit", _CURRENT_LIMIT, settings.current_limit, "A"),
            ("voltage_limit", _VOLTAGE_LIMIT, settings.voltage_limit, "V"),
        ):
            found = self._read(parameter)
            advice = "" if found == single(wanted) else f"another program changed it from {wanted:g} {unit}; end that"
            findings.append(CheckFinding(key, f"{found:g} {unit} in the device", advice))
        lowest, highest = self._read(_LOWEST_OBJECT), self._read(_HIGHEST_OBJECT)
        low, high = settings.temperature_limits
        advice = ""
        if self._mode is TECMode.TEMPERATURE and not lowest <= low <= high <= highest:
            advice = f"set temperature_limits, {low:g} to {high:g} °C, within the thresholds of errors 137 and 138"
        text = f"{lowest:g} to {highest:g} °C of the object, up to {self._read(_HIGHEST_SINK):g} °C of the sink"
        findings.append(CheckFinding("error thresholds", text, advice))
        text = f"{self._read(_SUPPLY_VOLTAGE):.3g} V, base plate {self._read(_BASE_TEMPERATURE):.3g} °C"
        return (*findings, CheckFinding("power supply", text))
