"""Measurements from one file or several, and which of their rows are fitted."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.data import Columns, read_columns
from bench.analysis.tables.reading.options import ReadingOptions
from bench.base import ConfigurationError, DataError
from bench.models import PolynomialPlays

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_ROWS = re.compile(r"(\d*):(\d*)")


@dataclass(frozen=True)
class JoinedFiles:
    """The rows of several files, one after another.

    Attributes
    ----------
    columns : Columns
        As of one file.
    starts : tuple of int
        First row of each file.
    """

    columns: Columns
    starts: tuple[int, ...]


def read_files(
    paths: Sequence[Path], names: Sequence[str], *, at_least: int, options: ReadingOptions | None
) -> JoinedFiles:
    """Read columns of one file or several; arguments and errors of `read_columns`.

    Raises DataError too if the unit of a column differs from file to file.
    """
    found = [read_columns(path, names, at_least=at_least, options=options) for path in paths]
    for path, each in zip(paths, found, strict=True):
        for name in names:
            if each.units[name] != found[0].units[name]:
                raise DataError(
                    f"{path}: column {name} is in {each.units[name] or 'no unit'}; in {paths[0]} it is in "
                    f"{found[0].units[name] or 'no unit'}"
                )
    if len(found) == 1:
        return JoinedFiles(found[0], (0,))
    sizes = [len(each.values[names[0]]) for each in found]
    values = {name: np.concatenate([each.values[name] for each in found]) for name in names}
    notes = "; ".join(
        f"{path.name}: {each.assumptions}" for path, each in zip(paths, found, strict=True) if each.assumptions
    )
    source = ", ".join(path.name for path in paths)
    return JoinedFiles(Columns(source, values, found[0].units, notes), tuple(np.cumsum([0, *sizes[:-1]]).tolist()))


def is_rows(text: str) -> bool:
    """Return whether a text has the form of a range of rows, `START:STOP`."""
    return _ROWS.fullmatch(text) is not None


def parse_rows(option: str, text: str) -> slice:
    """Return the rows of `START:STOP`, counted from 0 without STOP; either may be left out.

    Raises ConfigurationError if it is none.
    """
    match = _ROWS.fullmatch(text)
    if match is None:
        raise ConfigurationError(f"{option} {text}: expected rows as START:STOP, such as 0:3000 or 3000:")
    start, stop = (int(part) if part else None for part in match.groups())
    return slice(start, stop)


def check_rows(option: str, rows: slice | None, count: int) -> None:
    """Check that rows that are asked for are there.

    Raises ConfigurationError if there are fewer.
    """
    if rows is not None and max(rows.stop or 0, rows.start or 0) > count:
        text = f"{'' if rows.start is None else rows.start}:{'' if rows.stop is None else rows.stop}"
        raise ConfigurationError(f"{option} {text} goes beyond the last row: there are {count}")


def fitted_rows(files: JoinedFiles, inputs: Floats, rows: slice | None) -> tuple[Flags, list[str]]:
    """Return which rows are fitted, shape (N,), and what is odd about them.

    Each further file starts with a memory of its own, which nobody knows: its rows are fitted from where its inputs
    have overwritten what they do at all.

    Parameters
    ----------
    files : JoinedFiles
        The files.
    inputs : ndarray, shape (N,)
        Their inputs.
    rows : slice or None
        Rows that may be fitted; all if None.

    Raises
    ------
    ConfigurationError
        If no row is left, or there are not so many rows.
    """
    check_rows("--train", rows, inputs.size)
    chosen = np.zeros(inputs.size, dtype=bool)
    chosen[slice(None) if rows is None else rows] = True
    warnings = []
    for start, stop in pairwise((*files.starts[1:], inputs.size)):
        until = overwritten_from(inputs[start:stop])
        if until > (stop - start) // 2:
            warnings.append(
                f"the file of rows {start} to {stop - 1} overwrites its unknown memory only at row {start + until}: "
                "its start is taken as if it followed the end of the file before"
            )
        else:
            chosen[start : start + until] = False
    if not chosen.any():
        raise ConfigurationError(f"--train leaves none of {inputs.size} rows")
    return chosen, warnings


def overwritten_from(inputs: Floats) -> int:
    """Return the first row from which inputs, shape (N,), have overwritten all memory that they ever do."""
    low, high = float(inputs.min()), float(inputs.max())
    if low == high:
        return 0
    return PolynomialPlays(np.zeros(1), np.ones(1), np.zeros(1), (low, high)).unknown_until(inputs)
