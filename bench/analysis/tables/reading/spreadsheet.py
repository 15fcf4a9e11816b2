"""Columns of a spreadsheet (.xlsx)."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.analysis.tables.reading.heads import find_place, with_times
from bench.analysis.tables.reading.layout import SAMPLE_LINES, Header, Row, count_lines, find_header
from bench.analysis.tables.reading.moments import moment_in, since_first, with_moments
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.summary_rows import TextRows, text_note
from bench.analysis.tables.reading.table import NO_ROW_LEFT_OUT, OTHER_COLUMN, ReadColumns, finite_number
from bench.analysis.tables.reading.text import reading_errors
from bench.base import DataError, needed_for


def read_spreadsheet(
    path: Path, names: Sequence[str], options: ReadingOptions, times: Sequence[str] = ()
) -> ReadColumns:
    """Read columns of a sheet: the only one, or the one that `options.table` names or numbers.

    Raises
    ------
    DataError
        If the file cannot be read, a column is missing, or a cell is not a finite number: names sheet and row.
    ConfigurationError
        If an option does not apply.
    MissingExtraError
        If the library for spreadsheets is not installed.
    """
    options.check_only(path, "a spreadsheet", "table", "skip_lines")
    with needed_for("reading a spreadsheet", "spreadsheet"):
        import openpyxl
        from openpyxl.utils.exceptions import InvalidFileException
    with reading_errors(path), path.open("rb") as file:
        try:
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            sheets = {sheet.title: sheet for sheet in book.worksheets}
            title = _choose(path, list(sheets), options.table)
            rows = [
                Row(number, ["" if cell is None else str(cell) for cell in cells])
                for number, cells in enumerate(sheets[title].iter_rows(values_only=True), start=1)
            ]
        except (InvalidFileException, zipfile.BadZipFile, KeyError, ValueError, TypeError, SyntaxError) as error:
            raise DataError(f"{path} cannot be read as a spreadsheet: {error}") from None
        finally:
            if "book" in locals():
                book.close()
    for row in rows:
        while row.cells and not row.cells[-1].strip():
            row.cells.pop()
    rows = [row for row in rows if row.line > options.skip_lines and row.cells]
    header = find_header(rows[:SAMPLE_LINES], ".")
    if header is None:
        raise DataError(f"{path}: sheet {title}: has no numbers")
    names = with_times(names, times, header.heads, lambda name: find_place(path, header.heads, header.columns, name))
    places = [find_place(path, header.heads, header.columns, name) for name in names]
    values: list[list[float]] = [[] for _ in names]
    body, remarks = _without_summary([row for row in rows if row.line > header.start], header, places)
    moments = with_moments(body[0].cells, places) if body else frozenset()
    for row in body:
        remedy = f"; {NO_ROW_LEFT_OUT}: delete row {row.line} of the sheet, or put a number there"
        for name, place, column in zip(names, places, values, strict=True):
            said = remedy if place in header.numbers else OTHER_COLUMN
            cell = row.cells[place].strip() if place < len(row.cells) else ""
            where = f"{path}: sheet {title}, row {row.line}, column {name}"
            column.append(moment_in(where, cell) if place in moments else finite_number(where, cell, remedy=said))
    above = sum(row.line <= header.start for row in rows) - bool(header.heads) - len(header.notes)
    notes = (
        f"sheet {title}",
        *([count_lines(above, "above the header")] if above > 0 else []),
        *([] if header.heads else ["no header"]),
        *header.notes,
        *remarks,
    )
    units = [header.heads[place].unit if place < len(header.heads) else "" for place in places]
    arrays, units, since = since_first(
        [np.array(column) for column in values], units, names, [place in moments for place in places]
    )
    return ReadColumns(names, arrays, units, (*notes, *since))


def _without_summary(
    rows: Sequence[Row], header: Header, places: Sequence[int]
) -> tuple[Sequence[Row], Sequence[str]]:
    """Return the rows without those of a summary at their end, and notes of rows with text."""
    texts = TextRows(header.figures, ".", places)
    for row in rows:
        texts.add(row.line, row.cells)
    summary = texts.close()
    return (
        [row for row in rows if not summary or row.line < summary[0]],
        [
            *text_note(texts.within, "row"),
            *([f"{len(summary)} row{'s' * (len(summary) != 1)} below the table left out"] if summary else []),
        ],
    )


def _choose(path: Path, titles: Sequence[str], table: str | None) -> str:
    if table is None:
        if len(titles) != 1:
            raise DataError(f"{path}: has {len(titles)} sheets: {', '.join(titles)}; choose one with --table")
        return titles[0]
    if table in titles:
        return table
    if table.isdecimal() and int(table) <= len(titles):
        return titles[int(table) - 1]
    raise DataError(f"{path}: --table {table}: there is no such sheet; it has: {', '.join(titles)}")
