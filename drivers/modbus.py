"""Shared by the drivers of Modbus instruments: names of exceptions, and values in 16-bit registers."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Sequence
from typing import Any

# The drivers raise everything that pymodbus logs as an error, with the name of the device.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

_EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledge",
    6: "device busy",
    7: "negative acknowledge",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}


def exception_text(code: int, doing: str) -> str:
    """Describe a Modbus exception."""
    return f"Modbus exception {code} ({_EXCEPTIONS.get(code, 'unknown')}) on {doing}"


def pack(form: str, *values: float) -> list[int]:
    """Return values as registers, each 0 to 65535, high word first; `form` is one of `struct`."""
    data = struct.pack(f">{form}", *values)
    return list(struct.unpack(f">{len(data) // 2}H", data))


def unpack(form: str, words: Sequence[int]) -> tuple[Any, ...]:
    """Return the values in registers; the inverse of `pack`."""
    return struct.unpack(f">{form}", struct.pack(f">{len(words)}H", *words))


def swapped(words: Sequence[int], known: Callable[[Sequence[int]], bool]) -> str:
    """Describe the order in which `known` recognises a value; empty if it recognises none."""
    for unit, order in (
        ("words of a value", words[::-1]),
        ("bytes of a word", [(word & 0xFF) << 8 | word >> 8 for word in words]),
    ):
        if known(order):
            return f"sends the {unit} in swapped order; is there a gateway in between?"
    return ""
