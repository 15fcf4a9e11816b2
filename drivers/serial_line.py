"""Serial lines, opened by URL as pyserial does: `/dev/ttyUSB0`, `socket://host:port` or `emulated://NAME`."""

from __future__ import annotations

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


def open_port(device: str, settings: SerialSettings, **options: object) -> Any:  # noqa: ANN401 - pyserial is untyped
    """Open a serial port; `options` are pyserial's beside speed and timeouts.

    Raises `DeviceConnectionError` if the port cannot be opened.
    """
    try:
        return serial.serial_for_url(
            settings.port,
            baudrate=settings.baudrate,
            timeout=settings.timeout,
            write_timeout=settings.timeout,
            **options,
        )
    except Exception as error:  # pyserial passes on system errors that are no OSError
        raise DeviceConnectionError(device, f"cannot open {settings.port}: {error}") from None


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
