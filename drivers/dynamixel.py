"""Driver of the Dynamixel MX-28 servo with Protocol 2.0 firmware (39 and newer), on a serial bus.

`DynamixelMX28` holds an angle; `DynamixelDrum` is the same servo with a drum on its shaft, and holds the end of
the wire that it winds at a position.

Sources: ROBOTIS e-Manual, Protocol 2.0 (packets, CRC, error numbers) and MX-28(2.0) (control table, units,
hardware errors, bus watchdog).

The servo works in its extended position mode: 4096 counts a turn over ±256 turns. It knows its angle within
one turn only when it is switched on: the number of turns is lost in a power cycle and in a reboot, so the
setting `zero_counts` holds from one switching-on to the next.

The EEPROM wears: the driver writes an item there only if it is not as it has to be, with the torque off. Those
are operating mode, drive mode, return delay time, and the shutdown mask, to which overload, electrical shock
and overheating are added if they are missing. Set-points, profile and bus watchdog live in RAM. Limits of
velocity, acceleration, PWM, temperature and voltage are the bench builder's: the driver leaves them alone, and
so it does the homing offset.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import serial
from pydantic import Field, field_validator, model_validator

from bench.clock import Clock
from bench.devices import DriverSettings, Identity, Limits, LinearStage, Servo, Status
from bench.errors import ConfigurationError, DeviceConnectionError, DeviceError

MODEL_NUMBER = 30
OLDEST_FIRMWARE = 39
COUNTS_PER_TURN = 4096
HIGHEST_GOAL = 1_048_575
"""Largest goal position of either sign, counts."""

_COUNT = 2.0 * math.pi / COUNTS_PER_TURN  # rad
_VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0  # 0.229 rev/min in rad/s
_ACCELERATION_UNIT = 214.577 * 2.0 * math.pi / 3600.0  # 214.577 rev/min² in rad/s²
_WATCHDOG_UNIT = 0.02  # s
_DELAY_UNIT = 2e-6  # s
_WATCHDOG_EXPIRED = 255  # −1 in one byte
_EXTENDED_POSITION_MODE = 4
_REQUIRED_SHUTDOWN = 0b110100  # overload, electrical shock, overheating
_ANSWER_EVERYTHING = 2  # value of the status return level

_RESENDS = 2
_MOST_STRAY_PACKETS = 8
_START_TIMEOUT = 5.0
_START_POLL = 0.1
_REBOOT_DELAY = 0.2
_EMERGENCY_PATIENCE = 1.0  # s for a reboot on the way to the safe state
_STANDSTILL = 1.0  # s beside the goal without a motion that count as blocked
_SUSPICIOUS_SILENCE = 0.8  # share of the watchdog's time

_HEADER = b"\xff\xff\xfd\x00"
_HEAD = 7  # header, id, length
_SHORTEST_ANSWER = 11  # the head, instruction, error, CRC
_SHORTEST_LENGTH, _LONGEST_LENGTH = 3, 256  # bytes after the head; the longest answer has 26
_MOST_NOISE = 1024  # bytes without a packet
_STATUS = 0x55
_PING, _READ, _WRITE, _REBOOT = 0x01, 0x02, 0x03, 0x08
_ALERT = 0x80
_CRC_ERROR, _RANGE_ERROR = 3, 4

_FEEDBACK = struct.Struct("<hii8xHB")  # load, velocity, position, two trajectories, voltage, temperature
_FEEDBACK_ADDRESS = 126
_ARRIVAL = struct.Struct("<B3xhii")  # moving, moving status and PWM, load, velocity, position
_ARRIVAL_ADDRESS = 122


@dataclass
class _Standstill:
    """Since when a servo has stood beside its goal, s; infinity while it moves."""

    since: float = math.inf


@dataclass(frozen=True)
class _Item:
    """An item of the control table."""

    address: int
    size: int
    title: str


_DELAY = _Item(9, 1, "return delay time")
_DRIVE_MODE = _Item(10, 1, "drive mode")
_MODE = _Item(11, 1, "operating mode")
_ACCELERATION_LIMIT = _Item(40, 4, "acceleration limit")
_VELOCITY_LIMIT = _Item(44, 4, "velocity limit")
_SHUTDOWN = _Item(63, 1, "shutdown mask")
_TORQUE = _Item(64, 1, "torque enable")
_RETURN_LEVEL = _Item(68, 1, "status return level")
_HARDWARE_ERROR = _Item(70, 1, "hardware error status")
_WATCHDOG = _Item(98, 1, "bus watchdog")
_GOAL_PWM = _Item(100, 2, "goal PWM")
_PROFILE_ACCELERATION = _Item(108, 4, "profile acceleration")
_PROFILE_VELOCITY = _Item(112, 4, "profile velocity")
_GOAL = _Item(116, 4, "goal position")
_POSITION = _Item(132, 4, "position")
_VOLTAGE = _Item(144, 2, "input voltage")
_TEMPERATURE = _Item(146, 1, "temperature")

STATUS_ERRORS: Mapping[int, str] = {
    1: "it could not process the instruction",
    2: "it does not know the instruction",
    3: "the instruction arrived damaged",
    4: "the value is out of range",
    5: "the length of the data is wrong",
    6: "the value is beyond the limit that is set in the servo",
    7: "the address cannot be accessed: it is read-only, not defined, or locked while the torque is on",
}
"""Why the servo refuses an instruction (ROBOTIS e-Manual, Protocol 2.0, status packet)."""

HARDWARE_ERRORS: Mapping[int, tuple[str, str]] = {
    0: ("input voltage", "check the power supply and its cable; allowed are the voltage limits set in the servo"),
    2: ("overheating", "let it cool down for 20 minutes, and lower the load"),
    3: ("motor encoder", "ask ROBOTIS if it comes again"),
    4: ("electrical shock", "check wiring and earth, and that the supply gives current enough"),
    5: ("overload", "take away what blocks the shaft, or lower the load"),
}
"""What the bits of the hardware error status mean (ROBOTIS e-Manual, MX-28(2.0), shutdown) and what to do."""

_UNKNOWN_ERROR = ("unknown to this driver", "look it up in the manual of the servo")


class ServoSettings(DriverSettings):
    """What a rig file says of any Dynamixel MX-28, whatever it moves."""

    port: str = Field(
        min_length=1, description="line, as pyserial opens it: /dev/ttyUSB0, socket://host:port, emulated://servo"
    )
    id: int = Field(default=1, ge=0, le=252, description="id on the bus, 0 to 252")
    baudrate: int = Field(
        default=57600, ge=9600, le=4_500_000, description="speed of the line, Bd, as set in the servo (register 8)"
    )
    timeout: float = Field(
        default=0.1, gt=0.0, le=10.0, description="wait for an answer, s; a request is sent three times at most"
    )
    return_delay: float = Field(
        default=0.0,
        ge=0.0,
        le=508e-6,
        description="pause of the servo before it answers, s: 0 to 508e-6, steps of 2e-6",
    )
    zero_counts: int = Field(
        default=0, ge=-HIGHEST_GOAL, le=HIGHEST_GOAL, description="where the set-point zero is, counts of 2π/4096"
    )
    direction: Literal[1, -1] = Field(
        default=1,
        description="1 if set-points grow with the counts (counter-clockwise at the horn), -1 if against them",
    )
    profile_velocity: float = Field(
        default=1.0,
        ge=_VELOCITY_UNIT,
        le=1023 * _VELOCITY_UNIT,
        description="highest velocity of a motion, rad/s: 0.024 to 24.5, rounded down to steps of 0.024; at most "
        "the velocity limit that is set in the servo",
    )
    profile_acceleration: float = Field(
        default=2.0,
        ge=_ACCELERATION_UNIT,
        le=32767 * _ACCELERATION_UNIT,
        description="acceleration of a motion, rad/s²: 0.3746 to 12271, rounded down to steps of 0.3746; at most "
        "the acceleration limit that is set in the servo",
    )
    watchdog: float = Field(
        default=2.5,
        ge=0.0,
        le=127 * _WATCHDOG_UNIT,
        description="silence of the host after which the servo stops and holds, s: 0.02 to 2.54 in steps of 0.02, "
        "0 for never; must exceed the longest pause between two readings, which is 2 s in a long hold",
    )
    tolerance: float = Field(
        default=0.01,
        ge=0.5 * _COUNT,
        le=math.pi,
        description="deviation that counts as having arrived, rad: 0.0008 to π; a load holds the shaft off its "
        "goal, by 0.2 rad at full load with the gains as delivered",
    )
    arrival_timeout: float = Field(
        default=5.0, gt=0.0, description="time beyond that of the motion after which it has failed, s"
    )

    @field_validator("watchdog")
    @classmethod
    def _check_watchdog(cls, value: float) -> float:
        if 0.0 < value < _WATCHDOG_UNIT:
            raise ValueError("expected 0.02 to 2.54 s, or 0 for no watchdog")
        return value

    def _check_limits(self, key: str, limits: tuple[float, float], radius: float, unit: str) -> None:
        """Raise `ValueError` unless limits, in a unit of which `radius` are 1 rad, are within the servo's range."""
        low, high = (limit / radius for limit in limits)
        if not low < high:
            raise ValueError(f"{key}: expected the lower limit first")
        ends = sorted(self.direction * (goal - self.zero_counts) * _COUNT for goal in (-HIGHEST_GOAL, HIGHEST_GOAL))
        if low < ends[0] or high > ends[1]:
            raise ValueError(
                f"{key}: {Limits(*limits, unit)} is beyond the range of the servo, which with these zero_counts and "
                f"direction is {Limits(ends[0] * radius, ends[1] * radius, unit)}"
            )


class AngleSettings(ServoSettings):
    """What a rig file says of a Dynamixel MX-28 that holds an angle."""

    position_limits: tuple[float, float] = Field(
        description="lowest and highest angle set-point, rad; both within ±1048575 counts of the servo"
    )

    @model_validator(mode="after")
    def _check_position_limits(self) -> Self:
        self._check_limits("position_limits", self.position_limits, 1.0, "rad")
        return self


class DrumSettings(ServoSettings):
    """What a rig file says of a Dynamixel MX-28 that winds a wire on a drum.

    Profile and tolerance are those of the shaft, in rad; times `drum_radius` they are those of the stage.
    """

    drum_radius: float = Field(
        gt=0.0,
        le=1.0,
        description="distance from the axis to the middle of the wire, which lies in one layer, m: above 0, up to 1; "
        "the stage resolves 2π/4096 rad · drum_radius",
    )
    stage_limits: tuple[float, float] = Field(
        description="lowest and highest position set-point, m; both within ±1048575 counts of the servo, each "
        "2π/4096 rad · drum_radius"
    )

    @model_validator(mode="after")
    def _check_stage_limits(self) -> Self:
        self._check_limits("stage_limits", self.stage_limits, self.drum_radius, "m")
        return self

    @property
    def servo(self) -> AngleSettings:
        """What that means for the servo on whose shaft the drum is; angle = position / `drum_radius`."""
        shared = self.model_dump(include=set(ServoSettings.model_fields))
        low, high = self.stage_limits
        return AngleSettings(**shared, position_limits=(low / self.drum_radius, high / self.drum_radius))


def _angle_text(radians: float) -> str:
    return f"{radians:.4g} rad"


class DynamixelMX28(Servo):
    """A Dynamixel MX-28 in its extended position mode.

    Made by `connect`, which checks and configures the servo and leaves its torque off.

    While the torque is on, the servo watches its host (`watchdog` of the settings, 2.5 s unless told
    otherwise): if no packet comes for that long, it stops where it is, holds, and takes no goals any more. The
    watchdog takes 2.54 s at most, and the longest pause between two ticks of the bench is 2 s, hence the
    default. It is armed just before the torque is switched on. Once it has expired, every reading, every
    set-point and the status of the motion raise; `safe`, `reboot` and `connect` clear it by writing 0 to it.

    A hardware error of the servo (overload, overheating, ...) comes with every answer as its alert bit, and
    is raised with its meaning, voltage and temperature. After a shutdown only `reboot` or a power cycle brings
    the torque back, and both lose the number of turns.

    The first set-point after the torque was off takes the present position as the goal before it switches the
    torque on, so that the shaft does not jump to a goal of before.

    Several servos of one bus may each have a driver on one port, as long as they are called in turn.

    Parameters
    ----------
    name : str
        Name in the rig.
    settings : AngleSettings
        What the rig file says.
    clock : Clock
        The clock of the run.
    line : _Line
        The open line to the servo.
    text : callable
        Tells an angle (rad) in messages, in the unit of whoever reads them.
    """

    Settings: ClassVar[type[AngleSettings]] = AngleSettings

    def __init__(
        self, name: str, settings: AngleSettings, clock: Clock, line: _Line, text: Callable[[float], str]
    ) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._line = line
        self._text = text
        self._setpoint = math.nan
        self._goal = 0
        self._armed = False
        self._expired = False
        self._identity = self._identify()

    @classmethod
    def connect(cls, name: str, settings: AngleSettings, clock: Clock) -> DynamixelMX28:
        """Open the line, check that a healthy MX-28 answers, and configure it; the torque is off then.

        A bus watchdog that has expired, as after a host that died, is cleared.

        Parameters
        ----------
        name : str
            Name in the rig.
        settings : AngleSettings
            What the rig file says.
        clock : Clock
            The clock of the run.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened, nothing answers, or what answers is no MX-28 with firmware 39 or newer.
        DeviceError
            If the servo reports a hardware error; `recover` reboots it.
        ConfigurationError
            If the servo does not allow a value of the settings; nothing was written to its EEPROM then.
        """
        return cls._open(name, settings, clock, reboot=False)

    @classmethod
    def recover(cls, name: str, settings: AngleSettings, clock: Clock) -> DynamixelMX28:
        """Connect to a servo with a hardware error: open the line, reboot the servo, and configure it.

        Use it once the cause of the error is found; the number of turns is lost. Parameters and errors are
        those of `connect`.
        """
        return cls._open(name, settings, clock, reboot=True)

    @classmethod
    def _open(
        cls,
        name: str,
        settings: AngleSettings,
        clock: Clock,
        *,
        reboot: bool,
        text: Callable[[float], str] = _angle_text,
    ) -> DynamixelMX28:
        line = _Line(name, settings, clock)
        try:
            device = cls(name, settings, clock, line, text)
            if reboot:
                device.reboot()
            else:
                device._configure()
        except BaseException:
            line.close()
            raise
        return device

    @property
    def identity(self) -> Identity:
        """Get maker, model, id on the bus (there is no serial number) and firmware."""
        return self._identity

    @property
    def limits(self) -> Limits:
        """Get the allowed set-points: the settings' `position_limits`, rad."""
        return Limits(*self._settings.position_limits, "rad")

    @property
    def setpoint(self) -> float:
        """Get the angle that was last sent, rad; nan before the first."""
        return self._setpoint

    def set(self, value: float) -> Status:
        """Move to an angle; switches the torque on if it is off.

        Parameters
        ----------
        value : float
            Angle in rad within `position_limits`; the servo resolves 0.00153 rad.

        Returns
        -------
        Status
            Complete when the servo stands within `tolerance` of the angle. Fails if the shaft stands
            elsewhere for 1 s, if a later set-point or `stop` replaces this one, or if the torque goes off.

        Raises
        ------
        LimitError
            If the value is outside of `limits`; nothing is sent.
        DeviceError
            If the servo has a hardware error or an expired watchdog, or refuses.
        """
        self.check(value)
        goal = self._counts(value)
        _, _, position, _, _ = self._feedback()
        if not self._read(_TORQUE):
            self._switch_on(position)
        self._write_goal(goal)
        self._setpoint = value
        timeout = self._duration(abs(goal - position) * _COUNT) + self._settings.arrival_timeout
        standstill = _Standstill()
        return Status(self.name, self._clock, lambda: self._arrived(goal, standstill), timeout=timeout)

    @property
    def torque_enabled(self) -> bool:
        """Get whether the servo holds its position, as it says now."""
        return bool(self._read(_TORQUE))

    def measure(self) -> dict[str, float]:
        """Measure angle (rad), angular velocity (rad/s) and inferred load (1), in one round trip.

        Raises
        ------
        DeviceError
            If the servo has a hardware error or an expired watchdog, or does not answer.
        """
        load, velocity, position, _, _ = self._feedback()
        direction = self._settings.direction
        values = (self._radians(position), direction * velocity * _VELOCITY_UNIT, direction * load * 1e-3)
        return {signal.name: value for signal, value in zip(self.signals, values, strict=True)}

    def stop(self, success: bool = True) -> None:  # noqa: ARG002 - bluesky's form
        """Take the present angle as the goal and hold it; does nothing while the torque is off."""
        if not self._read(_TORQUE) or self._read(_WATCHDOG) == _WATCHDOG_EXPIRED:
            return
        position = self._read(_POSITION, signed=True)
        self._write_goal(position)
        self._setpoint = self._radians(position)

    def safe(self) -> None:
        """Switch the torque off and see that it is off; an expired watchdog is cleared.

        If the servo refuses or still reports its torque on, its output is set to zero and it is rebooted,
        which loses the number of turns.

        Raises
        ------
        DeviceError
            If the servo does not confirm that the torque is off, after everything was tried.
        """
        failures: list[DeviceError] = []
        try:
            self._write(_TORQUE, 0)
        except DeviceError as error:
            failures.append(error)
        if not self._is_off():
            with suppress(DeviceError):
                self._write(_GOAL_PWM, 0)
            with suppress(DeviceError):
                self._restart(_EMERGENCY_PATIENCE)
            if not self._is_off():
                reason = f" ({failures[0]})" if failures else ""
                raise DeviceError(
                    self.name, f"does not confirm that its torque is off{reason}; disconnect its power supply"
                )
        self._armed = False
        # The torque is off, so whether the watchdog could be disarmed does not matter for safety.
        with suppress(DeviceError):
            self._write(_WATCHDOG, 0)
            self._expired = False

    def reboot(self) -> None:
        """Restart the servo and configure it again: clears a hardware error whose cause is gone.

        The torque is off then and the number of turns is lost: the position is that within one turn.

        Raises
        ------
        DeviceError
            If the servo does not come back within 5 s, or comes back with an error.
        """
        self._restart(_START_TIMEOUT)
        self._configure()

    def close(self) -> None:
        """Release the line. A torque that is on stays on; the servo's watchdog stops a motion."""
        self._line.close()

    def _identify(self) -> Identity:
        try:
            model, firmware = struct.unpack("<HB", self._line.ask(_PING, b"", 3))
        except _RefusedError as error:
            raise self._refusal("a ping", error) from None
        place = f"{self._settings.port}, id {self._settings.id}"
        if model != MODEL_NUMBER:
            raise DeviceConnectionError(
                self.name,
                f"expected a Dynamixel MX-28 (model {MODEL_NUMBER}) at {place}, found model {model}; "
                "check port and id",
            )
        if firmware < OLDEST_FIRMWARE:
            raise DeviceConnectionError(
                self.name,
                f"the MX-28 at {place} has firmware {firmware}, expected {OLDEST_FIRMWARE} or newer; "
                "update it with the maker's software",
            )
        return Identity("ROBOTIS", "MX-28", f"id {self._settings.id}", str(firmware))

    def _configure(self) -> None:
        settings = self._settings
        self._have_everything_answered()
        if self._line.alert:
            raise self._fault()
        self._check_limit("profile_velocity", self._velocity_units, _VELOCITY_LIMIT, _VELOCITY_UNIT, "rad/s")
        self._check_limit(
            "profile_acceleration", self._acceleration_units, _ACCELERATION_LIMIT, _ACCELERATION_UNIT, "rad/s²"
        )
        self._write(_TORQUE, 0)
        if self._read(_TORQUE):
            raise DeviceError(self.name, "does not switch its torque off; power-cycle it")
        self._write(_WATCHDOG, 0)
        self._armed = self._expired = False
        self._set_up(_MODE, _EXTENDED_POSITION_MODE)
        self._set_up(_DRIVE_MODE, 0)
        self._set_up(_DELAY, round(settings.return_delay / _DELAY_UNIT))
        self._set_up(_SHUTDOWN, self._read(_SHUTDOWN) | _REQUIRED_SHUTDOWN)
        self._setpoint = math.nan

    def _have_everything_answered(self) -> None:
        """Raise the status return level if need be: below 2 the servo does not answer writes, at 0 no reads."""
        level = None
        with suppress(DeviceConnectionError):
            level = self._read(_RETURN_LEVEL)
        if level != _ANSWER_EVERYTHING:
            self._line.tell(_WRITE, struct.pack("<HB", _RETURN_LEVEL.address, _ANSWER_EVERYTHING))
            self._read(_RETURN_LEVEL)

    def _check_limit(self, key: str, units: int, item: _Item, unit: float, dimension: str) -> None:
        limit = self._read(item)
        if units > limit:
            raise ConfigurationError(
                f"{self.name}: {key}: {units * unit:.4g} {dimension} is beyond the {item.title} that is set in the "
                f"servo, {limit * unit:.4g} {dimension}"
            )

    def _set_up(self, item: _Item, value: int) -> None:
        """Have an item of the EEPROM at a value, without wearing it if it is already."""
        if self._read(item) == value:
            return
        self._write(item, value)
        found = self._read(item)
        if found != value:
            raise DeviceError(self.name, f"keeps its {item.title} at {found} instead of {value}; power-cycle it")

    def _switch_on(self, position: int) -> None:
        """Switch the torque on at the present position, under the watchdog."""
        settings = self._settings
        self._write(_WATCHDOG, 0)
        self._write(_PROFILE_ACCELERATION, self._acceleration_units)
        self._write(_PROFILE_VELOCITY, self._velocity_units)
        self._write_goal(position)
        self._write(_WATCHDOG, round(settings.watchdog / _WATCHDOG_UNIT))
        self._write(_TORQUE, 1)
        self._armed, self._expired = settings.watchdog > 0.0, False
        self._line.longest_silence = 0.0
        if self._line.alert:
            raise self._fault()

    def _write_goal(self, counts: int) -> None:
        try:
            self._line.order(_WRITE, struct.pack("<Hi", _GOAL.address, counts))
        except _RefusedError as error:
            if error.code == _RANGE_ERROR and self._read(_WATCHDOG) == _WATCHDOG_EXPIRED:
                self._expired = True
                raise self._watchdog_error() from None
            raise self._refusal(f"{self._told(counts)} ({counts} counts) as its {_GOAL.title}", error) from None
        self._goal = counts
        if self._line.alert:
            raise self._fault()

    @property
    def _velocity_units(self) -> int:
        # Rounded down, but not from a hair's breadth below; 0 would be without a limit.
        return max(math.floor(self._settings.profile_velocity / _VELOCITY_UNIT + 1e-9), 1)

    @property
    def _acceleration_units(self) -> int:
        return max(math.floor(self._settings.profile_acceleration / _ACCELERATION_UNIT + 1e-9), 1)

    def _duration(self, distance: float) -> float:
        """Return how long a motion over a distance (rad) takes at most, s."""
        velocity = self._velocity_units * _VELOCITY_UNIT
        acceleration = self._acceleration_units * _ACCELERATION_UNIT
        # Twice the ramp more, for a motion that has to turn round first.
        return distance / velocity + 4.0 * velocity / acceleration

    def _counts(self, radians: float) -> int:
        settings = self._settings
        counts = settings.zero_counts + settings.direction * round(radians / _COUNT)
        return min(max(counts, -HIGHEST_GOAL), HIGHEST_GOAL)

    def _radians(self, counts: int) -> float:
        settings = self._settings
        return settings.direction * (counts - settings.zero_counts) * _COUNT

    def _told(self, counts: int) -> str:
        return self._text(self._radians(counts))

    def _feedback(self) -> tuple[int, int, int, int, int]:
        """Return load, velocity, position, voltage and temperature in the servo's units; raise what is wrong."""
        try:
            data = self._line.feedback()
        except _RefusedError as error:
            raise self._refusal("to tell its feedback", error) from None
        self._check()
        load, velocity, position, voltage, temperature = _FEEDBACK.unpack(data)
        return load, velocity, position, voltage, temperature

    def _check(self) -> None:
        """Raise a hardware error that the last answer told of, and a watchdog that has expired."""
        if self._line.alert:
            raise self._fault()
        silence, self._line.longest_silence = self._line.longest_silence, 0.0
        if not self._armed:
            return
        # The feedback does not tell of the watchdog: it is asked for when there was time for it to expire.
        if self._expired or silence > _SUSPICIOUS_SILENCE * self._settings.watchdog:
            self._expired = self._read(_WATCHDOG) == _WATCHDOG_EXPIRED
            if self._expired:
                raise self._watchdog_error()

    def _arrived(self, goal: int, standstill: _Standstill) -> bool:
        try:
            data = self._line.ask(_READ, struct.pack("<HH", _ARRIVAL_ADDRESS, _ARRIVAL.size), _ARRIVAL.size)
        except _RefusedError as error:
            raise self._refusal("to tell whether it moves", error) from None
        self._check()
        moving, load, _, position = _ARRIVAL.unpack(data)
        if goal != self._goal:
            raise DeviceError(self.name, f"{self._told(goal)} was replaced by another goal on the way")
        if moving:
            standstill.since = math.inf
            return False
        if abs(position - goal) * _COUNT <= self._settings.tolerance:
            return True
        if not self._read(_TORQUE):
            raise DeviceError(self.name, f"the torque was switched off before it reached {self._told(goal)}")
        now = self._clock.now()
        standstill.since = min(standstill.since, now)
        if now - standstill.since >= _STANDSTILL:
            raise DeviceError(
                self.name,
                f"stands at {self._told(position)} instead of {self._told(goal)}, under a load of "
                f"{abs(load) / 10:.0f} %: take away what blocks it, lower the load, or allow a larger tolerance",
            )
        return False

    def _fault(self) -> DeviceError:
        bits = self._read(_HARDWARE_ERROR)
        volts, celsius = self._read(_VOLTAGE) * 0.1, self._read(_TEMPERATURE)
        found = [HARDWARE_ERRORS.get(bit, _UNKNOWN_ERROR) for bit in range(8) if bits >> bit & 1]
        texts = ", ".join(text for text, _ in found) or "none any more"
        advice = "; ".join(dict.fromkeys(advice for _, advice in found)) or "find out what it was"
        return DeviceError(
            self.name,
            f"hardware error 0x{bits:02X} ({texts}; {volts:.1f} V, {celsius} °C): {advice}; "
            "then clear it by a power cycle, or by reboot or recover of its driver",
        )

    def _watchdog_error(self) -> DeviceError:
        return DeviceError(
            self.name,
            f"the bus watchdog stopped the servo, as the host was silent for {self._settings.watchdog:g} s: find "
            "out why, or allow more time with the key watchdog; the safe state clears it",
        )

    def _is_off(self) -> bool:
        with suppress(DeviceError):
            return self._read(_TORQUE) == 0
        return False

    def _restart(self, patience: float) -> None:
        """Send a reboot and wait until the servo answers again, for so many seconds at most."""
        # The answer may be lost in the restart; whether the servo comes back is what counts.
        with suppress(DeviceConnectionError, _RefusedError):
            self._line.order(_REBOOT, b"")
        end = self._clock.now() + patience
        self._clock.sleep(_REBOOT_DELAY)
        while True:
            try:
                self._line.ask(_PING, b"", 3)
            except _RefusedError as error:
                raise self._refusal("a ping", error) from None
            except DeviceConnectionError:
                if self._clock.now() >= end:
                    raise
                self._clock.sleep(_START_POLL)
            else:
                return

    def _read(self, item: _Item, *, signed: bool = False) -> int:
        request = struct.pack("<HH", item.address, item.size)
        try:
            data = self._line.ask(_READ, request, item.size)
        except _RefusedError as error:
            raise self._refusal(f"to tell its {item.title}", error) from None
        return int.from_bytes(data, "little", signed=signed)

    def _write(self, item: _Item, value: int) -> None:
        try:
            self._line.order(_WRITE, struct.pack("<H", item.address) + value.to_bytes(item.size, "little"))
        except _RefusedError as error:
            raise self._refusal(f"{value} as its {item.title}", error) from None

    def _refusal(self, what: str, error: _RefusedError) -> DeviceError:
        return DeviceError(self.name, f"refused {what}: {error}")


class DynamixelDrum(LinearStage):
    """A Dynamixel MX-28 with a drum on its shaft: the end of the wire that it winds is the stage.

    The position is the angle times `drum_radius`, with the sign and the zero that `direction` and `zero_counts`
    give to the angle. The stage resolves 2π/4096 rad · `drum_radius`, which is 15 µm on a drum of 10 mm.

    Everything else is as `DynamixelMX28` has it: bus, watchdog, hardware errors, and that a power cycle or a
    reboot loses the number of turns. The position is then off by whole circumferences of the drum, so check
    `zero_counts` before the next set-point.

    Made by `connect`, which checks and configures the servo and leaves it without force.

    Parameters
    ----------
    name : str
        Name in the rig.
    settings : DrumSettings
        What the rig file says.
    clock : Clock
        The clock of the run.
    servo : DynamixelMX28
        The servo, with the same name and the limits of `settings.servo`.
    """

    Settings: ClassVar[type[DrumSettings]] = DrumSettings

    def __init__(self, name: str, settings: DrumSettings, clock: Clock, servo: DynamixelMX28) -> None:
        super().__init__(name, clock)
        self._radius = settings.drum_radius
        self._limits = Limits(*settings.stage_limits, "m")
        self._servo = servo
        self._asked = math.nan

    @classmethod
    def connect(cls, name: str, settings: DrumSettings, clock: Clock) -> DynamixelDrum:
        """Open the line, check that a healthy MX-28 answers, and configure it; it is without force then.

        Parameters
        ----------
        name : str
            Name in the rig.
        settings : DrumSettings
            What the rig file says.
        clock : Clock
            The clock of the run.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened, nothing answers, or what answers is no MX-28 with firmware 39 or newer.
        DeviceError
            If the servo reports a hardware error; `recover` reboots it.
        ConfigurationError
            If the servo does not allow a value of the settings; nothing was written to its EEPROM then.
        """
        return cls._open(name, settings, clock, reboot=False)

    @classmethod
    def recover(cls, name: str, settings: DrumSettings, clock: Clock) -> DynamixelDrum:
        """Connect to a servo with a hardware error: open the line, reboot the servo, and configure it.

        Use it once the cause of the error is found; the number of turns is lost. Parameters and errors are
        those of `connect`.
        """
        return cls._open(name, settings, clock, reboot=True)

    @classmethod
    def _open(cls, name: str, settings: DrumSettings, clock: Clock, *, reboot: bool) -> DynamixelDrum:
        radius = settings.drum_radius
        servo = DynamixelMX28._open(
            name, settings.servo, clock, reboot=reboot, text=lambda radians: f"{radians * radius:.6g} m"
        )
        return cls(name, settings, clock, servo)

    @property
    def identity(self) -> Identity:
        """Get maker, model, id on the bus (there is no serial number) and firmware of the servo."""
        return self._servo.identity

    @property
    def limits(self) -> Limits:
        """Get the allowed set-points: the settings' `stage_limits`, m."""
        return self._limits

    @property
    def setpoint(self) -> float:
        """Get the position that was last sent, m; nan before the first."""
        angle = self._servo.setpoint
        # What was asked for, as it was, and not as rounding leaves it, perhaps beyond a limit.
        return self._asked if angle == self._asked / self._radius else angle * self._radius

    def set(self, value: float) -> Status:
        """Move to a position; switches the force on if it is off.

        Parameters
        ----------
        value : float
            Position in m within `stage_limits`; the stage resolves 2π/4096 rad · `drum_radius`.

        Returns
        -------
        Status
            Complete when the shaft stands within `tolerance` of the angle. Fails if it stands elsewhere for
            1 s, if a later set-point or `stop` replaces this one, or if the torque goes off.

        Raises
        ------
        LimitError
            If the value is outside of `limits`; nothing is sent.
        DeviceError
            If the servo has a hardware error or an expired watchdog, or refuses.
        """
        self.check(value)
        status = self._servo.set(value / self._radius)
        self._asked = value
        return status

    @property
    def force_enabled(self) -> bool:
        """Get whether the servo holds its position, as it says now."""
        return self._servo.torque_enabled

    def measure(self) -> dict[str, float]:
        """Measure position (m), velocity (m/s) and inferred load (1), in one round trip.

        Raises
        ------
        DeviceError
            If the servo has a hardware error or an expired watchdog, or does not answer.
        """
        angle, angular_velocity, load = self._servo.measure().values()
        values = (angle * self._radius, angular_velocity * self._radius, load)
        return {signal.name: value for signal, value in zip(self.signals, values, strict=True)}

    def stop(self, success: bool = True) -> None:
        """Take the present position as the goal and hold it; does nothing while the force is off."""
        self._servo.stop(success)

    def safe(self) -> None:
        """Switch the force off and see that it is off; errors and last resort are those of the servo."""
        self._servo.safe()

    def reboot(self) -> None:
        """Restart the servo and configure it again: clears a hardware error whose cause is gone.

        The force is off then and the number of turns is lost: the position is off by whole circumferences.

        Raises
        ------
        DeviceError
            If the servo does not come back within 5 s, or comes back with an error.
        """
        self._servo.reboot()

    def close(self) -> None:
        """Release the line. A force that is on stays on; the servo's watchdog stops a motion."""
        self._servo.close()


class _RefusedError(Exception):
    """The servo answered with an error number."""

    def __init__(self, code: int) -> None:
        super().__init__(STATUS_ERRORS.get(code, f"error number {code}"))
        self.code = code


class _Line:
    """The serial line to one servo: packets, their CRC and stuffing, and sending again.

    A request that brings no answer, or a damaged one, is sent again, twice at most; all that the driver sends
    may be carried out twice. As answers carry no number, whatever may still come of an answer that was asked
    for twice is waited for before the next request. Packets of other servos, and an echo of the request, as
    adapters of two-wire lines give it, are passed over.

    Attributes
    ----------
    alert : bool
        Whether the last answer told of a hardware error.
    longest_silence : float
        Longest time between two answers since the attribute was last set to zero, s.
    """

    def __init__(self, device: str, settings: ServoSettings, clock: Clock) -> None:
        self._device = device
        self._settings = settings
        self._clock = clock
        self._received = bytearray()
        self._unsettled = False
        self._silence = f"no answer within {settings.timeout:g} s"
        self._answered_at = clock.now()
        self.alert = False
        self.longest_silence = 0.0
        self._feedback_request = _frame(settings.id, _READ, struct.pack("<HH", _FEEDBACK_ADDRESS, _FEEDBACK.size))
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

    def feedback(self) -> bytes:
        """Return the feedback block, 21 bytes from address 126; errors are those of `ask`."""
        return self._exchange(self._feedback_request, _FEEDBACK.size)

    def ask(self, instruction: int, parameters: bytes, length: int) -> bytes:
        """Send an instruction; return the `length` bytes of its answer.

        Raises
        ------
        _RefusedError
            If the servo answers with an error number.
        DeviceConnectionError
            If no good answer comes.
        """
        return self._exchange(_frame(self._settings.id, instruction, parameters), length)

    def order(self, instruction: int, parameters: bytes) -> None:
        """Send an instruction that is answered without content; errors are those of `ask`."""
        self._exchange(_frame(self._settings.id, instruction, parameters), 0)

    def tell(self, instruction: int, parameters: bytes) -> None:
        """Send an instruction that may or may not be answered."""
        try:
            self._port.write(_frame(self._settings.id, instruction, parameters))
            self._settle()
        except (serial.SerialException, OSError) as error:
            raise self._lost(error) from None

    def _exchange(self, request: bytes, length: int) -> bytes:
        problem = self._silence
        try:
            if self._unsettled:
                self._settle()
            for _ in range(1 + _RESENDS):
                self._port.write(request)
                problem, error, content = self._answer(length)
                if problem == "":
                    self._note_answer(error)
                    if self._unsettled:
                        self._settle()
                    if error & ~_ALERT:
                        raise _RefusedError(error & ~_ALERT)
                    return content
                self._unsettled = True
                self._received.clear()
                if problem != self._silence:
                    self._port.reset_input_buffer()
        except (serial.SerialException, OSError) as error:
            raise self._lost(error) from None
        raise DeviceConnectionError(
            self._device,
            f"{problem} at {self._settings.port}, id {self._settings.id}, after {1 + _RESENDS} requests; "
            f"check power, cable, id and speed ({self._settings.baudrate} Bd)",
        )

    def _note_answer(self, error: int) -> None:
        now = self._clock.now()
        self.longest_silence = max(self.longest_silence, now - self._answered_at)
        self._answered_at = now
        self.alert = bool(error & _ALERT)

    def _answer(self, length: int) -> tuple[str, int, bytes]:
        """Return what is wrong with the answer, if anything, its error byte and its content."""
        for _ in range(_MOST_STRAY_PACKETS):
            packet = self._read_packet(_SHORTEST_ANSWER + length)
            if packet is None:
                return self._silence, 0, b""
            if packet == b"":
                return "damaged answer", 0, b""
            if packet[4] != self._settings.id or packet[_HEAD] != _STATUS:
                continue
            body = packet[_HEAD:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
            error, content = body[1] if len(body) > 1 else 0, body[2:]
            if error & ~_ALERT == _CRC_ERROR:
                return STATUS_ERRORS[_CRC_ERROR], 0, b""
            if not error & ~_ALERT and len(content) != length:
                return f"answer of {len(content)} instead of {length} bytes", 0, b""
            return "", error, content
        return "only packets of others", 0, b""

    def _read_packet(self, expected: int) -> bytes | None:
        """Return the next packet, None after silence, nothing for a damaged one.

        All the bytes that are expected are waited for at once, which is faster than to begin with the head. A
        refusal of a read is shorter, so it is noticed after the timeout only.
        """
        received = self._received
        read, ended = 0, False
        while read < _MOST_NOISE:
            start = received.find(_HEADER)
            # Without a header, the last bytes may be the beginning of one.
            del received[: start if start >= 0 else max(len(received) - len(_HEADER) + 1, 0)]
            missing = expected - len(received)
            if start >= 0 and len(received) >= _HEAD:
                length = int.from_bytes(received[5:_HEAD], "little")
                if not _SHORTEST_LENGTH <= length <= _LONGEST_LENGTH:
                    del received[:1]
                    continue
                end = _HEAD + length
                if len(received) >= end:
                    packet = bytes(received[:end])
                    del received[:end]
                    return packet if _crc(packet[:-2]) == int.from_bytes(packet[-2:], "little") else b""
                missing = end - len(received)
            if ended:
                return b"" if received else None
            chunk = self._port.read(missing)
            received += chunk
            read += len(chunk)
            ended = len(chunk) < missing
        return b""

    def _settle(self) -> None:
        """Wait until nothing more comes, and forget it."""
        for _ in range(_MOST_STRAY_PACKETS):
            if len(self._port.read(_LONGEST_LENGTH)) < _LONGEST_LENGTH:
                break
        self._received.clear()
        self._unsettled = False

    def _lost(self, error: Exception) -> DeviceConnectionError:
        return DeviceConnectionError(self._device, f"lost the line {self._settings.port} ({error}); check the cable")


def _crc_row(index: int) -> int:
    crc = index << 8
    for _ in range(8):
        crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
    return crc & 0xFFFF


_CRC_TABLE = tuple(_crc_row(index) for index in range(256))


def _crc(data: bytes) -> int:
    """Return the CRC-16 of a packet: polynomial 0x8005, initial value 0, highest bit first."""
    crc = 0
    for byte in data:
        crc = ((crc & 0xFF) << 8) ^ _CRC_TABLE[(crc >> 8) ^ byte]
    return crc


def _frame(servo_id: int, instruction: int, parameters: bytes) -> bytes:
    """Return a packet; an FD is put in after each FF FF FD of its body."""
    body = bytes((instruction,)) + parameters
    body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = _HEADER + struct.pack("<BH", servo_id, len(body) + 2) + body
    return packet + struct.pack("<H", _crc(packet))
