"""The parameter table of a Meerstetter TEC-1091, its states and its error numbers.

Numbers, types and ranges are those of Meerstetter 5136 (TEC controller communication protocol) as a TEC-1091
reports them. Defaults are ours.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

STATIC, LIVE, CONTROLLER = 0, 1, 2
"""Values of parameter 2000: what controls the output stage."""

ENABLE_OFF, ENABLE_ON, ENABLE_LIVE = 0, 1, 2
"""Values of parameter 2010: what enables the output stage."""

_HIGHEST_INT = 2**31 - 1


class DeviceStatus(IntEnum):
    """Values of parameter 104 (Meerstetter 5136)."""

    INIT = 0
    READY = 1
    RUN = 2
    ERROR = 3
    BOOTLOADER = 4
    RESET_PENDING = 5


class ServerError(IntEnum):
    """Why a request is refused (Meerstetter 5117, server error codes)."""

    COMMAND_NOT_AVAILABLE = 1
    BUSY = 2
    COMMUNICATION = 3
    FORMAT = 4
    PARAMETER_NOT_AVAILABLE = 5
    READ_ONLY = 6
    OUT_OF_RANGE = 7
    INSTANCE_NOT_AVAILABLE = 8
    GENERAL = 9


@dataclass(frozen=True)
class Parameter:
    """One row of the parameter table."""

    number: int
    """Number of the parameter."""
    kind: Literal["INT32", "FLOAT32"]
    """How the value is coded on the wire."""
    low: float
    high: float
    """Range of the values."""
    default: float
    """Value as delivered."""
    writable: bool = True
    """Whether the host may write it."""
    volatile: bool = False
    """Whether it lives in RAM only and starts from its default after each reset."""


def _integer(number: int, high: float, default: float = 0, *, low: float = 0) -> Parameter:
    return Parameter(number, "INT32", low, high, default)


def _real(number: int, low: float, high: float, default: float) -> Parameter:
    return Parameter(number, "FLOAT32", low, high, default)


def _integer_reading(number: int) -> Parameter:
    return Parameter(number, "INT32", 0, _HIGHEST_INT, 0, writable=False)


def _real_reading(number: int) -> Parameter:
    return Parameter(number, "FLOAT32", -math.inf, math.inf, 0.0, writable=False)


def _live(number: int, kind: Literal["INT32", "FLOAT32"], low: float, high: float) -> Parameter:
    return Parameter(number, kind, low, high, 0, volatile=True)


PARAMETERS = {
    parameter.number: parameter
    for parameter in (
        *(_integer_reading(number) for number in (100, 101, 102, 103, 104, 105, 106, 107, 109, 1200)),
        *(_real_reading(number) for number in (1000, 1001, 1010, 1011, 1020, 1021, 1060, 1063)),
        Parameter(108, "INT32", 0, 1, 0, volatile=True),
        _integer(2000, 2, CONTROLLER),
        _integer(2010, 3, ENABLE_OFF),
        _real(2020, -4.0, 4.0, 0.0),
        _real(2021, 0.0, 21.0, 0.0),
        _real(2030, 0.0, 4.0, 4.0),
        _real(2031, 0.0, 21.0, 21.0),
        _real(2032, 0.0, 5.6, 5.0),
        _real(2033, 0.0, 25.0, 22.0),
        _integer(2040, 2),
        _integer(2050, 1_000_000, 57600, low=4800),
        _integer(2051, 254, 1, low=1),
        _integer(2052, 100_000),
        _real(2060, 0.0, 600.0, 0.0),
        _real(3000, -273.0, 1000.0, 25.0),
        _real(3002, 0.0, 200.0, 1.0),
        _real(3003, 1e-6, 50.0, 50.0),
        _real(3010, 0.0, 10000.0, 10.0),
        _real(3011, 1e-4, 10000.0, 300.0),
        _real(3012, 0.0, 10000.0, 0.0),
        _real(3013, 0.0, 1.0, 0.3),
        _integer(3034, 1, 1),
        _real(4010, -273.0, 1000.0, 0.0),
        _real(4011, -273.0, 1000.0, 105.0),
        _real(4012, 1.0, 100_000.0, 50.0),
        _real(4040, 0.0, 50.0, 0.1),
        _real(4041, 0.0, 86400.0, 1.0),
        _real(4042, 0.0, 86400.0, 0.0),
        _real(5010, -273.0, 1000.0, 0.0),
        _real(5011, -273.0, 1000.0, 70.0),
        _real(5012, 1.0, 200.0, 50.0),
        _real(6310, 0.0, 86400.0, 0.0),
        _integer(6320, 20_000_000, 1, low=-1),
        _live(50000, "INT32", 0, 1),
        _live(50001, "FLOAT32", -4.0, 4.0),
        _live(50002, "FLOAT32", 0.0, 21.0),
        _live(50011, "INT32", 0, 1),
        _live(50012, "FLOAT32", -273.0, 1000.0),
    )
}
"""The emulated part of a TEC-1091's parameter table, by parameter number.

4040 to 4042 are the stability window (K), the least time in it (s) and the longest time to get there (s, 0
for no limit); 6320 is the time in saturation (ms, −1 for never) that leads to error 108.
"""


def stored(row: Parameter, value: float) -> float:
    """Return a value as the device keeps it: an integer, or a number of single precision."""
    if row.kind == "INT32":
        return int(value)
    try:
        return float(struct.unpack(">f", struct.pack(">f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)
