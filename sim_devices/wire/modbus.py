"""Modbus for emulated instruments that are banks of registers, independent of the transport.

Sources: MODBUS Application Protocol Specification V1.1b3; LabJack, Direct Modbus TCP, Protocol Details.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import Protocol

ILLEGAL_FUNCTION = 1
ILLEGAL_ADDRESS = 2
ILLEGAL_VALUE = 3
DEVICE_FAILURE = 4

FEEDBACK = 76
"""LabJack's own function: reads and writes at several addresses in one packet."""

_READ_HOLDING, _READ_INPUT, _WRITE_ONE, _WRITE_MANY = 3, 4, 6, 16
_MOST_READ = 125  # registers in one read, Application Protocol 6.3
_MOST_WRITTEN = 123  # registers in one write, Application Protocol 6.12
_REGISTERS = 0x10000
_FUNCTIONS = frozenset((_READ_HOLDING, _READ_INPUT, _WRITE_ONE, _WRITE_MANY))
_BODY = struct.Struct(">BHH")  # function, address, and value or number of registers
_WORDS = tuple(struct.Struct(f">{number}H") for number in range(256))
_FRAME = struct.Struct(">BHB")  # of function 76: kind, address, number of registers
_FRAME_READ, _FRAME_WRITE = 0, 1
_MOST_FEEDBACK = 1040 - 8  # bytes that a packet of a T7 has behind its header and the function

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

    def request(self) -> AbstractContextManager[None]:
        """Serve all accesses within as one request."""

    def read_registers(self, address: int, count: int) -> list[int]:
        """Return `count` registers from `address` on, each 0 to 65535; raise `RegisterError` to refuse."""

    def write_registers(self, address: int, values: list[int]) -> None:
        """Write registers from `address` on, each 0 to 65535; raise `RegisterError` to refuse."""


OwnFunctions = Mapping[int, Callable[[RegisterBank, bytes], bytes]]
"""Functions that only some instruments have: each takes what follows its code in a request, and returns the same."""


def answer(bank: RegisterBank, request: bytes, own: OwnFunctions = MappingProxyType({})) -> bytes:
    """Return the reply to one request, both without a header and at least one byte long."""
    function = request[0]
    try:
        if function in own:
            with bank.request():
                return request[:1] + own[function](bank, request[1:])
        return request[:1] + _carry_out(bank, function, request)
    except RegisterError as error:
        return bytes((function | 0x80, error.code))
    # An emulator's defect must not end the server; the client sees a device that has failed.
    except Exception:
        _log.exception("the emulated instrument failed on request %s", request.hex(" "))
        return bytes((function | 0x80, DEVICE_FAILURE))


def _carry_out(bank: RegisterBank, function: int, request: bytes) -> bytes:
    if function not in _FUNCTIONS:
        raise RegisterError(ILLEGAL_FUNCTION, f"function {function} is not supported")
    size = len(request)
    if size < _BODY.size:
        raise RegisterError(ILLEGAL_VALUE, "the request is too short")
    _, address, number = _BODY.unpack_from(request)
    if function == _WRITE_ONE:
        if size != _BODY.size:
            raise RegisterError(ILLEGAL_VALUE, "the request is too long")
        bank.write_registers(address, [number])
        return request[1:]
    if function == _WRITE_MANY:
        if not 1 <= number <= _MOST_WRITTEN or size != 6 + 2 * number or request[5] != 2 * number:
            raise RegisterError(ILLEGAL_VALUE, "count and data do not agree")
        _check_range(address, number)
        bank.write_registers(address, list(_WORDS[number].unpack_from(request, 6)))
        return request[1 : _BODY.size]
    if size != _BODY.size or not 1 <= number <= _MOST_READ:
        raise RegisterError(ILLEGAL_VALUE, f"count: allowed are 1 to {_MOST_READ}, got {number}")
    _check_range(address, number)
    words: bytes = _WORDS[number].pack(*bank.read_registers(address, number))
    return bytes((2 * number,)) + words


def feedback(bank: RegisterBank, body: bytes) -> bytes:
    """Carry the frames of LabJack's function 76 out, one after the other, and return what the reads among them give.

    A frame is its kind (0 read, 1 write), the address, and the number of registers, followed by their values if it
    is a write (Direct Modbus TCP, Protocol Details, Modbus Feedback). The first frame that is refused ends the
    request; those before it have been carried out.
    """
    values = b""
    position = 0
    if not body:
        raise RegisterError(ILLEGAL_VALUE, "there is no frame")
    while position < len(body):
        if len(body) < position + _FRAME.size:
            raise RegisterError(ILLEGAL_VALUE, "a frame is too short")
        kind, address, number = _FRAME.unpack_from(body, position)
        position += _FRAME.size
        if kind not in (_FRAME_READ, _FRAME_WRITE) or number == 0:
            raise RegisterError(ILLEGAL_VALUE, f"frame of kind {kind} with {number} registers")
        _check_range(address, number)
        words = _WORDS[number]
        if kind == _FRAME_READ:
            # Before it is read: the readings of some registers are bursts, which take their time.
            if len(values) + words.size > _MOST_FEEDBACK:
                raise RegisterError(ILLEGAL_VALUE, "the reply is longer than a packet")
            values += words.pack(*bank.read_registers(address, number))
        elif len(body) < position + words.size:
            raise RegisterError(ILLEGAL_VALUE, "count and data do not agree")
        else:
            bank.write_registers(address, list(words.unpack_from(body, position)))
            position += words.size
    return values


def _check_range(address: int, count: int) -> None:
    if address + count > _REGISTERS:
        raise RegisterError(ILLEGAL_ADDRESS, f"registers {address} to {address + count - 1} do not exist")
