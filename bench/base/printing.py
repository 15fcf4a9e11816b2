"""Printing of texts as they are, and of tables that fit the terminal without cutting a word or a number."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

_INDENT = "    "

_COMMANDING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""Characters that command a terminal, but for tab and line feed, and those that change the direction of a text
(Unicode Standard Annex 9, section 2)."""


class PlainConsole(Console):
    """A console on which a text commands nothing, whoever wrote it: an instrument, a file, or another user.

    A text is printed as it is: brackets and colons in it are no markup. Characters that would command the terminal
    are shown as U+FFFD. Colours come from `rich.text.Text`, or from a style.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 - those of rich's console
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of what is printed; those of the console itself, such as of its cursor, as they are."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            if control is None and not text.isprintable():
                yield Segment(_COMMANDING.sub("\ufffd", text), style)
            else:
                yield segment


def print_plain(console: Console, text: str) -> None:
    """Print a text on one line of any length, such as a path or a name of the user's own."""
    console.print(Text(text), soft_wrap=True)


def show_table(console: Console, table: Table) -> None:
    """Print a table.

    Texts are wrapped between words. Where the terminal is too narrow even for that, each row becomes a block: its
    first cell, and below it a line for each other cell that is not empty, with the head of its column. Such lines are
    as long as they are, so that what is copied from them is whole.

    Parameters
    ----------
    console : Console
        Where to print.
    table : Table
        Its cells are texts.
    """
    columns = [[_text(console, cell) for cell in column.cells] for column in table.columns]
    heads = [_text(console, column.header) if table.show_header else Text() for column in table.columns]
    whole = [max(map(_longest_line, (head, *cells))) for head, cells in zip(heads, columns, strict=True)]
    least = [
        length if column.no_wrap else max(map(_longest_word, (head, *cells)))
        for column, head, cells, length in zip(table.columns, heads, columns, whole, strict=True)
    ]
    room = console.width - _beside_texts(table)
    unbroken = list(map(max, least, map(_longest_line, heads)))
    if sum(unbroken) <= room:
        # A head stays in one line where there is room.
        least = unbroken
    if sum(whole) > room >= sum(least):
        for column, width in zip(table.columns, _widths(least, whole, room), strict=True):
            column.width = width
    if sum(least) <= room:
        console.print(table)
        return
    if table.title:
        console.print(table.title, soft_wrap=True, style="table.title")
    for row in zip(*columns, strict=True):
        _print_block(console, [head.plain for head in heads], row, table.columns)


def print_table(
    console: Console,
    heads: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    title: str = "",
    *,
    numbers_from: int = 99,
    framed: bool = True,
) -> None:
    """Print a table of plain texts, see `show_table`; a `Text` has a style of its own.

    The columns from `numbers_from` on are aligned right.
    """
    look: dict[str, Any] = {} if framed else {"box": None, "padding": (0, 2)}
    table = Table(title=title and Text(title), title_justify="left", **look)
    for i, head in enumerate(heads):
        table.add_column(Text(head), justify="left" if i < numbers_from else "right")
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    show_table(console, table)


def aligned(rows: Sequence[Sequence[str]], numbers_from: int = 99) -> list[str]:
    """Return rows of texts as lines of aligned columns; those from `numbers_from` on end at one place."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i < numbers_from else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def show_rows(console: Console, title: str, rows: Iterable[tuple[str, str | Text]]) -> None:
    """Print (name, text) pairs under a title."""
    table = Table(title=title, title_justify="left", show_header=False, box=None, padding=(0, 2))
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for name, text in rows:
        table.add_row(name, text)
    show_table(console, table)


def html_table(heads: Sequence[str], rows: Iterable[Sequence[str]], title: str = "") -> str:
    """Return a table of texts as HTML, for notebooks."""

    def cells(tag: str, texts: Sequence[str]) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(text)}</{tag}>" for text in texts) + "</tr>"

    caption = f'<caption style="text-align:left">{escape(title)}</caption>' if title else ""
    head = f"<thead>{cells('th', heads)}</thead>" if any(heads) else ""
    return f"<table>{caption}{head}<tbody>{''.join(cells('td', row) for row in rows)}</tbody></table>"


def _print_block(console: Console, heads: Sequence[str], row: Sequence[Text], columns: Sequence[Column]) -> None:
    name, *others = row
    if name.plain.strip():
        console.print(name, style="bold", soft_wrap=True)
    for i, (text, column) in enumerate(zip(others, columns[1:], strict=True), 1):
        if text.plain.strip():
            head = f"{heads[i]}: " if heads[i] else ""
            line = Text.assemble(_INDENT, head, text)
            console.print(line, style=column.style, soft_wrap=True)


def _text(console: Console, cell: RenderableType) -> Text:
    return cell if isinstance(cell, Text) else console.render_str(str(cell))


def _longest_line(text: Text) -> int:
    return max((line.cell_len for line in text.split()), default=0)


def _longest_word(text: Text) -> int:
    return max((Text(word).cell_len for word in text.plain.split()), default=0)


def _beside_texts(table: Table) -> int:
    """Return the columns of the terminal that padding and lines of a table take."""
    _, right, _, left = table.padding
    count = len(table.columns)
    return count * (left + right) + (0 if table.box is None else count + 1)


def _widths(least: Sequence[int], whole: Sequence[int], room: int) -> list[int]:
    """Return widths that fill the room, the narrow columns first, none below its least."""
    widths = list(least)
    for _ in range(room - sum(least)):
        i = min((i for i, width in enumerate(widths) if width < whole[i]), key=widths.__getitem__)
        widths[i] += 1
    return widths
