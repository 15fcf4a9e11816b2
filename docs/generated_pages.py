"""Pages of the reference that follow from the code: commands, rig and campaign files, protocols, instruments, faults.

`docs/conf.py` writes them before Sphinx reads any page, so that they cannot differ from the code.
"""

from __future__ import annotations

import inspect
import re
import sqlite3
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from typer.main import get_command

from bench.base import VirtualClock, registry
from bench.batch.campaign.file import ComparisonsTable, ModelsTable, RunsTable, StudiesTable
from bench.cli import EXIT_CODES, app
from bench.protocol import packaged_protocols
from bench.record import rows
from bench.rig import (
    LONGEST_TURN,
    DashboardLayout,
    Interlock,
    RigTable,
    RoleTable,
    SafetyTable,
    TelemetryTable,
    load_rig,
)
from sim_devices.serving.requests import REQUESTS

_COLUMNS = {
    "meta": "Facts about the run, one a row, as JSON: protocol, parameters, rig, seed, versions, outcome.",
    "signals": "The signals in the order of the columns of `steps` and `telemetry`, with unit and precision.",
    "steps": "One row a finished step, committed before anybody is notified. One column a signal holds the reading, "
    "in SI units; temperatures in °C.",
    "telemetry": "Readings between steps, in batches. One column a signal.",
    "events": "What happened: phases, notes, pauses, interlocks, errors, the safe state, the end.",
    "files": "The content of every file that the run was given.",
}


def write(folder: Path) -> None:
    """Write every page into a folder.

    Parameters
    ----------
    folder : Path
        Made if it is missing; pages in it are replaced where they differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pages: dict[str, Callable[[], Iterator[str]]] = {
        "commands": commands,
        "rig-file": rig_file,
        "campaign-file": campaign_file,
        "instruments": instruments,
        "laboratories": laboratories,
        "protocols": protocols,
        "journal-schema": journal_schema,
        "emulation": emulation,
    }
    for name, lines in pages.items():
        text = "\n".join(lines()) + "\n"
        path = folder / f"{name}.md"
        # An unchanged file keeps its date, so that Sphinx does not read it again.
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def commands() -> Iterator[str]:
    """Yield the lines of the page about the `bench` command."""
    group = get_command(app)
    yield "# Commands\n"
    yield "The texts are those of `bench COMMAND --help`.\n"
    yield f"{EXIT_CODES}\n"
    yield from _commands(group, "bench")


def _commands(group: Any, path: str) -> Iterator[str]:  # noqa: ANN401 - the types of click are a private part of typer
    context = group.make_context(path, [], resilient_parsing=True)
    for name in dict.fromkeys([*group.own, *group.list_commands(context)]):
        command = group.get_command(context, name)
        full = f"{path} {name}"
        yield f"## {full}\n"
        yield f"{_paragraphs(command.help or '')}\n"
        if hasattr(command, "list_commands"):
            yield from (line.replace("## ", "### ", 1) for line in _commands(command, full))
            continue
        parameters = [one for one in command.params if not getattr(one, "hidden", False) and one.name != "help"]
        arguments = [one for one in parameters if one.param_type_name == "argument"]
        usage = " ".join([full, *(_metavar(one) for one in arguments), "[OPTIONS]"])
        yield f"```text\n{usage}\n```\n"
        rows_ = [(_spelling(one), _default(one), one.help or "") for one in parameters]
        yield from _table(("option", "default", "meaning"), rows_)


def _metavar(parameter: Any) -> str:  # noqa: ANN401 - the types of click are a private part of typer
    text = parameter.metavar or parameter.name.upper()
    return f"{text}..." if parameter.nargs == -1 and not text.endswith("...") else text


def _spelling(parameter: Any) -> str:  # noqa: ANN401 - the types of click are a private part of typer
    if parameter.param_type_name == "argument":
        return f"`{_metavar(parameter)}`"
    names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
    return names if parameter.is_flag else f"{names} `{_metavar(parameter)}`"


def _default(parameter: Any) -> str:  # noqa: ANN401 - the types of click are a private part of typer
    default = parameter.default
    if parameter.required or default in (None, False, "", [], ()) or callable(default) or "UNSET" in repr(default):
        return "must be given" if parameter.required else ""
    return f"`{default}`"


def rig_file() -> Iterator[str]:
    """Yield the lines of the page about rig files."""
    import bench.rig.file

    yield "# Rig files\n"
    summary, _, text = inspect.getdoc(bench.rig.file).partition("\n")  # type: ignore[union-attr]
    yield f"{summary}\n{_literal_blocks(text)}\n"
    tables: tuple[tuple[str, type[BaseModel]], ...] = (
        ("[rig]", RigTable),
        ("[roles.NAME]", RoleTable),
        ("[[interlocks]]", Interlock),
        ("[safety]", SafetyTable),
        ("[telemetry]", TelemetryTable),
        ("[dashboard]", DashboardLayout),
    )
    for head, model in tables:
        yield f"## `{head}`\n"
        yield from _fields(model)
    yield "## `[lines.NAME]`\n"
    yield 'A serial line that several devices share: those with `line = "NAME"`. Its keys are keys of their drivers,'
    yield "and count for each of them; a key may not stand in both tables. Each device has an address of its own, and"
    yield "what concerns the port (speed, parity, echo) is the same for all. A silent device may keep its line for"
    yield f"{LONGEST_TURN:g} s at most, which bounds its `timeout` ([how-to](../../how-to/share-a-line.md)).\n"
    yield "The keys of `[devices.NAME]` are those of its driver ([instruments](instruments.md)), the keys of"
    yield "`[emulation]` those of its laboratory ([laboratories](laboratories.md)), and those of `[protocols.NAME]`"
    yield "the parameters of a protocol ([protocols](protocols.md))."


def campaign_file() -> Iterator[str]:
    """Yield the lines of the page about campaign files."""
    yield "# Keys of campaign files\n"
    yield "The tables of a file of `bench study FILE.toml`; [campaigns](../campaign.md) has an example. Paths are"
    yield "relative to the file.\n"
    for table in (RunsTable, ModelsTable, ComparisonsTable, StudiesTable):
        head, _, text = _first_paragraph(table).removeprefix("A table ").partition(": ")
        yield f"## {head}\n"
        yield f"{text[0].upper()}{text[1:]}\n"
        yield from _fields(table)


def emulation() -> Iterator[str]:
    """Yield the lines of the page about the control socket of emulated rigs, and about their faults."""
    yield "# Requests and faults of emulated rigs\n"
    yield "[Emulated instruments](../emulate.md) says how they are used.\n"
    yield "## Requests\n"
    yield "Keys of a request beside `do`. Every request of a rig takes `rig` as well, where several are served.\n"
    told = []
    for name, request in REQUESTS.items():
        fields = {key: info.description or "" for key, info in request.model_fields.items() if key != "rig"}
        keys = "; ".join(f"`{key}`: {text}" for key, text in fields.items())
        told.append((f"`{name}`", keys, _first_paragraph(request)))
    yield from _table(("do", "keys", "what it does"), told)
    of_all: dict[str, Sequence[str]] = {}
    of_rig: dict[str, list[Sequence[str]]] = {}
    for rig in ("vo2", "sma", "hybrid"):
        file = load_rig(rig)
        assert file.laboratory is not None
        laboratory = file.laboratory(file.laboratory_settings, VirtualClock(), 0)
        for name, fault in laboratory.faults.items():
            part, _, kind = name.rpartition(".")
            if part:
                word = "INSTRUMENT" if part in laboratory.lines else "SENSOR"
                summary = re.sub(rf"\b{part}\b", f"`{word}`", fault.summary)
                names = ", ".join(f"`{key}`" for key in fault.values)
                of_all.setdefault(f"{word}.{kind}", (f"`{word}.{kind}`", names, summary))
            else:
                values = "; ".join(_quantity(key, quantity) for key, quantity in fault.values.items())
                of_rig.setdefault(rig, []).append((f"`{name}`", values, fault.summary))
    yield "## Faults of every instrument and sensor\n"
    yield "`count` is the number of answers that are disturbed: 0 for all of the duration, or one without a duration."
    yield "`probability`, 1 if not given, is that of each. The request `help` has the ranges of a rig. Not every line"
    yield "has each fault. The faults of `sma` are those of `mckibben` and `coiled-polymer` too.\n"
    yield from _table(("fault", "values", "what happens"), of_all.values())
    for rig, faults in of_rig.items():
        yield f"## Faults of `{rig}`\n"
        yield from _table(("fault", "values", "what happens"), faults)


def _quantity(name: str, quantity: Any) -> str:  # noqa: ANN401 - its class is no public part of sim_devices
    unit = f" {quantity.unit}" if quantity.unit else ""
    return f"`{name}`: {quantity.description}, {quantity.low:g} to {quantity.high:g}{unit} ({quantity.default:g})"


def instruments() -> Iterator[str]:
    """Yield the lines of the page about drivers."""
    yield "# Instruments\n"
    yield "Drivers that are registered, with their keys in a table `[devices.NAME]` of a rig file.\n"
    yield from _registered("devices", "driver")


def laboratories() -> Iterator[str]:
    """Yield the lines of the page about emulated laboratories."""
    yield "# Laboratories\n"
    yield "Emulated laboratories that are registered, with their keys in the table `[emulation]` of a rig file.\n"
    yield from _registered("laboratories", "laboratory")


def _registered(group: registry.Group, key: str) -> Iterator[str]:
    """Yield a section for each part of a group that a rig file names by `key`: how, what it is, and its settings."""
    for name, entry in registry.entries(group).items():
        part = entry.load()
        yield f"## `{name}`\n"
        yield f'`{key} = "{name}"`, or `"{entry.reference}"`. {_first_paragraph(part)}\n'
        yield from _fields(part.Settings)


def protocols() -> Iterator[str]:
    """Yield the lines of the page about packaged protocols."""
    yield "# Protocols\n"
    yield "`bench run PROTOCOL --rig RIG --set NAME=VALUE`. A default that comes from a slot is that of the rig:"
    yield "`bench run PROTOCOL --rig RIG --help` shows it.\n"
    for name, one in packaged_protocols().protocols.items():
        yield f"## `{name}`\n"
        yield f"{_paragraphs(one.description)}\n"
        if one.slots:
            asked = ", ".join(f"`{slot}` ({kind.__name__})" for slot, kind in one.slots.items())
            used = ", ".join(f"`{slot}`" for slot in one.may_use)
            yield f"Slots: {asked}{f'; uses {used} where the rig binds it' if used else ''}.\n"
        else:
            yield f"Devices and signals: {', '.join(f'`{part}`' for part in one.names)}.\n"
        rows_ = [(f"`{p.name}`", p.default, p.unit, p.allowed, p.text) for p in one.help()]
        yield from _table(("parameter", "default", "unit", "allowed", "meaning"), rows_)


def journal_schema() -> Iterator[str]:
    """Yield the lines of the page about the tables of a journal."""
    yield "# Tables of a journal\n"
    yield f"`{rows.FILE_NAME}`, schema {rows.SCHEMA}."
    yield "Times are laboratory time in s from the start of the run. `checksum` is the CRC-32 of the"
    yield "other columns of the row. [Records](../records.md) says what is kept.\n"
    connection = sqlite3.connect(":memory:")
    for statement in rows.table_definitions(["SIGNAL"]):
        connection.execute(statement)
    for table in rows.TABLES:
        yield f"## `{table}`\n"
        yield f"{_COLUMNS[table]}\n"
        columns = connection.execute(f"PRAGMA table_info({table})").fetchall()
        yield from _table(
            ("column", "type", "key"),
            [(f"`{name}`", kind, "primary" if key else "") for _, name, kind, _, _, key in columns],
        )
    connection.close()
    yield "## Records\n"
    yield "```{eval-rst}\n.. autoclass:: bench.record.rows.StepRecord\n.. autoclass:: bench.record.rows.Event\n```"


def _fields(model: type[BaseModel]) -> Iterator[str]:
    """Yield a table of the fields of a model, and tables of the models inside it."""
    inner: dict[str, type[BaseModel]] = {}
    rows_ = []
    for name, info in model.model_fields.items():
        rows_.append(
            (f"`{name}`", _type(info.annotation, inner), _field_default(info), _limits(info), info.description or "")
        )
    yield from _table(("key", "type", "default", "allowed", "meaning"), rows_)
    for name, one in inner.items():
        yield f"`{name}`: {_first_paragraph(one)}\n"
        yield from _fields(one)


def _type(annotation: object, inner: dict[str, type[BaseModel]]) -> str:
    """Return how a type is written for people; models inside it join `inner`."""
    if inspect.isclass(annotation) and issubclass(annotation, Enum):
        return ", ".join(f"`{one.value}`" for one in annotation)
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        inner[annotation.__name__] = annotation
        return f"table `{annotation.__name__}`"
    arguments = [one for one in typing.get_args(annotation) if one not in (type(None), Ellipsis)]
    origin = typing.get_origin(annotation)
    if origin is dict:
        return "table"
    if origin is typing.Literal:
        return ", ".join(f"`{one}`" for one in arguments)
    if origin is typing.Annotated:
        return _type(arguments[0], inner)
    if origin in (tuple, list) and arguments:
        return "array of " + " and ".join(dict.fromkeys(_type(one, inner) for one in arguments))
    if origin is not None and arguments:
        return " or ".join(dict.fromkeys(_type(one, inner) for one in arguments))
    names = {str: "text", float: "number", int: "integer", bool: "true, false"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))  # type: ignore[call-overload,no-any-return]


def _field_default(info: FieldInfo) -> str:
    if info.is_required():
        return "must be given"
    default = info.get_default(call_default_factory=True) if info.default_factory is None else PydanticUndefined
    empty = default is PydanticUndefined or default is None or default in ("", (), {})
    return "" if empty or isinstance(default, BaseModel) else f"`{default}`"


def _limits(info: FieldInfo) -> str:
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    found = [(signs[key], getattr(one, key)) for one in info.metadata for key in signs if hasattr(one, key)]
    return ", ".join(f"{sign} {value:g}" for sign, value in found)


def _table(heads: Sequence[str], rows_: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield a table without the columns in which nothing stands."""
    content = [[" ".join(str(cell).split()).replace("|", "\\|") for cell in row] for row in rows_]
    kept = [index for index in range(len(heads)) if any(row[index] for row in content)]
    if not kept:
        return
    yield "| " + " | ".join(heads[index] for index in kept) + " |"
    yield "|" + "---|" * len(kept)
    for row in content:
        yield "| " + " | ".join(row[index] for index in kept) + " |"
    yield ""


_SECTION = re.compile(r"^[A-Z]\w+\n-+$", re.MULTILINE)


def _paragraphs(text: str) -> str:
    """Return the prose of a docstring; sections of the numpy convention are left out."""
    return _SECTION.split(inspect.cleandoc(text).replace("\b", ""))[0].strip()


def _first_paragraph(part: object) -> str:
    return _paragraphs(inspect.getdoc(part) or "").split("\n\n")[0].replace("\n", " ")


def _literal_blocks(text: str) -> str:
    """Return a docstring with its blocks after `::` as fenced blocks of TOML."""
    lines, block = [], False
    for line in text.splitlines():
        if not block and line.endswith("::"):
            lines += [line[:-1], "", "```toml"]
            block = True
        elif block and line and not line.startswith(" "):
            while lines and not lines[-1]:
                lines.pop()
            lines += ["```", "", line]
            block = False
        elif not (block and not line and lines[-1] == "```toml"):
            lines.append(line.removeprefix("    ") if block else line)
    return "\n".join([*lines, "```"] if block else lines)
