"""Instruments on a serial line with Modbus RTU: their settings, their line, and the numbers in their registers.

Source: MODBUS over Serial Line, Specification and Implementation Guide V1.02, 2.5.1.1, for the pause between frames.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar, overload

from pydantic import Field

from bench.base import Clock, DeferredModule, DeviceConnectionError, DeviceError
from bench.rig import EMULATED
from drivers.device import other_answer, refuse_hiding
from drivers.modbus import (
    READ,
    NoReplyError,
    RefusedError,
    RtuClient,
    UnexpectedReplyError,
    exception_text,
)
from drivers.serial_line import RESENDS, RepeatingLine, SerialSettings, claim, lost_line, no_answer, open_port

if TYPE_CHECKING:
    from drivers import pymodbus_client
else:
    pymodbus_client = DeferredModule("drivers.pymodbus_client")

T = TypeVar("T")
NumberT = TypeVar("NumberT", int, float)

Kind = Literal["U16", "I16", "U32", "I32", "F32"]
"""What is in one register or two: an integer without or with a sign, or a floating-point number."""

_CODES = {"U16": "H", "I16": "h", "U32": "I", "I32": "i", "F32": "f"}
_FORMS = {kind: struct.Struct(f">{code}") for kind, code in _CODES.items()}
_WORD = 2  # bytes
_READING, _WRITING = "reading register 0x{:04X}", "writing register 0x{:04X}"
_ECHO_REGISTERS = (6, 8)  # numbers that no other request reads
_LATEST = 3.0  # time-outs after a request by which even a reply that others overtook has come
_QUIET = 0.25  # time-outs of silence after which a damaged reply is over
_FAST_LINE = 19200  # Bd above which the pause between frames does not get shorter
_FAST_PAUSE = 1.75e-3  # s


class RtuSettings(SerialSettings):
    """Where an instrument is that speaks Modbus RTU; the settings of its driver extend it."""

    address_key: ClassVar[str] = "address"

    address: int = Field(default=1, ge=1, le=247, description="Modbus address, 1 to 247")
    baudrate: int = Field(default=9600, ge=300, le=4000000, description="speed of the line, Bd")
    parity: Literal["N", "E", "O"] = Field(default="N", description="parity: N for none, E for even, O for odd")
    timeout: float = Field(
        default=0.2,
        ge=0.02,
        le=10.0,
        description="wait for a reply, s: 0.02 to 10; a request is sent three times at most",
    )
    pause: float | None = Field(
        default=None,
        ge=0.0,
        le=1.0,
        description="silence before a request, s: 0 to 1; unless given, 3.5 characters, or 1.75 ms above 19200 Bd",
    )

    @property
    def longest_turn(self) -> float:
        """Longest time that a request and its repetitions keep the line while nothing answers, s."""
        return super().longest_turn + RESENDS * _QUIET * self.timeout


def pack_number(kind: Kind, value: float) -> bytes:
    """Return a number as it stands in registers, high word first; an integer is rounded.

    Raises
    ------
    ValueError
        If it does not fit.
    """
    try:
        return _FORMS[kind].pack(value if kind == "F32" else round(value))
    except (struct.error, OverflowError, ValueError):
        raise ValueError(f"{value:g} does not fit into a register {kind}") from None


def unpack_number(kind: Kind, data: bytes) -> float:
    """Return the number in registers; the inverse of `pack_number`."""
    number: float = _FORMS[kind].unpack(data)[0]
    return number


class RtuLine(RepeatingLine):
    """The serial line to one Modbus instrument: its registers, and sending again.

    Modbus RTU does not say which request a reply belongs to. After a reply that is missing or damaged the line asks
    for as many registers as for no other request, until a reply of that length comes: what the instrument sent before
    has passed then. Where the instrument reads its registers by functions 3 and 4 alike, they are taken in turn, so
    that a doubled or late reply to the request before shows by its function.

    Attributes
    ----------
    lost : bool
        Whether the line itself failed, so that it has to be opened again.
    longest_silence : float
        Longest time between two replies since the attribute was last set to zero, s.
    reading : tuple of int
        Functions that read, taken in turn.
    first_of_echo : int
        Address from which registers can be read to find the end of what is late.
    swaps_words : bool
        Whether the low word of a value comes first.
    set_at : str
        Where at the instrument speed, parity and mode are set, for messages.

    Raises
    ------
    DeviceConnectionError
        If the line cannot be opened.
    """

    reading: tuple[int, ...] = (READ,)
    first_of_echo = 0
    swaps_words = False
    set_at = ""

    def __init__(self, name: str, settings: RtuSettings, clock: Clock) -> None:
        self._name = name
        self._settings = settings
        self._clock = clock
        self._pause = _frame_pause(settings)
        self._silent_since = self._answered_at = self._late_until = clock.now()
        self._reads = 0
        self._in_step = True
        self._echoes = 0
        self._is_open = True
        self.lost = False
        self.longest_silence = 0.0
        self.port = open_port(name, settings, parity=settings.parity)
        self._client: RtuClient | pymodbus_client.SerialClient
        if settings.port.startswith(EMULATED):
            self._client = RtuClient(self.port, settings.address)
        else:
            self._client = pymodbus_client.SerialClient(self.port, settings, settings.address, settings.parity)

    def close(self) -> None:
        """Release the line."""
        self._is_open = False
        self._client.close()

    def read(self, address: int, count: int) -> list[int]:
        """Get `count` registers from `address` on, each 0 to 65535."""
        return list(struct.unpack(f">{count}H", self.read_bytes(address, count)))

    def read_bytes(self, address: int, count: int) -> bytes:
        """Get the values of `count` registers from `address` on, two bytes each."""
        self._reads += 1
        function = self.reading[self._reads % len(self.reading)]
        return self._exchange(_READING, address, lambda: self._client.read(address, count, function))

    def read_number(self, address: int, kind: Kind) -> float:
        """Get a number; an `int` unless it is `F32`."""
        return unpack_number(kind, self._ordered(self.read_bytes(address, _FORMS[kind].size // _WORD)))

    def write_number(self, title: str, address: int, kind: Kind, value: float) -> None:
        """Set a number and read it back; `title` is its name for messages."""
        data = pack_number(kind, value)
        if len(data) == _WORD:
            self.write_one(_WRITING, address, address, int.from_bytes(data))
        else:
            self._exchange(_WRITING, address, lambda: self._client.write(address, self._ordered(data)))
        actual = self.read_number(address, kind)
        if actual != unpack_number(kind, data):
            raise DeviceError(
                self._name,
                f"{title} reads back {actual:g} after {value:g} was written; "
                "is another program using the instrument?",
            )

    def write_one(self, doing: str, number: int, address: int, value: int) -> None:
        """Set one register, which is not read back; `doing`, a format of `number`, is for messages."""
        self._exchange(doing, number, lambda: self._client.write_one(address, value))

    def tell(self, address: int, value: int) -> None:
        """Set one register at once, also on a line that is out of step; whether it was is not looked at."""
        self._in_step = False
        if self._is_open and not self.lost:
            with suppress(OSError, RefusedError):
                self._keep_pause()
                self._client.write_one(address, value)

    def _ordered(self, data: bytes) -> bytes:
        """Return the bytes of a value as they are sent, from those with the high word first; and the other way."""
        return data[_WORD:] + data[:_WORD] if self.swaps_words else data

    def _exchange(self, doing: str, number: int, request: Callable[[], T]) -> T:
        if not self._is_open:
            raise DeviceConnectionError(
                self._name, f"the line {self._settings.port} is closed; connect again, so that the set-up is checked"
            )
        if self.lost:
            raise DeviceConnectionError(self._name, f"the line {self._settings.port} was lost; open it again")
        problem: NoReplyError | None = None
        resends, self.resends = self.resends, RESENDS
        try:
            for attempt in range(1 + resends):
                self.repeats += attempt > 0
                try:
                    if not self._in_step:
                        self._catch_up()
                    return self._once(request)
                except NoReplyError as error:
                    problem = problem or error
                    self._in_step = False
        except RefusedError as error:
            raise RefusalError(self._name, exception_text(error.code, doing.format(number))) from error
        except OSError as error:
            self.lost = True
            raise lost_line(self._name, self._settings.port, error, ", then connect again") from error
        self.resends = 0
        if isinstance(problem, UnexpectedReplyError):
            raise DeviceConnectionError(
                self._name, f"{problem}; check that no other master is on the line"
            ) from problem
        settings = self._settings
        raise no_answer(
            self._name,
            settings,
            f"no good reply within {settings.timeout:g} s",
            "address",
            settings.address,
            other_answer(problem.heard) if problem else "",
            resends=resends,
            speed=f"{settings.baudrate} Bd, parity {settings.parity}, mode RTU{self.set_at}",
        ) from problem

    def _once(self, request: Callable[[], T]) -> T:
        self._keep_pause()
        sent_at = self._clock.now()
        try:
            reply = request()
        except RefusedError:
            self._note_answer()
            raise
        except NoReplyError:
            self._silent_since = self._clock.now()
            self._late_until = sent_at + _LATEST * self._settings.timeout
            raise
        self._note_answer()
        return reply

    def _keep_pause(self) -> None:
        """Wait until the line has been silent for long enough, also since the turn of a neighbour."""
        if self._pause:
            if claim(self.port):
                self._silent_since = self._clock.now()
            self._clock.sleep_until(self._silent_since + self._pause)

    def _note_answer(self) -> None:
        now = self._clock.now()
        self.longest_silence = max(self.longest_silence, now - self._answered_at)
        self._silent_since = self._answered_at = now

    def _catch_up(self) -> None:
        """Let late replies pass: what comes before the reply to a request like no other is old."""
        settings = self._settings
        self._client.settle(_QUIET * settings.timeout)
        late_until = self._late_until
        self._echoes += 1
        count = _ECHO_REGISTERS[self._echoes % len(_ECHO_REGISTERS)]
        function = self.reading[(1 + self._echoes // len(_ECHO_REGISTERS)) % len(self.reading)]
        with suppress(RefusedError):
            self._once(lambda: self._client.read(self.first_of_echo, count, function))
        # No line turns replies round, but what is between two may.
        if (left := late_until - self._clock.now()) > 0.0:
            self._client.settle(left)
        self._in_step = True


class RefusalError(DeviceError):
    """The instrument answered with a Modbus exception."""


class Register(Generic[NumberT]):
    """A number in the registers of a device with an `RtuLine`, as an attribute: reading it asks the instrument.

    Assigning sets it, and raises `DeviceError` if it is not read back as it was written.

    Parameters
    ----------
    address : int
        Address of its first register.
    kind : type
        `int` or `float`, as which it is read.
    form : Kind
        How it stands in the registers.
    description : str
        What it is, in a few words.
    """

    def __init__(self, address: int, kind: type[NumberT], form: Kind, description: str) -> None:
        self._kind: Callable[[float], NumberT] = kind
        self._address, self._form, self._description = address, form, description
        self.__doc__ = f"{description[:1].upper()}{description[1:]}."

    def __set_name__(self, owner: type, name: str) -> None:
        refuse_hiding(owner, name, Register)

    @overload
    def __get__(self, device: None, owner: object = None) -> Self: ...

    @overload
    def __get__(self, device: object, owner: object = None) -> NumberT: ...

    def __get__(self, device: Any, owner: object = None) -> NumberT | Self:
        return self if device is None else self._kind(device._line.read_number(self._address, self._form))

    def __set__(self, device: Any, value: NumberT) -> None:  # noqa: ANN401 - any device with such a line
        device._line.write_number(self._description, self._address, self._form, value)


def _frame_pause(settings: RtuSettings) -> float:
    """Return the silence between frames in s; by default the 3.5 characters of Modbus, 1.75 ms above 19200 Bd."""
    if settings.pause is not None:
        return settings.pause
    if settings.baudrate > _FAST_LINE:
        return _FAST_PAUSE
    bits = 10 if settings.parity == "N" else 11
    return 3.5 * bits / settings.baudrate
