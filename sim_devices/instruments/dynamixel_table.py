"""The control table of a Dynamixel MX-28 with the Protocol 2.0 firmware.

Addresses, sizes, units, ranges and defaults are those of the ROBOTIS e-Manual, MX-28(2.0), control table.

Assumption: profile velocity, profile acceleration, goal PWM, goal velocity, and the goal position of position mode
beyond their limit registers are limit errors; everything else out of range is a range error.

A byte of indirect data that stands for another one of them is the memory of that one.

Kept in the table without effect: baud rate, return delay, secondary id, LED, and all gains but the position P gain.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from sim_devices.instruments.emulated import RequestRefusedError

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

HIGHEST_GOAL = 1_048_575
"""Largest goal position of either sign in the extended position mode, counts."""

FULL_PWM = 885
"""PWM of full output."""

VELOCITY, POSITION, EXTENDED, PWM = 1, 3, 4, 16
"""Values of the operating mode (11)."""

INDIRECT = ((168, 224, 28), (578, 634, 28))
"""Blocks of the indirect addresses: first address, first byte of their data, and how many there are."""

_HIGHEST_ADDRESS = 661

GOALS = (100, 104, 116)
"""Goal PWM, goal velocity and goal position."""

_EEPROM_END = 64


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


@dataclass(frozen=True)
class Item:
    """One item of the control table."""

    address: int
    """Address of its first byte; below 64 it lies in the EEPROM."""
    size: int
    """Bytes, 1, 2 or 4, the lowest first."""
    default: int = 0
    """Value as delivered."""
    low: int = 0
    high: int = 0
    """Range of the values that a host may write."""
    writable: bool = True
    """Whether a host may write it."""
    signed: bool = False
    """Whether it is in two's complement."""

    @property
    def in_eeprom(self) -> bool:
        """Whether it survives a reboot, and can be written with the torque off only."""
        return self.address < _EEPROM_END


def _reading(address: int, size: int, *, signed: bool = False) -> Item:
    return Item(address, size, writable=False, signed=signed)


def _setting(address: int, size: int, default: int, low: int, high: int) -> Item:
    return Item(address, size, default, low, high, signed=low < 0)


HARDWARE_ERRORS = 0b111101  # bit 1 is not used
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
        _setting(11, 1, POSITION, 0, 255),  # operating mode
        _setting(12, 1, 255, 0, 255),  # secondary id
        _setting(13, 1, 2, 2, 2),  # protocol version
        _setting(20, 4, 0, -1_044_479, 1_044_479),  # homing offset, counts
        _setting(24, 4, 10, 0, 1023),  # moving threshold
        _setting(31, 1, 80, 0, 100),  # temperature limit, °C
        _setting(32, 2, 160, 50, 160),  # highest voltage, 0.1 V
        _setting(34, 2, 95, 50, 160),  # lowest voltage, 0.1 V
        _setting(36, 2, FULL_PWM, 0, FULL_PWM),  # PWM limit
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
        _setting(100, 2, FULL_PWM, -FULL_PWM, FULL_PWM),  # goal PWM
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
        *(
            # As delivered, each points to its own byte of data.
            _setting(first + 2 * place, 2, data + place, _EEPROM_END, _HIGHEST_ADDRESS)
            for first, data, count in INDIRECT
            for place in range(count)
        ),
        *(_setting(data + place, 1, 0, 0, 255) for _, data, count in INDIRECT for place in range(count)),
    )
}
"""The control table by address, with the indirect addresses and their data."""

INDIRECT_ADDRESSES = frozenset(first + 2 * place for first, _, count in INDIRECT for place in range(count))
"""Where the indirect addresses are kept."""

_INDIRECT_ADDRESS_OF = {data + place: first + 2 * place for first, data, count in INDIRECT for place in range(count)}
"""Where the address is kept that a byte of indirect data stands for."""

ITEM_OF_BYTE = {item.address + offset: item for item in ITEMS.values() for offset in range(item.size)}


_FORMATS = {
    (size, signed): "<" + (code if signed else code.upper())
    for size, code in ((1, "b"), (2, "h"), (4, "i"))
    for signed in (False, True)
}
"""How an item is carried, by its size and whether it is signed."""


_Block = tuple[struct.Struct, list[tuple[int, Callable[[], float] | None]], list[tuple[int, int]]]
"""Whole items: their form, and of each address and reading, and its lowest and highest value."""


class ControlTable:
    """The control table as bytes: reading and writing across items, and the indirect data.

    Parameters
    ----------
    values : mapping of int to int
        The present values of the items that are kept, by address.
    readings : mapping of int to callable
        How the other items get their value, by address; it is rounded.
    """

    def __init__(self, values: Mapping[int, int], readings: Mapping[int, Callable[[], float]]) -> None:
        self._values = values
        self._readings = readings
        self._blocks: dict[tuple[int, int], _Block] = {}

    def read(self, address: int, length: int) -> bytes:
        """Return bytes of the table.

        Raises `RequestRefusedError` if there are none to return, or one of the addresses is not defined.
        """
        if length == 0:
            raise RequestRefusedError(ErrorNumber.DATA_LENGTH)
        block = self._block(address, length)
        if block is not None:
            return self._measured(block)
        # Each item is measured once, so that its bytes belong together.
        measured: dict[int, bytes] = {}
        data = bytearray()
        for byte in range(address, address + length):
            meant = self._meant(byte)
            item = ITEM_OF_BYTE.get(meant)
            if item is None:
                raise RequestRefusedError(ErrorNumber.ACCESS)
            if item.address not in measured:
                measured[item.address] = self._measured(self._block_of([item]))
            data.append(measured[item.address][meant - item.address])
        return bytes(data)

    def decode(self, address: int, data: bytes) -> list[tuple[Item, int]]:
        """Return the items and values that data for an address are.

        Raises `RequestRefusedError` if an item is not defined, incomplete, read-only or locked by the torque, or a
        value is out of its range.
        """
        if not data:
            raise RequestRefusedError(ErrorNumber.DATA_LENGTH)
        meant = [self._meant(byte) for byte in range(address, address + len(data))]
        written, start = [], 0
        while start < len(data):
            first = meant[start]
            item = ITEMS.get(first)
            if item is None:
                raise RequestRefusedError(ErrorNumber.DATA_LENGTH if first in ITEM_OF_BYTE else ErrorNumber.ACCESS)
            if not item.writable or (item.in_eeprom and self._values[64]):
                raise RequestRefusedError(ErrorNumber.ACCESS)
            end = start + item.size
            if meant[start:end] != list(range(first, first + item.size)):
                raise RequestRefusedError(ErrorNumber.DATA_LENGTH)
            value = int.from_bytes(data[start:end], "little", signed=item.signed)
            check_value(self._values, item, value)
            written.append((item, value))
            start = end
        return written

    def _meant(self, address: int) -> int:
        """Return the address that a byte stands for, which is another one only for indirect data."""
        kept = _INDIRECT_ADDRESS_OF.get(address)
        return address if kept is None else self._values[kept]

    def _block(self, address: int, length: int) -> _Block | None:
        """Return form and sources of addresses that stand for whole items, once each; None for others."""
        known = self._blocks.get((address, length))
        if known is not None:
            return known
        meant = [self._meant(byte) for byte in range(address, address + length)]
        items, place = [], 0
        while place < length and meant[place] in ITEMS:
            item = ITEMS[meant[place]]
            if meant[place : place + item.size] != list(range(item.address, item.address + item.size)):
                return None
            items.append(item)
            place += item.size
        if not items or place != length or len(set(items)) < len(items):
            return None
        block = self._blocks[address, length] = self._block_of(items)
        return block

    def forget(self) -> None:
        """Forget what the indirect data stand for, as their addresses have changed."""
        self._blocks.clear()

    def _block_of(self, items: Sequence[Item]) -> _Block:
        form = struct.Struct("<" + "".join(_FORMATS[item.size, item.signed][1:] for item in items))
        sources = [(item.address, self._readings.get(item.address)) for item in items]
        return form, sources, [_range(item) for item in items]

    def _measured(self, block: _Block) -> bytes:
        """Return the bytes of whole items."""
        form, sources, ranges = block
        kept = self._values
        values = [kept[address] if reading is None else round(reading()) for address, reading in sources]
        try:
            return form.pack(*values)
        except struct.error:
            return form.pack(*[min(max(value, low), high) for value, (low, high) in zip(values, ranges, strict=True)])


def _range(item: Item) -> tuple[int, int]:
    """Return the lowest and the highest value that the bytes of an item can carry."""
    bits = 8 * item.size
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if item.signed else (0, (1 << bits) - 1)


def check_value(values: Mapping[int, int], item: Item, value: int) -> None:
    """Check a value that a host writes.

    Parameters
    ----------
    values : mapping of int to int
        The present values of the table, by address.
    item : Item
        The item.
    value : int
        The new value.

    Raises
    ------
    RequestRefusedError
        If the value is out of the item's range, or beyond its limit register.
    """
    address = item.address
    out_of_range = not item.low <= value <= item.high
    if values[98] == WATCHDOG_EXPIRED and (address in GOALS or (address == 98 and value != 0)):
        out_of_range = True
    elif address == 98:
        out_of_range = not 0 <= value <= item.high
    elif address == 11:
        out_of_range = value not in (VELOCITY, POSITION, EXTENDED, PWM)
    elif address == 12:
        out_of_range = value in (253, 254)
    elif address == 63:
        out_of_range = bool(value & ~HARDWARE_ERRORS)
    if out_of_range:
        raise RequestRefusedError(ErrorNumber.DATA_RANGE)
    limits = {100: values[36], 104: values[44], 108: values[40], 112: values[44]}
    beyond = address in limits and abs(value) > max(limits[address], 0)
    if address == 116 and values[11] == POSITION:
        beyond = not values[52] <= value <= values[48]
    if beyond:
        raise RequestRefusedError(ErrorNumber.DATA_LIMIT)
