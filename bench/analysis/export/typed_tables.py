"""The tables of a run with a type for each column, for other programs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import islice
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np

from bench.analysis.uncertain_results import reading_uncertainties
from bench.base import header_with_unit
from bench.record import Record
from bench.rig import SETPOINT

Kind: TypeAlias = Literal["integer", "number", "truth", "text", "time"]
T = TypeVar("T")

_PORTION = 4096
"""Rows that are read together."""


@dataclass(frozen=True)
class Column:
    """One column."""

    # The unit is empty for what has none.
    name: str
    unit: str
    kind: Kind  # {"integer", "number", "truth", "text", "time"}; type of its values; a time is a `datetime` in UTC
    description: str  # what it is, in a few words

    @property
    def head(self) -> str:
        """Name with unit, as a header has it."""
        return header_with_unit(self.name, self.unit)


Block: TypeAlias = Sequence[Sequence[Any]]
"""Some rows of a table: the values of each column, None where there is no value."""


@dataclass(frozen=True)
class TypedTable:
    """A table that is read in blocks, as it may be longer than the memory."""

    columns: tuple[Column, ...]
    # Its rows in their order, each block a list of values a column; read once. Raises DataError if the record is
    # damaged.
    blocks: Iterator[Block]


def typed_tables(record: Record) -> dict[str, TypedTable]:
    """Return readings, telemetry and events of a run by name; the record stays open while they are read.

    Times of day are laboratory times counted from the epoch of the run: one base for all tables.

    Raises DataError if the record is damaged.
    """
    epoch = epoch_of(record)
    return {
        "readings": _readings(record, epoch),
        "telemetry": _telemetry(record, epoch),
        "events": _events(record, epoch),
    }


def epoch_of(record: Record) -> datetime:
    """Return the time of day at laboratory time 0 of a run, UTC."""
    found = datetime.fromisoformat(str(record.meta["epoch"]))
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).astimezone(UTC)


def metadata_of(record: Record) -> dict[str, Any]:
    """Return the metadata of a run with its signals and what its record lacks, for JSON."""
    signals = [
        {"name": each.name, "unit": each.unit, "description": each.description, "precision": each.precision}
        for each in record.signals
    ]
    missing = record.missing.to_json() if record.missing else None
    return {**record.meta, "status": record.status, "signals": signals, "missing_rows": missing}


def _readings(record: Record, epoch: datetime) -> TypedTable:
    # Set-points as the protocol sent them in this step; those that stood are signals.
    actuators = [name.removesuffix(SETPOINT) for name in (s.name for s in record.signals) if name.endswith(SETPOINT)]
    commanded = dict.fromkeys(actuators)
    for step in record.step_records():
        commanded |= dict.fromkeys(step.setpoints)

    names = [signal.name for signal in record.signals]
    uncertainties = reading_uncertainties(record)
    stated = list(uncertainties({name: np.empty(0) for name in names}))

    def blocks() -> Iterator[Block]:
        for records in _portions(record.step_records()):
            rows = np.array([each.values for each in records], dtype=np.float64).T
            uncertain = uncertainties(dict(zip(names, rows, strict=True)))
            finished = [each.finished for each in records]
            yield [
                [each.step for each in records],
                [each.started for each in records],
                finished,
                _absolute(epoch, finished),
                [each.phase for each in records],
                [each.label for each in records],
                [not each.settled.failed for each in records],
                [each.settled.value for each in records],
                *([each.setpoints.get(name) for each in records] for name in commanded),
                *(list(map(_known, values)) for values in rows.tolist()),
                *(list(map(_known, uncertain[name].tolist())) for name in stated),
            ]

    columns = (
        Column("step", "", "integer", "number of the step"),
        Column("started", "s", "number", "begin of the step, laboratory time"),
        *_times("finished", "reading of the step"),
        Column("phase", "", "text", "phase of the protocol"),
        Column("label", "", "text", "what the protocol calls the step"),
        Column("settled", "", "truth", "whether it settled"),
        Column("settling", "", "text", "how it settled"),
        *(
            Column(
                f"commanded {name}",
                _unit(record, f"{name}{SETPOINT}"),
                "number",
                f"set-point that the step sent to {name}",
            )
            for name in commanded
        ),
        *_signals(record),
        *(Column(f"u_{name}", _unit(record, name), "number", f"standard uncertainty of {name}") for name in stated),
    )
    return TypedTable(columns, blocks())


def _telemetry(record: Record, epoch: datetime) -> TypedTable:
    def blocks() -> Iterator[Block]:
        for ticks in record.ticks():
            numbers = ticks["step"].astype(np.int64).tolist()
            places = record.places(min(numbers), max(numbers))
            times = ticks["t"].tolist()
            yield [
                times,
                _absolute(epoch, times),
                numbers,
                *([places.get(number, (None, None))[i] for number in numbers] for i in range(2)),
                *(list(map(_known, ticks[signal.name].tolist())) for signal in record.signals),
            ]

    columns = (
        *_times("t", "time of the tick"),
        Column("step", "", "integer", "step that the tick belongs to; -1 on the way back of a resumed run"),
        Column("phase", "", "text", "phase of that step"),
        Column("label", "", "text", "what the protocol calls that step"),
        *_signals(record),
    )
    return TypedTable(columns, blocks())


def _events(record: Record, epoch: datetime) -> TypedTable:
    def blocks() -> Iterator[Block]:
        for events in _portions(record.each_event()):
            times = [each.t for each in events]
            texts = ([each.level for each in events], [each.kind for each in events], [each.text for each in events])
            yield [times, _absolute(epoch, times), *texts]

    columns = (
        *_times("t", "time of the event"),
        Column("level", "", "text", "INFO, WARN or ERROR"),
        Column("kind", "", "text", "kind of event"),
        Column("text", "", "text", "what happened"),
    )
    return TypedTable(columns, blocks())


def _portions(entries: Iterable[T]) -> Iterator[list[T]]:
    entries = iter(entries)
    while portion := list(islice(entries, _PORTION)):
        yield portion


def _times(name: str, description: str) -> tuple[Column, Column]:
    return (
        Column(name, "s", "number", f"{description}, laboratory time"),
        Column("time", "", "time", f"{description}, time of day"),
    )


def _absolute(epoch: datetime, seconds: Sequence[float]) -> list[datetime]:
    return [epoch + timedelta(seconds=each) for each in seconds]


def _signals(record: Record) -> list[Column]:
    return [Column(signal.name, signal.unit, "number", signal.description) for signal in record.signals]


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _unit(record: Record, signal: str) -> str:
    return next((each.unit for each in record.signals if each.name == signal), "")


def plain(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return metadata as event-model takes them: no key has a point or a solidus."""
    return {key.replace(".", "_").replace("/", "_"): _plain(value) for key, value in content.items()}


def _plain(value: Any) -> Any:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(value, Mapping):
        return plain(value)
    return [_plain(each) for each in value] if isinstance(value, list) else value
