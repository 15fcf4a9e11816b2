"""Modbus for emulated instruments that are banks of registers, independent of the transport.

Source: MODBUS Application Protocol Specification V1.1b3.
"""

from __future__ import annotations

import logging
import struct
from typing import Protocol

ILLEGAL_FUNCTION = 1
ILLEGAL_ADDRESS = 2
ILLEGAL_VALUE = 3
DEVICE_FAILURE = 4

_READ_HOLDING, _READ_INPUT, _WRITE_ONE, _WRITE_MANY = 3, 4, 6, 16
_MOST_READ = 125  # registers in one read, Application Protocol 6.3
_MOST_WRITTEN = 123  # registers in one write, Application Protocol 6.12
_REGISTERS = 0x10000

_log = logging.getLogger(__name__)


class RegisterError(Exception):
    """An instrument refuses an access.

    Parameters
    ----------
    code : int
        Modbus exception code that the client gets, 1 to 255.
    message : str
        The reason, for a caller without a wire.
    """

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class RegisterBank(Protocol):
    """An instrument as Modbus sees it: 16-bit registers at addresses 0 to 65535."""

    def read_registers(self, address: int, count: int) -> list[int]:
        """Return `count` registers from `address` on, each 0 to 65535; raise `RegisterError` to refuse."""

    def write_registers(self, address: int, values: list[int]) -> None:
        """Write registers from `address` on, each 0 to 65535; raise `RegisterError` to refuse."""


def answer(bank: RegisterBank, request: bytes) -> bytes:
    """Return the reply to one request, both without a header and at least one byte long."""
    function = request[0]
    try:
        return bytes([function]) + _carry_out(bank, function, request[1:])
    except RegisterError as refusal:
        return bytes([function | 0x80, refusal.code])
    except Exception:
        # An emulator's defect must not end the server; the client sees a device that has failed.
        _log.exception("the emulated instrument failed on request %s", request.hex(" "))
        return bytes([function | 0x80, DEVICE_FAILURE])


def _carry_out(bank: RegisterBank, function: int, body: bytes) -> bytes:
    if function not in (_READ_HOLDING, _READ_INPUT, _WRITE_ONE, _WRITE_MANY):
        raise RegisterError(ILLEGAL_FUNCTION, f"function {function} is not supported")
    if len(body) < 4:
        raise RegisterError(ILLEGAL_VALUE, "the request is too short")
    address, number = struct.unpack_from(">HH", body)
    if function == _WRITE_ONE:
        if len(body) != 4:
            raise RegisterError(ILLEGAL_VALUE, "the request is too long")
        bank.write_registers(address, [number])
        return body
    if function == _WRITE_MANY:
        if not 1 <= number <= _MOST_WRITTEN or len(body) != 5 + 2 * number or body[4] != 2 * number:
            raise RegisterError(ILLEGAL_VALUE, "count and data do not agree")
        _check_range(address, number)
        bank.write_registers(address, list(struct.unpack_from(f">{number}H", body, 5)))
        return body[:4]
    if len(body) != 4 or not 1 <= number <= _MOST_READ:
        raise RegisterError(ILLEGAL_VALUE, f"count: allowed are 1 to {_MOST_READ}, got {number}")
    _check_range(address, number)
    words = bank.read_registers(address, number)
    return struct.pack(f">B{number}H", 2 * number, *words)


def _check_range(address: int, count: int) -> None:
    if address + count > _REGISTERS:
        raise RegisterError(ILLEGAL_ADDRESS, f"registers {address} to {address + count - 1} do not exist")
