"""The Dynamixel Protocol 2.0 as servos on one bus serve it (ROBOTIS e-Manual, Protocol 2.0).

A packet is FF FF FD 00, id, length (2 bytes), instruction, parameters, CRC-16 (2 bytes); numbers begin with
their lowest byte. The length counts what follows it. The CRC (polynomial 0x8005, initial value 0, highest bit
first) is over everything before it. From the instruction to the last parameter, an FD is put in after each
FF FF FD, so that FF FF FD 00 is always the beginning of a packet.

Assumptions, where the e-Manual is silent:

- A packet with a wrong CRC is dropped without an answer, as nothing in it can be trusted.
- In a sync or bulk read, a servo that is not there leaves a gap; those after it answer all the same. The one
  answer of a fast read ends before the first servo that is not there.
- The e-Manual lists the fast reads for other series only; these servos know them, too. A servo that refuses
  a fast read says so by its error number and sends zeros.
- Sync and bulk instructions, which are for all, are passed over when they carry the id of one servo.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from enum import IntEnum
from functools import lru_cache

from bench.base import crc16_dynamixel as crc16
from sim_devices.instruments.dynamixel import LOWEST_FIRMWARE_THAT_CLEARS, EmulatedMX28
from sim_devices.instruments.dynamixel_table import ErrorNumber
from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.wire import WireServer

LONGEST_FRAME = 1024
"""Bytes beyond which what looks like a packet is taken for noise; it is the longest of the maker's software."""

BROADCAST = 254

_READ = struct.Struct("<HH")  # address and length
_HEADER = b"\xff\xff\xfd\x00"
_HEAD = 7  # header, id and length
_LOWEST_LENGTH = 3  # instruction and CRC
_ALERT = 0x80


class Instruction(IntEnum):
    """The instructions of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


_ANSWERED_FROM = {int(Instruction.PING): 0, int(Instruction.READ): 1}
"""Lowest status return level at which an instruction is answered; all others are from 2 on."""

_FOR_ALL = frozenset(
    (
        Instruction.SYNC_READ,
        Instruction.SYNC_WRITE,
        Instruction.FAST_SYNC_READ,
        Instruction.BULK_READ,
        Instruction.BULK_WRITE,
        Instruction.FAST_BULK_READ,
    )
)


def frame(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return a packet."""
    body = (b"%c%s" % (instruction, parameters)).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = _HEADER + struct.pack("<BH", servo_id, len(body) + 2) + body
    return packet + crc16(packet).to_bytes(2, "little")


def _content(packet: bytes) -> tuple[int, int, bytes]:
    """Return id, instruction and parameters of a packet."""
    body = packet[_HEAD:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
    return packet[4], body[0], body[1:]


@lru_cache(maxsize=256)
def _whole_instruction(data: bytes) -> tuple[int, int, bytes] | None:
    """Return the content of data that are exactly one good packet; None if they are anything else."""
    if len(data) < _HEAD + _LOWEST_LENGTH or len(data) > LONGEST_FRAME or not data.startswith(_HEADER):
        return None
    if int.from_bytes(data[5:_HEAD], "little") != len(data) - _HEAD or data.find(_HEADER, 1, len(data) - 2) > 0:
        return None
    return _content(data) if crc16(data[:-2]) == int.from_bytes(data[-2:], "little") else None


class Dynamixel2Server(WireServer):
    """The serial side of the servos on one bus.

    Parameters
    ----------
    servos : iterable of EmulatedMX28
        The servos; they share one world.

    Raises
    ------
    ValueError
        If there is none, two have one id, or they live in different worlds.
    """

    protocol = "Dynamixel 2.0"
    has_addresses = True

    def __init__(self, servos: Iterable[EmulatedMX28]) -> None:
        self._servos = tuple(servos)
        if not self._servos:
            raise ValueError("servos: expected at least one")
        self._world = self._servos[0].world
        if any(servo.world is not self._world for servo in self._servos):
            raise ValueError("servos: expected all of them in one world")
        if len({servo.bus_id for servo in self._servos}) < len(self._servos):
            raise ValueError("servos: expected an id of its own for each")
        self._received = b""

    def readdressed(self, answer: bytes) -> bytes:
        """Return a status packet of the next servo."""
        packet = answer[:4] + bytes(((answer[4] + 1) % BROADCAST,)) + answer[5:-2]
        return packet + crc16(packet).to_bytes(2, "little")

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the servos send."""
        with self._world.lock:
            if not self._received:
                # As a rule, one whole packet comes at once.
                whole = _whole_instruction(data)
                if whole is not None:
                    return self._serve(*whole)
            self._received += data
            return b"".join(self._serve(*_content(packet)) for packet in self._packets())

    def _packets(self) -> Iterator[bytes]:
        """Take the whole packets with a good CRC out of what was received."""
        received = self._received
        start = 0
        while True:
            start = received.find(_HEADER, start)
            if start < 0:
                # The last bytes may be the beginning of a header.
                start = max(len(received) - len(_HEADER) + 1, 0)
                break
            head = received[start : start + _HEAD]
            length = int.from_bytes(head[5:], "little") if len(head) == _HEAD else _LOWEST_LENGTH
            end = start + _HEAD + length
            if not _LOWEST_LENGTH <= length <= LONGEST_FRAME - _HEAD:
                start += 1
                continue
            # Within a packet its stuffing excludes a header: so another one there is the next packet's, and
            # this one was cut off. At its very end, the CRC may happen to complete one.
            following = received.find(_HEADER, start + 1, end - 2)
            if following >= 0:
                start = following
                continue
            if len(received) < end or len(head) < _HEAD:
                break
            packet = received[start:end]
            if crc16(packet[:-2]) != int.from_bytes(packet[-2:], "little"):
                start += 1
                continue
            start = end
            yield packet
        self._received = received[start:]

    def _serve(self, number: int, instruction: int, parameters: bytes) -> bytes:
        if instruction == Instruction.STATUS:
            return b""
        # Every instruction packet feeds the bus watchdogs of all (e-Manual, Bus Watchdog).
        if len(self._servos) == 1 and number == self._servos[0].bus_id:
            # As a rule, the one servo is asked by its own id.
            (servo,) = self._servos
            heard = servo.hear()
            return self._serve_one(servo, instruction, parameters) if heard and instruction not in _FOR_ALL else b""
        present = {servo.bus_id: servo for servo in self._servos if servo.hear()}
        if instruction in _FOR_ALL:
            if number != BROADCAST:
                return b""
            return self._serve_several(present, Instruction(instruction), parameters)
        if number == BROADCAST:
            answers = [self._serve_one(present[one], instruction, parameters, to_all=True) for one in sorted(present)]
            return b"".join(answers) if instruction == Instruction.PING else b""
        return self._serve_one(present[number], instruction, parameters) if number in present else b""

    def _serve_one(self, servo: EmulatedMX28, instruction: int, parameters: bytes, *, to_all: bool = False) -> bytes:
        # Level and id as they were when the packet came: it may change both.
        level, bus_id = servo.status_return_level, servo.bus_id
        error, content = 0, b""
        try:
            content = _act(servo, instruction, parameters, to_all=to_all)
        except RequestRefusedError as refusal:
            error = refusal.reason
        if level < _ANSWERED_FROM.get(instruction, 2):
            return b""
        return _status(servo, bus_id, error, content)

    def _serve_several(
        self, present: Mapping[int, EmulatedMX28], instruction: Instruction, parameters: bytes
    ) -> bytes:
        if instruction in (Instruction.SYNC_WRITE, Instruction.BULK_WRITE):
            for number, address, data in _writes(instruction, parameters):
                if number in present:
                    _refusable_write(present[number], address, data)
            return b""
        reads = _reads(instruction, parameters)
        if instruction in (Instruction.SYNC_READ, Instruction.BULK_READ):
            return b"".join(
                self._serve_one(present[number], Instruction.READ, struct.pack("<HH", address, length))
                for number, address, length in reads
                if number in present
            )
        return _fast_answer(present, reads)


def _act(servo: EmulatedMX28, instruction: int, parameters: bytes, *, to_all: bool) -> bytes:
    """Have one servo carry an instruction out; return the parameters of its answer."""
    match instruction:
        case Instruction.READ:
            _expect(parameters, 4)
            return servo.read_bytes(*_READ.unpack(parameters))
        case Instruction.PING:
            _expect(parameters, 0)
            return struct.pack("<HB", servo.model_number, servo.firmware)
        case Instruction.WRITE | Instruction.REG_WRITE:
            if len(parameters) < 3:
                raise RequestRefusedError(ErrorNumber.DATA_LENGTH)
            write = servo.write_bytes if instruction == Instruction.WRITE else servo.register_write
            write(int.from_bytes(parameters[:2], "little"), parameters[2:])
        case Instruction.ACTION:
            _expect(parameters, 0)
            servo.action()
        case Instruction.FACTORY_RESET:
            _expect(parameters, 1)
            # From firmware 42 on, all servos at once do not lose their ids.
            if not (to_all and parameters[0] == 0xFF and servo.firmware >= LOWEST_FIRMWARE_THAT_CLEARS):
                servo.factory_reset(parameters[0])
        case Instruction.REBOOT:
            _expect(parameters, 0)
            servo.reboot()
        case Instruction.CLEAR:
            servo.clear(parameters)
        case _:
            raise RequestRefusedError(ErrorNumber.INSTRUCTION)
    return b""


def _expect(parameters: bytes, length: int) -> None:
    if len(parameters) != length:
        raise RequestRefusedError(ErrorNumber.DATA_LENGTH)


def _refusable_write(servo: EmulatedMX28, address: int, data: bytes) -> None:
    try:
        servo.write_bytes(address, data)
    except RequestRefusedError:
        # A write to several servos is not answered.
        return


def _reads(instruction: Instruction, parameters: bytes) -> list[tuple[int, int, int]]:
    """Return id, address and length of each read; none if the packet makes no sense."""
    if instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
        if len(parameters) < 4:
            return []
        address, length = struct.unpack_from("<HH", parameters)
        reads = [(number, address, length) for number in parameters[4:]]
    else:
        if len(parameters) % 5:
            return []
        reads = list(struct.iter_unpack("<BHH", parameters))
    return reads if _distinct(number for number, _, _ in reads) else []


def _writes(instruction: Instruction, parameters: bytes) -> list[tuple[int, int, bytes]]:
    """Return id, address and data of each write; none if the packet makes no sense."""
    writes = []
    if instruction == Instruction.SYNC_WRITE:
        if len(parameters) < 4:
            return []
        address, length = struct.unpack_from("<HH", parameters)
        rest = parameters[4:]
        if len(rest) % (1 + length):
            return []
        writes = [
            (rest[start], address, rest[start + 1 : start + 1 + length]) for start in range(0, len(rest), 1 + length)
        ]
    else:
        start = 0
        while start < len(parameters):
            if len(parameters) < start + 5:
                return []
            number, address, length = struct.unpack_from("<BHH", parameters, start)
            start += 5 + length
            if len(parameters) < start:
                return []
            writes.append((number, address, parameters[start - length : start]))
    return writes if _distinct(number for number, _, _ in writes) else []


def _distinct(numbers: Iterable[int]) -> bool:
    listed = list(numbers)
    return len(set(listed)) == len(listed)


def _fast_answer(present: Mapping[int, EmulatedMX28], reads: list[tuple[int, int, int]]) -> bytes:
    """Return the one answer of several servos: each adds its part and the CRC of everything before it."""
    total = 1 + sum(4 + length for _, _, length in reads)
    if not reads or total > LONGEST_FRAME - _HEAD:
        return b""
    answer = _HEADER + struct.pack("<BHB", BROADCAST, total, Instruction.STATUS)
    for number, address, length in reads:
        servo = present.get(number)
        if servo is None or servo.status_return_level < 1:
            # No servo continues the answer, and none begins it.
            return answer if number != reads[0][0] else b""
        error, content = 0, bytes(length)
        try:
            content = servo.read_bytes(address, length)
        except RequestRefusedError as refusal:
            error = refusal.reason
        # This form of answer has no stuffing.
        answer += bytes((error | _ALERT * servo.alert, number)) + content
        answer += struct.pack("<H", crc16(answer))
    return answer


def _status(servo: EmulatedMX28, bus_id: int, error: int, content: bytes) -> bytes:
    flags = error | (_ALERT if servo.alert else 0)
    return frame(bus_id, Instruction.STATUS, bytes((flags,)) + content)
