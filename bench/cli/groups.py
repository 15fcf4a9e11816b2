"""The groups of commands: what is in them, and how help shows it."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from bench.base import ConfigurationError, closest, registry

HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}


class Command(NamedTuple):
    """A command of the bench."""

    summary: str  # what it does, in a line
    function: str  # `module:name` in `bench.cli`, which is imported when the command or its help is asked for
    panel: str = "Commands"  # heading under which help shows it
    has_help: bool = False  # whether it has an option `--help` of its own


class _PlainParameters:
    """A command whose help names no Python types, and which converts no value that was not given.

    To convert any value typer imports pydantic, which takes as long as the rest of `bench list`.
    """

    def get_params(self, ctx: Any) -> list[Any]:  # noqa: ANN401 - the types of click are a private part of typer
        """Return arguments and options."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for each in parameters:
            if "process_value" in vars(each):
                continue
            each.process_value = partial(_process_value, each, each.process_value)
            if each.param_type_name == "argument":
                each.display_type = lambda _: ""
            elif each.metavar is None and not each.is_flag and not each.type_descriptor.is_choice:
                each.metavar = "NUMBER" if each.type_descriptor.is_ranged else "TEXT"
        return parameters


def _process_value(parameter: Any, convert: Callable[..., Any], ctx: Any, value: Any) -> Any:  # noqa: ANN401
    if value is not None or parameter.required or parameter.nargs != 1 or getattr(parameter, "multiple", False):
        return convert(ctx, value)
    return None if parameter.callback is None else parameter.callback(ctx, parameter, None)


class _OneCommand(_PlainParameters, TyperCommand):
    pass


class Group(_PlainParameters, TyperGroup):
    """A group of commands, each imported when it is asked for.

    Attributes
    ----------
    own : mapping of str to Command
        The bench's own commands, by name.
    others : str
        Prefix of the commands of the group that packages register: "rig." for `rig.emulate`.
    otherwise : str
        The command that takes the words if the first is no command; not shown. Empty if there is none.
    panel : str
        Heading of the commands that packages register.
    former : mapping of str to str
        Today's command by its former name, or a pattern of `fnmatch`.
    """

    own: ClassVar[Mapping[str, Command]] = {}
    others: ClassVar[str] = ""
    otherwise: ClassVar[str] = ""
    panel: ClassVar[str] = "Commands"
    former: ClassVar[Mapping[str, str]] = {}

    def registered(self) -> dict[str, registry.RegisteredPart]:
        """Return what packages register in the group, by name."""
        found = {}
        for name, entry in registry.entries("commands").items():
            group, dot, command = name.rpartition(".")
            if group + dot == self.others and command not in self.own:
                found[command] = entry
        return found

    # The types of click are a private part of typer.
    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401, ARG002
        """Return the names of the commands that help shows, the registered ones last."""
        return [name for name in (*self.own, *self.registered()) if name != self.otherwise]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401, ARG002
        """Return a command; one that cannot be loaded says so when it is called."""
        if cmd_name in self.own:
            module, _, function = self.own[cmd_name].function.partition(":")
            part = getattr(importlib.import_module(f"bench.cli.{module}"), function)
            if isinstance(part, type):
                return part(name=cmd_name, help=part.__doc__, context_settings=HELP_OPTIONS, rich_markup_mode=None)
            return _command(cmd_name, part, add_help_option=not self.own[cmd_name].has_help)
        entry = self.registered().get(cmd_name)
        if entry is None:
            return None
        try:
            return _command(cmd_name, self.make_callback(cmd_name, entry.load()))
        except ConfigurationError as error:
            failure = error

            def callback() -> None:
                raise failure

            callback.__doc__ = f"Cannot be loaded: {error}"
            return _command(cmd_name, callback)

    def make_callback(self, name: str, part: Any) -> Callable[..., None]:  # noqa: ARG002, ANN401
        """Return the function of a command whose entry point is `part`: that itself, with word of compilations."""
        from bench.cli.printing import show_compilation

        callback: Callable[..., None] = show_compilation()(part)
        return callback

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401
        """Take the words; without any, show help and end, or carry out the command that is meant by none."""
        asks_for_help = any(word in HELP_OPTIONS["help_option_names"] for word in args[:1])
        is_meant = not self.no_args_is_help and not ctx.resilient_parsing if not args else not asks_for_help
        names = self.list_commands(ctx)
        if self.otherwise and is_meant and args[:1] not in [[name] for name in (*names, self.otherwise)]:
            word = args[0] if args else "-"
            if word[0] != "-" and not Path(word).exists() and (near := get_close_matches(word, names)):
                raise ConfigurationError(f"{ctx.command_path}: there is no {word}; did you mean {near[0]}?")
            args = [self.otherwise, *args]
        if not args and not ctx.resilient_parsing:
            args = ["--help"]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:  # noqa: ANN401
        """Return the command of the first word; say the present name if it is a former one."""
        now = next((now for former, now in self.former.items() if fnmatchcase(args[0], former)), None)
        if now is not None and args[0] not in self.registered():
            raise ConfigurationError(f"bench {args[0]} is now {now}")
        if self.get_command(ctx, args[0]) is None and not ctx.resilient_parsing:
            known = closest(args[0], self.list_commands(ctx), f"`{ctx.command_path} --help`")
            raise ConfigurationError(f"{ctx.command_path}: there is no command {args[0]}; {known}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401
        """Write the commands by panel, a line each."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            if name in self.own:
                summary, panel = self.own[name].summary, self.own[name].panel
            else:
                summary, panel = self.get_command(ctx, name).get_short_help_str(200), self.panel
            panels.setdefault(panel, []).append((name, summary))
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows)


class RunsGroup(Group):
    """List the runs below a folder, export, compare and repair them, and import other measurements as runs.

    `bench runs [FOLDER]` lists; `bench runs list --help` shows its options.
    """

    own: ClassVar[Mapping[str, Command]] = {
        "list": Command("List runs: how they ended, what was set, what came out.", "record_commands:runs_"),
        "export": Command("Write a run as csv, parquet, bluesky, rrd or png.", "record_commands:export"),
        "import": Command("Make a run of a file of measurements.", "record_commands:import_"),
        "repair": Command("Say how far a journal is good; write a repaired copy.", "record_commands:repair"),
        "compare": Command("Compare two runs with each other.", "record_commands:compare"),
    }
    others = "runs."
    otherwise = "list"


class RigGroup(Group):
    """Look after the instruments of a rig, and emulate them."""

    own: ClassVar[Mapping[str, Command]] = {
        "check": Command("Check instruments, and the rig file against them.", "rig_commands:check"),
        "clear": Command("Clear the errors that a watchdog or a protection left.", "rig_commands:clear"),
        "calibrate": Command("Calibrate a sensor from a run.", "rig_commands:calibrate"),
    }
    others = "rig."


class ModelGroup(Group):
    """Test models, design experiments for them, and use them: emulated twins, tuned controllers, exports."""

    own: ClassVar[Mapping[str, Command]] = {
        "test": Command("Compare models on measurements.", "model_group:models_on_data"),
        "design": Command("Compare excitation sequences, and write one.", "model_group:design"),
        "twin": Command("Make an emulated twin of the present specimen.", "model_group:twin_"),
        "tune": Command("Tune a controller on the emulated twin.", "model_group:tune_"),
        "deploy": Command("Export a model for a controller that runs elsewhere.", "model_group:deploy_"),
    }
    others = "model."


class StudyGroup(Group):
    """Carry a registered study out on emulated rigs, or all that a campaign file names.

    A study repeats a paper's results. `bench study FILE.toml` takes a campaign: runs, models and studies over rigs,
    parameters, seeds and faults; `bench study FILE --help` shows its options.
    """

    own: ClassVar[Mapping[str, Command]] = {"FILE": Command("Carry out a campaign file.", "study_commands:campaign")}
    otherwise = "FILE"

    def __init__(self, **settings: Any) -> None:  # noqa: ANN401 - those of click
        super().__init__(**settings, no_args_is_help=True)

    def registered(self) -> dict[str, registry.RegisteredPart]:
        """Return the registered studies."""
        return dict(registry.entries("studies"))

    def make_callback(self, name: str, part: Any) -> Callable[..., None]:  # noqa: ANN401
        """Return a function that carries a study out."""
        from bench.cli.study_commands import command_of

        return command_of(name, part)


def _command(name: str, function: Callable[..., None], *, add_help_option: bool = True) -> Any:  # noqa: ANN401
    one = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    one.command(name, cls=_OneCommand, context_settings=HELP_OPTIONS, add_help_option=add_help_option)(function)
    return typer.main.get_command(one)
