"""The `bench` command: its groups put together, and how it ends.

Every command prints for people, and with `--json FILE` writes the same result for programs. Heavy imports
wait until a command needs them, so that `bench --help` answers at once.
"""

from __future__ import annotations

import atexit
import errno
import gc
import sqlite3
import sys
from collections.abc import Mapping, Sequence
from typing import ClassVar, NoReturn

import typer
from rich.markup import escape
from typer.main import get_command_name
from typer.models import CommandInfo

from bench.base import BenchError, ConfigurationError, registry
from bench.cli import (
    calibrations,
    campaign_command as campaign,
    comparisons,
    designs,
    imports,
    journals,
    maintenance_commands as upkeep,
    model_commands as models,
    new,
    panel_command as panel,
    record_commands as records,
    rehearse_command as rehearse,
    repeat_command as repeat,
    resume_command as resume,
    run_commands as runs,
    run_list,
    tune_command as tune,
    twin_command as twin,
    watch,
)
from bench.cli.command_support import error_console, exit_code, fail, told_of_records
from bench.cli.registered import RegisteredCommands, Studies
from bench.cli.streams import standard_streams

_EPILOG = (
    "Exit codes: 0 done; 1 failed, or done but the file of --json could not be written; 2 wrong command, rig file or "
    "parameter (nothing has moved); 3 unusable data or model file; 4 device fault; 5 interlock; 6 not steady in "
    "time; 7 safe state not confirmed; 8 record damaged or incomplete; 9 a resumed specimen is not as it was; 10 a "
    "controller does not converge; 130 ended by the operator. Try: bench list, and bench run PROTOCOL --rig RIG "
    "--clock virtual"
)

_MID_WAY = ("safe", "recover")
"""Commands that have devices open without asking for Ctrl-C in between."""

_PARTS = (
    runs.app,
    rehearse.app,
    repeat.app,
    campaign.app,
    resume.app,
    run_list.app,
    upkeep.app,
    panel.app,
    models.app,
    designs.app,
    comparisons.app,
    calibrations.app,
    records.app,
    imports.app,
    watch.app,
    journals.app,
    twin.app,
    tune.app,
    new.app,
)


class BenchCommands(RegisteredCommands):
    """The commands of `bench`."""

    own: ClassVar[Mapping[str, CommandInfo]] = {
        info.name or get_command_name(info.callback.__name__): info
        for part in _PARTS
        for info in part.registered_commands
        if info.callback is not None
    }


app = typer.Typer(
    name="bench",
    cls=BenchCommands,
    help="A lab bench for smart-material actuators: run step protocols on real or emulated instruments, "
    "identify hysteresis models from the measurements, and apply them.",
    epilog=_EPILOG,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
reproduce_ = typer.Typer(
    help="Reproduce a paper's results on its emulated rig, at the wire level, on the virtual clock.",
    no_args_is_help=True,
    cls=Studies,
)
app.add_typer(reproduce_, name="reproduce")


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command; every error that the bench raises becomes one message and an exit code."""
    # Imports leave thousands of objects that stay: by its default the collector would search them again and again, a
    # tenth of the time to start.
    gc.set_threshold(10_000, 20, 20)
    # The collector would search all that the libraries have left behind: up to a second, after the work is done.
    atexit.register(gc.freeze)
    with standard_streams(), told_of_records():
        _carry_out(arguments)


def _carry_out(arguments: Sequence[str] | None) -> NoReturn:
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        _check_words(words)
        registry.check_own_packages()
        app(args=words)
    except BenchError as error:
        fail(error)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        fail(ConfigurationError(f"{str(error.filename)[:60]}…: the name of a file or folder is too long"))
    except sqlite3.Error as error:
        error_console.print("[bold red]error:[/] the journal cannot be written:", escape(str(error)), highlight=False)
        sys.exit(1)
    # As typer ends a command at Ctrl-C: without a word.
    except SystemExit as ended:
        if _is_by_keyboard(ended):
            error_console.print(f"[yellow]ended by Ctrl-C:[/] {_state_of_outputs(words)}", highlight=False)
        code = 0 if ended.code is None else ended.code
        if isinstance(code, int) and (code := exit_code(code)) != ended.code:
            sys.exit(code)
        raise
    sys.exit(exit_code(0))


def _check_words(words: Sequence[str]) -> None:
    """Raise ConfigurationError for a word whose bytes are no text: neither a record nor a log could hold it."""
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise ConfigurationError(
                f"{word!a}: its bytes are no text in {sys.getfilesystemencoding()}, the encoding of this system; "
                "expected names that are"
            ) from None


def _is_by_keyboard(error: BaseException | None) -> bool:
    """Return whether Ctrl-C is what an exception comes from; that of a run is heard by its `Interrupts`."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _state_of_outputs(words: Sequence[str]) -> str:
    command = next((word for word in words if not word.startswith("-")), "")
    if command in _MID_WAY:
        return f"in the middle of {command}; `bench safe RIG` makes sure that every output is off"
    return "no device was opened, nothing has moved; the outputs are as they were"
