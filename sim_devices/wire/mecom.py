"""The MeCom protocol as a Meerstetter device serves it (Meerstetter 5117, MeCom protocol specification).

A request is `#`, address (2 hex digits), sequence number (4), payload, CRC-16 (4), carriage return; an
answer begins with `!` and repeats address and sequence number. All hex digits are upper case. The CRC
(polynomial 0x1021, initial value 0) is over every character before it. An acknowledge has no payload and
carries the CRC of its request, not its own.

Assumptions, as the specification's text was not at hand:

- A frame with a wrong CRC or header is dropped without an answer, as nothing in it can be trusted, the
  address included; the host times out and sends it again. A frame that is whole but whose
  payload makes no sense is answered with server error 04.
- The same frame again, sequence number included, is a repetition: it is answered as before and not acted
  on again. Only the last request is remembered.
- An answer to the broadcast address 0 repeats that address, which the maker's client software checks.
"""

from __future__ import annotations

import math
import re
import struct
from binascii import crc_hqx

from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.instruments.meerstetter_table import Parameter, ServerError
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.wire import WireServer

LONGEST_FRAME = 512
"""Characters after which a frame without an end is dropped; the longest real one is about half of it."""

_BROADCAST = 0
_SILENT = 255
_FRAME = re.compile(rb"#([0-9A-F]{2})([0-9A-F]{4})(.*)([0-9A-F]{4})", re.DOTALL)
_HEX = re.compile(r"[0-9A-F]*")


class MeComServer(WireServer):
    """The serial side of an emulated Meerstetter device.

    Answers `?VR`, `VS`, `?VL`, `?VM`, `?IF`, `ES`, `RS` and `CS`; a change of speed is acknowledged and has
    no effect, as an emulated line has no speed of its own.
    """

    protocol = "MeCom"

    def __init__(self, device: EmulatedTEC) -> None:
        self._device = device
        self._received = b""
        self._last_request = b""
        self._last_answer = b""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the device sends."""
        with self._device.world.lock:
            *frames, rest = (self._received + data).split(b"\r")
            # A new start sign begins a new frame.
            start = rest.rfind(b"#")
            self._received = rest[start:] if start >= 0 and len(rest) - start <= LONGEST_FRAME else b""
            return b"".join(self._serve(frame) for frame in frames)

    def _serve(self, frame: bytes) -> bytes:
        frame = frame[max(frame.rfind(b"#"), 0) :]
        match = _FRAME.fullmatch(frame)
        if match is None or len(frame) > LONGEST_FRAME or not self._device.plugged_in:
            return b""
        address, sequence, payload, crc = match.groups()
        if crc != _crc(frame[:-4]):
            return b""
        number = int(address, 16)
        if number not in (_BROADCAST, _SILENT, self._device.address):
            return b""
        self._device.attend()
        if frame != self._last_request:
            self._last_request = frame
            self._last_answer = self._answer(b"!" + address + sequence, payload, crc)
        return b"" if number == _SILENT else self._device.transmit(self._last_answer)

    def _answer(self, header: bytes, payload: bytes, crc: bytes) -> bytes:
        try:
            content = self._act(payload.decode("ascii", "replace"))
        except RequestRefusedError as error:
            content = f"+{error.reason:02X}"
        if content == "":
            return header + crc + b"\r"
        body = header + content.encode("ascii")
        return body + _crc(body) + b"\r"

    def _act(self, payload: str) -> str:
        """Carry a request out; return the payload of the answer, empty for an acknowledge."""
        device = self._device
        command = payload[:3] if payload.startswith("?") else payload[:2]
        operand = payload[len(command) :]
        if command == "?VR":
            row, instance = self._row(operand, 6)
            return _encode(row, device.read_parameter(row.number, instance))
        if command == "VS":
            row, instance = self._row(operand, 14)
            device.write_parameter(row.number, _decode(row, operand[6:]), instance)
            return ""
        if command == "?VL":
            row, _ = self._row(operand, 6)
            return f"{_type_code(row):02X}{_encode(row, row.low)}{_encode(row, row.high)}"
        if command == "?VM":
            row, instance = self._row(operand, 6)
            value = device.read_parameter(row.number, instance)
            # Type, flags (1 readable, 2 writable), instances, elements; then range and present value.
            head = f"{_type_code(row):02X}{3 if row.writable else 1:02X}{1:02X}{1:08X}"
            return head + "".join(_encode(row, each) for each in (row.low, row.high, value))
        if command == "CS":
            _operand(operand, 8)
            return ""
        if command in ("?IF", "ES", "RS"):
            _operand(operand, 0)
            if command == "?IF":
                return device.identification
            if command == "ES":
                device.emergency_stop()
            else:
                device.reset()
            return ""
        raise RequestRefusedError(ServerError.COMMAND_NOT_AVAILABLE)

    def _row(self, operand: str, digits: int) -> tuple[Parameter, int]:
        _operand(operand, digits)
        instance = int(operand[4:6], 16)
        return self._device.parameter(int(operand[:4], 16), instance), instance


def _operand(operand: str, digits: int) -> None:
    if len(operand) != digits or _HEX.fullmatch(operand) is None:
        raise RequestRefusedError(ServerError.FORMAT)


def _crc(data: bytes) -> bytes:
    return b"%04X" % crc_hqx(data, 0)


def _type_code(row: Parameter) -> int:
    return 1 if row.kind == "INT32" else 0


def _encode(row: Parameter, value: float) -> str:
    if row.kind == "INT32":
        return f"{int(value) & 0xFFFFFFFF:08X}"
    return struct.pack(">f", value).hex().upper()


def _decode(row: Parameter, digits: str) -> float:
    raw = bytes.fromhex(digits)
    value: float = struct.unpack(">i" if row.kind == "INT32" else ">f", raw)[0]
    if math.isnan(value):
        raise RequestRefusedError(ServerError.OUT_OF_RANGE)
    return value
