"""Resuming a run that died: what is read from its record, and what is refused."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.base import ConfigurationError, Interrupts, print_plain
from bench.execution.context import RECORDING_NAME, Run
from bench.execution.resumption.feeding import Past
from bench.execution.resumption.interrupted import Interrupted, Resume
from bench.execution.resumption.repetition import recorded_protocol
from bench.execution.run import RunResult, carry_out
from bench.record import FILE_NAME, Original, Record, take_in, unpack
from bench.rig import Holder, Locks, clear_expired_watchdogs, load_rig, opened, rig_of_content


def resume(asked: Resume, console: Console, interrupts: Interrupts | None = None) -> RunResult:
    """Go on with a run that died, in its own record, from its last finished step.

    Parameters
    ----------
    asked : Resume
        What to resume.
    console, interrupts
        As in `carry_out`.

    Raises
    ------
    DataError
        If it is no run, or its record is damaged or of another schema.
    ConfigurationError
        If it was completed, goes on, has no finished step, or something has changed since; if it is a journal that
        does not stand in a folder of its own; nothing has moved.
    DeviceError
        If a device cannot be connected, or is in an error that the death of the run did not cause.
    """
    _check_is_in_its_folder(asked.folder)
    with ExitStack() as stack:
        folder = asked.folder if asked.folder.is_dir() else asked.folder.parent
        # A reader may touch the companions of the file.
        written = max((file.stat().st_mtime for file in folder.glob(f"{FILE_NAME}*")), default=0.0)
        with Record(asked.folder) as record:
            rig = str(record.meta.get("rig"))
            _check_can_be_resumed(record, asked.folder)
        locks = stack.enter_context(Locks(Holder.of_this_process(rig, f"bench resume {folder}")))
        locks.take_folder(folder)
        take_in(asked.folder)
        with Record(asked.folder) as record:
            meta, past, files = record.meta, Past.of(record), record.files()
        again = Interrupted(folder, meta, past, datetime.fromtimestamp(written, UTC), asked)
        # On Windows, what is still open cannot be deleted.
        scratch = tempfile.TemporaryDirectory(prefix="bench-resume-", ignore_cleanup_errors=True)
        run = _run_of(asked, meta, files, Path(stack.enter_context(scratch)).resolve())
        if asked.attach is not None or run.original is None or run.original.rig is None:
            with opened(load_rig(run.rig, run.overrides), asked.attach, "bench resume") as place:
                for name, meaning in clear_expired_watchdogs(place).items():
                    print_plain(console, f"{name}: cleared: {meaning}")
        result = carry_out(run, console, interrupts, again)
    recording = folder / RECORDING_NAME
    if recording.exists():
        # It ends where the run died.
        recording.unlink()
        how = f"bench runs export {folder} --format rrd makes the whole"
        print_plain(console, f"{recording} was of the first part and is removed; {how}")
    return result


def _check_is_in_its_folder(given: Path) -> None:
    """Raise ConfigurationError for a journal of another name, such as a recovered copy: a run is one folder."""
    if given.name == FILE_NAME or not given.is_file() or given.suffix != ".sqlite":
        return
    place = given.absolute().parent
    other = place.with_name(f"{place.name}-recovered")
    raise ConfigurationError(
        f"{given} is not the {FILE_NAME} of a folder of its own, in which a run is resumed. Copy it into one: "
        f"`mkdir {other} && cp {given} {other / FILE_NAME}`, and then `bench resume {other}`"
    )


def _check_can_be_resumed(record: Record, given: Path) -> None:
    meta = record.meta
    if record.status == "completed":
        raise ConfigurationError(f"{given} was completed; there is nothing to resume")
    if "rig_given" not in meta:
        raise ConfigurationError(
            f"{given} is a recovered copy of a record whose metadata were lost; it takes them to resume a run, so "
            "start it again"
        )


def _run_of(asked: Resume, meta: Mapping[str, Any], files: Mapping[str, bytes], scratch: Path) -> Run:
    """Return the run as it was started, with the files of its record; an emulated laboratory has the same seed."""
    unpack(files, meta["parameters"], scratch)
    attached = str(meta["clock"]).startswith("attached")
    if attached is not (asked.attach is not None):
        raise ConfigurationError(
            f"{asked.folder} is a run on a laboratory that another process served; name its endpoints by --attach"
            if attached
            else f"--attach: {asked.folder} is a run on rig {meta['rig']} itself, not on a served laboratory"
        )
    overrides: Mapping[str, str] = meta["overrides"]
    given = asked.rig or meta["rig_given"]
    if asked.rig is not None and (name := load_rig(asked.rig, overrides).name) != meta["rig"]:
        raise ConfigurationError(f"{asked.folder} is a run on rig {meta['rig']}; {name} is another one")
    recorded = None
    if asked.rig is None and not attached:
        recorded = rig_of_content(meta["rig"], meta["rig_file"], meta["rig_content"])
    return Run(
        protocol=recorded_protocol(asked.folder, meta, scratch),
        settings=meta["parameters"],
        rig=given,
        overrides=overrides,
        seed=meta["seed"],
        clock="wall" if attached else meta["clock"],
        folder=asked.folder,
        live=asked.live,
        # The recording is made from the journal afterwards, whole.
        recording=False,
        attach=asked.attach,
        interlock_rate=meta["interlock_rate"],
        notify=asked.notify,
        original=Original(meta, files, scratch, recorded if recorded is not None and recorded.in_process else None),
    )
