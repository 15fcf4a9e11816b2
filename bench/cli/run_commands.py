"""`bench run`: carry a protocol out, or a recorded run once more."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base import BenchError, ConfigurationError, counted, format_duration, print_plain, print_table
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
from bench.cli.printing import console, print_error, show_compilation, warn
from bench.cli.rehearse_command import show_rehearsal
from bench.cli.run_names import find_run

if TYPE_CHECKING:
    from bench.execution import RunResult


def run(
    context: typer.Context,
    protocol: ProtocolArgument = None,
    rig: RigOption = None,
    from_run: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="RUN",
            help="Carry this run out again, in place of PROTOCOL; see below.",
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
        str,
        typer.Option(
            metavar="U",
            help="Refuse the run, before anything moves, unless the uncertainty budget of the controlled signal "
            "supports this: largest expanded uncertainty (95 %) in its unit, or with one, such as 2 or '20 µm'.",
        ),
    ] = "",
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
        console.print(context.get_help(), highlight=False)
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
            console.print(
                f"as the original: {', '.join(comparison.equal)} are equal to the last bit", highlight=False
            )
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
        highlight=False,
    )
    if outcome.pace is not None and not outcome.pace.is_reached:
        console.print(f"clock: {outcome.pace}", highlight=False)
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
