"""The Dynamixel MX-28 with Protocol 2.0 firmware (39 and newer): the common base of servo and drum.

Source: ROBOTIS e-Manual, MX-28(2.0) (control table, units, hardware errors, bus watchdog).

The servo works in its extended position mode: 4096 counts a turn over ±256 turns. It measures its angle only
within one turn when it is switched on: the number of turns is lost in a power cycle and in a reboot, so the
setting `zero_counts` holds until the next power cycle.

The EEPROM wears: the driver writes an item there only if its value differs, with the torque off. Those items
are operating mode, drive mode, return delay time, and the shutdown mask, to which overload, electrical shock
and overheating are added if they are missing. Set-points, profile and bus watchdog live in RAM. Limits of
velocity, acceleration, PWM, temperature and voltage, and the homing offset, are left as the bench builder set them;
a homing offset other than 0 is refused together with the bus watchdog.
"""

from __future__ import annotations

import math
import struct
from abc import abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, NamedTuple, Self, TypeVar

from pydantic import Field, field_validator, model_validator

from bench.base import Clock, ConfigurationError, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import Actuator, CheckFinding, Identity, Limits, Status
from drivers.device import RecoverableDevice, attempt, watchdog_field
from drivers.dynamixel.protocol2 import (
    PING,
    RANGE_ERROR,
    READ,
    REBOOT,
    WRITE,
    RefusedError,
    ServoLine,
    ServoLineSettings,
)

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
_EXPIRED = -1
_EXTENDED_POSITION_MODE = 4
_REQUIRED_SHUTDOWN = 0b110100  # overload, electrical shock, overheating
_ANSWER_EVERYTHING = 2  # value of the status return level

_START_TIMEOUT = 5.0
_REBOOT_DELAY = 0.2
_EMERGENCY_PATIENCE = 1.0  # s for a reboot on the way to the safe state
_STANDSTILL = 1.0  # s beside the goal without a motion that count as blocked
_SAFE_WITHIN = 2.0  # with a reboot
_MOST_READINGS = 4
_SAME_TICK = 5e-3  # s after which the realtime tick, in ms, has moved on


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
_MODES = _Item(9, 4, "return delay time, modes and secondary id")
_HOMING_OFFSET = _Item(20, 4, "homing offset")
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

_TICK, _MOVING, _LOAD, _VELOCITY = 120, 122, 126, 128
# What changes in most readings comes last: the line keeps the CRC of what is before it.
_FEEDBACK = struct.Struct("<BBBbiBhiiH")
_FEEDBACK_BYTES = tuple(
    address + offset
    for address, size in (
        (_RETURN_LEVEL.address, 1),
        (_TORQUE.address, 1),
        (_HARDWARE_ERROR.address, 1),
        (_WATCHDOG.address, 1),
        (_GOAL.address, 4),
        (_MOVING, 1),
        (_LOAD, 2),
        (_VELOCITY, 4),
        (_POSITION.address, 4),
        (_TICK, 2),
    )
    for offset in range(size)
)
"""Addresses that the indirect data stand for; the return level, which is 2, tells whether they still do."""
_INDIRECT_ADDRESSES, _INDIRECT_DATA = 168, 224


class _Feedback(NamedTuple):
    """What the servo reports in one reading, in its units."""

    return_level: int
    torque: int
    hardware_error: int
    watchdog: int
    goal: int
    moving: int
    load: int
    velocity: int
    position: int
    tick: int


HARDWARE_ERRORS: Mapping[int, tuple[str, str]] = {
    0: ("input voltage", "check the power supply and its cable; allowed are the voltage limits set in the servo"),
    2: ("overheating", "let it cool down for 20 minutes, and lower the load"),
    3: ("motor encoder", "ask ROBOTIS if it comes again"),
    4: ("electrical shock", "check wiring and earth, and that the supply gives current enough"),
    5: ("overload", "take away what blocks the shaft, or lower the load"),
}
"""What the bits of the hardware error status mean (ROBOTIS e-Manual, MX-28(2.0), shutdown) and what to do."""

_UNKNOWN_ERROR = ("unknown to this driver", "look it up in the manual of the servo")


class MX28Settings(ServoLineSettings):
    """Rig-file settings of any Dynamixel MX-28."""

    return_delay: float = Field(
        default=0.0, ge=0.0, le=508e-6, description="pause before an answer, s: 0 to 508e-6, in steps of 2e-6"
    )
    zero_counts: int = Field(
        default=0, ge=-HIGHEST_GOAL, le=HIGHEST_GOAL, description="where the set-point zero is, counts of 2π/4096"
    )
    direction: Literal[1, -1] = Field(
        default=1, description="1 if set-points grow with the counts (counter-clockwise at the horn), otherwise -1"
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
    watchdog: float = watchdog_field(
        2.5, 127 * _WATCHDOG_UNIT, "the servo stops and holds, s: 0.02 to 2.54 in steps of 0.02, 0 for never"
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

    _LIMITS: ClassVar[tuple[str, str]]  # key and unit of the limits of the set-point

    @property
    @abstractmethod
    def per_radian(self) -> float:
        """Change of the set-point with the angle of the shaft, in the unit of `limits` per rad."""

    @property
    def limits(self) -> Limits:
        """The set-points that are allowed."""
        key, unit = self._LIMITS
        low, high = getattr(self, key)
        return Limits(low, high, unit)

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        key, unit = self._LIMITS
        low, high = (limit / self.per_radian for limit in getattr(self, key))
        if not low < high:
            raise ValueError(f"{key}: expected the lower limit first")
        ends = sorted(self.direction * (goal - self.zero_counts) * _COUNT for goal in (-HIGHEST_GOAL, HIGHEST_GOAL))
        if low < ends[0] or high > ends[1]:
            raise ValueError(
                f"{key}: {self.limits} is beyond the range of the servo, which with these zero_counts and "
                f"direction is {Limits(ends[0] * self.per_radian, ends[1] * self.per_radian, unit)}"
            )
        return self


MX28SettingsT = TypeVar("MX28SettingsT", bound=MX28Settings)


class MX28(RecoverableDevice[MX28SettingsT, ServoLine], Actuator):
    """A Dynamixel MX-28 in its extended position mode, in the unit of what it moves.

    `connect` leaves the torque off, and clears a bus watchdog that has expired, as after a host that died. A servo
    with a hardware error is refused; `recover` reboots it, which loses the number of turns. A value that the servo
    does not allow is refused before anything is written to its EEPROM.

    While the torque is on, the servo watches its host (`watchdog` of the settings, 2.5 s by default): if no packet
    comes for that long, to any servo of the bus, it stops where it is, holds, and answers goals by error 4. The
    watchdog takes 2.54 s at most, and the longest pause between two ticks of the bench is 2 s, hence the default. It
    is armed just before the torque is switched on. Once it has expired, every reading, every set-point and the status
    of the motion raise; `safe`, `reboot` and `connect` clear it by writing 0 to it.

    A hardware error of the servo (overload, overheating, ...) comes with every answer as its alert bit, and
    is raised with its meaning, voltage and temperature. After a shutdown only `reboot` or a power cycle brings
    the torque back, and both lose the number of turns.

    That is all it does by itself: the torque stays on after the death of its host, so `watchdog` is None, and only
    `safe` switches the torque off.

    A reading is one block of indirect data (addresses 168 to 251): status return level, torque, bus watchdog, goal,
    motion, load, velocity, position, and realtime tick. The indirect addresses live in RAM: after a restart the
    level is 0 there instead of 2. So the next reading finds the restart before it believes a position, which may be
    off by whole turns; from then on every reading and every set-point is a `DeviceRestartedError`, until the servo is
    connected again with its `zero_counts` checked. A goal or a torque that is not the one that was sent is a
    `DeviceError` of the next reading, and so is a tick that stands still.

    The first set-point after the torque was off takes the present position as the goal before it switches the
    torque on, so that the shaft does not jump to a previous goal.

    Several servos of one bus may each have a driver on one port, if they are called in turn.
    """

    _DIGITS: ClassVar[int]  # of a position in messages

    def __init__(self, name: str, settings: MX28SettingsT, clock: Clock, line: ServoLine) -> None:
        super().__init__(name, settings, clock, line)
        self._names = [signal.name for signal in self.signals]
        self._per_radian = settings.per_radian
        # What is sent and found from `connect` on.
        self._goal: int | None
        self._on: bool
        self._restarted: bool
        self._tick: int | None = None
        self._read_at = -math.inf
        self._read_feedback = line.reading(_INDIRECT_DATA, _FEEDBACK.size)

    @classmethod
    def _open_line(cls, name: str, settings: MX28SettingsT, clock: Clock) -> ServoLine:
        return ServoLine(name, settings, clock)

    @property
    def limits(self) -> Limits:
        """The allowed set-points: the limits of the settings."""
        return self._settings.limits

    @property
    def safe_within(self) -> float:
        """Longest time that `safe` takes on a line that works, s, with the reboot of a servo that refuses."""
        return _SAFE_WITHIN

    def set(self, value: float) -> Status:
        """Move to a set-point, with a resolution of 0.00153 rad; switches the torque on if it is off.

        The status completes when the shaft stands within `tolerance` of the goal. It fails if the shaft stands
        elsewhere for 1 s, if a later set-point or `stop` replaces this one, or if the torque goes off.
        """
        self.check(value)
        goal = self._counts(value / self._settings.per_radian)
        found = self._feedback()
        position = found.position
        if not found.torque:
            self._switch_on(position)
        self._write_goal(goal)
        self._setpoint = value
        timeout = self._duration(abs(goal - position) * _COUNT) + self._settings.arrival_timeout
        standstill = _Standstill()
        return Status(self.name, self._clock, lambda: self._arrived(goal, standstill), timeout=timeout)

    def measure(self) -> dict[str, float]:
        """Measure position, velocity and inferred load (1), in one round trip."""
        found = self._feedback()
        direction = self._settings.direction
        velocity = direction * found.velocity * _VELOCITY_UNIT * self._per_radian
        values = (self._position(found.position), velocity, direction * found.load * 1e-3)
        return dict(zip(self._names, values, strict=True))

    def stop(self, success: bool = True) -> None:  # noqa: ARG002 - bluesky's form
        """Take the present position as the goal and hold it; does nothing while the torque is off."""
        if not self._read(_TORQUE) or self._read(_WATCHDOG) == _WATCHDOG_EXPIRED:
            return
        position = self._read(_POSITION, signed=True)
        self._write_goal(position)
        self._setpoint = self._position(position)

    def _make_safe(self) -> None:
        """Switch the torque off and see that it is off, or reboot the servo, which loses the number of turns."""
        line = self._line
        line.urgent = True
        try:
            failures = attempt(partial(self._write, _TORQUE, 0))
        finally:
            line.urgent = False
        lost = bool(failures) and isinstance(failures[0], DeviceConnectionError)
        if lost and line.answered:
            # Another line is tried before the reboot, which loses the number of turns.
            raise self._unconfirmed("torque", failures)
        if lost:
            goal_pwm = struct.pack("<Hh", _GOAL_PWM.address, 0)
            attempt(partial(line.tell, WRITE, goal_pwm), partial(line.tell, REBOOT, b""))
            if not self._is_off():
                raise self._unconfirmed("torque", failures)
        elif not self._is_off():
            attempt(partial(self._write, _GOAL_PWM, 0), partial(self._reboot, _EMERGENCY_PATIENCE))
            if not self._is_off():
                raise self._unconfirmed("torque", failures)
        self._on = False
        # The torque is off, so whether the watchdog could be disarmed does not matter for safety.
        with suppress(DeviceError):
            self._write(_WATCHDOG, 0)

    def reboot(self) -> None:
        """Restart the servo and configure it again: clears a hardware error whose cause is gone.

        The torque is off then and the number of turns is lost: the angle is that within one turn, and a drum is off
        by whole circumferences.

        Raises `DeviceError` if the servo does not come back within 5 s, or comes back with an error.
        """
        self._reboot(_START_TIMEOUT)
        self._start()

    def _restart(self) -> None:
        self.reboot()

    def _identify(self) -> Identity:
        model, firmware = self._ping()
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

    def _start(self) -> None:
        settings = self._settings
        self._ensure_answers()
        if self._line.alert:
            raise self._fault()
        self._refuse_homing_offset()
        self._check_limit("profile_velocity", self._velocity_units, _VELOCITY_LIMIT, _VELOCITY_UNIT, "rad/s")
        self._check_limit(
            "profile_acceleration", self._acceleration_units, _ACCELERATION_LIMIT, _ACCELERATION_UNIT, "rad/s²"
        )
        self._write(_TORQUE, 0)
        if self._read(_TORQUE):
            raise DeviceError(self.name, "does not switch its torque off; power-cycle it")
        self._write(_WATCHDOG, 0)
        self._on = False
        delay, drive_mode, mode, _ = self._read(_MODES).to_bytes(_MODES.size, "little")
        self._set_up(_MODE, mode, _EXTENDED_POSITION_MODE)
        self._set_up(_DRIVE_MODE, drive_mode, 0)
        self._set_up(_DELAY, delay, round(settings.return_delay / _DELAY_UNIT))
        shutdown = self._read(_SHUTDOWN)
        self._set_up(_SHUTDOWN, shutdown, shutdown | _REQUIRED_SHUTDOWN)
        # A servo that does not report its feedback is found here, not in the first motion.
        self._map_feedback()
        self._restarted = False
        self._feedback()
        self._setpoint = math.nan

    def _map_feedback(self) -> None:
        """Have the indirect data stand for the feedback."""
        addresses = struct.pack(f"<{len(_FEEDBACK_BYTES)}H", *_FEEDBACK_BYTES)
        try:
            self._line.order(WRITE, struct.pack("<H", _INDIRECT_ADDRESSES) + addresses)
        except RefusedError as error:
            raise self._refusal("its indirect addresses", error) from None

    def _renew_line(self) -> None:
        super()._renew_line()
        self._read_feedback = self._line.reading(_INDIRECT_DATA, _FEEDBACK.size)

    def _ensure_answers(self) -> None:
        """Raise the status return level if need be: below 2 the servo does not answer writes, at 0 no reads."""
        level = None
        with suppress(DeviceConnectionError):
            level = self._read(_RETURN_LEVEL)
        if level != _ANSWER_EVERYTHING:
            self._line.tell(WRITE, struct.pack("<HB", _RETURN_LEVEL.address, _ANSWER_EVERYTHING))
            self._read(_RETURN_LEVEL)

    def _refuse_homing_offset(self) -> None:
        """Refuse what makes the firmware turn the shaft without end (ROBOTIS DynamixelSDK, issue 584)."""
        offset = self._read(_HOMING_OFFSET, signed=True)
        if offset and self._settings.watchdog:
            raise ConfigurationError(
                f"{self.name}: watchdog: the servo has a homing offset of {offset} counts, with which an expired bus "
                "watchdog makes it turn without end in its extended position mode; set the homing offset (register "
                "20) to 0 with the maker's software and the key zero_counts instead, or do without the watchdog (0)"
            )

    def _check_limit(self, key: str, units: int, item: _Item, unit: float, dimension: str) -> None:
        limit = self._read(item)
        if units > limit:
            raise ConfigurationError(
                f"{self.name}: {key}: {units * unit:.4g} {dimension} is beyond the {item.title} that is set in the "
                f"servo, {limit * unit:.4g} {dimension}"
            )

    def _set_up(self, item: _Item, present: int, value: int) -> None:
        """Set an item of the EEPROM, but write only what differs from the present value, as the EEPROM wears."""
        if present == value:
            return
        self._write(item, value)
        self._require(item, value)

    def _require(self, item: _Item, value: int) -> None:
        found = self._read(item)
        if found != value:
            raise DeviceError(self.name, f"keeps its {item.title} at {found} instead of {value}; power-cycle it")

    def _switch_on(self, position: int) -> None:
        """Switch the torque on at the present position, under the watchdog, after a look at mode and profile."""
        settings = self._settings
        self._write(_WATCHDOG, 0)
        for item, value in (
            (_PROFILE_ACCELERATION, self._acceleration_units),
            (_PROFILE_VELOCITY, self._velocity_units),
        ):
            self._write(item, value)
            self._require(item, value)
        self._require(_MODE, _EXTENDED_POSITION_MODE)
        self._write_goal(position)
        self._write(_WATCHDOG, round(settings.watchdog / _WATCHDOG_UNIT))
        self._write(_TORQUE, 1)
        self._on = True
        if self._line.alert:
            raise self._fault()

    def _write_goal(self, counts: int) -> None:
        try:
            self._line.order(WRITE, struct.pack("<Hi", _GOAL.address, counts))
        except RefusedError as error:
            if error.code == RANGE_ERROR and self._read(_WATCHDOG) == _WATCHDOG_EXPIRED:
                raise self._watchdog_error() from None
            raise self._refusal(f"{self._text(counts)} ({counts} counts) as its {_GOAL.title}", error) from None
        except DeviceConnectionError:
            # It may have arrived.
            self._goal = None
            raise
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

    def _position(self, counts: int) -> float:
        settings = self._settings
        return settings.direction * (counts - settings.zero_counts) * _COUNT * self._per_radian

    def _text(self, counts: int) -> str:
        return f"{self._position(counts):.{self._DIGITS}g} {self.limits.unit}"

    def _feedback(self) -> _Feedback:
        """Return what the servo reports; raise what is wrong with it."""
        found = self._look()
        if self._on:
            self._check_held(found)
        return found

    def _look(self) -> _Feedback:
        """Return what the servo reports; raise a hardware error and a restart."""
        if self._restarted:
            raise self._restart_error()
        for number in range(_MOST_READINGS):
            if number:
                self._line.repeats += 1
            asked_at = self._clock.now()
            try:
                found = _Feedback(*_FEEDBACK.unpack(self._read_feedback()))
            except RefusedError as error:
                raise self._refusal("to report its feedback", error) from None
            if found.return_level != _ANSWER_EVERYTHING:
                self._restarted = True
                raise self._restart_error()
            # The answer of before once more: doubled on its way, and late.
            if found.tick != self._tick or asked_at - self._read_at <= _SAME_TICK:
                break
        else:
            raise DeviceError(self.name, "its realtime tick stands still; power-cycle it")
        self._tick, self._read_at = found.tick, self._clock.now()
        if self._line.alert:
            raise self._fault()
        return found

    def _check_held(self, found: _Feedback) -> None:
        """Raise if the servo does not hold what was sent to it."""
        if found.watchdog == _EXPIRED:
            raise self._watchdog_error()
        if not found.torque:
            self._on = False
            raise DeviceError(
                self.name,
                "its torque was switched off, and not by this bench; find out by whom, and check zero_counts",
            )
        if self._goal is not None and found.goal != self._goal:
            raise DeviceError(
                self.name,
                f"its goal was changed to {self._text(found.goal)} by another host, from {self._text(self._goal)}; "
                "find out which",
            )

    def _restart_error(self) -> DeviceRestartedError:
        return DeviceRestartedError(
            self.name,
            "the servo has restarted: its torque is off and the number of turns is lost; check its power supply and "
            "zero_counts, and connect it again",
        )

    def _arrived(self, goal: int, standstill: _Standstill) -> bool:
        found = self._look()
        if goal != self._goal:
            raise DeviceError(self.name, f"{self._text(goal)} was replaced by another goal on the way")
        if not found.torque:
            self._on = False
            raise DeviceError(self.name, f"the torque was switched off before it reached {self._text(goal)}")
        self._check_held(found)
        if found.moving:
            standstill.since = math.inf
            return False
        if abs(found.position - goal) * _COUNT <= self._settings.tolerance:
            return True
        now = self._clock.now()
        standstill.since = min(standstill.since, now)
        if now - standstill.since >= _STANDSTILL:
            raise DeviceError(
                self.name,
                f"stands at {self._text(found.position)} instead of {self._text(goal)}, under a load of "
                f"{abs(found.load) / 10:.0f} %: take away what blocks it, lower the load, or allow a larger "
                "tolerance",
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
            f"then run `bench rig clear RIG {self.name}`, or switch the servo off and on, which loses the number of "
            "turns: check zero_counts",
        )

    def _watchdog_error(self) -> DeviceError:
        return DeviceError(
            self.name,
            f"the bus watchdog stopped the servo, as the host was silent for {self._settings.watchdog:g} s: find "
            "out why, or allow more time with the key watchdog; the safe state clears it",
        )

    def _holds(self) -> bool:
        return bool(self._read(_TORQUE))

    def _is_off(self) -> bool:
        with suppress(DeviceError):
            return not self._holds()
        return False

    def _reboot(self, patience: float) -> None:
        """Send a reboot and wait until the servo answers again, for so many seconds at most."""
        # The answer may be lost in the restart; whether the servo comes back is what counts.
        with suppress(DeviceConnectionError, RefusedError):
            self._line.order(REBOOT, b"")
        self._clock.sleep(_REBOOT_DELAY)
        self._wait_until(lambda: bool(self._ping()), patience - _REBOOT_DELAY)

    def _ping(self) -> tuple[int, int]:
        """Return model number and firmware."""
        try:
            model, firmware = struct.unpack("<HB", self._line.ask(PING, b"", 3))
        except RefusedError as error:
            raise self._refusal("a ping", error) from None
        return model, firmware

    def _read(self, item: _Item, *, signed: bool = False) -> int:
        request = struct.pack("<HH", item.address, item.size)
        try:
            data = self._line.ask(READ, request, item.size)
        except RefusedError as error:
            raise self._refusal(f"to report its {item.title}", error) from None
        return int.from_bytes(data, "little", signed=signed)

    def _write(self, item: _Item, value: int) -> None:
        try:
            self._line.order(WRITE, struct.pack("<H", item.address) + value.to_bytes(item.size, "little"))
        except RefusedError as error:
            raise self._refusal(f"{value} as its {item.title}", error) from None

    def _refusal(self, what: str, error: RefusedError) -> DeviceError:
        return DeviceError(self.name, f"refused {what}: {error}")

    def self_check(self) -> tuple[CheckFinding, ...]:
        """Report the supply voltage and the temperature, and whether a power cycle can lose a turn.

        Raises DeviceError if the servo does not answer.
        """
        voltage, temperature = self._read(_VOLTAGE), self._read(_TEMPERATURE)
        span = abs((self.limits.high - self.limits.low) / self._settings.per_radian) / (2.0 * math.pi)
        turns = f"the limits span {span:.2g} turns"
        if span >= 1.0:
            turns += "; which of them it is in is lost when it is switched off"
        return CheckFinding("power supply", f"{0.1 * voltage:.1f} V, servo {temperature} °C"), CheckFinding(
            "turns", turns
        )
