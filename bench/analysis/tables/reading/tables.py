"""Tables of a text file: where each begins and ends, the rows of a summary below it, and what else stands there."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

from bench.analysis.tables.reading.layout import (
    MUCH_LONGER,
    SAMPLE_CHARACTERS,
    SAMPLE_LINES,
    Layout,
    find_layout,
    is_comment,
    is_number,
    split_rows,
)
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.text import TextFile
from bench.base import DataError, counted

_MISSING = frozenset(
    (
        "n/a", "na", "n.a.", "none", "null", "nil", "missing", "invalid", "fault", "err", "error", "nodata",
        "ovld", "ovl", "ovf", "ovrng", "ovrflw", "overload", "overflow", "overrange", "over", "under", "ol", "o.l.",
        "no data", "open", "inop",
    )
)  # fmt: skip
"""What instruments write for a value that is missing; a row with it is one of the data."""

_MOST_ROWS = 20
"""Rows of a summary."""


def is_label(cell: str, decimal: str) -> bool:
    """Return whether a cell is a text that names what stands beside it."""
    cell = cell.strip().strip('"')
    return cell[:1].isalpha() and cell.casefold() not in _MISSING and not is_number(cell, decimal)


class TextRows:
    """Rows of a table that have a label where there are numbers, dates or times as a rule.

    Those at its end are a summary; the others stay.

    `figures` are the indices of the columns of numbers, dates and times; `asked` those of the columns that are asked
    for. A label in one of the latter is a wrong cell, unless it begins the row.
    """

    def __init__(self, figures: Collection[int], decimal: str, asked: Collection[int] = ()) -> None:
        self._figures, self._decimal, self._asked = set(figures), decimal, set(asked)
        self._begun = False
        self._last: list[int] = []
        self._mixed: set[int] = set()
        self.within: list[int] = []

    def add(self, line: int, cells: Sequence[str]) -> bool:
        """Add the next row; return whether it has a label."""
        labels = {place for place in self._figures if place < len(cells) and is_label(cells[place], self._decimal)}
        if labels and next(place for place, cell in enumerate(cells) if cell.strip()) not in labels:
            labels -= self._asked
            self._mixed |= labels
        if labels:
            self._last.append(line)
            return True
        self.within += self._last
        if self._last:
            # A column of numbers and remarks; a remark in its last row is no summary.
            self._figures -= self._mixed
        self._begun, self._last, self._mixed = True, [], set()
        return False

    def close(self) -> list[int]:
        """Return the lines of the summary at the end of the table; may be empty."""
        if self._begun and len(self._last) <= _MOST_ROWS:
            return self._last
        self.within += self._last
        return []


def text_note(lines: Sequence[int]) -> list[str]:
    """Return a note of lines within a table that have a label; none without any."""
    if not lines:
        return []
    if len(lines) == 1:
        return [f"text in a column of numbers in line {lines[0]}"]
    return [f"text in columns of numbers in {len(lines)} lines, first in line {lines[0]}"]


_NAME_AND_VALUE = re.compile(r"\s*[^\W\d][^:=\t,;]*[:=]\s*\S.*")
"""A line such as `PMax: 19.8`."""

_MOST_LINES_BELOW = 20
"""Names and values below a table, of which no more are no table."""


@dataclass(frozen=True)
class Ending:
    """End of a table."""

    end: int | None  # number of lines up to it; None if nothing follows
    rest: int  # number of lines up to what follows the rows of a summary
    within: tuple[int, ...]  # lines of the table that have a text in a column of numbers
    rows: int  # number of rows


@dataclass(frozen=True)
class Table:
    """A table: its layout and its end."""

    layout: Layout
    ending: Ending


def read_sample(file: TextFile, start: int) -> list[str]:
    """Return the lines from number `start`, from 0, that are looked at to find a layout."""
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


def walk_tables(file: TextFile, options: ReadingOptions, most: int | None = None) -> Iterator[Table]:
    """Yield the tables, as `--format table=N` counts them; those in the first `most` lines, if given."""
    options = replace(options, table=options.table or "1")
    layout = find_layout(file.path, read_sample(file, options.skip_lines), options, options.skip_lines)
    while layout is not None:
        ending = find_end(file, layout, most=most)
        yield Table(layout, ending)
        layout = None if ending.end is None else _next_layout(file, options, layout, ending.rest)


def choose_tables(file: TextFile, tables: Sequence[Table]) -> tuple[list[Table], str] | None:
    """Return the tables that are meant where none was chosen, and a note; None if that is not clear.

    They are the one long table among short ones, with those of equal heads, which are segments of one record, and so
    are long ones of as many columns without heads.
    """
    longest = max(tables, key=lambda table: table.ending.rows)
    heads = next((table.layout.heads for table in tables if _is_like(table, longest) and table.layout.heads), ())
    few = longest.ending.rows / MUCH_LONGER
    equal = [
        table
        for table in tables
        if table is longest
        or (heads and _is_like(table, longest) and (table.layout.heads or table.ending.rows > few))
    ]
    short = [table for table in tables if table not in equal]
    if any(table.ending.rows > few for table in short):
        return None
    first = equal[0].layout
    others = sum(1 for _ in split_rows(file.lines(first.start), first.delimiter))
    others -= sum(table.ending.rows for table in equal)
    others += sum(table.ending.rows for table in short if table.layout.start < first.start)
    many = f"{len(equal)} of {len(tables)} tables, of equal columns, joined in order"
    note = many if len(equal) > 1 else f"the longest of {len(tables)} tables"
    chosen = [replace(table, layout=replace(table.layout, heads=heads)) for table in equal]
    return chosen, f"{note}, {counted(others, 'line')} beside them left out" if others else note


def _is_like(table: Table, other: Table) -> bool:
    """Return whether a table may be a segment of the record of another."""
    one, two = table.layout, other.layout
    same = (one.numbers, one.delimiter, one.decimal) == (two.numbers, two.delimiter, two.decimal)
    return same and (not one.heads or not two.heads or one.heads == two.heads)


def find_end(file: TextFile, layout: Layout, asked: Collection[int] = (), most: int | None = None) -> Ending:
    """Find where a table ends, because something else follows.

    A table ends before a row without numbers that follows a blank line, has another number of cells or repeats the
    header; before a comment after a blank line; before two blank lines; and before the rows of a summary, unless
    other rows follow.

    `asked` are the indices of the columns that are asked for; no more than `most` lines are looked at, if given.
    """
    heads = [head.text for head in layout.heads]
    rows = TextRows(layout.figures, layout.decimal, asked)
    blank, begun, number, count = 0, False, layout.start, 0
    apart: tuple[int, int] | None = None
    for number, line in enumerate(file.lines(layout.start, most), start=layout.start):
        if line.isspace():
            blank += 1
            continue
        if is_comment(line, layout.marks):
            if blank and begun:
                return _ending(rows, number, apart, count)
            continue
        cells = next((row.cells for row in split_rows([line], layout.delimiter)), [])
        has_numbers = any(is_number(cell, layout.decimal) for cell in cells)
        if begun and cells and not has_numbers and _breaks(cells, blank, layout, heads):
            return _ending(rows, number, apart, count)
        labelled = bool(cells) and rows.add(number + 1, cells)
        if begun and blank > 1 and apart is None:
            # A summary, or names and values above another table.
            apart = number, count
        if apart is not None and not labelled:
            break
        count += bool(cells)
        begun = begun or has_numbers
        blank = 0
    else:
        return _ending(rows, None, None, count, number + 1)
    return _ending(rows, None, apart, count)


def _breaks(cells: list[str], blank: int, layout: Layout, heads: list[str]) -> bool:
    """Return whether a row without numbers is not one of the table."""
    texts = [cell.strip() for cell in cells]
    # A column of remarks may be empty in all rows that were looked at, and so not count as one.
    return bool(blank) or len(cells) not in (layout.columns, len(heads)) or texts == heads[: len(texts)]


def _ending(rows: TextRows, number: int | None, apart: tuple[int, int] | None, count: int, lines: int = 0) -> Ending:
    """Return the end before line `number`, from 0, or of the file, which has so many lines."""
    if apart is not None:
        return Ending(apart[0], apart[0], tuple(rows.within), apart[1])
    summary = rows.close()
    end = summary[0] - 1 if summary else number
    return Ending(end, lines if number is None else number, tuple(rows.within), count - len(summary))


def _next_layout(file: TextFile, options: ReadingOptions, layout: Layout, start: int) -> Layout | None:
    """Return the layout of the table behind another, preferably with its delimiter and decimal sign."""
    lines = read_sample(file, start)
    filled = [line for line in lines if not line.isspace()]
    if len(filled) <= _MOST_LINES_BELOW and all(map(_NAME_AND_VALUE.fullmatch, map(str.rstrip, filled))):
        return None
    like = find_layout(file.path, lines, replace(options, delimiter=layout.delimiter, decimal=layout.decimal), start)
    try:
        other = find_layout(file.path, lines, options, start)
    except DataError:
        return like
    found = [each for each in (like, other) if each is not None]
    return min(found, key=lambda each: each.start, default=None)


def note_rest(file: TextFile, options: ReadingOptions, layout: Layout, ending: Ending) -> tuple[str, ...] | None:
    """Return a note of the lines behind a table; None if they are another table, and none was chosen."""
    if ending.end is None:
        return ()
    another = _next_layout(file, options, layout, ending.rest) is not None
    if another and options.table is None:
        return None
    lines = file.lines(ending.end, ending.rest if another else None)
    rest = sum(not line.isspace() and not is_comment(line, layout.marks) for line in lines)
    return (f"{counted(rest, 'line')} below the table left out",) if rest else ()


def list_tables(tables: Sequence[Table]) -> str:
    """Return the number of tables, and the place and size of each, for people."""
    sizes = [
        f"{number} from line {table.layout.start + 1} ({table.ending.rows} × {table.layout.columns})"
        for number, table in enumerate(tables, start=1)
    ]
    return f"{counted(len(tables), 'table')}, of rows × columns: {', '.join(sizes)}"
