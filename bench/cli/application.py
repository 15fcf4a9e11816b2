"""The `bench` command: what is in it, and how it ends.

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
from typing import Annotated, Any, ClassVar, NoReturn

import typer

from bench.base import AbortError, BenchError, ConfigurationError, closest, registry
from bench.cli.command_support import exit_code, told_of_records
from bench.cli.groups import HELP_OPTIONS, Command, Group
from bench.cli.streams import standard_streams

EXIT_CODES = (
    "Exit codes: 0 done; 1 failed, or done but the file of --json could not be written; 2 wrong command, rig file or "
    "parameter (nothing has moved); 3 unusable data or model file; 4 device fault; 5 interlock; 6 not steady in "
    "time; 7 safe state not confirmed; 8 record damaged or incomplete; 9 a resumed specimen is not as it was; 10 a "
    "controller does not converge; 130 ended by the operator."
)

_MID_WAY = ("safe", "rig clear")
"""Commands that have devices open without asking for Ctrl-C in between."""

_RUN, _LOOK, _MODEL, _EXTEND = "Run", "Look", "Model", "Rig & extend"


class BenchCommands(Group):
    """The commands of `bench`."""

    panel = _EXTEND
    own: ClassVar[Mapping[str, Command]] = {
        "rehearse": Command("Say what a run would do, before anything moves.", "run_commands:rehearse", _RUN),
        "run": Command("Carry a protocol out on a rig, and record it.", "run_commands:run", _RUN, has_help=True),
        "resume": Command("Go on with a run that was ended or died.", "run_commands:resume", _RUN),
        "panel": Command("Move a rig by hand, or answer a run in progress.", "panel_command:panel", _RUN),
        "safe": Command("Bring every device of a rig into its safe state.", "rig_commands:safe", _RUN),
        "list": Command("List rigs, protocols, models, controllers, studies.", "part_commands:list_", _LOOK),
        "show": Command("Show one of these in full.", "part_commands:show", _LOOK),
        "runs": Command("List, export, import, repair and compare runs.", "groups:RunsGroup", _LOOK),
        "view": Command("Show a run in a viewer, live or once more.", "view:view", _LOOK),
        "report": Command("Make tables, figures and a page of a run.", "record_commands:report", _LOOK),
        "identify": Command("Identify a hysteresis model from measurements.", "model_commands:identify_", _MODEL),
        "predict": Command("Apply a model to a column of inputs.", "model_commands:predict_", _MODEL),
        "invert": Command("Compute the set-points for a column of targets.", "model_commands:invert", _MODEL),
        "model": Command("Test models, design experiments, make twins, tune, deploy.", "groups:ModelGroup", _MODEL),
        "study": Command("Carry out a study or a campaign on emulated rigs.", "groups:StudyGroup", _MODEL),
        "rig": Command("Check, clear, calibrate and emulate instruments.", "groups:RigGroup", _EXTEND),
        "new": Command("Write the skeleton of a device, protocol, model, rig.", "part_commands:new", _EXTEND),
    }
    former: ClassVar[Mapping[str, str]] = {
        "repeat": "bench run --from RUN",
        "campaign": "bench study FILE.toml",
        "reproduce": "bench study NAME",
        "recover": "bench rig clear",
        "doctor": "bench rig check",
        "calibrate": "bench rig calibrate",
        "emulate": "bench rig emulate",
        "shakedown": "bench rig check RIG --exercise",
        "find": "bench rig find",
        "torture": "bench rig torture",
        "design": "bench model design",
        "compare": "bench model test, and for two runs bench runs compare",
        "twin": "bench model twin",
        "tune": "bench model tune",
        "export": "bench runs export",
        "import": "bench runs import",
        "recover-journal": "bench runs repair",
        "watch": "bench view",
        "replay": "bench view",
        "identify-*": "bench identify RUN... --model NAME",
    }


app = typer.Typer(
    name="bench",
    cls=BenchCommands,
    epilog="Every command has --help. Start with: bench list; bench run PROTOCOL --rig RIG",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=HELP_OPTIONS,
)


def _show_version(is_wanted: bool) -> None:
    if is_wanted:
        from bench import __version__

        typer.echo(f"bench {__version__}")
        raise typer.Exit


@app.callback()
def bench(
    *,
    _version: Annotated[
        bool, typer.Option("--version", help="Show the version.", is_eager=True, callback=_show_version)
    ] = False,
) -> None:
    """Run protocols on smart-material actuators, real or emulated; identify hysteresis models, and apply them."""


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
    code: int | None = None
    try:
        _check_words(words)
        registry.check_own_packages()
        code = app(args=words, prog_name="bench", standalone_mode=False)
    except BenchError as error:
        _fail(error)
    except (typer.Abort, KeyboardInterrupt):
        code = AbortError.exit_code
    except typer.TyperException as error:
        _fail(ConfigurationError(_usage(error)))
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        _fail(ConfigurationError(f"{str(error.filename)[:60]}…: the name of a file or folder is too long"))
    except sqlite3.Error as error:
        _fail(BenchError(f"the journal cannot be written: {error}"))
    except SystemExit as ended:
        if isinstance(ended.code, int | None) and (code := exit_code(ended.code or 0)) != (ended.code or 0):
            sys.exit(code)
        raise
    # As typer ends a command at Ctrl-C: without a word.
    if code == AbortError.exit_code:
        from rich.text import Text

        from bench.cli.printing import error_console

        error_console.print(Text("ended by Ctrl-C:", "yellow"), _state_of_outputs(words))
    sys.exit(exit_code(code or 0))


def _fail(error: BenchError) -> NoReturn:
    # What prints is imported only now: it takes a third of the time to start.
    from bench.cli.printing import print_error

    print_error(error)
    sys.exit(error.exit_code)


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


def _usage(error: Any) -> str:  # noqa: ANN401 - of typer
    """Return what is wrong with the use of a command, in a line."""
    context = getattr(error, "ctx", None)
    if context is None:
        return str(error)
    parameters = context.command.params
    if (name := getattr(error, "option_name", None)) is not None and hasattr(error, "possibilities"):
        known = [option for each in parameters for option in (*each.opts, *each.secondary_opts) if option[0] == "-"]
        return f"{context.command_path}: there is no option {name}; {closest(name, known, _help_of(context))}"
    if hasattr(error, "param_type"):
        # click names the first missing parameter only. It has processed those that are given before.
        left = [each for each in parameters if each.required and context.params.get(each.name) is None]
        return f"{context.command_path}: missing: {', '.join(map(_spelled, left))}; see {_help_of(context)}"
    if (cause := getattr(error.__cause__, "errors", None)) is not None:
        from bench.base import explain

        return f"{context.command_path}: {_spelled(error.param)} {cause()[0]['input']}: {explain(cause()[0])}"
    return f"{context.command_path}: {error.format_message().removeprefix('Got ').rstrip('.')}"


def _spelled(parameter: Any) -> str:  # noqa: ANN401 - of typer
    return str(parameter.opts[-1] if parameter.opts[0][0] == "-" else parameter.metavar or parameter.name.upper())


def _help_of(context: Any) -> str:  # noqa: ANN401 - of typer
    return f"`{context.command_path} --help`"


def _state_of_outputs(words: Sequence[str]) -> str:
    command = " ".join([word for word in words if not word.startswith("-")][:2])
    if command.startswith(_MID_WAY):
        return f"in the middle of {command}; `bench safe RIG` makes sure that every output is off"
    return "no device was opened, nothing has moved; the outputs are as they were"
