"""An ideal sensor beside the loops of the emulated hybrid: the deflection itself, exact and without noise.

It stands on Modbus TCP like the T7, so that it is there in process and for other processes alike: register 0 to 3 are
the deflection in m, a 64-bit floating-point number, highest word first.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import ClassVar

from pydantic import Field

from bench.base import Clock, DeviceConnectionError
from bench.devices import DriverSettings, Identity, PositionSensor
from drivers.device import LineDevice
from drivers.modbus import RefusedError, read_request
from drivers.modbus_tcp import Connection, share
from sim_devices.wire.modbus import ILLEGAL_ADDRESS, Frame, Packet, RegisterError
from sim_devices.world import World

_VALUE = struct.Struct(">d")
_WORDS = struct.Struct(">4H")
_REGISTERS = (0, 4)
"""Address and number of them."""
_REQUEST = read_request(*_REGISTERS)
_REPLY = struct.Struct(">xBd")
"""Form of the reply: its function (skipped), the number of bytes of the value, and the value."""


class WitnessRegisters:
    """The registers of the witness; a `sim_devices.wire.modbus.PacketBank`."""

    def __init__(self, world: World, deflection: Callable[[], float]) -> None:
        self._world = world
        self._deflection = deflection

    def read_registers(self, address: int, count: int) -> list[int]:
        """Return the words of the deflection; raise `RegisterError` for any other registers."""
        if (address, count) != _REGISTERS:
            raise RegisterError(ILLEGAL_ADDRESS, "the witness has the registers 0 to 3, to be read at once")
        return list(_WORDS.unpack(self._read(b"")))

    def prepare(self, frames: Sequence[Frame], heads: Sequence[int]) -> Packet | None:  # noqa: ARG002
        """Return what carries such packets out: reads of the deflection."""
        return self._read if list(frames) == [Frame(False, *_REGISTERS)] else None

    def _read(self, packet: bytes) -> bytes:  # noqa: ARG002
        with self._world.lock:
            self._world.advance_locked()
            return _VALUE.pack(self._deflection())

    def write_registers(self, address: int, values: list[int]) -> None:  # noqa: ARG002
        """Raise `RegisterError`: nothing can be written."""
        raise RegisterError(ILLEGAL_ADDRESS, "the registers of the witness can only be read")


class WitnessSettings(DriverSettings):
    """Settings of the witness in a rig file."""

    port: str = Field(description="emulated://NAME, or tcp://HOST:PORT of an emulated laboratory in another process")
    timeout: float = Field(default=1.0, ge=0.05, le=60.0, description="longest wait for a reply in s, 0.05 to 60")


class Witness(LineDevice[WitnessSettings, Connection], PositionSensor):
    """The deflection itself, without noise: an ideal sensor beside the loop."""

    Settings: ClassVar[type[WitnessSettings]] = WitnessSettings

    def __init__(self, name: str, settings: WitnessSettings, clock: Clock, line: Connection) -> None:
        super().__init__(name, settings, clock, line)
        self._signal = f"{name}_position"

    @classmethod
    def _open_line(cls, name: str, settings: WitnessSettings, clock: Clock) -> Connection:  # noqa: ARG003
        try:
            return share(settings.port, settings.timeout)
        except OSError as error:
            raise DeviceConnectionError(name, f"cannot connect to {settings.port}: {error}") from None

    def _identify(self) -> Identity:
        return Identity("emulated", "witness", "0", "0")

    def _start(self) -> None:
        self.measure()

    def measure(self) -> dict[str, float]:
        """Return the deflection, m."""
        try:
            announced, deflection = _REPLY.unpack(self._line.client.request(_REQUEST, _REPLY.size))
            if announced != _VALUE.size:
                raise OSError(f"the answer announces {announced} bytes where {_VALUE.size} were asked for")
        except (RefusedError, OSError) as error:
            raise DeviceConnectionError(self.name, f"no witness at {self._settings.port}: {error}") from error
        return {self._signal: deflection}

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""
