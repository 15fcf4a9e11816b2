"""The commands that look after the instruments of a rig: safe, rig check, rig clear, rig calibrate."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from bench.base import AbortError, ConfigurationError, DeviceError, counted, print_plain, print_table, wall_time
from bench.cli.command_support import (
    UNSAFE_EXIT_CODE,
    AttachOption,
    JsonOption,
    OverrideOption,
    check_outputs,
    complete_rig,
    parse_assignments,
    write_json,
)
from bench.cli.printing import console, print_rows, show_compilation, warn
from bench.cli.run_names import NEWEST, RunArgument

if TYPE_CHECKING:
    from bench.rig import Condition

RigArgument = Annotated[
    str,
    typer.Argument(
        metavar="RIG", help="A packaged rig, or a rig file: path/to/rig.toml.", autocompletion=complete_rig
    ),
]


def safe(
    rig: RigArgument,
    force: Annotated[
        bool, typer.Option("--force", help="Go on although another process holds the rig; says who it is.")
    ] = False,
    limit: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0.0, help="Give up after so long; without it, never.")
    ] = None,
    attach: AttachOption = None,
    overrides: OverrideOption = None,
    json_file: JsonOption = None,
) -> None:
    """Bring every device of a rig into its safe state, whatever state the instruments are in.

    For when a run has died, or an instrument reports an error. The lines are tried in parallel. A device that does
    not confirm its safe state is named at once, with what to unplug, and tried again each second until it does, also
    one whose port is not there. Ctrl-C and every signal that would end the process end it; a script sets `--limit`.
    Nothing is configured, and errors stay (see `bench rig clear`). A run that goes on holds its lines: end it, or use
    `--force`; a serial line that is open elsewhere may still be refused then.

    Exit codes: 0 every output is off; 2 the rig file is wrong, or the rig is in use; 7 at least one device had not
    confirmed its safe state when the command was ended, or at the limit.
    """
    from bench.base import Interrupts
    from bench.rig import UNANSWERED, load_rig, opened, rescue

    file = load_rig(rig, parse_assignments("--override", overrides or []))
    with opened(file, attach, "bench safe", warn if force else None) as place, Interrupts() as interrupts:

        def is_ended() -> bool:
            return interrupts.pause_requested or interrupts.abort_requested()

        said: dict[str, str] = {}
        for seconds, found in rescue(place, is_ended, math.inf if limit is None else limit):
            unsafe = {each.device: each for each in found if not each.is_safe}
            for name, each in unsafe.items():
                if each.state not in (UNANSWERED, said.get(name)):
                    said[name] = each.state
                    warn(f"{name}: NOT CONFIRMED: {each.state}; {each.advice}")
            if unsafe and seconds >= 1.0:
                warn(f"not confirmed after {seconds:.0f} s: {', '.join(unsafe)}; trying again, Ctrl-C ends")
    rows = [
        (
            each.device,
            Text(each.state, "green") if each.is_safe else Text(f"NOT CONFIRMED: {each.state}", "bold red"),
            each.advice,
        )
        for each in found
    ]
    print_table(console, ("device", "state", "what to do"), rows, framed=False)
    write_json(json_file, {each.device: {"state": each.state, "is_safe": each.is_safe} for each in found})
    if not all(each.is_safe for each in found):
        sys.exit(UNSAFE_EXIT_CODE)


@show_compilation()
def clear(
    rig: RigArgument,
    device: Annotated[
        str | None, typer.Argument(metavar="DEVICE", help="Only this device; without it all that are in error.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    attach: AttachOption = None,
    overrides: OverrideOption = None,
    json_file: JsonOption = None,
) -> None:
    """Clear the errors that a watchdog or a protection left in the instruments of a rig.

    First every device is connected, its output switched off, and its error shown with what it means. Remove the cause
    before you confirm: clearing restarts the instrument or releases its emergency stop. A servo loses its number of
    turns. Every output is off at the end.

    Exit codes: 0 every device is ready; 2 the rig file is wrong or does not fit an instrument, or the rig is in use;
    4 a device is still in error, or cannot be reached; 130 not confirmed.
    """
    from bench.rig import load_rig, look, opened, recover

    file = load_rig(rig, parse_assignments("--override", overrides or []))
    with opened(file, attach, "bench rig clear") as place:
        entries = place.only(device)
        found: dict[str, Condition] = {entry.name: look(place, entry) for entry in entries}
        _print_conditions(found.values())
        wanted = [entry for entry in entries if (at := found[entry.name]).state == "in error" and at.can_recover]
        if wanted:
            names = ", ".join(entry.name for entry in wanted)
            if not yes and not (sys.stdin is not None and sys.stdin.isatty()):
                raise ConfigurationError(f"clearing the errors of {names} needs --yes where no operator can answer")
            question = f"Is the cause removed? Clear the errors of {names}"
            if not yes and not typer.confirm(question, err=console.stderr):
                raise AbortError("nothing was cleared")
            found |= {entry.name: recover(place, entry) for entry in wanted}
            console.print()
            _print_conditions([found[entry.name] for entry in wanted])
    write_json(json_file, {name: {"state": each.state, "meaning": each.meaning} for name, each in found.items()})
    for each in found.values():
        if each.state == "refused":
            raise ConfigurationError(f"{each.device}: {each.meaning}")
        if each.state != "ready":
            raise DeviceError(each.device, f"is {each.state}: {each.meaning}")


def _print_conditions(conditions: Iterable[Condition]) -> None:
    rows = [
        (each.device, Text(each.state, "green" if each.state == "ready" else "bold red"), each.meaning)
        for each in conditions
    ]
    print_table(console, ("device", "state", "what it is, or what it reports"), rows, framed=False)


@show_compilation()
def check(
    rig: RigArgument,
    exercise: Annotated[
        bool,
        typer.Option(
            "--exercise", help="Move each actuator that a role gives a rest: to a set-point beside it, and back."
        ),
    ] = False,
    attach: AttachOption = None,
    overrides: OverrideOption = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Page of what was found, in one file.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Check the instruments of a rig, and the rig file against them, before a run.

    Opens every line; identifies instruments and firmware; compares limits, ranges, watchdogs and interlocks; measures
    noise, and the time of a reading beside telemetry and watchdogs. Outputs are switched off; nothing moves without
    `--exercise`, which looks at sign, scale, noise, settling and interlocks. An emulated rig is checked in process.

    Exit codes: 0 all is well; 1 something should be mended; 2 the rig file is wrong, or the rig is in use; 4 a device
    cannot be connected, is in error or fails to read; 7 at least one device did not confirm its safe state at the
    end. The highest counts.
    """
    from bench.base import Interrupts
    from bench.devices import CheckFinding
    from bench.rig import check_up, load_rig, opened

    def keep_on() -> None:
        if interrupts.pause_requested or interrupts.abort_requested():
            raise AbortError("the check-up was ended; every device was brought into its safe state")

    check_outputs(html=html, json_file=json_file)
    file = load_rig(rig, parse_assignments("--override", overrides or []))
    with Interrupts() as interrupts, opened(file, attach, "bench rig check") as place:
        place.clock.interrupted = lambda: interrupts.pause_requested or interrupts.abort_requested()
        checks = check_up(place, exercise, keep_on)
        name = place.file.name
    heads = ("device", "what", "found", "what to do")
    rows = [
        (check.device or f"rig {name}", finding.subject, finding.text, finding.advice)
        for check in checks
        for finding in (*([CheckFinding("instrument", check.identity)] if check.identity else ()), *check.findings)
    ]
    styled = [
        (Text(device, "bold"), what, Text(text, "yellow" if advice else "default"), advice)
        for device, what, text, advice in rows
    ]
    print_table(console, heads, styled, framed=False)
    code = 0
    if any(finding.advice for check in checks for finding in check.findings):
        code = 1
    if any(check.failed for check in checks):
        code = DeviceError.exit_code
    if any(check.unsafe for check in checks):
        code = UNSAFE_EXIT_CODE
    count = sum(bool(finding.advice) for check in checks for finding in check.findings)
    verdict = f"{count} to look at" if count else "all is well"
    console.print(verdict)
    if html is not None:
        from bench.analysis import Page, PageSection, PageTable, write_page

        sections = [PageSection("Findings", [PageTable(heads, rows)])]
        when = wall_time().isoformat(" ", "seconds")
        write_page(html, Page(f"Check of rig {name}", when, verdict, "bad" if code else "good", (), sections))
    write_json(json_file, {"rig": name, "exit_code": code, "devices": [asdict(check) for check in checks]})
    if code:
        sys.exit(code)


def calibrate(
    run: RunArgument = NEWEST,
    *,
    sensor: Annotated[str, typer.Option(metavar="SIGNAL", help="Signal of the sensor.")],
    uncertainty: Annotated[
        float,
        typer.Option(metavar="U", help="Standard uncertainty of the reference, in its unit, by its certificate."),
    ],
    interval: Annotated[int, typer.Option(min=1, metavar="DAYS", help="Days for which the calibration holds.")],
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="SIGNAL", help="Signal of the reference; if not given, the values that steps have as labels."
        ),
    ] = None,
    name: Annotated[
        str, typer.Option(metavar="TEXT", help="What the reference is, and its certificate; its signal if not given.")
    ] = "",
    degrees_of_freedom: Annotated[
        float | None,
        typer.Option(metavar="N", help="Degrees of freedom of that uncertainty; infinitely many if not given."),
    ] = None,
    gain_uncertainty: Annotated[
        float, typer.Option(metavar="SHARE", help="Standard uncertainty of the scale of the reference, as a share.")
    ] = 0.0,
    unit: Annotated[
        str, typer.Option(metavar="UNIT", help="Unit of the reference where it is not that of the sensor, such as °.")
    ] = "",
    out: Annotated[
        Path | None, typer.Option(metavar="calibration.json", help="Where the calibration file goes.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Calibrate a sensor from a run of a calibration protocol: what its readings mean, and how well that is known.

    `accuracy` is the standard uncertainty of the mean of calibrated readings, that of the reference included;
    `repeatability` the standard deviation of one reading about the mean of many, which no calibration removes. A rig
    file applies the calibration by a derived signal: kind = "calibrated", source = SIGNAL, calibration =
    "calibration.json". A run says before it starts, and its report afterwards, if the calibration is older than its
    interval; one of another instrument is refused.
    """
    from bench.analysis import Reference, calibrate_run

    check_outputs(out=out, json_file=json_file, read=[run])
    named = name or reference or "values that were set up"
    found = calibrate_run(
        run, sensor, Reference(named, uncertainty, interval, reference, unit, degrees_of_freedom, gain_uncertainty)
    )
    unit = found.reference_unit
    values = found.value([found.low, 0.5 * (found.low + found.high), found.high]).tolist()
    rows = [
        ("reference", f"{found.reference}, {found.reference_uncertainty:.3g} {unit} (standard uncertainty)"),
        ("holds", f"from {found.date} to {found.due}"),
        ("instrument", found.serial_number or "tells no serial number"),
        ("range", f"{found.low:.6g} to {found.high:.6g} {found.unit}, {counted(found.readings, 'reading')}"),
        ("values at its ends and middle", ", ".join(f"{each:.6g}" for each in values) + f" {unit}"),
        ("coefficients", str(len(found.coefficients))),
        ("accuracy (standard uncertainty)", f"{found.uncertainty:.3g} {unit}"),
        ("repeatability (one reading)", f"{found.repeatability:.3g} {unit}"),
        ("late against the reference by", f"{1e3 * found.lateness:.3g} ms"),
    ]
    print_rows(f"calibration of {sensor}", rows)
    if out is not None:
        found.save(out)
        print_plain(console, f"calibration: {out}")
    write_json(json_file, {**found.model_dump(mode="json"), "accuracy": found.uncertainty})
