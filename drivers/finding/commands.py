"""The command `bench rig find`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.base import ConfigurationError, print_table, write_whole
from bench.cli import JsonOption, console, parse_assignments, write_json


def find(
    rig: Annotated[
        str | None,
        typer.Argument(metavar="RIG", help="Rig whose devices are looked for; without it ports are listed."),
    ] = None,
    further: Annotated[
        list[str] | None,
        typer.Option("--port", metavar="PATH", help="A port that the system does not list; repeatable."),
    ] = None,
    hosts: Annotated[
        list[str] | None, typer.Option("--host", help="Address of a T7 beyond the local network; repeatable.")
    ] = None,
    write: Annotated[
        bool,
        typer.Option("--write", help="Write port and serial_number of each device that was found into the rig file."),
    ] = False,
    attach: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Endpoints file of `bench rig emulate --json`: look at the ports that are served."
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--override", metavar="KEY=VALUE", help="Replace a value of the rig file; repeatable."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """List serial ports and LabJack T7s, and find out which device of a rig is at which of them.

    At each port that nobody holds, those of the rig file among them, the devices of the rig are asked for in turn,
    each in its own dialect, and for nothing but its identity: nothing is configured and nothing moves. An empty line
    shows whether an adapter echoes. Where nothing answers, other speeds and parities are tried. Equal instruments
    are told apart by the key serial_number.

    Exit codes: 0 every device was found, or there is no rig; 1 some were not, or are interchangeable; 2 the rig file
    is wrong.
    """
    from bench.rig import EMULATED, load_rig, port_of, read_endpoints
    from drivers.finding.places import answers, askable, keys_of, placements
    from drivers.finding.ports import ports

    asked: list[str] = []
    if write and not (rig or "").endswith(".toml"):
        why = f"{rig} is a packaged rig; copy its file, and give the path of the copy" if rig else "needs a rig file"
        raise ConfigurationError(f"--write: {why}")
    file = None if rig is None else load_rig(rig, parse_assignments("--override", overrides or []))
    if attach is not None:
        rigs = read_endpoints(attach).served.values()
        asked = [each.port for one in rigs for each in one.instruments.values()]
    elif file is not None:
        own = (port_of(entry.settings) for entry in askable(file))
        asked = [port for port in own if not port.startswith((EMULATED, "visa://"))]
    known = ports([*(further or []), *asked], hosts or [], search=attach is None)
    rows = [(each.name, each.description, each.serial_number, each.problem) for each in known]
    print_table(console, ("port", "description", "USB serial number", "remark"), rows, framed=False)
    if rig is None or file is None:
        write_json(json_file, {"ports": [asdict(each) for each in known], "devices": {}})
        return
    placed = placements(file, answers(file, known), known)
    rows = [
        (
            one.device,
            one.answer.port.name if one.answer else "–",
            str(one.answer.identity if one.answer else "–"),
            one.remark,
        )
        for one in placed
    ]
    console.print()
    print_table(console, ("device", "port", "instrument", "remark"), rows, framed=False)
    if write:
        found = zip(placed, askable(file), strict=True)
        _write(Path(rig), [keys_of(entry, one.answer) for one, entry in found if one.answer])
    write_json(
        json_file, {"ports": [asdict(each) for each in known], "devices": {one.device: asdict(one) for one in placed}}
    )
    if not all(one.is_settled for one in placed):
        sys.exit(1)


def _write(path: Path, found: Iterable[Mapping[tuple[str, str], Mapping[str, Any]]]) -> None:
    """Write keys of tables into a rig file, whose comments stay."""
    import tomlkit

    document: Any = tomlkit.parse(path.read_text(encoding="utf-8"))
    for tables in found:
        for (kind, name), keys in tables.items():
            if keys:
                tables_of_kind = document.setdefault(kind, tomlkit.table(is_super_table=True))
                tables_of_kind.setdefault(name, tomlkit.table()).update(keys)
            # What the devices of a line say themselves may not stand in its table as well.
            for device in document.get("devices", {}).values() if kind == "lines" else ():
                for key in keys.keys() & device.keys() if device.get("line") == name else ():
                    del device[key]
    write_whole(path, tomlkit.dumps(document))
    console.print(f"written: {path}")
