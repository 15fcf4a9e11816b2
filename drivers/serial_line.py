"""Serial lines, opened by URL as pyserial does: `/dev/ttyUSB0`, `socket://host:port` or `emulated://NAME`."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import serial
from pydantic import Field

from bench.base import BUSY, DeviceConnectionError, slowness
from bench.devices import DriverSettings
from bench.rig import EMULATED, LONGEST_TURN

RESENDS = 2
"""How often a request that brought no good answer is sent again."""

_SHARE_OF_WATCHDOG = 0.6
"""Share of the time of an instrument's watchdog that a request and its repetitions may take together on a busy
computer; as long as its line may be lost (`bench.execution.station.reconnection`)."""

LONGEST_WITHOUT_WATCHDOG = 1.0
"""Longest wait for an answer on a busy computer, s, of an instrument that has no watchdog."""


class SerialSettings(DriverSettings):
    """Where an instrument on a serial line is; the settings of its driver extend it."""

    keys_of_line: ClassVar[frozenset[str]] = frozenset(
        ("port", "baudrate", "parity", "stop_bits", "flow_control", "echo", "bitrate")
    )

    line: str = Field(default="", description="name of the line that it shares, of a table [lines.NAME]")
    port: str = Field(
        min_length=1, description="line as pyserial opens it: /dev/ttyUSB0, socket://host:port or emulated://NAME"
    )
    baudrate: int = Field(description="speed of the line, Bd")
    timeout: float = Field(
        default=0.1, gt=0.0, le=10.0, description="wait for an answer, s; a request is sent three times at most"
    )
    echo: bool = Field(default=False, description="whether the adapter hands back what is sent, as on two wires")

    @property
    def longest_turn(self) -> float:
        """Longest time that a request and its repetitions keep the line while nothing answers, s."""
        return (1 + RESENDS) * self.timeout


class RepeatingLine:
    """A line to one instrument whose requests are sent again if no good answer comes.

    Attributes
    ----------
    repeats : int
        How many requests were sent again.
    resends : int
        How often a request is sent again at most; 0 after one without an answer, until the next answer.
    """

    repeats = 0
    resends = RESENDS


MOST_STRAY = 4096
"""Bytes that may come unasked before a serial line counts as unusable."""

_LONGEST_PIECE = 256  # bytes that are discarded at once
_HELD = (errno.EAGAIN, errno.EBUSY)
_CURES = {
    errno.ENOENT: "; see that the adapter is plugged in; `bench rig find` shows what is at which port",
    errno.EACCES: "; add yourself to the group of the port (dialout on most systems), and log in again",
}


class PatientPort:
    """A port of pyserial that waits longer for what is missing while the computer is busy.

    The time-out of a line is for an idle computer. When it has passed without an answer, it is measured how much
    longer this process takes for its work at present. The instrument's own side may be no faster (an adapter's
    driver, an emulator), so the wait is as many times as long, up to a bound.

    Parameters
    ----------
    port : serial.SerialBase
        The open port.
    longest : float
        The bound, s; a longer time-out of the port stays as it is.
    measure : callable
        Returns the slowness; see `bench.base.clock.slowness`.

    Attributes
    ----------
    patience : float
        How long the last wait that was in vain, or nearly, was allowed to be, s.
    """

    def __init__(self, port: Any, longest: float, measure: Callable[[], float] = slowness) -> None:  # noqa: ANN401
        self._port = port
        self._longest = longest
        self._measure = measure
        self.patience: float = port.timeout

    @property
    def timeout(self) -> float:
        """Wait for an answer on an idle computer, s."""
        seconds: float = self._port.timeout
        return seconds

    @timeout.setter
    def timeout(self, seconds: float) -> None:
        self._port.timeout = seconds
        self.patience = seconds

    def read(self, size: int = 1) -> bytes:
        """Return so many bytes; fewer only after the wait."""
        return self._whole(self._port.read, size)

    def read_until(self, expected: bytes, size: int) -> bytes:
        """Return what comes up to an end, or so many bytes; another only after the wait."""
        return self._whole(partial(self._port.read_until, expected), size, expected)

    def _whole(self, read: Callable[[int], bytes], size: int, end: bytes | None = None) -> bytes:
        received = read(size)
        if len(received) < size and not (end and received.endswith(end)):
            received += self._waited(read, size - len(received))
        return received

    def _waited(self, read: Callable[[int], bytes], size: int) -> bytes:
        """Return what comes within the time by which a busy computer makes the wait longer."""
        nominal = self._port.timeout
        self.patience = nominal
        if not nominal or nominal >= self._longest or (factor := self._measure()) < BUSY:
            return b""
        self.patience = min(factor * nominal, self._longest)
        self._port.timeout = self.patience - nominal
        try:
            return read(size)
        finally:
            self._port.timeout = nominal

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - all else is the port's
        return getattr(self._port, name)


def patient(port: Any, settings: SerialSettings, measure: Callable[[], float] = slowness) -> Any:  # noqa: ANN401
    """Return a port that waits longer while the computer is busy; an emulated one has the laboratory's time."""
    if settings.port.startswith(EMULATED):
        return port
    return PatientPort(port, longest_wait(settings), measure)


def longest_wait(settings: SerialSettings) -> float:
    """Return how long an answer is waited for on a line at most, however busy the computer is, s."""
    watchdog = getattr(settings, "watchdog", 0.0)
    longest = _SHARE_OF_WATCHDOG * watchdog / (1 + RESENDS) if watchdog else LONGEST_WITHOUT_WATCHDOG
    if settings.line:
        # Its neighbours wait with it.
        longest = min(longest, LONGEST_TURN * settings.timeout / settings.longest_turn)
    return max(longest, settings.timeout)


def patience_of(port: Any, settings: SerialSettings) -> float:  # noqa: ANN401 - pyserial is untyped
    """Return how long an answer is waited for on a line at present, s."""
    return float(getattr(port, "patience", settings.timeout))


class OpenPort:
    """A port that is open, with what the devices on it have in common.

    Parameters
    ----------
    port : object
        The open port, or the adapter on it.
    close : callable
        Closes it.
    address : str, optional
        Address of a port that is shared.

    Attributes
    ----------
    user : Share or None
        Whose request was the last.
    is_lost : bool
        Whether it failed, so that each device has to open it again.
    silent : set of str
        The devices that have waited in vain since anything has come.
    """

    def __init__(self, port: Any, close: Callable[[], object], address: str = "") -> None:  # noqa: ANN401
        self.port = port
        self.devices: set[str] = set()
        self.user: Share | None = None
        self.is_lost = False
        self.silent: set[str] = set()
        self._close = close
        self._address = address

    def give_up(self) -> None:
        """Close it, for all devices."""
        self.is_lost = True
        if _shared.get(self._address) is self:
            del _shared[self._address]
        with suppress(Exception):
            self._close()


_shared: dict[str, OpenPort] = {}
"""The ports of this process that several devices share, by address. One thread asks all devices of a port."""


def shared_port(address: str, device: str, open_it: Callable[[], tuple[Any, Callable[[], object]]]) -> OpenPort:
    """Return the port at an address that devices share; `open_it` opens it, and returns it and what closes it.

    It is opened again if it failed, or if several devices have waited in vain and nothing has come since.

    Raises `DeviceConnectionError` if the device has it open already, as of another rig.
    """
    shared = _shared.get(address)
    if shared is not None and device in shared.devices:
        raise DeviceConnectionError(device, f"cannot open {address}: this program has opened it already")
    if shared is not None and len(shared.silent) > 1:
        # Perhaps it is the adapter that is silent.
        shared.give_up()
    if shared is None or shared.is_lost:
        shared = _shared[address] = OpenPort(*open_it(), address)
    return shared


class Share:
    """What one device has of an open port. When the port fails, all its devices lose their line.

    Attributes
    ----------
    requests : int
        How many messages were sent.
    """

    def __init__(self, shared: OpenPort, device: str) -> None:
        self._shared = shared
        self._device = device
        self._is_open = True
        self.requests = 0
        shared.devices.add(device)

    @property
    def is_open(self) -> bool:
        """Whether it can be used."""
        return self._is_open and not self._shared.is_lost

    def close(self) -> None:
        """Leave the port, which is closed with its last device; may be called again."""
        if self._is_open:
            self._is_open = False
            self._shared.devices.discard(self._device)
            if not self._shared.devices:
                self._shared.give_up()

    def _take_turn(self) -> None:
        self._shared.user = self

    @contextmanager
    def _in_turn(self) -> Iterator[None]:
        """Make it this device's turn; raise `serial.SerialException` if the port was lost, or fails."""
        if not self._is_open:
            raise serial.PortNotOpenError
        if self._shared.is_lost:
            raise serial.SerialException("the port was lost")
        try:
            if self._shared.user is not self:
                self._take_turn()
            yield
        except Exception as error:
            self._shared.give_up()
            if isinstance(error, OSError):
                raise
            # pyserial passes on that of termios.
            raise OSError(str(error)) from error

    def _note(self, received: object) -> None:
        """Note whether what was waited for has come."""
        if received:
            self._shared.silent.clear()
        else:
            self._shared.silent.add(self._device)


class LinePort(Share):
    """A port as one of the devices that share it has it, or the port of an adapter that echoes.

    When it is another device's turn, what the line has received before is forgotten: a late answer to a neighbour.
    The echo of a request is read before its answer. If it is not what was sent, others were sending as well: then
    what comes is discarded, as an answer that is lost, and the request is repeated by whoever has sent it.

    Parameters
    ----------
    shared : OpenPort
        The open port.
    settings : SerialSettings
        Those of the device.
    """

    def __init__(self, shared: OpenPort, device: str, settings: SerialSettings) -> None:
        super().__init__(shared, device)
        self._settings = settings
        self._port = patient(shared.port, settings)
        self._timeout: float = settings.timeout
        self._has_collided = False

    def claim(self) -> bool:
        """Take the port for this device; return whether it was another's turn before."""
        is_another = self._shared.user is not self
        with self._in_turn():
            return is_another

    @property
    def timeout(self) -> float:
        """Wait for an answer on an idle computer, s."""
        return self._timeout

    @timeout.setter
    def timeout(self, seconds: float) -> None:
        self._timeout = seconds
        if self._shared.user is self and self.is_open:
            self._port.timeout = seconds

    @property
    def patience(self) -> float:
        """How long an answer is waited for at present, s."""
        return patience_of(self._port, self._settings)

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read at once."""
        with self._in_turn():
            return int(self._port.in_waiting)

    def write(self, data: bytes) -> int:
        """Send a message, and read its echo."""
        with self._in_turn():
            self.requests += 1
            if self._settings.echo:
                # What is late would be taken for a part of the echo.
                forget_received(self._port)
            count: int = self._port.write(data)
            self._has_collided = self._settings.echo and self._port.read(len(data)) != data
            return count

    def read(self, size: int = 1) -> bytes:
        """Return so many bytes; fewer only after the wait."""
        with self._in_turn():
            return self._awaited(self._port.read(size))

    def read_until(self, expected: bytes, size: int) -> bytes:
        """Return what comes up to an end, or so many bytes; another only after the wait."""
        with self._in_turn():
            return self._awaited(self._port.read_until(expected, size))

    def read_all(self) -> bytes:
        """Return what was received; nothing is waited for."""
        with self._in_turn():
            received: bytes = self._port.read_all()
            return self._awaited(received) if received else b""

    def reset_input_buffer(self) -> None:
        """Forget what was received and not read."""
        with self._in_turn():
            forget_received(self._port)

    def _awaited(self, received: bytes) -> bytes:
        self._note(received)
        return b"" if self._has_collided else received

    def _take_turn(self) -> None:
        port = self._shared.port
        forget_received(port)
        if port.timeout != self._timeout:
            port.timeout = self._timeout
        super()._take_turn()


def claim(port: Any) -> bool:  # noqa: ANN401 - pyserial is untyped
    """Take a port for its device; return whether it was the turn of another device before."""
    return isinstance(port, LinePort) and port.claim()


def open_port(device: str, settings: SerialSettings, **options: object) -> Any:  # noqa: ANN401 - pyserial is untyped
    """Open a serial port that no other process holds; `options` are pyserial's beside speed and timeouts.

    It waits longer for answers while the computer is busy, see `PatientPort`. One that devices of this process share,
    as their settings name a `line`, is opened once, see `LinePort`.

    A port is held by a lock of the system that ends with the process (`flock`; on Windows the port itself). So it
    keeps out every program that asks for the lock as well, pseudo-terminals included, and leaves nothing behind.

    Raises `DeviceConnectionError` if the port cannot be opened; it names the process that holds it where the system
    tells.
    """
    if settings.line:

        def open_it() -> tuple[Any, Callable[[], object]]:
            port = open_serial(device, settings, **options)
            return port, port.close

        return LinePort(shared_port(settings.port, device, open_it), device, settings)
    port = open_serial(device, settings, **options)
    return LinePort(OpenPort(port, port.close), device, settings) if settings.echo else patient(port, settings)


def open_serial(device: str, settings: SerialSettings, **options: object) -> Any:  # noqa: ANN401
    """Open the port of every driver, which is locked, and in which no call waits for ever."""
    options = {"baudrate": settings.baudrate, "write_timeout": longest_wait(settings), **options}
    return open_locked(device, settings.port, timeout=settings.timeout, **options)


def open_locked(device: str, port: str, *, timeout: float, **options: object) -> Any:  # noqa: ANN401
    """Open a port of pyserial of any kind; see `open_serial`."""
    # On a busy computer pyserial calls a write late that has sent all its bytes.
    longest = max(timeout, LONGEST_WITHOUT_WATCHDOG)
    try:
        given = {"timeout": timeout, "write_timeout": longest, "exclusive": True, **options}
        return serial.serial_for_url(port, **given)
    except Exception as error:  # pyserial passes on system errors that are no OSError
        raise cannot_open(device, port, error) from None


def cannot_open(device: str, port: str, error: BaseException) -> DeviceConnectionError:
    """Return the error for a port that could not be opened; a library's own error gives its cause."""
    while error.__cause__ is not None:
        error = error.__cause__
    number, why = getattr(error, "errno", None), str(error)
    if number in _HELD:
        why = _use_of(port)
    elif number:
        # pyserial's own text says port and cause twice.
        why = os.strerror(number) + _CURES.get(number, "")
    return DeviceConnectionError(device, f"cannot open {port}: {why}")


def holder_of(port: str) -> tuple[int, str] | None:
    """Return number and name of the process that holds the lock of a port, as far as Linux says so."""
    with suppress(OSError, StopIteration, IndexError, ValueError):
        node = Path(port).stat()
        place = f"{os.major(node.st_dev):02x}:{os.minor(node.st_dev):02x}:{node.st_ino}"
        locks = (line.split() for line in Path("/proc/locks").read_text().splitlines())
        process = int(next(words[4] for words in locks if words[1] == "FLOCK" and words[5] == place))
        return process, Path(f"/proc/{process}/comm").read_text().strip()
    return None


def _use_of(port: str) -> str:
    """Return which process holds the lock of a port, and what to do."""
    holder = holder_of(port)
    if holder is not None and holder[0] == os.getpid():
        return "this program has opened it already; devices share it by a table [lines.NAME] of the rig file"
    name = "another process" if holder is None else f"process {holder[0]} ({holder[1]})"
    return f"it is in use by {name}; end that program first"


def forget_received(port: Any) -> None:  # noqa: ANN401 - pyserial is untyped
    """Forget what a line has received and nobody has read; raises `OSError` if the line is lost."""
    try:
        port.reset_input_buffer()
    except OSError:
        raise
    except Exception as error:  # pyserial passes on that of termios, which is no OSError
        raise OSError(str(error)) from error


def settle_line(port: Any, silence: float) -> None:  # noqa: ANN401 - pyserial is untyped
    """Discard what comes on a line until nothing has come for `silence` seconds.

    After an answer that was missing, damaged or doubled, one more may be on its way; this lets it pass. An answer can
    be later than any silence: a protocol without numbers also needs a question whose answer is like no other.

    Raises `OSError` if the line is lost or does not fall silent.
    """
    timeout = port.timeout
    port.timeout = silence
    try:
        for _ in range(MOST_STRAY // _LONGEST_PIECE):
            if not port.read(_LONGEST_PIECE):
                return
    finally:
        port.timeout = timeout
    raise OSError("the line does not fall silent")


def lost_line(device: str, port: str, error: object, advice: str = "") -> DeviceConnectionError:
    """Return the error for a line that failed while it was in use."""
    return DeviceConnectionError(device, f"lost the line {port} ({error}); check the cable and its adapter{advice}")


def no_answer(
    device: str,
    settings: SerialSettings,
    problem: str,
    node: str,
    number: int,
    found: str = "",
    speed: str = "",
    resends: int = RESENDS,
) -> DeviceConnectionError:
    """Return the error for a request without a good answer; `node` is the instrument's word for its address."""
    return DeviceConnectionError(
        device,
        f"{problem} at {settings.port}, {node} {number}, after {1 + resends} request{'s' if resends else ''}{found}; "
        f"check power, cable, {node} and speed ({speed or f'{settings.baudrate} Bd'})"
        f"{', and the key echo' if settings.echo else ''}",
    )
