"""Devices that own their line: opening it, checking what answers there, and releasing it.

Serial lines are opened by URL, as pyserial does: `/dev/ttyUSB0`, `socket://host:port` or `emulated://NAME`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Generic, Protocol, Self, TypeVar

import serial
from pydantic import Field

from bench.clock import Clock
from bench.devices import Device, DriverSettings, Identity
from bench.errors import DeviceConnectionError

RESENDS = 2
"""How often a serial driver sends a request again that brought no good answer."""


class Line(Protocol):
    """What a device talks over."""

    def close(self) -> None:
        """Release the line."""


SettingsT = TypeVar("SettingsT", bound=DriverSettings)
LineT = TypeVar("LineT", bound=Line)


class LineDevice(Device, Generic[SettingsT, LineT]):
    """A device at the end of a line of its own.

    Made by `connect`. A driver implements how its line is opened (`_open_line`), which instrument is there
    (`_identify`), and how it is checked and configured (`_start`).

    Parameters
    ----------
    name : str
        Name in the rig.
    settings : DriverSettings
        The device's part of the rig file; each driver has its own, as `Settings`.
    clock : Clock
        The clock of the run.
    line : Line
        The open line to the instrument.
    """

    _identity: Identity

    def __init__(self, name: str, settings: SettingsT, clock: Clock, line: LineT) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._line = line

    @classmethod
    def connect(cls, name: str, settings: SettingsT, clock: Clock) -> Self:
        """Open the line, check that the right instrument answers and is healthy, and configure it; nothing moves.

        Parameters
        ----------
        name : str
            Name in the rig.
        settings : DriverSettings
            The device's part of the rig file.
        clock : Clock
            The clock of the run.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened, nothing answers, or another instrument does.
        DeviceError
            If the instrument reports an error, or does not take a setting.
        ConfigurationError
            If the instrument does not allow a value of the settings; nothing was saved in it then.
        """
        return cls._open(name, settings, clock, cls._start)

    @classmethod
    def _open(cls, name: str, settings: SettingsT, clock: Clock, start: Callable[[Self], None]) -> Self:
        line = cls._open_line(name, settings, clock)
        try:
            device = cls(name, settings, clock, line)
            device._identity = device._identify()
            start(device)
        except BaseException:
            line.close()
            raise
        return device

    @classmethod
    @abstractmethod
    def _open_line(cls, name: str, settings: SettingsT, clock: Clock) -> LineT: ...

    @abstractmethod
    def _identify(self) -> Identity: ...

    @abstractmethod
    def _start(self) -> None: ...

    @property
    def identity(self) -> Identity:
        """Maker, model, serial number and firmware, as the instrument reported on connecting."""
        return self._identity

    def close(self) -> None:
        """Release the line; an output that is on stays on until the instrument's watchdog acts."""
        self._line.close()


class RecoverableDevice(LineDevice[SettingsT, LineT]):
    """A device whose instrument keeps an error until it is restarted or released."""

    @classmethod
    def recover(cls, name: str, settings: SettingsT, clock: Clock) -> Self:
        """Connect to an instrument in its error state: restart or release it, and configure it.

        Use it once the cause of the error is found. Parameters and errors are those of `connect`.
        """
        return cls._open(name, settings, clock, cls._restart)

    @abstractmethod
    def _restart(self) -> None: ...


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

    Raises
    ------
    DeviceConnectionError
        If the port cannot be opened.
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
    device: str, settings: SerialSettings, problem: str, node: str, number: int, found: str = "", speed: str = ""
) -> DeviceConnectionError:
    """Return the error for a request without a good answer; `node` is the instrument's word for its address."""
    return DeviceConnectionError(
        device,
        f"{problem} at {settings.port}, {node} {number}, after {1 + RESENDS} requests{found}; "
        f"check power, cable, {node} and speed ({speed or f'{settings.baudrate} Bd'})",
    )
