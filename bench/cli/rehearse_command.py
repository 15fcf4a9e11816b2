"""The command that says what a run would do, before anything moves."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Column, Table

from bench.base import ConfigurationError, print_plain, show_table
from bench.cli.command_support import (
    JsonOption,
    OverrideOption,
    ProtocolArgument,
    RigOption,
    SeedOption,
    SettingsOption,
    parse_assignments,
    write_json,
)
from bench.cli.printing import console, print_rows, show_compilation

if TYPE_CHECKING:
    from bench.execution import Extremes, Rehearsal, Run


def rehearse(
    protocol: ProtocolArgument = None,
    rig: RigOption = None,
    settings: SettingsOption = None,
    overrides: OverrideOption = None,
    seed: SeedOption = 0,
    json_file: JsonOption = None,
) -> None:
    """Carry a protocol out on the emulated twin of a rig, on the virtual clock, and say what a run would do.

    Shown are the number of steps, the duration, how often the operator is asked to do something, the extremes of
    every signal with their distance to the limits of the devices and to the interlocks, and what would trip. Nothing
    moves and nothing is recorded. An emulated rig is its own twin; that of real instruments is the one that its file
    names (`[rig] twin`) or extends. A rig without a twin is connected, to know its limits, and the set-points are
    checked as far as no reading decides.
    """
    from bench.execution import Run
    from bench.protocol import find_protocol

    if protocol is None or rig is None:
        raise ConfigurationError("PROTOCOL and --rig must be given; `bench list` shows both")
    asked = Run(
        protocol=find_protocol(protocol),
        settings=parse_assignments("--set", settings or []),
        rig=rig,
        folder=Path(),
        overrides=parse_assignments("--override", overrides or []),
        seed=seed,
    )
    show_rehearsal(asked, json_file)


def show_rehearsal(run: Run, json_file: Path | None) -> None:
    """Print what a run would do and touch; raises ConfigurationError if it would not complete."""
    from bench.base import Interrupts
    from bench.execution import foresee, say_what_ctrl_c_does

    with Interrupts(say_what_ctrl_c_does) as interrupts, show_compilation():
        rehearsal = foresee(run, console, interrupts)
    _print(rehearsal)
    write_json(json_file, rehearsal.to_json())
    rehearsal.raise_if_wrong()


def _print(rehearsal: Rehearsal) -> None:
    from bench.base import format_duration

    on = f"rehearsed on {rehearsal.twin}" if rehearsal.twin else "planned"
    least = "" if rehearsal.complete else "at least "
    most = ""
    if math.isfinite(rehearsal.at_most) and rehearsal.at_most - rehearsal.seconds >= 1.0:
        most = f", at most {format_duration(rehearsal.at_most)}"
    elif not rehearsal.twin and not rehearsal.complete:
        most = "; the rest is unknown, as readings decide"
    rows = [
        ("steps", f"{least}{rehearsal.steps}"),
        ("duration", f"{least}{format_duration(rehearsal.seconds)}{most}"),
        ("prompts", f"{least}{rehearsal.prompts}"),
    ]
    console.print(f"{rehearsal.protocol} on {rehearsal.rig}, {on}", highlight=False)
    print_rows("", rows)
    table = Table(
        Column("signal", no_wrap=True), "lowest", "highest", "unit", "allowed", "margin", box=None, padding=(0, 1)
    )
    for name, each in rehearsal.extremes.items():
        table.add_row(escape(name), *_cells(each))
    show_table(console, table)
    for finding in rehearsal.findings:
        console.print(
            f"{format_duration(finding.t):>10}  step {finding.step}, {finding.kind}: {finding.text}",
            style={"ERROR": "bold red"}.get(finding.level, "yellow"),
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    for text in rehearsal.shortened:
        print_plain(console, text)
    if rehearsal.status == "completed":
        console.print("nothing would trip" if not rehearsal.findings else "it would complete", highlight=False)


def _cells(extremes: Extremes) -> tuple[str, ...]:
    shown = extremes.display
    plain = replace(shown, unit="")
    allowed = ", ".join(f"{plain.between(each.low, each.high)} ({each.by})" for each in extremes.bounds)
    margin = shown.number(extremes.margin) if math.isfinite(extremes.margin) else ""
    style = "[bold red]" if extremes.margin < 0 else ""
    return shown.number(extremes.low), shown.number(extremes.high), shown.unit, allowed, style + margin
