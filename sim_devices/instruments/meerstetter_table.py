"""The parameter table of a Meerstetter TEC-1091, its states and its error numbers.

Numbers, types, ranges and instances are those that a TEC-1091 with firmware 4.10 reported to `?VM` (JulienKluge/
pyMeComTEC, api/src/get_params/params.csv), but for the response delay (2052), whose range Meerstetter 5136AL (TEC
controller communication protocol) gives as 0 to 1 s. Defaults are ours.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from sim_devices.instruments.emulated import RequestRefusedError

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
    instances: int = 2
    """How many there are: 1 for the whole device, 2 for the channels of the family, 8 for the digital lines."""


def _integer(number: int, high: float, default: float = 0, *, low: float = 0, instances: int = 2) -> Parameter:
    return Parameter(number, "INT32", low, high, default, instances=instances)


def _real(number: int, low: float, high: float, default: float, *, instances: int = 2) -> Parameter:
    return Parameter(number, "FLOAT32", low, high, default, instances=instances)


def _integer_reading(number: int, *, high: float = _HIGHEST_INT, instances: int = 1) -> Parameter:
    return Parameter(number, "INT32", 0, high, 0, writable=False, instances=instances)


def _real_reading(number: int, *, instances: int = 2) -> Parameter:
    return Parameter(number, "FLOAT32", -math.inf, math.inf, 0.0, writable=False, instances=instances)


def _live(
    number: int, kind: Literal["INT32", "FLOAT32"], low: float, high: float, *, instances: int = 2
) -> Parameter:
    return Parameter(number, kind, low, high, 0, volatile=True, instances=instances)


PARAMETERS = {
    parameter.number: parameter
    for parameter in (
        *(_integer_reading(number) for number in (100, 101, 102, 103, 104, 105, 106, 107)),
        Parameter(108, "INT32", 0, 1, 0, volatile=True, instances=1),
        _integer_reading(109, high=2),
        *(_real_reading(number) for number in (1000, 1001, 1010, 1011, 1020, 1021)),
        *(_real_reading(number, instances=1) for number in (1060, 1063)),
        _integer_reading(1200, high=2, instances=2),
        _integer(2000, 2, CONTROLLER),
        _integer(2010, 3, ENABLE_OFF),
        _real(2020, -4.0, 4.0, 0.0),
        _real(2021, 0.0, 21.0, 0.0),
        _real(2030, 0.0, 4.0, 4.0),
        _real(2031, 0.0, 21.0, 21.0),
        _real(2032, 0.0, 5.6, 5.0),
        _real(2033, 0.0, 25.0, 22.0),
        _integer(2040, 2, instances=1),
        _integer(2050, 1_000_000, 57600, low=4800, instances=3),
        _integer(2051, 254, 1, low=1, instances=1),
        _integer(2052, 1_000_000, instances=3),
        _real(2060, 0.0, 600.0, 0.0, instances=1),
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
        _integer(6100, 21, instances=8),
        _integer(6101, 2, instances=8),
        _integer(6102, 6, instances=8),
        _integer(6103, 2, 1, low=1, instances=8),
        _integer(6300, 2),
        _integer(6302, 2),
        _real(6310, 0.0, 86400.0, 0.0, instances=1),
        _integer(6320, 20_000_000, 1, low=-1),
        _live(50000, "INT32", 0, 1),
        _live(50001, "FLOAT32", -4.0, 4.0),
        _live(50002, "FLOAT32", 0.0, 21.0),
        _live(50011, "INT32", 0, 1),
        _live(50012, "FLOAT32", -273.0, 1000.0),
        *(_live(number, "INT32", 0, high, instances=1) for number, high in ((52100, 1), (52101, 255), (52102, 255))),
        _integer_reading(52103, high=255),
        _live(52200, "FLOAT32", -273.0, 1000.0),
    )
}
"""The emulated part of a TEC-1091's parameter table, by parameter number.

4040 to 4042 are the stability window (K), the least time in it (s) and the longest time to get there (s, 0
for no limit); 6100 to 6103 and 52100 to 52103 set up, drive and read the digital lines; 6300 and 52200 let the host
measure the object temperature instead of the device; 6320 is the time in saturation (ms, −1 for never) that leads to
error 108. Of 2060 (communication watchdog, s) the values between 0 and 0.1 are left out.
"""

SENSOR_READINGS = (1000, 1001)
"""Parameters that a sensor measures: without it, as on a channel that is not there, they are not a number."""


def find_parameter(number: int, instance: int = 1) -> Parameter:
    """Return the row of a parameter.

    Raises `RequestRefusedError` if there is no such parameter or no such instance of it.
    """
    row = PARAMETERS.get(number)
    if row is None:
        raise RequestRefusedError(ServerError.PARAMETER_NOT_AVAILABLE)
    if not 1 <= instance <= row.instances:
        raise RequestRefusedError(ServerError.INSTANCE_NOT_AVAILABLE)
    return row


def stored(row: Parameter, value: float) -> float:
    """Return a value as the device keeps it: an integer, or a number of single precision."""
    if row.kind == "INT32":
        return int(value)
    try:
        return float(struct.unpack(">f", struct.pack(">f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)
