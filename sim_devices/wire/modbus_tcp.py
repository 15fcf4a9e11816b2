"""Modbus TCP as LabJack speaks it, for any emulated instrument that is a bank of registers.

The framing is our own rather than pymodbus's, whose server was tried in its version 3.16: of several requests in
one segment it answers the first only, and after a frame with a foreign protocol identifier it keeps waiting with the
bytes in its buffer, so that the client is no longer served and gets no error. Its framing is also that of the client
of the drivers, where a misunderstanding would hide on both ends of the wire.

Sources: MODBUS Application Protocol Specification V1.1b3; MODBUS Messaging on TCP/IP Implementation Guide
V1.0b, section 3.1 (MBAP header).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np

from sim_devices.instruments.emulated import Pluggable
from sim_devices.wire import TcpServer
from sim_devices.wire.modbus import FEEDBACK, Feedback, Packet, RegisterBank, answer, prepare, refusal

_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), bytes that follow, unit
_KEY_END = _HEADER.size + 6  # function 16 has that many bytes before its values
_CONNECTIONS = 2
"""Connections that an instrument accepts. Source: T-series datasheet, 6.0 Ethernet, of a T7 on port 502. That it
refuses one more, and does not end the oldest instead, is an assumption."""
_MOST_BYTES = 1034  # unit identifier and the longest PDU of a T7, whose packets have up to 1040 bytes


_Known = tuple[int, bytes, bytes, Packet]
"""A known frame: its length, its end if that is always the same, the part of its reply before the values from the
protocol on, and the function that carries it out."""


class FramingError(Exception):
    """The bytes are no Modbus TCP, and where the next frame begins cannot be known."""


@runtime_checkable
class Restartable(Protocol):
    """An instrument that tells when it restarts."""

    def on_restart(self, follow: Callable[[], None]) -> None:
        """Call `follow()` at each restart."""


class ModbusTcpInstrument(TcpServer):
    """An instrument on TCP that accepts a few connections at a time.

    Parameters
    ----------
    bank : RegisterBank
        The instrument.
    """

    protocol = "Modbus TCP"
    has_addresses = True

    def __init__(self, bank: RegisterBank) -> None:
        self.bank = bank
        self._open: list[ModbusTcpStream] = []
        if isinstance(bank, Restartable):
            bank.on_restart(self.end_connections)

    def connect(self) -> ModbusTcpStream:
        """Open a connection.

        Raises `ConnectionRefusedError` if as many as the instrument accepts are open.
        """
        if len(self._open) >= _CONNECTIONS:
            raise ConnectionRefusedError(f"connection refused: the instrument has {_CONNECTIONS} open already")
        stream = ModbusTcpStream(self.bank, self._open.remove)
        self._open.append(stream)
        return stream

    def corrupted(self, answer: bytes, rng: np.random.Generator) -> bytes:
        """Return a reply with a wrong bit in its header: TCP has a check of its own, so that no value is wrong."""
        bit = int(rng.integers(16))
        return (int.from_bytes(answer[:2], "big") ^ 1 << bit).to_bytes(2, "big") + answer[2:]

    def readdressed(self, answer: bytes) -> bytes:
        """Return a reply that belongs to the transaction after its own."""
        return ((int.from_bytes(answer[:2], "big") + 1) & 0xFFFF).to_bytes(2, "big") + answer[2:]

    def end_connections(self) -> None:
        """End all connections, as a power cycle of the instrument does."""
        for stream in tuple(self._open):
            stream.close()


class ModbusTcpStream:
    """The instrument's end of one connection: bytes in, bytes out.

    Parameters
    ----------
    closed : callable
        Called once with the connection when it ends.
    """

    _MOST_KNOWN = 256

    def __init__(self, bank: RegisterBank, closed: Callable[[ModbusTcpStream], None] = lambda _: None) -> None:
        self._bank = bank
        self._line = bank if isinstance(bank, Pluggable) else None
        self._closed = closed
        self._own = {FEEDBACK: Feedback()}
        self._known: dict[bytes, _Known | None] = {}
        self._received = b""
        self._is_open = True

    @property
    def is_open(self) -> bool:
        """Whether neither end has closed it."""
        return self._is_open

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the client, in pieces of any size; return the replies to whole frames.

        Raises
        ------
        FramingError
            If the header is not one of Modbus; the connection is closed.
        ConnectionResetError
            If the connection is closed.
        """
        if not self._is_open:
            raise ConnectionResetError("the connection is closed")
        if self._line is not None and not self._line.answering:
            return b""
        # A fast loop sends the same few requests, each by itself, with other values in those that write.
        known = self._known.get(data[2:_KEY_END])
        if known is not None and not self._received:
            size, rest, head, packet = known
            if len(data) == size and data.endswith(rest):
                try:
                    return data[:2] + head + packet(data)
                except Exception as error:
                    return _framed(data, refusal(data[_HEADER.size :], error))
        received = self._received + data if self._received else data
        replies = b""
        begin, size = 0, len(received)
        while size - begin >= _HEADER.size:
            _, protocol, length, _ = _HEADER.unpack_from(received, begin)
            if protocol != 0 or not 2 <= length <= _MOST_BYTES:
                self.close()
                raise FramingError(f"protocol {protocol}, length {length}")
            end = begin + _HEADER.size + length - 1
            if size < end:
                break
            frame = received[begin:end]
            replies += _framed(frame, answer(self._bank, frame[_HEADER.size :], self._own))
            self._learn(frame)
            begin = end
        self._received = received[begin:]
        return replies

    def unsolicited(self) -> bytes:
        """Return nothing: a Modbus instrument speaks when it is asked."""
        return b""

    def next_unsolicited(self) -> float:
        """Return infinity."""
        return math.inf

    def _learn(self, frame: bytes) -> None:
        """Prepare for a request that may come again."""
        key = frame[2:_KEY_END]
        if key in self._known:
            return
        prepared = prepare(self._bank, frame[_HEADER.size :], _HEADER.size)
        if len(self._known) >= self._MOST_KNOWN:
            self._known.clear()
        if prepared is None:
            self._known[key] = None
            return
        rest = frame[_KEY_END:] if prepared.same == prepared.size else b""
        head = _framed(frame, prepared.head, prepared.answered)[2:]
        self._known[key] = len(frame), rest, head, prepared.packet

    def close(self) -> None:
        """End the connection; may be called again."""
        if self._is_open:
            self._is_open = False
            self._closed(self)


def _framed(request: bytes, reply: bytes, size: int | None = None) -> bytes:
    """Return a reply, or its beginning if it is of another `size`, behind the header for a request with its own."""
    transaction, _, _, unit = _HEADER.unpack_from(request)
    # Any unit is echoed: a device on TCP is addressed by its port.
    return _HEADER.pack(transaction, 0, (len(reply) if size is None else size) + 1, unit) + reply
