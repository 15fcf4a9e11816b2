"""Columns of a spreadsheet (.xlsx, .xls, .xlsb, .ods): each sheet is read as a table of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from bench.analysis.tables.reading.layout import MUCH_LONGER, delimited
from bench.analysis.tables.reading.library_files import load_contents
from bench.analysis.tables.reading.options import OF_ALL, ReadingOptions
from bench.analysis.tables.reading.table import ReadColumns
from bench.analysis.tables.reading.text import TextLines
from bench.analysis.tables.reading.text_table import read_tables
from bench.base import DataError

_TABS = delimited("\t")


def read_spreadsheet(
    path: Path, names: Sequence[str], options: ReadingOptions, times: Sequence[str] = ()
) -> ReadColumns:
    """Read columns of a sheet: the one long one, or the one that `options.table` names or numbers.

    A table of a sheet of several is chosen by `SHEET:NUMBER`.

    Raises DataError if the file cannot be read, a column is missing, or a cell is not a finite number: names sheet
    and line; ConfigurationError if an option does not apply, or the library for spreadsheets is not installed.
    """
    options.check_only(path, "a spreadsheet", "table", "skip_lines", *OF_ALL)
    sheets, _ = load_contents(path, "spreadsheet")
    title, table, chosen = _choose(path, sheets, options.table)
    sheet = TextLines(
        Path(f"{path}: sheet {title}"), "utf-8", compressed=False, choice=f"{title}:", content=sheets[title]
    )
    found = read_tables(sheet, names, replace(options, table=table, delimiter="\t", decimal="."), times)
    notes = (note for note in found.notes if note not in (_TABS, "one column"))
    return replace(found, notes=(f"sheet {title}{chosen}", *notes))


def _choose(path: Path, sheets: Mapping[str, Sequence[str]], table: str | None) -> tuple[str, str | None, str]:
    """Return the title of a sheet, the number of a table in it, and how the sheet was chosen, for people."""
    titles = list(sheets)
    widths = [max((len(row.split("\t")) for row in rows), default=0) for rows in sheets.values()]
    sizes = zip(sheets.items(), widths, strict=True)
    listed = ", ".join(f"{title} ({len(rows)} × {width})" for (title, rows), width in sizes)
    if table is None:
        longest = max(titles, key=lambda title: len(sheets[title]), default="")
        others = [len(rows) for title, rows in sheets.items() if title != longest]
        if not titles or MUCH_LONGER * max(others, default=0) > len(sheets[longest]):
            raise DataError(f"{path}: has {len(titles)} sheets: {listed}; choose one with --format table=N")
        return longest, None, f", the longest of {len(titles)}" if others else ""
    sheet, _, last = table.rpartition(":")
    for name, number in ((table, None), (sheet, last)):
        if name in titles:
            return name, number, ""
        if name.isdecimal() and int(name) <= len(titles):
            return titles[int(name) - 1], number, ""
    raise DataError(f"{path}: --format table={table}: there is no such sheet; it has: {listed}")
