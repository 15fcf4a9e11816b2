"""Files that are never seen half written: a full disk or a killed process leaves what was there before."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.base.errors import DataError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give another name to write a file under, which becomes the file at the end of the block.

    After an error the file stays as it was. A link stays one: the file that it points to is written. What is no
    regular file, such as `/dev/stdout`, is written itself.

    Parameters
    ----------
    path : Path
        The file; it may exist.

    Yields
    ------
    Path
        What to write.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    path = Path(os.path.realpath(path))
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text as UTF-8 to a file that is never seen half written; raise OSError if that cannot be."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def result_file(path: Path) -> Iterator[Path]:
    """Give another name to write a file of results under, as `whole_file`.

    Raises DataError if it cannot be written.
    """
    try:
        with whole_file(path) as part:
            yield part
    except OSError as error:
        raise DataError(f"{path} cannot be written: {error.strerror or error}") from None


def write_result(path: Path, text: str) -> None:
    """Write a text of results as UTF-8; raise DataError if it cannot be written."""
    with result_file(path) as part:
        part.write_text(text, encoding="utf-8")
