"""What the commands that read measurements share: the options of the layout, and what was assumed."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base import print_plain
from bench.cli.printing import console

if TYPE_CHECKING:
    from bench.analysis import ReadingOptions


def _layout(
    format_: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            metavar="WORD=VALUE,...",
            help="What is not to be found from the file: decimal=comma, delimiter=semicolon, encoding=cp1252, skip=3 "
            "(first lines), table=2 (number, sheet or variable; telemetry of a run), interval=0.1s (between rows), "
            "time-unit=ms, missing=nan (rows with it are left out).",
        ),
    ] = None,
) -> Any:  # noqa: ANN401 - ReadingOptions, which help does without
    """Return the options of the layout of a file; its signature is that of the option."""
    from bench.analysis import ReadingOptions

    return ReadingOptions.parse(",".join(format_ or ()))


ReadingGroup = Annotated["ReadingOptions", _layout]
"""The options of the layout of a file."""


SkipOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        metavar="ROWS",
        help="First rows, which drive the memory but are left out of the errors; on a model's own data those that "
        "its identification left out.",
    ),
]
FiguresOption = Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for figures.")]


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
    grouped.__annotations__ = {parameter.name: parameter.annotation for parameter in keywords}
    return grouped


def print_assumptions(name: str, assumptions: str) -> None:
    """Print in a line what was assumed about the layout of a file; nothing for a run."""
    if assumptions:
        print_plain(console, f"read {name}: {assumptions}")
