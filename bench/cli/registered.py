"""Commands that packages register: those of rigs, and the studies of `bench reproduce`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import typer
from typer.core import TyperGroup
from typer.models import CommandInfo

from bench.base import ConfigurationError, registry
from bench.cli.command_support import (
    FigureFormat,
    FigureFormatOption,
    JsonOption,
    LiveOption,
    check_outputs,
    console,
    parse_assignments,
    show_compilation,
    write_json,
)


class RegisteredCommands(TyperGroup):
    """A group of commands with those that packages register in `group`, each loaded when it is asked for.

    Attributes
    ----------
    own : mapping of str to CommandInfo
        The bench's own, by name. Their options are read when one is asked for: of all commands that takes 60 ms.
    """

    group: ClassVar[registry.Group] = "commands"
    own: ClassVar[Mapping[str, CommandInfo]] = MappingProxyType({})

    # The types of click are a private part of typer.
    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401
        """Return the names of all commands, the registered ones last."""
        own = [*self.own, *super().list_commands(ctx)]
        return [*own, *(name for name in registry.entries(self.group) if name not in own)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401
        """Return a command; one that cannot be loaded says so when it is called."""
        one = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)
        if cmd_name in self.own:
            one.registered_commands.append(self.own[cmd_name])
            return typer.main.get_command(one)
        entry = registry.entries(self.group).get(cmd_name)
        if cmd_name in self.commands or entry is None:
            return super().get_command(ctx, cmd_name)
        try:
            callback = self.make_callback(cmd_name, entry.load())
        except ConfigurationError as error:
            failure = error

            def callback() -> None:
                raise failure

            callback.__doc__ = f"Cannot be loaded: {error}"
        one.command(cmd_name)(callback)
        return typer.main.get_command(one)

    def make_callback(self, name: str, part: Any) -> Callable[..., None]:  # noqa: ARG002, ANN401
        """Return the function of a command whose entry point is `part`: that itself, with word of compilations."""
        callback: Callable[..., None] = show_compilation()(part)
        return callback


class Studies(RegisteredCommands):
    """The commands of `bench reproduce`, one for each registered study."""

    group = "studies"

    def make_callback(self, name: str, part: Any) -> Callable[..., None]:  # noqa: ANN401
        """Return a function that carries a study out."""

        def carry_out_study(
            rig: Annotated[
                str | None,
                typer.Option("--rig", metavar="RIG", help="Another rig with the same signals."),
            ] = None,
            set_: Annotated[
                list[str] | None,
                typer.Option(
                    "--set",
                    metavar="PROTOCOL.KEY=VALUE",
                    help="Set a parameter in each run of a protocol; repeatable.",
                ),
            ] = None,
            seed: Annotated[
                int, typer.Option(min=0, help="Seed of all noise in the emulated laboratory and of random sequences.")
            ] = 0,
            out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for runs, models and figures.")] = Path(
                "recordings"
            ),
            live: LiveOption = False,
            workers: Annotated[
                int | None,
                typer.Option(
                    min=1, help="Runs that go on beside each other; as many as there are cores if not given."
                ),
            ] = None,
            figures: FigureFormatOption = FigureFormat.PNG,
            json_file: JsonOption = None,
        ) -> None:
            from bench.batch import reproduce

            check_outputs(folder=out)
            settings: dict[str, dict[str, str]] = {}
            for name_of_parameter, text in parse_assignments("--set", set_ or []).items():
                protocol, dot, parameter = name_of_parameter.partition(".")
                if not dot:
                    raise ConfigurationError(f"--set {name_of_parameter}={text}: expected PROTOCOL.KEY=VALUE")
                settings.setdefault(protocol, {})[parameter] = text
            result = reproduce(
                name,
                part,
                rig=rig,
                seed=seed,
                out=out,
                live=live,
                console=console,
                workers=workers,
                figure_format=figures.value,
                settings=settings,
            )
            write_json(json_file, result)

        carry_out_study.__doc__ = f"{part.summary}\n\n{part.description}"
        return carry_out_study
