"""Emulated Meerstetter TEC-1091: a thermoelectric cooler's amplifier and temperature controller.

The instrument is its parameter table, its state machine and its protections; the plant behind it is the
physics. Sources: Meerstetter 5216G (TEC-family user manual) for the error numbers and the communication watchdog,
which any valid package feeds (table 32); Meerstetter 5136AL for the live parameters (50000 and up), which a reset
alone brings back to zero, so that an error that resets itself (6310) brings the output back as it was; the output of
JulienKluge/pyMeComTEC with a TEC-1091 for the channel that is not there and for the parameter that an emergency
stop names.

Assumptions, where these are silent:

- A package to another address does not feed the watchdog. When it expires the output goes off at that instant.
- A channel that is not there keeps what is written to it; its measured temperatures are not a number, its other
  readings zero.
- Initialising takes no time: after a reset the device is ready at once, and 6310 counts at once, not 20 s later.
- `Output stage enable` 3 (hardware enable) leaves the output off: nothing is wired to the input.
- The stability window (4040) is the allowed distance to either side of the target.
- The first error stays until a reset; a later one does not replace it.

Kept in the table without effect: the temperature ramp (3003, so 1011 is the target itself), the proximity
width and the PID parameters (3002, 3010 to 3013: the closed loop belongs to the plant), the operating mode
(2040), baud rate and response delay (2050, 2052), the digital lines (6100 to 6103, 52100 to 52103), the source of the
object temperature (6300, 6302, 52200), and the voltage limitation (2031), as the plants take a current. The error
thresholds of current and voltage act.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np

from bench.base import DeviceError
from bench.devices import Identity, Limits, Status, TECAmplifier, TECMode
from sim_devices.instruments.emulated import EmulatedInstrument, FreezingReadings, RequestRefusedError
from sim_devices.instruments.meerstetter_table import (
    CONTROLLER,
    ENABLE_LIVE,
    ENABLE_OFF,
    ENABLE_ON,
    LIVE,
    PARAMETERS,
    SENSOR_READINGS,
    DeviceStatus,
    Parameter,
    ServerError,
    find_parameter,
    stored,
)
from sim_devices.world import World

RESET_DELAY = 0.2
"""Seconds from the reset command to the restart (Meerstetter 5136, set commands)."""

SUPERVISION_INTERVAL = 0.25
"""Seconds between two checks of the protections while the output is on; a real device checks faster."""

OBJECT_NOISE = 0.002
"""Standard deviation of the object temperature reading, K."""

SUPPLY_VOLTAGE = 24.0
"""Input voltage, V; the output stage saturates there."""

_READY, _RUN = DeviceStatus.READY, DeviceStatus.RUN  # sooner than by the class
_OBJECT_RESOLUTION = 128.0 / 2**23  # K: a converter of 23 bits, with the range of an NTC set-up
_SINK_RESOLUTION = 128.0 / 2**12  # K: 12 bits
_OUTPUT_RESOLUTION = 1e-3  # A and V
_DEVICE_TEMPERATURE = 35.0
_IDENTIFICATION = "8065-TEC SW G01     "  # of the firmware, which the whole family shares (Meerstetter 5117C)
_STOP_PARAMETER = 464  # which error 11 names
_DEVICE_TYPE = 1091
_HARDWARE_VERSION = 120


class PeltierLoad(Protocol):
    """The load of the output stage; a positive current heats the plate."""

    @property
    def plate_temperature(self) -> float:
        """Temperature of the plate with the object sensor, °C."""

    @property
    def sink_temperature(self) -> float:
        """Temperature of the heat sink, °C."""

    @property
    def current(self) -> float:
        """Peltier current, A."""

    @property
    def voltage(self) -> float:
        """Voltage across the Peltier element, V."""

    def terminals(self) -> tuple[float, float, float, float]:
        """Return the temperatures of plate and sink (°C), current (A) and voltage (V) of this instant, at once."""

    def regulate(self, target_celsius: float, current_limit: float = math.inf) -> None:
        """Close the temperature loop, with a current of at most `current_limit` A of either sign."""

    def drive(self, current_ampere: float) -> None:
        """Drive a constant current."""

    def release(self) -> None:
        """Switch the output off."""


class EmulatedTEC(FreezingReadings, EmulatedInstrument, TECAmplifier):
    """One TEC-1091 with its Peltier element, as the parameter table and as the role of a TEC amplifier.

    Parameters
    ----------
    firmware : int
        Firmware version times 100 that the device reports.
    rng : numpy.random.Generator, optional
        Noise of the object temperature; without it the readings are free of noise.
    """

    MEASURED = (1000, 1001, 1020, 1021)

    def __init__(
        self,
        name: str,
        world: World,
        load: PeltierLoad,
        *,
        serial_number: int = 1091_0042,
        firmware: int = 410,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(name, world, rng)
        self._load = load
        self._firmware = firmware
        self.serial_number = serial_number
        self._saved = {
            _key(number, instance): stored(row, row.default)
            for number, row in PARAMETERS.items()
            for instance in range(1, row.instances + 1)
        }
        self._values = dict(self._saved)
        self._values |= {100: _DEVICE_TYPE, 101: _HARDWARE_VERSION, 103: firmware}
        self._readings: dict[int, Callable[..., Any]] = {
            104: lambda: self._status,
            102: lambda: self.serial_number,
            105: lambda: self._error,
            106: lambda: self._error_instance,
            107: lambda: self._error_parameter,
            109: lambda: 2 if self._values[108] else 0,
            1000: self._object_temperature,
            1001: lambda: _rounded(self._load.sink_temperature, _SINK_RESOLUTION),
            1010: self._target,
            1011: self._target,
            1020: lambda: self._polarity * _rounded(self._load.current, _OUTPUT_RESOLUTION),
            1021: lambda: self._polarity * _rounded(self._load.voltage, _OUTPUT_RESOLUTION),
            1060: lambda: SUPPLY_VOLTAGE,
            1063: lambda: _DEVICE_TEMPERATURE,
            1200: self._stability,
        }
        self.flash_writes = 0
        """How many parameters were written to the flash; a real one endures about 100 000."""
        self._status = DeviceStatus.READY
        self._error = self._error_instance = self._error_parameter = 0
        self._output: tuple[str, float, float] | None = None
        self._watchdog_due = self._restart_due = self._recovery_due = self._supervision_due = math.inf
        self._supervised_at = world.time
        self._last_object, self._last_sink = load.plate_temperature, load.sink_temperature
        self._started_at = self._in_window_since = self._saturated_since = math.nan
        self._announce = world.add(self, announces=True)

    # Parameters and commands.

    @property
    def address(self) -> int:
        """The device address, 1 to 254 (parameter 2051)."""
        return int(self._values[2051])

    @property
    def identification(self) -> str:
        """The identification string, 20 characters."""
        return _IDENTIFICATION

    @property
    def status(self) -> DeviceStatus:
        """The state of the device at the clock's present time; does not feed the watchdog."""
        with self.world.at_present():
            return self._status

    def attend(self) -> None:
        """Come up to the clock's present time and feed the watchdog: a valid package has arrived."""
        with self.world.lock:
            self.attend_locked()

    def attend_locked(self) -> None:
        """Do as `attend`; the caller holds the world's lock."""
        world = self.world
        world.advance_locked()
        now = world.time
        if now > self._supervised_at:
            self._supervise(now)
        self._feed(now)

    def read_parameter(self, number: int, instance: int = 1) -> float:
        """Return the value of a parameter, in the unit of the table, as one request would.

        Raises `RequestRefusedError` if there is no such parameter or instance.
        """
        with self.world.lock:
            row = find_parameter(number, instance)
            self.attend()
            return stored(row, self.value(number, instance))

    def write_parameter(self, number: int, value: float, instance: int = 1) -> None:
        """Set a parameter as one request would; it goes to the flash as well unless saving is off (parameter 108).

        Raises `RequestRefusedError` if there is no such parameter or instance, it is read-only, or the value is out
        of its range.
        """
        with self.world.lock:
            row = find_parameter(number, instance)
            self.attend()
            self.assign(row, value, instance)

    def value(self, number: int, instance: int = 1) -> float:
        """Return the value of a parameter that exists, after `attend`; not yet in the precision of the table."""
        if instance == 1:
            reading = self._readings.get(number)
            return self._values[number] if reading is None else reading()
        return math.nan if number in SENSOR_READINGS else self._values[_key(number, instance)]

    def assign(self, row: Parameter, value: float, instance: int = 1) -> None:
        """Set a parameter that exists, after `attend`; raises `RequestRefusedError` as `write_parameter` does."""
        number = row.number
        if not row.writable:
            raise RequestRefusedError(ServerError.READ_ONLY)
        kept = stored(row, value)
        low, high = _stored_bounds(number)
        if not low <= kept <= high or (number == 2060 and 0.0 < value < 0.1):
            raise RequestRefusedError(ServerError.OUT_OF_RANGE)
        key = _key(number, instance)
        self._values[key] = kept
        if not row.volatile and not self._values[108]:
            self._save(key)
        if number == 2060:
            self._feed(self.world.time)
        self._apply()

    def save(self) -> None:
        """Write what differs from the flash to it, also where saving is off (command `SP`)."""
        with self.world.lock:
            self.attend()
            for number, row in PARAMETERS.items():
                if row.writable and not row.volatile:
                    for key in (_key(number, instance) for instance in range(1, row.instances + 1)):
                        if self._values[key] != self._saved[key]:
                            self._save(key)

    def emergency_stop(self) -> None:
        """Switch the output off and stay in error 11 (command `ES`)."""
        with self.world.lock:
            self.attend()
            self._trip(11, _STOP_PARAMETER)

    def reset(self) -> None:
        """Restart from the flash after 0.2 s (command `RS`); the output goes off at once."""
        with self.world.lock:
            self.attend()
            self._shut_down()
            self._restart_due = self.world.time + RESET_DELAY
            self._announce(self._restart_due)

    # Faults.

    @property
    def identity(self) -> Identity:
        """Maker, model, serial number and firmware."""
        firmware = f"{self._firmware / 100:.2f}"
        return Identity("Meerstetter Engineering", f"TEC-{_DEVICE_TYPE}", str(self.serial_number), firmware)

    def power_cycle(self) -> None:
        """Switch the supply off and on again: what is in RAM is lost, what is in the flash stays."""
        with self.world.at_present():
            self._shut_down()
            self._restart()

    def trip(self, error_number: int) -> None:
        """Put the device into its error state; parameter 105 reports the number, such as 138."""
        with self.world.at_present():
            self._trip(error_number)

    # Timed events.

    def deadline(self) -> float:
        """Return when the watchdog, a restart, the reset of an error or a check of the protections is due (s)."""
        # Plain comparisons: this is asked with each sample of a fast loop.
        due = self._supervision_due
        if self._watchdog_due < due:
            due = self._watchdog_due
        if self._restart_due < due:
            due = self._restart_due
        if self._recovery_due < due:
            due = self._recovery_due
        return due

    def expire(self) -> None:
        """Carry out what is due."""
        now = self.world.time
        if now >= self._watchdog_due:
            self._watchdog_due = math.inf
            self._trip(183, 2060)
        if now >= self._restart_due:
            self._restart()
        if now >= self._recovery_due:
            self._recover()
        if now >= self._supervision_due:
            self._supervision_due = now + SUPERVISION_INTERVAL
            self._supervise(now)

    # The role of a TEC amplifier.

    @property
    def mode(self) -> TECMode:
        """The quantity that is held constant (parameter 2000)."""
        return TECMode.TEMPERATURE if self._values[2000] == CONTROLLER else TECMode.CURRENT

    def select_mode(self, mode: TECMode) -> None:
        """Choose the quantity that is held constant; a change switches the output off."""
        with self._request():
            if mode is not self.mode:
                for number in (50000, 2010, 50001):
                    self.write_parameter(number, 0)
                self.write_parameter(2000, CONTROLLER if mode is TECMode.TEMPERATURE else LIVE)
                self._setpoint = math.nan

    @property
    def limits(self) -> Limits:
        """The object temperature's error thresholds in °C, or the current limitation in A."""
        if self.mode is TECMode.TEMPERATURE:
            return Limits(self._values[4010], self._values[4011], "°C")
        return Limits(-self._values[2030], self._values[2030], "A")

    def set(self, value: float) -> Status:
        """Send a set-point in °C or A, and switch the output on if it is off."""
        self.check(value)
        with self._request():
            self._refuse_fault()
            if self.mode is TECMode.TEMPERATURE:
                self.write_parameter(50012, value)
                self.write_parameter(50011, 1)
            else:
                self.write_parameter(50001, self._polarity * value)
            self.write_parameter(2010, ENABLE_LIVE)
            self.write_parameter(50000, 1)
            self._setpoint = value
            self._refuse_fault()
        if self.mode is TECMode.CURRENT:
            return Status.completed(self.name, self._clock)
        return Status(self.name, self._clock, self._arrived, timeout=300.0)

    @property
    def output_enabled(self) -> bool:
        """Whether the output stage is on."""
        with self._request():
            return self._status is DeviceStatus.RUN

    def measure(self) -> dict[str, float]:
        """Measure object and sink temperature in °C, current in A and voltage in V."""
        with self._request():
            self._refuse_fault()
            return {
                f"{self.name}_temperature": self._read(1000),
                f"{self.name}_sink_temperature": self._read(1001),
                f"{self.name}_current": self._polarity * self._read(1020),
                f"{self.name}_voltage": self._polarity * self._read(1021),
            }

    def stop(self, success: bool = True) -> None:  # noqa: ARG002 - bluesky's form
        """Hold the present temperature; in current mode the current stays as it is."""
        with self._request():
            if self.mode is TECMode.TEMPERATURE and self._status is DeviceStatus.RUN:
                limits = self.limits
                self._setpoint = min(max(self._read(1000), limits.low), limits.high)
                self.write_parameter(50012, self._setpoint)

    def safe(self) -> None:
        """Switch the output stage off."""
        with self._request():
            self.write_parameter(50000, 0)
            self.write_parameter(2010, ENABLE_OFF)

    def _arrived(self) -> bool:
        with self._request():
            self._refuse_fault()
            if self._status is not DeviceStatus.RUN:
                raise DeviceError(self.name, "the output was switched off before the temperature was reached")
            return self._read(1200) == 2

    def _refuse_fault(self) -> None:
        if self._status is DeviceStatus.ERROR:
            raise DeviceError(self.name, f"error {self._error} (parameter {self._error_parameter}); reset it")
        if self._status not in (DeviceStatus.READY, DeviceStatus.RUN):
            raise DeviceError(self.name, f"not ready: {self._status.name.lower().replace('_', ' ')}")

    # The inner workings. The lock is held and the world stands at the present.

    @property
    def _polarity(self) -> int:
        # Parameter 3034: whether a positive current of the device heats (1) or cools (0) the object.
        return 1 if self._values[3034] else -1

    def _read(self, number: int) -> float:
        return stored(PARAMETERS[number], self.value(number))

    def _save(self, key: int) -> None:
        self._saved[key] = self._values[key]
        self.flash_writes += 1

    def _object_temperature(self) -> float:
        return _rounded(self._load.plate_temperature + self._draw(OBJECT_NOISE), _OBJECT_RESOLUTION)

    def _target(self) -> float:
        return self._values[50012] if self._values[50011] else self._values[3000]

    def _stability(self) -> int:
        if self._status is not DeviceStatus.RUN or self._values[2000] != CONTROLLER:
            return 0
        # A comparison with nan, outside of the window, is false.
        return 2 if self.world.time - self._in_window_since >= self._values[4041] else 1

    def _feed(self, now: float) -> None:
        watchdog, status = self._values[2060], self._status
        due = now + watchdog if watchdog > 0.0 and (status is _RUN or status is _READY) else math.inf
        if due < self._watchdog_due:
            self._announce(due)
        self._watchdog_due = due

    def _trip(self, error_number: int, parameter: int = 0) -> None:
        if self._status not in (DeviceStatus.READY, DeviceStatus.RUN):
            return
        self._status = DeviceStatus.ERROR
        self._error, self._error_instance, self._error_parameter = error_number, 1, parameter
        self._watchdog_due = math.inf
        if self._values[6310] > 0.0:
            # No sooner than a reset: otherwise a cause that stays would trip and restart it within one instant.
            self._recovery_due = self.world.time + max(self._values[6310], RESET_DELAY)
            self._announce(self._recovery_due)
        self._apply()

    def _shut_down(self) -> None:
        self._status = DeviceStatus.RESET_PENDING
        self._watchdog_due = self._recovery_due = math.inf
        self._apply()

    def _restart(self) -> None:
        """Begin with what is in the flash."""
        self._restart_due = math.inf
        writable = {number for number, row in PARAMETERS.items() if row.writable}
        self._values |= {key: value for key, value in self._saved.items() if key & 0xFFFF in writable}
        self._recover()

    def _recover(self) -> None:
        """Clear the error; the output returns if it is still asked for."""
        self._recovery_due = math.inf
        self._error = self._error_instance = self._error_parameter = 0
        self._status = DeviceStatus.READY
        self._feed(self.world.time)
        self._apply()

    def _apply(self) -> None:
        """Bring the output stage into the state that the table asks for."""
        values = self._values
        enable = values[2010]
        wanted = enable == ENABLE_ON or (enable == ENABLE_LIVE and values[50000] == 1)
        on = wanted and (self._status is _RUN or self._status is _READY)
        output: tuple[str, float, float] | None = None
        if on:
            limit = values[2030]
            if values[2000] == CONTROLLER:
                output = ("regulate", self._target(), limit)
            else:
                asked = values[50001] if values[2000] == LIVE else values[2020]
                output = ("drive", self._polarity * min(max(asked, -limit), limit), limit)
        if output == self._output:
            return
        was_on, self._output = self._output is not None, output
        now = self.world.time
        self._in_window_since = math.nan
        self._started_at = now
        if output is None:
            self._load.release()
            self._supervision_due = math.inf
            self._saturated_since = math.nan
            if self._status is DeviceStatus.RUN:
                self._status = DeviceStatus.READY
            return
        kind, value, limit = output
        if kind == "regulate":
            self._load.regulate(value, limit)
        else:
            self._load.drive(value)
        self._status = _RUN
        if not was_on:
            self._supervision_due = now + SUPERVISION_INTERVAL
            self._announce(self._supervision_due)
        self._supervise(now)

    def _supervise(self, now: float) -> None:
        """Check the protections and follow the stability of the temperature."""
        values = self._values
        elapsed = now - self._supervised_at
        plate, sink, current, voltage = self._load.terminals()
        # A slope over less than this would see the steps of the plant's own time grid.
        if elapsed >= 0.5 * SUPERVISION_INTERVAL:
            if abs(plate - self._last_object) > values[4012] * elapsed:
                self._trip(139, 4012)
            if abs(sink - self._last_sink) > values[5012] * elapsed:
                self._trip(144, 5012)
            self._last_object, self._last_sink, self._supervised_at = plate, sink, now
        if plate < values[4010]:
            self._trip(137, 4010)
        elif plate > values[4011]:
            self._trip(138, 4011)
        if sink < values[5010]:
            self._trip(142, 5010)
        elif sink > values[5011]:
            self._trip(143, 5011)
        if self._status is _RUN:
            self._supervise_output(now, plate, current, voltage)

    def _supervise_output(self, now: float, plate: float, current: float, voltage: float) -> None:
        values = self._values
        if abs(current) > values[2032]:
            self._trip(100 if self._polarity * current > 0 else 101, 2032)
        elif abs(voltage) > values[2033]:
            self._trip(104 if self._polarity * voltage > 0 else 105, 2033)
        if abs(voltage) < SUPPLY_VOLTAGE:
            self._saturated_since = math.nan
        elif math.isnan(self._saturated_since):
            self._saturated_since = now
        elif 0 <= values[6320] < 1e3 * (now - self._saturated_since):
            self._trip(108, 6320)
        if values[2000] != CONTROLLER or self._status is not _RUN:
            return
        if abs(plate - self._target()) > values[4040]:
            self._in_window_since = math.nan
        elif math.isnan(self._in_window_since):
            self._in_window_since = now
        late = values[4042] > 0.0 and now - self._started_at > values[4042]
        if late and self._stability() != 2:
            self._trip(182, 4042)


@cache
def _stored_bounds(number: int) -> tuple[float, float]:
    """Return the range of a parameter as the device keeps it."""
    row = PARAMETERS[number]
    return stored(row, row.low), stored(row, row.high)


def _rounded(value: float, resolution: float) -> float:
    return round(value / resolution) * resolution


def _key(number: int, instance: int) -> int:
    """Return where the value of an instance of a parameter is kept; the first one under the number itself."""
    return number | (instance - 1) << 16
