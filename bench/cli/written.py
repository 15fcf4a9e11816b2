"""What the commands about models write beside what they print: rows as CSV, figures, model cards."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bench.base import print_plain
from bench.cli.command_line import command_line
from bench.cli.command_support import console

if TYPE_CHECKING:
    from bench.analysis import IdentifiedFile, Predictions


def print_figures(paths: Iterable[Path]) -> None:
    """Print where figures are."""
    for path in paths:
        print_plain(console, f"figure: {path}")


def write_fit(
    found: IdentifiedFile, *, context: typer.Context, out: Path | None, card: Path | None, figures: Path | None
) -> None:
    """Draw the figures of a fit in a folder and write its model card, if asked for, and print where they are.

    The card names the command of `context`, and the model file `out` if there is one. Raises DataError if a file
    cannot be written.
    """
    drawn: list[Path] = []
    if figures is not None:
        from bench.analysis import draw_identification

        drawn = draw_identification(found, figures)
        print_figures(drawn)
    if card is not None:
        from bench.analysis import write_card

        write_card(card, found, found.data.paths[0], command=command_line(context), model=out, figures=drawn)
        print_plain(console, f"card: {card}")


def write_rows(path: Path, found: Predictions) -> None:
    """Write models beside measurements as CSV, and print where.

    Raises DataError if the file cannot be written.
    """
    from bench.analysis import write_csv

    table = found.table()
    write_csv(path, [head for head, _ in table], [values for _, values in table])
    print_plain(console, f"{found.input.values.size} rows: {path}")
