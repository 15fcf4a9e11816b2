"""A run as documents of bluesky's event-model, for databroker, tiled and their like.

The form on disk is that of suitcase-jsonl: a line a document, `[name, document]` as JSON. All times are seconds since
1970 UTC at the laboratory's clock.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from bench.analysis.export.typed_tables import Column, TypedTable, epoch_of, plain, typed_tables
from bench.base import json_text, result_file
from bench.record import Record
from bench.rig import SETPOINT

Document = tuple[str, dict[str, Any]]

_EXIT_STATUS = {"completed": "success", "aborted": "abort", "failed": "fail"}
_STREAMS = {"readings": "primary", "telemetry": "telemetry", "events": "events"}
"""Names of the streams by the tables of a run."""
_TIMES = {"readings": "finished", "telemetry": "t", "events": "t"}
_DTYPES = {"integer": "integer", "number": "number", "truth": "boolean", "text": "string"}


def documents(record: Record) -> Iterator[Document]:
    """Yield the documents of a run in order of their kind: start, and for each stream descriptor and events, stop.

    A run that has not ended has no stop. A number that is missing or not finite is left out of its event, as JSON has
    none; a text that is missing is empty.

    Raises DataError if the record is damaged.
    """
    meta = record.meta
    epoch = epoch_of(record).timestamp()
    name = f"{meta['run']} {(meta.get('host') or {}).get('started', meta['epoch'])}"
    run = uuid.uuid5(uuid.NAMESPACE_URL, f"actuator-bench:{name}")
    tables = typed_tables(record)
    motors = [each.name.removesuffix(SETPOINT) for each in record.signals if each.name.endswith(SETPOINT)]
    yield (
        "start",
        {
            "uid": str(run),
            "time": epoch,
            "scan_id": 1,
            "plan_name": meta["protocol"],
            "plan_type": "generator",
            "plan_args": plain(meta["parameters"]),
            "motors": motors,
            "detectors": [name for name in meta["devices"] if name not in motors],
            "owner": str(meta["operator"]),
            "hints": {},
            **{key: plain({key: meta[key]})[key] for key in _START if key in meta},
            **({"missing_rows": record.missing.to_json()} if record.missing else {}),
        },
    )
    counts: dict[str, int] = {}
    for table, stream in _STREAMS.items():
        for document in _stream(str(run), stream, tables[table], epoch, _TIMES[table], meta):
            if document[0] == "event":
                counts[stream] = document[1]["seq_num"]
            yield document
    if "status" in meta:
        stop = {
            "uid": str(uuid.uuid5(run, "stop")),
            "run_start": str(run),
            "time": epoch + float(meta.get("finished") or 0.0),
            "exit_status": _EXIT_STATUS.get(record.status, "fail"),
            "reason": str(meta.get("reason", "")),
            "num_events": counts,
        }
        yield "stop", stop


_START = ("run", "rig", "rig_title", "protocol_summary", "seed", "clock", "git", "packages", "limits", "safe_state")
"""Metadata that a start has under their own names."""


def _stream(
    run: str, stream: str, table: TypedTable, epoch: float, clock: str, meta: Mapping[str, Any]
) -> Iterator[Document]:
    """Yield descriptor and events of a table, whose column `clock` has their times; nothing of one without rows."""
    kept = [each for each in table.columns if each.kind != "time"]
    clock_at = [each.name for each in table.columns].index(clock)
    rows = (
        (epoch + t, *row)
        for block in table.blocks
        for t, *row in zip(
            block[clock_at], *(v for v, c in zip(block, table.columns, strict=True) if c in kept), strict=True
        )
    )
    descriptor = str(uuid.uuid5(uuid.UUID(run), stream))
    keys = {_key(each): _data_key(each, stream) for each in kept}
    devices = {
        device: found
        for device in meta["devices"]
        if (found := [key for key in keys if key.startswith(f"{device}_")])
    }
    rest = [key for key in keys if not any(key in found for found in devices.values())]
    first = next(rows, None)
    if first is None:
        return
    yield (
        "descriptor",
        {
            "uid": descriptor,
            "run_start": run,
            "time": first[0],
            "name": stream,
            "data_keys": keys,
            "object_keys": {**devices, **({"bench": rest} if rest else {})},
            "configuration": {},
            "hints": {},
        },
    )
    for number, (time, *row) in enumerate(chain([first], rows), start=1):
        values = ((_key(each), _value(each, value)) for each, value in zip(kept, row, strict=True))
        data = {key: value for key, value in values if value is not None}
        yield (
            "event",
            {
                "uid": str(uuid.uuid5(uuid.UUID(descriptor), str(number))),
                "descriptor": descriptor,
                "time": time,
                "seq_num": number,
                "data": data,
                "timestamps": dict.fromkeys(data, time),
                "filled": {},
            },
        )


def _key(column: Column) -> str:
    return column.name.replace(" ", "_")


def _data_key(column: Column, stream: str) -> dict[str, Any]:
    key: dict[str, Any] = {
        "source": f"bench:{stream}:{column.name}",
        "dtype": _DTYPES[column.kind],
        "shape": [],
    }
    return key | ({"units": column.unit} if column.unit else {})


def _value(column: Column, value: Any) -> Any:  # noqa: ANN401 - of the kind of the column
    """Return a value as JSON has it, None for a number that is missing or not finite."""
    if column.kind != "number":
        return "" if value is None else value
    return value if value is not None and math.isfinite(value) else None


def write_documents(record: Record, path: Path) -> None:
    """Write the documents of a run as JSON lines.

    Raises DataError if the file cannot be written.
    """
    with result_file(path) as part, part.open("w", encoding="utf-8") as file:
        file.writelines(json_text(document) + "\n" for document in documents(record))
