"""Rows of a summary below a table, such as `Total, 600, 3`: known by a text where the rows above have numbers."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from bench.analysis.tables.reading.layout import is_number

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
