"""Repeating a run from its record alone."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.base import ConfigurationError, DataError, Interrupts
from bench.execution.context import Run
from bench.execution.run import RunResult, carry_out
from bench.protocol import ParameterChange, ProtocolDefinition, digest_of, find_protocol
from bench.record import PROTOCOL_NAME, Original, Record, unpack
from bench.rig import RigFile, rig_of_content


@dataclass(frozen=True)
class Repetition:
    """A run that was repeated.

    Attributes
    ----------
    original : Path
        The run that was repeated.
    result : RunResult
        What its repetition left behind.
    is_exact : bool
        Whether equal values were to be expected: all emulated in this process, on the virtual clock.
    """

    original: Path
    result: RunResult
    is_exact: bool


def repeat(
    run: Path,
    *,
    out: Path,
    console: Console,
    rig: str | None = None,
    overrides: Mapping[str, str] | None = None,
    attach: Path | None = None,
    live: bool = False,
    interrupts: Interrupts | None = None,
) -> Repetition:
    """Carry a recorded run out again: protocol, parameters, files, seed, clock and faults are those of the record.

    A run that was emulated in its process has its rig from the record, too. Any other is repeated on a rig that is
    named, and what differs from the record is printed before anything moves.

    Parameters
    ----------
    run : Path
        Folder of the run, or its journal.
    out : Path
        Where the folder of the repetition is made.
    console : Console
        Where progress is shown.
    rig : str, optional
        Rig of a run on hardware or at an attached laboratory.
    overrides : mapping of str to str, optional
        Values of that rig's file to replace, by dotted key.
    attach : Path, optional
        Endpoints file of `bench rig emulate`.
    live : bool
        Whether to serve the live view.
    interrupts : Interrupts, optional
        As for `carry_out`.

    Raises
    ------
    DataError
        If the record cannot be repeated; says why.
    BenchError
        As `carry_out`.
    """
    with Record(run) as record:
        meta, files = record.meta, record.files()
        changes = ParameterChange.among((event.kind, event.text) for event in record.events())
        # What the repetition is compared with: a damaged row is found before anything moves.
        deque(record.step_records(), maxlen=0)
        record.telemetry()
    if "protocol_source" not in meta:
        raise DataError(f"{run} cannot be repeated: it is a recovered copy of a record whose metadata were lost")
    # On Windows, what is still open cannot be deleted.
    with tempfile.TemporaryDirectory(prefix="bench-repeat-", ignore_cleanup_errors=True) as scratch:
        folder = Path(scratch).resolve()
        unpack(files, meta["parameters"], folder)
        try:
            recorded = rig_of_content(meta["rig"], meta["rig_file"], meta["rig_content"])
        except ConfigurationError as error:
            if rig is None:
                raise DataError(f"{run} cannot be repeated: its rig is no longer the same here:\n{error}") from None
            recorded = None
        is_served = str(meta["clock"]).startswith("attached")
        own = recorded if recorded is not None and recorded.in_process and not is_served else None
        _check_rig(run, own, rig, attach, overrides or {})
        definition = recorded_protocol(run, meta, folder)
        _check_source(run, meta, definition)
        original = Original(meta, files, folder, own)
        asked = Run(
            protocol=definition,
            settings=meta["parameters"],
            rig=rig or meta["rig"],
            folder=out,
            overrides=meta["overrides"] if own else overrides or {},
            seed=meta["seed"],
            clock=meta["clock"] if own else "wall",
            live=live,
            attach=attach,
            interlock_rate=meta["interlock_rate"] if own else None,
            faults=original.faults,
            original=original,
            changes=changes,
        )
        result = carry_out(asked, console, interrupts)
    return Repetition(run, result, own is not None and meta["clock"] == "virtual")


def _check_rig(
    run: Path, own: RigFile | None, rig: str | None, attach: Path | None, overrides: Mapping[str, str]
) -> None:
    if own is not None and (rig is not None or attach is not None or overrides):
        raise ConfigurationError(
            f"{run} was emulated, so that its rig is in the record; leave --rig, --override and --attach out, or use "
            "bench run"
        )
    if own is None and rig is None:
        raise ConfigurationError(
            f"{run} was on hardware or at a served laboratory; name the rig on which it is to be repeated by --rig, "
            "and a served laboratory by --attach"
        )


def recorded_protocol(run: Path, meta: Mapping[str, Any], folder: Path) -> ProtocolDefinition:
    """Return the protocol of a record, whose files were unpacked into a folder; raises DataError if there is none."""
    name, source = meta["protocol"], meta["protocol_source"]
    kept = folder / PROTOCOL_NAME
    if not source["installed"] and (source["module"] == "__main__" or not kept.is_file()):
        raise DataError(
            f"{run} can be neither repeated nor resumed: protocol {name} was written in the program or notebook that "
            "started the run, not in a file of its own"
        )
    try:
        return find_protocol(name if source["installed"] else f"{kept}:{name}")
    except ConfigurationError as error:
        raise DataError(f"{run} can be neither repeated nor resumed: {error}") from None


def _check_source(run: Path, meta: Mapping[str, Any], definition: ProtocolDefinition) -> None:
    """Raise DataError if the protocol of an installed package was changed since it ran."""
    source, now = meta["protocol_source"], digest_of(definition)
    if source["installed"] and (now is None or now != source["sha256"]):
        raise DataError(
            f"{run} cannot be repeated: protocol {meta['protocol']} ({source['module']}) was changed since it ran, "
            f"with actuator-bench {meta['packages']['actuator-bench']} of git {meta['git']}; bench run takes the new "
            "one"
        )
