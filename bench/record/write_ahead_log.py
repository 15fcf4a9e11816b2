"""Looks for damage in a write-ahead log of SQLite, which SQLite itself does not report.

SQLite takes a log up to the first frame that does not fit, and drops the rest without a message, as it cannot tell
damage from a write that its process did not finish. Format: https://sqlite.org/fileformat2.html, section 4.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

Words = npt.NDArray[np.uint32]

_HEADER, _FRAME = 32, 24
"""Lengths of the header of the log and of that of a frame, bytes."""
_MAGIC = 0x377F0682
"""First word of a log; its lowest bit says whether checksums are of big-endian words."""
_SUMMED = 24
"""Bytes of the header that its checksum is of; of a frame these are the first 8, and its page."""
_BLOCK = 256
"""Frames that are looked at together."""


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
            if len(header) < _HEADER or not _is_header(header):
                return "the header of its write-ahead log is damaged"
            page = int.from_bytes(header[8:12], "big")
            file.seek(_HEADER)
            order = ">u4" if header[3] & 1 else "<u4"
            return _damaged_frame(header, iter(lambda: file.read(_BLOCK * (_FRAME + page)), b""), page, order)
    except FileNotFoundError:
        return ""


def _is_header(header: bytes) -> bool:
    magic = int.from_bytes(header[:4], "big")
    page = int.from_bytes(header[8:12], "big")
    if magic & ~1 != _MAGIC or not 512 <= page <= 65536 or page & (page - 1):
        return False
    words = np.frombuffer(header[:_SUMMED], ">u4" if magic & 1 else "<u4").astype(np.uint32)
    return _chained((0, 0), words[None, :])[0] == struct.unpack(">II", header[_SUMMED:])


def _damaged_frame(header: bytes, blocks: Iterator[bytes], page: int, order: str) -> str:
    """Return which frame does not fit although it belongs to the log."""
    salts = header[16:24]
    before: tuple[int, int] = struct.unpack(">II", header[24:32])
    number, damaged = 0, 0
    for block in blocks:
        count, torn = divmod(len(block), _FRAME + page)
        frames = np.frombuffer(block[: count * (_FRAME + page)], np.uint8).reshape(count, _FRAME + page)
        sums = []
        if not damaged and count:
            summed = np.concatenate([frames[:, :8], frames[:, _FRAME:]], axis=1)
            sums = _chained(before, summed.copy().view(order).astype(np.uint32))
        for i in range(count):
            number += 1
            head = frames[i, :_FRAME].tobytes()
            if not damaged and head[8:16] == salts and sums[i] == struct.unpack(">II", head[16:24]):
                before = sums[i]
                continue
            damaged = damaged or number
            if _is_commit(head, salts):
                return f"frame {damaged} of its write-ahead log is damaged"
        if torn and _is_commit(block[-torn:], salts):
            return f"frame {damaged or number + 1} of its write-ahead log is cut off or damaged"
    return ""


def _is_commit(head: bytes, salts: bytes) -> bool:
    """Return whether a frame ends a commit of this round of the log; each round has new salts."""
    return any(head[4:8]) and (head[8:12] == salts[:4] or head[12:16] == salts[4:])


def _chained(before: tuple[int, int], words: Words) -> list[tuple[int, int]]:
    """Return the checksum after each of several frames, words of shape (frames, words), from that before the first.

    The checksum adds up, modulo 2^32, so that all frames are weighted at once.
    """
    weights, carried = _weights(words.shape[1])
    own = words @ weights
    result = []
    first, second = before
    for k in range(len(own)):
        first, second = (
            (carried[i][0] * first + carried[i][1] * second + int(own[k, i])) & 0xFFFFFFFF for i in range(2)
        )
        result.append((first, second))
    return result


@cache
def _weights(count: int) -> tuple[Words, tuple[tuple[int, int], tuple[int, int]]]:
    """Return how each of `count` words counts in the two sums, shape (count, 2), and how the sums before them do."""
    # For two words a, b: first += a + second; then second += b + first.
    weights = np.empty((count, 2), dtype=np.uint32)
    later = ((1, 0), (0, 1))
    for pair in reversed(range(count // 2)):
        for i, (of_first, of_second) in enumerate(later):
            weights[2 * pair, i] = (of_first + of_second) & 0xFFFFFFFF
            weights[2 * pair + 1, i] = of_second
        later = tuple(  # type: ignore[assignment]
            ((a + b) & 0xFFFFFFFF, (a + 2 * b) & 0xFFFFFFFF) for a, b in later
        )
    return weights, later
