"""CANopen on an slcan adapter: service data objects of one node, its process data, and its heartbeat.

Source: CiA 301 (SDO, abort codes, SYNC, heartbeat). The examples in Roboteq's manual leave the bits e and s of
the command byte clear; the device takes the standard ones that are used here, and answers of both forms are
understood.
"""

from __future__ import annotations

import math
import re
import struct
from binascii import unhexlify
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from bench.base import Clock, DeferredModule, DeviceConnectionError, DeviceError
from drivers.device import other_answer
from drivers.serial_line import RESENDS, RepeatingLine, SerialSettings, lost_line, no_answer

if TYPE_CHECKING:
    from drivers.roboteq import slcan
else:
    slcan = DeferredModule("drivers.roboteq.slcan")

_MOST_KNOWN = 128  # requests that are kept; a voltage that is held is commanded again and again
_MOST_FRAMES = 4096  # looked at for one answer; a full buffer of the system has some 500
_LONGEST_TEXT = 256
_LATEST = 3.0  # time-outs after its request until which an answer may come

_SDO_REQUEST, _SDO_ANSWER, _HEARTBEAT = 0x600, 0x580, 0x700
_SDO_LINE = 21  # characters of a line with an SDO
_SYNC = b"t0800\r"
_ABORT = 0x80
_TIMED_OUT = 0x0504_0000
_BOOT_UP = 0

ABORT_CODES: Mapping[int, str] = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid or unknown",
    0x0504_0005: "out of memory",
    0x0601_0000: "unsupported access to an object",
    0x0601_0001: "the object can only be written",
    0x0601_0002: "the object can only be read",
    0x0602_0000: "the object does not exist",
    0x0604_0041: "the object cannot be mapped to the PDO",
    0x0604_0042: "the mapped objects exceed the length of the PDO",
    0x0604_0043: "parameters are incompatible",
    0x0604_0047: "internal incompatibility of the device",
    0x0606_0000: "hardware error",
    0x0607_0010: "the length of the value does not match",
    0x0607_0012: "the value is too long",
    0x0607_0013: "the value is too short",
    0x0609_0011: "the subindex does not exist; check the channel",
    0x0609_0030: "the value is out of range",
    0x0609_0031: "the value is too high",
    0x0609_0032: "the value is too low",
    0x0609_0036: "the highest value is below the lowest",
    0x0800_0000: "general error",
    0x0800_0020: "the value cannot be transferred or stored",
    0x0800_0021: "local control prevents it",
    0x0800_0022: "the present state of the device prevents it",
    0x0800_0023: "no object dictionary is there",
}
"""Why the device ends a transfer (CiA 301, SDO abort codes)."""


ABSENT = (0x0602_0000, 0x0609_0011)
"""Codes that say that an object or its subindex does not exist."""


class NodeSettings(SerialSettings):
    """Rig-file settings of the line to a CANopen node."""

    port: str = Field(
        min_length=1,
        pattern="^[^@]+$",
        description="line of the slcan adapter, as pyserial opens it: /dev/ttyACM0, socket://host:port, "
        "emulated://supply",
    )
    baudrate: int = Field(
        default=115_200, ge=9600, le=3_000_000, description="speed of the adapter's serial line, Bd; USB has none"
    )
    bitrate: Literal[125_000, 500_000] = Field(
        default=125_000, description="speed of the CAN bus, bit/s: 125000 as delivered, or 500000"
    )
    address_key: ClassVar[str] = "node"
    keys_of_line: ClassVar[frozenset[str]] = SerialSettings.keys_of_line | {"timeout"}

    node: int = Field(default=1, ge=1, le=126, description="CANopen node of the controller, 1 to 126")

    @property
    def longest_turn(self) -> float:
        """Longest time that a request and its repetitions keep the line while nothing answers, s."""
        return super().longest_turn + _LATEST * self.timeout


@dataclass(frozen=True)
class Entry:
    """An object of the dictionary; `size` in bytes is what a download carries, 0 for read-only ones."""

    index: int
    title: str
    size: int = 0
    signed: bool = False


class AbortedError(Exception):
    """The device ended a transfer with an abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(ABORT_CODES.get(code, f"abort code 0x{code:08X}"))
        self.code = code


class MissedError(Exception):
    """A request was not sent, as it would have arrived too late."""


class NodeLine(RepeatingLine):
    """The service data objects of one node: requests, their answers, and the node's heartbeat.

    A request that brings no answer is sent again, twice at most; all of them may be carried out twice without
    harm. An answer for another object is a late one to an earlier request, and is skipped. As nothing tells two
    answers for one object apart, no request is sent before an answer that is missing can come no more: it may be
    three time-outs late. Calls must not overlap.

    Attributes
    ----------
    round_trip : float
        How long the last request that was answered took, s.
    answered : bool
        Whether the node has answered since the line was opened.
    port : SlcanAdapter or NodePort
        The adapter.
    restarted : bool
        Whether the node has reported a restart since this was last set to false.
    urgent : bool
        Whether requests are sent without waiting for what may still come.
    """

    def __init__(self, device: str, settings: NodeSettings, clock: Clock) -> None:
        self._device = device
        self._settings = settings
        self._clock = clock
        self._request_head = b"t%03X8" % (_SDO_REQUEST + settings.node)
        answer_head = b"t%03X8" % (_SDO_ANSWER + settings.node)
        self._answer_heads = frozenset((answer_head, answer_head.lower()))
        self._heard: set[int] = set()
        self._quiet_at = -math.inf
        self.round_trip = 0.0
        self.answered = self.restarted = self.urgent = False
        self.port = self._adapter = slcan.open_adapter(device, settings, settings.bitrate, settings.node)
        self._heard_at = clock.now()

    def close(self) -> None:
        """Release the line."""
        self._adapter.release()

    def heartbeat_age(self) -> float:
        """Return how long ago the node's last heartbeat was heard, s."""
        return self._clock.now() - self._heard_at

    def await_heartbeat(self, patience: float) -> None:
        """Listen until a heartbeat comes, for so many seconds at most.

        Raises `DeviceConnectionError` if the line is lost.
        """
        end, before = self._clock.now() + patience, self._heard_at
        try:
            while self._heard_at == before and self._clock.now() < end:
                line = self._adapter.line()
                if line is not None:
                    self._notice(line)
        except OSError as error:
            raise self._lost(error) from None

    def read(self, item: Entry, sub: int) -> int:
        """Read a number; errors are `AbortedError` and `DeviceConnectionError`."""
        multiplexer = struct.pack("<HB", item.index, sub)
        answer = self._exchange(self._request(b"\x40" + multiplexer), multiplexer)
        command = answer[0]
        # The maker's own examples leave the bits e and s clear and still say the size.
        if command >> 5 != 2 or command & 3 == 1:
            raise DeviceError(self._device, f"answered {answer.hex(' ')} for its {described(item, sub)}")
        return int.from_bytes(answer[4 : 8 - (command >> 2 & 3)], "little", signed=item.signed)

    def read_text(self, item: Entry) -> str:
        """Read a text, in one piece or in segments; errors as of `read`."""
        multiplexer = struct.pack("<HB", item.index, 0)
        request = self._request(b"\x40" + multiplexer)
        for number in range(1 + RESENDS):
            answer = self._exchange(request, multiplexer)
            if answer[0] & 2:
                text = answer[4 : 8 - (answer[0] >> 2 & 3 if answer[0] & 1 else 0)]
                break
            try:
                text = self._read_segments(item, multiplexer)
                break
            except DeviceConnectionError:
                # A segment cannot be asked for again; the whole text can.
                if number == RESENDS:
                    raise
                self.repeats += 1
        return text.split(b"\0")[0].decode("ascii", "replace").strip()

    def write(self, item: Entry, value: int, sub: int, *, before: float = math.inf, after: bytes = b"") -> None:
        """Write a number, which is to arrive before an instant (s); errors are those of `read`.

        The line `after` is sent in front of it. Raises `MissedError` if it would arrive later: it is not sent then,
        or not sent again.
        """
        request, multiplexer = self._download(item, value, sub)
        answer = self._exchange(after + request, multiplexer, before)
        if answer[0] != 0x60:
            raise DeviceError(self._device, f"answered {answer.hex(' ')} for its {described(item, sub)}")

    def tell(self, item: Entry, value: int, sub: int) -> None:
        """Write a number without waiting for the answer; raises `DeviceConnectionError` if the line is lost."""
        self.transmit(self._download(item, value, sub)[0])
        self._quiet_at = self._clock.now() + _LATEST * self._adapter.patience

    def transmit(self, line: bytes) -> None:
        """Send a line; raises `DeviceConnectionError` if the line is lost."""
        try:
            self._adapter.transmit(line)
        except OSError as error:
            raise self._lost(error) from None

    def synchronize(self, heads: tuple[bytes, ...], before: bytes = b"") -> Sequence[bytes]:
        """Send a SYNC; return the process data that follow it, back to back, in hexadecimal digits.

        Parameters
        ----------
        heads : tuple of bytes
            Beginning of the line of each PDO, up to its length, in the order in which they come.
        before : bytes
            What is sent in front of the SYNC.

        Returns
        -------
        sequence of bytes
            The data of each; none if not all of them come within the timeout.

        Raises
        ------
        DeviceConnectionError
            If the line is lost.
        """
        adapter, clock = self._adapter, self._clock
        found: list[bytes] = []
        try:
            self._hear()
            adapter.transmit(before + _SYNC)
            # As a rule they come at once, and nothing else does.
            matched = adapter.matched(_set_of(heads))
            if matched:
                self.answered, self.resends = True, RESENDS
                return matched
            sent_at = clock.now()
            for _ in range(_MOST_FRAMES):
                line = adapter.line()
                if line is None:
                    break
                head = line[:5]
                if head in heads:
                    if head != heads[len(found)]:
                        # What came before it belongs to an earlier SYNC.
                        found.clear()
                    if head == heads[len(found)] and len(line) == 5 + 2 * int(head[4:]):
                        found.append(line[5:])
                        if len(found) == len(heads):
                            self.answered, self.resends = True, RESENDS
                            return found
                else:
                    self._notice(line)
                if clock.now() >= sent_at + adapter.patience:
                    break
        except OSError as error:
            raise self._lost(error) from None
        return []

    def _download(self, item: Entry, value: int, sub: int) -> tuple[bytes, bytes]:
        """Return the line of a request that writes a number, and the object that its answer names."""
        multiplexer = struct.pack("<HB", item.index, sub)
        data = value.to_bytes(item.size, "little", signed=item.signed)
        return self._request(bytes((0x23 | (4 - item.size) << 2,)) + multiplexer + data), multiplexer

    def _read_segments(self, item: Entry, multiplexer: bytes) -> bytes:
        text, toggle, last = b"", 0, False
        while not last and len(text) < _LONGEST_TEXT:
            try:
                segment = self._exchange(self._request(bytes((0x60 | toggle,))))
            except DeviceConnectionError:
                # CiA 301: the client ends a transfer that has stopped. The answer may still come.
                with suppress(OSError):
                    self._adapter.transmit(self._request(b"\x80" + multiplexer + struct.pack("<I", _TIMED_OUT)))
                raise
            if segment[0] & 0x10 != toggle:
                raise DeviceError(self._device, f"answered {segment.hex(' ')} for its {described(item, 0)}")
            text += segment[1 : 8 - (segment[0] >> 1 & 7)]
            last = bool(segment[0] & 1)
            toggle ^= 0x10
        return text

    def _request(self, payload: bytes) -> bytes:
        """Return the line of a request."""
        return _line_of(self._request_head, payload)

    def _exchange(self, request: bytes, multiplexer: bytes = b"", before: float = math.inf) -> bytes:
        """Send the line of a request; return the eight bytes of its answer."""
        adapter, clock = self._adapter, self._clock
        refusals = adapter.refusals
        resends, self.resends = self.resends, RESENDS
        try:
            if clock.now() < self._quiet_at and not self.urgent:
                clock.sleep_until(self._quiet_at)
            self._hear()
            # Twice the same segment would be a wrong toggle bit.
            for number in range(1 + resends if multiplexer else 1):
                sent_at = clock.now()
                if sent_at + self.round_trip >= before:
                    raise MissedError
                if number:
                    # The answer to the first one may come as well, after the one that is taken.
                    self._quiet_at = sent_at + _LATEST * self._adapter.patience
                    self.repeats += 1
                adapter.transmit(request)
                answer = self._answer(multiplexer, sent_at)
                if answer is not None:
                    self.answered = True
                    self.round_trip = clock.now() - sent_at
                    if answer[0] == _ABORT:
                        raise AbortedError(int.from_bytes(answer[4:], "little"))
                    return answer
            self._quiet_at = sent_at + _LATEST * self._adapter.patience
        except OSError as error:
            raise self._lost(error) from None
        self.resends = 0
        raise self._silence(adapter.refusals - refusals, adapter.strange, resends)

    def _hear(self) -> None:
        """Take note of what has come, which answers nothing."""
        # Of several heartbeats that have come since, one says as much.
        for line in dict.fromkeys(self._adapter.lines()):
            self._notice(line)

    def _answer(self, multiplexer: bytes, sent_at: float) -> bytes | None:
        """Return the answer, or None if it does not come in time."""
        adapter = self._adapter
        for _ in range(_MOST_FRAMES):
            line = adapter.line()
            if line is None:
                return None
            answer = self._notice(line)
            if answer:
                # An answer to a segment does not name its object; an abort and all others do.
                if answer[1:4] == multiplexer:
                    return answer
                if not multiplexer and (answer[0] >> 5 == 0 or answer[0] == _ABORT):
                    return answer
            if self._clock.now() >= sent_at + adapter.patience:
                return None
        return None

    def _notice(self, line: bytes) -> bytes:
        """Return the eight bytes of an SDO of the node, none for other frames; take note of a heartbeat."""
        try:
            if line[:5] in self._answer_heads and len(line) >= _SDO_LINE:
                return unhexlify(line[5:_SDO_LINE])
            identifier = int(line[1:4], 16)
            if _HEARTBEAT < identifier < _HEARTBEAT + 128 and line[4:5] == b"1":
                self._notice_heartbeat(identifier - _HEARTBEAT, unhexlify(line[5:7]))
        except ValueError:
            # A damaged line is no frame: the request is sent again when the answer does not come.
            return b""
        return b""

    def _notice_heartbeat(self, node: int, state: bytes) -> None:
        if node != self._settings.node:
            self._heard.add(node)
        elif state:
            self._heard_at = self._clock.now()
            self.restarted = self.restarted or state[0] == _BOOT_UP

    def _lost(self, error: BaseException) -> DeviceConnectionError:
        return lost_line(self._device, self._settings.port, error)

    def _silence(self, refusals: int, strange: bytes, resends: int) -> DeviceConnectionError:
        settings = self._settings
        found = f"; heard of node {', '.join(map(str, sorted(self._heard)))} instead" if self._heard else ""
        if refusals:
            found += f"; the adapter reports an error ({refusals} BEL)"
        found += other_answer(strange)
        problem, speed = f"no answer within {settings.timeout:g} s", f"{settings.bitrate} bit/s"
        return no_answer(self._device, settings, problem, "node", settings.node, found, speed, resends)


@lru_cache(_MOST_KNOWN)
def _line_of(head: bytes, payload: bytes) -> bytes:
    """Return the line of a frame of eight bytes."""
    return b"%s%s\r" % (head, payload.ljust(8, b"\0").hex().upper().encode("ascii"))


@lru_cache(maxsize=16)
def _set_of(heads: tuple[bytes, ...]) -> re.Pattern[bytes]:
    """Return the form of process data as they come back to back, behind the adapter's acknowledgements."""
    lines = (rb"%s([^\r\n\a]{%d})\r" % (head, 2 * int(head[4:])) for head in heads)
    return re.compile(rb"(?:z?\r)*" + b"".join(lines))


def described(item: Entry, sub: int) -> str:
    """Describe an object for messages."""
    return f"{item.title} (object 0x{item.index:04X}:{sub})"
