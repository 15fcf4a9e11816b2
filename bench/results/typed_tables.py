"""The tables of a run with a type for each column, for other programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Literal, TypeAlias

import numpy as np

from bench.interlocks import SETPOINT
from bench.journal import Record, Table
from bench.units import header_with_unit

Kind: TypeAlias = Literal["integer", "number", "truth", "text", "time"]


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes
    ----------
    name, unit : str
        The unit is empty for what has none.
    kind : {"integer", "number", "truth", "text", "time"}
        Type of its values; a time is a `datetime` in UTC.
    values : sequence
        None where there is no value.
    description : str
        What it is, in a few words.
    """

    name: str
    unit: str
    kind: Kind
    values: Sequence[Any]
    description: str

    @property
    def head(self) -> str:
        """Name with unit, as a header has it."""
        return header_with_unit(self.name, self.unit)


def typed_tables(record: Record) -> dict[str, list[Column]]:
    """Return readings, telemetry and events of a run by name, each as columns of equal length.

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


def _readings(record: Record, epoch: datetime) -> list[Column]:
    steps, records = record.steps(), list(record.step_records())
    # Set-points as the protocol sent them in this step; those that stood are signals.
    actuators = [name.removesuffix(SETPOINT) for name in (s.name for s in record.signals) if name.endswith(SETPOINT)]
    commanded = dict.fromkeys([*actuators, *(name for each in records for name in each.setpoints)])
    return [
        Column("step", "", "integer", [each.step for each in records], "number of the step"),
        *_times(epoch, "started", [each.started for each in records], "begin of the step", time_of_day=False),
        *_times(epoch, "finished", [each.finished for each in records], "reading of the step"),
        Column("phase", "", "text", [each.phase for each in records], "phase of the protocol"),
        Column("label", "", "text", [each.label for each in records], "what the protocol calls the step"),
        Column("settled", "", "truth", [not each.settled.failed for each in records], "whether it settled"),
        Column("settling", "", "text", [each.settled.value for each in records], "how it settled"),
        *(
            Column(
                f"commanded {name}",
                _unit(record, f"{name}{SETPOINT}"),
                "number",
                [each.setpoints.get(name) for each in records],
                f"set-point that the step sent to {name}",
            )
            for name in commanded
        ),
        *_signals(record, steps),
    ]


def _telemetry(record: Record, epoch: datetime) -> list[Column]:
    ticks = record.telemetry()
    numbers = ticks["step"].astype(np.int64).tolist()
    of_steps = {each.step: (each.phase, each.label) for each in record.step_records()}
    places = [of_steps.get(number, (None, None)) for number in numbers]
    return [
        *_times(epoch, "t", ticks["t"].tolist(), "time of the tick"),
        Column("step", "", "integer", numbers, "step that the tick belongs to; -1 on the way back of a resumed run"),
        Column("phase", "", "text", [phase for phase, _ in places], "phase of that step"),
        Column("label", "", "text", [label for _, label in places], "what the protocol calls that step"),
        *_signals(record, ticks),
    ]


def _events(record: Record, epoch: datetime) -> list[Column]:
    events = record.events()
    return [
        *_times(epoch, "t", [each.t for each in events], "time of the event"),
        Column("level", "", "text", [each.level for each in events], "INFO, WARN or ERROR"),
        Column("kind", "", "text", [each.kind for each in events], "kind of event"),
        Column("text", "", "text", [each.text for each in events], "what happened"),
    ]


def _times(
    epoch: datetime, name: str, seconds: Sequence[float], description: str, *, time_of_day: bool = True
) -> list[Column]:
    columns = [Column(name, "s", "number", seconds, f"{description}, laboratory time")]
    if time_of_day:
        absolute = [epoch + timedelta(seconds=each) for each in seconds]
        columns.append(Column("time", "", "time", absolute, f"{description}, time of day"))
    return columns


def _signals(record: Record, table: Table) -> list[Column]:
    return [
        Column(
            signal.name,
            signal.unit,
            "number",
            [None if math.isnan(value) else value for value in table[signal.name].tolist()],
            signal.description,
        )
        for signal in record.signals
    ]


def _unit(record: Record, signal: str) -> str:
    return next((each.unit for each in record.signals if each.name == signal), "")


def plain(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return metadata as event-model takes them: no key has a point or a solidus."""
    return {key.replace(".", "_").replace("/", "_"): _plain(value) for key, value in content.items()}


def _plain(value: Any) -> Any:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(value, Mapping):
        return plain(value)
    return [_plain(each) for each in value] if isinstance(value, list) else value
