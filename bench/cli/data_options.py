"""What the commands that read measurements share: the options of the layout, and what was assumed."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
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
    interval: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Rows are this far apart, and no column has times: 0.1s, 50ms."),
    ] = None,
    time_unit: Annotated[
        str | None,
        typer.Option(
            metavar="UNIT", help="Times have this unit, which their head does not say: d, h, min, s, ms, us or ns."
        ),
    ] = None,
) -> ReadingOptions:
    """Return the options of the layout of a file; its signature is that of the options."""
    return ReadingOptions(delimiter, decimal, encoding, skip_lines, table, interval, time_unit)


ReadingGroup = Annotated[ReadingOptions, _layout]
"""The options of the layout of a file."""


def offer_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Offer a command's users, in place of each parameter that is a group of options, the options of the group.

    A group is a dataclass whose fields are annotated as options, or is annotated with a function whose parameters
    are, and which returns the value of the group.
    """
    own = inspect.signature(command, eval_str=True)
    groups: dict[str, tuple[Callable[..., Any], list[str]]] = {}
    offered: list[inspect.Parameter] = []
    for name, parameter in own.parameters.items():
        source: Any = (*getattr(parameter.annotation, "__metadata__", ()), parameter.annotation)[0]
        is_group = inspect.isfunction(source) or is_dataclass(source)
        if not is_group:
            offered.append(parameter)
            continue
        options = inspect.signature(source, eval_str=True).parameters
        groups[name] = source, list(options)
        offered += options.values()

    @functools.wraps(command)
    def grouped(**arguments: Any) -> None:  # noqa: ANN401 - the command's own
        made = {
            name: make(**{option: arguments.pop(option) for option in options})
            for name, (make, options) in groups.items()
        }
        command(**arguments, **made)

    keywords = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in offered]
    grouped.__signature__ = own.replace(parameters=keywords)  # type: ignore[attr-defined]
    return grouped


def print_assumptions(name: str, assumptions: str) -> None:
    """Print in a line what was assumed about the layout of a file; nothing for a run."""
    if assumptions:
        print_plain(console, f"read {name}: {assumptions}")
