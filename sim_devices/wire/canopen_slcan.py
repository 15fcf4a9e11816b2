"""A CANopen node behind an slcan adapter, as a serial line sees them.

The adapter speaks the ASCII protocol of the LAWICEL CAN232 (LAWICEL CAN232 manual V3): lines that end with a
carriage return, answered by a carriage return, or by BEL when they cannot be obeyed. `C` closes and `O` opens
the channel, `L` opens it for listening, `Sn` selects the bit rate; `t` and `T` carry a frame with an 11-bit and
a 29-bit identifier, `r` and `R` remote frames. Closing a closed channel, opening an open one and empty lines are
obeyed, as python-can sends all of these. Line feeds are passed over.

The node serves SDO as in CiA 301: expedited and segmented, download and upload, aborts; process data (PDO); network
management commands and its heartbeat. It takes the command bytes of the examples in Roboteq CANBus Networking Manual
V2.0 as well, whose bits e and s are clear: a download of that form is expedited, and a query that says its size (48h
for two bytes) is answered by the same byte.

Assumptions: a frame that is sent at another bit rate than that of the bus is lost without an error; block transfers
are refused; a remote frame is not answered.
"""

from __future__ import annotations

import math
import re
import struct
from binascii import hexlify, unhexlify
from collections.abc import Callable
from functools import lru_cache

from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.instruments.roboteq_objects import FORMATS, AbortCode, NodeState
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
_STANDARD = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])")
_UNANSWERED = re.compile(
    rb"(?:r[0-7][0-9A-Fa-f]{2}|R[01][0-9A-Fa-f]{7})[0-8]|T[01][0-9A-Fa-f]{7}([0-8])((?:[0-9A-Fa-f]{2}){0,8})"
)
_NMT, _SYNC = 0x000, 0x080
_SDO_REQUEST, _SDO_ANSWER, _HEARTBEAT = 0x600, 0x580, 0x700
_SEGMENT = 7  # bytes in a segment
_HEAD = 5  # characters of a standard frame before its data
_FRAMES = frozenset((b"t", b"T", b"r", b"R"))


class CanopenSlcanServer(WireServer):
    """The serial side of an slcan adapter with one emulated controller on its bus."""

    has_addresses = True
    # Its bus is behind the adapter, whose lines are those of the host.
    hears_others = False

    def __init__(self, device: EmulatedRoboteq) -> None:
        self._device = device
        self._node = SdoServer(device)
        self._answer_head = b"t%03X8" % (_SDO_ANSWER + device.node)
        self._now = device.world.clock.now
        self._received = b""
        self._overrun = False
        self._bitrate = 0
        self._open = False
        self._listening = False

    def answer_begins(self, sent: bytes) -> int:
        """Return where the frames of the node begin: before them the adapter has obeyed."""
        begin = sent.find(b"t")
        return len(sent) if begin < 0 else begin

    def readdressed(self, answer: bytes) -> bytes:
        """Return frames of the next node."""
        return b"t%03X" % (int(answer[1:4], 16) + 1) + answer[4:]

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the adapter sends."""
        with self._device.world.lock:
            received = self._received + data
            if b"\n" in received:
                received = received.replace(b"\n", b"")
            *lines, rest = received.split(b"\r")
            sent = self._sent_by_itself() if self._now() >= self._device.quiet_until else b""
            for line in lines:
                sent += self._obey(line) if not self._overrun and len(line) <= LONGEST_LINE else _REFUSED
                self._overrun = False
            # A line that is too long is refused up to its end.
            self._overrun = self._overrun or len(rest) > LONGEST_LINE
            self._received = b"" if self._overrun else rest
            return sent

    def unsolicited(self) -> bytes:
        """Return heartbeats, boot-up message and TPDOs since the last call, which pass while the channel is open."""
        device = self._device
        if self._now() < device.quiet_until:
            return b""
        with device.world.lock:
            return self._sent_by_itself()

    def next_unsolicited(self) -> float:
        """Return when the node next sends something by itself, s; infinity while nothing passes."""
        device = self._device
        with device.world.lock:
            if not self._on_the_bus():
                return math.inf
            return device.next_message()

    def _sent_by_itself(self) -> bytes:
        """Return what the node has sent since it was last quiet."""
        device = self._device
        states = device.heartbeats()
        frames, data = device.process_data(synchronous=False)
        device.next_message()
        if not (states or frames) or not self._on_the_bus():
            return b""
        heartbeats = ((_HEARTBEAT + device.node, 1),) * len(states)
        return _lines(heartbeats + frames, bytes(states) + data)

    def _on_the_bus(self) -> bool:
        return self._open and self._bitrate == self._device.bitrate

    def _obey(self, line: bytes) -> bytes:
        kind = line[:1]
        if kind in _FRAMES:
            frame = _frame(line)
            if frame is None or not self._open or self._listening:
                return _REFUSED
            identifier, data = frame
            sent = b"z\r" if kind in b"tr" else b"Z\r"
            device = self._device
            if data is not None and device.plugged_in and self._bitrate == device.bitrate:
                return sent + self._answer(identifier, data)
            return sent
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
        return _REFUSED

    def _answer(self, identifier: int, data: bytes) -> bytes:
        """Have the node look at a frame; return the lines of its answer."""
        device = self._device
        # CiA 301: an SDO has eight bytes, and a stopped node serves none.
        if identifier == _SDO_REQUEST + device.node:
            if len(data) == 8 and device.state is not NodeState.STOPPED:
                answer = self._node.answer(data)
                if answer:
                    return b"%s%s\r" % (self._answer_head, hexlify(answer).upper())
        elif identifier == _SYNC:
            return _lines(*device.process_data(synchronous=True))
        elif identifier != _NMT:
            device.receive_process_data(identifier, data)
        elif len(data) == 2 and data[1] in (0, device.node):
            device.manage(data[0])
            return self._sent_by_itself()
        return b""


class SdoServer:
    """The service data objects of one node (CiA 301)."""

    def __init__(self, device: EmulatedRoboteq) -> None:
        self._device = device
        self._numbers: dict[bytes, tuple[int, int, struct.Struct, bytes]] = {}
        """Index, subindex, form, and beginning of the answer, by the first four bytes of a query for a number."""
        self._writes: dict[bytes, tuple[int, int, struct.Struct, bytes]] = {}
        """Index, subindex, form, and answer, by the first four bytes of a download in one piece."""
        self._multiplexer = bytes(3)
        self._text: bytes | None = None
        self._incoming: bytes | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes:
        """Return the eight bytes that answer eight bytes; none answer an abort."""
        command = request[0]
        specifier = command >> 5
        known = self._writes.get(request[:4])
        if known is not None:
            self._text = self._incoming = None
            self._multiplexer = request[1:4]
            index, sub, written, answer = known
            try:
                self._device.write_object(index, written.unpack_from(request, 4)[0], sub)
            except RequestRefusedError as error:
                return self._abort(error)
            return answer
        if specifier not in (0, 3):
            # What was under way has ended.
            self._text = self._incoming = None
            if specifier == 4:
                return b""
            self._multiplexer = request[1:4]
        try:
            if specifier == 0:
                return self._download_segment(command, request[1:])
            if specifier == 1:
                return self._download(command, request[4:])
            if specifier == 2:
                return self._upload(request)
            if specifier == 3:
                return self._upload_segment(command)
            raise RequestRefusedError(AbortCode.COMMAND)
        except RequestRefusedError as error:
            return self._abort(error)

    def _abort(self, error: RequestRefusedError) -> bytes:
        """End what is under way; return the answer that says so."""
        self._text = self._incoming = None
        return b"\x80" + self._multiplexer + struct.pack("<I", error.reason)

    def _object(self) -> tuple[int, int]:
        multiplexer = self._multiplexer
        return multiplexer[0] | multiplexer[1] << 8, multiplexer[2]

    def _download(self, command: int, data: bytes) -> bytes:
        index, sub = self._object()
        row = self._device.entry(index, sub)
        if not row.writable:
            raise RequestRefusedError(AbortCode.READ_ONLY)
        expedited, sized = command & 2, command & 1
        size = FORMATS[row.kind].size
        if sized and not expedited:
            if int.from_bytes(data, "little") != size:
                raise RequestRefusedError(AbortCode.LENGTH)
            self._incoming, self._toggle = b"", 0
        else:
            # Without the bit s the size is not said; the simplified form of the maker says it all the same.
            if (sized or not expedited) and 4 - (command >> 2 & 3) != size:
                raise RequestRefusedError(AbortCode.LENGTH)
            self._write(data[:size])
            answer = b"\x60" + self._multiplexer + bytes(4)
            self._writes[bytes((command,)) + self._multiplexer] = index, sub, FORMATS[row.kind], answer
            return answer
        return b"\x60" + self._multiplexer + bytes(4)

    def _download_segment(self, command: int, data: bytes) -> bytes:
        if self._incoming is None:
            raise RequestRefusedError(AbortCode.COMMAND)
        if command >> 4 & 1 != self._toggle:
            raise RequestRefusedError(AbortCode.TOGGLE)
        self._incoming += data[: _SEGMENT - (command >> 1 & 7)]
        if command & 1:
            whole, self._incoming = self._incoming, None
            self._write(whole)
        self._toggle ^= 1
        return bytes((0x20 | command & 0x10,)) + bytes(7)

    def _write(self, data: bytes) -> None:
        index, sub = self._object()
        form = FORMATS[self._device.entry(index, sub).kind]
        if len(data) != form.size:
            raise RequestRefusedError(AbortCode.LENGTH)
        value: int = form.unpack(data)[0]
        self._device.write_object(index, value, sub)

    def _upload(self, request: bytes) -> bytes:
        known = self._numbers.get(request[:4])
        if known is not None:
            index, sub, form, head = known
            return (head + form.pack(self._device.read_object(index, sub))).ljust(8, b"\0")
        index, sub = self._object()
        value = self._device.read_object(index, sub)
        if isinstance(value, str):
            self._text, self._toggle = value.encode("ascii", "replace"), 0
            return b"\x41" + self._multiplexer + struct.pack("<I", len(self._text))
        form = FORMATS[self._device.entry(index, sub).kind]
        # The maker's form of the query says the size, and has the bits e and s clear in the answer.
        command = (0x40 if request[0] & 0x0C else 0x43) | (4 - form.size) << 2
        head = bytes((command,)) + self._multiplexer
        self._numbers[request[:4]] = index, sub, form, head
        return (head + form.pack(value)).ljust(8, b"\0")

    def _upload_segment(self, command: int) -> bytes:
        if self._text is None:
            raise RequestRefusedError(AbortCode.COMMAND)
        if command >> 4 & 1 != self._toggle:
            raise RequestRefusedError(AbortCode.TOGGLE)
        part, rest = self._text[:_SEGMENT], self._text[_SEGMENT:]
        head = self._toggle << 4 | (_SEGMENT - len(part)) << 1 | (not rest)
        self._toggle ^= 1
        self._text = rest or None
        return bytes((head,)) + part.ljust(_SEGMENT, b"\0")


def _frame(line: bytes) -> tuple[int, bytes | None] | None:
    """Return identifier and data of a line; no data for frames that nobody answers, None if it makes no sense."""
    identifier, size = _head(line[:_HEAD])
    if size:
        try:
            return (identifier, unhexlify(line[_HEAD:])) if len(line) == size else None
        except ValueError:
            return None
    match = _UNANSWERED.fullmatch(line)
    if match is None or len(match[2] or b"") != 2 * int(match[1] or b"0"):
        return None
    return 0, None


@lru_cache(maxsize=256)
def _head(head: bytes) -> tuple[int, int]:
    """Return identifier and characters of the line of a standard data frame; 0 of other frames."""
    match = _STANDARD.fullmatch(head)
    return (0, 0) if match is None else (int(match[1], 16), _HEAD + 2 * int(match[2]))


def _lines(frames: tuple[tuple[int, int], ...], data: bytes) -> bytes:
    """Return the lines of some frames, of identifier and number of bytes, with their data one behind the other."""
    if not frames:
        return b""
    text, divide = _text_of(frames)
    return text % divide(hexlify(data).upper())


@lru_cache(maxsize=64)
def _text_of(frames: tuple[tuple[int, int], ...]) -> tuple[bytes, Callable[[bytes], tuple[bytes, ...]]]:
    """Return the lines without their data, and what divides the digits of these among them."""
    text = b"".join(b"t%03X%d%%b\r" % frame for frame in frames)
    return text, struct.Struct("".join(f"{2 * size}s" for _, size in frames)).unpack
