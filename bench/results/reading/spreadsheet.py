"""Columns of a spreadsheet (.xlsx)."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.errors import DataError
from bench.extras import needed_for
from bench.results.reading.heads import find_place
from bench.results.reading.layout import SAMPLE_LINES, Row, count_lines, find_header
from bench.results.reading.options import ReadingOptions
from bench.results.reading.table import ReadColumns, finite_number
from bench.results.reading.text import reading_errors


def read_spreadsheet(path: Path, names: Sequence[str], options: ReadingOptions) -> ReadColumns:
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
    places = [find_place(path, header.heads, header.columns, name) for name in names]
    values: list[list[float]] = [[] for _ in names]
    for row in rows:
        if row.line <= header.start:
            continue
        for name, place, column in zip(names, places, values, strict=True):
            cell = row.cells[place].strip() if place < len(row.cells) else ""
            column.append(finite_number(f"{path}: sheet {title}, row {row.line}, column {name}", cell))
    above = sum(row.line <= header.start for row in rows) - bool(header.heads) - len(header.notes)
    notes = (
        f"sheet {title}",
        *([count_lines(above, "above the header")] if above > 0 else []),
        *([] if header.heads else ["no header"]),
        *header.notes,
    )
    units = [header.heads[place].unit if place < len(header.heads) else "" for place in places]
    return ReadColumns([np.array(column) for column in values], units, notes)


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
