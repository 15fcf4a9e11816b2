"""The command line by which a command can be given again."""

from __future__ import annotations

import shlex
from typing import Any

import typer


def command_line(context: typer.Context) -> str:
    """Return a command with all that was set, as a shell takes it; what was left at its default is left out."""
    options: list[str] = []
    arguments: list[str] = []
    for parameter in context.command.params:
        name = parameter.name or ""
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE":
            continue
        value = context.params[name]
        if parameter.param_type_name == "option":
            options += _option(parameter, value)
        else:
            arguments += map(str, value if parameter.nargs != 1 else [value])
    return shlex.join(["bench", context.info_name or "", *arguments, *options])


def _option(option: Any, value: Any) -> list[str]:  # noqa: ANN401 - an option of typer's, and its value
    if option.is_flag:
        return [(option.opts if value else option.secondary_opts)[0]]
    given = value if option.multiple else [value]
    return [word for each in given for word in (option.opts[0], *map(str, each if option.nargs != 1 else [each]))]
