"""Emulated Dynamixel MX-28 with the Protocol 2.0 firmware: a servo with 4096 counts a turn.

The instrument is its control table, its motion profile, its protections and its bus watchdog; the plant
behind it is what hangs on the shaft. Addresses, sizes, units, ranges and defaults of the control table are
those of the ROBOTIS e-Manual, MX-28(2.0), control table; the stall torque and the no-load speed those of its
specifications.

Assumptions, where the e-Manual is silent:

- Packets that are addressed to the servo, or to all, feed its bus watchdog. When it expires the shaft stops
  at that instant, goal position and goal velocity become the present ones, and the torque stays on; besides
  goals, register 98 itself takes nothing but 0 then.
- Switching the torque on starts a motion to whatever the goal position register holds. A goal written while
  the torque is off is kept.
- A hardware error stays until a reboot. The first load at or beyond the allowed output counts as overload
  after `OVERLOAD_TIME`. After a shutdown a write of torque enable is answered with a result failure.
- A write is checked as a whole before any of it is stored; one that begins within an item has the wrong
  length. Profile velocity, profile acceleration, goal PWM, goal velocity, and the goal position of position
  mode beyond their limit registers are limit errors, everything else out of range is a range error.
- The shaft has no inertia. Without a load it follows the profile exactly. With one it stands where the
  position controller (its P gain only: full output at 885 · 128 / gain counts of deviation, so 133 counts by
  default) and the load balance, and moves no faster than the no-load speed. With the torque off a load turns
  it when it overcomes the friction of the gear.
- A present load is positive when the servo pushes towards larger angles, as it infers it from its output.
- Without a profile velocity the shaft moves at the no-load speed.
- A reboot takes `REBOOT_TIME`; the servo does not answer meanwhile.
- The internal temperature follows the square of the output with one time constant.

Kept in the table without effect: baud rate, return delay, secondary id, LED, and all gains but the position P
gain. Not there: time-based profiles (drive mode bit 2 is out of range), protocol 1.0, and indirect addresses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Protocol

import numpy as np

from bench.devices import Identity, Limits, LinearStage, Servo, Status
from bench.errors import DeviceConnectionError, DeviceError
from sim_devices.world import World

COUNTS_PER_TURN = 4096
COUNT = 2.0 * math.pi / COUNTS_PER_TURN
"""Angle of one count, rad."""

VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0
"""Unit of the velocities, 0.229 rev/min, in rad/s."""

ACCELERATION_UNIT = 214.577 * 2.0 * math.pi / 3600.0
"""Unit of the accelerations, 214.577 rev/min², in rad/s²."""

WATCHDOG_UNIT = 0.02
"""Unit of the bus watchdog, s."""

WATCHDOG_EXPIRED = -1
"""Value of register 98 after the bus watchdog has expired."""

MODEL_NUMBER = 30
LOWEST_FIRMWARE_THAT_CLEARS = 42
HIGHEST_GOAL = 1_048_575
"""Largest goal position of either sign in the extended position mode, counts."""

STALL_TORQUE_PER_VOLT = 2.5 / 12.0
"""Stall torque over supply voltage, N·m/V: 2.5 N·m at 12 V."""

NO_LOAD_SPEED_PER_VOLT = 55.0 * 2.0 * math.pi / 60.0 / 12.0
"""No-load speed over supply voltage, rad/s/V: 55 rev/min at 12 V."""

GEAR_FRICTION = 0.1
"""Torque of a load that the gear holds while the torque is off, N·m; an assumption."""

OVERLOAD_TIME = 1.0
"""Time at full output after which the overload error comes up, s; an assumption."""

REBOOT_TIME = 0.3
"""Time without an answer after a reboot instruction, s; an assumption."""

FULL_LOAD_HEATING = 60.0
"""Rise of the internal temperature at full output, K; an assumption."""

HEATING_TIME = 300.0
"""Time constant of the internal temperature, s; an assumption."""

MOTION_INTERVAL = 0.02
"""Longest time between two positions that a plant sees while the shaft moves, s."""

SUPERVISION_INTERVAL = 0.25
"""Time between two balances of a shaft with a load that stands, s."""

POSITION_NOISE = 0.03 * math.pi / 180.0
"""Standard deviation of the encoder's reading, rad; an assumption."""

ARRIVAL_TOLERANCE = 0.01
"""Deviation that counts as having arrived when the servo is called directly, rad."""

_FULL_PWM = 885
_BALANCE_PRECISION = 1e-6
_EEPROM_END = 64
_CLEAR_KEY = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))
_VELOCITY, _POSITION, _EXTENDED, _PWM = 1, 3, 4, 16  # values of the operating mode
_GOALS = (100, 104, 116)


class HardwareError(IntFlag):
    """Bits of the hardware error status (70) and of the shutdown mask (63)."""

    INPUT_VOLTAGE = 1
    OVERHEATING = 4
    MOTOR_ENCODER = 8
    ELECTRICAL_SHOCK = 16
    OVERLOAD = 32


class ErrorNumber(IntEnum):
    """Why an instruction is refused (ROBOTIS e-Manual, Protocol 2.0, status packet)."""

    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class RequestRefusedError(Exception):
    """The servo answers an instruction with an error number."""

    def __init__(self, reason: ErrorNumber) -> None:
        super().__init__(reason.name)
        self.reason = reason


@dataclass(frozen=True)
class Item:
    """One item of the control table.

    Attributes
    ----------
    address : int
        Address of its first byte; below 64 it lies in the EEPROM.
    size : int
        Bytes, 1, 2 or 4, the lowest first.
    default : int
        Value as delivered.
    low, high : int
        Range of the values that a host may write.
    writable : bool
        Whether a host may write it.
    signed : bool
        Whether it is in two's complement.
    """

    address: int
    size: int
    default: int = 0
    low: int = 0
    high: int = 0
    writable: bool = True
    signed: bool = False

    @property
    def in_eeprom(self) -> bool:
        """Whether it survives a reboot, and can be written with the torque off only."""
        return self.address < _EEPROM_END


def _reading(address: int, size: int, *, signed: bool = False) -> Item:
    return Item(address, size, writable=False, signed=signed)


def _setting(address: int, size: int, default: int, low: int, high: int) -> Item:
    return Item(address, size, default, low, high, signed=low < 0)


_HARDWARE_ERRORS = 0b111101  # bit 1 is not used
_DEFAULT_SHUTDOWN = int(HardwareError.OVERLOAD | HardwareError.ELECTRICAL_SHOCK | HardwareError.OVERHEATING)

ITEMS = {
    item.address: item
    for item in (
        _reading(0, 2),  # model number
        _reading(2, 4),  # model information
        _reading(6, 1),  # firmware version
        _setting(7, 1, 1, 0, 252),  # id
        _setting(8, 1, 1, 0, 7),  # baud rate
        _setting(9, 1, 250, 0, 254),  # return delay time, 2 µs
        _setting(10, 1, 0, 0, 1),  # drive mode: 1 reverses the direction
        _setting(11, 1, _POSITION, 0, 255),  # operating mode
        _setting(12, 1, 255, 0, 255),  # secondary id
        _setting(13, 1, 2, 2, 2),  # protocol version
        _setting(20, 4, 0, -1_044_479, 1_044_479),  # homing offset, counts
        _setting(24, 4, 10, 0, 1023),  # moving threshold
        _setting(31, 1, 80, 0, 100),  # temperature limit, °C
        _setting(32, 2, 160, 50, 160),  # highest voltage, 0.1 V
        _setting(34, 2, 95, 50, 160),  # lowest voltage, 0.1 V
        _setting(36, 2, _FULL_PWM, 0, _FULL_PWM),  # PWM limit
        _setting(40, 4, 32767, 0, 32767),  # acceleration limit
        _setting(44, 4, 380, 0, 1023),  # velocity limit
        _setting(48, 4, 4095, 0, 4095),  # highest position of position mode, counts
        _setting(52, 4, 0, 0, 4095),  # lowest position of position mode, counts
        _setting(63, 1, _DEFAULT_SHUTDOWN, 0, 255),  # shutdown
        _setting(64, 1, 0, 0, 1),  # torque enable
        _setting(65, 1, 0, 0, 1),  # LED
        _setting(68, 1, 2, 0, 2),  # status return level
        _reading(69, 1),  # registered instruction
        _reading(70, 1),  # hardware error status
        _setting(76, 2, 1920, 0, 16383),  # velocity I gain
        _setting(78, 2, 100, 0, 16383),  # velocity P gain
        _setting(80, 2, 0, 0, 16383),  # position D gain
        _setting(82, 2, 0, 0, 16383),  # position I gain
        _setting(84, 2, 850, 0, 16383),  # position P gain
        _setting(88, 2, 0, 0, 16383),  # second feed-forward gain
        _setting(90, 2, 0, 0, 16383),  # first feed-forward gain
        _setting(98, 1, 0, WATCHDOG_EXPIRED, 127),  # bus watchdog, 20 ms
        _setting(100, 2, _FULL_PWM, -_FULL_PWM, _FULL_PWM),  # goal PWM
        _setting(104, 4, 0, -1023, 1023),  # goal velocity
        _setting(108, 4, 0, 0, 32767),  # profile acceleration
        _setting(112, 4, 0, 0, 32767),  # profile velocity
        _setting(116, 4, 0, -HIGHEST_GOAL, HIGHEST_GOAL),  # goal position
        _reading(120, 2),  # realtime tick, ms
        _reading(122, 1),  # moving
        _reading(123, 1),  # moving status
        _reading(124, 2, signed=True),  # present PWM
        _reading(126, 2, signed=True),  # present load, 0.1 %
        _reading(128, 4, signed=True),  # present velocity
        _reading(132, 4, signed=True),  # present position
        _reading(136, 4, signed=True),  # velocity trajectory
        _reading(140, 4, signed=True),  # position trajectory
        _reading(144, 2),  # present input voltage, 0.1 V
        _reading(146, 1),  # present temperature, °C
    )
}
"""The control table by address, without the indirect addresses (168 to 251 and 578 to 661)."""

_ITEM_OF_BYTE = {item.address + offset: item for item in ITEMS.values() for offset in range(item.size)}


class ShaftLoad(Protocol):
    """What hangs on the shaft."""

    def torque(self, angle: float) -> float:
        """Return the torque on the shaft at an angle (rad), N·m; positive towards larger angles.

        It must be the answer of the load's present state, and asking must not change that.
        """


@dataclass(frozen=True)
class Trajectory:
    """A motion from one angle to another, piecewise of constant acceleration.

    Attributes
    ----------
    start : float
        When it begins, s.
    origin, target : float
        Where it begins and where it ends, rad.
    pieces : tuple of (float, float, float)
        Duration (s), velocity at its beginning (rad/s) and acceleration (rad/s²) of each piece.
    """

    start: float
    origin: float
    target: float
    pieces: tuple[tuple[float, float, float], ...] = ()

    @property
    def end(self) -> float:
        """When it has ended, s."""
        return self.start + sum(duration for duration, _, _ in self.pieces)

    def at(self, instant: float) -> tuple[float, float]:
        """Return angle (rad) and velocity (rad/s) at an instant (s)."""
        if instant >= self.end:
            return self.target, 0.0
        left, angle = max(instant - self.start, 0.0), self.origin
        for duration, velocity, acceleration in self.pieces:
            if left <= duration:
                return angle + (velocity + 0.5 * acceleration * left) * left, velocity + acceleration * left
            angle += (velocity + 0.5 * acceleration * duration) * duration
            left -= duration
        return self.target, 0.0

    @classmethod
    def to_position(
        cls, start: float, origin: float, initial: float, target: float, velocity: float, acceleration: float
    ) -> Trajectory:
        """Plan the way to a standstill at an angle.

        Parameters
        ----------
        start : float
            When it begins, s.
        origin : float
            Where it begins, rad.
        initial : float
            Velocity at the beginning, rad/s.
        target : float
            Where it ends, rad.
        velocity : float
            Highest velocity, rad/s, positive.
        acceleration : float
            Acceleration and deceleration, rad/s²; infinity for a rectangular profile.
        """
        if math.isinf(acceleration):
            distance = target - origin
            if distance == 0.0:
                return cls(start, origin, target)
            return cls(start, origin, target, ((abs(distance) / velocity, math.copysign(velocity, distance), 0.0),))
        # Where a braking begun now would end decides about the direction.
        distance = target - origin - initial * abs(initial) / (2.0 * acceleration)
        sign = math.copysign(1.0, distance)
        way, speed = sign * (target - origin), sign * initial
        peak = min(math.sqrt(max(acceleration * way + 0.5 * speed * speed, 0.0)), velocity)
        first = abs(peak - speed) / acceleration
        change = math.copysign(acceleration, peak - speed)
        last = peak / acceleration
        cruise = 0.0
        if peak == velocity:
            cruise = max(way - 0.5 * (speed + peak) * first - 0.5 * peak * last, 0.0) / peak
        pieces = (
            (first, initial, sign * change),
            (cruise, sign * peak, 0.0),
            (last, sign * peak, -sign * acceleration),
        )
        return cls(start, origin, target, tuple(piece for piece in pieces if piece[0] > 0.0))

    @classmethod
    def at_velocity(
        cls, start: float, origin: float, initial: float, velocity: float, acceleration: float
    ) -> Trajectory:
        """Plan an endless motion at a velocity (rad/s); parameters as for `to_position`."""
        if velocity == 0.0 and (initial == 0.0 or math.isinf(acceleration)):
            return cls(start, origin, origin)
        change = math.copysign(acceleration, velocity - initial)
        ramp = (abs(velocity - initial) / acceleration, initial, change if math.isfinite(change) else 0.0)
        if velocity == 0.0:
            return cls(start, origin, origin + 0.5 * initial * ramp[0], (ramp,))
        pieces = (ramp, (math.inf, velocity, 0.0)) if ramp[0] > 0.0 else ((math.inf, velocity, 0.0),)
        return cls(start, origin, math.nan, pieces)


class EmulatedMX28(Servo):
    """One MX-28, as its control table and as the role of a servo.

    Called directly, angles are those of the position registers: zero at count 0, positive as the counts are.

    Parameters
    ----------
    name : str
        Name in the rig.
    world : World
        The time of the emulated laboratory; the servo enters its own deadlines there.
    load : ShaftLoad, optional
        What hangs on the shaft; without it the shaft is free.
    bus_id : int
        Id on the bus, 0 to 252.
    firmware : int
        Firmware version that the servo reports.
    model_number : int
        Model number that the servo reports.
    position : float
        Angle of the shaft at the beginning, rad.
    supply_voltage : float
        Input voltage, V.
    ambient_temperature : float
        Temperature around it, °C.
    rng : numpy.random.Generator, optional
        Noise of the encoder; without it the readings are free of noise.

    Attributes
    ----------
    eeprom_writes : int
        How many items were written to the EEPROM, which wears it.
    """

    def __init__(
        self,
        name: str,
        world: World,
        load: ShaftLoad | None = None,
        *,
        bus_id: int = 1,
        firmware: int = 45,
        model_number: int = MODEL_NUMBER,
        position: float = math.pi,
        supply_voltage: float = 12.0,
        ambient_temperature: float = 25.0,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(name, world.clock)
        self._world = world
        self._load = load
        self._rng = rng
        self._supply_voltage = supply_voltage
        self._ambient_temperature = ambient_temperature
        self._saved = {address: item.default for address, item in ITEMS.items() if item.in_eeprom}
        self._saved |= {0: model_number, 6: firmware, 7: bus_id}
        self._values = {address: item.default for address, item in ITEMS.items()} | self._saved
        self._readings: dict[int, Callable[[], float]] = {
            69: lambda: self._registered is not None,
            70: lambda: self._hardware_error,
            120: lambda: int(self._world.time * 1e3) % 32768,
            122: lambda: self._moving,
            123: self._moving_status,
            124: self._present_pwm,
            126: lambda: self._sign * 1e3 * self._output,
            128: lambda: self._sign * self._velocity / VELOCITY_UNIT,
            132: self._present_position,
            136: lambda: self._sign * self._reference()[1] / VELOCITY_UNIT,
            140: lambda: self._counts(self._reference()[0]),
            144: lambda: 10.0 * self._supply_voltage,
            146: lambda: self._temperature,
        }
        self.eeprom_writes = 0
        self._setpoint = math.nan
        self._angle = position
        self._velocity = self._output = 0.0
        self._turns = 0
        self._trajectory: Trajectory | None = None
        self._followed_at = world.time
        self._temperature = ambient_temperature
        self._hardware_error = HardwareError(0)
        self._registered: tuple[int, bytes] | None = None
        self._watchdog_due = self._restart_due = self._step_due = self._overload_due = math.inf
        self._plugged_in = True
        self._corrupt_next = self._drop_next = False
        self._power_on()
        world.add(self)

    # The servo as its manual has it: control table and instructions.

    @property
    def world(self) -> World:
        """The time of the emulated laboratory."""
        return self._world

    @property
    def position(self) -> float:
        """Angle of the shaft itself, rad, as a plant sees it; asking does not let time pass."""
        with self._world.lock:
            self._follow()
            return self._angle

    def position_after(self, seconds: float) -> float:
        """Return where the profile brings the shaft within some seconds, rad, for a plant on its way there.

        The load is left out of account: a plant that is one takes `position`.
        """
        with self._world.lock:
            if self._trajectory is None:
                return self._angle
            return self._trajectory.at(self._world.time + seconds)[0]

    @property
    def bus_id(self) -> int:
        """Get the id on the bus, 0 to 252."""
        return self._values[7]

    @property
    def model_number(self) -> int:
        """Get the model number."""
        return self._values[0]

    @property
    def firmware(self) -> int:
        """Get the firmware version."""
        return self._values[6]

    @property
    def status_return_level(self) -> int:
        """Get which instructions are answered: 0 pings, 1 reads as well, 2 all."""
        return self._values[68]

    @property
    def alert(self) -> bool:
        """Get whether there is a hardware error."""
        return self._hardware_error != 0

    @property
    def answering(self) -> bool:
        """Get whether packets reach the servo and it is not restarting."""
        with self._world.lock:
            self._world.advance()
            return self._plugged_in and math.isinf(self._restart_due)

    def attend(self) -> None:
        """Come up to the clock's present time and feed the bus watchdog: a packet has arrived."""
        with self._world.lock:
            self._world.advance()
            self._follow()
            self._protect()
            self._feed()

    def read_bytes(self, address: int, length: int) -> bytes:
        """Return bytes of the control table.

        Raises
        ------
        RequestRefusedError
            If there are none to return, or one of the addresses is not defined.
        """
        with self._world.lock:
            self.attend()
            if length == 0:
                raise RequestRefusedError(ErrorNumber.DATA_LENGTH)
            data = bytearray()
            while len(data) < length:
                item = _ITEM_OF_BYTE.get(address + len(data))
                if item is None:
                    raise RequestRefusedError(ErrorNumber.ACCESS)
                data += self._encoded(item)[address + len(data) - item.address :]
            return bytes(data[:length])

    def write_bytes(self, address: int, data: bytes) -> None:
        """Write whole items of the control table.

        Raises
        ------
        RequestRefusedError
            If an item is not defined, incomplete, read-only or locked, or a value is out of its range; nothing
            is written then.
        """
        with self._world.lock:
            self.attend()
            for item, value in self._decoded(address, data):
                self._store(item, value)

    def read_item(self, address: int) -> int:
        """Return the value of the item that begins at an address; errors are those of `read_bytes`."""
        item = ITEMS[address]
        return int.from_bytes(self.read_bytes(address, item.size), "little", signed=item.signed)

    def write_item(self, address: int, value: int) -> None:
        """Write the item that begins at an address; errors are those of `write_bytes`."""
        item = ITEMS[address]
        self.write_bytes(address, value.to_bytes(item.size, "little", signed=item.signed))

    def register_write(self, address: int, data: bytes) -> None:
        """Keep a write for `action`; it is checked now and then. Errors are those of `write_bytes`."""
        with self._world.lock:
            self.attend()
            self._decoded(address, data)
            self._registered = (address, data)

    def action(self) -> None:
        """Carry out what `register_write` kept.

        Raises
        ------
        RequestRefusedError
            If there is nothing, or the reasons of `write_bytes`.
        """
        with self._world.lock:
            if self._registered is None:
                raise RequestRefusedError(ErrorNumber.INSTRUCTION)
            registered, self._registered = self._registered, None
            self.write_bytes(*registered)

    def reboot(self) -> None:
        """Restart: the torque goes off, RAM and the number of turns are lost, no answer for `REBOOT_TIME`."""
        with self._world.lock:
            self.attend()
            self._switch_off()
            self._restart_due = self._world.time + REBOOT_TIME

    def clear(self, parameters: bytes) -> None:
        """Forget the number of turns (firmware 42 and newer).

        Raises
        ------
        RequestRefusedError
            If the firmware is older, the parameters are not 01 44 58 4C 22, or the shaft moves.
        """
        with self._world.lock:
            self.attend()
            if self.firmware < LOWEST_FIRMWARE_THAT_CLEARS:
                raise RequestRefusedError(ErrorNumber.INSTRUCTION)
            if parameters != _CLEAR_KEY:
                wrong_length = len(parameters) != len(_CLEAR_KEY)
                raise RequestRefusedError(ErrorNumber.DATA_LENGTH if wrong_length else ErrorNumber.DATA_RANGE)
            if self._moving:
                raise RequestRefusedError(ErrorNumber.RESULT_FAIL)
            self._lose_turns()
            self._command()

    def factory_reset(self, option: int) -> None:
        """Bring the EEPROM into the state of delivery and restart.

        Parameters
        ----------
        option : int
            255 for everything, 1 for everything but the id, 2 for everything but id and baud rate.

        Raises
        ------
        RequestRefusedError
            If the option is none of these.
        """
        with self._world.lock:
            kept = {255: (0, 6), 1: (0, 6, 7), 2: (0, 6, 7, 8)}.get(option)
            if kept is None:
                raise RequestRefusedError(ErrorNumber.DATA_RANGE)
            self.attend()
            for address in self._saved:
                if address not in kept:
                    self._saved[address] = ITEMS[address].default
                    self.eeprom_writes += 1
            self.reboot()

    # Faults to try the bench with.

    @property
    def plugged_in(self) -> bool:
        """Get whether packets reach the servo."""
        return self._plugged_in

    def trip(self, error: HardwareError) -> None:
        """Have a hardware error come up."""
        with self._world.lock:
            self._world.advance()
            self._follow()
            self._raise_error(error)

    def supply(self, volts: float) -> None:
        """Change the input voltage, V; it must be positive."""
        if not volts > 0.0:
            raise ValueError(f"volts: expected a positive voltage, got {volts}")
        with self._world.lock:
            self._world.advance()
            self._follow()
            self._supply_voltage = volts
            self._protect()

    def heat(self, celsius: float) -> None:
        """Bring the servo to a temperature, °C, from which it goes on by itself."""
        with self._world.lock:
            self._world.advance()
            self._follow()
            self._temperature = celsius
            self._protect()

    def unplug(self) -> None:
        """Let no packet arrive and no answer leave; the servo works on, and its watchdog expires."""
        with self._world.lock:
            self._world.advance()
            self._plugged_in = False

    def plug_in(self) -> None:
        """Undo `unplug`."""
        with self._world.lock:
            self._world.advance()
            self._plugged_in = True

    def corrupt_next_answer(self) -> None:
        """Have one bit of the next answer turned over on its way; the servo has acted all the same."""
        self._corrupt_next = True

    def drop_next_answer(self) -> None:
        """Have the next answer lost on its way; the servo has acted all the same."""
        self._drop_next = True

    def transmit(self, answer: bytes) -> bytes:
        """Return what arrives at the host of an answer, after the faults of the line."""
        if answer and self._drop_next:
            self._drop_next = False
            return b""
        if answer and self._corrupt_next:
            self._corrupt_next = False
            middle = len(answer) // 2
            return answer[:middle] + bytes((answer[middle] ^ 1,)) + answer[middle + 1 :]
        return answer

    # What happens by itself.

    def deadline(self) -> float:
        """Return when watchdog, overload, restart, or the next position or the arrival is due (s)."""
        return min(self._watchdog_due, self._overload_due, self._restart_due, self._step_due)

    def expire(self) -> None:
        """Do what is due."""
        now = self._world.time
        self._follow()
        if now >= self._watchdog_due:
            self._watchdog_due = math.inf
            self._values[98] = WATCHDOG_EXPIRED
            self._halt()
        if now >= self._overload_due:
            self._overload_due = math.inf
            self._raise_error(HardwareError.OVERLOAD)
        if now >= self._restart_due:
            self._power_on()
        if now >= self._step_due:
            self._protect()
            self._schedule()

    # The role of a servo, as a host on the spot would play it.

    @property
    def identity(self) -> Identity:
        """Maker, model, id on the bus (there is no serial number) and firmware."""
        return Identity("ROBOTIS", "MX-28", f"id {self.bus_id}", str(self.firmware))

    @property
    def limits(self) -> Limits:
        """The range of the goal position in the present operating mode, rad."""
        low, high = -HIGHEST_GOAL, HIGHEST_GOAL
        if self._values[11] == _POSITION:
            low, high = self._values[52], self._values[48]
        return Limits(low * COUNT, high * COUNT, "rad")

    @property
    def setpoint(self) -> float:
        """The angle that `set` or `stop` last took, rad; nan before the first."""
        return self._setpoint

    def set(self, value: float) -> Status:
        """Move to an angle (rad), and switch the torque on if it is off."""
        self.check(value)
        counts = round(value / COUNT)
        with self._request():
            self._refuse_fault()
            if self._values[11] not in (_POSITION, _EXTENDED):
                raise DeviceError(self.name, f"operating mode {self._values[11]} takes no position")
            if not self._values[64]:
                self.write_item(116, self._present_position())
                self.write_item(64, 1)
            self.write_item(116, counts)
            self._setpoint = value
            timeout = self._trajectory.end - self._world.time if self._trajectory is not None else 0.0
        return Status(self.name, self._clock, lambda: self._arrived(counts), timeout=timeout + 5.0)

    @property
    def torque_enabled(self) -> bool:
        """Whether the torque is on."""
        with self._request():
            return self._values[64] == 1

    def measure(self) -> dict[str, float]:
        """Measure angle (rad), angular velocity (rad/s) and load (share of the stall torque)."""
        with self._request():
            self._refuse_fault()
            return {
                f"{self.name}_position": self.read_item(132) * COUNT,
                f"{self.name}_velocity": self.read_item(128) * VELOCITY_UNIT,
                f"{self.name}_load": self.read_item(126) * 1e-3,
            }

    def stop(self, success: bool = True) -> None:  # noqa: ARG002 - bluesky's form
        """Hold the present angle; does nothing while the torque is off."""
        with self._request():
            if self._values[64] and self._values[98] != WATCHDOG_EXPIRED:
                self.write_item(116, self._present_position())
                self._setpoint = self._values[116] * COUNT

    def safe(self) -> None:
        """Switch the torque off, and clear a watchdog that has expired."""
        with self._request():
            self.write_item(64, 0)
            if self._values[98] == WATCHDOG_EXPIRED:
                self.write_item(98, 0)

    def close(self) -> None:
        """Do nothing: there is no line."""

    def _arrived(self, goal: int) -> bool:
        with self._request():
            self._refuse_fault()
            if not self._values[64]:
                raise DeviceError(self.name, "the torque was switched off before the goal was reached")
            if self._values[116] != goal:
                raise DeviceError(self.name, "another goal replaced this one before it was reached")
            return not self._moving and abs(self._present_position() - goal) * COUNT <= ARRIVAL_TOLERANCE

    @contextmanager
    def _request(self) -> Iterator[None]:
        with self._world.lock:
            if not self.answering:
                raise DeviceConnectionError(self.name, "does not answer: it was unplugged or restarts")
            self.attend()
            yield

    def _refuse_fault(self) -> None:
        if self.alert:
            names = ", ".join(bit.name or "" for bit in self._hardware_error).lower().replace("_", " ")
            raise DeviceError(self.name, f"hardware error {int(self._hardware_error):#04x} ({names}); reboot it")
        if self._values[98] == WATCHDOG_EXPIRED:
            raise DeviceError(self.name, "the bus watchdog expired and stopped it; bring it into its safe state")

    # The inner workings. The lock is held and the world stands at the present.

    @property
    def _sign(self) -> int:
        return -1 if self._values[10] & 1 else 1

    @property
    def _top_speed(self) -> float:
        return NO_LOAD_SPEED_PER_VOLT * self._supply_voltage

    @property
    def _moving(self) -> bool:
        if self._trajectory is not None and self._world.time < self._trajectory.end:
            return True
        return abs(self._velocity) > self._values[24] * VELOCITY_UNIT

    @property
    def _shut_down(self) -> bool:
        return bool(self._hardware_error & self._values[63])

    def _counts(self, angle: float) -> int:
        return self._sign * round(angle / COUNT) - self._turns + self._values[20]

    def _present_position(self) -> int:
        noise = 0.0 if self._rng is None else POSITION_NOISE * self._rng.standard_normal()
        return self._counts(self._angle + noise)

    def _present_pwm(self) -> float:
        return self._sign * _FULL_PWM * (self._output + self._velocity / self._top_speed)

    def _moving_status(self) -> int:
        trajectory = self._trajectory
        if trajectory is None or self._values[11] not in (_POSITION, _EXTENDED):
            return 0
        ongoing = 0x02 if self._world.time < trajectory.end else 0
        arrived = not ongoing and abs(self._angle - trajectory.target) <= ARRIVAL_TOLERANCE
        profile = 0
        if self._values[112]:
            # One piece is rectangular, two are triangular, three trapezoidal.
            profile = 0x10 * min(len(trajectory.pieces), 3)
        return profile | ongoing | int(arrived)

    def _reference(self) -> tuple[float, float]:
        """Return angle and velocity that the profile asks for now."""
        if self._trajectory is None:
            return self._angle, 0.0
        return self._trajectory.at(self._world.time)

    def _encoded(self, item: Item) -> bytes:
        reading = self._readings.get(item.address)
        value = self._values[item.address] if reading is None else round(reading())
        bits = 8 * item.size
        low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if item.signed else (0, (1 << bits) - 1)
        return min(max(value, low), high).to_bytes(item.size, "little", signed=item.signed)

    def _decoded(self, address: int, data: bytes) -> list[tuple[Item, int]]:
        """Return the items that data for an address are, after checking them all."""
        if not data:
            raise RequestRefusedError(ErrorNumber.DATA_LENGTH)
        written = []
        while data:
            item = ITEMS.get(address)
            if item is None:
                inside = address in _ITEM_OF_BYTE
                raise RequestRefusedError(ErrorNumber.DATA_LENGTH if inside else ErrorNumber.ACCESS)
            if not item.writable or (item.in_eeprom and self._values[64]):
                raise RequestRefusedError(ErrorNumber.ACCESS)
            if len(data) < item.size:
                raise RequestRefusedError(ErrorNumber.DATA_LENGTH)
            value = int.from_bytes(data[: item.size], "little", signed=item.signed)
            self._check_value(item, value)
            written.append((item, value))
            address, data = address + item.size, data[item.size :]
        return written

    def _check_value(self, item: Item, value: int) -> None:
        values, address = self._values, item.address
        out_of_range = not item.low <= value <= item.high
        if values[98] == WATCHDOG_EXPIRED and (address in _GOALS or (address == 98 and value != 0)):
            out_of_range = True
        elif address == 98:
            out_of_range = not 0 <= value <= item.high
        elif address == 11:
            out_of_range = value not in (_VELOCITY, _POSITION, _EXTENDED, _PWM)
        elif address == 12:
            out_of_range = value in (253, 254)
        elif address == 63:
            out_of_range = bool(value & ~_HARDWARE_ERRORS)
        if out_of_range:
            raise RequestRefusedError(ErrorNumber.DATA_RANGE)
        limit = {100: values[36], 104: values[44], 108: values[40], 112: values[44]}.get(address, item.high)
        beyond = abs(value) > max(limit, 0) if address in (100, 104, 108, 112) else False
        if address == 116 and values[11] == _POSITION:
            beyond = not values[52] <= value <= values[48]
        if beyond:
            raise RequestRefusedError(ErrorNumber.DATA_LIMIT)
        if address == 64 and value and self._shut_down:
            raise RequestRefusedError(ErrorNumber.RESULT_FAIL)

    def _store(self, item: Item, value: int) -> None:
        address = item.address
        changed = self._values[address] != value
        self._values[address] = value
        if item.in_eeprom:
            self._saved[address] = value
            self.eeprom_writes += 1
            if address == 11 and changed:
                self._values |= {100: self._values[36], 108: 0, 112: 0}
            if address == 36:
                self._values[100] = min(max(self._values[100], -value), value)
            if address in (10, 11, 20):
                if changed and (address == 10 or value == _POSITION):
                    self._lose_turns()
                self._values[116] = self._counts(self._angle)
        elif address == 64:
            if not value:
                self._switch_off()
            elif changed:
                if self._values[11] == _POSITION:
                    # Position mode counts one turn only.
                    goal = self._values[116]
                    self._lose_turns()
                    self._values[116] = goal
                self._command()
        elif address in _GOALS:
            self._command()
        if address in (64, 98):
            self._feed()

    def _lose_turns(self) -> None:
        counts = self._sign * round(self._angle / COUNT)
        self._turns = counts - counts % COUNTS_PER_TURN
        self._values[116] = self._counts(self._angle)

    def _feed(self) -> None:
        watched = self._values[64] and self._values[98] > 0
        self._watchdog_due = self._world.time + self._values[98] * WATCHDOG_UNIT if watched else math.inf

    def _power_on(self) -> None:
        self._restart_due = self._overload_due = math.inf
        self._values |= {address: item.default for address, item in ITEMS.items() if not item.in_eeprom}
        self._values |= self._saved
        self._values[100] = self._values[36]
        self._hardware_error = HardwareError(0)
        self._registered = None
        self._switch_off()
        self._lose_turns()
        self._protect()

    def _switch_off(self) -> None:
        self._values[64] = 0
        self._trajectory = None
        self._velocity = self._output = 0.0
        self._watchdog_due = self._overload_due = math.inf
        self._schedule()

    def _halt(self) -> None:
        """Stop the shaft where it is, and hold."""
        self._values[116] = self._counts(self._angle)
        self._values[104] = 0
        self._trajectory = Trajectory(self._world.time, self._angle, self._angle)
        self._velocity = 0.0
        self._schedule()

    def _command(self) -> None:
        """Plan the motion that mode and goals ask for."""
        if not self._values[64]:
            return
        values, now = self._values, self._world.time
        angle, velocity = self._reference()
        share = abs(values[100]) / _FULL_PWM
        top = self._top_speed * share
        acceleration = values[108] * ACCELERATION_UNIT or math.inf
        if values[11] == _PWM:
            wanted = self._sign * math.copysign(top, values[100]) if top else 0.0
            self._trajectory = Trajectory.at_velocity(now, angle, velocity, wanted, math.inf)
        elif values[11] == _VELOCITY:
            wanted = self._sign * min(max(values[104] * VELOCITY_UNIT, -top), top)
            self._trajectory = Trajectory.at_velocity(now, angle, velocity, wanted, acceleration)
        elif top == 0.0:
            self._trajectory = Trajectory(now, angle, angle)
        else:
            target = self._sign * (values[116] - values[20] + self._turns) * COUNT
            if values[112]:
                top = min(values[112] * VELOCITY_UNIT, top)
            else:
                acceleration = math.inf
            self._trajectory = Trajectory.to_position(now, angle, velocity, target, top, acceleration)
        self._follow()
        self._schedule()

    def _schedule(self) -> None:
        now = self._world.time
        if self._trajectory is not None and now < self._trajectory.end:
            self._step_due = min(now + MOTION_INTERVAL, self._trajectory.end)
        else:
            self._step_due = math.inf if self._load is None else now + SUPERVISION_INTERVAL

    def _follow(self) -> None:
        """Bring the shaft to where it is now."""
        now = self._world.time
        elapsed = now - self._followed_at
        self._followed_at = now
        if elapsed > 0.0:
            settled = self._ambient_temperature + FULL_LOAD_HEATING * self._output * self._output
            self._temperature = settled + (self._temperature - settled) * math.exp(-elapsed / HEATING_TIME)
        if self._load is None:
            if self._trajectory is not None:
                self._angle, self._velocity = self._trajectory.at(now)
        elif elapsed > 0.0:
            before = self._angle
            self._angle, self._output = self._balance(self._load, self._top_speed * elapsed)
            self._velocity = (self._angle - before) / elapsed
            self._watch_overload(now)

    def _balance(self, load: ShaftLoad, reach: float) -> tuple[float, float]:
        """Return where servo and load balance, as far as the shaft gets, and the output as a share."""
        stall = STALL_TORQUE_PER_VOLT * self._supply_voltage
        allowed = stall * abs(self._values[100]) / _FULL_PWM
        reference, _ = self._reference()
        stiffness = stall * (self._values[84] / 128.0) / (_FULL_PWM * COUNT)

        def drive(angle: float) -> float:
            if self._trajectory is None:
                return 0.0
            return min(max(stiffness * (reference - angle), -allowed), allowed)

        def net(angle: float) -> float:
            torque = load.torque(angle)
            if self._trajectory is None:
                torque = math.copysign(max(abs(torque) - GEAR_FRICTION, 0.0), torque)
            return torque + drive(angle)

        near = self._angle
        push = net(near)
        if push != 0.0:
            far = near + math.copysign(reach, push)
            if net(far) * push > 0.0:
                near = far
            else:
                while abs(far - near) > _BALANCE_PRECISION:
                    middle = 0.5 * (near + far)
                    if net(middle) * push > 0.0:
                        near = middle
                    else:
                        far = middle
        return near, drive(near) / stall

    def _watch_overload(self, now: float) -> None:
        allowed = abs(self._values[100]) / _FULL_PWM
        if self._output == 0.0 or abs(self._output) < allowed * (1.0 - 1e-9):
            self._overload_due = math.inf
        elif math.isinf(self._overload_due) and not self._hardware_error & HardwareError.OVERLOAD:
            self._overload_due = now + OVERLOAD_TIME

    def _protect(self) -> None:
        values = self._values
        if not values[34] <= round(10.0 * self._supply_voltage) <= values[32]:
            self._raise_error(HardwareError.INPUT_VOLTAGE)
        if self._temperature > values[31]:
            self._raise_error(HardwareError.OVERHEATING)

    def _raise_error(self, error: HardwareError) -> None:
        self._hardware_error |= error
        if self._shut_down and self._values[64]:
            self._switch_off()


class EmulatedDrum(LinearStage):
    """An emulated MX-28 with a drum on its shaft, as the role of a linear stage and as a plant sees it.

    Called directly, positions are those of the position registers, as `zero_counts`, `direction` and `radius`
    turn them into m; the stage resolves `COUNT` · `radius`. It has the name of its servo, and on the wire the
    servo is what answers.

    Parameters
    ----------
    servo : EmulatedMX28
        The servo that turns the drum.
    radius : float
        Distance from the axis to the middle of the wire, m.
    zero_counts : int
        Where the position zero is, counts.
    direction : int
        1 if the position grows with the counts, -1 if against them.

    Raises
    ------
    ValueError
        If the radius is not positive, or the direction is neither 1 nor -1.
    """

    def __init__(self, servo: EmulatedMX28, radius: float, *, zero_counts: int = 0, direction: int = 1) -> None:
        if not 0.0 < radius < math.inf:
            raise ValueError(f"radius: expected a positive length, got {radius} m")
        if direction not in (1, -1):
            raise ValueError(f"direction: expected 1 or -1, got {direction}")
        super().__init__(servo.name, servo.world.clock)
        self._servo = servo
        self._scale = direction * radius
        self._zero = zero_counts * COUNT
        self._asked = self._sent = math.nan

    # As a plant sees it.

    @property
    def position(self) -> float:
        """Position of the wire's end itself, m, by the angle of the shaft; asking does not let time pass.

        It agrees with the registers' as long as these have lost no turn and have no homing offset.
        """
        return self._metres(self._servo.position)

    def position_after(self, seconds: float) -> float:
        """Return where the profile brings the wire's end within some seconds, m, for a plant on its way there."""
        return self._metres(self._servo.position_after(seconds))

    # The role of a linear stage.

    @property
    def identity(self) -> Identity:
        """Maker, model, id on the bus (there is no serial number) and firmware of the servo."""
        return self._servo.identity

    @property
    def limits(self) -> Limits:
        """The range of the goal position in the servo's present operating mode, m."""
        limits = self._servo.limits
        low, high = sorted((self._metres(limits.low), self._metres(limits.high)))
        return Limits(low, high, "m")

    @property
    def setpoint(self) -> float:
        """The position that `set` or `stop` last took, m; nan before the first."""
        angle = self._servo.setpoint
        return self._asked if angle == self._sent else self._metres(angle)

    def set(self, value: float) -> Status:
        """Move to a position (m), and switch the torque on if it is off."""
        self.check(value)
        limits = self._servo.limits
        # Within the limits, rounding alone can bring it beyond them.
        angle = min(max(value / self._scale + self._zero, limits.low), limits.high)
        status = self._servo.set(angle)
        self._asked, self._sent = value, angle
        return status

    @property
    def force_enabled(self) -> bool:
        """Whether the torque is on."""
        return self._servo.torque_enabled

    def measure(self) -> dict[str, float]:
        """Measure position (m), velocity (m/s) and load (share of the stall torque)."""
        angle, angular_velocity, load = self._servo.measure().values()
        values = (self._metres(angle), angular_velocity * self._scale, math.copysign(1.0, self._scale) * load)
        return {signal.name: value for signal, value in zip(self.signals, values, strict=True)}

    def stop(self, success: bool = True) -> None:
        """Hold the present position; does nothing while the torque is off."""
        self._servo.stop(success)

    def safe(self) -> None:
        """Switch the torque off, and clear a watchdog that has expired."""
        self._servo.safe()

    def close(self) -> None:
        """Do nothing: there is no line."""
        self._servo.close()

    def _metres(self, angle: float) -> float:
        return (angle - self._zero) * self._scale
