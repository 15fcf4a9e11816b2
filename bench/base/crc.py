"""Cyclic redundancy checks of frames on serial lines."""

from __future__ import annotations

from functools import lru_cache

_BEGINNING = 28
"""Bytes of a frame that is at rest and often repeats."""


def _lowest_first(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


def _highest_first(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = value << 1 ^ (0x8005 if value & 0x8000 else 0)
    return value & 0xFFFF


_LOWEST_FIRST, _HIGHEST_FIRST = (tuple(map(of_byte, range(256))) for of_byte in (_lowest_first, _highest_first))


def crc16_modbus(data: bytes | bytearray | memoryview) -> bytes:
    """Return the CRC of a Modbus RTU frame as it follows on the line, low byte first (Serial Line V1.02, 6.2.2)."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _LOWEST_FIRST[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")


def crc16_dynamixel(data: bytes) -> int:
    """Return the CRC of a packet of the Dynamixel Protocol 2.0: polynomial 0x8005, from 0, highest bit first."""
    return _crc_from(_crc_of_beginning(data[:_BEGINNING]), data[_BEGINNING:])


@lru_cache(maxsize=256)
def _crc_of_beginning(data: bytes) -> int:
    return _crc_from(0, data)


def _crc_from(crc: int, data: bytes) -> int:
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _HIGHEST_FIRST[crc >> 8 ^ byte]
    return crc
