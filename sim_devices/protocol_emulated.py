"""The `emulated://NAME` address: a serial port whose other end is an emulated instrument in this process.

pyserial finds this module by its name once `install` has been called, so that every client that opens its line with
`serial.serial_for_url` (our drivers, pymodbus, python-can) reaches the emulator unchanged. There are no threads and
no sleeps: a write is answered before it returns, a read that would wait advances the clock by its timeout, and each
byte takes the time of its baud rate on the clock.
"""

from __future__ import annotations

import serial
from serial.serialutil import PortNotOpenError, SerialBase, SerialException

from bench.clock import Clock
from sim_devices.wire import WireServer

_SCHEME = "emulated://"
_BITS_PER_BYTE = 10  # 8N1: a start and a stop bit
_servers: dict[str, tuple[WireServer, Clock]] = {}


def install() -> None:
    """Register the scheme with pyserial; calling it again changes nothing."""
    package = __name__.rpartition(".")[0]
    if package not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(package)


def register(name: str, server: WireServer, clock: Clock) -> str:
    """Put an emulated instrument at `emulated://NAME` and return that address.

    Raises `ValueError` if the name is taken.
    """
    if name in _servers:
        raise ValueError(f"name: {_SCHEME}{name} is taken by another emulated instrument of this process")
    install()
    _servers[name] = (server, clock)
    return f"{_SCHEME}{name}"


def unregister(name: str) -> None:
    """Take an instrument off its address; ports that are open to it go dead, as if it were unplugged."""
    _servers.pop(name, None)


def serial_class_for_url(url: str) -> tuple[str, type[Serial]]:
    """Return the address and the port class, as pyserial asks its handlers."""
    return url, Serial


class Serial(SerialBase):  # type: ignore[misc]  # pyserial ships no types
    """A pyserial port that is wired to an emulated instrument."""

    is_open: bool

    def open(self) -> None:
        """Connect to the instrument.

        Raises `serial.SerialException` if the port is open already, or no emulated instrument has this name.
        """
        if self.is_open:
            raise SerialException("Port is already open.")
        name = str(self.portstr).removeprefix(_SCHEME)
        if name not in _servers:
            known = ", ".join(_SCHEME + other for other in sorted(_servers)) or "none"
            raise SerialException(f"no emulated instrument at {_SCHEME}{name}; there are: {known}")
        self._name = name
        self._received = bytearray()
        self.is_open = True

    def close(self) -> None:
        """Disconnect."""
        self.is_open = False

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read at once."""
        self._clock_of_open_port()
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        """Return up to `size` bytes; fewer only after the timeout has passed on the clock.

        Raises `serial.SerialException` if bytes are missing and there is no timeout: a real port would wait for ever.
        """
        clock = self._clock_of_open_port()
        if len(self._received) < size and self._timeout is None:
            raise SerialException(f"{_SCHEME}{self._name}: would wait for ever, as nothing can arrive unasked")
        if len(self._received) < size and self._timeout:
            # Nothing can arrive unasked, so all that waiting brings is that the time is gone.
            clock.sleep(self._timeout)
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        """Return what was received up to `expected`, or `size` bytes; what there is after the timeout on the clock.

        pyserial's own reads byte by byte and watches the wall clock, by which nothing emulated may fail.
        """
        self._clock_of_open_port()
        end = self._received.find(expected)
        found = len(self._received) + 1 if end < 0 else end + len(expected)
        return self.read(found if size is None else min(found, size))

    def write(self, data: bytes, /) -> int:
        """Send bytes; the answer is ready for `read` when this returns."""
        clock = self._clock_of_open_port()
        sent = bytes(data)
        clock.sleep(len(sent) * _BITS_PER_BYTE / self._baudrate)
        answer = _servers[self._name][0].receive(sent)
        clock.sleep(len(answer) * _BITS_PER_BYTE / self._baudrate)
        self._received += answer
        return len(sent)

    def flush(self) -> None:
        """Do nothing: what was written has arrived."""
        self._clock_of_open_port()

    def reset_input_buffer(self) -> None:
        """Forget what was received and not read."""
        self._clock_of_open_port()
        self._received.clear()

    def reset_output_buffer(self) -> None:
        """Do nothing: what was written has arrived."""
        self._clock_of_open_port()

    def _clock_of_open_port(self) -> Clock:
        if not self.is_open:
            raise PortNotOpenError
        if self._name not in _servers:
            raise SerialException(f"{_SCHEME}{self._name} was unplugged")
        return _servers[self._name][1]

    # Line settings and modem lines: accepted, and without meaning here.
    def _reconfigure_port(self, force_update: bool = False) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass

    def _update_break_state(self) -> None:
        pass
