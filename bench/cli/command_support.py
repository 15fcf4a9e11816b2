"""Shared by the commands: options, files for results, and what is missing in records.

Rich is imported by what prints only, so that help answers at once.
"""

from __future__ import annotations

import os
import shlex
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, TextIO

import typer

from bench.base import (
    BenchError,
    ConfigurationError,
    DataError,
    IncompleteRecordWarning,
    json_text,
    write_whole,
)
from bench.cli.streams import write_out

FigureFormatOption = Annotated[
    Literal["png", "pdf", "svg"], typer.Option("--figures", help="Format of the figures; pdf and svg for papers.")
]

UNSAFE_EXIT_CODE = 7

STANDARD_OUTPUT = Path("-")
"""What `--json` takes for the standard output."""


def _take_json(context: typer.Context, path: Path | None) -> Path | None:
    """Check the file of `--json` before its command does anything; with `-` texts go to the standard error."""
    if path == STANDARD_OUTPUT:
        from bench.cli.printing import console

        console.stderr = True
        context.call_on_close(lambda: setattr(console, "stderr", False))
    elif path is not None:
        check_outputs(json_file=path)
    return path


JsonOption = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Write the result as JSON, for programs; - writes it to the standard output, and texts to the standard "
        "error.",
        callback=_take_json,
    ),
]
LiveOption = Annotated[
    bool, typer.Option("--live/--no-live", help="Open the live view, or print its address where there is no display.")
]
NotifyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--notify",
        metavar="COMMAND",
        help="Command to start at a pause, a prompt, a warning, a trip and the end, with the facts in BENCH_… "
        "variables and as JSON on its input; or mailto:ADDRESS, or https://ADDRESS of a webhook. Repeatable.",
    ),
]


def complete_rig(incomplete: str) -> list[str]:
    """Return the rigs whose names begin so, for the completion of a shell."""
    return _listed("rigs", incomplete)


def complete_protocol(incomplete: str) -> list[str]:
    """Return the protocols whose names begin so, for the completion of a shell."""
    return _listed("protocols", incomplete)


def complete_setting(context: typer.Context, incomplete: str) -> list[str]:
    """Return the parameters of the protocol whose names begin so, for the completion of a shell."""
    from bench.protocol import find_protocol

    # An option without its value leaves the words before it unread.
    protocol = context.params.get("protocol") or next(iter(context.args), "")
    try:
        names = find_protocol(protocol).parameters.model_fields
    except ConfigurationError:
        return []
    return [f"{name}=" for name in names if name.startswith(incomplete)]


def _listed(kind: str, incomplete: str) -> list[str]:
    from bench.cli.listing import listing

    return [name for name in listing()[kind] if name.startswith(incomplete)]


RigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="RIG",
        help="Name of a packaged rig, or a rig file: path/to/rig.toml.",
        autocompletion=complete_rig,
    ),
]
ProtocolArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="PROTOCOL",
        help="Name of a protocol, or a file of your own: path/to/file.py[:NAME].",
        autocompletion=complete_protocol,
    ),
]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Set a parameter of the protocol; repeatable.",
        autocompletion=complete_setting,
    ),
]
OverrideOption = Annotated[
    list[str] | None,
    typer.Option(
        "--override",
        metavar="KEY=VALUE",
        help="Replace a value of the rig file, such as devices.NAME.port=/dev/ttyUSB1; repeatable.",
    ),
]
AttachOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Endpoints file of `bench rig emulate --json`: use the instruments served there, on their clock.",
    ),
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of all random numbers of an emulated laboratory.")]


@contextmanager
def told_of_records() -> Iterator[None]:
    """Print once what is missing in a record that is opened within; `write_json` writes it for programs too."""

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if not issubclass(category, IncompleteRecordWarning):
            otherwise(message, category, filename, lineno, file, line)
        elif str(message) not in _of_records:
            from bench.cli.printing import warn

            _of_records.append(str(message))
            warn(str(message))

    with warnings.catch_warnings():
        otherwise = warnings.showwarning
        warnings.showwarning = show
        warnings.simplefilter("always", IncompleteRecordWarning)
        try:
            yield
        finally:
            _of_records.clear()


_of_records: list[str] = []
"""What is missing in the records that the command has opened."""


def parse_assignments(option: str, texts: Sequence[str]) -> dict[str, str]:
    """Split texts of the form `key=value`.

    Raises ConfigurationError if one is not of this form, or a key comes twice.
    """
    pairs: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise ConfigurationError(f"{option} {text!r}: expected KEY=VALUE")
        if key in pairs:
            raise ConfigurationError(f"{option}: {key} is given twice")
        pairs[key] = value
    return pairs


def parse_numbers(option: str, texts: Sequence[str]) -> dict[str, int | float]:
    """Split texts of the form `key=number`; errors as `parse_assignments`, or if a value is not a number."""
    numbers: dict[str, int | float] = {}
    for key, text in parse_assignments(option, texts).items():
        try:
            numbers[key] = int(text) if text.lstrip("-").isdigit() else float(text)
        except ValueError:
            raise ConfigurationError(f"{option} {key}={text}: expected a number") from None
    return numbers


def given_parameters(context: typer.Context) -> list[Any]:
    """Return the parameters that the command line gives, as typer describes them."""
    sources = ((each, context.get_parameter_source(each.name or "")) for each in context.command.params)
    return [each for each, source in sources if source is not None and source.name == "COMMANDLINE"]


def check_given(context: typer.Context, taken: Collection[str], why: str) -> None:
    """Raise ConfigurationError if the command line gives a parameter that is not among those `taken`; says why."""
    for parameter in given_parameters(context):
        if parameter.name not in taken:
            given = max(parameter.opts, key=len) if parameter.param_type_name == "option" else parameter.name.upper()
            raise ConfigurationError(f"{why}; leave {given} out")


def command_line(context: typer.Context) -> str:
    """Return a command with all that was set, as a shell takes it; what was left at its default is left out."""
    options: list[str] = []
    arguments: list[str] = []
    for each in given_parameters(context):
        value = context.params[each.name]
        if each.param_type_name != "option":
            arguments += map(str, value if each.nargs != 1 else [value])
        elif each.is_flag:
            options.append((each.opts if value else each.secondary_opts)[0])
        else:
            for one in value if each.multiple else [value]:
                options += [each.opts[0], *map(str, one if each.nargs != 1 else [one])]
    return shlex.join(["bench", context.info_name or "", *arguments, *options])


def check_outputs(
    *,
    out: Path | None = None,
    card: Path | None = None,
    figures: Path | None = None,
    html: Path | None = None,
    json_file: Path | None = None,
    folder: Path | None = None,
    read: Sequence[Path] = (),
) -> None:
    """Check, before any computing, that the files and figures that are asked for can be written.

    A file needs its folder to be there; the `folder` of `--out` and that of the figures are made. No output may be
    one of the files that are `read`, or another output. Raises ConfigurationError for `--json` and the folder of
    `--out`, DataError for the others: names the option and the folder.
    """
    taken = {path.resolve(): "it is read" for path in read}
    for path, option, kind in (
        (out, "--out", DataError), (card, "--card", DataError), (html, "--html", DataError),
        (json_file, "--json", ConfigurationError),
    ):  # fmt: skip
        if path is None or (path == STANDARD_OUTPUT and option == "--json"):
            continue
        if path.is_dir():
            raise kind(f"{option} {path} cannot be written: it is a folder")
        if not path.parent.is_dir():
            raise kind(f"{option} {path} cannot be written: there is no folder {path.parent}")
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise kind(f"{option} {path} cannot be written: permission denied")
        if (why := taken.get(path.resolve())) is not None:
            raise kind(f"{option} {path} cannot be written: {why}; choose another name")
        taken[path.resolve()] = f"it is that of {option}"
    if folder is not None:
        _check_folder("--out", folder, ConfigurationError)
    if figures is not None:
        from bench.analysis import check_matplotlib

        check_matplotlib()
        _check_folder("--figures", figures, DataError)


def _check_folder(option: str, path: Path, kind: type[BenchError]) -> None:
    existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise kind(f"{option} {path}: the folder cannot be made in {existing}")


def write_json(path: Path | None, content: Any) -> None:  # noqa: ANN401 - anything that JSON can hold
    """Write a result for programs, if a file was asked for.

    The work is done by then. If the file cannot be written all the same, as the disk is full, that is an error with
    a message; the command goes on to its end, and `exit_code` says what it exits with.
    """
    if path is None:
        return
    if _of_records and isinstance(content, Mapping):
        content = {**content, "missing_rows": list(_of_records)}
    text = json_text(content, indent=1) + "\n"
    if path == STANDARD_OUTPUT:
        failure = write_out(text)
    else:
        try:
            write_whole(path, text)
            failure = ""
        except OSError as error:
            failure = error.strerror or str(error)
    if failure:
        from bench.cli.printing import print_error

        _unwritten.append(path)
        print_error(BenchError(f"--json {path} cannot be written: {failure}; the work is done"))


_unwritten: list[Path] = []
"""Files of `--json` that could not be written after the work."""


def exit_code(of_the_work: int) -> int:
    """Return what a command exits with, after all that it has printed.

    That is the code of its work. If this is 0 and a file of `--json` could not be written, it is 1: a program must
    not go on as if the file were there, and code 2 would say that nothing has moved.
    """
    unwritten = bool(_unwritten)
    _unwritten.clear()
    return 1 if unwritten and not of_the_work else of_the_work
