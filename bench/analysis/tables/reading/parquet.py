"""Columns of a Parquet file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.analysis.tables.reading.heads import find_place, make_heads, with_times
from bench.analysis.tables.reading.moments import since_first
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.table import NO_ROW_LEFT_OUT, ReadColumns
from bench.analysis.tables.reading.text import reading_errors
from bench.base import DataError, needed_for


def read_parquet(path: Path, names: Sequence[str], options: ReadingOptions, times: Sequence[str] = ()) -> ReadColumns:
    """Read columns of a Parquet file.

    Raises
    ------
    DataError
        If the file cannot be read, a column is missing or not of numbers, or a value is missing or not finite.
    ConfigurationError
        If an option does not apply.
    MissingExtraError
        If the library for Parquet files is not installed.
    """
    options.check_only(path, "a Parquet file")
    with needed_for("reading a parquet file", "report"):
        import pyarrow as pa
        import pyarrow.parquet as pq
    with reading_errors(path):
        try:
            texts = pq.read_schema(path).names
            heads = make_heads(texts)
            names = with_times(names, times, heads, lambda name: find_place(path, heads, len(heads), name))
            places = [find_place(path, heads, len(heads), name) for name in names]
            table = pq.ParquetFile(path, page_checksum_verification=True).read(
                columns=[texts[place] for place in places]
            )
            found = [table.column(texts[place]) for place in places]
            are_moments = [pa.types.is_timestamp(column.type) for column in found]
            found = [
                column.cast(pa.timestamp("us")).cast(pa.int64()) if is_moment else column
                for column, is_moment in zip(found, are_moments, strict=True)
            ]
            values = [np.asarray(column.cast(pa.float64()).to_numpy(), dtype=np.float64) for column in found]
        except (pa.ArrowException, KeyError) as error:
            raise DataError(f"{path} cannot be read as Parquet: {error}") from None
    for name, column in zip(names, values, strict=True):
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            raise DataError(
                f"{path}: row {bad[0] + 1}, column {name}: is empty or not a finite number; {NO_ROW_LEFT_OUT}: "
                "save the file without it, or with a number there"
            )
    values = [1e-6 * column if moment else column for column, moment in zip(values, are_moments, strict=True)]
    values, units, moments = since_first(values, [heads[place].unit for place in places], names, are_moments)
    return ReadColumns(names, values, units, ("Parquet", *moments))
