"""Modbus for emulated instruments that are banks of registers, independent of the transport.

Sources: MODBUS Application Protocol Specification V1.1b3; LabJack, Direct Modbus TCP, Protocol Details.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, Protocol, runtime_checkable

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
READS = (_READ_HOLDING, _READ_INPUT)
"""Functions that read registers."""
_BODY = struct.Struct(">BHH")  # function, address, and value or number of registers
_WRITE_HEAD = _BODY.size + 1  # and the number of bytes of the values
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

    def read_registers(self, address: int, count: int) -> list[int]:
        """Return `count` registers from `address` on, each 0 to 65535; raise `RegisterError` to refuse."""

    def write_registers(self, address: int, values: list[int]) -> None:
        """Write registers from `address` on, each 0 to 65535; raise `RegisterError` to refuse."""


class Frame(NamedTuple):
    """A frame of LabJack's function 76."""

    writes: bool
    """Whether it sets registers; it reads them otherwise."""
    address: int
    number: int
    """How many registers, 1 to 255."""


Packet = Callable[[bytes], bytes]
"""Carries the frames of a packet out, with the values in it, and returns what the reads among them give."""


@runtime_checkable
class PacketBank(Protocol):
    """A bank that can prepare for packets of the same frames with other values, as a fast loop sends them."""

    def prepare(self, frames: Sequence[Frame], heads: Sequence[int]) -> Packet | None:
        """Return what carries such packets out, with the result of frame by frame; None if it cannot.

        `heads` are the numbers of bytes of a packet that stand before the values of each frame.
        """


OwnFunctions = Mapping[int, Callable[[RegisterBank, bytes], bytes]]
"""Functions that only some instruments have: each takes what follows its code in a request, and returns the same."""


def answer(bank: RegisterBank, request: bytes, own: OwnFunctions = MappingProxyType({})) -> bytes:
    """Return the reply to one request, both without a header and at least one byte long."""
    function = request[0]
    try:
        if function in own:
            return request[:1] + own[function](bank, request[1:])
        return request[:1] + _carry_out(bank, function, request)
    except Exception as error:
        return refusal(request, error)


def refusal(request: bytes, error: Exception) -> bytes:
    """Return the reply to a request that was not carried out."""
    if isinstance(error, RegisterError):
        return bytes((request[0] | 0x80, error.code))
    # An emulator's defect must not end the server; the client sees a device that has failed.
    _log.error("the emulated instrument failed on request %s", request.hex(" "), exc_info=error)
    return bytes((request[0] | 0x80, DEVICE_FAILURE))


class Prepared(NamedTuple):
    """A request that is known, and may come again with other values if it writes."""

    size: int
    """Bytes of the request."""
    same: int
    """How many bytes at its beginning are always the same."""
    packet: Packet
    """Carries it out; takes the bytes before the request too."""
    head: bytes
    """What stands before the values of the reply."""
    answered: int
    """Bytes of the reply."""


def prepare(bank: RegisterBank, request: bytes, before: int) -> Prepared | None:
    """Prepare for a request that comes again; None if it is not well formed, or the instrument cannot.

    These are reads, writes of several registers, and packets of function 76 that only read. What carries the request
    out takes `before` bytes in front of it.
    """
    if not isinstance(bank, PacketBank) or len(request) < _BODY.size:
        return None
    function, size = request[0], len(request)
    if function == FEEDBACK:
        frames = _frames(request[1:])
        if frames is None or any(frame.writes for frame in frames):
            return None
        same, heads, head = size, [0] * len(frames), request[:1]
    else:
        _, address, number = _BODY.unpack_from(request)
        frames = [Frame(function == _WRITE_MANY, address, number)]
        if number == 0 or address + number > _REGISTERS:
            return None
        if function in READS and size == _BODY.size and number <= _MOST_READ:
            same, heads, head = size, [0], bytes((function, 2 * number))
        elif (
            function == _WRITE_MANY
            and number <= _MOST_WRITTEN
            and size == _WRITE_HEAD + 2 * number
            and request[5] == 2 * number
        ):
            same, heads, head = _WRITE_HEAD, [before + _WRITE_HEAD], request[: _BODY.size]
        else:
            return None
    packet = bank.prepare(frames, heads)
    if packet is None:
        return None
    answered = len(head) + sum(2 * frame.number for frame in frames if not frame.writes)
    return Prepared(size, same, packet, head, answered)


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


class Feedback:
    """Function 76 of one instrument, which prepares for the packets that come again and again.

    A packet is known again by all its bytes but the values that it writes.
    """

    _MOST_KNOWN = 256

    def __init__(self) -> None:
        self._known: dict[int, tuple[int, int, Packet]] = {}

    def __call__(self, bank: RegisterBank, body: bytes) -> bytes:
        """Carry a packet out; see `feedback`."""
        known = self._known.get(len(body))
        if known is not None:
            mask, pattern, carry_out = known
            if int.from_bytes(body) & mask == pattern:
                return carry_out(body)
        elif len(self._known) >= self._MOST_KNOWN:
            self._known.clear()
        if isinstance(bank, PacketBank) and (frames := _frames(body)) is not None:
            packet = bank.prepare(frames, [_FRAME.size] * len(frames))
            if packet is not None:
                mask = int.from_bytes(
                    b"".join(b"\xff" * _FRAME.size + bytes(2 * frame.number * frame.writes) for frame in frames)
                )
                self._known[len(body)] = mask, int.from_bytes(body) & mask, packet
                return packet(body)
        return feedback(bank, body)


def _frames(body: bytes) -> list[Frame] | None:
    """Return the frames of a packet that is well formed, and whose reply fits into a packet; None for another."""
    frames: list[Frame] = []
    position = answered = 0
    while position + _FRAME.size <= len(body):
        kind, address, number = _FRAME.unpack_from(body, position)
        if kind not in (_FRAME_READ, _FRAME_WRITE) or number == 0 or address + number > _REGISTERS:
            return None
        frames.append(Frame(kind == _FRAME_WRITE, address, number))
        position += _FRAME.size
        if kind == _FRAME_WRITE:
            position += 2 * number
        else:
            answered += 2 * number
    return frames if frames and position == len(body) and answered <= _MOST_FEEDBACK else None


def _check_range(address: int, count: int) -> None:
    if address + count > _REGISTERS:
        raise RegisterError(ILLEGAL_ADDRESS, f"registers {address} to {address + count - 1} do not exist")
