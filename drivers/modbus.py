"""Shared by the drivers of Modbus instruments: a client of few calls, names of exceptions, values in registers.

`ModbusClient` is what a driver needs of a client. On `emulated://` addresses it is one of ours (`TcpClient`,
`RtuClient`), which costs microseconds; on real lines it is pymodbus behind the same calls.

Sources: MODBUS Application Protocol Specification V1.1b3; MODBUS Messaging on TCP/IP V1.0b, 3.1; MODBUS over Serial
Line V1.02, 2.5.1 and 6.2.2; LabJack, Direct Modbus TCP, Protocol Details, for function 76.
"""

from __future__ import annotations

import logging
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from bench.base import crc16_modbus
from drivers.serial_line import settle_line

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


READ, READ_INPUT, WRITE_ONE, WRITE, FEEDBACK = 3, 4, 6, 16, 76
"""Functions: read holding or input registers, write one, write several, and LabJack's own for both in one packet."""

_READ = struct.Struct(">BHH")  # function, address, number of registers
_WRITE = struct.Struct(">BHHB")  # the same, and number of bytes
_FRAME = struct.Struct(">BHB")  # of function 76: kind, address, number of registers
_FRAME_READ, _FRAME_WRITE = 0, 1
_MBAP = struct.Struct(">HHHB")  # transaction, protocol (0), bytes that follow, unit
_HEADER_SIZE = _MBAP.size
_pack_header = _MBAP.pack
_pack_reply_head = struct.Struct(">HHHBB").pack  # the same, and the function
_LAST_TRANSACTION = 0xFFFF
_REFUSED = 0x80
_KNOWN_FRAMES = 64  # that are kept; a host asks the same few again and again
_KNOWN_REPLIES = 1024  # whose CRC is kept; what is at rest gives the same few readings


class RefusedError(Exception):
    """The instrument refuses a request.

    Parameters
    ----------
    code : int
        Modbus exception code.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


@lru_cache(_KNOWN_FRAMES)
def read_request(address: int, count: int, function: int = READ) -> bytes:
    """Return the request for `count` registers from `address` on; its reply has 2 bytes more than their values."""
    return _READ.pack(function, address, count)


def write_request(address: int, data: bytes) -> bytes:
    """Return the request that sets registers from `address` on, two bytes each; its reply is its first 5 bytes."""
    return _WRITE.pack(WRITE, address, len(data) // 2, len(data)) + data


def read_frame(address: int, count: int) -> bytes:
    """Return the frame of function 76 that reads `count` registers, 1 to 255, from `address` on."""
    return _FRAME.pack(_FRAME_READ, address, count)


def write_frame(address: int, data: bytes) -> bytes:
    """Return the frame of function 76 that sets registers from `address` on, two bytes each."""
    return _FRAME.pack(_FRAME_WRITE, address, len(data) // 2) + data


class ModbusClient(ABC):
    """The connection to one Modbus instrument; one request at a time.

    Values are bytes, high byte and high word first. Every request raises `RefusedError` if the instrument refuses,
    and `OSError` if it does not answer, its answer belongs to no question, or the line is lost.
    """

    def read(self, address: int, count: int, function: int = READ) -> bytes:
        """Return the values of `count` registers from `address` on, two bytes each."""
        reply = self.request(read_request(address, count, function), 2 + 2 * count)
        if reply[1] != 2 * count:
            raise OSError(f"the answer has {reply[1]} bytes of values where {2 * count} were asked for")
        return reply[2:]

    def write(self, address: int, data: bytes) -> None:
        """Set registers from `address` on, two bytes each."""
        request = write_request(address, data)
        self._check_echo(self.request(request, _READ.size), request)

    def write_one(self, address: int, value: int) -> None:
        """Set one register to a value from 0 to 65535."""
        request = _READ.pack(WRITE_ONE, address, value)
        self._check_echo(self.request(request, _READ.size), request)

    def feedback(self, frames: bytes, expected: int) -> bytes:
        """Carry out frames of LabJack's function 76 in one request; return what those that read give, in bytes."""
        return self.request(bytes((FEEDBACK,)) + frames, 1 + expected)[1:]

    @abstractmethod
    def request(self, request: bytes, expected: int) -> bytes:
        """Send a request, from its function on, and return its reply, of an `expected` number of bytes."""

    @abstractmethod
    def wait_for(self, seconds: float) -> None:
        """Wait so long for a reply from now on, s."""

    @abstractmethod
    def close(self) -> None:
        """Release the line; may be called again."""

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether the line can be used."""

    @staticmethod
    def _check_echo(reply: bytes, request: bytes) -> None:
        if reply != request[: _READ.size]:
            raise OSError(f"the answer {reply.hex(' ')} is none to the request {request.hex(' ')}")


class _PortClient(ModbusClient):
    """A client of ours on a port of pyserial."""

    def __init__(self, port: Any) -> None:  # noqa: ANN401 - pyserial is untyped
        self._port = port

    def wait_for(self, seconds: float) -> None:
        """Wait so long for a reply from now on, s."""
        self._port.timeout = seconds

    def close(self) -> None:
        """Release the line; may be called again."""
        self._port.close()

    @property
    def is_open(self) -> bool:
        """Whether the line can be used."""
        try:
            return bool(self._port.is_open and self._port.in_waiting >= 0)
        except OSError:
            return False

    def _receive(self, received: bytes, size: int) -> bytes:
        """Return what was received up to `size` bytes, after what is missing has been waited for."""
        if len(received) < size:
            received += self._port.read(size - len(received))
            if len(received) < size:
                raise TimeoutError(f"{len(received)} bytes where {size} were expected")
        return received


class TcpClient(_PortClient):
    """Modbus TCP over a port of pyserial, for `emulated://` addresses.

    Parameters
    ----------
    port : serial.SerialBase
        The open port.
    unit : int
        Unit identifier, 0 to 255.
    """

    def __init__(self, port: Any, unit: int = 1) -> None:  # noqa: ANN401 - pyserial is untyped
        super().__init__(port)
        self._unit = unit
        self._transaction = 0

    def request(self, request: bytes, expected: int) -> bytes:
        """Send a request, from its function on, and return its reply, of an `expected` number of bytes."""
        transaction = self._transaction = (self._transaction + 1) & _LAST_TRANSACTION
        unit = self._unit
        self._port.write(_pack_header(transaction, 0, len(request) + 1, unit) + request)
        # In process the reply has come already.
        reply: bytes = self._port.read_all()
        size = _HEADER_SIZE + expected
        if len(reply) == size and reply.startswith(_pack_reply_head(transaction, 0, expected + 1, unit, request[0])):
            return reply[_HEADER_SIZE:]
        # The shortest reply is a refusal, a function and a code.
        reply = self._receive(reply, _HEADER_SIZE + min(expected, 2))
        answered, protocol, length, answering = _MBAP.unpack_from(reply)
        function = reply[_HEADER_SIZE]
        if answered != transaction or protocol != 0 or answering != unit or function & ~_REFUSED != request[0]:
            raise OSError(f"the answer {reply.hex(' ')} belongs to another request")
        if function & _REFUSED:
            raise RefusedError(self._receive(reply, _HEADER_SIZE + 2)[-1])
        if length != expected + 1:
            raise OSError(f"the answer has {length - 1} bytes where {expected} were expected")
        return self._receive(reply, size)[_HEADER_SIZE:size]


crc16 = lru_cache(_KNOWN_REPLIES)(crc16_modbus)
"""The CRC of a frame as it follows on the line."""


class NoReplyError(OSError):
    """No good reply came; the line itself works.

    Parameters
    ----------
    message : str
        What came instead.
    heard : bytes
        What came, if it does not begin as a reply of the instrument does.
    """

    def __init__(self, message: str, heard: bytes = b"") -> None:
        super().__init__(message)
        self.heard = heard


class UnexpectedReplyError(NoReplyError):
    """Only good replies of another form than the request asks for came."""

    def __init__(self, request: bytes, expected: int, function: int, length: int) -> None:
        super().__init__(
            f"the answer has {length} bytes where {expected} were expected (function {request[0]} was asked for, "
            f"{function} answered)"
        )


SHORTEST_REPLY = 5
"""Bytes of the shortest reply on a serial line: address, function, one byte, CRC."""
LONGEST_REPLY = 256
"""Bytes of the longest reply on a serial line (2.5.1.1)."""

_WRITE_REPLY = 8
_MOST_STRAY_REPLIES = 8


def reply_length(head: bytes) -> int:
    """Return the bytes of the reply on a serial line whose first 5 are known; 5 if it is none."""
    function = head[1]
    if function in (READ, READ_INPUT):
        return SHORTEST_REPLY + head[2]
    if function in (WRITE_ONE, WRITE):
        return _WRITE_REPLY
    return SHORTEST_REPLY


def is_reply_to(request: bytes, expected: int, frame: bytes) -> bool:
    """Return whether a good frame has the form of a reply to a request, or of its refusal."""
    return frame[1] == request[0] | _REFUSED or (frame[1] == request[0] and len(frame) == expected + 3)


@lru_cache(_KNOWN_FRAMES)
def _framed(unit: int, request: bytes) -> bytes:
    frame = bytes((unit,)) + request
    return frame + crc16(frame)


class RtuClient(_PortClient):
    """Modbus RTU over a port of pyserial, for `emulated://` addresses.

    A reply does not say which request it belongs to. One that has the form of another than the request is skipped.

    Parameters
    ----------
    port : serial.SerialBase
        The open port.
    unit : int
        Address of the instrument, 1 to 247.
    """

    def __init__(self, port: Any, unit: int) -> None:  # noqa: ANN401 - pyserial is untyped
        super().__init__(port)
        self._unit = unit

    def request(self, request: bytes, expected: int) -> bytes:
        """Send a request, from its function on, and return its reply, of an `expected` number of bytes.

        Raises `NoReplyError` or `UnexpectedReplyError`, besides what the base class says.
        """
        self._port.reset_input_buffer()
        self._port.write(_framed(self._unit, request))
        reply: bytes = self._port.read_all()
        if len(reply) != expected + 3 or reply[0] != self._unit or reply[1] != request[0]:
            reply = self._reply_among(reply, request, expected)
            if reply[1] == request[0] | _REFUSED:
                raise RefusedError(reply[2])
        elif crc16(reply[:-2]) != reply[-2:]:
            raise NoReplyError("damaged reply")
        return reply[1:-2]

    def settle(self, silence: float) -> None:
        """Discard what comes until nothing has come for `silence` seconds; raises `OSError` if that does not end."""
        settle_line(self._port, silence)

    def _reply_among(self, received: bytes, request: bytes, expected: int) -> bytes:
        """Return the reply among what has come and comes."""
        stray = b""
        for _ in range(_MOST_STRAY_REPLIES):
            received = self._fill(received, SHORTEST_REPLY)
            if len(received) < SHORTEST_REPLY:
                break
            length = reply_length(received)
            received = self._fill(received, length)
            reply, received = received[:length], received[length:]
            if len(reply) < length or reply[0] != self._unit or crc16(reply[:-2]) != reply[-2:]:
                raise NoReplyError(f"{len(reply)} bytes that are no good reply", self._foreign(reply))
            if is_reply_to(request, expected, reply):
                return reply
            stray = reply
        if stray:
            raise UnexpectedReplyError(request, expected, stray[1], len(stray) - 3)
        raise NoReplyError(f"{len(received)} bytes that are no good reply", self._foreign(received))

    def _foreign(self, received: bytes) -> bytes:
        return b"" if received[:1] == bytes((self._unit,)) else received

    def _fill(self, received: bytes, size: int) -> bytes:
        """Wait until so many bytes are there, for the timeout at most; return what is there."""
        if len(received) < size:
            received += self._port.read(size - len(received))
        return received


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
