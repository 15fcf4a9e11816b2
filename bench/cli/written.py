"""What the commands about models write beside what they print: rows as CSV, figures, model cards."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.console import console

if TYPE_CHECKING:
    from bench.results.predictions import Predictions


def print_figures(paths: Iterable[Path]) -> None:
    """Print where figures are."""
    for path in paths:
        console.print(f"figure: {path}", highlight=False, markup=False, soft_wrap=True)


def write_rows(path: Path, found: Predictions) -> None:
    """Write models beside measurements as CSV, and print where.

    Raises DataError if the file cannot be written.
    """
    from bench.results.data import write_csv

    table = found.table()
    write_csv(path, [head for head, _ in table], [values for _, values in table])
    console.print(f"{found.input.values.size} rows: {path}", highlight=False, markup=False, soft_wrap=True)
