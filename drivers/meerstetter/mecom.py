"""The MeCom protocol on a serial line: frames, their CRC and sequence numbers, and parameters.

Sources: Meerstetter 5117C (MeCom protocol specification: frames, CRC, server errors, sending again); Meerstetter's
MeComAPI for .NET 5205F, `BulkParRead` (`?VX`).
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import ClassVar, NamedTuple

import serial
from pydantic import Field

from bench.base import DeviceError
from drivers.device import other_answer
from drivers.serial_line import (
    RESENDS,
    RepeatingLine,
    SerialSettings,
    forget_received,
    lost_line,
    no_answer,
    open_port,
)

_MOST_STALE_ANSWERS = 8
_HASTE = 0.2  # s, longest wait for an answer where time is short
_HASTY_RESENDS = 1
_ACKNOWLEDGE_LENGTH = 12  # !, address, sequence, CRC, carriage return
_ERROR_LENGTH = 15  # the same and + with two digits
_LONGEST_NONSENSE = 256  # characters without an end; the longest answer has 52, and two may have lost their end

SERVER_ERRORS: Mapping[int, str] = {
    1: "the command is not available",
    2: "the device is busy",
    3: "general communication error",
    4: "format error",
    5: "the parameter is not available",
    6: "the parameter is read-only",
    7: "the value is out of range",
    8: "the instance is not available; check the channel",
    9: "general error of the parameter",
}
"""Why the device refuses a request (Meerstetter 5117, server error codes)."""


class TECLineSettings(SerialSettings):
    """Rig-file settings of the line to a Meerstetter TEC controller."""

    address_key: ClassVar[str] = "address"

    address: int = Field(default=1, ge=1, le=254, description="device address (parameter 2051), 1 to 254")
    baudrate: int = Field(default=57600, ge=4800, le=1_000_000, description="speed of the line, Bd")
    timeout: float = Field(
        default=0.2, gt=0.0, le=10.0, description="wait for an answer, s; a request is sent three times at most"
    )


class Parameter(NamedTuple):
    """A device parameter: INT32 or FLOAT32, of a channel or of the whole device."""

    number: int
    title: str
    real: bool = False
    of_channel: bool = True


class RefusedError(Exception):
    """The device answered a request with a server error."""

    def __init__(self, code: int) -> None:
        super().__init__(SERVER_ERRORS.get(code, f"server error {code}"))
        self.code = code


class TECLine(RepeatingLine):
    """The serial line to one device: frames, their CRC and sequence numbers, and sending again.

    A request that brings no answer, or a damaged one, is sent again with its own sequence number, twice at
    most (5117C). The device may carry it out again, so an order that must not be repeated is sent once. An answer
    with another sequence number is a late one to an earlier request, and is skipped.
    """

    def __init__(self, device: str, settings: TECLineSettings) -> None:
        self._device = device
        self._settings = settings
        self._begin = f"#{settings.address:02X}"
        self._sequence = 0
        self._most_resends = RESENDS
        self._received = bytearray()
        self._strange = b""
        self._silence = f"no answer within {settings.timeout:g} s"
        self.port = open_port(device, settings)

    def close(self) -> None:
        """Release the line."""
        self.port.close()

    def follow(self, line: TECLine) -> None:
        """Go on counting where another line to the device has ended, as an answer to it may still come."""
        self._sequence = line._sequence

    @contextmanager
    def in_haste(self) -> Iterator[None]:
        """Wait 0.2 s at most for an answer, and send a request twice at most."""
        patience = self.port.timeout
        self._most_resends = _HASTY_RESENDS
        try:
            self._wait_for(min(patience, _HASTE))
            yield
        finally:
            self._most_resends = RESENDS
            self._wait_for(patience)

    def _wait_for(self, patience: float) -> None:
        # pyserial sets an open port up again, and a lost one says that it is lost at the next request.
        with suppress(serial.SerialException, OSError):
            self.port.timeout = patience

    def ask(self, request: str, digits: int) -> str:
        """Send a query; return the `digits` characters of its answer.

        Raises
        ------
        RefusedError
            If the device answers with a server error.
        DeviceConnectionError
            If no good answer comes.
        """
        return self._exchange(request, digits).decode("ascii", "replace")

    def order(self, request: str, *, resends: int = RESENDS) -> None:
        """Send a command that the device only acknowledges; errors are those of `ask`."""
        self._exchange(request, 0, resends)

    def _exchange(self, request: str, digits: int, resends: int = RESENDS) -> bytes:
        sequence = self._sequence = (self._sequence + 1) & 0xFFFF
        body = f"{self._begin}{sequence:04X}{request}".encode("ascii")
        end = b"%04X\r" % crc_hqx(body, 0)
        frame, head = body + end, b"!" + body[1:7]
        self._strange = b""
        resends, self.resends = min(resends, self._most_resends, self.resends), RESENDS
        try:
            for attempt in range(1 + resends):
                if attempt:
                    self.repeats += 1
                self.port.write(frame)
                # An emulated line has the answer already.
                answer: bytes = self.port.read_all()
                if len(answer) == _ACKNOWLEDGE_LENGTH + digits and answer.startswith(head) and not self._received:
                    # A good answer that is all there is, as it mostly is on an emulated line.
                    if not digits:
                        if answer.endswith(end):
                            return b""
                    elif answer.endswith(b"%04X\r" % crc_hqx(answer[:-5], 0)):
                        return answer[7:-5]
                self._received += answer
                problem, content = self._answer(head, end[:-1], digits)
                if not problem:
                    return content
                if content[:1] == b"+":
                    raise RefusedError(int(content[1:3], 16))
                if problem != self._silence:
                    # All else that has come belongs to the damage; after silence, a late answer may come.
                    self._received.clear()
                    forget_received(self.port)
        except (serial.SerialException, OSError) as error:
            raise lost_line(self._device, self._settings.port, error) from None
        self.resends = 0
        found, address = other_answer(self._strange), self._settings.address
        raise no_answer(self._device, self._settings, problem, "address", address, found, resends=resends)

    def _answer(self, head: bytes, crc: bytes, digits: int) -> tuple[str, bytes]:
        """Return what is wrong with the answer, if anything, and its payload."""
        for _ in range(_MOST_STALE_ANSWERS):
            answer = self._read_answer(_ACKNOWLEDGE_LENGTH + digits)
            if answer is None:
                if b"!" not in self._received:
                    self._strange += self._received
                return self._silence, b""
            if (begin := answer.rfind(b"!")) > 0:
                answer = answer[begin:]
            if not answer.startswith(head):
                if not answer.startswith(b"!"):
                    self._strange += answer
                continue
            content, received_crc = answer[7:-4], answer[-4:]
            # An acknowledge carries the CRC of the request.
            expected_crc = b"%04X" % crc_hqx(answer[:-4], 0) if content else crc
            if received_crc != expected_crc:
                return "damaged answer", b""
            if content[:1] == b"+" and len(content) == 3 and content[1:].isdigit():
                return "refused", content
            if len(content) != digits:
                return f"answer of {len(content)} instead of {digits} characters", b""
            return "", content
        return "only late or damaged answers", b""

    def _read_answer(self, length: int) -> bytes | None:
        """Read up to the next carriage return, without waiting for more than the shortest answer has."""
        received = self._received
        while (end := received.find(b"\r")) < 0:
            if len(received) < _ACKNOWLEDGE_LENGTH:
                missing = _ACKNOWLEDGE_LENGTH - len(received)
            elif received[7:8] == b"+" and len(received) < _ERROR_LENGTH:
                missing = _ERROR_LENGTH - len(received)
            else:
                missing = max(length - len(received), 1)
            chunk = self.port.read(missing)
            received += chunk
            if len(chunk) < missing and b"\r" not in chunk:
                # What came is kept: the rest of a slow answer may still follow.
                return None
            if len(received) > _LONGEST_NONSENSE:
                received.clear()
                return b""
        answer = bytes(received[:end])
        del received[: end + 1]
        return answer


def encode(parameter: Parameter, value: float) -> str:
    """Return a value as 8 hex digits: IEEE 754 single precision, or two's complement."""
    if parameter.real:
        return struct.pack(">f", value).hex().upper()
    return f"{int(value) & 0xFFFFFFFF:08X}"


class Block:
    """Parameters that are read by one request, `?VX`.

    Parameters
    ----------
    channel : int
        The instance of those that belong to a channel.
    """

    def __init__(self, channel: int, *parameters: Parameter) -> None:
        self.parameters = parameters
        self.request = f"?VX{len(parameters):02X}" + "".join(selector(each, channel) for each in parameters)
        self.digits = 8 * len(parameters)
        self._form = struct.Struct(">" + "".join("f" if each.real else "i" for each in parameters))

    def decode(self, device: str, digits: str) -> tuple[float, ...]:
        """Return the values of an answer, in order."""
        try:
            return self._form.unpack(bytes.fromhex(digits))
        except (ValueError, struct.error):
            raise DeviceError(device, f"answered {digits!r} for {len(self.parameters)} parameters at once") from None


@lru_cache(256)
def selector(parameter: Parameter, channel: int) -> str:
    """Return number and instance of a parameter as 6 hex digits."""
    return f"{parameter.number:04X}{channel if parameter.of_channel else 1:02X}"


def decode(device: str, parameter: Parameter, digits: str) -> float:
    """Return the value of 8 hex digits; the inverse of `encode`."""
    try:
        value: float = struct.unpack(">f" if parameter.real else ">i", bytes.fromhex(digits))[0]
    except (ValueError, struct.error):
        raise DeviceError(
            device, f"answered {digits!r} for its {parameter.title} (parameter {parameter.number})"
        ) from None
    return value


def single(value: float) -> float:
    """Return a value rounded to single precision."""
    return float(struct.unpack(">f", struct.pack(">f", value))[0])
