"""A run for other programs: tables, documents, its recording, a picture."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.analysis.export.bluesky_documents import write_documents
from bench.analysis.export.typed_tables import TypedTable, metadata_of, typed_tables
from bench.analysis.tables.data import write_blocks
from bench.base import ConfigurationError, DataError, json_text, needed_for, result_file, write_json_file
from bench.execution import RECORDING_NAME
from bench.record import Record

FORMATS = ("csv", "parquet", "bluesky", "rrd", "png")
"""What a run can be exported to."""


def export_run(run: Path, format_: str, out: Path | None, *, escape_formulas: bool = True) -> list[Path]:
    """Write a run for other programs; return the files.

    `csv` and `parquet` are readings, telemetry and events, with the metadata beside or in the schema; `bluesky` are
    documents as JSON lines; `rrd` is the recording, `png` a picture of the dashboard. `escape_formulas` is that of
    `write_blocks`, for CSV. Rows are read and written in blocks, and a file is there only as a whole.

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
        metadata = metadata_of(record)
        paths = []
        for name, table in typed_tables(record).items():
            paths.append(folder / f"{name}.{format_}")
            write_table(paths[-1], table, metadata, escape_formulas=escape_formulas)
    if format_ == "csv":
        paths.append(folder / "metadata.json")
        write_json_file(paths[-1], metadata)
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


def _pyarrow() -> Any:  # noqa: ANN401 - a module
    # Takes a fifth of a second to import.
    with needed_for("a parquet file", "report"):
        import pyarrow as pa
        import pyarrow.parquet
    return pa


def write_table(path: Path, table: TypedTable, metadata: Mapping[str, Any], *, escape_formulas: bool = True) -> None:
    """Write a table as CSV, or as Parquet with the metadata if the name ends so; raise DataError if that fails.

    Raises MissingExtraError for Parquet without pyarrow.
    """
    if path.suffix == ".csv":
        heads = [column.head for column in table.columns]
        blocks = ([list(map(_cell, values)) for values in block] for block in table.blocks)
        write_blocks(path, heads, blocks, escape_formulas=escape_formulas)
        return
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
        for column in table.columns
    ]
    schema = pa.schema(fields, metadata={"bench": json_text(metadata)})
    with result_file(path) as part, pa.parquet.ParquetWriter(part, schema) as writer:
        for block in table.blocks:
            arrays = [pa.array(values, type=field.type) for values, field in zip(block, fields, strict=True)]
            writer.write_table(pa.table(arrays, schema=schema))
