"""Emulated instruments that are banks of named Modbus registers."""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Literal, NamedTuple

from sim_devices.wire.modbus import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Frame, Packet, RegisterError

Kind = Literal["F32", "I32", "U32", "U16"]

_FORMATS = {"F32": ">f", "I32": ">i", "U32": ">I", "U16": ">H"}

Reader = Callable[[], float]
"""Returns the value of a register."""


@dataclass(frozen=True)
class Register:
    """One row of a register map, or several numbered registers of one meaning."""

    name: str
    """Name in the manual; a `#` stands for the number, as in `AIN#_RANGE`."""
    address: int
    """Address of the first 16-bit word, 0 to 65535; the highest word comes first."""
    kind: Kind
    """Type of the value."""
    read: Callable[..., float] | None = None
    """Returns the value; without it the register can only be written. Takes the number if there are several."""
    write: Callable[..., None] | None = None
    """Takes the value, after the number if there are several; without it the register can only be read."""
    count: int = 1
    """How many registers there are, one behind the other."""

    @property
    def words(self) -> int:
        """Number of 16-bit words."""
        return 1 if self.kind == "U16" else 2

    def encode(self, value: float) -> tuple[int, ...]:
        """Return the words of a value."""
        raw = struct.pack(_FORMATS[self.kind], value if self.kind == "F32" else int(value))
        return struct.unpack(f">{self.words}H", raw)

    def decode(self, words: Sequence[int]) -> float:
        """Return the value of words: an int, except for `F32`."""
        value: float = struct.unpack(_FORMATS[self.kind], struct.pack(f">{self.words}H", *words))[0]
        return value

    def each(self) -> Iterable[Register]:
        """Return the registers that the row stands for."""
        if "#" not in self.name:
            return (self,)
        return (
            Register(
                self.name.replace("#", str(number)),
                self.address + number * self.words,
                self.kind,
                self.read and partial(self.read, number),
                self.write and partial(self.write, number),
            )
            for number in range(self.count)
        )


FrameParts = tuple[Sequence[Reader], Sequence[Register]]
"""Readers of one frame of a packet, and the registers that it writes."""


class _Reads(NamedTuple):
    """What a read of neighbouring words takes."""

    read: tuple[Reader, ...]
    values: struct.Struct
    words: struct.Struct
    skipped: int
    """Bytes of the first value that were not asked for."""


class _Writes(NamedTuple):
    """What a write of neighbouring words takes: the registers, up to the one for which it is refused."""

    registers: tuple[Register, ...]
    values: struct.Struct
    words: struct.Struct
    refusal: RegisterError | None


def _integer(read: Reader) -> int:
    return int(read())


def _joint(registers: Iterable[Register]) -> struct.Struct:
    """Return the form of the values of neighbouring registers."""
    return struct.Struct(">" + "".join(_FORMATS[register.kind][1:] for register in registers))


class Service:
    """The time in which an instrument serves a request, to be entered again and again."""

    def __init__(self, begin: Callable[[], None], end: Callable[[BaseException | None], None]) -> None:
        self._begin = begin
        self._end = end

    def __enter__(self) -> None:
        self._begin()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end(error)


class RegisterInstrument(ABC):
    """A bank of registers with names; a `sim_devices.wire.modbus.RegisterBank`."""

    _touched = False
    """Whether an output may have changed since `_lead`."""

    def _set_map_up(self, rows: Iterable[Register]) -> None:
        registers = [register for row in rows for register in row.each()]
        self._named = {register.name: register for register in registers}
        self._words = {register.address + word: register for register in registers for word in range(register.words)}
        # What a request means is found once; a host asks the same few again and again.
        self._known_reads: dict[tuple[int, int], _Reads] = {}
        self._known_writes: dict[tuple[int, int], _Writes] = {}
        self._service = Service(self._begin, self._end)

    def _request(self) -> AbstractContextManager[None]:
        """Serve a request: hold the lock, at the clock's present time."""
        return self._service

    @abstractmethod
    def _begin(self) -> None:
        """Begin a request; if it raises, the request does not begin."""

    @abstractmethod
    def _end(self, error: BaseException | None) -> None:
        """End a request, with what it raised."""

    def read_registers(self, address: int, count: int) -> list[int]:
        """Return `count` registers from `address` on, of one instant; reading half a value is allowed.

        Raises `RegisterError` if one of them does not exist or cannot be read; nothing was read then.
        """
        with self._request():
            reads = self._known_reads.get((address, count)) or self._reads(address, count)
            data = reads.values.pack(*[read() for read in reads.read])
            return list(reads.words.unpack_from(data, reads.skipped))

    def write_registers(self, address: int, values: list[int]) -> None:
        """Write registers from `address` on, in whole values.

        Raises `RegisterError` if one of them does not exist or cannot be written, or if a value is not allowed; the
        values before it have been written then.
        """
        count = len(values)
        with self._request():
            writes = self._known_writes.get((address, count)) or self._writes(address, count)
            decoded = writes.values.unpack_from(writes.words.pack(*values))
            for register, value in zip(writes.registers, decoded, strict=True):
                self._take(register, value)
            if writes.refusal is not None:
                raise writes.refusal

    def prepare(self, frames: Sequence[Frame], heads: Sequence[int]) -> Packet | None:
        """Return what carries such a packet out, as one request; see `wire.modbus.PacketBank`."""
        sent, answered = ">", ">"
        parts: list[FrameParts] = []
        for frame, head in zip(frames, heads, strict=True):
            try:
                if frame.writes:
                    writes = self._writes(frame.address, frame.number)
                    if writes.refusal is not None:
                        return None
                    sent += f"{head}x{writes.values.format[1:]}"
                    parts.append(((), writes.registers))
                else:
                    reads = self._reads(frame.address, frame.number)
                    if reads.values.size != reads.words.size:
                        return None
                    sent += f"{head}x"
                    answered += reads.values.format[1:]
                    parts.append((reads.read, ()))
            except RegisterError:
                return None
        return self._as_request(self._carrying_out(parts, struct.Struct(sent).unpack, struct.Struct(answered).pack))

    def _as_request(self, act: Packet) -> Packet:
        """Return what serves a packet as one request; as `_request` does, but with fewer calls."""
        begin, end = self._begin, self._end

        def serve(packet: bytes) -> bytes:
            begin()
            try:
                answer = act(packet)
            except BaseException as error:
                end(error)
                raise
            end(None)
            return answer

        return serve

    def _carrying_out(
        self,
        parts: Sequence[FrameParts],
        unpack: Callable[[bytes], tuple[float, ...]],
        pack: Callable[..., bytes],
    ) -> Packet:
        """Return what carries frames out: what each reads, and the registers that it writes."""
        if len(parts) == 1 and not parts[0][1]:
            # What a fast loop sends most.
            return lambda _: pack(*[read() for read in parts[0][0]])
        lead, writes = self._lead, any(registers for _, registers in parts)

        def carry_out(packet: bytes) -> bytes:
            given = iter(unpack(packet) if writes else ())
            values: list[float] = []
            for readers, registers in parts:
                for read in readers:
                    values.append(read())
                for register in registers:
                    self._take(register, next(given))
                if self._touched:
                    lead()
            return pack(*values)

        return carry_out

    @staticmethod
    def _take(register: Register, value: float) -> None:
        if not math.isfinite(value):
            raise RegisterError(ILLEGAL_VALUE, f"{register.name}: allowed are finite numbers, got {value}")
        assert register.write is not None
        register.write(value)

    def _lead(self) -> None:
        """Let what depends on the outputs follow; most have none."""
        self._touched = False

    def _reads(self, address: int, count: int) -> _Reads:
        registers = list(dict.fromkeys(self._at(each) for each in range(address, address + count)))
        read = []
        for register in registers:
            if register.read is None:
                raise RegisterError(ILLEGAL_ADDRESS, f"{register.name} can only be written")
            read.append(register.read if register.kind == "F32" else partial(_integer, register.read))
        self._known_reads[address, count] = reads = _Reads(
            tuple(read), _joint(registers), struct.Struct(f">{count}H"), 2 * (address - registers[0].address)
        )
        return reads

    def _writes(self, address: int, count: int) -> _Writes:
        registers: list[Register] = []
        refusal = None
        position = address
        try:
            while position < address + count:
                register = self._at(position)
                self._check_write(
                    register, register.address == position and position + register.words <= address + count
                )
                registers.append(register)
                position += register.words
        except RegisterError as error:
            refusal = error
        writes = _Writes(tuple(registers), _joint(registers), struct.Struct(f">{count}H"), refusal)
        self._known_writes[address, count] = writes
        return writes

    def _check_write(self, register: Register, whole: bool) -> None:
        if not whole:
            raise RegisterError(ILLEGAL_VALUE, f"{register.name} must be written as a whole")
        if register.write is None:
            raise RegisterError(ILLEGAL_ADDRESS, f"{register.name} can only be read")

    def read_value(self, register: int | str) -> float:
        """Return the value of a register, by address or by name, as one request would."""
        row = self._row(register)
        return float(row.decode(self.read_registers(row.address, row.words)))

    def write_value(self, register: int | str, value: float) -> None:
        """Write the value of a register, by address or by name, as one request would."""
        row = self._row(register)
        self.write_registers(row.address, list(row.encode(value)))

    def _row(self, register: int | str) -> Register:
        return self._named[register] if isinstance(register, str) else self._at(register)

    def _at(self, address: int) -> Register:
        try:
            return self._words[address]
        except KeyError:
            raise RegisterError(ILLEGAL_ADDRESS, f"register {address} (0x{address:04X}) is not emulated") from None
