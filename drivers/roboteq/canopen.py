"""CANopen through an slcan adapter: service data objects of one node, and its heartbeat.

Source: CiA 301 (SDO, abort codes, heartbeat). The examples in Roboteq's manual leave the bits e and s of the command
byte clear; the device takes the standard ones that are used here.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import serial
from can import CanError, Message
from can.interfaces.slcan import slcanBus
from pydantic import Field

from bench.clock import Clock
from bench.errors import DeviceConnectionError, DeviceError
from drivers.serial_line import RESENDS, SerialSettings, lost_line, no_answer

_MOST_FRAMES = 4096  # looked at for one answer; a full buffer of the system has some 500
_MOST_READS = 4096
_LONGEST_LINE = 64
_LONGEST_TEXT = 256

_SDO_REQUEST, _SDO_ANSWER, _HEARTBEAT = 0x600, 0x580, 0x700
_ABORT = 0x80
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
    node: int = Field(default=1, ge=1, le=126, description="CANopen node of the controller, 1 to 126")


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


class SlcanAdapter(slcanBus):
    """python-can's slcan adapter, reading what has arrived rather than byte by byte.

    The only wait is the port's own timeout, so the port decides which clock it uses. An empty read means silence
    for the whole timeout.

    Attributes
    ----------
    refused : bool
        Whether the adapter has answered with BEL since this was last cleared.
    """

    _buffer: bytearray

    def __init__(self, settings: NodeSettings) -> None:
        self.refused = False
        self._patient = True
        try:
            super().__init__(
                settings.port,
                tty_baudrate=settings.baudrate,
                bitrate=settings.bitrate,
                sleep_after_open=0,
                timeout=settings.timeout,
            )
        except BaseException:
            self._abandon()
            raise

    def frame(self) -> Message | None:
        """Return the next frame; None after the silence of the port's timeout."""
        for _ in range(_MOST_FRAMES):
            # A damaged line is no frame: the request is sent again when the answer does not come.
            with suppress(ValueError, IndexError, KeyError):
                return self.recv(0)
        return None

    def waiting_frames(self) -> list[Message]:
        """Return the frames that have arrived, without waiting."""
        frames: list[Message] = []
        self._patient = False
        try:
            while len(frames) < _MOST_FRAMES:
                frame = self.frame()
                if frame is None:
                    break
                frames.append(frame)
        finally:
            self._patient = True
        return frames

    def release(self) -> None:
        """Close the channel and the port, in any state."""
        with suppress(CanError, serial.SerialException, OSError):
            self.shutdown()
        self._abandon()

    def _abandon(self) -> None:
        port = getattr(self, "serialPortOrig", None)
        if port is not None:
            port.close()

    def _read(self, timeout: float | None) -> str | None:  # noqa: ARG002 - the port's timeout decides
        """Return the next line that carries a frame."""
        port, buffer = self.serialPortOrig, self._buffer
        for _ in range(_MOST_READS):
            while line := self._take_line():
                if line[0] in b"tTrR":
                    return line.decode("ascii", "replace")
            if len(buffer) > _LONGEST_LINE:
                buffer.clear()
            waiting = port.in_waiting
            if not (waiting or self._patient):
                return None
            received = port.read(max(waiting, 1))
            if not received:
                return None
            buffer += received
        return None

    def _take_line(self) -> bytes:
        """Return the next line with its end, nothing if there is none; BEL ends a line, too."""
        buffer = self._buffer
        end = buffer.find(b"\r")
        bell = buffer.find(b"\a", 0, end if end >= 0 else None)
        if bell >= 0:
            self.refused = True
            end = bell
        line = bytes(buffer[: end + 1])
        del buffer[: end + 1]
        return line


class NodeLine:
    """The service data objects of one node: requests, their answers, and the node's heartbeat.

    A request that brings no answer is sent again, twice at most; all of them may be carried out twice without
    harm. An answer for another object is a late one to an earlier request, and is skipped.
    """

    def __init__(self, device: str, settings: NodeSettings, clock: Clock) -> None:
        self._device = device
        self._settings = settings
        self._clock = clock
        self._lock = threading.Lock()
        self._request_id = _SDO_REQUEST + settings.node
        self._answer_id = _SDO_ANSWER + settings.node
        self._heartbeat_id = _HEARTBEAT + settings.node
        self._heard: set[int] = set()
        self._restarted = False
        try:
            self._adapter = SlcanAdapter(settings)
        except (CanError, serial.SerialException, OSError, ValueError) as error:
            raise DeviceConnectionError(device, f"cannot open {settings.port}: {_cause(error)}") from None
        self._heard_at = clock.now()

    def close(self) -> None:
        """Release the line."""
        self._adapter.release()

    def heartbeat_age(self) -> float:
        """Return how long ago the node's last heartbeat was heard, s."""
        return self._clock.now() - self._heard_at

    def take_restart(self) -> bool:
        """Return whether the node has restarted since this was last asked."""
        restarted, self._restarted = self._restarted, False
        return restarted

    def read(self, item: Entry, sub: int) -> int:
        """Read a number; errors are `AbortedError` and `DeviceConnectionError`."""
        answer = self._exchange(0x40, item, sub)
        command = answer[0]
        # The maker's own examples leave the bits e and s clear and still say the size.
        data = answer[4 : 8 - (command >> 2 & 3)]
        if command >> 5 != 2 or command & 3 == 1:
            raise DeviceError(self._device, f"answered {answer.hex(' ')} for its {described(item, sub)}")
        return int.from_bytes(data, "little", signed=item.signed)

    def read_text(self, item: Entry) -> str:
        """Read a text, in one piece or in segments; errors as of `read`."""
        for _ in range(RESENDS):
            # A segment cannot be asked for again; the whole text can.
            with suppress(DeviceConnectionError):
                return self._read_text(item)
        return self._read_text(item)

    def _read_text(self, item: Entry) -> str:
        answer = self._exchange(0x40, item, 0)
        text, toggle = b"", 0
        if answer[0] & 2:
            text = answer[4 : 8 - (answer[0] >> 2 & 3 if answer[0] & 1 else 0)]
        else:
            last = False
            while not last and len(text) < _LONGEST_TEXT:
                segment = self._exchange(0x60 | toggle, item, 0)
                if segment[0] & 0x10 != toggle:
                    raise DeviceError(self._device, f"answered {segment.hex(' ')} for its {described(item, 0)}")
                text += segment[1 : 8 - (segment[0] >> 1 & 7)]
                last = bool(segment[0] & 1)
                toggle ^= 0x10
        return text.split(b"\0")[0].decode("ascii", "replace").strip()

    def write(self, item: Entry, value: int, sub: int) -> None:
        """Write a number; errors are those of `read`."""
        data = value.to_bytes(item.size, "little", signed=item.signed)
        answer = self._exchange(0x23 | (4 - item.size) << 2, item, sub, data)
        if answer[0] != 0x60:
            raise DeviceError(self._device, f"answered {answer.hex(' ')} for its {described(item, sub)}")

    def _exchange(self, command: int, item: Entry, sub: int, data: bytes = b"") -> bytes:
        """Send a request; return the eight bytes of its answer."""
        segment = command >> 5 == 3
        multiplexer = b"" if segment else struct.pack("<HB", item.index, sub)
        payload = (bytes((command,)) + multiplexer + data).ljust(8, b"\0")
        request = Message(arbitration_id=self._request_id, is_extended_id=False, data=payload)
        adapter = self._adapter
        try:
            with self._lock:
                for frame in adapter.waiting_frames():
                    self._notice(frame)
                adapter.refused = False
                # Twice the same segment would be a wrong toggle bit.
                for _ in range(1 if segment else 1 + RESENDS):
                    adapter.send(request, timeout=self._settings.timeout)
                    answer = self._answer(multiplexer)
                    if answer is not None:
                        if answer[0] == _ABORT:
                            raise AbortedError(int.from_bytes(answer[4:], "little"))
                        return answer
        except (CanError, serial.SerialException, OSError) as error:
            raise lost_line(self._device, self._settings, _cause(error)) from None
        raise self._silence()

    def _answer(self, multiplexer: bytes) -> bytes | None:
        """Return the answer, or None if it does not come in time."""
        adapter, clock = self._adapter, self._clock
        end = clock.now() + self._settings.timeout
        for _ in range(_MOST_FRAMES):
            frame = adapter.frame()
            if frame is None:
                return None
            data = frame.data
            if frame.arbitration_id == self._answer_id and len(data) == 8 and not frame.is_extended_id:
                answer = bytes(data)
                # An answer to a segment does not name its object; an abort and all others do.
                if answer[1:4] == multiplexer or (not multiplexer and (answer[0] >> 5 == 0 or answer[0] == _ABORT)):
                    return answer
            else:
                self._notice(frame)
            if clock.now() >= end:
                return None
        return None

    def _notice(self, frame: Message) -> None:
        """Take note of a heartbeat."""
        identifier = frame.arbitration_id
        if frame.is_extended_id or not _HEARTBEAT < identifier < _HEARTBEAT + 128 or len(frame.data) != 1:
            return
        if identifier == self._heartbeat_id:
            self._heard_at = self._clock.now()
            self._restarted = self._restarted or frame.data[0] == _BOOT_UP
        else:
            self._heard.add(identifier - _HEARTBEAT)

    def _silence(self) -> DeviceConnectionError:
        settings = self._settings
        found = f"; heard of node {', '.join(map(str, sorted(self._heard)))} instead" if self._heard else ""
        if self._adapter.refused:
            found += "; the adapter reports an error"
        problem, speed = f"no answer within {settings.timeout:g} s", f"{settings.bitrate} bit/s"
        return no_answer(self._device, settings, problem, "node", settings.node, found, speed)


def described(item: Entry, sub: int) -> str:
    """Describe an object for messages."""
    return f"{item.title} (object 0x{item.index:04X}:{sub})"


def _cause(error: BaseException) -> BaseException:
    """Return the original cause of an error of python-can."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error
