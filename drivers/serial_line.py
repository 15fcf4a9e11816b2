"""Serial lines, opened by URL as pyserial does: `/dev/ttyUSB0`, `socket://host:port` or `emulated://NAME`."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import serial
from pydantic import Field

from bench.devices import DriverSettings
from bench.errors import DeviceConnectionError

RESENDS = 2
"""How often a request that brought no good answer is sent again."""


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


def open_port(device: str, settings: SerialSettings, **options: object) -> Any:  # noqa: ANN401 - pyserial is untyped
    """Open a serial port that no other process holds; `options` are pyserial's beside speed and timeouts.

    A port is held by a lock of the system that ends with the process (`flock`; on Windows the port itself). So it
    keeps out every program that asks for the lock as well, pseudo-terminals included, and leaves nothing behind.

    Raises `DeviceConnectionError` if the port cannot be opened; it names the process that holds it where the system
    tells.
    """
    try:
        return serial.serial_for_url(
            settings.port,
            baudrate=settings.baudrate,
            timeout=settings.timeout,
            write_timeout=settings.timeout,
            exclusive=True,
            **options,
        )
    except Exception as error:  # pyserial passes on system errors that are no OSError
        if getattr(error, "errno", None) in _HELD:
            raise DeviceConnectionError(
                device,
                f"cannot open {settings.port}: it is in use by {_holder(settings.port)}; end that program first",
            ) from None
        raise DeviceConnectionError(device, f"cannot open {settings.port}: {error}") from None


def _holder(port: str) -> str:
    """Return which process holds the lock of a port, as far as Linux says so."""
    try:
        node = Path(port).stat()
        place = f"{os.major(node.st_dev):02x}:{os.minor(node.st_dev):02x}:{node.st_ino}"
        locks = (line.split() for line in Path("/proc/locks").read_text().splitlines())
        process = next(words[4] for words in locks if words[1] == "FLOCK" and words[5] == place)
        return f"process {process} ({Path(f'/proc/{process}/comm').read_text().strip()})"
    except (OSError, StopIteration, IndexError):
        return "another process"


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
