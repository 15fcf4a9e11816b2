"""Printing of errors, warnings, tables and files on the two consoles of the commands."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from bench.base import BenchError, PlainConsole, counted, print_plain, show_rows

if TYPE_CHECKING:
    from bench.analysis import Applied


console = PlainConsole()

error_console = PlainConsole(stderr=True)


def print_error(error: BenchError) -> None:
    """Print an error of the bench, a line each of its lines."""
    for line in str(error).splitlines():
        error_console.print(Text("error:", "bold red"), line, soft_wrap=True)


def warn(text: str) -> None:
    """Print a warning."""
    error_console.print(Text("warning:", "yellow"), text, soft_wrap=True)


@contextmanager
def show_compilation() -> Iterator[None]:
    """Say when numerical kernels are compiled, which a first use does for seconds; also a decorator of commands."""
    # Here, as numba takes half a second to load.
    from bench.base import CompilationDisplay

    with CompilationDisplay(error_console):
        yield


def print_rows(title: str, rows: Iterable[tuple[str, str]]) -> None:
    """Print (name, text) pairs under a title."""
    show_rows(console, title, rows)


def print_figures(paths: Iterable[Path]) -> None:
    """Print where figures are."""
    for path in paths:
        print_plain(console, f"figure: {path}")


def write_rows(path: Path, found: Mapping[str, Applied]) -> None:
    """Write models beside measurements as CSV, and print where.

    Raises DataError if the file cannot be written.
    """
    from bench.analysis import rows_table, write_csv

    table = rows_table(found)
    write_csv(path, table)
    print_plain(console, f"{counted(len(table[0][1]), 'row')}: {path}")
