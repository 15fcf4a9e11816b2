"""What the commands that read measurements share: the options of the layout, and what was assumed."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.cli.console import console
from bench.results.reading.options import ReadingOptions


def _layout(
    delimiter: Annotated[
        str | None,
        typer.Option(metavar="CHARACTER", help="Between columns: comma, semicolon, tab, blanks, or the character."),
    ] = None,
    decimal: Annotated[str | None, typer.Option(metavar="SIGN", help="Decimal sign: point or comma.")] = None,
    encoding: Annotated[
        str | None, typer.Option(metavar="NAME", help="Encoding of the text, such as utf-8, cp1252 or utf-16.")
    ] = None,
    skip_lines: Annotated[int, typer.Option(metavar="LINES", help="First lines of the file that are left out.")] = 0,
    table: Annotated[
        str | None,
        typer.Option(metavar="TABLE", help="Table of a file of several: number from 1; name of a sheet or variable."),
    ] = None,
) -> ReadingOptions:
    """Return the options of the layout of a file; its signature is that of the options."""
    return ReadingOptions(delimiter, decimal, encoding, skip_lines, table)


def layout_options(command: Callable[..., None]) -> Callable[..., None]:
    """Offer a command's users the options of the layout of a file, in place of its parameter `reading`."""
    own, added = inspect.signature(command, eval_str=True), inspect.signature(_layout, eval_str=True).parameters
    kept = [parameter for name, parameter in own.parameters.items() if name != "reading"]

    @functools.wraps(command)
    def offered(**arguments: Any) -> None:  # noqa: ANN401 - the command's own
        reading = _layout(**{name: arguments.pop(name) for name in added})
        command(**arguments, reading=reading)

    keywords = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in (*kept, *added.values())]
    offered.__signature__ = own.replace(parameters=keywords)  # type: ignore[attr-defined]
    return offered


def print_assumptions(file: Path, assumptions: str) -> None:
    """Print in a line what was assumed about the layout of a file; nothing for a run."""
    if assumptions:
        console.print(f"read {file.name}: {assumptions}", highlight=False, markup=False, soft_wrap=True)
