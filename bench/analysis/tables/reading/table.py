"""What every reader of a file gives."""

from __future__ import annotations

from dataclasses import dataclass

from bench.base import Floats

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
