"""The CANopen object dictionary of a Roboteq SDC2160.

Sources: Roboteq CANBus Networking Manual V2.0 (objects, their types and scales, PDO mapping), the electronic data
sheet `roboteq_motor_controllers_v60.eds` (communication objects), CiA 301 (abort codes, NMT states).

Assumptions: flags have 16 bits (0x2111, 0x2112, according to the manual; the data sheet says 8) and 32 bits
(0x2122); there are 16 user variables; all runtime queries can be mapped to TPDOs and all runtime commands to RPDOs.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Literal

CHANNELS = 2
"""Motor outputs of an SDC2160."""

VARIABLES = 16
"""User variables of MicroBasic scripts."""

PDOS = 4
"""Process data objects of each direction."""

MOST_MAPPED = 8
"""Objects that one of them can carry, of a byte each."""

TRANSMIT_PARAMETERS, TRANSMIT_MAPPING = 0x1800, 0x1A00
RECEIVE_PARAMETERS, RECEIVE_MAPPING = 0x1400, 0x1600


class Fault(IntFlag):
    """Bits of the fault flags, object 0x2112."""

    OVERHEAT = 0x01
    OVER_VOLTAGE = 0x02
    UNDER_VOLTAGE = 0x04
    SHORT_CIRCUIT = 0x08
    EMERGENCY_STOP = 0x10
    SETUP = 0x20
    MOSFET = 0x40
    DEFAULT_CONFIGURATION = 0x80


class ChannelFlag(IntFlag):
    """Bits of the channel flags, object 0x2122."""

    AMPS_LIMIT = 0x01
    STALL = 0x02
    LOOP_ERROR = 0x04
    SAFETY_STOP = 0x08
    FORWARD_LIMIT = 0x10
    REVERSE_LIMIT = 0x20
    AMPS_TRIGGER = 0x40


class NodeState(IntEnum):
    """NMT states as a heartbeat reports them (CiA 301)."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class AbortCode(IntEnum):
    """Why an SDO transfer ends (CiA 301, SDO abort codes)."""

    TOGGLE = 0x0503_0000
    COMMAND = 0x0504_0001
    UNSUPPORTED = 0x0601_0000
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    MAPPING_TOO_LONG = 0x0604_0042
    LENGTH = 0x0607_0010
    NO_SUBINDEX = 0x0609_0011
    VALUE = 0x0609_0030


Kind = Literal["S8", "U8", "S16", "U16", "S32", "U32", "text"]

FORMATS: dict[Kind, struct.Struct] = {
    "S8": struct.Struct("<b"),
    "U8": struct.Struct("<B"),
    "S16": struct.Struct("<h"),
    "U16": struct.Struct("<H"),
    "S32": struct.Struct("<i"),
    "U32": struct.Struct("<I"),
}
"""How a number of each type is carried."""


@dataclass(frozen=True)
class Entry:
    """One row of the object dictionary."""

    kind: Kind
    """Type of the value."""
    readable: bool = True
    writable: bool = False
    """Which ways it can be transferred."""


def _dictionary() -> dict[tuple[int, int], Entry]:
    command = {"readable": False, "writable": True}
    rows: dict[tuple[int, int], Entry] = {
        (0x1000, 0): Entry("U32"),
        (0x1001, 0): Entry("U8"),
        (0x1008, 0): Entry("text"),
        (0x1009, 0): Entry("text"),
        (0x100A, 0): Entry("text"),
        (0x1016, 0): Entry("U8"),
        **{(0x1016, sub): Entry("U32", writable=True) for sub in range(1, 5)},
        (0x1017, 0): Entry("U16", writable=True),
        **{(0x1018, sub): Entry("U32" if sub else "U8") for sub in range(4)},
        **{(index, 0): Entry("U8", **command) for index in (0x200C, 0x200D, 0x200E)},
        **{(0x210D, sub): Entry("U16") for sub in (1, 2, 3)},
        **{(0x210F, sub): Entry("S8") for sub in (1, 2)},
        (0x2111, 0): Entry("U16"),
        (0x2112, 0): Entry("U16"),
    }
    for number in range(PDOS):
        for parameters in (TRANSMIT_PARAMETERS, RECEIVE_PARAMETERS):
            rows[parameters + number, 0] = Entry("U8")
            rows[parameters + number, 1] = Entry("U32", writable=True)
            rows[parameters + number, 2] = Entry("U8", writable=True)
        for mapping in (TRANSMIT_MAPPING, RECEIVE_MAPPING):
            rows[mapping + number, 0] = Entry("U8", writable=True)
            rows |= {(mapping + number, 1 + place): Entry("U32", writable=True) for place in range(MOST_MAPPED)}
    for channel in range(1, CHANNELS + 1):
        rows |= {(index, channel): Entry("S32", **command) for index in (0x2000, 0x2003)}
        rows |= {(index, channel): Entry("S16") for index in (0x2100, 0x2101, 0x2102, 0x210C)}
        rows[0x2104, channel] = Entry("S32")
        rows[0x2122, channel] = Entry("U32")
    for variable in range(1, VARIABLES + 1):
        rows[0x2005, variable] = Entry("S32", **command)
        rows[0x2106, variable] = Entry("S32")
    return rows


DICTIONARY = _dictionary()
"""The emulated part of the object dictionary, by index and subindex."""

INDICES = frozenset(index for index, _ in DICTIONARY)
"""The objects that exist."""
