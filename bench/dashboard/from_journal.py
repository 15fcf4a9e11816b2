"""The .rrd of a run, made from its journal by the code of the live view."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from bench.dashboard.entries import End, Entry, Tick, densities_of
from bench.dashboard.live import CHUNK_ROWS
from bench.dashboard.writer import Writer
from bench.errors import ConfigurationError, DataError
from bench.journal import Record
from bench.model_file import is_model, models_among, parse_model


def rebuild(record: Record, path: Path) -> None:
    """Make the .rrd of a run, finished or not, from its journal; the folder of the file exists.

    Raises ConfigurationError if the file exists, and DataError if the journal is damaged.
    """
    meta = record.meta
    # What was identified from the run comes last, and is what its plane shows.
    identified = (
        parse_model(content, f"{record.path}: model {name}")
        for name, content in record.models().items()
        if is_model(content)
    )
    models = densities_of([*models_among(record.files(), str(record.path)).values(), *identified])
    try:
        writer = Writer(record.signals, meta, models)
    except (ConfigurationError, KeyError, TypeError) as error:
        raise DataError(f"{record.path}: the metadata of its dashboard is damaged: {error}") from error
    writer.open(path, None)
    try:
        entries = _entries(record)
        for start in range(0, len(entries), CHUNK_ROWS):
            writer.write(entries[start : start + CHUNK_ROWS])
        writer.write(models)
        if "status" in meta:
            writer.write([End(str(meta["status"]), str(meta.get("reason", "")), meta.get("lateness", {}))])
    finally:
        writer.recording.close()


def _entries(record: Record) -> list[Entry]:
    """Return what the engine reported of a run, in its order."""
    telemetry = record.telemetry()
    rows = np.column_stack([telemetry[signal.name] for signal in record.signals]).tolist()
    times, steps = telemetry["t"].tolist(), telemetry["step"].astype(np.int64).tolist()
    # Of what happened in one instant, the ticks of a step come first, then its end, then what follows from it.
    dated: list[tuple[tuple[float, float, int], Entry]] = [
        ((t, step, 0), Tick(t, step, row)) for t, step, row in zip(times, steps, rows, strict=True)
    ]
    dated += [((step.finished, step.step, 1), step) for step in record.step_records()]
    dated += [((event.t, math.inf, 0), event) for event in record.events()]
    dated.sort(key=lambda entry: entry[0])
    return [entry for _, entry in dated]
