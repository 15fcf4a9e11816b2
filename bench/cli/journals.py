"""The command that recovers damaged journals."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from bench.base import RecordError, print_plain, print_table
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.printing import console
from bench.cli.run_names import NEWEST, RunArgument


def repair(
    journal: RunArgument = NEWEST,
    second: Annotated[
        list[Path] | None,
        typer.Option(
            "--second", metavar="FILE", help="Second file of the journal that is not where it was left; repeatable."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Repaired copy; journal.recovered.sqlite beside the journal if not given."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Say how far a journal is good, and write a repaired copy of it if it is not; the journal itself stays.

    Each row is compared with its checksum. The copy has the good rows, and those that wait in a second file because
    the journal could not be written or is damaged.

    Exit codes: 0 no row is lost; 2 the copy cannot be written; 3 it is no journal; 8 rows are lost.
    """
    from bench.record import recover

    check_outputs(json_file=json_file, read=[journal, *(second or [])])
    found = recover(journal, second or [], out)
    rows = [
        (name, *(str(cell or "-") for cell in (state.good, state.added, state.missing, state.first_bad)))
        for name, state in found.tables.items()
    ]
    print_table(console, ("table", "good", "from a second file", "lost", "first bad row"), rows, framed=False)
    said = [f"status: {found.status}"]
    if found.problem:
        said.append(f"SQLite finds: {found.problem}")
    said += [f"second file: {path}" for path in found.second_files]
    said.append("the journal is whole" if found.copy is None else f"repaired copy: {found.copy}")
    for line in said:
        print_plain(console, line)
    write_json(
        json_file,
        {
            "journal": str(found.journal),
            "status": found.status,
            "problem": found.problem,
            "tables": {name: asdict(state) for name, state in found.tables.items()},
            "second_files": [str(path) for path in found.second_files],
            "copy": None if found.copy is None else str(found.copy),
            "is_complete": found.is_complete,
        },
    )
    if not found.is_complete:
        sys.exit(RecordError.exit_code)
