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

from bench.base import ConfigurationError, DataError, RecordError, Stopwatch, json_text
from bench.devices import Signal, check_signal_names
from bench.record.background import LONGEST_UNWRITTEN, Background
from bench.record.ending import Ending
from bench.record.finding import cause_of, files_of
from bench.record.keeping import RESERVE_NAME, Keeper
from bench.record.mirror import NAME as MIRROR_NAME, read_mirror, second_files
from bench.record.model_files import add_model
from bench.record.reading import Record
from bench.record.rows import FIRST, IDENTITY, SCHEMA, Event, JournalEntry, StepRecord, entry, meta_row, split, ticks
from bench.record.store import Store

_READERS = 10.0
"""Wall-clock time for which a journal that is made or opened again waits for its readers, s."""

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
        Longest time that a call waits for the disk, s of wall-clock time; a thread of its own writes then. Without
        it the caller's writes, which is faster where nothing waits, as on the virtual clock.
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
        heading = {"schema": SCHEMA, IDENTITY: identity, **meta}
        entries = [entry("meta", meta_row(key, value)) for key, value in heading.items()]
        entries += [
            entry("signals", (position, signal.name, signal.unit, signal.description, signal.precision))
            for position, signal in enumerate(signals)
        ]
        entries += [
            entry("files", (name, hashlib.sha256(content).hexdigest(), content)) for name, content in files.items()
        ]
        for former in second_files(path):
            # What another user has put there stays, and is not believed.
            with suppress(OSError):
                former.unlink(missing_ok=True)
        with ExitStack() as made:
            made.callback(_remove, path)
            try:
                store = Store(path, _READERS, flushed=flushed)
                made.callback(store.close)
                store.create(names, entries)
                store.wait_for_others(0.0)
                keeper = Keeper(store, identity)
                made.callback(keeper.close, is_whole=True)
                keeper.begin(entries)
            except (sqlite3.Error, OSError) as error:
                raise ConfigurationError(f"{path} cannot be made: {cause_of(error)}") from None
            made.pop_all()
        self._begin(keeper, signals, dict.fromkeys(FIRST, 0), patience)

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
        journal = cls.__new__(cls)
        was_mirrored = (file.parent / MIRROR_NAME).exists()
        keeper: Keeper | None = None
        try:
            # A reader may have it for a moment.
            keeper = Keeper(Store(file, _READERS), identity)
            keeper.store.forget(_END)
            keeper.store.wait_for_others(0.0)
            if not was_mirrored:
                keeper.begin(keeper.store.entries())
        except (sqlite3.Error, OSError) as error:
            if keeper is not None:
                keeper.close(is_whole=False)
            raise DataError(f"{file} cannot be written on: {cause_of(error)}") from None
        keeper.keep([entry("meta", meta_row(key, value)) for key, value in meta.items()])
        journal._begin(keeper, signals, counts, patience, lost)
        return journal

    def _begin(
        self,
        keeper: Keeper,
        signals: Sequence[Signal],
        counts: dict[str, int],
        patience: float | None,
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
        self._waiting: list[tuple[float, ...]] = []
        self._since_write = Stopwatch()
        self._background = None if patience is None else Background(keeper, patience)
        self._is_whole = True
        self._failure: Exception | None = None

    @property
    def path(self) -> Path:
        """The journal; another one once the first was removed."""
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
        self._waiting.append((tick, t, step, *map(float, values)))
        if self._background is not None:
            self._background.keep_soon(self._take_ticks())
        elif self._since_write.seconds() >= LONGEST_UNWRITTEN:
            self._write(())

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
        self._write([entry("steps", row)])

    def event(self, event: Event) -> None:
        """Record something that happened."""
        self._write([entry("events", (self._number("events"), event.t, event.level, event.kind, event.text))])

    def keep_model(self, name: str, t: float, content: Mapping[str, Any]) -> None:
        """Keep a model beside the journal; see `add_model`."""
        add_model(self.path, name, t, content)

    def take_notices(self) -> list[str]:
        """Return what happened to the journal itself since the last call."""
        taken = []
        while self._keeper.notices:
            taken.append(self._keeper.notices.pop(0))
        return taken

    def make_room(self) -> None:
        """Give back the space that is kept for the end of a run on a full disk."""
        self._stop_background()
        self._keeper.make_room()

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
        self._stop_background()
        if self._waiting:
            self._write(())
        there = {table: count - self._lost.get(table, 0) for table, count in self._counts.items()}
        problem = self._keeper.end(there) or (str(self._failure) if self._failure else "")
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
        self._keeper.keep([entry("meta", meta_row(key, value)) for key, value in end.items()])
        problem = problem or self._keeper.why
        if problem:
            self._is_whole = False
            raise RecordError(
                f"{self.path} is not whole: {problem}; every row is in {self._keeper.second_file}; "
                f"`bench recover-journal {self.path}` puts them together"
            )
        if lost:
            raise RecordError(f"{self.path} lacks {lost}")

    def close(self) -> None:
        """Close the files; what was recorded stays."""
        with suppress(RecordError, sqlite3.Error):
            self._stop_background()
            if self._waiting:
                self._write(())
        # Otherwise its disk does not answer.
        if self._background is None:
            self._keeper.close(is_whole=self._is_whole)

    def _number(self, table: str) -> int:
        """Return the number of the next row of a table."""
        number = FIRST[table] + self._counts[table]
        self._counts[table] += 1
        return number

    def _take_ticks(self) -> list[JournalEntry]:
        """Return the ticks that wait, which wait no longer."""
        waiting, self._waiting = self._waiting, []
        return [ticks(waiting)] if waiting else []

    def _write(self, entries: Sequence[JournalEntry]) -> None:
        """Make rows durable, and before them the ticks that wait."""
        entries = [*self._take_ticks(), *entries]
        if self._background is not None:
            self._background.keep(entries)
        else:
            self._keeper.keep(entries)
        self._since_write = Stopwatch()
        if self._keeper.is_short and not self._is_told:
            self._is_told = True
            self.when_short()

    def _stop_background(self) -> None:
        """Write in the caller's thread from now on."""
        if self._background is not None:
            if not self._background.stop():
                raise RecordError(f"{self.path}: its disk does not answer")
            self._failure = self._background.failure
            self._background = None


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
        file, signals = record.path, record.signals
        if record.status == "completed":
            raise ConfigurationError(f"{file} is the record of a run that was completed")
        # Each row is checked, also where only its number is needed.
        record.steps(), record.telemetry(), record.events()
        numbers = {table: record.numbers(table) for table in FIRST}
        identity = record.identity
        lost: dict[str, int] = dict(record.meta.get("recovered", {}).get("lost", {}))
        has_ended = "status" in record.meta
    beside = {
        (each.table, each.row[0]): each
        for second in second_files(file)
        for each in split(read_mirror(second, identity))
        if each.table not in FIRST or each.row[0] not in numbers[each.table]
    }
    if not has_ended and ("meta", "status") in beside:
        raise ConfigurationError(
            f"{file} is the record of a run that has ended, of which rows wait in a second file; "
            f"`bench recover-journal {file}` puts them together"
        )
    missing = [each for (table, _), each in beside.items() if table in FIRST]
    for each in missing:
        numbers[each.table].add(int(each.row[0]))
    # A number is never given twice, also where rows before it are lost.
    counts = {table: max(found, default=FIRST[table] - 1) + 1 - FIRST[table] for table, found in numbers.items()}
    lost = {**lost, **{table: counts[table] - len(found) for table, found in numbers.items()}}
    for table in ("steps", "events"):
        if lost[table]:
            raise DataError(
                f"{file} lacks {lost[table]} of its {table}, which are lost, and a run is resumed by all of them; "
                "start the run anew"
            )
    if missing:
        try:
            with closing(Store(file, _READERS)) as store:
                store.write(missing)
        except (sqlite3.Error, OSError) as error:
            raise DataError(f"{file} cannot be written on: {cause_of(error)}") from None
    return file, signals, counts, {table: count for table, count in lost.items() if count}


def _remove(journal: Path) -> None:
    """Remove the files of a journal that could not be made."""
    with suppress(OSError):
        for path in (*files_of(journal), *second_files(journal)):
            path.unlink(missing_ok=True)


def abandon(path: Path, ending: Ending) -> None:
    """Record the end of a run whose own thread hangs, if its file can be written within a second."""
    with suppress(OSError):
        (path.parent / RESERVE_NAME).unlink(missing_ok=True)
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=1.0)) as db, db:
        for key, value in asdict(ending).items():
            rows = entry("meta", meta_row(key, value)).columns()
            db.executemany("INSERT OR IGNORE INTO meta VALUES (?, ?, ?)", rows)
