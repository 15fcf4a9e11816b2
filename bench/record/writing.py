"""Writes the journal of a run."""

from __future__ import annotations

import hashlib
import json
import secrets
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from bench.base import ConfigurationError, DataError, RecordError, json_text
from bench.devices import Signal, check_signal_names
from bench.record.ending import Ending
from bench.record.finding import cause_of, files_of
from bench.record.keeping import Keeper
from bench.record.model_files import add_model
from bench.record.reading import Record
from bench.record.rows import FIRST, IDENTITY, SCHEMA, Event, Row, StepRecord, meta as meta_rows
from bench.record.second_file import is_second_file, places, read_second_file, remove
from bench.record.store import OTHERS, Store, copy_heading, insert

_LAST_WORDS = 1.0
"""Wall-clock time for which a run whose own thread hangs waits for a program that has its journal locked, s: as long
as it has for its last words in the terminal (`bench.execution.context`)."""

_END = ("status", "reason", "finished", "safe_state", "counts", "lateness")
"""Entries of the metadata that a run has once it has ended."""


class Journal:
    """Writes the record of one run.

    Parameters
    ----------
    path : Path
        File to create; its folder exists.
    signals : sequence of Signal
        What is measured, in the order in which values will be handed over.
    meta : mapping
        What is known at the start; values that JSON can hold.
    files : mapping of str to bytes
        Content of the files that the run was given, by name.
    patience : float, optional
        Longest time that a call waits for the disk, s of wall-clock time; a thread of its own writes then, and rows
        that are late go into a second file. Without it the caller's writes, which is faster where nothing waits, as
        on the virtual clock.
    flushed : bool
        Whether each step and event waits until it is on the disk, so that a loss of power takes nothing either.
        Otherwise the disk gets the journal at its end, and the death of the process alone takes nothing.

    Raises
    ------
    ConfigurationError
        If the file exists already: a record is never overwritten. If two signals have one name, or a signal
        has that of a column which the journal itself needs; case does not count. If the file cannot be made; nothing
        is left of it then.
    """

    def __init__(
        self,
        path: Path,
        signals: Sequence[Signal],
        meta: Mapping[str, Any],
        files: Mapping[str, bytes] = MappingProxyType({}),
        patience: float | None = None,
        *,
        flushed: bool = True,
    ) -> None:
        if path.exists():
            raise ConfigurationError(f"{path} exists already; a record of a run is never overwritten")
        names = [signal.name for signal in signals]
        check_signal_names(names)
        # Nobody has a reason to forge the record of a run that moves nothing, and equal runs have equal records.
        content = json_text(dict(meta)).encode(errors="surrogatepass")
        identity = secrets.token_hex(16) if flushed else hashlib.sha256(content).hexdigest()[:32]
        rows = meta_rows({"schema": SCHEMA, IDENTITY: identity, **meta})
        rows += [
            Row("signals", (position, signal.name, signal.unit, signal.description, signal.precision))
            for position, signal in enumerate(signals)
        ]
        rows += [
            Row("files", (name, hashlib.sha256(content).hexdigest(), content)) for name, content in files.items()
        ]
        for former in places(path):
            # What another user has put there stays, and is not believed.
            remove(former)
        with ExitStack() as made:
            made.callback(_remove, path)
            try:
                store = Store(path, OTHERS, flushed=flushed)
                made.callback(store.close)
                store.create(names, rows)
                store.wait_for_others(0.0)
            except (sqlite3.Error, OSError) as error:
                raise ConfigurationError(f"{path} cannot be made: {cause_of(error)}") from None
            made.pop_all()
        keeper = Keeper(store, identity, patience)
        self._begin(keeper, signals, dict.fromkeys(FIRST, 0))

    @classmethod
    def reopen(
        cls, path: Path, meta: Mapping[str, Any] = MappingProxyType({}), patience: float | None = None
    ) -> Self:
        """Open the record of a run that was not completed to write on: steps, ticks and events are numbered on.

        Its end, if it had one, is taken back.

        Parameters
        ----------
        path : Path
            The journal, or the folder of the run that holds it.
        meta : mapping
            Further entries of the metadata.
        patience : float, optional
            As of a new one.

        Raises
        ------
        DataError
            If there is none, it is damaged or of another schema, or cannot be written.
        ConfigurationError
            If the run was completed.
        """
        file, signals, counts, lost = take_in(path)
        with Record(file) as record:
            identity = record.identity
        try:
            # A reader may have it for a moment.
            with ExitStack() as made:
                store = Store(file, OTHERS)
                made.callback(store.close)
                store.forget(_END)
                store.wait_for_others(0.0)
                made.pop_all()
        except (sqlite3.Error, OSError) as error:
            raise DataError(f"{file} cannot be written on: {cause_of(error)}") from None
        keeper = Keeper(store, identity, patience)
        keeper.keep(meta_rows(meta))
        journal = cls.__new__(cls)
        journal._begin(keeper, signals, counts, lost)
        return journal

    def _begin(
        self,
        keeper: Keeper,
        signals: Sequence[Signal],
        counts: dict[str, int],
        lost: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        """Start with rows that are there already: by table those up to the last one, and of these the lost ones."""
        self.signals = tuple(signals)
        self.when_short: Callable[[], object] = lambda: None
        """Called once when the disk is nearly full: recordings stop then, as the journal needs the space."""
        self._is_told = False
        self._keeper = keeper
        self._counts = counts
        self._lost = lost

    @property
    def path(self) -> Path:
        """The journal."""
        return self._keeper.store.path

    @property
    def steps(self) -> int:
        """Number of finished steps that were handed over."""
        return self._counts["steps"]

    @property
    def ticks(self) -> int:
        """Number of ticks that were handed over."""
        return self._counts["telemetry"]

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Record one tick of a hold: laboratory time in s, step number, one value a signal.

        A tick that comes less than 0.1 s (wall clock) after the last write, as on the virtual clock, is written with
        the next tick, step or event.
        """
        self._counts["telemetry"] = tick = self._counts["telemetry"] + 1
        self._keeper.keep([Row("telemetry", (tick, t, step, *map(float, values)))], soon=True)

    def step(self, record: StepRecord) -> None:
        """Record a finished step."""
        self._counts["steps"] += 1
        row = (
            record.step,
            record.started,
            record.finished,
            record.phase,
            record.label,
            record.settled.value,
            json.dumps({name: float(value) for name, value in record.setpoints.items()}),
            *map(float, record.values),
            json.dumps(record.seen),
        )
        self._write(Row("steps", row))

    def event(self, event: Event) -> None:
        """Record something that happened."""
        self._counts["events"] = number = self._counts["events"] + 1
        self._write(Row("events", (number, event.t, event.level, event.kind, event.text)))

    def keep_model(self, name: str, t: float, content: Mapping[str, Any]) -> None:
        """Keep a model beside the journal; see `add_model`."""
        add_model(self.path, name, t, content)

    def take_notices(self) -> list[str]:
        """Return what happened to the journal itself since the last call."""
        taken = []
        while self._keeper.notices:
            taken.append(self._keeper.notices.pop(0))
        return taken

    def finish(
        self,
        *,
        status: str,
        reason: str,
        finished: float,
        safe_state: Mapping[str, str],
        lateness: Mapping[str, object] = MappingProxyType({}),
    ) -> None:
        """Record how the run ended: status, reason, laboratory time in s, safe state by device, lateness of loops.

        Raises RecordError if rows are missing or damaged; the status is `failed` then at best.
        """
        there = {table: count - self._lost.get(table, 0) for table, count in self._counts.items()}
        problem = self._keeper.end(there)
        lost = ", ".join(f"{count} of {table}" for table, count in self._lost.items())
        if lost:
            lost = f"rows that were lost before the run was resumed: {lost}"
        if problem or lost:
            status = "failed" if status == "completed" else status
            reason = "; ".join(filter(None, (reason, f"the record is not whole: {problem or f'it lacks {lost}'}")))
        end = {
            "status": status,
            "reason": reason,
            "finished": finished,
            "safe_state": dict(safe_state),
            "counts": self._counts,
            **({"lateness": dict(lateness)} if lateness else {}),
        }
        self._keeper.keep(meta_rows(end))
        problem = self._keeper.why or problem
        if problem:
            raise RecordError(
                f"{self.path} is not whole: {problem}; `bench runs repair {self.path}` says what there is"
            )
        if lost:
            raise RecordError(f"{self.path} lacks {lost}")

    def close(self) -> None:
        """Close the files; what was recorded stays."""
        self._keeper.close()

    def _write(self, row: Row) -> None:
        """Make a row durable, and before it the ticks that wait."""
        self._keeper.keep([row])
        if self._keeper.is_short and not self._is_told:
            self._is_told = True
            self.when_short()


def take_in(path: Path) -> tuple[Path, tuple[Signal, ...], dict[str, int], dict[str, int]]:
    """Bring into the journal of a run that was not completed what waits for it in a second file.

    Returns
    -------
    Path
        The journal.
    tuple of Signal
        Its signals.
    dict of str to int
        Number of its rows, by table, those that are lost between others included.
    dict of str to int
        Of a recovered copy, the number of rows that are lost, by table; without tables that lack none.

    Raises
    ------
    DataError, ConfigurationError
        As `Journal.reopen`. DataError also if steps or events are lost, as a run is resumed by all of them.
    """
    with Record(path) as record:
        file, identity = record.path, record.identity
        _check_can_be_written_on(record)
    seconds = [each for each in places(file) if is_second_file(each, identity)]
    if seconds:
        try:
            with closing(Store(file, OTHERS)) as store:
                for second in seconds:
                    store.write([row for row in read_second_file(second, identity) if row.table in ("meta", *FIRST)])
        except (sqlite3.Error, OSError) as error:
            raise DataError(f"{file} cannot be written on: {cause_of(error)}") from None
        for second in seconds:
            remove(second)
    with Record(file) as record:
        _check_can_be_written_on(record)
        numbers = {table: record.numbers(table) for table in FIRST}
        known: dict[str, int] = dict(record.meta.get("recovered", {}).get("lost", {}))
        signals = record.signals
    # A number is never given twice, also where rows before it are lost.
    counts = {table: max(found, default=FIRST[table] - 1) + 1 - FIRST[table] for table, found in numbers.items()}
    lost = {**known, **{table: counts[table] - len(found) for table, found in numbers.items()}}
    for table in ("steps", "events"):
        if lost[table]:
            raise DataError(
                f"{file} lacks {lost[table]} of its {table}, which are lost, and a run is resumed by all of them; "
                "start the run again"
            )
    return file, signals, counts, {table: count for table, count in lost.items() if count}


def _check_can_be_written_on(record: Record) -> None:
    """Raise an error if the run was completed, or a row is damaged, also where only its number is needed."""
    if record.status == "completed":
        raise ConfigurationError(f"{record.path} is the record of a run that was completed")
    record.steps(), record.telemetry(), record.events()


def _remove(journal: Path) -> None:
    """Remove the files of a journal that could not be made."""
    with suppress(OSError):
        for path in files_of(journal):
            path.unlink(missing_ok=True)


def abandon(path: Path, ending: Ending) -> None:
    """Record the end of a run whose own thread hangs, if its file can be written within a second.

    What stands there already stays.
    """
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=_LAST_WORDS)) as db:
        with db:
            insert(db, meta_rows(asdict(ending)), otherwise="IGNORE")
        # By itself, as it fails where the heading cannot be read.
        with db:
            copy_heading(db)
