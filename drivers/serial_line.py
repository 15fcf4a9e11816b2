"""Serial lines, opened by URL as pyserial does: `/dev/ttyUSB0`, `socket://host:port` or `emulated://NAME`."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import serial
from pydantic import Field

from bench.base import DeviceConnectionError, slowness
from bench.devices import DriverSettings
from bench.rig import EMULATED

RESENDS = 2
"""How often a request that brought no good answer is sent again."""

_SHARE_OF_WATCHDOG = 0.6
"""Share of the time of an instrument's watchdog that a request and its repetitions may take together on a busy
computer; as long as its line may be lost (`bench.execution.station.reconnection`)."""

_LONGEST_WITHOUT_WATCHDOG = 1.0
"""Longest wait for an answer on a busy computer, s, of an instrument that has no watchdog."""

_BUSY = 1.5
"""Slowness from which on a computer counts as busy: a pause of its own is no reason to wait."""


class SerialSettings(DriverSettings):
    """Where an instrument on a serial line is; the settings of its driver extend it."""

    port: str = Field(
        min_length=1, description="line as pyserial opens it: /dev/ttyUSB0, socket://host:port or emulated://NAME"
    )
    baudrate: int = Field(description="speed of the line, Bd")
    timeout: float = Field(
        default=0.1, gt=0.0, le=10.0, description="wait for an answer, s; a request is sent three times at most"
    )


MOST_STRAY = 4096
"""Bytes that may come unasked before a serial line counts as unusable."""

_LONGEST_PIECE = 256  # bytes that are discarded at once
_HELD = (errno.EAGAIN, errno.EBUSY)


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
        received: bytes = self._port.read(size)
        if len(received) < size:
            received += self._waited(lambda: self._port.read(size - len(received)))
        return received

    def read_until(self, expected: bytes, size: int) -> bytes:
        """Return what comes up to an end, or so many bytes; another only after the wait."""
        received: bytes = self._port.read_until(expected, size)
        if len(received) < size and not received.endswith(expected):
            received += self._waited(lambda: self._port.read_until(expected, size - len(received)))
        return received

    def _waited(self, read: Callable[[], bytes]) -> bytes:
        """Return what comes within the time by which a busy computer makes the wait longer."""
        nominal = self._port.timeout
        self.patience = nominal
        if not nominal or nominal >= self._longest or (factor := self._measure()) < _BUSY:
            return b""
        self.patience = min(factor * nominal, self._longest)
        self._port.timeout = self.patience - nominal
        try:
            return read()
        finally:
            self._port.timeout = nominal

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - all else is the port's
        return getattr(self._port, name)


def patient(port: Any, settings: SerialSettings, measure: Callable[[], float] = slowness) -> Any:  # noqa: ANN401
    """Return a port that waits longer while the computer is busy; an emulated one has the laboratory's time."""
    if settings.port.startswith(EMULATED):
        return port
    watchdog = getattr(settings, "watchdog", 0.0)
    longest = _SHARE_OF_WATCHDOG * watchdog / (1 + RESENDS) if watchdog else _LONGEST_WITHOUT_WATCHDOG
    return PatientPort(port, longest, measure)


def patience_of(port: Any, settings: SerialSettings) -> float:  # noqa: ANN401 - pyserial is untyped
    """Return how long an answer is waited for on a line at present, s."""
    return float(getattr(port, "patience", settings.timeout))


def open_port(device: str, settings: SerialSettings, **options: object) -> Any:  # noqa: ANN401 - pyserial is untyped
    """Open a serial port that no other process holds; `options` are pyserial's beside speed and timeouts.

    It waits longer for answers while the computer is busy, see `PatientPort`.

    A port is held by a lock of the system that ends with the process (`flock`; on Windows the port itself). So it
    keeps out every program that asks for the lock as well, pseudo-terminals included, and leaves nothing behind.

    Raises `DeviceConnectionError` if the port cannot be opened; it names the process that holds it where the system
    tells.
    """
    try:
        port = serial.serial_for_url(
            settings.port,
            baudrate=settings.baudrate,
            timeout=settings.timeout,
            write_timeout=settings.timeout,
            exclusive=True,
            **options,
        )
    except Exception as error:  # pyserial passes on system errors that are no OSError
        if getattr(error, "errno", None) in _HELD:
            raise DeviceConnectionError(device, f"cannot open {settings.port}: {_use_of(settings.port)}") from None
        raise DeviceConnectionError(device, f"cannot open {settings.port}: {error}") from None
    return patient(port, settings)


def _use_of(port: str) -> str:
    """Return which process holds the lock of a port, as far as Linux says so, and what to do."""
    try:
        node = Path(port).stat()
        place = f"{os.major(node.st_dev):02x}:{os.minor(node.st_dev):02x}:{node.st_ino}"
        locks = (line.split() for line in Path("/proc/locks").read_text().splitlines())
        process = int(next(words[4] for words in locks if words[1] == "FLOCK" and words[5] == place))
        if process == os.getpid():
            return "this program has opened it already; give each device a port of its own"
        name = f"process {process} ({Path(f'/proc/{process}/comm').read_text().strip()})"
    except (OSError, StopIteration, IndexError, ValueError):
        name = "another process"
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


def lost_line(device: str, settings: SerialSettings, error: object, advice: str = "") -> DeviceConnectionError:
    """Return the error for a line that failed while it was in use."""
    return DeviceConnectionError(device, f"lost the line {settings.port} ({error}); check the cable{advice}")


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
        f"check power, cable, {node} and speed ({speed or f'{settings.baudrate} Bd'})",
    )
