"""What the commands that read measurements share: the options of the layout, and what was assumed."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from bench.analysis import ReadingOptions
from bench.base import print_plain
from bench.cli.command_support import console


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
        typer.Option(
            metavar="TABLE",
            help="Table of a file of several: number from 1; name of a sheet or variable; of a run: telemetry.",
        ),
    ] = None,
) -> ReadingOptions:
    """Return the options of the layout of a file; its signature is that of the options."""
    return ReadingOptions(delimiter, decimal, encoding, skip_lines, table)


def offer_options(source: Callable[..., Any], name: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that offers a command's users the parameters of a function in place of a parameter.

    The command gets what the function returns for them.

    Parameters
    ----------
    source : callable
        Its signature is that of the options.
    name : str
        The parameter of the command that they replace.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own, added = inspect.signature(command, eval_str=True), inspect.signature(source, eval_str=True).parameters
        kept = [parameter for key, parameter in own.parameters.items() if key != name]

        @functools.wraps(command)
        def offered(**arguments: Any) -> None:  # noqa: ANN401 - the command's own
            made = source(**{key: arguments.pop(key) for key in added})
            command(**arguments, **{name: made})

        keywords = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in (*kept, *added.values())]
        offered.__signature__ = own.replace(parameters=keywords)  # type: ignore[attr-defined]
        return offered

    return decorate


layout_options = offer_options(_layout, "reading")
"""Offer a command's users the options of the layout of a file, in place of its parameter `reading`."""


def print_assumptions(name: str, assumptions: str) -> None:
    """Print in a line what was assumed about the layout of a file; nothing for a run."""
    if assumptions:
        print_plain(console, f"read {name}: {assumptions}")
