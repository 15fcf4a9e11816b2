"""The `emulated://NAME` address: a serial port or a TCP connection to an emulated instrument in this process.

pyserial finds this module by its name once `install` has been called, so that every client that opens its line with
`serial.serial_for_url` (our drivers, pymodbus, python-can) reaches the emulator unchanged. There are no threads and
no sleeps: a write is answered before it returns, a read that would wait advances the clock by its timeout, or until
the instrument next sends something by itself. On a serial line each byte takes the time of its baud rate on the
clock; a connection of an instrument on TCP (`sim_devices.wire.modbus_tcp`) takes none.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import serial
from serial.serialutil import PortNotOpenError, SerialBase, SerialException

from bench.base import Clock
from bench.rig import ECHO, EMULATED, JOIN
from sim_devices.wire import Connection, Stream, TcpServer, WireServer
from sim_devices.wire.modbus_tcp import FramingError
from sim_devices.wire.shared import joined

_BITS_PER_BYTE = 10  # 8N1: a start and a stop bit


@dataclass(eq=False)
class _Socket:
    """The place of an instrument at its address."""

    server: WireServer | TcpServer
    clock: Clock
    taken: bool = True


_sockets: dict[str, _Socket] = {}


def install() -> None:
    """Register the scheme with pyserial; calling it again changes nothing."""
    package = __name__.rpartition(".")[0]
    if package not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(package)


def register(name: str, server: WireServer | TcpServer, clock: Clock) -> str:
    """Put an emulated instrument at an address of its own in this process, and return the address.

    It is `emulated://NAME`, or `emulated://NAME-2` and so on while other instruments of that name are there.
    """
    install()
    number, free = 1, name
    while free in _sockets:
        number += 1
        free = f"{name}-{number}"
    _sockets[free] = _Socket(server, clock)
    return f"{EMULATED}{free}"


def unregister(address: str) -> None:
    """Take an instrument off its address; ports that are open to it go dead, as if it were unplugged."""
    name = address.removeprefix(EMULATED)
    # With it go the lines that it shares with others.
    for each in [each for each in _sockets if each == name or name in each.split(JOIN)]:
        _sockets.pop(each).taken = False


def _join(name: str) -> None:
    """Put instruments that have addresses of their own on one line, at an address as `emulated://a+b`."""
    try:
        server = joined(name, {each: socket.server for each, socket in _sockets.items()})
    except ValueError as error:
        raise SerialException(str(error)) from None
    _sockets[name] = _Socket(server, next(_sockets[each].clock for each in name.split(JOIN) if each != ECHO))


def serial_class_for_url(url: str) -> tuple[str, type[Serial]]:
    """Return the address and the port class, as pyserial asks its handlers."""
    return url, Serial


class Serial(SerialBase):  # type: ignore[misc]  # pyserial ships no types
    """A pyserial port that is wired to an emulated instrument."""

    is_open: bool

    def open(self) -> None:
        """Connect to the instrument.

        Raises `serial.SerialException` if the port is open already, no emulated instrument has this name, or an
        instrument on TCP refuses one more connection.
        """
        if self.is_open:
            raise SerialException("Port is already open.")
        self._name = str(self.portstr).removeprefix(EMULATED)
        if JOIN in self._name and self._name not in _sockets:
            _join(self._name)
        if self._name not in _sockets:
            known = ", ".join(EMULATED + other for other in sorted(_sockets)) or "none"
            raise SerialException(f"no emulated instrument at {EMULATED}{self._name}; there are: {known}")
        self._received = bytearray()
        self._plug_in()
        self.is_open = True

    def _plug_in(self) -> None:
        socket = _sockets[self._name]
        stream: Stream
        self._connection: Connection | None = None
        if isinstance(socket.server, TcpServer):
            try:
                stream = self._connection = socket.server.connect()
            except ConnectionRefusedError as refusal:
                raise SerialException(f"{EMULATED}{self._name}: {refusal}") from None
        else:
            stream = socket.server
        self._socket, self._stream = socket, stream
        self._clock = socket.clock

    def close(self) -> None:
        """Disconnect."""
        if self.is_open and self._connection is not None:
            self._connection.close()
        self.is_open = False

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read at once."""
        if not self.is_open or not self._socket.taken:
            self._check()
        self._hear()
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        """Return up to `size` bytes; fewer only after the timeout has passed on the clock.

        Raises `serial.SerialException` if bytes are missing, there is no timeout, and the instrument will send
        nothing by itself: a real port would wait for ever.
        """
        if not self.is_open or not self._socket.taken:
            self._check()
        received = self._received
        if self._connection is None:
            self._hear()
        if len(received) < size:
            self._wait_for(size)
        data = bytes(received[:size])
        del received[:size]
        return data

    def read_all(self) -> bytes:
        """Return what was received; nothing is waited for."""
        if not self.is_open or not self._socket.taken:
            self._check()
        self._hear()
        received = self._received
        if not received:
            return b""
        data = bytes(received)
        received.clear()
        return data

    def _wait_for(self, size: int) -> None:
        """Let time pass until so many bytes are there, at most the timeout."""
        self._hear()
        if self._timeout != 0:
            self._wait_until(size, self._end_of_timeout())

    def _end_of_timeout(self) -> float:
        return math.inf if self._timeout is None else self._clock.now() + self._timeout

    def _wait_until(self, size: int, end: float) -> None:
        """Let time pass until so many bytes are there, at most until `end` (s)."""
        while len(self._received) < size:
            due = self._stream.next_unsolicited()
            # What is overdue and has not come does not come.
            instant = min(end, due) if due > self._clock.now() else end
            if instant == math.inf:
                raise SerialException(f"{EMULATED}{self._name}: would wait for ever, as nothing can arrive unasked")
            self._clock.sleep_until(instant)
            self._hear()
            if instant == end or self._clock.now() < instant:
                return

    def _hear(self) -> None:
        try:
            heard = self._stream.unsolicited()
            if heard:
                self._received += heard
        except (FramingError, ConnectionError) as error:
            raise self._ended(error) from None

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        """Return what was received up to `expected`, or `size` bytes; what there is after the timeout on the clock.

        pyserial's own reads byte by byte and watches the wall clock, by which nothing emulated may fail.
        """
        self._check()
        self._hear()
        received = self._received
        most = sys.maxsize if size is None else size
        begin = received.find(expected)
        if begin < 0 and self._timeout != 0:
            until, before = self._end_of_timeout(), -1
            while begin < 0 and before < len(received) < most:
                before = len(received)
                self._wait_until(before + 1, until)
                begin = received.find(expected)
        count = min(len(received) if begin < 0 else begin + len(expected), most)
        data = bytes(received[:count])
        del received[:count]
        return data

    def write(self, data: bytes, /) -> int:
        """Send bytes; the answer is ready for `read` when this returns.

        Raises `serial.SerialException` if an instrument on TCP ends the connection over them.
        """
        if not self.is_open or not self._socket.taken:
            self._check()
        sent = bytes(data)
        if self._connection is not None:
            try:
                self._received += self._stream.receive(sent)
            except (FramingError, ConnectionError) as error:
                raise self._ended(error) from None
            return len(sent)
        answer = self._answer(sent)
        if answer:
            self._received += answer
        return len(sent)

    def _answer(self, sent: bytes) -> bytes:
        """Let the bytes pass on a serial line; return the answer, for which the time has passed as well."""
        clock, stream = self._clock, self._stream
        clock.sleep(len(sent) * _BITS_PER_BYTE / self._baudrate)
        heard = stream.unsolicited()
        if heard:
            self._received += heard
        answer = stream.receive(sent)
        if answer:
            clock.sleep(len(answer) * _BITS_PER_BYTE / self._baudrate)
        return answer

    def _ended(self, error: Exception) -> SerialException:
        return SerialException(f"{EMULATED}{self._name} ended the connection: {error}")

    def flush(self) -> None:
        """Do nothing: what was written has arrived."""
        self._check()

    def reset_input_buffer(self) -> None:
        """Forget what was received and not read."""
        if not self.is_open or not self._socket.taken:
            self._check()
        self._hear()
        self._received.clear()

    def reset_output_buffer(self) -> None:
        """Do nothing: what was written has arrived."""
        self._check()

    def _check(self) -> None:
        if not self.is_open:
            raise PortNotOpenError
        if self._socket.taken:
            return
        if self._name not in _sockets or self._connection is not None:
            raise SerialException(f"{EMULATED}{self._name} was unplugged")
        # A serial line that is plugged in again goes on; a connection does not.
        self._plug_in()

    # Line settings and modem lines: accepted, and without meaning here.
    def _reconfigure_port(self, force_update: bool = False) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass

    def _update_break_state(self) -> None:
        pass
