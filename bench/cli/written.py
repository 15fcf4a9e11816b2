"""What the commands about models write beside what they print: rows as CSV, and where figures are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.base import counted, print_plain
from bench.cli.printing import console

if TYPE_CHECKING:
    from bench.analysis import Applied


def print_figures(paths: Iterable[Path]) -> None:
    """Print where figures are."""
    for path in paths:
        print_plain(console, f"figure: {path}")


def write_table(path: Path, table: Sequence[tuple[str, Any]]) -> None:
    """Write columns behind their heads as CSV. Raises DataError if the file cannot be written."""
    from bench.analysis import write_csv

    write_csv(path, [head for head, _ in table], [values for _, values in table])


def write_rows(path: Path, found: Mapping[str, Applied]) -> None:
    """Write models beside measurements as CSV, and print where.

    Raises DataError if the file cannot be written.
    """
    from bench.analysis import rows_table

    table = rows_table(found)
    write_table(path, table)
    print_plain(console, f"{counted(len(table[0][1]), 'row')}: {path}")
