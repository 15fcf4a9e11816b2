"""Printing of texts as they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def print_plain(console: Console, text: str) -> None:
    """Print a text on one line of any length, such as a path or a name of the user's own: no markup, no colours."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)
