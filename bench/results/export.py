"""A run for other programs: tables, documents, its recording, a picture."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.errors import ConfigurationError, DataError
from bench.extras import needed_for
from bench.journal import Record
from bench.results.bluesky_documents import write_documents
from bench.results.data import write_csv
from bench.results.typed_tables import Column, metadata_of, typed_tables
from bench.runs import RECORDING_NAME

FORMATS = ("csv", "parquet", "bluesky", "rrd", "png")
"""What a run can be exported to."""


def export_run(run: Path, format_: str, out: Path | None) -> list[Path]:
    """Write a run for other programs; return the files.

    `csv` and `parquet` are readings, telemetry and events, with the metadata beside or in the schema; `bluesky` are
    documents as JSON lines; `rrd` is the recording, `png` a picture of the dashboard.

    Raises
    ------
    DataError
        If the run cannot be read or a file cannot be written.
    ConfigurationError
        If the format is unknown, a recording exists already, or a library that the format needs is not installed.
    """
    if format_ not in FORMATS:
        raise ConfigurationError(
            f"format {format_!r} is unknown; allowed are {', '.join(FORMATS[:-1])} and {FORMATS[-1]}"
        )
    if format_ == "parquet":
        _pyarrow()
    with Record(run) as record:
        folder = make_folder(out or record.path.parent)
        if format_ == "rrd":
            return [_recording(record, folder)]
        if format_ == "png":
            return [_picture(record, folder)]
        if format_ == "bluesky":
            path = folder / "documents.jsonl"
            write_documents(record, path)
            return [path]
        tables, metadata = typed_tables(record), metadata_of(record)
    paths = []
    for name, columns in tables.items():
        paths.append(folder / f"{name}.{format_}")
        if format_ == "csv":
            cells = [[_cell(value) for value in column.values] for column in columns]
            write_csv(paths[-1], [column.head for column in columns], cells)
        else:
            _write_parquet(paths[-1], columns, metadata)
    if format_ == "csv":
        paths.append(folder / "metadata.json")
        _write_text(paths[-1], json.dumps(metadata, indent=1, ensure_ascii=False, default=str) + "\n")
    return paths


def make_folder(path: Path) -> Path:
    """Make a folder for results; raise DataError if that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"folder {path} cannot be made: {error.strerror}") from None
    return path


def _recording(record: Record, folder: Path) -> Path:
    with needed_for("an .rrd file", "dashboard"):
        from bench.dashboard import rebuild

    path = folder / RECORDING_NAME
    if path.exists():
        raise ConfigurationError(f"{path} exists already; choose another folder by --out")
    rebuild(record, path)
    return path


def _picture(record: Record, folder: Path) -> Path:
    with needed_for("a picture of the dashboard", "dashboard"):
        from bench.dashboard import picture, rebuild

    path = folder / "dashboard.png"
    with tempfile.TemporaryDirectory() as scratch:
        recording = Path(scratch) / RECORDING_NAME
        rebuild(record, recording)
        complaints = picture(recording, path)
    if complaints:
        raise DataError(f"{path}: the viewer reports: {'; '.join(complaints)}")
    return path


def _cell(value: Any) -> Any:  # noqa: ANN401 - of any kind of column
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, datetime):
        return value.isoformat(timespec="microseconds").replace("+00:00", "Z")
    return "" if value is None else value


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise DataError(f"{path} cannot be written: {error.strerror}") from None


def _pyarrow() -> Any:  # noqa: ANN401 - a module
    # Takes a fifth of a second to import.
    with needed_for("a parquet file", "report"):
        import pyarrow as pa
        import pyarrow.parquet
    return pa


def _write_parquet(path: Path, columns: Sequence[Column], metadata: dict[str, Any]) -> None:
    pa = _pyarrow()
    types = {
        "integer": pa.int64(),
        "number": pa.float64(),
        "truth": pa.bool_(),
        "text": pa.string(),
        "time": pa.timestamp("us", tz="UTC"),
    }
    fields = [
        pa.field(
            column.head,
            types[column.kind],
            metadata={"name": column.name, "unit": column.unit, "description": column.description},
        )
        for column in columns
    ]
    schema = pa.schema(fields, metadata={"bench": json.dumps(metadata, ensure_ascii=False, default=str)})
    arrays = [pa.array(column.values, type=types[column.kind]) for column in columns]
    try:
        pa.parquet.write_table(pa.table(arrays, schema=schema), path)
    except OSError as error:
        raise DataError(f"{path} cannot be written: {error}") from None
