"""A CANopen node behind an slcan adapter, as a serial line sees them.

The adapter speaks the ASCII protocol of the LAWICEL CAN232 (LAWICEL CAN232 manual V3): lines that end with a
carriage return, answered by a carriage return, or by BEL when they cannot be obeyed. `C` closes and `O` opens
the channel, `L` opens it for listening, `Sn` selects the bit rate; `t` and `T` carry a frame with an 11-bit and
a 29-bit identifier, `r` and `R` remote frames. Closing a closed channel, opening an open one and empty lines are
obeyed, as python-can sends all of these.

The node serves SDO as in CiA 301: expedited download and upload, segmented upload of texts, aborts; network
management commands and its heartbeat. It takes the simplified command bytes of Roboteq CANBus Networking Manual
V2.0, whose bits e and s are 0, as well, and answers them by the standard ones.

Assumptions: a frame that is sent at another bit rate than that of the bus is lost without an error; segmented and
block downloads are refused; a remote frame is not answered.
"""

from __future__ import annotations

import math
import re
import struct

from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.instruments.roboteq import AbortCode, EmulatedRoboteq, Kind, NodeState
from sim_devices.wire import WireServer

LONGEST_LINE = 64
"""Characters after which a line without an end is dropped; the longest real one has 26."""

BITRATES = {
    b"S0": 10_000,
    b"S1": 20_000,
    b"S2": 50_000,
    b"S3": 100_000,
    b"S4": 125_000,
    b"S5": 250_000,
    b"S6": 500_000,
    b"S7": 800_000,
    b"S8": 1_000_000,
}
"""Bit rates of the bus, bit/s, by the command that selects them (LAWICEL CAN232 manual)."""

_OK = b"\r"
_REFUSED = b"\a"
_FRAME = re.compile(rb"(?:([tr])([0-7][0-9A-Fa-f]{2})|([TR])([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2}){0,8})")
_FORMATS: dict[Kind, str] = {"S8": "<b", "U8": "<B", "S16": "<h", "U16": "<H", "S32": "<i", "U32": "<I"}
_SDO_REQUEST, _SDO_ANSWER, _HEARTBEAT = 0x600, 0x580, 0x700
_SEGMENT = 7  # bytes in a segment


class CanopenSlcanServer(WireServer):
    """The serial side of an slcan adapter with one emulated controller on its bus."""

    protocol = "CANopen over slcan"

    def __init__(self, device: EmulatedRoboteq) -> None:
        self._device = device
        self._node = SdoServer(device)
        self._received = b""
        self._overrun = False
        self._bitrate = 0
        self._open = False
        self._listening = False

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the adapter sends."""
        with self._device.world.lock:
            *lines, rest = (self._received + data).split(b"\r")
            sent = self._heartbeats()
            for line in lines:
                sent += _REFUSED if self._overrun or len(line) > LONGEST_LINE else self._obey(line)
                self._overrun = False
            # A line that is too long is refused up to its end.
            self._overrun = self._overrun or len(rest) > LONGEST_LINE
            self._received = b"" if self._overrun else rest
            return sent

    def unsolicited(self) -> bytes:
        """Return the heartbeats since they were last sent."""
        with self._device.world.at_present():
            return self._heartbeats()

    def next_unsolicited(self) -> float:
        """Return the laboratory time (s) of the next heartbeat that the host sees; infinity if it sees none."""
        return self._device.next_heartbeat() if self._on_the_bus() and self._device.plugged_in else math.inf

    def _heartbeats(self) -> bytes:
        """Return the heartbeats since the last request of the host."""
        states = self._device.heartbeats()
        if not self._on_the_bus():
            return b""
        return b"".join(_line(_HEARTBEAT + self._device.node, bytes((state,))) for state in states)

    def _on_the_bus(self) -> bool:
        return self._open and self._bitrate == self._device.bitrate

    def _obey(self, line: bytes) -> bytes:
        if line == b"":
            return _OK
        if line in (b"O", b"L"):
            self._open, self._listening = True, line == b"L"
            return _OK
        if line == b"C":
            self._open = False
            return _OK
        if line in BITRATES and not self._open:
            self._bitrate = BITRATES[line]
            return _OK
        if line == b"V":
            return b"V1013\r"
        if line == b"N":
            return b"NEMUL\r"
        if line == b"F" and self._open:
            return b"F00\r"
        if line == b"Z0" and not self._open:
            return _OK
        match = _FRAME.fullmatch(line)
        if match is None or not self._open or self._listening:
            return _REFUSED
        short, identifier, long, _, length, data = match.groups()
        remote = (short or long) in (b"r", b"R")
        if len(data) != (0 if remote else 2 * int(length)):
            return _REFUSED
        sent = b"Z\r" if long else b"z\r"
        if short == b"t" and self._on_the_bus():
            sent += self._frame(int(identifier, 16), bytes.fromhex(data.decode("ascii")))
        return sent

    def _frame(self, identifier: int, data: bytes) -> bytes:
        """Put a frame on the bus; return the lines of the node's answer."""
        device = self._device
        if not device.plugged_in:
            return b""
        if identifier == 0 and len(data) == 2 and data[1] in (0, device.node):
            device.manage(data[0])
            return self._heartbeats()
        # CiA 301: an SDO has eight bytes, and a stopped node serves none.
        if identifier == _SDO_REQUEST + device.node and len(data) == 8 and device.state is not NodeState.STOPPED:
            answer = self._node.answer(data)
            if answer:
                return device.transmit(_line(_SDO_ANSWER + device.node, answer))
        return b""


class SdoServer:
    """The service data objects of one node (CiA 301)."""

    def __init__(self, device: EmulatedRoboteq) -> None:
        self._device = device
        self._multiplexer = bytes(3)
        self._text: bytes | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes:
        """Return the eight bytes that answer eight bytes; none answer an abort."""
        command = request[0]
        specifier = command >> 5
        if specifier == 4:
            self._text = None
            return b""
        if specifier != 3:
            self._text = None
            self._multiplexer = request[1:4]
        try:
            if specifier == 1:
                return self._download(command, request[4:])
            if specifier == 2:
                return self._upload()
            if specifier == 3:
                return self._segment(command)
            raise RequestRefusedError(AbortCode.COMMAND)
        except RequestRefusedError as error:
            self._text = None
            return b"\x80" + self._multiplexer + struct.pack("<I", error.reason)

    def _object(self) -> tuple[int, int]:
        return int.from_bytes(self._multiplexer[:2], "little"), self._multiplexer[2]

    def _download(self, command: int, data: bytes) -> bytes:
        index, sub = self._object()
        row = self._device.entry(index, sub)
        if not row.writable:
            raise RequestRefusedError(AbortCode.READ_ONLY)
        expedited, sized = bool(command & 2), bool(command & 1)
        if not expedited and sized:
            raise RequestRefusedError(AbortCode.UNSUPPORTED)
        form = _FORMATS[row.kind]
        size = struct.calcsize(form)
        # Without the bit s the size is not said; the simplified form of the maker says it all the same.
        if (sized or not expedited) and 4 - (command >> 2 & 3) != size:
            raise RequestRefusedError(AbortCode.LENGTH)
        value: int = struct.unpack(form, data[:size])[0]
        self._device.write_object(index, value, sub)
        return b"\x60" + self._multiplexer + bytes(4)

    def _upload(self) -> bytes:
        index, sub = self._object()
        value = self._device.read_object(index, sub)
        if isinstance(value, str):
            self._text, self._toggle = value.encode("ascii", "replace"), 0
            return b"\x41" + self._multiplexer + struct.pack("<I", len(self._text))
        data = struct.pack(_FORMATS[self._device.entry(index, sub).kind], value)
        return bytes((0x43 | (4 - len(data)) << 2,)) + self._multiplexer + data.ljust(4, b"\0")

    def _segment(self, command: int) -> bytes:
        if self._text is None:
            raise RequestRefusedError(AbortCode.COMMAND)
        if command >> 4 & 1 != self._toggle:
            raise RequestRefusedError(AbortCode.TOGGLE)
        part, rest = self._text[:_SEGMENT], self._text[_SEGMENT:]
        head = self._toggle << 4 | (_SEGMENT - len(part)) << 1 | (not rest)
        self._toggle ^= 1
        self._text = rest or None
        return bytes((head,)) + part.ljust(_SEGMENT, b"\0")


def _line(identifier: int, data: bytes) -> bytes:
    return b"t%03X%d%s\r" % (identifier, len(data), data.hex().upper().encode("ascii"))
