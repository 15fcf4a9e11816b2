"""Dynamixel Protocol 2.0 on a serial line: packets, their CRC, and requests that are sent again.

Source: ROBOTIS e-Manual, Protocol 2.0 (packets, CRC, error numbers).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import ClassVar

import serial
from pydantic import Field

from bench.base import Clock, crc16_dynamixel as crc
from drivers.device import other_answer
from drivers.serial_line import (
    RESENDS,
    RepeatingLine,
    SerialSettings,
    forget_received,
    lost_line,
    no_answer,
    open_port,
    patience_of,
)

PING, READ, WRITE, REBOOT = 0x01, 0x02, 0x03, 0x08
RANGE_ERROR = 4

_HEADER = b"\xff\xff\xfd\x00"
_HEAD = 7  # header, id, length
_SHORTEST_ANSWER = 11  # the head, instruction, error, CRC
_SHORTEST_LENGTH, _LONGEST_LENGTH = 3, 256  # bytes after the head; the longest answer has 26
_MOST_NOISE = 1024  # bytes without a packet
_MOST_STRAY_PACKETS = 8
_LATEST = 3.0  # time-outs after its request until which an answer may come
_STATUS = 0x55
_ALERT = 0x80
_CRC_ERROR = 3

STATUS_ERRORS: Mapping[int, str] = {
    1: "it could not process the instruction",
    2: "it does not know the instruction",
    3: "the instruction arrived damaged",
    4: "the value is out of range",
    5: "the length of the data is wrong",
    6: "the value is beyond the limit that is set in the servo",
    7: "the address cannot be accessed: it is read-only, not defined, or locked while the torque is on",
}
"""Why the servo refuses an instruction (ROBOTIS e-Manual, Protocol 2.0, status packet)."""


class ServoLineSettings(SerialSettings):
    """Rig-file settings of the line to a Dynamixel."""

    address_key: ClassVar[str] = "id"

    id: int = Field(default=1, ge=0, le=252, description="id on the bus, 0 to 252")
    baudrate: int = Field(
        default=57600, ge=9600, le=4_500_000, description="speed of the line, Bd, as set in the servo (register 8)"
    )

    @property
    def longest_turn(self) -> float:
        """Longest time that a request and its repetitions keep the line while nothing answers, s."""
        return super().longest_turn + _LATEST * self.timeout


class RefusedError(Exception):
    """The servo answered with an error number."""

    def __init__(self, code: int) -> None:
        super().__init__(STATUS_ERRORS.get(code, f"error number {code}"))
        self.code = code


class ServoLine(RepeatingLine):
    """The serial line to one servo: packets, their CRC and stuffing, and sending again.

    A request that brings no answer, or a damaged one, is sent again, twice at most; all requests of the driver may
    be carried out twice. As answers carry no number, what has come is discarded before each request, and none is sent
    before an answer that is missing can come no more: it may be three time-outs late. Packets of other servos are
    skipped, and so is the echo of the request that adapters of two-wire lines give.

    Attributes
    ----------
    alert : bool
        Whether the last answer reported a hardware error.
    answered : bool
        Whether the servo has answered since the line was opened.
    urgent : bool
        Whether requests are sent without waiting for what may still come.
    """

    def __init__(self, device: str, settings: ServoLineSettings, clock: Clock) -> None:
        self._device = device
        self._settings = settings
        self._clock = clock
        self._received = bytearray()
        self._heard = b""
        self._heads: dict[int, bytes] = {}
        self._quiet_at = -math.inf
        self._silence = f"no answer within {settings.timeout:g} s"
        self.alert = self.answered = self.urgent = False
        self.port = open_port(device, settings)

    def close(self) -> None:
        """Release the line."""
        self.port.close()

    def reading(self, address: int, length: int) -> Callable[[], bytes]:
        """Return a function that reads bytes of the control table; its errors are those of `ask`."""
        return partial(self._exchange, frame(self._settings.id, READ, struct.pack("<HH", address, length)), length)

    def ask(self, instruction: int, parameters: bytes, length: int) -> bytes:
        """Send an instruction; return the `length` bytes of its answer.

        Raises
        ------
        RefusedError
            If the servo answers with an error number.
        DeviceConnectionError
            If no good answer comes.
        """
        return self._exchange(frame(self._settings.id, instruction, parameters), length)

    def order(self, instruction: int, parameters: bytes) -> None:
        """Send an instruction that is answered without content; errors are those of `ask`."""
        self._exchange(frame(self._settings.id, instruction, parameters), 0)

    def tell(self, instruction: int, parameters: bytes) -> None:
        """Send an instruction that may or may not be answered; raises `DeviceConnectionError` if the line is lost."""
        try:
            self.port.write(frame(self._settings.id, instruction, parameters))
            self._expect_late()
        except (serial.SerialException, OSError) as error:
            raise lost_line(self._device, self._settings.port, error) from None

    def _exchange(self, request: bytes, length: int) -> bytes:
        problem = self._silence
        resends, self.resends = self.resends, RESENDS
        try:
            if self._clock.now() < self._quiet_at and not self.urgent:
                self._clock.sleep_until(self._quiet_at)
            for number in range(1 + resends):
                if number:
                    # The answer to the first one may come as well, after the one that is taken.
                    self.repeats += 1
                    self._expect_late()
                self._received.clear()
                self._heard = b""
                forget_received(self.port)
                self.port.write(request)
                problem, answer = self._answer(length)
                if problem == "":
                    self.answered = True
                    error = answer[0]
                    self.alert = bool(error & _ALERT)
                    if error & ~_ALERT:
                        raise RefusedError(error & ~_ALERT)
                    return answer[1:]
            self._expect_late()
        except (serial.SerialException, OSError) as error:
            raise lost_line(self._device, self._settings.port, error) from None
        self.resends = 0
        found = "" if _HEADER in self._heard else other_answer(self._heard)
        raise no_answer(self._device, self._settings, problem, "id", self._settings.id, found, resends=resends)

    def _expect_late(self) -> None:
        """Take note that an answer to what is sent now may come late."""
        self._quiet_at = self._clock.now() + _LATEST * patience_of(self.port, self._settings)

    def _answer(self, length: int) -> tuple[str, bytes]:
        """Return what is wrong with the answer, if anything; its error byte and its content."""
        ended = False
        if not self._received:
            # As a rule the answer comes whole, and nothing else does.
            expected = _SHORTEST_ANSWER + length
            data = self.port.read(expected)
            whole = len(data) == expected and data.startswith(self._answer_head(length))
            if whole and not data[8] & ~_ALERT and crc(data[:-2]) == data[-2] | data[-1] << 8:
                return "", data[8:-2]
            self._received += data
            self._heard += data
            ended = len(data) < expected
        return self._search_answer(length, ended)

    def _answer_head(self, length: int) -> bytes:
        """Return the beginning of an answer that has so many bytes of content, up to the instruction."""
        head = self._heads.get(length)
        if head is None:
            head = self._heads[length] = _HEADER + struct.pack("<BHB", self._settings.id, length + 4, _STATUS)
        return head

    def _search_answer(self, length: int, ended: bool) -> tuple[str, bytes]:
        """Look for the answer among what has come and comes; `ended` is whether the line has just been silent."""
        for _ in range(_MOST_STRAY_PACKETS):
            packet = self._read_packet(_SHORTEST_ANSWER + length, ended)
            ended = False
            if packet is None:
                return self._silence, b""
            if packet == b"":
                return "damaged answer", b""
            if packet[4] != self._settings.id or packet[_HEAD] != _STATUS:
                continue
            answer = packet[_HEAD + 1 : -2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
            if not answer:
                return "answer without an error number", b""
            error = answer[0] & ~_ALERT
            if error == _CRC_ERROR:
                return STATUS_ERRORS[_CRC_ERROR], b""
            if not error and len(answer) != 1 + length:
                return f"answer of {len(answer) - 1} instead of {length} bytes", b""
            return "", answer
        return "only packets of others", b""

    def _read_packet(self, expected: int, ended: bool) -> bytes | None:
        """Return the next packet, None after silence, nothing for a damaged one."""
        # All the bytes that are expected are waited for at once, which is faster than to begin with the head; a
        # refusal of a read is shorter, so it is noticed after the timeout only.
        received = self._received
        read = 0
        while read < _MOST_NOISE:
            start = received.find(_HEADER)
            # Without a header, the last bytes may be the beginning of one.
            del received[: start if start >= 0 else max(len(received) - len(_HEADER) + 1, 0)]
            missing = expected - len(received)
            if start >= 0 and len(received) >= _HEAD:
                length = int.from_bytes(received[5:_HEAD], "little")
                if not _SHORTEST_LENGTH <= length <= _LONGEST_LENGTH:
                    del received[:1]
                    continue
                end = _HEAD + length
                if len(received) >= end:
                    packet = bytes(received[:end])
                    del received[:end]
                    return packet if crc(packet[:-2]) == int.from_bytes(packet[-2:], "little") else b""
                missing = end - len(received)
            if ended:
                return b"" if received else None
            chunk = self.port.read(missing)
            received += chunk
            self._heard += chunk
            read += len(chunk)
            ended = len(chunk) < missing
        return b""


def frame(servo_id: int, instruction: int, parameters: bytes) -> bytes:
    """Return a packet; an FD is put in after each FF FF FD of its body."""
    body = bytes((instruction,)) + parameters
    body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = _HEADER + struct.pack("<BH", servo_id, len(body) + 2) + body
    return packet + struct.pack("<H", crc(packet))
