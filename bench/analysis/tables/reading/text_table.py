"""Columns of a table of text: numpy reads them at once; what it cannot read is looked at cell by cell."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from bench.analysis.tables.reading.formats import check_format
from bench.analysis.tables.reading.heads import NoColumnError, find_place, with_times
from bench.analysis.tables.reading.layout import (
    D_EXPONENTS,
    Layout,
    closes_its_quotes,
    delimited,
    find_layout,
    header_only,
    is_comment,
    is_number,
    other_heads,
    split_rows,
)
from bench.analysis.tables.reading.moments import moment_in, since_first, with_moments
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.remedies import cell_remedy, is_cut_off, missing_column
from bench.analysis.tables.reading.reshaped import StampedFile, split_stamps, turn_rows
from bench.analysis.tables.reading.table import ReadColumns
from bench.analysis.tables.reading.tables import (
    Ending,
    choose_tables,
    find_end,
    is_label,
    list_tables,
    note_rest,
    read_sample,
    text_note,
    walk_tables,
)
from bench.analysis.tables.reading.text import TextFile, open_text
from bench.base import ConfigurationError, DataError, Floats, counted

_LETTER = re.compile(r"[^\x00-@E\[-`e{-\x7f]")
"""A letter but for that of an exponent."""

_D_EXPONENT = re.compile(r"(\d*\.\d*)[dD](?=[+-]?\d)")


class _BreakError(Exception):
    """Lines that may not be of the table."""


class _SeveralError(Exception):
    """Another table follows."""


def read_text(path: Path, names: Sequence[str], options: ReadingOptions, times: Sequence[str] = ()) -> ReadColumns:
    """Read columns of a text file, perhaps compressed by gzip, and the first of `times` that is there.

    Raises DataError if the file cannot be read, is ambiguous, or a cell is not a finite number: names line and
    option; ConfigurationError if `options.table` is not a number.
    """
    if options.table is not None and not options.table.isdecimal():
        raise ConfigurationError(f"--format table={options.table}: the tables of a text file have numbers, from 1")
    file = split_stamps(open_text(path, options.encoding), options)
    check_format(path, read_sample(file, options.skip_lines))
    try:
        found = read_tables(file, names, options, times)
        stamped = ("times of day before ->",) if isinstance(file, StampedFile) else ()
        return replace(found, notes=(*stamped, *found.notes))
    except csv.Error as error:
        raise DataError(f"{path} cannot be read as a table: {error}") from None


def read_tables(file: TextFile, names: Sequence[str], options: ReadingOptions, times: Sequence[str]) -> ReadColumns:
    """Read columns of the table that is meant, or of those of equal heads, joined; see `read_text`."""
    if turned := turn_rows(file, options):
        file, options, notes = turned
        found = read_tables(file, names, options, times)
        return replace(found, notes=(*notes, *(note for note in found.notes if note != delimited("\t"))))
    lines = read_sample(file, options.skip_lines)
    layout = _find_table(file, options, lines)
    try:
        return _read_table(file, layout, names, options, times, lines)
    except (NoColumnError, _SeveralError) as error:
        tables = list(walk_tables(file, options)) if options.table is None else []
        chosen = choose_tables(file, tables) if tables else None
        if chosen is None and isinstance(error, _SeveralError):
            raise DataError(
                f"{file.path}: has {list_tables(tables)}; choose one with --format table=N, {file.choice}1 to "
                f"{file.choice}{len(tables)}"
            ) from None
        if chosen is None or (isinstance(error, NoColumnError) and chosen[0][0].layout == layout):
            raise
    parts = [_read_table(file, table.layout, names, options, times, lines, table.ending) for table in chosen[0]]
    first, values = parts[0], zip(*(part.values for part in parts), strict=True)
    notes = (*first.notes, chosen[1]) if len(tables) > 1 else first.notes
    return ReadColumns(first.names, [np.concatenate(column) for column in values], first.units, notes)


def _find_table(file: TextFile, options: ReadingOptions, lines: Sequence[str]) -> Layout:
    """Return the layout of the table that is chosen, or of the first; DataError if there is no such table."""
    start = options.skip_lines
    if options.table is None:
        layout = find_layout(file.path, lines, options, start)
    else:
        tables = list(itertools.islice(walk_tables(file, options), int(options.table)))
        if len(tables) < int(options.table) > 1:
            raise DataError(f"{file.path}: --format table={int(options.table)}: it has {list_tables(tables)}")
        layout = tables[-1].layout if tables else None
    layout = layout or header_only(lines, options, start)
    if layout is None and is_cut_off(lines):
        raise DataError(
            f"{file.path}: has neither a header nor numbers in {len(lines)} lines from line {start + 1}; leave out "
            "the lines above the table with --format skip=N"
        )
    if layout is None:
        raise DataError(f"{file.path}: is empty; expected a header line with column names, or numbers")
    return layout


def _read_table(
    file: TextFile,
    layout: Layout,
    names: Sequence[str],
    options: ReadingOptions,
    times: Sequence[str],
    lines: Sequence[str],
    ending: Ending | None = None,
) -> ReadColumns:
    """Read columns of a table; _SeveralError if its end is unknown and other tables follow."""
    row = next(split_rows(lines[layout.start - options.skip_lines :], layout.delimiter), None) if times else None
    moments = with_moments(row.cells, range(len(layout.heads))) if row is not None else ()
    names = with_times(names, times, layout.heads, lambda name: _place(file, layout, name), moments)
    layout, places = _find_places(file, names, options, layout, lines)
    body = _Body(file, layout, names, places, options)
    body.ending = ending
    after: tuple[str, ...] | None = ()
    try:
        values = body.at_once()
    except (_BreakError, DataError, ValueError):
        if ending is None:
            body.ending = find_end(file, layout, places)
            after = note_rest(file, options, layout, body.ending)
            if after is None:
                raise _SeveralError from None
        try:
            values = body.at_once()
        except (_BreakError, DataError, ValueError):
            values = body.cell_by_cell()
    if not all(np.isfinite(column).all() for column in values):
        values = body.cell_by_cell()
    encoding = file.encoding.removesuffix("-sig")
    comments = layout.comments + body.comments
    notes = (
        *(["gzip"] if file.compressed else []),
        *([encoding.upper() if encoding.startswith("utf") else encoding] if encoding != "utf-8" else []),
        *([f"table {int(options.table)}"] if options.table else []),
        *layout.notes,
        *([f"{counted(comments, 'line')} of comment"] if comments else []),
        *(text_note(body.ending.within) if body.ending else []),
        *(after or ()),
    )
    units = [layout.heads[place].unit if place < len(layout.heads) else "" for place in places]
    values, units, remarks = since_first(
        values, units, names, [place in body.moments for place in places], may_be_clocks=True
    )
    return ReadColumns(names, values, units, (*notes, *remarks))


def _find_places(
    file: TextFile, names: Sequence[str], options: ReadingOptions, layout: Layout, lines: Sequence[str]
) -> tuple[Layout, list[int]]:
    """Return the indices of the columns asked for, and the layout whose heads have them; DataError if none does."""
    missing: tuple[NoColumnError, str] | None = None
    above = split_rows(lines[: layout.start - options.skip_lines], layout.delimiter, options.skip_lines)
    for other in (layout, *other_heads(list(above), layout)):
        places: list[int] = []
        for name in names:
            try:
                places.append(_place(file, other, name))
            except NoColumnError as error:
                missing = missing or (error, name)
                break
        else:
            return other, places
    assert missing is not None
    raise missing_column(*missing, file, options, layout, lines)


class _Body:
    """The data of a table: its end if known, its lines of comment, and which columns hold dates and times."""

    def __init__(
        self, file: TextFile, layout: Layout, names: Sequence[str], places: Sequence[int], options: ReadingOptions
    ) -> None:
        self._file, self._layout, self._names, self._places = file, layout, names, places
        self._options = options
        self._width = max(layout.columns, len(layout.heads))
        self.ending: Ending | None = None
        self.comments = 0
        self.moments: frozenset[int] = frozenset()

    def at_once(self) -> list[Floats]:
        """Return the columns by numpy's reader; ValueError, DataError or _BreakError if it cannot."""
        layout = self._layout
        if layout.decimal == layout.delimiter:
            raise ValueError("cells are in quotes")
        lines = self._lines()
        first = next(lines, None)
        if first is None:
            return [np.empty(0) for _ in self._places]
        wanted = sorted(set(self._places))
        row = next(split_rows([first], layout.delimiter), None)
        self.moments = with_moments(row.cells, wanted) if row is not None else frozenset()
        array = np.loadtxt(
            itertools.chain([first], lines),
            delimiter=None if layout.delimiter == " " else layout.delimiter,
            usecols=wanted,
            comments=None,
            quotechar='"',
            ndmin=2,
            converters={place: partial(moment_in, "") for place in self.moments} or None,
        )
        return [np.ascontiguousarray(array[:, wanted.index(place)]) for place in self._places]

    def cell_by_cell(self) -> list[Floats]:
        """Return the columns cell by cell; DataError names the first that is not a finite number."""
        layout, path = self._layout, self._file.path
        values: list[list[float]] = [[] for _ in self._places]
        lines = self._closed(self._file.lines(layout.start, self._end()))
        for number, row in enumerate(split_rows(lines, layout.delimiter, layout.start), start=1):
            beyond = row.cells[self._width :]
            # Between blanks a text may be a part of the cell before it.
            if any(layout.delimiter == " " or is_number(cell, layout.decimal) for cell in beyond):
                raise DataError(
                    f"{path}: line {row.line}, row {number}: has {len(row.cells)} cells; the table has {self._width} "
                    "columns, so that its numbers may stand in the wrong ones; remove what is too much"
                )
            if number == 1:
                self.moments = with_moments(row.cells, self._places)
            for name, place, column in zip(self._names, self._places, values, strict=True):
                cell = row.cells[place].strip() if place < len(row.cells) else ""
                where = f"{path}: line {row.line}, row {number}, column {name}"
                column.append(self._number(where, cell, place, row.line, first=not column))
        return [np.array(column, dtype=np.float64) for column in values]

    def _number(self, where: str, cell: str, place: int, line: int, *, first: bool) -> float:
        if self._options.is_missing(cell):
            return math.nan
        if place in self.moments:
            return moment_in(where, cell)
        decimal = self._layout.decimal
        if not cell:
            wrong = "is empty; expected a number"
        elif not is_number(cell, decimal):
            wrong = f"{cell if len(cell) < 40 else f'{cell[:40]}…'!r} is not a number"
        else:
            value = float((cell.replace(",", ".") if decimal == "," else cell).upper().replace("D", "E"))
            if math.isfinite(value):
                return value
            wrong = f"{cell[:40]} is not a finite number"
        remedy = cell_remedy(cell, self._layout, self._options, place, line, first=first)
        raise DataError(f"{where}: {wrong}{remedy}")

    def _end(self) -> int | None:
        return None if self.ending is None else self.ending.end

    def _lines(self) -> Iterator[str]:
        """Yield the lines of data as numpy reads numbers; _BreakError where what follows may not be of the table."""
        marks, comma = self._layout.marks, self._layout.decimal == ","
        exponents = D_EXPONENTS in self._layout.notes
        self.comments = blank = 0
        for line in self._closed(self._file.lines(self._layout.start, self._end())):
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
            if self.ending is None and _LETTER.search(line) and self._has_label(line):
                raise _BreakError
            if self._is_longer(line):
                raise ValueError("more cells than columns")
            if comma:
                # A point within numbers of decimal comma is none; it may not become one.
                line = line.replace(".", "?").replace(",", ".")
            yield _D_EXPONENT.sub(r"\1E", line) if exponents else line

    def _is_longer(self, line: str) -> bool:
        """Return whether a line may have more cells than the table has columns."""
        delimiter = self._layout.delimiter
        if delimiter == " ":
            return len(line.split()) > self._width
        return (
            line.count(delimiter) >= self._width
            and len(line.rstrip(f"{delimiter} \r\n\t").split(delimiter)) > self._width
        )

    def _closed(self, lines: Iterator[str]) -> Iterator[str]:
        """Yield lines of data; raise DataError for a quote that opens a cell and does not close it in its line."""
        layout = self._layout
        for number, line in enumerate(lines, start=layout.start + 1):
            if not closes_its_quotes(line, layout.delimiter) and not is_comment(line, layout.marks):
                raise DataError(
                    f"{self._file.path}: line {number}: a quotation mark opens a cell and does not close it before "
                    "the next delimiter or the end of the line; remove it, or close it"
                )
            yield line

    def _has_label(self, line: str) -> bool:
        """Return whether a line may have a label in a column of numbers, dates or times."""
        cells = line.split(None if self._layout.delimiter == " " else self._layout.delimiter)
        for place in self._layout.figures:
            # Most cells begin with a digit.
            if place < len(cells) and not cells[place][:1].isdigit() and is_label(cells[place], self._layout.decimal):
                return True
        return False


def _place(file: TextFile, layout: Layout, name: str) -> int:
    if layout.heads or "no header" in layout.notes:
        return find_place(file.path, layout.heads, layout.columns, name)
    if name.isdecimal() and 1 <= int(name) <= layout.columns:
        return int(name) - 1
    raise NoColumnError(
        f"{file.path}: line {layout.start}: the header does not fit the {layout.columns} columns below it, so "
        f"there is no column {name!r}; name columns by number, 1 to {layout.columns}, or say "
        "--format delimiter=CHARACTER, decimal=SIGN or skip=N"
    )
