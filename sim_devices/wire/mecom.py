"""The MeCom protocol as a Meerstetter device serves it (Meerstetter 5117, MeCom protocol specification).

A request is `#`, address (2 hex digits), sequence number (4), payload, CRC-16 (4), carriage return; an
answer begins with `!` and repeats address and sequence number. All hex digits are upper case. The CRC
(polynomial 0x1021, initial value 0) is over every character before it. An acknowledge has no payload and
carries the CRC of its request, not its own.

The sequence number is only sent back: a frame that comes again is carried out again, as nothing in the specification
says that a device remembers the last one.

Assumptions:

- A frame with a wrong CRC or header is dropped without an answer, as nothing in it can be trusted, the
  address included; the host times out and sends it again. A frame that is whole but whose
  payload makes no sense is answered with server error 04.
- An answer to the broadcast address 0 repeats that address, which the maker's client software checks.
- Big data (`?VB`, `VB`) are served for every parameter as the one element that it has here.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx, hexlify
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.instruments.meerstetter_table import Parameter, ServerError, find_parameter
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.wire import WireServer

LONGEST_FRAME = 512
"""Characters after which a frame without an end is dropped; the longest real one is about half of it."""

_BROADCAST = 0
_SILENT = 255
_SHORTEST_FRAME = 11
_PREAMBLE = re.compile(rb"#[0-9A-F]{6}")
_HEX = re.compile(r"[0-9A-F]*")
_FORMS = {"INT32": struct.Struct(">i"), "FLOAT32": struct.Struct(">f")}
_PARSED = 256  # payloads that are kept as parsed; a client sends a few over and over


@dataclass(frozen=True)
class _Selection:
    """Parameters that a payload names, and how their values are coded one behind the other."""

    keys: tuple[tuple[int, int], ...]
    form: struct.Struct

    def encode(self, values: list[float]) -> bytes:
        return hexlify(self.form.pack(*values)).upper()


class MeComServer(WireServer):
    """The serial side of an emulated Meerstetter device.

    Answers `?VR`, `VS`, `?VL`, `?VM`, `?VX` (several parameters at once), `?VB` and `VB` (big data), `?IF`, `ES`,
    `RS`, `SP` (save in the flash) and `CS`; a change of speed is acknowledged and has no effect, as an emulated line
    has no speed of its own.
    """

    protocol = "MeCom"
    has_addresses = True

    def __init__(self, device: EmulatedTEC) -> None:
        self._device = device
        self._received = b""
        self._commands: dict[str, Callable[[str], str]] = {
            "VS": self._write,
            "?VL": self._limits,
            "?VM": self._metadata,
            "?VB": self._read_big,
            "VB": self._write_big,
            "?IF": self._identify,
            "ES": self._order(device.emergency_stop),
            "RS": self._order(device.reset),
            "SP": self._order(device.save),
            "CS": self._change_speed,
        }

    def readdressed(self, answer: bytes) -> bytes:
        """Return an answer of the next address; the CRC of an acknowledge, which is its request's, stays."""
        if answer[:1] != b"!" or len(answer) <= _SHORTEST_FRAME:
            return answer
        body = b"!%02X" % (int(answer[1:3], 16) % 254 + 1) + answer[3:-5]
        return body + (answer[-5:] if len(body) == 7 else b"%04X\r" % crc_hqx(body, 0))

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the device sends."""
        with self._device.world.lock:
            if not self._received and data.find(b"\r") == len(data) - 1 >= 0:
                # One whole frame, as it mostly is.
                return self._serve(data[:-1])
            *frames, rest = (self._received + data).split(b"\r")
            # A new start sign begins a new frame.
            start = rest.rfind(b"#")
            self._received = rest[start:] if start >= 0 and len(rest) - start <= LONGEST_FRAME else b""
            return b"".join([self._serve(frame) for frame in frames])

    def _serve(self, frame: bytes) -> bytes:
        device = self._device
        if (begin := frame.rfind(b"#")) > 0:
            frame = frame[begin:]
        if not _SHORTEST_FRAME <= len(frame) <= LONGEST_FRAME or not device.plugged_in:
            return b""
        body, crc = frame[:-4], frame[-4:]
        if crc != b"%04X" % crc_hqx(body, 0) or not _PREAMBLE.match(body):
            return b""
        number = int(body[1:3], 16)
        if number != device.address and number not in (_BROADCAST, _SILENT):
            return b""
        device.attend_locked()
        head = b"!" + body[1:7]
        try:
            payload = body[7:]
            content = self._act(payload)
        except RequestRefusedError as error:
            content = b"+%02X" % error.reason
        if number == _SILENT:
            return b""
        answer = head + content
        # An acknowledge carries the CRC of its request.
        return answer + (b"%04X\r" % crc_hqx(answer, 0) if content else crc + b"\r")

    def _act(self, request: bytes) -> bytes:
        """Carry a request out; return the payload of the answer, empty for an acknowledge."""
        command, operand, selection = _parsed(request)
        if selection is not None:
            return self._values(selection)
        try:
            carry_out = self._commands[command]
        except KeyError:
            raise RequestRefusedError(ServerError.COMMAND_NOT_AVAILABLE) from None
        return carry_out(operand).encode("ascii")

    def _values(self, selection: _Selection) -> bytes:
        value = self._device.value
        return selection.encode([value(number, instance) for number, instance in selection.keys])

    def _write(self, operand: str) -> str:
        _check_digits(operand, 14)
        row, instance = _row(operand)
        self._device.assign(row, _decode(row, operand[6:]), instance)
        return ""

    def _limits(self, operand: str) -> str:
        _check_digits(operand, 6)
        row, _ = _row(operand)
        return f"{_type_code(row):02X}{_encode(row, row.low, row.high)}"

    def _metadata(self, operand: str) -> str:
        _check_digits(operand, 6)
        row, instance = _row(operand)
        # Type, flags (1 readable, 2 writable), instances, elements; then range and present value.
        head = f"{_type_code(row):02X}{3 if row.writable else 1:02X}{row.instances:02X}{1:08X}"
        return head + _encode(row, row.low, row.high, self._device.value(row.number, instance))

    def _read_big(self, operand: str) -> str:
        """Parameter, instance, first element (8 digits), most elements (4); answered by count, rest and data."""
        _check_digits(operand, 18)
        row, instance = _row(operand)
        if _digits(operand, 6, 8) or not _digits(operand, 14, 4):
            return f"{0:04X}{0:02X}"
        return f"{1:04X}{0:02X}" + _encode(row, self._device.value(row.number, instance))

    def _write_big(self, operand: str) -> str:
        """Parameter, instance, first element (8 digits), count (4), whether it is the last package (2), and data."""
        count = _digits(operand, 14, 4)
        _check_digits(operand, 20 + 8 * count)
        row, instance = _row(operand)
        if _digits(operand, 6, 8) or count != 1:
            raise RequestRefusedError(ServerError.OUT_OF_RANGE)
        self._device.assign(row, _decode(row, operand[20:]), instance)
        return ""

    def _identify(self, operand: str) -> str:
        _check_digits(operand, 0)
        return self._device.identification

    def _order(self, carry_out: Callable[[], None]) -> Callable[[str], str]:
        def act(operand: str) -> str:
            _check_digits(operand, 0)
            carry_out()
            return ""

        return act

    def _change_speed(self, operand: str) -> str:
        _check_digits(operand, 8)
        return ""


@lru_cache(_PARSED)
def _parsed(request: bytes) -> tuple[str, str, _Selection | None]:
    """Return command and operand of a payload, and of one that only reads parameters which these are."""
    payload = request.decode("ascii", "replace")
    command = payload[:3] if payload.startswith("?") else payload[:2]
    operand = payload[len(command) :]
    if command == "?VR":
        return command, operand, _single(operand)
    return command, operand, _several(operand) if command == "?VX" else None


def _row(operand: str) -> tuple[Parameter, int]:
    """Return the row of the parameter that an operand begins with, and the instance."""
    return _named_row(operand[:6])


@lru_cache(_PARSED)
def _named_row(name: str) -> tuple[Parameter, int]:
    instance = int(name[4:], 16)
    return find_parameter(int(name[:4], 16), instance), instance


def _check_digits(operand: str, digits: int) -> None:
    if len(operand) != digits or _HEX.fullmatch(operand) is None:
        raise RequestRefusedError(ServerError.FORMAT)


def _digits(operand: str, start: int, digits: int) -> int:
    """Return the number in some digits of an operand."""
    part = operand[start : start + digits]
    _check_digits(part, digits)
    return int(part, 16)


def _single(operand: str) -> _Selection:
    _check_digits(operand, 6)
    return _selection(operand)


def _several(operand: str) -> _Selection:
    count = _digits(operand, 0, 2)
    _check_digits(operand, 2 + 6 * count)
    return _selection(operand[2:])


def _selection(names: str) -> _Selection:
    """Parse parameters and instances, 6 digits each; raise `RequestRefusedError` if one does not exist."""
    keys = tuple((int(names[at : at + 4], 16), int(names[at + 4 : at + 6], 16)) for at in range(0, len(names), 6))
    rows = [find_parameter(*key) for key in keys]
    return _Selection(keys, struct.Struct(">" + "".join(_form(row) for row in rows)))


def _form(row: Parameter) -> str:
    return "i" if row.kind == "INT32" else "f"


def _type_code(row: Parameter) -> int:
    return 1 if row.kind == "INT32" else 0


def _encode(row: Parameter, *values: float) -> str:
    return struct.pack(f">{len(values)}{_form(row)}", *values).hex().upper()


def _decode(row: Parameter, digits: str) -> float:
    return _number(_FORMS[row.kind], bytes.fromhex(digits))


def _number(form: struct.Struct, data: bytes) -> float:
    value: float = form.unpack(data)[0]
    if value != value:  # nan
        raise RequestRefusedError(ServerError.OUT_OF_RANGE)
    return value
