"""The commands that carry a protocol out: run, rehearse and resume."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Column, Table
from rich.text import Text

from bench.base import BenchError, ConfigurationError, counted, format_duration, print_plain, print_table, show_table
from bench.cli.command_support import (
    UNSAFE_EXIT_CODE,
    AttachOption,
    JsonOption,
    LiveOption,
    NotifyOption,
    OverrideOption,
    ProtocolArgument,
    RigOption,
    SeedOption,
    SettingsOption,
    check_given,
    check_outputs,
    parse_assignments,
    write_json,
)
from bench.cli.printing import console, print_error, print_rows, show_compilation, warn
from bench.cli.run_names import NEWEST, RunArgument, find_run

if TYPE_CHECKING:
    from bench.execution import Extremes, Rehearsal, Run, RunResult


def run(
    context: typer.Context,
    protocol: ProtocolArgument = None,
    rig: RigOption = None,
    from_run: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="RUN",
            help="Carry this run out again, in place of PROTOCOL; see above.",
            parser=find_run,
        ),
    ] = None,
    settings: SettingsOption = None,
    overrides: OverrideOption = None,
    seed: SeedOption = 0,
    clock: Annotated[
        str | None,
        typer.Option(
            metavar="CLOCK",
            help="On emulated rigs: virtual (as fast as possible; if not given), wall, or xN (N times as fast as the "
            "wall clock; a machine that cannot keep up slows the laboratory down, and the factor reached is "
            "recorded). Hardware has wall alone.",
        ),
    ] = None,
    attach: AttachOption = None,
    faults: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Faults of the emulated laboratory from a file (.toml, .jsonl): at = seconds of laboratory time "
            "from the start of the run, or rate an hour with a seed; fault, values, duration. "
            "docs/reference/emulate.md lists them.",
        ),
    ] = None,
    interlock_rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            min=0.01,
            max=50.0,
            help="Look at the interlocks of an emulated rig so often in a laboratory second, beside each reading; on "
            "hardware the rig file says it ([safety] rate, 5 Hz).",
        ),
    ] = None,
    rehearse: Annotated[
        bool,
        typer.Option(
            "--rehearse/--no-rehearse",
            help="Rehearse the run on the emulated twin of the rig first, and refuse it if it would not complete; on "
            "the virtual clock it is not rehearsed.",
        ),
    ] = True,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what the run would do and touch, as `bench rehearse` does.")
    ] = False,
    accuracy: Annotated[
        str | None,
        typer.Option(
            metavar="U",
            help="Refuse the run, before anything moves, unless the uncertainty budget of the controlled signal "
            "supports this: largest expanded uncertainty (95 %) in its unit, or with one, such as 2 or '20 µm'.",
        ),
    ] = None,
    notify: NotifyOption = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Parent of the run's folder.")] = Path("recordings"),
    live: LiveOption = False,
    json_file: JsonOption = None,
    help_: Annotated[
        bool,
        typer.Option(
            "-h",
            "--help",
            help="Show this message; after PROTOCOL also its parameters, and with --rig their defaults there.",
        ),
    ] = False,
) -> None:
    """Carry a protocol out on a rig, record it, and leave every device in its safe state.

    The run is rehearsed on the rig's emulated twin before anything moves. Ctrl-C pauses at the next
    step and asks; Ctrl-C again ends at once; so does every signal that would end a process, such as
    SIGTERM, SIGHUP and SIGUSR1. However the run ends, every device is brought into its safe state,
    and what was recorded so far is kept.

    `--from RUN` carries a run out again from its record alone, and says whether the same came out. Protocol,
    parameters, seed, clock, faults and the content of every file that the run was given are those of the record. A
    run that was emulated has its rig from the record as well; on the virtual clock its values come out equal to the
    last bit. Any other run is repeated on the rig that you name by --rig, with --override or --attach, and what
    differs from the record is printed before anything moves. A record is code: its protocol and the modules of its
    rig file are run as they were kept.
    """
    if from_run is not None:
        taken = ("from_run", "out", "rig", "overrides", "attach", "live", "json_file")
        check_given(context, taken, "--from: the record says it")
        _repeat(from_run, out, rig, parse_assignments("--override", overrides or []), attach, json_file, live=live)
        return
    from bench.protocol import find_protocol

    if help_ or protocol is None:
        console.print(context.get_help())
        if protocol is not None:
            print_protocol(find_protocol(protocol), rig)
        return
    if rig is None:
        raise ConfigurationError("--rig is missing; `bench list` shows the installed rigs")
    if attach is not None and (clock not in (None, "wall") or seed):
        raise ConfigurationError("--attach: clock and seed are the server's; leave --clock and --seed out")
    check_outputs(
        json_file=json_file, folder=None if dry_run else out, read=[Path(rig)] if rig.endswith(".toml") else []
    )
    definition = find_protocol(protocol)
    given = parse_assignments("--set", settings or [])

    from bench.base import Interrupts
    from bench.execution import Run, carry_out, say_what_ctrl_c_does

    asked = Run(
        protocol=definition,
        settings=given,
        rig=rig,
        overrides=parse_assignments("--override", overrides or []),
        seed=seed,
        clock=clock,
        folder=out,
        live=live,
        attach=attach,
        interlock_rate=interlock_rate,
        faults=faults,
        rehearse=rehearse,
        notify=tuple(notify or ()),
        accuracy=accuracy,
    )
    if dry_run:
        if not rehearse:
            raise ConfigurationError("--dry-run is a rehearsal; leave --no-rehearse out")
        show_rehearsal(asked, json_file)
        return
    # Until the result is printed: a terminal that hangs must not keep the process from being ended.
    with Interrupts(say_what_ctrl_c_does) as interrupts:
        with show_compilation():
            result = carry_out(asked, console, interrupts)
        print_result(result, json_file)


def _repeat(
    run: Path,
    out: Path,
    rig: str | None,
    overrides: Mapping[str, str],
    attach: Path | None,
    json_file: Path | None,
    *,
    live: bool,
) -> None:
    """Carry a recorded run out again, and say whether the same came out."""
    from bench.analysis import compare_runs
    from bench.base import Interrupts
    from bench.execution import repeat, say_what_ctrl_c_does
    from bench.record import Record

    check_outputs(json_file=json_file, folder=out, read=[run])
    with Interrupts(say_what_ctrl_c_does) as interrupts:
        with show_compilation():
            found = repeat(
                run, out=out, console=console, rig=rig, overrides=overrides, attach=attach, live=live,
                interrupts=interrupts,
            )  # fmt: skip
        with Record(found.original) as before, Record(found.result.folder) as now:
            comparison = compare_runs(before, now)
        differ = ", ".join(name for name, same in comparison.equal.items() if not same)
        if not differ:
            console.print(f"as the original: {', '.join(comparison.equal)} are equal to the last bit")
        else:
            text = f"{differ} differ from the original: bench runs compare {found.original} {found.result.folder}"
            warn(text) if found.is_exact else print_plain(console, text)
        print_result(found.result, json_file, {"repeats": str(found.original), **comparison.to_json()})


def print_result(
    result: RunResult, json_file: Path | None, more: Mapping[str, Any] | None = None, *, can_resume: bool = True
) -> None:
    """Print how a run ended, write it with `more` for programs, and exit with the code of what ended it."""
    from bench.rig import SAFE

    outcome, ratio = result.outcome, result.time_ratio
    # Of a run that was resumed, this process has seen the end only.
    end = (
        ""
        if outcome.own_seconds >= outcome.laboratory_seconds
        else f", the last {format_duration(outcome.own_seconds)} of it"
    )
    console.print(
        f"{outcome.status}: {counted(outcome.steps, 'step')}, {format_duration(outcome.laboratory_seconds)} of "
        f"laboratory time{end} in {format_duration(result.wall_seconds)}"
        + (f" ({ratio:.0f} times as fast)" if ratio >= 2 else ""),
    )
    if outcome.pace is not None and not outcome.pace.is_reached:
        console.print(f"clock: {outcome.pace}")
    print_plain(console, f"record: {result.folder}")
    following = "report" if outcome.status == "completed" else "resume" if outcome.steps and can_resume else ""
    if following:
        print_plain(console, f"next: {shlex.join(['bench', following, str(result.folder)])}")
    write_json(
        json_file,
        {
            "folder": str(result.folder),
            "status": outcome.status,
            "reason": outcome.reason,
            "steps": outcome.steps,
            "laboratory_seconds": outcome.laboratory_seconds,
            "wall_seconds": result.wall_seconds,
            "safe_state": dict(outcome.safe_state),
            "is_safe": outcome.is_safe,
            **(more or {}),
        },
    )
    for name, state in outcome.safe_state.items():
        if state != SAFE:
            print_error(BenchError(f"{name} is NOT in its safe state: {state}"))
    if outcome.error is not None:
        if not isinstance(outcome.error, BenchError):
            raise outcome.error
        print_error(outcome.error)
    # What is not safe matters more than what ended the run.
    if not outcome.is_safe:
        sys.exit(UNSAFE_EXIT_CODE)
    if isinstance(outcome.error, BenchError):
        sys.exit(outcome.error.exit_code)


def print_protocol(definition: Any, rig: str | None = None) -> None:  # noqa: ANN401 - a ProtocolDefinition
    """Print a protocol's help: what it does and what can be set; with a rig, its defaults and units."""
    from rich.markdown import Markdown

    from bench.rig import load_rig

    file = load_rig(rig) if rig is not None else None
    console.print(Markdown(f"**{definition.name}**: {definition.description}"))
    console.print()
    entries = definition.help(file.roles, file.protocols.get(definition.name)) if file else definition.help()
    rows = [(entry.name, entry.default, entry.unit, entry.allowed, entry.text) for entry in entries]
    print_table(console, ("--set", "default", "unit", "allowed", "what it does"), rows, "parameters")


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
    console.print(f"{rehearsal.protocol} on {rehearsal.rig}, {on}")
    print_rows("", rows)
    table = Table(
        Column("signal", no_wrap=True), "lowest", "highest", "unit", "allowed", "margin", box=None, padding=(0, 1)
    )
    for name, each in rehearsal.extremes.items():
        table.add_row(name, *_cells(each))
    show_table(console, table)
    for finding in rehearsal.findings:
        console.print(
            f"{format_duration(finding.t):>10}  step {finding.step}, {finding.kind}: {finding.text}",
            style={"ERROR": "bold red"}.get(finding.level, "yellow"),
            soft_wrap=True,
        )
    for text in rehearsal.shortened:
        print_plain(console, text)
    if rehearsal.status == "completed":
        console.print("nothing would trip" if not rehearsal.findings else "it would complete")


def _cells(extremes: Extremes) -> tuple[str | Text, ...]:
    shown = extremes.display
    plain = replace(shown, unit="")
    allowed = ", ".join(f"{plain.between(each.low, each.high)} ({each.by})" for each in extremes.bounds)
    margin = shown.number(extremes.margin) if math.isfinite(extremes.margin) else ""
    style = "bold red" if extremes.margin < 0 else ""
    return shown.number(extremes.low), shown.number(extremes.high), shown.unit, allowed, Text(margin, style)


def resume(
    run: RunArgument = NEWEST,
    sigmas: Annotated[
        float,
        typer.Option(min=0.1, max=1000, help="Standard deviations by which the specimen may differ from the record."),
    ] = 5.0,
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="Go on although the protocol's source, the content of the rig or a version has changed; what has "
            "changed is recorded. A protocol that does other than the record says is refused all the same.",
        ),
    ] = False,
    accept_disagreement: Annotated[
        bool,
        typer.Option("--accept-disagreement", help="Go on although the specimen is not as the record left it."),
    ] = False,
    rig: Annotated[
        str | None,
        typer.Option("--rig", metavar="RIG", help="Where the rig file is now, if it was moved."),
    ] = None,
    attach: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Endpoints file of `bench rig emulate --json`, if the run was attached."),
    ] = None,
    notify: NotifyOption = None,
    live: LiveOption = False,
    json_file: JsonOption = None,
) -> None:
    """Go on with a run that was killed, aborted or failed, from its last finished step, in its own record.

    The protocol is started again with its recorded parameters, and the recorded readings are fed back to it: nothing
    is sent, and no time passes. What it yields has to be what the record says. Errors that watchdogs left in the
    instruments when the run died are cleared, no others (see `bench rig clear`). Then the specimen is brought to
    where it was by the corners of the set-points that it still remembers, and its signals are compared with the last
    readings. The step that had not finished is done again, and the run goes on: same record, same numbers of steps,
    same zero of time.

    A run without a finished step, or one that goes on or is completed, is refused; so is one whose protocol, rig or
    versions have changed. docs/reference/resume.md says how the specimen is brought back, and what is refused.

    Exit codes: those of `bench run`; 9 the specimen is not as the record left it, and every device is safe.
    """
    from bench.base import Interrupts, say_at_once
    from bench.execution import Resume, resume as resume_run

    check_outputs(json_file=json_file, read=[run])
    asked = Resume(
        folder=run,
        rig=rig,
        attach=attach,
        sigmas=sigmas,
        accept_changes=accept_changes,
        accept_disagreement=accept_disagreement,
        live=live,
        notify=tuple(notify or ()),
    )
    with Interrupts(say_at_once) as interrupts:
        with show_compilation():
            result = resume_run(asked, console, interrupts)
        print_result(result, json_file)
