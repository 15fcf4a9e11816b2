"""Every command of `bench`, also those of its groups."""

from collections.abc import Iterator
from typing import Any

import typer

from bench.cli import app


def every_command(group: Any = None, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the words of each command after `bench`, and the command."""
    group = group or typer.main.get_command(app)
    context = group.make_context("bench", [], resilient_parsing=True)
    for name in dict.fromkeys([*group.own, *group.list_commands(context)]):
        command = group.get_command(context, name)
        if hasattr(command, "own"):
            yield from every_command(command, f"{path}{name} ")
        else:
            yield f"{path}{name}", command
