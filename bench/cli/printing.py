"""Printing of errors, warnings and tables on the two consoles of the commands."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rich.markup import escape

from bench.base import BenchError, PlainConsole, show_rows

console = PlainConsole()
error_console = PlainConsole(stderr=True)


def print_error(error: BenchError) -> None:
    """Print an error of the bench, a line each of its lines."""
    for line in str(error).splitlines():
        error_console.print("[bold red]error:[/]", escape(line), highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print a warning."""
    error_console.print("[yellow]warning:[/]", escape(text), highlight=False, soft_wrap=True)


@contextmanager
def show_compilation() -> Iterator[None]:
    """Say when numerical kernels are compiled, which a first use does for seconds; also a decorator of commands."""
    # Here, as numba takes half a second to load.
    from bench.base import CompilationDisplay

    with CompilationDisplay(console, error_console):
        yield


def print_rows(title: str, rows: Iterable[tuple[str, str]]) -> None:
    """Print (name, text) pairs under a title."""
    show_rows(console, title, rows)
