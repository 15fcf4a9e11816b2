"""The base of all devices on a LabJack T7: the address of the instrument, and the connection that they share."""

from __future__ import annotations

import re
from typing import TypeVar

from pydantic import Field, field_validator

from bench.base import Clock
from bench.devices import DriverSettings, Identity
from bench.rig import EMULATED
from drivers.device import LineDevice
from drivers.labjack_t7.registers import LabJackT7

DEFAULT_PORT = 502

_HOST = re.compile(r"(?:tcp://)?(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::(?P<port>[0-9]{1,5}))?/?")


class T7ConnectionSettings(DriverSettings):
    """Where a T7 is; every device on one extends it."""

    port: str = Field(
        description="address as tcp://HOST:PORT, such as tcp://192.168.1.207:502, HOST alone for port 502, or "
        "emulated://NAME"
    )
    timeout: float = Field(default=1.0, ge=0.05, le=60.0, description="longest wait for a reply in s, 0.05 to 60")

    @field_validator("port")
    @classmethod
    def _check_port(cls, value: str) -> str:
        if value.startswith(EMULATED):
            return value
        match = _HOST.fullmatch(value.strip())
        number = int(match["port"] or DEFAULT_PORT) if match else 0
        if match is None or not 1 <= number <= 65535:
            raise ValueError(f"expected tcp://HOST:PORT with port 1 to 65535, got {value!r}")
        return f"tcp://{match['host']}:{number}"


T7SettingsT = TypeVar("T7SettingsT", bound=T7ConnectionSettings)


class T7Device(LineDevice[T7SettingsT, LabJackT7]):
    """A device on a LabJack T7.

    Several may share one instrument, and share the connection to it then (`drivers.modbus_tcp`); they are
    set up one after the other. A connection that breaks ends for all of them, and the next request of each goes over
    another one, if the instrument has not restarted since (`LabJackT7`). A request without a reply is repeated once.
    `connect` raises `DeviceConnectionError` also if the words or bytes of a value arrive in swapped order.
    """

    @classmethod
    def _open_line(cls, name: str, settings: T7SettingsT, clock: Clock) -> LabJackT7:  # noqa: ARG003
        return LabJackT7(name, settings.port, settings.timeout)

    def _identify(self) -> Identity:
        return self._line.identify()

    def _renew_line(self) -> None:
        # One that another device has just opened stays.
        self._line.renew()

    def reconnect(self) -> None:
        """Go on over another connection if the present one was lost; errors are those of `Device.reconnect`."""
        with self._line.in_haste():
            super().reconnect()
