"""The command `bench rig torture`."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from bench.base import show_table
from bench.cli import JsonOption, console, parse_assignments, write_json

if TYPE_CHECKING:
    # Imported by the function, as `bench --help` imports this module for its help text.
    from sim_devices.torture.running import Cell


def torture(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="An emulated rig: a name, or path/to/rig.toml.")],
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="Only faults of the instrument of this device.")
    ] = None,
    fault: Annotated[str, typer.Option(metavar="WORD", help="Only faults with this in their name.")] = "",
    seeds: Annotated[int, typer.Option(min=1, help="Runs with each fault, each at another instant.")] = 5,
    processes: Annotated[int | None, typer.Option(min=1, help="Worker processes; one a core if not given.")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--override", metavar="KEY=VALUE", help="Replace a value of the rig file; repeatable."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Carry a short run out with each fault of an emulated rig, and judge drivers and bench by it.

    Every actuator is moved while a fault begins: answers are lost, late, damaged, doubled or of another address;
    lines are cut; instruments restart, hang or freeze; plant and sensors fail. All runs are in process on the virtual
    clock. The emulated instruments and the plant are what judges, not what a driver says of them:

    ends: within its planned time and a margin. safe: every output is off at the end; w: by a watchdog. limits: no
    output ever was beyond the limits of the rig file. names: what ended the run names the device at fault. rows:
    every step is in the journal. true: every recorded value is what the plant was, or what the same run shows without
    the fault; a dot where it is the sensor that is at fault, and the record is as it was measured.

    Exit codes: 0 all runs passed; 1 one has failed; 2 the rig has no emulated laboratory, or there is no such fault.
    """
    from sim_devices.torture.running import Task, cells, faults_of, largest_excursion

    task = Task(rig, parse_assignments("--override", overrides or []))
    wanted = faults_of(task, device, fault)
    task = largest_excursion(task)
    console.print(f"{len(wanted)} faults, {seeds} seeds; moved over {task.share:.0%} of the ranges")
    done = [*cells(task, wanted, seeds, processes, console)]
    failed = [cell for cell in done if cell.failures]
    show_table(console, table(done))
    for cell in failed:
        for check in cell.failures:
            text = f"{cell.fault} seed {cell.seed}: {check}: {cell.results[check]} ({cell.status}: {cell.reason})"
            console.print(text, soft_wrap=True)
    console.print(f"{len(done) - len(failed)} of {len(done)} runs passed")
    write_json(json_file, {"rig": rig, "share": task.share, "runs": [asdict(cell) for cell in done]})
    if failed:
        sys.exit(1)


def table(done: Iterable[Cell]) -> Table:
    """Return the runs as a table: a row a fault, with the number of seeds that passed where not all did."""
    from sim_devices.torture.running import CHECKS

    drawn = Table("device", "fault", "ended", *CHECKS, box=None, padding=(0, 2))
    rows: dict[str, list[Cell]] = {}
    for cell in done:
        rows.setdefault(cell.fault, []).append(cell)
    for name, row in rows.items():
        marks = []
        for check in CHECKS:
            bad = sum(check in cell.failures for cell in row)
            kinds = {cell.results[check] for cell in row}
            passed = "w" if "w" in kinds else "." if kinds == {"."} else "ok"
            marks.append(Text(f"{len(row) - bad}/{len(row)}", "red") if bad else Text(passed))
        ended = ", ".join(f"{count} {status}" for status, count in Counter(cell.status for cell in row).items())
        drawn.add_row(row[0].device or "–", name, ended, *marks)
    return drawn
