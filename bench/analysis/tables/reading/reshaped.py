"""Text that is brought into the form of a table before it is read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

from bench.analysis.tables.reading.layout import DELIMITERS, delimited, find_layout, is_number, split_rows
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.table import FEWEST_ROWS
from bench.analysis.tables.reading.tables import read_sample
from bench.analysis.tables.reading.text import TextFile, TextLines

_MOST_TEXTS = 2
"""Cells before the numbers of a row: a name and a unit."""


_STAMP = re.compile(r"\s*(\d{1,2}:\d\d:\d\d(?:[.,]\d+)?) -> ?")
"""What the monitor of a serial line writes before what it receives."""


@dataclass(frozen=True)
class StampedFile(TextFile):
    """A text file whose lines begin with a time of day and an arrow, which are read as a column of their own."""

    delimiter: str = ","

    def lines(self, start: int = 0, end: int | None = None) -> Iterator[str]:
        """Yield lines as `TextFile.lines`."""
        return (_STAMP.sub(rf"\1{self.delimiter}", line) for line in super().lines(start, end))


def split_stamps(file: TextFile, options: ReadingOptions) -> TextFile:
    """Return a file with its stamps in a column of their own, if it has any."""
    lines = read_sample(file, options.skip_lines)
    if not lines or not all(map(_STAMP.match, lines)):
        return file
    layout = find_layout(file.path, [_STAMP.sub("", line) for line in lines], options, options.skip_lines)
    delimiter = "\t" if layout is None else layout.delimiter
    return StampedFile(file.path, file.encoding, file.compressed, file.choice, delimiter)


def turn_rows(file: TextFile, options: ReadingOptions) -> tuple[TextFile, ReadingOptions, tuple[str, ...]] | None:
    """Return a file whose few long rows stand as columns, how it is read, and notes; None if it has no such rows.

    So few samples as there are rows identify nothing. Each row has as many numbers, perhaps behind a name and a unit.
    """
    if options.table is not None:
        return None
    for delimiter in [options.delimiter] if options.delimiter else DELIMITERS:
        first = islice(split_rows(file.lines(options.skip_lines), delimiter), FEWEST_ROWS)
        rows = [[cell.strip() for cell in row.cells] for row in first]
        columns = len(rows[0]) if rows else 0
        if len(rows) == FEWEST_ROWS or columns < FEWEST_ROWS or any(len(row) != columns for row in rows):
            continue
        for decimal in [options.decimal] if options.decimal else (".", ","):
            are_numbers = [[is_number(cell, decimal) for cell in row] for row in rows]
            texts = are_numbers[0].index(True) if True in are_numbers[0] else columns
            if texts <= _MOST_TEXTS and all(not any(row[:texts]) and all(row[texts:]) for row in are_numbers):
                turned = tuple("\t".join(cells) + "\n" for cells in zip(*rows, strict=True))
                notes = delimited(delimiter), f"{len(rows)} × {columns - texts}, its rows read as columns"
                content = TextLines(file.path, file.encoding, file.compressed, file.choice, turned)
                return content, replace(options, delimiter="\t", decimal=decimal, skip_lines=0), notes
    return None
