"""Tables of a text file: where each begins and ends, and what stands below it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

from bench.analysis.tables.reading.layout import (
    SAMPLE_CHARACTERS,
    SAMPLE_LINES,
    Layout,
    count_lines,
    find_layout,
    is_comment,
    is_number,
    split_rows,
)
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.summary_rows import TextRows
from bench.analysis.tables.reading.text import TextFile
from bench.base import DataError

_MOST_TABLES = 9
"""Tables that a message lists."""


@dataclass(frozen=True)
class Ending:
    """End of a table.

    Attributes
    ----------
    end : int or None
        Number of lines up to it; None if nothing follows.
    rest : int
        Number of lines up to what follows the rows of a summary.
    within : tuple of int
        Lines of the table that have a text in a column of numbers.
    """

    end: int | None
    rest: int
    within: tuple[int, ...]


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


def walk_tables(file: TextFile, options: ReadingOptions, most: int | None = None) -> Iterator[Layout]:
    """Yield the layouts of the tables, as `--table` counts them; those in the first `most` lines, if given."""
    options = replace(options, table=options.table or "1")
    layout = find_layout(file.path, read_sample(file, options.skip_lines), options, options.skip_lines)
    while layout is not None:
        yield layout
        ending = find_end(file, layout, most=most)
        layout = None if ending.end is None else _next_layout(file, options, layout, ending.rest)


def find_end(file: TextFile, layout: Layout, asked: Collection[int] = (), most: int | None = None) -> Ending:
    """Find where a table ends, because something else follows.

    A table ends before a row without numbers that follows a blank line, has another number of cells or repeats the
    header; before a comment after a blank line; before two blank lines; and before the rows of a summary, unless
    other rows follow.

    Parameters
    ----------
    file : TextFile
        The file.
    layout : Layout
        That of the table.
    asked : collection of int
        Indices of the columns that are asked for.
    most : int, optional
        Number of lines of the file that are looked at.
    """
    heads = [head.text for head in layout.heads]
    rows = TextRows(layout.figures, layout.decimal, asked)
    blank, begun, number = 0, False, layout.start
    apart: int | None = None
    for number, line in enumerate(file.lines(layout.start, most), start=layout.start):
        if line.isspace():
            blank += 1
            continue
        if is_comment(line, layout.marks):
            if blank and begun:
                return _ending(rows, number, apart)
            continue
        cells = next((row.cells for row in split_rows([line], layout.delimiter)), [])
        has_numbers = any(is_number(cell, layout.decimal) for cell in cells)
        if begun and cells and not has_numbers and _breaks(cells, blank, layout, heads):
            return _ending(rows, number, apart)
        labelled = bool(cells) and rows.add(number + 1, cells)
        if begun and blank > 1 and apart is None:
            # A summary, or names and values above another table.
            apart = number
        if apart is not None and not labelled:
            return Ending(apart, apart, tuple(rows.within))
        begun = begun or has_numbers
        blank = 0
    return _ending(rows, None, None, number + 1)


def _breaks(cells: list[str], blank: int, layout: Layout, heads: list[str]) -> bool:
    """Return whether a row without numbers is not one of the table."""
    texts = [cell.strip() for cell in cells]
    # A column of remarks may be empty in all rows that were looked at, and so not count as one.
    return bool(blank) or len(cells) not in (layout.columns, len(heads)) or texts == heads[: len(texts)]


def _ending(rows: TextRows, number: int | None, apart: int | None, lines: int = 0) -> Ending:
    """Return the end before line `number`, from 0, or of the file, which has so many lines."""
    if apart is not None:
        return Ending(apart, apart, tuple(rows.within))
    summary = rows.close()
    end = summary[0] - 1 if summary else number
    return Ending(end, lines if number is None else number, tuple(rows.within))


def _next_layout(file: TextFile, options: ReadingOptions, layout: Layout, start: int) -> Layout | None:
    """Return the layout of the table behind another, preferably with its delimiter and decimal sign."""
    like = replace(options, delimiter=layout.delimiter, decimal=layout.decimal)
    lines = read_sample(file, start)
    return find_layout(file.path, lines, like, start) or find_layout(file.path, lines, options, start)


def note_rest(file: TextFile, options: ReadingOptions, layout: Layout, ending: Ending) -> tuple[str, ...]:
    """Return a note of the lines behind a table.

    Raises DataError if they are another table, and none was chosen.
    """
    if ending.end is None:
        return ()
    another = _next_layout(file, options, layout, ending.rest) is not None
    if another and options.table is None:
        starts, many = table_starts(file, options)
        raise DataError(f"{file.path}: has {many}; choose one with --table, 1 to {starts}")
    lines = file.lines(ending.end, ending.rest if another else None)
    rest = sum(not line.isspace() and not is_comment(line, layout.marks) for line in lines)
    return (f"{count_lines(rest, 'below the table')} left out",) if rest else ()


def table_starts(file: TextFile, options: ReadingOptions, most: int | None = None) -> tuple[int, str]:
    """Return the number of tables, and for people also where they begin; see `walk_tables` for `most`."""
    starts: list[int] = []
    more = False
    for layout in walk_tables(file, options, most):
        more = len(starts) == _MOST_TABLES
        if more:
            break
        starts.append(layout.start + 1)
    lines = ", ".join(map(str, starts))
    return len(starts), f"{'at least ' * more}{count_tables(len(starts))}, whose data begin in the lines {lines}"


def count_tables(number: int) -> str:
    """Return a number of tables for people."""
    return f"{number} table{'s' * (number != 1)}"
