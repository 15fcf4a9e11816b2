"""Layout of a table of text: delimiter, decimal sign, comments, and where header, units and data stand."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TypeAlias

from bench.analysis.tables.reading.heads import Head, bare_unit, is_unit, make_heads
from bench.analysis.tables.reading.options import ReadingOptions
from bench.base import DataError, counted

COMMENT_MARKS = ("#", "%", "//", ";")
"""What begins a line of comment; a semicolon does unless it delimits."""

SAMPLE_LINES, SAMPLE_CHARACTERS = 1000, 200_000
"""How much of a table is looked at to find its layout."""

NOT_NUMBERS = ("#DIV/0!", "#N/A", "#NAME?", "#NULL!", "#NUM!", "#REF!", "#VALUE!")
"""Errors of spreadsheets, which are no comments."""

NUMBER = {
    ".": re.compile(
        r"[+-]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?|(?:\d+\.\d*|\.\d+)d[+-]?\d+|nan|inf(?:inity)?)",
        re.IGNORECASE | re.ASCII,
    ),
    ",": re.compile(
        r"[+-]?(?:(?:\d+(?:,\d+)?|,\d+)(?:e[+-]?\d+)?|\d*,\d+d[+-]?\d+|nan|inf(?:inity)?)",
        re.IGNORECASE | re.ASCII,
    ),
}
"""A number, by its decimal sign; an exponent may begin with D, as Fortran writes it, if the sign is there."""

D_EXPONENTS = "exponents with D"
"""Note of such numbers."""

_MOST_LINES_OF_HEADS = 4

_WITHIN = re.compile(r"(?<![\d.,])\d+[.,]\d+(?![\d.,])")
"""A number with a decimal sign, in a text."""

_TIME = re.compile(r"\d+[-./:]\d")
"""Begins a date or a time of day."""

MUCH_LONGER = 5
"""Factor of rows by which a table is told from names and values above it, and from short ones beside it."""

_MOSTLY = 0.8
"""Share of cells that are numbers in a layout that is preferred to one with more cells, of which fewer are."""

DELIMITERS = {
    "\t": "tab-separated",
    ";": "semicolon-separated",
    "|": "separated by |",
    ",": "comma-separated",
    " ": "separated by blanks",
}
# The strongest first: what stands in a text is rarely a tab.


Mask: TypeAlias = tuple[bool | None, ...]
"""By cell whether it is a number, None where it is empty."""


@dataclass(frozen=True)
class Layout:
    """Layout of a table."""

    delimiter: str  # between cells; a blank stands for runs of blanks and tabs
    decimal: str  # point or comma
    start: int  # number of lines above the first row of data, in the file
    heads: tuple[Head, ...]  # heads by column; none where there is no header, or one that does not fit the data
    columns: int  # number of columns of the data
    notes: tuple[str, ...]  # what was assumed
    # Indices of the columns that hold numbers as a rule; of those that hold numbers, dates or times of day.
    numbers: tuple[int, ...] = ()
    figures: tuple[int, ...] = ()
    comments: int = 0  # number of lines of comment above the data
    fit: int = 1  # how well the heads fit: 2; 1 where there are none; 0 if they do not

    @property
    def marks(self) -> tuple[str, ...]:
        """Marks of comments."""
        return comment_marks(self.delimiter)


@dataclass(frozen=True)
class Row:
    """Cells of a row, and the number of its last line, from 1."""

    line: int
    cells: list[str]


def delimited(delimiter: str) -> str:
    """Return how columns are separated, for people."""
    return DELIMITERS.get(delimiter, f"separated by {delimiter!r}")


def comment_marks(delimiter: str) -> tuple[str, ...]:
    """Return the marks of comments where a character delimits."""
    return tuple(mark for mark in COMMENT_MARKS if mark != delimiter)


def is_comment(line: str, marks: tuple[str, ...]) -> bool:
    """Return whether a line is one of comment."""
    line = line.lstrip()
    return line.startswith(marks) and not line.startswith(NOT_NUMBERS)


def split_rows(lines: Iterable[str], delimiter: str, first: int = 0) -> Iterator[Row]:
    """Yield the rows of lines that are neither blank nor comments; `first` lines stand above them.

    Each line is a row: no cell of a table of numbers contains a line break, so a quote that is not closed must not
    take in the lines below.
    """
    marks = comment_marks(delimiter)
    for number, line in enumerate(lines, start=first + 1):
        if line.isspace() or is_comment(line, marks):
            continue
        cells = _cells(line, delimiter)
        # Trailing delimiters close empty cells, of which spreadsheets write thousands.
        while cells and not cells[-1].strip():
            cells.pop()
        if any(cell.strip() for cell in cells):
            yield Row(number, cells)


def _cells(line: str, delimiter: str, *, strict: bool = False) -> list[str]:
    """Return the cells of a line; raise csv.Error for quotes that do not enclose a cell, if `strict`."""
    line = line.replace("\t", " ").strip() if delimiter == " " else line.rstrip("\r\n")
    return next(csv.reader([line], delimiter=delimiter, skipinitialspace=delimiter == " ", strict=strict), [])


def closes_its_quotes(line: str, delimiter: str) -> bool:
    """Return whether each cell of a line that begins with a quote ends with one."""
    if '"' not in line:
        return True
    try:
        _cells(line, delimiter, strict=True)
    except csv.Error:
        return False
    return True


def is_number(cell: str, decimal: str) -> bool:
    """Return whether a cell is a number with this decimal sign."""
    return NUMBER[decimal].fullmatch(cell.strip()) is not None


def find_layout(path: Path, lines: Sequence[str], options: ReadingOptions, first: int = 0) -> Layout | None:
    """Find the layout of a table from its first lines; None if no row of them has a number.

    If the options name a table, the first one is found. Otherwise names and values above a much longer table are no
    table.

    Raises DataError if the lines can be read in several ways: names the option that decides.
    """
    found: list[tuple[tuple[bool, int, int, float], Layout]] = []
    for delimiter in [options.delimiter] if options.delimiter else list(DELIMITERS):
        assert delimiter is not None
        rows = list(split_rows(lines, delimiter, first))
        signs: list[tuple[tuple[bool, int, int, float], Layout]] = []
        for decimal in [options.decimal] if options.decimal else [".", ","]:
            assert decimal is not None
            header = find_header(rows, decimal, delimiter, in_order=options.table is not None)
            if header is None or (delimiter == decimal and not _quoted(rows, lines, options)):
                continue
            # A blank within a cell delimits nothing where another character does.
            if delimiter == " " and any(rank[0] and other.columns == header.columns for rank, other in found):
                continue
            if not header.heads and header.fit == 1:
                header = _header_in_comment(lines, first, header)
            data = [row.cells for row in rows if row.line > header.start]
            filled = [cell for cells in data for cell in cells if cell.strip()]
            numbers = [cell for cell in filled if is_number(cell, decimal)]
            above = lines[: header.start - first]
            comments = sum(is_comment(line, header.marks) for line in above)
            notes = (*_notes(above, comments, header), *[D_EXPONENTS] * any("d" in cell.lower() for cell in numbers))
            layout = replace(header, notes=notes, comments=comments)
            share = len(numbers) / len(filled)
            signs.append(((share >= _MOSTLY, header.fit, len(numbers), share), layout))
        # The decimal sign is the one with which more are numbers, whether or not a header fits.
        found += sorted(signs, key=lambda entry: -entry[0][2])[:1]
    if not found:
        return None
    # Of equals the first: the point before the comma, the stronger delimiter before the weaker.
    rank, layout = max(found, key=lambda entry: entry[0])
    if options.delimiter is None and options.decimal is None:
        rivals = [
            other
            for same, other in found
            if same == rank and other.columns != layout.columns and "," in (layout.delimiter, other.delimiter)
        ]
        cells = [row for row in split_rows(lines, layout.delimiter, first) if row.line > layout.start]
        if rivals or (layout.delimiter == "," and _may_be_decimal(cells, layout)):
            raise DataError(
                f"{path}: line {cells[0].line}: a comma may stand between columns or be the decimal sign: say "
                "--format delimiter=comma, or --format decimal=comma; where it is both, save the file with another "
                "delimiter"
            )
    for head in layout.heads:
        text = head.text
        if _WITHIN.search(text) and not any(map(str.isalpha, text)) and not any(is_number(text, s) for s in ".,"):
            raise DataError(
                f"{path}: line {layout.start}: {head.text!r} is neither a number nor the head of a column: correct "
                "it in the file, or leave the line out with --format skip=N"
            )
    return layout


def header_only(lines: Sequence[str], options: ReadingOptions, first: int = 0) -> Layout | None:
    """Return the layout of lines without any number: the first row is the header; None if there is no row."""
    rows = {
        delimiter: list(split_rows(lines, delimiter, first))
        for delimiter in ([options.delimiter] if options.delimiter else (",", ";", "\t", "|"))
    }
    best = max(rows, key=lambda delimiter: max((len(row.cells) for row in rows[delimiter][:1]), default=0))
    if not rows[best] or not any(character.isalnum() for cell in rows[best][0].cells for character in cell):
        return None
    row = rows[best][0]
    return Layout(best, options.decimal or ".", row.line, make_heads(row.cells), len(row.cells), ())


def other_heads(above: Sequence[Row], layout: Layout) -> Iterator[Layout]:
    """Yield a layout with the heads of each row of texts right above the data, from the lowest.

    Some programs write remarks, types or lines between the names and the data.
    """
    for row in reversed(above):
        if any(is_number(cell, layout.decimal) for cell in row.cells):
            return
        if len(row.cells) == layout.columns > 1:
            yield replace(layout, heads=make_heads(row.cells), notes=(*layout.notes, f"heads from line {row.line}"))


def find_header(rows: Sequence[Row], decimal: str, delimiter: str = ",", *, in_order: bool = False) -> Layout | None:
    """Find where the data begin, and the heads and units above them; None if no row has a number.

    In order, the data are those of the first table; otherwise names and values above a much longer one are no table.
    """
    masks = [tuple(None if not cell.strip() else is_number(cell, decimal) for cell in row.cells) for row in rows]
    block = _first_block(rows, masks, in_order=in_order)
    if block is None:
        return None
    begin, pattern = block
    typical = rows[begin + masks[begin:].index(pattern)].cells
    return replace(
        _find_heads(rows, masks, begin, pattern, decimal, delimiter),
        numbers=tuple(place for place, number in enumerate(pattern) if number),
        figures=tuple(place for place, number in enumerate(pattern) if number or _TIME.match(typical[place].strip())),
    )


def _find_heads(
    rows: Sequence[Row], masks: Sequence[Mask], begin: int, pattern: Mask, decimal: str, delimiter: str
) -> Layout:
    """Return the heads and units above the data, which begin in a row and have a pattern."""
    columns, notes = len(pattern), list[str]()
    layout = Layout(delimiter, decimal, rows[0].line - 1, (), columns, ())
    if (
        begin == 0
        and len(rows) > 1
        and not masks[0][0]
        and any(one is False and two for one, two in zip(masks[0], pattern, strict=False))
    ):
        # Such as `time, 1, 2`.
        begin = 1
        notes.append(f"heads from line {rows[0].line}, some of them numbers")
    if begin == 0:
        return layout
    layout = replace(layout, start=rows[begin - 1].line)
    texts, units = rows[begin - 1].cells, list[str]()
    # As of two channels, heads may be numbers but for the first.
    above = rows[begin - 2].cells if begin > 1 and masks[begin - 2][0] is False else []
    highest = rows[begin - 3].cells if above and begin > 2 and not any(masks[begin - 3]) else []
    if highest and _unit_row(above) and len(highest) >= len(above) > 1:
        # Names, units and remarks, as Origin writes them.
        texts, units = highest, above
        notes.append("units from a row")
    elif (
        above and _unit_row(_over_numbers(texts, pattern)) and len(_matched(above, columns, delimiter)) >= len(texts)
    ):
        texts, units = above, texts
        notes.append("units from a row")
    other = "," if decimal == "." else "."
    if any(is_number(text, other) and not is_number(text, decimal) for text in texts):
        # Numbers with the other decimal sign.
        return replace(layout, fit=0)
    heads = _matched(texts, columns, delimiter)
    aligned = _aligned(rows[:begin], columns) if len(heads) == 1 < columns else []
    if aligned and not any(is_number(text, sign) for text in aligned for sign in ".,"):
        return replace(layout, heads=make_heads(aligned), fit=2, notes=("heads aligned by blanks",))
    if len(heads) == 1 < columns and begin > 1:
        # A title, perhaps between the heads and the data.
        found = _find_heads(rows, masks, begin - 1, pattern, decimal, delimiter) if len(above) == columns else None
        return replace(found, start=layout.start) if found else layout
    fit = 2 if len(heads) == columns or (len(heads) > columns and delimiter != " ") else 0
    return replace(layout, heads=make_heads(heads, units) if fit else (), fit=fit, notes=tuple(notes))


def _aligned(above: Sequence[Row], columns: int) -> list[str]:
    """Return the heads in the last lines above data, which blanks align; none if they are not as many as columns."""
    best: list[str] = []
    spans: list[list[tuple[int, int, str]]] = []
    for row in reversed(above[-_MOST_LINES_OF_HEADS:]):
        if len(row.cells) > 1:
            break
        found = [(*match.span(), match[0]) for match in re.finditer(r"\S+(?: \S+)*", row.cells[0])]
        # From the top, so that `Adjusted` stands before `Field` below it.
        spans = [[each] for each in found] + spans
        merged: list[list[tuple[int, int, str]]] = []
        for group in sorted(spans, key=lambda group: group[0][0]):
            if merged and group[0][0] < max(end for _, end, _ in merged[-1]):
                merged[-1] += group
            else:
                merged.append(list(group))
        if len(merged) == columns:
            order = [span for group in spans for span in group]
            best = [" ".join(span[2] for span in sorted(group, key=order.index)) for group in merged]
    return best


@dataclass(frozen=True)
class _Block:
    """Rows with numbers: rank, first row, number of rows, and which cells are numbers as a rule."""

    rank: tuple[bool, bool]
    begin: int
    length: int
    pattern: Mask


def _first_block(rows: Sequence[Row], masks: Sequence[Mask], *, in_order: bool) -> tuple[int, Mask] | None:
    """Return where the first rows with numbers begin, and which of their cells are numbers as a rule.

    Rows without a number separate blocks. Names and values of a preamble are rarely of numbers mostly. Where they
    are, as of two channels, a much longer block below is the table, unless blocks are counted in order.
    """
    blocks: list[_Block] = []
    for has_numbers, group in groupby(enumerate(masks), key=lambda entry: any(entry[1])):
        if has_numbers:
            block = list(group)
            pattern, times = Counter(mask for _, mask in block).most_common(1)[0]
            mostly = 2 * sum(map(bool, pattern)) > sum(cell is not None for cell in pattern)
            blocks.append(_Block((times > 1, mostly), block[0][0], len(block), pattern))
    if not blocks:
        return None
    highest = max(block.rank for block in blocks)
    equals = [block for block in blocks if block.rank == highest]
    longest = max(equals, key=lambda block: block.length)
    chosen = next(
        block
        for block in equals
        if in_order
        or block is longest
        or block.length * MUCH_LONGER > longest.length
        or not _names_and_values(rows, block)
    )
    return chosen.begin, chosen.pattern


def _names_and_values(rows: Sequence[Row], block: _Block) -> bool:
    """Return whether each row of a block begins with a name of its own, as `Delta_X, 0.05, 0.05` does."""
    names = [row.cells[0].strip() for row in rows[block.begin : block.begin + block.length]]
    return all(name[:1].isalpha() for name in names) and len(set(names)) == len(names)


def _matched(texts: Sequence[str], columns: int, delimiter: str) -> list[str]:
    """Return heads; between blanks, those whose unit stands behind a blank are put together."""
    if delimiter != " " or len(texts) == columns:
        return list(texts)
    joined: list[str] = []
    for text in texts:
        if joined and (text[0] in "[(/" or joined[-1].endswith("/")):
            joined[-1] += f" {text}"
        else:
            joined.append(text)
    return joined


def _over_numbers(cells: Sequence[str], pattern: Mask) -> Sequence[str]:
    """Return the cells above columns of numbers; all where those above the others cannot be told."""
    if len(cells) != len(pattern):
        return cells
    return [cell for cell, is_number in zip(cells, pattern, strict=True) if is_number]


def _unit_row(cells: Sequence[str]) -> bool:
    filled = [cell.strip() for cell in cells if cell.strip()]
    return all(is_unit(cell) or is_unit(bare_unit(cell)) for cell in filled)


def _header_in_comment(lines: Sequence[str], first: int, header: Layout) -> Layout:
    """Return the header with the heads of the last comments above the data, as numpy writes them, if they fit."""
    delimiter = header.delimiter
    comments = [line.strip() for line in lines[: header.start - first] if is_comment(line, header.marks)]
    texts = [comment.lstrip("#%/; \t") for comment in comments]
    rows = [row.cells for text in texts[-2:] for row in split_rows([text], delimiter)]
    if not rows:
        return header
    heads, units = (rows[0], rows[1]) if len(rows) == 2 and _unit_row(rows[1]) else (rows[-1], [])
    heads = _matched(heads, header.columns, delimiter)
    if len(heads) != header.columns or (len(heads) == 1 and delimiter != "," and " " in heads[0]):
        return header
    notes = ("header from a comment", *(("units from a row",) if units else ()))
    return replace(header, heads=make_heads(heads, units), fit=2, notes=notes)


def _notes(above: Sequence[str], comments: int, header: Layout) -> tuple[str, ...]:
    used = 0 if not header.heads or "header from a comment" in header.notes else 1
    used += "units from a row" in header.notes and "header from a comment" not in header.notes
    others = sum(not line.isspace() for line in above) - comments - used
    return (
        "one column" if header.columns == 1 else delimited(header.delimiter),
        *(["decimal comma"] if header.decimal == "," else []),
        *([f"{counted(others, 'line')} above the header"] if others > 0 else []),
        *(["no header"] if header.fit == 1 and not header.heads else []),
        *(["heads that do not fit the columns"] if header.fit == 0 else []),
        *header.notes,
    )


def _quoted(rows: Sequence[Row], lines: Sequence[str], options: ReadingOptions) -> bool:
    """Return whether cells are in quotes, so that a comma can delimit and be the decimal sign."""
    if not any('"' in line for line in lines):
        return False
    numbers = [cell for row in rows for cell in row.cells if is_number(cell, ",")]
    return options.decimal == "," or 2 * sum("," in cell for cell in numbers) >= len(numbers)


def _may_be_decimal(rows: Sequence[Row], layout: Layout) -> bool:
    """Return whether commas between whole numbers may be decimal signs.

    Each second cell has digits only then. It is the fraction of a number if one begins with a zero, as in `1,05`, or
    if the heads do not name each column: `Kraft, N` may be one name with its unit.
    """
    whole = [cell.strip().lstrip("+-") for row in rows for cell in row.cells[::2]]
    rest = [cell.strip() for row in rows for cell in row.cells[1::2]]
    if layout.columns % 2 or not all(map(str.isdecimal, whole + rest)):
        return False
    names = [head.text for head in layout.heads]
    units = [is_unit(name) and not name.startswith("count") for name in names[1::2]]
    are_names = len(names) == layout.columns and not all(units) and not any(is_number(name, ".") for name in names)
    return not are_names or any(len(cell) > 1 and cell.startswith("0") for cell in rest)
