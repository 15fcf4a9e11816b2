"""What tests of instruments share that need no plant: one that stands still; and a frame of Modbus RTU."""

from sim_devices.wire.modbus_rtu import crc16


class Still:
    """A plant of which nothing changes with time."""

    def advance(self, dt: float) -> None:
        pass


def sealed(text: str) -> bytes:
    """Return the bytes of hex digits with their CRC behind them."""
    frame = bytes.fromhex(text)
    return frame + crc16(frame)
