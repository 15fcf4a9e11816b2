"""An emulated instrument on Modbus TCP as its connections see it."""

from __future__ import annotations

from sim_devices.wire.modbus import RegisterBank
from sim_devices.wire.modbus_tcp import ModbusTcpStream

_MOST_CONNECTIONS = 2  # of a LabJack T7


class ModbusTcpInstrument:
    """An instrument that takes two connections."""

    def __init__(self, bank: RegisterBank) -> None:
        self._bank = bank
        self._open = 0

    def connect(self) -> OpenStream:
        """Open a connection.

        Raises ConnectionRefusedError if two are open.
        """
        if self._open == _MOST_CONNECTIONS:
            raise ConnectionRefusedError(f"{_MOST_CONNECTIONS} connections are open already")
        self._open += 1
        return OpenStream(self)

    def leave(self) -> None:
        """Count a connection less."""
        self._open -= 1

    def stream(self) -> ModbusTcpStream:
        """Return the instrument's end of a connection."""
        return ModbusTcpStream(self._bank)


class OpenStream:
    """The instrument's end of an open connection."""

    def __init__(self, instrument: ModbusTcpInstrument) -> None:
        self._instrument = instrument
        self._stream = instrument.stream()

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the client; return the replies to whole frames."""
        return self._stream.receive(data)

    def close(self) -> None:
        """Close it."""
        self._instrument.leave()
