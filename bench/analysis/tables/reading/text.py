"""Lines of a text file, however it was encoded, compressed or ended."""

from __future__ import annotations

import codecs
import gzip
import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO, cast

from bench.base import DataError, reason, say_share

WHAT_IS_READ = "text, .gz of text, .mat, .h5, .tdms, .npz, .parquet, .json and spreadsheets are read"
"""Kinds of files, for messages."""

FALLBACK = "cp1252"
"""Encoding of what is not UTF-8: Western Windows."""

_LINES = 20000
"""Lines after which it is said how far the reading is."""

_CHUNK = 1 << 20
# That of UTF-32 begins with that of UTF-16.
_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip
_GZIP = b"\x1f\x8b"


@dataclass(frozen=True)
class TextFile:
    """A text file."""

    path: Path  # the file, which may be compressed by gzip
    encoding: str  # as Python names it
    compressed: bool  # whether it is
    choice: str = ""  # what stands before the number of a table in `--format table=N`

    def lines(self, start: int = 0, end: int | None = None) -> Iterator[str]:
        """Yield lines from number `start` to before `end`, from 0; each ends in a line feed, the last perhaps not.

        Raises DataError if they cannot be read.
        """
        with (
            reading_errors(self.path),
            _open(self.path, self.compressed) as file,
            io.TextIOWrapper(file, encoding=self.encoding) as wrapped,
        ):
            size = max(self.path.stat().st_size, 1)
            # The position in the file itself, which may be compressed.
            place: BinaryIO = getattr(file, "fileobj", file)
            rest = islice(wrapped, start, end)
            while lines := list(islice(rest, _LINES)):
                yield from lines
                say_share("reading", place.tell() / size)


@dataclass(frozen=True)
class TextLines(TextFile):
    """The same, of lines that are read already."""

    content: tuple[str, ...] = ()

    def lines(self, start: int = 0, end: int | None = None) -> Iterator[str]:
        """Yield lines from number `start` to before `end`, from 0."""
        return islice(self.content, start, end)


@contextmanager
def reading_errors(path: Path) -> Iterator[None]:
    """Make the errors of reading a file a DataError that names it."""
    try:
        yield
    except FileNotFoundError:
        raise DataError(f"{path} does not exist") from None
    except UnicodeError as error:
        raise DataError(
            f"{path} cannot be read as text ({error}); say its encoding with --format encoding=NAME, such as cp1252, "
            "utf-16 or shift_jis"
        ) from None
    except MemoryError:
        raise DataError(f"{path} cannot be read: by what it says of itself it is larger than the memory") from None
    except (OSError, EOFError, LookupError, zlib.error) as error:
        raise DataError(f"{path} cannot be read: {reason(error)}") from None


def open_text(path: Path, encoding: str | None) -> TextFile:
    """Find out encoding and compression of a text file.

    An encoding that is not given is that of a byte-order mark, UTF-16 by its pattern of zeros, UTF-8 if the whole
    file is, else cp1252, Western Windows.

    Raises DataError if it cannot be read or is no text.
    """
    with reading_errors(path):
        with path.open("rb") as raw:
            compressed = raw.read(2) == _GZIP
        if encoding is None:
            with _open(path, compressed) as file:
                encoding = _encoding(path, file)
    return TextFile(path, encoding, compressed)


def _encoding(path: Path, file: BinaryIO) -> str:
    start = file.read(_CHUNK)
    for mark, encoding in _BYTE_ORDER_MARKS.items():
        if start.startswith(mark):
            return encoding
    if b"\0" in start[:4096]:
        sample = start[:4096]
        zeros = sample[::2].count(0), sample[1::2].count(0)
        if min(zeros) == 0 and 4 * max(zeros) > len(sample):
            return "utf-16-be" if zeros[0] else "utf-16-le"
        raise DataError(
            f"{path} is no table of text; {WHAT_IS_READ} (of text in another encoding, say --format encoding=NAME)"
        )
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        while start:
            decoder.decode(start)
            start = file.read(_CHUNK)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return FALLBACK
    return "utf-8"


def _open(path: Path, compressed: bool) -> BinaryIO:
    return cast("BinaryIO", gzip.open(path, "rb")) if compressed else path.open("rb")
