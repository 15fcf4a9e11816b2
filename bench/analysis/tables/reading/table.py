"""What every reader of a file gives, and the number that a cell must be."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.analysis.tables.reading.layout import is_number
from bench.base import DataError, Floats

FEWEST_ROWS = 10
"""Fewer samples than this identify nothing."""

OTHER_COLUMN = "; most rows have no number in this column: choose another"
"""Remedy for a cell of a column that is not one of numbers."""


@dataclass(frozen=True)
class ReadColumns:
    """Columns that were read."""

    names: list[str]  # those that were asked for, and that of a column of times where one was looked for and found
    values: list[Floats]  # in the same order, shape (rows,) each, finite but for nan where a value is missing
    units: list[str]  # likewise; empty where the file does not say
    notes: tuple[str, ...]  # what was assumed about the file


def finite_number(where: str, cell: str, decimal: str = ".", remedy: str = "") -> float:
    """Return the number in a cell.

    Raises DataError with the place and a remedy, if there is none or it is not finite.
    """
    if not cell:
        raise DataError(f"{where}: is empty; expected a number{remedy}")
    if not is_number(cell, decimal):
        shown = cell if len(cell) < 40 else f"{cell[:40]}…"
        raise DataError(f"{where}: {shown!r} is not a number{remedy}")
    value = float((cell.replace(",", ".") if decimal == "," else cell).upper().replace("D", "E"))
    if not math.isfinite(value):
        raise DataError(f"{where}: {cell[:40]} is not a finite number{remedy}")
    return value
