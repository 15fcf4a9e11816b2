"""Modbus RTU on a serial line, for any emulated instrument that is a bank of registers.

On a real line a pause of 3.5 characters ends a frame. A stream of bytes has no pauses, so frames are found by
their content: the function code gives the length of a request, the CRC confirms it. Data that does not
form a request is skipped, and a whole request to this instrument is found behind it at once,
not only after the number of bytes that the garbage seemed to announce.

Functions 3, 4, 6 and 16 are carried out. The other functions of the specification are refused with exception
1; to a function code that it does not define there is no answer, as the length of such a request is unknown.

Sources: MODBUS over Serial Line, Specification and Implementation Guide V1.02, sections 2.2 (addresses,
broadcast), 2.5.1 (RTU framing) and 6.2.2 (CRC); MODBUS Application Protocol Specification V1.1b3, section 6
(lengths of requests).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from bench.base import crc16_modbus as crc16
from sim_devices.instruments.emulated import Pluggable
from sim_devices.wire import WireServer
from sim_devices.wire.modbus import RegisterBank, answer

BROADCAST = 0
LONGEST_FRAME = 256
"""Bytes of the longest frame, Serial Line 2.5.1."""

_SHORTEST_FRAME = 4
_FIXED: Mapping[int, int] = {
    **dict.fromkeys((1, 2, 3, 4, 5, 6, 8), 8),
    **dict.fromkeys((7, 11, 12, 17), 4),
    22: 10,
    24: 6,
    43: 7,
}
"""Bytes of a request by function code, from the address to the CRC."""

_COUNTED: Mapping[int, tuple[int, int]] = {15: (9, 6), 16: (9, 6), 20: (5, 2), 21: (5, 2), 23: (13, 10)}
"""Bytes of a request without its data, and where the number of bytes of its data stands."""


_known_crc = lru_cache(maxsize=1024)(crc16)
"""A host asks the same few requests again and again, and what is at rest gives the same few readings."""


class ModbusRtuServer(WireServer):
    """The serial side of an emulated instrument.

    Requests to other addresses have no answer. A broadcast to address 0 is carried out and not answered.

    Parameters
    ----------
    address : int
        Address of the instrument on its line, 1 to 247.

    Raises
    ------
    ValueError
        If the address is not allowed.
    """

    protocol = "Modbus RTU"
    has_addresses = True

    def __init__(self, bank: RegisterBank, address: int = 1) -> None:
        if not 1 <= address <= 247:
            raise ValueError(f"address: allowed are 1 to 247, got {address}")
        self._bank = bank
        self._address = address
        self._line = bank if isinstance(bank, Pluggable) else None
        self._received = bytearray()

    @property
    def address(self) -> int:
        """Address of the instrument on its line."""
        return self._address

    def readdressed(self, answer: bytes) -> bytes:
        """Return a reply of the next address."""
        body = bytes((answer[0] % 247 + 1,)) + answer[1:-2]
        return body + crc16(body)

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the line, in pieces of any size; return the replies to whole requests."""
        if self._line is not None and not self._line.answering:
            self._received.clear()
            return b""
        if not self._received:
            # The usual case: a client that sends one request and waits.
            if self._is_request(data):
                return self._serve(data)
            if (
                data[:1] not in (bytes((self._address,)), b"\0")
                and len(data) >= _SHORTEST_FRAME
                and crc16(data) == b"\0\0"
            ):
                # A whole frame of somebody else on the line, which the pauses around it set apart.
                return b""
        self._received += data
        replies = bytearray()
        received = memoryview(bytes(self._received))
        begin = 0
        while (found := self._find(received[begin:])) is not None:
            start, end = found
            replies += self._serve(bytes(received[begin + start : begin + end]))
            begin += end
        del self._received[:begin]
        # What a frame can still become the beginning of is shorter than the longest frame.
        del self._received[: max(len(self._received) - LONGEST_FRAME + 1, 0)]
        return bytes(replies)

    def _is_request(self, data: bytes) -> bool:
        """Return whether these bytes are one whole request to this instrument."""
        return (
            len(data) >= _SHORTEST_FRAME
            and data[0] == self._address
            and _length(data) == len(data)
            and data[-2:] == _known_crc(data[:-2])
        )

    def _find(self, received: memoryview) -> tuple[int, int] | None:
        """Return where the first whole request begins and ends."""
        for start in range(len(received) - _SHORTEST_FRAME + 1):
            # Behind bytes that are none of a request, only one to this instrument is trusted to be one.
            if start and received[start] not in (self._address, BROADCAST):
                continue
            length = _length(received[start:])
            if length is None or start + length > len(received):
                continue
            body = received[start : start + length - 2]
            if received[start + length - 2 : start + length] == crc16(body):
                return start, start + length
        return None

    def _serve(self, frame: bytes) -> bytes:
        address = frame[0]
        if address not in (self._address, BROADCAST):
            return b""
        reply = frame[:1] + answer(self._bank, frame[1:-2])
        return b"" if address == BROADCAST else reply + _known_crc(reply)


def _length(received: bytes | memoryview) -> int | None:
    """Return the length of the request that begins here; None if it is none, or too little has come."""
    function = received[1]
    if function in _FIXED:
        return _FIXED[function]
    if function not in _COUNTED:
        return None
    rest, position = _COUNTED[function]
    if len(received) <= position:
        return None
    length = rest + received[position]
    return length if length <= LONGEST_FRAME else None
