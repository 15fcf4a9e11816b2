"""Columns of a table of text: numpy reads them at once; what it cannot read is looked at cell by cell."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bench.errors import ConfigurationError, DataError
from bench.results.reading.heads import find_place
from bench.results.reading.layout import (
    SAMPLE_CHARACTERS,
    SAMPLE_LINES,
    Layout,
    count_lines,
    find_layout,
    header_only,
    is_comment,
    is_number,
    split_rows,
)
from bench.results.reading.options import ReadingOptions
from bench.results.reading.table import ReadColumns, finite_number
from bench.results.reading.text import TextFile, open_text

Floats = npt.NDArray[np.float64]

_MOST_TABLES = 9
"""Tables that a message lists."""


class _BreakError(Exception):
    """Lines that may separate two tables."""


def read_text(path: Path, names: Sequence[str], options: ReadingOptions) -> ReadColumns:
    """Read columns of a text file.

    Parameters
    ----------
    path : Path
        The file, perhaps compressed by gzip.
    names : sequence of str
        Columns by head, head without its unit, or number from 1.
    options : ReadingOptions
        What is known of its layout.

    Raises
    ------
    DataError
        If the file cannot be read, is ambiguous, or a cell is not a finite number: names line and option.
    ConfigurationError
        If `options.table` is not a number.
    """
    if options.table is not None and not options.table.isdecimal():
        raise ConfigurationError(f"--table {options.table!r}: the tables of a text file have numbers, from 1")
    file = open_text(path, options.encoding)
    try:
        return _read(file, names, options)
    except csv.Error as error:
        raise DataError(f"{path} cannot be read as a table: {error}") from None


def _read(file: TextFile, names: Sequence[str], options: ReadingOptions) -> ReadColumns:
    start, table = options.skip_lines, int(options.table or 1)
    layout = _layout(file, options, start)
    for number in range(1, table):
        end = None if layout is None else _find_break(file, layout)
        following = None if end is None or layout is None else _next_layout(file, options, layout, end)
        if following is None:
            raise DataError(f"{file.path}: --table {table}: it has {count_tables(number)}")
        layout = following
    layout = layout or header_only(_sample(file, start), options, start)
    if layout is None:
        raise DataError(f"{file.path}: is empty; expected a header line with column names, or numbers")
    places = (
        [find_place(file.path, layout.heads, layout.columns, name) for name in names]
        if _fits(layout)
        else [_place_by_number(file, layout, name) for name in names]
    )
    body = _Body(file, layout, names, places)
    after: tuple[str, ...] = ()
    try:
        values = body.at_once()
    except (_BreakError, ValueError):
        body.end = _find_break(file, layout)
        if body.end is not None:
            after = _what_follows(file, options, layout, body.end)
        try:
            values = body.at_once()
        except (_BreakError, ValueError):
            values = body.cell_by_cell()
    if not all(np.isfinite(column).all() for column in values):
        values = body.cell_by_cell()
    encoding = file.encoding.removesuffix("-sig")
    comments = layout.comments + body.comments
    notes = (
        *(["gzip"] if file.compressed else []),
        *([encoding.upper() if encoding.startswith("utf") else encoding] if encoding != "utf-8" else []),
        *([f"table {table}"] if options.table else []),
        *layout.notes,
        *([count_lines(comments, "of comment")] if comments else []),
        *after,
    )
    units = [layout.heads[place].unit if place < len(layout.heads) else "" for place in places]
    return ReadColumns(values, units, notes)


def count_tables(number: int) -> str:
    """Return a number of tables for people."""
    return f"{number} table{'s' * (number != 1)}"


class _Body:
    """The data of a table.

    Attributes
    ----------
    end : int or None
        Number of lines up to the end of the table.
    comments : int
        Number of lines of comment within it.
    """

    def __init__(self, file: TextFile, layout: Layout, names: Sequence[str], places: Sequence[int]) -> None:
        self._file, self._layout, self._names, self._places = file, layout, names, places
        self.end: int | None = None
        self.comments = 0

    def at_once(self) -> list[Floats]:
        """Return the columns by numpy's reader, shape (rows,) each.

        Raises ValueError or _BreakError if cells are not all numbers.
        """
        layout = self._layout
        if layout.decimal == layout.delimiter:
            raise ValueError("cells are in quotes")
        lines = self._lines()
        first = next(lines, None)
        if first is None:
            return [np.empty(0) for _ in self._places]
        wanted = sorted(set(self._places))
        array = np.loadtxt(
            itertools.chain([first], lines),
            delimiter=None if layout.delimiter == " " else layout.delimiter,
            usecols=wanted,
            comments=None,
            quotechar='"',
            ndmin=2,
        )
        return [np.ascontiguousarray(array[:, wanted.index(place)]) for place in self._places]

    def cell_by_cell(self) -> list[Floats]:
        """Return the columns by looking at each cell.

        Raises DataError that names the first that is not a finite number.
        """
        layout, path = self._layout, self._file.path
        values: list[list[float]] = [[] for _ in self._places]
        lines = self._file.lines(layout.start, self.end)
        for number, row in enumerate(split_rows(lines, layout.delimiter, layout.start), start=1):
            for name, place, column in zip(self._names, self._places, values, strict=True):
                cell = row.cells[place].strip() if place < len(row.cells) else ""
                where = f"{path}: line {row.line}, row {number}, column {name}"
                column.append(finite_number(where, cell, layout.decimal, _remedy(cell, layout)))
        return [np.array(column, dtype=np.float64) for column in values]

    def _lines(self) -> Iterator[str]:
        """Yield the lines of data as numpy reads numbers.

        Raises _BreakError where what follows may be another table.
        """
        marks, comma = self._layout.marks, self._layout.decimal == ","
        self.comments = blank = 0
        for line in self._file.lines(self._layout.start, self.end):
            if line.isspace():
                blank += 1
                continue
            if is_comment(line, marks):
                if blank:
                    raise _BreakError
                self.comments += 1
                continue
            if blank > 1:
                raise _BreakError
            blank = 0
            # A point within numbers of decimal comma is none; it may not become one.
            yield line.replace(".", "?").replace(",", ".") if comma else line


def _remedy(cell: str, layout: Layout) -> str:
    """Return what may help with a cell that is not a number; may be empty."""
    other = "," if layout.decimal == "." else "."
    if is_number(cell, other):
        return f"; if its decimal sign is a {'comma' if other == ',' else 'point'}, say --decimal {other}"
    if any(is_number(cell.replace(sign, ""), layout.decimal) for sign in ",.'’ \xa0\u202f" if sign in cell):
        return "; separators of thousands are not read"
    parts = [delimiter for delimiter in "\t;, " if delimiter in cell]
    if any(is_number(part, layout.decimal) for delimiter in parts for part in cell.split(delimiter)):
        return "; the file may have another delimiter (--delimiter) or lines above the data (--skip-lines)"
    return "; lines above the data are left out by --skip-lines"


def _sample(file: TextFile, start: int) -> list[str]:
    lines: list[str] = []
    characters = 0
    for line in file.lines(start, start + SAMPLE_LINES):
        if len(lines) == 0:
            line = line.removeprefix("\ufeff")
        lines.append(line)
        characters += len(line)
        if characters > SAMPLE_CHARACTERS:
            break
    return lines


def _layout(file: TextFile, options: ReadingOptions, start: int) -> Layout | None:
    return find_layout(file.path, _sample(file, start), options, start)


def _next_layout(file: TextFile, options: ReadingOptions, layout: Layout, start: int) -> Layout | None:
    """Return the layout of the table behind another, preferably with its delimiter and decimal sign."""
    like = replace(options, delimiter=layout.delimiter, decimal=layout.decimal)
    return _layout(file, like, start) or _layout(file, options, start)


def _fits(layout: Layout) -> bool:
    return bool(layout.heads) or "no header" in layout.notes


def _place_by_number(file: TextFile, layout: Layout, name: str) -> int:
    if name.isdecimal() and 1 <= int(name) <= layout.columns:
        return int(name) - 1
    raise DataError(
        f"{file.path}: line {layout.start}: the header does not fit the {layout.columns} columns below it, so "
        f"there is no column {name!r}; name columns by number, 1 to {layout.columns}, or say --delimiter, --decimal "
        "or --skip-lines"
    )


def _find_break(file: TextFile, layout: Layout) -> int | None:
    """Return the number of lines up to the end of a table, where something else follows; None if nothing does.

    A table ends before a row without numbers that follows a blank line, has another number of cells or repeats the
    header; before a comment after a blank line; and before two blank lines.
    """
    marks = layout.marks
    heads = [head.text for head in layout.heads]
    blank, begun = 0, False
    for number, line in enumerate(file.lines(layout.start), start=layout.start):
        if line.isspace():
            blank += 1
            continue
        if is_comment(line, marks):
            if blank and begun:
                return number
            continue
        if begun and blank > 1:
            return number
        cells = next((row.cells for row in split_rows([line], layout.delimiter)), [])
        if any(is_number(cell, layout.decimal) for cell in cells):
            begun = True
        elif begun and cells:
            texts = [cell.strip() for cell in cells]
            # A column of remarks may be empty in all rows that were looked at, and so not count as one.
            if blank or len(cells) not in (layout.columns, len(heads)) or texts == heads[: len(texts)]:
                return number
        blank = 0
    return None


def _what_follows(file: TextFile, options: ReadingOptions, layout: Layout, end: int) -> tuple[str, ...]:
    """Return a note of the lines behind a table.

    Raises DataError if they are another table, and none was chosen.
    """
    following = _next_layout(file, options, layout, end)
    if following is None:
        rest = sum(not line.isspace() and not is_comment(line, layout.marks) for line in file.lines(end))
        return (f"{count_lines(rest, 'below the table')} left out",) if rest else ()
    if options.table is not None:
        return ()
    starts = [layout.start + 1]
    next_end: int | None = end
    while following is not None and len(starts) < _MOST_TABLES:
        starts.append(following.start + 1)
        next_end = _find_break(file, following)
        following = None if next_end is None else _next_layout(file, options, following, next_end)
    many = "at least " * (following is not None)
    raise DataError(
        f"{file.path}: has {many}{count_tables(len(starts))}, whose data begin in the lines "
        f"{', '.join(map(str, starts))}; choose one with --table, 1 to {len(starts)}"
    )
