"""A run as its journal tells it, by the code of the live view: an .rrd of all of it, or a view that follows it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from bench.base import ConfigurationError, DataError
from bench.dashboard.entries import End, Entry, Part, Ticks, densities_of, merged, portions, single, size
from bench.dashboard.live import CHUNK_ROWS
from bench.dashboard.writer import Writer
from bench.identification import ModelFile, is_model, models_among, parse_model
from bench.record import Record


def rebuild(record: Record, path: Path) -> None:
    """Make the .rrd of a run, finished or not, from its journal; the folder of the file exists.

    Raises ConfigurationError if the file exists, and DataError if the journal is damaged.
    """
    models = _models_of(record)
    writer = _writer_of(record, models)
    writer.open(path, None)
    try:
        _write(writer, _Tail().parts(record))
        writer.write(densities_of(models))
        writer.write(_end_of(record))
        writer.arrange()
    finally:
        writer.recording.close()


class JournalView:
    """A view, for viewers that connect, of a run that another process carries out or that is replayed.

    Parameters
    ----------
    run : Path
        Folder of the run, or its journal.
    port : int
        Port of the loopback address for viewers; if it is taken, the next free one. 0 takes any.

    Attributes
    ----------
    uri : str
        Address for a viewer.

    Raises
    ------
    DataError
        If there is no journal, or it is damaged.
    ConfigurationError
        If no port is free.
    """

    def __init__(self, run: Path, port: int) -> None:
        self._run = run
        self._tail = _Tail()
        with Record(run) as record:
            models = _models_of(record)
            self._writer = _writer_of(record, models)
        self._writer.open(None, port)
        self.uri = str(self._writer.recording.uri)
        self._writer.write(densities_of(models))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.recording.close()

    def follow(self) -> str:
        """Show what has come into the journal since the last call; return how the run ended, empty if it goes on.

        The journal is open only meanwhile, so that it can be closed by the process whose it is.
        """
        with Record(self._run) as record:
            # Whether it has ended first: what is read then is all.
            end = _end_of(record)
            self.show(self._tail.parts(record))
        self.show(end)
        return end[0].status if end else ""

    def entries(self) -> list[tuple[float, Entry]]:
        """Return all of the run, each entry behind its laboratory time in s, for `show`."""
        with Record(self._run) as record:
            entries = [(time_of(entry), entry) for entry in single(self._tail.parts(record))]
            return entries + [(entries[-1][0] if entries else 0.0, end) for end in _end_of(record)]

    def show(self, parts: Sequence[Entry | Part]) -> None:
        """Show entries; viewers get them at once."""
        if parts:
            _write(self._writer, parts)
            self._writer.arrange()
        self._writer.recording.follow_viewer(sum(map(size, parts)))


class _Tail:
    """Reads a journal from where it was read last."""

    def __init__(self) -> None:
        self._ticks, self._step, self._events = 0, -1, 0

    def parts(self, record: Record) -> list[Part]:
        """Return what the engine reported of a run since the last call, in its order."""
        telemetry = record.telemetry(self._ticks)
        steps = list(record.step_records(self._step))
        events = record.events(self._events)
        ticks = Ticks(
            telemetry["t"],
            telemetry["step"].astype(np.int64),
            np.column_stack([telemetry[signal.name] for signal in record.signals]),
        )
        self._ticks += len(ticks)
        self._step = steps[-1].step if steps else self._step
        self._events += len(events)
        return merged(ticks, steps, events)


def time_of(entry: Entry) -> float:
    """Return the laboratory time of a tick, a step or an event, s."""
    return float(getattr(entry, "finished", getattr(entry, "t", 0.0)))


def _models_of(record: Record) -> list[ModelFile]:
    # What was identified from the run comes last, and is what its plane shows.
    identified = (
        parse_model(content, f"{record.path}: model {name}")
        for name, content in record.models().items()
        if is_model(content)
    )
    return [*models_among(record.files(), str(record.path)).values(), *identified]


def _writer_of(record: Record, models: list[ModelFile]) -> Writer:
    missing = {"missing_rows": str(record.missing)} if record.missing else {}
    try:
        return Writer(record.signals, {**record.meta, **missing}, models)
    except (ConfigurationError, KeyError, TypeError) as error:
        raise DataError(f"{record.path}: the metadata of its dashboard is damaged: {error}") from error


def _write(writer: Writer, parts: Sequence[Entry | Part]) -> None:
    for portion in portions(parts, CHUNK_ROWS):
        writer.write(portion)


def _end_of(record: Record) -> list[End]:
    """Return how the run ended; nothing if it goes on or its process died."""
    if record.status == "unfinished":
        return []
    return [End(record.status, record.reason, record.meta.get("lateness", {}))]
