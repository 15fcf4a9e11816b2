"""Looks for damage in a write-ahead log of SQLite, which SQLite itself does not report.

SQLite takes a log up to the first frame that does not fit, and drops the rest without a message, as it cannot tell
damage from a write that its process did not finish. Format: https://sqlite.org/fileformat2.html, section 4.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

_HEADER, _FRAME = 32, 24
"""Lengths of the header of the log and of that of a frame, bytes."""
_MAGIC = 0x377F0682
"""First word of a log; its lowest bit says whether checksums are of big-endian words."""
_SUMMED = 24
"""Bytes of the header that its checksum is of; of a frame these are the first 8, and its page."""


def log_damage(log: Path) -> str:
    """Return what is wrong with a log that nobody writes; empty if nothing is.

    Frames without a commit at the end are of a write that its process did not finish: they may fit or not, and
    nothing is wrong with them. Frames of an earlier round of the log have other salts.
    """
    try:
        with log.open("rb") as file:
            header = file.read(_HEADER)
            rest_is_empty = not any(any(block) for block in iter(lambda: file.read(1 << 16), b""))
            if rest_is_empty:
                return ""
            magic, page = struct.unpack(">I4xI", header[:12])
            order = ">" if magic & 1 else "<"
            if magic & ~1 != _MAGIC or _chained((0, 0), header[:_SUMMED], order) != _sums(header[_SUMMED:]):
                return "the header of its write-ahead log is damaged"
            file.seek(_HEADER)
            return _damaged_frame(header, iter(lambda: file.read(_FRAME + page), b""), page, order)
    except FileNotFoundError:
        return ""


def _damaged_frame(header: bytes, frames: Iterator[bytes], page: int, order: str) -> str:
    """Return which frame does not fit although it belongs to the log."""
    salts = header[16:24]
    before = _sums(header[_SUMMED:])
    number, damaged = 0, 0
    for frame in frames:
        number += 1
        if not damaged and len(frame) == _FRAME + page and frame[8:16] == salts:
            found = _chained(_chained(before, frame[:8], order), frame[_FRAME:], order)
            if found == _sums(frame[16:_FRAME]):
                before = found
                continue
        damaged = damaged or number
        if _is_commit(frame, salts):
            what = "damaged" if len(frame) == _FRAME + page else "cut off or damaged"
            return f"frame {damaged} of its write-ahead log is {what}"
    return ""


def _is_commit(head: bytes, salts: bytes) -> bool:
    """Return whether a frame ends a commit of this round of the log; each round has new salts."""
    return any(head[4:8]) and (head[8:12] == salts[:4] or head[12:16] == salts[4:])


def _sums(content: bytes) -> tuple[int, int]:
    first, second = struct.unpack(">II", content)
    return first, second


def _chained(before: tuple[int, int], content: bytes, order: str) -> tuple[int, int]:
    """Return the checksum after some words, from that before them."""
    first, second = before
    for one, other in struct.iter_unpack(f"{order}II", content):
        first = (first + one + second) & 0xFFFFFFFF
        second = (second + other + first) & 0xFFFFFFFF
    return first, second
