"""The registers of a LabJack T7, and a client that reads and writes them over Modbus TCP.

Sources: `ljm_constants.json` (repository labjack/ljm_constants) for the register map; LabJack, Direct Modbus TCP,
Protocol Details, for the byte order and for function 76; the error table of the same repository for the details of
refusals; LabJack, Letter of Volatility of the T7, for USER_RAM, which each restart clears.

Assumptions: the instrument reads back the settings that were written. WAIT_US_BLOCKING, which programs use beside
TDAC# but the versions of the map at hand do not have, is a UINT32 at 61590 and takes up to 100 000 µs.
"""

from __future__ import annotations

import math
import secrets
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.base import Clock, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import Identity
from drivers.modbus import (
    FEEDBACK,
    ModbusClient,
    RefusedError,
    exception_text,
    read_frame,
    read_request,
    swapped,
    write_frame,
    write_request,
)
from drivers.modbus_tcp import Connection, share

Kind = Literal["F32", "U32", "U16"]
Access = Literal["R", "W", "RW"]
Floats = NDArray[np.float64]

Answer = TypeVar("Answer")

_FORMS = {"F32": "f", "U32": "I", "U16": "H"}


class Register(NamedTuple):
    """A register, or the first of several alike."""

    name: str
    """Name in the map, with # for the number of a channel."""
    address: int
    """Modbus address."""
    kind: Kind
    """Type of its value."""
    access: Access
    """Whether it can be read, written, or both."""

    @property
    def form(self) -> str:
        """Letter of its type in `struct`."""
        return _FORMS[self.kind]

    def of(self, channel: int) -> Register:
        """Return the register of a channel."""
        words = struct.calcsize(f">{self.form}") // 2
        return self._replace(name=self.name.replace("#", str(channel)), address=self.address + words * channel)


class Span(NamedTuple):
    """Neighbouring registers of one type, to be read at once again and again."""

    name: str
    """What reading them is called in messages."""
    request: bytes
    """Asks for them."""
    size: int
    """Bytes of the reply."""
    reply: struct.Struct
    """Form of the reply: its function, the number of bytes of the values (both skipped), and the values."""
    frame: bytes
    """Asks for them in function 76, among others."""
    values: struct.Struct
    """Form of the values alone."""

    @classmethod
    def of(cls, register: Register, count: int = 1) -> Span:
        """Return the span of `count` registers from one on.

        Raises `ValueError` if they can only be written.
        """
        if "R" not in register.access:
            raise ValueError(f"{register.name} can only be written")
        values = struct.Struct(f">{count}{register.form}")
        words = values.size // 2
        return cls(
            name=f"reading register {register.address}",
            request=read_request(register.address, words),
            size=2 + values.size,
            reply=struct.Struct(f">xx{count}{register.form}"),
            frame=read_frame(register.address, words),
            values=values,
        )

    def ask(self, client: ModbusClient) -> tuple[float, ...]:
        """Return the values, as a client gets them by a request of their own.

        Raises what the request does, and `OSError` if the answer announces another number of bytes than it has.
        """
        reply = client.request(self.request, self.size)
        if reply[1] != self.size - 2:
            raise OSError(f"the answer announces {reply[1]} bytes where {self.size - 2} were asked for")
        return self.reply.unpack(reply)


class Packet(NamedTuple):
    """One request of function 76, to be sent again and again: it writes, then reads spans and the owner number."""

    name: str
    """What it is called in messages."""
    request: bytes
    """Asks for it."""
    size: int
    """Bytes of the reply."""
    reply: struct.Struct
    """Form of the reply: its function, the values of all spans, and the owner number."""

    @classmethod
    def of(cls, spans: Sequence[Span], *writes: tuple[int, bytes]) -> Packet:
        """Return the packet of spans; what is to be written at addresses goes first in it."""
        read = (*spans, _OWNER_SPAN)
        reply = struct.Struct(">x" + "".join(span.values.format[1:] for span in read))
        frames = (*(write_frame(*write) for write in writes), *(span.frame for span in read))
        return cls(
            name=", ".join(
                (*(f"writing register {address}" for address, _ in writes), *(span.name for span in spans))
            ),
            request=bytes((FEEDBACK,)) + b"".join(frames),
            size=reply.size,
            reply=reply,
        )

    def ask(self, client: ModbusClient) -> tuple[float, ...]:
        """Return the values of all spans and the owner number; raises what the request does."""
        return self.reply.unpack(client.request(self.request, self.size))


class Target(NamedTuple):
    """A register to be set again and again."""

    name: str
    """What setting it is called in messages."""
    head: bytes
    """What stands before its value in the request."""
    echo: bytes
    """The reply."""
    encode: Callable[[float], bytes]
    """Returns a value as it is sent."""

    @classmethod
    def of(cls, register: Register) -> Target:
        """Return the target of a register.

        Raises `ValueError` if it can only be read.
        """
        if "W" not in register.access:
            raise ValueError(f"{register.name} can only be read")
        value = struct.Struct(f">{register.form}")
        head = write_request(register.address, bytes(value.size))[: -value.size]
        return cls(f"writing register {register.address}", head, head[:-1], value.pack)

    def send(self, value: float, client: ModbusClient) -> None:
        """Set the register; raises what the request does, and `OSError` if the answer is none to it."""
        reply = client.request(self.head + self.encode(value), len(self.echo))
        if reply != self.echo:
            raise OSError(f"the answer {reply.hex(' ')} is none to the request {self.head.hex(' ')} …")


AIN = Register("AIN#", 0, "F32", "R")
DAC = Register("DAC#", 1000, "F32", "RW")
DIO = Register("DIO#", 2000, "U16", "RW")
DIO_STATE = Register("DIO_STATE", 2800, "U32", "RW")
DIO_DIRECTION = Register("DIO_DIRECTION", 2850, "U32", "RW")
STREAM_SETTLING_US = Register("STREAM_SETTLING_US", 4008, "F32", "RW")
STREAM_RESOLUTION_INDEX = Register("STREAM_RESOLUTION_INDEX", 4010, "U32", "RW")
AIN_EF_READ_AVERAGE = Register("AIN#_EF_READ_A", 7000, "F32", "R")
AIN_EF_READ_MAXIMUM = Register("AIN#_EF_READ_B", 7300, "F32", "RW")
AIN_EF_READ_MINIMUM = Register("AIN#_EF_READ_C", 7600, "F32", "RW")
AIN_EF_INDEX = Register("AIN#_EF_INDEX", 9000, "U32", "RW")
AIN_EF_SAMPLES = Register("AIN#_EF_CONFIG_A", 9300, "U32", "RW")
AIN_EF_SCAN_RATE = Register("AIN#_EF_CONFIG_D", 10200, "F32", "RW")
TDAC = Register("TDAC#", 30000, "F32", "W")
AIN_RANGE = Register("AIN#_RANGE", 40000, "F32", "RW")
AIN_NEGATIVE_CH = Register("AIN#_NEGATIVE_CH", 41000, "U16", "RW")
AIN_RESOLUTION_INDEX = Register("AIN#_RESOLUTION_INDEX", 41500, "U16", "RW")
AIN_SETTLING_US = Register("AIN#_SETTLING_US", 42000, "F32", "RW")
USER_RAM = Register("USER_RAM#_U32", 46100, "U32", "RW")
LAST_ERR_DETAIL = Register("LAST_ERR_DETAIL", 55000, "U16", "R")
TEST = Register("TEST", 55100, "U32", "R")
TEST_FLOAT32 = Register("TEST_FLOAT32", 55124, "F32", "R")
PRODUCT_ID = Register("PRODUCT_ID", 60000, "F32", "R")
FIRMWARE_VERSION = Register("FIRMWARE_VERSION", 60004, "F32", "R")
SERIAL_NUMBER = Register("SERIAL_NUMBER", 60028, "U32", "R")
WAIT_US_BLOCKING = Register("WAIT_US_BLOCKING", 61590, "U32", "W")
WATCHDOG_ENABLE = Register("WATCHDOG_ENABLE_DEFAULT", 61600, "U32", "RW")
WATCHDOG_TIMEOUT_S = Register("WATCHDOG_TIMEOUT_S_DEFAULT", 61604, "U32", "RW")
WATCHDOG_STRICT_ENABLE = Register("WATCHDOG_STRICT_ENABLE_DEFAULT", 61610, "U32", "RW")
WATCHDOG_DIO_ENABLE = Register("WATCHDOG_DIO_ENABLE_DEFAULT", 61630, "U32", "RW")
WATCHDOG_DIO_STATE = Register("WATCHDOG_DIO_STATE_DEFAULT", 61632, "U32", "RW")
WATCHDOG_DIO_DIRECTION = Register("WATCHDOG_DIO_DIRECTION_DEFAULT", 61634, "U32", "RW")
WATCHDOG_DIO_INHIBIT = Register("WATCHDOG_DIO_INHIBIT_DEFAULT", 61636, "U32", "RW")
WATCHDOG_DAC_ENABLE = (
    Register("WATCHDOG_DAC0_ENABLE_DEFAULT", 61640, "U32", "RW"),
    Register("WATCHDOG_DAC1_ENABLE_DEFAULT", 61650, "U32", "RW"),
)

_FRAME_HEAD = 4  # bytes of a frame of function 76 before its values
_MOST_FRAMES = 1040 - 8  # bytes of all frames of a packet

_OWNER = USER_RAM.of(39)  # the last one, as scripts of the instrument take the first ones
_ASKED = 1 << 31
"""Bit of the owner number by which an owner is asked whether it is still there."""
_ANSWERS = 3.0
"""Time within which an owner answers, s: longer than it may be between two readings, 2 s in a long hold."""
_LOOKS_AGAIN = 0.25  # s
_OWNER_SPAN = Span.of(_OWNER)
_HASTE = 0.5  # s, longest wait for a connection or a reply where time is short

_owners: dict[str, int] = {}
"""The owner number of this process in each instrument, by address."""

_TEST_WORDS = [0x0011, 0x2233]
_TEST_FLOAT = -9999.0
_PRODUCT = 7.0
_PRODUCTS = {4.0: "a LabJack T4", 8.0: "a LabJack T8", 200.0: "a LabJack Digit"}
_DETAILS = {
    2370: "AIN range not available",
    2371: "AIN settling time too long",
    2372: "AIN is set to binary",
    2373: "AIN negative channel not allowed",
    2374: "only zero may be written",
    2375: "AIN resolution index not allowed",
    2376: "AIN rate not possible at this resolution index",
}


class LabJackT7:
    """The connection to a LabJack T7 over Modbus TCP.

    Methods raise `DeviceError` if the instrument refuses, and `DeviceConnectionError` if it does not answer. A
    connection without an answer ends, for all its devices, as a late reply must not be taken for that to the next
    request; the request is repeated once over another, and so is the next one.

    `claim` leaves an owner number in the RAM of the instrument. It is gone after a restart, and another one is there
    when another program has taken the instrument. Each new connection is checked for it before anything is sent,
    and each request of function 76 carries the check along.

    Parameters
    ----------
    port : str
        Address as `tcp://HOST:PORT`.
    timeout : float
        Longest wait for a connection or a reply in s.

    Raises
    ------
    DeviceConnectionError
        If no connection can be made.
    """

    def __init__(self, name: str, port: str, timeout: float) -> None:
        self._name = name
        self._address = port
        self._timeout = timeout
        self._owner = 0
        self._serial_number: int
        self._in_haste = self._unchecked = self._gave_up = False
        self.repeats = 0
        """Number of requests that were repeated over another connection."""
        self._connection = self._share()
        self._client = self._connection.client
        self._lock = self._connection.lock
        self._connected = True

    def _share(self) -> Connection:
        """Return the connection of the process, or a new one if that does not answer."""
        timeout = min(self._timeout, _HASTE) if self._in_haste else self._timeout
        while True:
            try:
                connection = share(self._address, timeout)
            except OSError as error:
                reason = f" ({error})" if str(error) else ""
                raise DeviceConnectionError(
                    self._name,
                    f"cannot connect to {self._address}{reason}; check the address, the cable and "
                    "that the instrument has power",
                ) from None
            is_new = connection.has_one_user
            try:
                with connection.lock:
                    if self._in_haste:
                        connection.client.wait_for(timeout)
                    if self.checks_owner:
                        self._check_instrument(connection.client)
                    elif not is_new:
                        # The instrument may have restarted since the other devices last used it.
                        connection.client.read(TEST.address, 1)
            except RefusedError:
                pass  # another instrument, as `identify` will say
            except OSError as error:
                connection.close()
                connection.end()
                if is_new:
                    raise self._silence(error) from error
                self.repeats += 1
                continue
            except BaseException:
                connection.close()
                raise
            return connection

    def _check_instrument(self, client: ModbusClient) -> None:
        """Raise `DeviceError` if this is another instrument, or it has restarted since `claim`."""
        found = int.from_bytes(client.read(SERIAL_NUMBER.address, 2), "big")
        if found != self._serial_number:
            raise DeviceError(
                self._name,
                f"is another instrument now: the T7 at {self._address} has serial number {found}; it was "
                f"{self._serial_number}",
            )
        self._check_owner(int.from_bytes(client.read(_OWNER.address, 2), "big"), client)

    def claim(self, clock: Clock) -> None:
        """Leave the owner number of this process in the instrument, by which a restart and another program are seen.

        The devices of a process share it. An owner that has left one is asked first whether it is still there, by a
        bit of the number: with its next request it sets the number again. No lock of this computer is needed for
        that, so another computer, too, is kept from an instrument in use.

        Raises DeviceError if another program, on whichever computer, has answered that it uses the instrument.
        """
        with self._lock:
            known = _owners.get(self._address)
            found = self.read_integer(_OWNER)
            if found != known:
                if found:
                    self._ask_owner(found, clock)
                known = _owners[self._address] = 1 + secrets.randbelow(_ASKED - 1)
                self.write(_OWNER, known)
            self._serial_number = self.read_integer(SERIAL_NUMBER)
            assert known is not None
            self._owner = known

    def _ask_owner(self, found: int, clock: Clock) -> None:
        self.write(_OWNER, found | _ASKED)
        end = clock.now() + _ANSWERS
        while clock.now() < end:
            clock.sleep(_LOOKS_AGAIN)
            if not self.read_integer(_OWNER) & _ASKED:
                raise DeviceError(
                    self._name,
                    f"the LabJack T7 at {self._address} is in use by another program, on this or another computer, "
                    "which has just answered; end that program, or wait for it",
                )

    def reopen(self) -> None:
        """Use the connection that other devices have opened, or open one, if the present one has ended.

        Raises
        ------
        DeviceConnectionError
            If no connection can be made, nothing answers, or the device has closed it.
        DeviceRestartedError
            If the instrument has restarted since `claim`.
        DeviceError
            If it is another instrument, or another program has taken it.
        """
        if not self._connected:
            raise self._closed()
        if not self._connection.ended:
            return
        self._connection.close()
        connection = self._share()
        self._connection, self._client, self._lock = connection, connection.client, connection.lock

    def renew(self) -> None:
        """Check the instrument, over another connection if the present one does not answer; raises as `reopen`."""
        try:
            with self._lock:
                if self._owner and not self._connection.ended:
                    self._check_instrument(self._client)
        except RefusedError:
            pass  # another instrument, as `identify` will say
        except OSError:
            self._connection.end()
        self.reopen()

    def _check_owner(self, found: int, client: ModbusClient) -> None:
        if found == self._owner:
            return
        if found == self._owner | _ASKED:
            # One that is lost is asked for again.
            with suppress(OSError, RefusedError):
                client.write(_OWNER.address, self.encode(_OWNER, self._owner))
            return
        if found in (0, _owners.get(self._address)):
            raise DeviceRestartedError(
                self._name,
                "the LabJack T7 has restarted, and its inputs and lines are not set up any more; find out why, then "
                "connect again",
            )
        raise DeviceError(
            self._name,
            f"another program has taken the LabJack T7 at {self._address}; end it, then connect again",
        )

    @contextmanager
    def in_haste(self, *, unchecked: bool = False) -> Iterator[None]:
        """Wait 0.5 s at most for a connection or a reply.

        Parameters
        ----------
        unchecked : bool
            Whether requests go to an instrument that has restarted as well; a connection opened for them ends here.
        """
        before = self._connection
        self._in_haste, self._unchecked = True, unchecked
        try:
            with before.lock:
                before.client.wait_for(min(before.timeout, _HASTE))
            yield
        finally:
            self._in_haste = self._unchecked = self._gave_up = False
            now = self._connection
            if unchecked and now is not before:
                now.end()
            for connection in (before, now):
                if not connection.ended:
                    connection.wait_for_reply(max(self._timeout, connection.timeout))

    def close(self) -> None:
        """Release the connection; it is closed with its last user, who leaves no owner number behind."""
        if self._connected:
            if self._owner and self._connection.has_one_user and not self._connection.ended:
                # The next program need not ask then; on a line that is lost it has to.
                with suppress(OSError, RefusedError), self._lock:
                    self._client.wait_for(min(self._timeout, _HASTE))
                    if int.from_bytes(self._client.read(_OWNER.address, 2), "big") == self._owner:
                        self._client.write(_OWNER.address, self.encode(_OWNER, 0))
            self._connected = False
            self._connection.close()

    @property
    def checks_owner(self) -> bool:
        """Whether every packet asks for the owner number as well."""
        return self._owner != 0 and not self._unchecked

    def read_words(self, address: int, count: int) -> list[int]:
        """Get `count` 16-bit registers from `address` on, each 0 to 65535."""
        return [int(word) for word in self.read(Register(str(address), address, "U16", "R"), count)]

    def read_span(self, span: Span) -> tuple[float, ...]:
        """Get the values of neighbouring registers of one type."""
        return self._carry_out(span.name, span.ask)

    def read_packet(self, packet: Packet) -> tuple[float, ...]:
        """Carry a packet out; return the values of its spans, one behind the other.

        Raises `DeviceRestartedError` or `DeviceError` also if the owner number is not that of `claim` any more.
        """
        *values, owner = self._carry_out(packet.name, packet.ask)
        if owner != self._owner and self.checks_owner:
            self._check_owner(int(owner), self._client)
        return tuple(values)

    def shares_connection(self, other: LabJackT7) -> bool:
        """Return whether another device on the same instrument uses this connection."""
        return self._connection is other._connection

    def play(self, spans: Sequence[Span], register: Register, values: Floats, wait: int) -> Floats:
        """Read spans and set a register again and again, with waits between, in one request of function 76.

        The instrument carries it out by itself, in the order of the frames: reads, then the value, then the wait.
        What conversions and outputs take comes on top of the wait.

        Parameters
        ----------
        spans : sequence of Span
            FLOAT32 registers to be read.
        values : numpy.ndarray
            Values of a FLOAT32 register, one after the other, `most_played(spans)` at most.
        wait : int
            Time between, µs, 0 to 100000; there is none behind the last.

        Returns
        -------
        numpy.ndarray
            What was read, one row for each value.
        """
        self._ensure_open()
        reads = b"".join(span.frame for span in spans)
        size = len(reads)
        pause = write_frame(WAIT_US_BLOCKING.address, self.encode(WAIT_US_BLOCKING, wait))
        sample = reads + write_frame(register.address, self.encode(register, 0.0)) + pause
        packet = np.frombuffer(bytearray(sample * len(values)), np.uint8).reshape(len(values), len(sample))
        at = size + _FRAME_HEAD
        packet[:, at : at + 4] = values.astype(">f4").view(np.uint8).reshape(-1, 4)
        row = sum(span.values.size for span in spans)
        try:
            with self._lock:
                reply = self._client.feedback(packet.tobytes()[: -len(pause)], row * len(values))
        except (RefusedError, OSError) as error:
            # Not again: part of the block may have been played.
            raise self._failure(error, f"playing {len(values)} values on register {register.address}") from error
        return np.frombuffer(reply, ">f4").astype(np.float64).reshape(len(values), -1)

    @staticmethod
    def most_played(spans: Sequence[Span]) -> int:
        """Return how many values `play` takes at once: a packet has 1040 bytes, of which 8 are its head."""
        return _MOST_FRAMES // (sum(len(span.frame) for span in spans) + 2 * (_FRAME_HEAD + 4))

    def read(self, register: Register, count: int = 1) -> list[float]:
        """Get the values of `count` registers of one type from `register` on."""
        return list(self.read_span(Span.of(register, count)))

    def read_integer(self, register: Register) -> int:
        """Get the value of a UINT32 or UINT16 register."""
        return int(self.read(register)[0])

    def write(self, register: Register, *values: float) -> None:
        """Set registers of one type from `register` on, in one request."""
        self.write_span(register.address, self.encode(register, *values))

    @staticmethod
    def encode(register: Register, *values: float) -> bytes:
        """Return values for registers from `register` on, as they are sent.

        Raises `ValueError` if they can only be read.
        """
        if "W" not in register.access:
            raise ValueError(f"{register.name} can only be read")
        return struct.pack(f">{len(values)}{register.form}", *values)

    def write_span(self, address: int, data: bytes) -> None:
        """Set neighbouring registers from an address on."""
        self._carry_out(f"writing register {address}", lambda client: client.write(address, data))

    def send(self, target: Target, value: float) -> None:
        """Set a register."""
        self._carry_out(target.name, partial(target.send, value))

    def set(self, values: Mapping[Register, float]) -> None:
        """Set neighbouring registers of one type and read them back, in one request.

        Raises `DeviceError` if a register reads back another value.
        """
        first = next(iter(values))
        data = self.encode(first, *values.values())
        present = self.read_packet(Packet.of((Span.of(first, len(values)),), (first.address, data)))
        for (register, value), actual in zip(values.items(), present, strict=True):
            tolerance = 1e-5 if register.kind == "F32" else 0.0
            if not math.isclose(actual, value, rel_tol=tolerance, abs_tol=0.1 * tolerance):
                raise DeviceError(
                    self._name,
                    f"{register.name} reads back {actual:g} after {value:g} was written; is another program using "
                    "the instrument?",
                )

    def identify(self) -> Identity:
        """Check the byte order and the product, and get the identity.

        Raises `DeviceConnectionError` if another device answers, or words or bytes arrive in another order than
        LabJack's.
        """
        try:
            words = self.read_words(TEST.address, 2)
        except DeviceConnectionError:
            raise
        except DeviceError as error:
            raise self._wrong(f"is not a LabJack T-series: register TEST gave {error.text}") from error
        if words != _TEST_WORDS:
            raise self._wrong(
                swapped(words, lambda order: list(order) == _TEST_WORDS)
                or f"is not a LabJack T-series: register TEST is 0x{words[0]:04X}{words[1]:04X}, not 0x00112233"
            )
        (value,) = self.read(TEST_FLOAT32)
        if value != _TEST_FLOAT:
            raise self._wrong(f"sends FLOAT32 in another form: TEST_FLOAT32 is {value:g}, not -9999")
        (product,) = self.read(PRODUCT_ID)
        if product != _PRODUCT:
            known = _PRODUCTS.get(product, "another product")
            raise self._wrong(f"is {known}, not a T7: PRODUCT_ID is {product:g}, not 7")
        (firmware,) = self.read(FIRMWARE_VERSION)
        return Identity("LabJack", "T7", str(self.read_integer(SERIAL_NUMBER)), f"{firmware:.4f}")

    def _ensure_open(self) -> None:
        if self._connection.ended or not self._connected:
            self.reopen()

    def _carry_out(self, doing: str, ask: Callable[[ModbusClient], Answer]) -> Answer:
        """Return what a request brings, which is repeated over another connection if nothing answers."""
        self._ensure_open()
        try:
            with self._lock:
                return ask(self._client)
        except (RefusedError, OSError) as error:
            return self._again(error, doing, ask)

    def _again(self, error: RefusedError | OSError, doing: str, ask: Callable[[ModbusClient], Answer]) -> Answer:
        """Return what a request that failed brings over another connection; raise what a refusal means."""
        failure = self._failure(error, doing)
        if isinstance(error, RefusedError) or self._gave_up:
            raise failure from error
        # In haste, two silences are enough.
        self._gave_up = self._in_haste
        try:
            self.reopen()
            self.repeats += 1
            with self._lock:
                return ask(self._client)
        except DeviceConnectionError:
            raise failure from error
        except RefusedError as refusal:
            raise self._refusal(refusal, doing) from refusal
        except OSError:
            self._connection.end()
            raise failure from error

    def _failure(self, error: RefusedError | OSError, doing: str) -> DeviceError:
        """Return the error for a request that failed; without an answer, end the connection."""
        if isinstance(error, RefusedError):
            return self._refusal(error, doing)
        self._connection.end()
        return self._silence(error)

    def _silence(self, error: OSError) -> DeviceConnectionError:
        if isinstance(error, ConnectionError):
            why = ": the connection broke; a T7 takes two at a time: end other users of it, or check the cable"
        else:
            why = f" within {self._timeout:g} s; check cable and power"
        return DeviceConnectionError(self._name, f"no reply from {self._address}{why} ({error})")

    def _refusal(self, refusal: RefusedError, doing: str) -> DeviceError:
        message = exception_text(refusal.code, doing)
        try:
            with self._lock:
                (detail,) = struct.unpack(">H", self._client.read(LAST_ERR_DETAIL.address, 1))
        except RefusedError:
            detail = 0
        except OSError as error:
            return self._failure(error, doing)
        if detail:
            message += f"; LAST_ERR_DETAIL {detail} ({_DETAILS.get(detail, 'see the LabJack error codes')})"
        return DeviceError(self._name, message)

    def _closed(self) -> DeviceConnectionError:
        return DeviceConnectionError(
            self._name,
            f"the connection to {self._address} was closed by its device; connect again",
        )

    def _wrong(self, what: str) -> DeviceConnectionError:
        return DeviceConnectionError(self._name, f"the device at {self._address} {what}")
