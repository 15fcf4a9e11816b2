"""Emulated Dynamixel MX-28 with the Protocol 2.0 firmware: a servo with 4096 counts a turn.

The emulation has the control table, the motion profile, the protections and the bus watchdog; the plant is the
load on the shaft.

Assumptions, where the e-Manual is silent:

- Every instruction packet on the bus feeds the bus watchdog, those for other servos as well. When it expires the
  shaft stops at that instant, goal position and goal velocity become the present ones, and the torque stays on;
  besides goals, register 98 itself takes nothing but 0 then.
- In extended position mode with a homing offset other than 0 the shaft runs away instead, at full speed, until the
  torque goes off or the register is cleared and a goal written (ROBOTIS DynamixelSDK, issue 584; a later firmware is
  said to cure it).
- Switching the torque on starts a motion to the goal position in its register. A goal written while
  the torque is off is kept.
- A hardware error stays until a reboot. The first load at or beyond the allowed output counts as overload
  after `OVERLOAD_TIME`. After a shutdown a write of torque enable is answered with a result failure.
- The shaft has no inertia. Without a load it follows the profile exactly. With one it stands where the
  position controller (its P gain only: full output at 885 · 128 / gain counts of deviation, so 133 counts by
  default) and the load balance, and moves no faster than the no-load speed. With the torque off a load turns
  it when it overcomes the friction of the gear.
- A present load is positive when the servo pushes towards larger angles, as it infers it from its output.
- Without a profile velocity the shaft moves at the no-load speed.
- A reboot takes `REBOOT_TIME`; the servo does not answer meanwhile.
- The internal temperature follows the square of the output with one time constant.
- A write is checked as a whole before any of it is stored; one that begins within an item has the wrong length.

Not emulated: time-based profiles (drive mode bit 2 is out of range), and protocol 1.0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.base import DeviceError
from bench.devices import Identity, Limits, Servo, Status
from sim_devices.instruments.dynamixel_motion import (
    NO_LOAD_SPEED_PER_VOLT,
    STALL_TORQUE_PER_VOLT,
    ShaftLoad,
    Trajectory,
    balance,
)
from sim_devices.instruments.dynamixel_table import (
    ACCELERATION_UNIT,
    COUNT,
    COUNTS_PER_TURN,
    EXTENDED,
    FULL_PWM,
    GOALS,
    HIGHEST_GOAL,
    INDIRECT_ADDRESSES,
    ITEMS,
    POSITION,
    PWM,
    VELOCITY,
    VELOCITY_UNIT,
    WATCHDOG_EXPIRED,
    WATCHDOG_UNIT,
    ControlTable,
    ErrorNumber,
    HardwareError,
    Item,
)
from sim_devices.instruments.emulated import EmulatedInstrument, FreezingReadings, RequestRefusedError
from sim_devices.world import World

MODEL_NUMBER = 30
LOWEST_FIRMWARE_THAT_CLEARS = 42

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

_CLEAR_KEY = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))


class EmulatedMX28(FreezingReadings, EmulatedInstrument, Servo):
    """One MX-28, as its control table and as the role of a servo.

    Called directly, angles are those of the position registers: zero at count 0, positive as the counts are.

    Parameters
    ----------
    load : ShaftLoad, optional
        The load on the shaft; without it the shaft is free.
    bus_id : int
        Id on the bus, 0 to 252.
    position : float
        Angle of the shaft at the beginning, rad.
    supply_voltage : float
        Input voltage, V.
    ambient_temperature : float
        Temperature around it, °C.
    rng : numpy.random.Generator, optional
        Noise of the encoder; without it the readings are free of noise.
    """

    MEASURED = (124, 126, 128, 132, 136, 140, 144, 146)

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
        super().__init__(name, world, rng)
        self._load = load
        self._supply_voltage = supply_voltage
        self._ambient_temperature = ambient_temperature
        self._saved = {address: item.default for address, item in ITEMS.items() if item.in_eeprom}
        self._saved |= {0: model_number, 6: firmware, 7: bus_id}
        self._values = {address: item.default for address, item in ITEMS.items()} | self._saved
        self._readings: dict[int, Callable[..., Any]] = {
            69: lambda: self._registered is not None,
            70: lambda: self._hardware_error,
            120: lambda: int(self.world.time * 1e3) % 32768,
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
        """How many items were written to the EEPROM, which wears it."""
        self._angle = position
        self._velocity = self._output = 0.0
        self._turns = 0
        self._trajectory: Trajectory | None = None
        self._followed_at = world.time
        self._temperature = ambient_temperature
        self._hardware_error = HardwareError(0)
        self._registered: tuple[int, bytes] | None = None
        self._watchdog_due = self._restart_due = self._step_due = self._overload_due = math.inf
        self._attended_at = -math.inf
        self._table = ControlTable(self._values, self._readings)
        self._power_on()
        world.add(self)

    # Control table and instructions.

    @property
    def position(self) -> float:
        """Angle of the shaft itself, rad, as a plant sees it; asking does not let time pass."""
        with self.world.lock:
            self._follow()
            return self._angle

    @property
    def is_moving(self) -> bool:
        """Whether the shaft is on its way, by its profile; asking does not let time pass."""
        return self._trajectory is not None and self.world.time < self._trajectory.end

    def position_after(self, seconds: float) -> float:
        """Return where the profile alone brings the shaft within some seconds, rad, for a plant that is no load."""
        with self.world.lock:
            return self._angle if self._trajectory is None else self._trajectory.at(self.world.time + seconds)[0]

    @property
    def holds(self) -> bool:
        """Whether the torque is on at the clock's present time; does not feed the watchdog."""
        with self.world.at_present():
            return self._values[64] == 1

    @property
    def bus_id(self) -> int:
        """The id on the bus, 0 to 252."""
        return self._values[7]

    @property
    def model_number(self) -> int:
        """The model number."""
        return self._values[0]

    @property
    def firmware(self) -> int:
        """The firmware version."""
        return self._values[6]

    @property
    def status_return_level(self) -> int:
        """Which instructions are answered: 0 pings, 1 reads as well, 2 all."""
        return self._values[68]

    @property
    def alert(self) -> bool:
        """Whether there is a hardware error."""
        return self._hardware_error != 0

    @property
    def answering(self) -> bool:
        """Whether packets reach the servo and it is not restarting."""
        with self.world.at_present():
            return self._reachable

    def hear(self) -> bool:
        """Take note of an instruction packet on the bus, for whichever servo; return whether it got here.

        The caller holds the lock of the world.
        """
        self.world.advance_locked()
        if not self._reachable:
            return False
        self._attend_at(self._clock.now())
        return self._reachable

    def attend(self) -> None:
        """Come up to the clock's present time and feed the bus watchdog."""
        with self.world.at_present():
            self._attend_at(self._clock.now())

    @property
    def _reachable(self) -> bool:
        return self.plugged_in and self._restart_due == math.inf

    def _attend_at(self, now: float) -> None:
        # Once an instant is enough: what is written at that instant acts by itself.
        if now != self._attended_at:
            self._attended_at = now
            self._follow()
            self._protect()
            self._feed()

    def read_bytes(self, address: int, length: int) -> bytes:
        """Return bytes of the control table.

        Raises `RequestRefusedError` if there are none to return, or one of the addresses is not defined.
        """
        with self.world.lock:
            if self._clock.now() != self._attended_at:
                self.attend()
            return self._table.read(address, length)

    def write_bytes(self, address: int, data: bytes) -> None:
        """Write whole items of the control table.

        Raises `RequestRefusedError` if an item is not defined, incomplete, read-only or locked, or a value is out of
        its range; nothing is written then.
        """
        with self.world.lock:
            self.attend()
            for item, value in self._checked(address, data):
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
        with self.world.lock:
            self.attend()
            self._checked(address, data)
            self._registered = (address, data)

    def action(self) -> None:
        """Carry out what `register_write` kept.

        Raises `RequestRefusedError` if there is nothing, or the reasons of `write_bytes`.
        """
        with self.world.lock:
            if self._registered is None:
                raise RequestRefusedError(ErrorNumber.INSTRUCTION)
            registered, self._registered = self._registered, None
            self.write_bytes(*registered)

    def reboot(self) -> None:
        """Restart: the torque goes off, RAM and the number of turns are lost, no answer for `REBOOT_TIME`."""
        with self.world.lock:
            self.attend()
            self._switch_off()
            self._restart_due = self.world.time + REBOOT_TIME

    def clear(self, parameters: bytes) -> None:
        """Forget the number of turns (firmware 42 and newer).

        Raises `RequestRefusedError` if the firmware is older, the parameters are not 01 44 58 4C 22, or the shaft
        moves.
        """
        with self.world.lock:
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
        with self.world.lock:
            kept = {255: (0, 6), 1: (0, 6, 7), 2: (0, 6, 7, 8)}.get(option)
            if kept is None:
                raise RequestRefusedError(ErrorNumber.DATA_RANGE)
            self.attend()
            for address in self._saved:
                if address not in kept:
                    self._saved[address] = ITEMS[address].default
                    self.eeprom_writes += 1
            self.reboot()

    # Faults.

    def trip(self, error: HardwareError) -> None:
        """Raise a hardware error."""
        with self.world.at_present():
            self._follow()
            self._raise_error(error)

    def power_cycle(self) -> None:
        """Interrupt the supply: RAM and the number of turns are lost, no answer for `REBOOT_TIME`."""
        with self.world.at_present():
            self._follow()
            self._switch_off()
            self._restart_due = self.world.time + REBOOT_TIME

    def supply(self, volts: float) -> None:
        """Change the input voltage, V; it must be positive."""
        if not volts > 0.0:
            raise ValueError(f"volts: expected a positive voltage, got {volts}")
        with self.world.at_present():
            self._follow()
            self._supply_voltage = volts
            self._protect()

    def heat(self, celsius: float) -> None:
        """Bring the servo to a temperature, °C, from which it goes on by itself."""
        with self.world.at_present():
            self._follow()
            self._temperature = celsius
            self._protect()

    def _readings_changed(self) -> None:
        self._table = ControlTable(self._values, self._readings)

    # Timed events.

    def deadline(self) -> float:
        """Return when watchdog, overload, restart, or the next position or the arrival is due (s)."""
        return min(self._watchdog_due, self._overload_due, self._restart_due, self._step_due)

    def expire(self) -> None:
        """Carry out what is due."""
        now = self.world.time
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

    # The role of a servo.

    @property
    def identity(self) -> Identity:
        """Maker, model, id on the bus (there is no serial number) and firmware."""
        return Identity("ROBOTIS", "MX-28", f"id {self.bus_id}", str(self.firmware))

    @property
    def limits(self) -> Limits:
        """The range of the goal position in the present operating mode, rad."""
        low, high = -HIGHEST_GOAL, HIGHEST_GOAL
        if self._values[11] == POSITION:
            low, high = self._values[52], self._values[48]
        return Limits(low * COUNT, high * COUNT, "rad")

    def set(self, value: float) -> Status:
        """Move to an angle (rad), and switch the torque on if it is off."""
        self.check(value)
        counts = round(value / COUNT)
        with self._request():
            self._refuse_fault()
            if self._values[11] not in (POSITION, EXTENDED):
                raise DeviceError(self.name, f"operating mode {self._values[11]} takes no position")
            if not self._values[64]:
                self.write_item(116, self._present_position())
                self.write_item(64, 1)
            self.write_item(116, counts)
            self._setpoint = value
            timeout = self._trajectory.end - self.world.time if self._trajectory is not None else 0.0
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

    def _arrived(self, goal: int) -> bool:
        with self._request():
            self._refuse_fault()
            if not self._values[64]:
                raise DeviceError(self.name, "the torque was switched off before the goal was reached")
            if self._values[116] != goal:
                raise DeviceError(self.name, "another goal replaced this one before it was reached")
            return not self._moving and abs(self._present_position() - goal) * COUNT <= ARRIVAL_TOLERANCE

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
        return self.is_moving or abs(self._velocity) > self._values[24] * VELOCITY_UNIT

    @property
    def _shut_down(self) -> bool:
        return bool(self._hardware_error & self._values[63])

    def _counts(self, angle: float) -> int:
        return self._sign * round(angle / COUNT) - self._turns + self._values[20]

    def _present_position(self) -> int:
        return self._counts(self._angle + self._draw(POSITION_NOISE))

    def _present_pwm(self) -> float:
        return self._sign * FULL_PWM * (self._output + self._velocity / self._top_speed)

    def _moving_status(self) -> int:
        trajectory = self._trajectory
        if trajectory is None or self._values[11] not in (POSITION, EXTENDED):
            return 0
        ongoing = 0x02 if self.world.time < trajectory.end else 0
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
        return self._trajectory.at(self.world.time)

    def _checked(self, address: int, data: bytes) -> list[tuple[Item, int]]:
        """Return the items that data for an address are, after checking them all."""
        written = self._table.decode(address, data)
        if self._shut_down and any(item.address == 64 and value for item, value in written):
            raise RequestRefusedError(ErrorNumber.RESULT_FAIL)
        return written

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
                if changed and (address == 10 or value == POSITION):
                    self._lose_turns()
                self._values[116] = self._counts(self._angle)
        elif address == 64:
            if not value:
                self._switch_off()
            elif changed:
                if self._values[11] == POSITION:
                    # Position mode counts one turn only.
                    goal = self._values[116]
                    self._lose_turns()
                    self._values[116] = goal
                self._command()
        elif address in GOALS:
            self._command()
        elif address in INDIRECT_ADDRESSES:
            self._table.forget()
        if address in (64, 98):
            self._feed()

    def _lose_turns(self) -> None:
        counts = self._sign * round(self._angle / COUNT)
        self._turns = counts - counts % COUNTS_PER_TURN
        self._values[116] = self._counts(self._angle)

    def _feed(self) -> None:
        watched = self._values[64] and self._values[98] > 0
        self._watchdog_due = self.world.time + self._values[98] * WATCHDOG_UNIT if watched else math.inf

    def _power_on(self) -> None:
        self._restart_due = self._overload_due = math.inf
        self._values |= {address: item.default for address, item in ITEMS.items() if not item.in_eeprom}
        self._values |= self._saved
        self._values[100] = self._values[36]
        self._table.forget()
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
        """Stop the shaft where it is, and hold; or run away, as the firmware does with a homing offset."""
        self._values[116] = self._counts(self._angle)
        self._values[104] = 0
        now, angle, speed = self.world.time, self._angle, 0.0
        if self._values[11] == EXTENDED and self._values[20]:
            speed = math.copysign(self._top_speed, self._values[20])
        self._trajectory = Trajectory.at_velocity(now, angle, 0.0, speed, math.inf)
        self._velocity = speed
        self._schedule()

    def _command(self) -> None:
        """Plan the motion that mode and goals ask for."""
        if not self._values[64]:
            return
        values, now = self._values, self.world.time
        angle, velocity = self._reference()
        share = abs(values[100]) / FULL_PWM
        top = self._top_speed * share
        acceleration = values[108] * ACCELERATION_UNIT or math.inf
        if values[11] == PWM:
            wanted = self._sign * math.copysign(top, values[100]) if top else 0.0
            self._trajectory = Trajectory.at_velocity(now, angle, velocity, wanted, math.inf)
        elif values[11] == VELOCITY:
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
        now = self.world.time
        if self._trajectory is not None and now < self._trajectory.end:
            self._step_due = min(now + MOTION_INTERVAL, self._trajectory.end)
        else:
            self._step_due = math.inf if self._load is None else now + SUPERVISION_INTERVAL

    def _follow(self) -> None:
        """Bring the shaft to where it is now."""
        now = self.world.time
        elapsed, self._followed_at = now - self._followed_at, now
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
        if self._trajectory is None:
            return balance(load, self._angle, reach), 0.0
        allowed = stall * abs(self._values[100]) / FULL_PWM
        reference, _ = self._reference()
        stiffness = stall * (self._values[84] / 128.0) / (FULL_PWM * COUNT)

        def drive(angle: float) -> float:
            return min(max(stiffness * (reference - angle), -allowed), allowed)

        angle = balance(load, self._angle, reach, drive)
        return angle, drive(angle) / stall

    def _watch_overload(self, now: float) -> None:
        allowed = abs(self._values[100]) / FULL_PWM
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
