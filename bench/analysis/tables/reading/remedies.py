"""What may help where a cell is no number, or a table has not the column that is asked for."""

from __future__ import annotations

import re
from collections.abc import Sequence

from bench.analysis.tables.reading.heads import NoColumnError, is_unit
from bench.analysis.tables.reading.layout import SAMPLE_LINES, Layout, is_comment, is_number
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.table import OTHER_COLUMN
from bench.analysis.tables.reading.tables import list_tables, walk_tables
from bench.analysis.tables.reading.text import FALLBACK, TextFile

_LOOKED_AT = 5 * SAMPLE_LINES
"""Lines in which other tables are looked for."""

_ENCODINGS = (
    "shift_jis", "gb18030", "big5", "euc_kr", "euc_jp", "cp1251", "koi8_r", "cp1250", "cp1253", "cp1254", "cp437",
    "cp850", "mac_roman",
)  # fmt: skip
"""Those that are tried for a name that is not found."""

_UNIT_BEHIND = re.compile(r"[^\d.,]+$")
"""What may be a unit behind a number."""

_SPELLED = " \t,;|.+-'\"_()[]{}<>"
"""What delimits by itself, or stands within a number or a name."""


def cell_remedy(cell: str, layout: Layout, options: ReadingOptions, place: int, line: int, *, first: bool) -> str:
    """Return what may help with a cell that is not a finite number; `first` if no number stands above it."""
    if place not in layout.numbers and (not cell or is_number(cell, layout.decimal)):
        return OTHER_COLUMN
    if not cell or is_number(cell, layout.decimal):
        return options.missing_remedy(cell)
    other = "," if layout.decimal == "." else "."
    if is_number(cell, other):
        sign = "comma" if other == "," else "point"
        return f"; if its decimal sign is a {sign}, say --format decimal={other}; in a spreadsheet make it a number"
    if is_number(cell.strip("'"), layout.decimal):
        return "; its quotation marks are not those of tables: replace ' by \" in the file"
    if any(is_number(cell.replace(sign, ""), layout.decimal) for sign in ",.'’ \xa0\u202f" if sign in cell):
        return "; separators of thousands are not read: save the file without them"
    if (unit := _UNIT_BEHIND.search(cell)) and is_number(cell[: unit.start()], layout.decimal) and is_unit(unit[0]):
        return f"; save the file without the unit {unit[0].strip()!r} in its cells"
    if cell.startswith("−") and is_number(cell[1:], layout.decimal):
        return "; its minus sign is not that of numbers: replace '−' by '-' in the file"
    mark = _delimiting_mark([cell]) if layout.columns == 1 else None
    if mark is not None:
        return f"; if {mark!r} stands between columns, say --format delimiter={mark}"
    parts = [delimiter for delimiter in "\t;, " if delimiter in cell]
    if first and any(is_number(part, layout.decimal) for delimiter in parts for part in cell.split(delimiter)):
        return "; say --format delimiter=CHARACTER for another delimiter, or --format skip=N for lines above the data"
    if place not in layout.numbers:
        return OTHER_COLUMN + ", or leave out lines above the data with --format skip=N" * first
    if first:
        return f"; if line {line} is above the data, leave it out with --format skip=N{options.missing_remedy(cell)}"
    return options.missing_remedy(cell)


def missing_column(
    error: NoColumnError, name: str, file: TextFile, options: ReadingOptions, layout: Layout, lines: Sequence[str]
) -> NoColumnError:
    """Return the error of a column that a table, whose first lines are given, does not have, with what may help."""
    remedies = [
        _other_delimiter(options, layout, lines),
        _other_encoding(name, file, options, layout, lines),
        _other_lines(name, file, options, layout, lines),
    ]
    return NoColumnError("; ".join([str(error), *filter(None, remedies)]), error.known)


def is_cut_off(lines: Sequence[str]) -> bool:
    """Return whether a file may go on behind the lines that are looked at."""
    return len(lines) >= SAMPLE_LINES


def _other_delimiter(options: ReadingOptions, layout: Layout, lines: Sequence[str]) -> str:
    if layout.columns != 1 or options.delimiter is not None:
        return ""
    rows = [line for line in lines if not line.isspace() and not is_comment(line, layout.marks)]
    mark = _delimiting_mark(rows[-10:])
    return "" if mark is None else f"if {mark!r} stands between columns, say --format delimiter={mark}"


def _delimiting_mark(rows: Sequence[str]) -> str | None:
    """Return the character that stands between numbers in each row; None if there is none."""
    for mark in dict.fromkeys("".join(rows[:1]).strip()):
        if mark.isalnum() or mark in _SPELLED:
            continue
        cells = [cell for row in rows for cell in row.strip().removesuffix(mark).split(mark)]
        if len(cells) > len(rows) and any(all(is_number(cell, sign) for cell in cells) for sign in ".,"):
            return mark
    return None


def _other_encoding(name: str, file: TextFile, options: ReadingOptions, layout: Layout, lines: Sequence[str]) -> str:
    """Return the encoding in which the header has the name, if the encoding was guessed."""
    above = "".join(lines[: layout.start - options.skip_lines])
    plain = "".join(mark for mark in above + name if mark not in "µ°²³").isascii()
    if options.encoding is not None or file.encoding != FALLBACK or plain:
        return ""
    raw = above.encode(FALLBACK)
    for encoding in _ENCODINGS if not name.isascii() else ():
        try:
            found = name in raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if found:
            return f"with --format encoding={encoding} it has this column"
    return (
        f"it is not UTF-8 and was read as {FALLBACK}: if names look wrong, say --format encoding=NAME, such as "
        "shift_jis, gb18030 or mac_roman"
    )


def _other_lines(name: str, file: TextFile, options: ReadingOptions, layout: Layout, lines: Sequence[str]) -> str:
    """Return what helps if the table is not the one that is meant, or its header is not."""
    tables = list(walk_tables(file, options, _LOOKED_AT))
    if len(tables) > 1:
        return (
            f"the file has {list_tables(tables)}: choose another one with --format table=N, or leave out the lines "
            "above it with --format skip=N"
        )
    if not layout.numbers and is_cut_off(lines):
        return (
            f"its first {len(lines)} lines have no numbers: leave out the lines above the table with --format skip=N"
        )
    if "no header" in layout.notes and not name.isdecimal():
        return "if a header stands further down, leave out the lines above it with --format skip=N"
    return ""
