"""A run made of measurements of another program, so that reports, comparisons and models take it as their own."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.tables.data import find_elsewhere, is_run
from bench.analysis.tables.dataset import TIME_COLUMN, ColumnNames, read_dataset, time_names
from bench.analysis.tables.reading.heads import split_unit
from bench.analysis.tables.reading.options import ReadingOptions
from bench.base import ConfigurationError, DataError, Floats, redacted_command, wall_time
from bench.devices import Settled, Signal
from bench.record import FILE_NAME, Event, Journal, NewFolder, StepRecord, current_user, version_of

PROTOCOL = "imported"
"""What an imported run has in the place of a protocol."""


@dataclass(frozen=True)
class ImportedRun:
    """What was imported."""

    folder: Path  # the folder of the run
    rows: int  # number of readings
    assumptions: str  # what was assumed about the layout of the file and about times


def import_file(
    path: Path,
    names: ColumnNames,
    *,
    title: str = "",
    out: Path = Path("recordings"),
    reading: ReadingOptions | None = None,
) -> ImportedRun:
    """Make a run of a file of measurements: each row is a reading.

    Parameters
    ----------
    path : Path
        A file that `read_columns` reads.
    names : ColumnNames
        Columns of input, output and others, and of times; without one, rows are 1 s apart.
    title : str
        Of the rig, for heads; the name of the file if empty.
    out : Path
        Where the folder of the run is made.
    reading : ReadingOptions, optional
        What is known of the layout of the file.

    Raises
    ------
    DataError
        If the file cannot be read, is a run already, or times do not increase: names row and column.
    ConfigurationError
        If a column is asked for twice, or two signals have one name.
    """
    if is_run(path):
        raise DataError(f"{path} is a run already")
    wanted = [names.input, *filter(None, [names.output]), *names.others]
    if len(set(wanted)) < len(wanted):
        raise ConfigurationError(f"columns {', '.join(wanted)}: one of them is asked for twice")
    names = replace(names, times=() if names.time else time_names(path))
    data = read_dataset([path], names, reading)
    assert data.output is not None
    remark = "rows are 1 s apart" if data.time is None else ""
    try:
        times = data.times
    except DataError as error:
        # Those that nobody asked for may be of several records.
        times, remark = None, f"{error}: left out, rows are 1 s apart"
    quantities = data.input, data.output, *data.others
    signals = [_signal(quantity.name, quantity.unit) for quantity in quantities]
    assumptions = [data.assumptions, remark]
    with NewFolder() as new:
        folder = new.make(out, f"{_word(path.stem)}-{PROTOCOL}")
        new.keep()
    columns = dict(zip(("input_column", "output_column"), wanted, strict=False))
    if times is not None and data.time is not None:
        columns[TIME_COLUMN] = data.time.name
    times = np.arange(1.0, data.inputs.size + 1.0) if times is None else times
    meta = _metadata(path, folder.name, title, signals, columns, times)
    # A file that is still there needs no row to be durable before the next.
    places = [path, *(place[0] for name in wanted if (place := find_elsewhere(path, name)))]
    files = {file.name: file.read_bytes() for file in places}
    journal = Journal(folder / FILE_NAME, signals, meta, files, flushed=False)
    values = np.column_stack([quantity.values for quantity in quantities])
    journal.event(Event(0.0, "INFO", "phase", f"imported from {path.name}"))
    for text in filter(None, assumptions):
        journal.event(Event(0.0, "INFO", "note", text))
    elapsed = times - times[0]
    steps = np.diff(elapsed, prepend=elapsed[0]).tolist()
    for i, (t, lasted, row) in enumerate(zip(elapsed.tolist(), steps, values.tolist(), strict=True)):
        journal.step(StepRecord(i, t - lasted, t, PROTOCOL, "", Settled.UNRECORDED, {}, tuple(row)))
    journal.finish(status="completed", reason="", finished=float(elapsed[-1]), safe_state={})
    journal.close()
    return ImportedRun(folder, times.size, ", ".join(filter(None, assumptions)))


def _signal(column: str, unit: str) -> Signal:
    name = split_unit(column)[0]
    return Signal(f"column_{name}" if name.isdecimal() else name, unit or "1", "imported", 6)


def _word(text: str) -> str:
    return "".join(sign if sign.isalnum() else "-" for sign in text)[:48].strip("-") or "file"


def _metadata(
    path: Path, run: str, title: str, signals: Sequence[Signal], columns: Mapping[str, str], times: Floats
) -> dict[str, Any]:
    content = path.read_bytes()
    span = {signal.name: signal for signal in signals}
    driven, response = list(span)[:2]
    measured = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    now = wall_time().isoformat()
    return {
        "run": run,
        "rig": path.stem,
        "rig_title": title or path.name,
        "rig_file": "",
        "rig_content": {},
        "protocol": PROTOCOL,
        "protocol_summary": f"Imported from {path.name}",
        "parameters": {
            "source": str(path),
            "sha256": hashlib.sha256(content).hexdigest(),
            **columns,
        },
        "changed": {},
        "overrides": {},
        "controls": "",
        "slots": {
            "drive": {"device": "", "signal": driven},
            "response": {"device": "", "signal": response},
        },
        "plan": {"steps": times.size, "seconds": float(times[-1] - times[0]), "at_most": None, "complete": True},
        "seed": None,
        "clock": "wall",
        # Nothing better is known of when it was measured.
        "epoch": measured.isoformat(),
        "devices": {},
        "limits": {},
        "calibration": {},
        "dashboard": None,
        "rehearsal": None,
        "operator": current_user(),
        "command": redacted_command(sys.argv),
        "packages": {"actuator-bench": version_of("actuator-bench")},
        "git": "",
        "host": {"started": now},
    }
