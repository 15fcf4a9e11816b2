"""Columns of files of named arrays: MATLAB, HDF5, TDMS, Parquet and NumPy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.reading.heads import NoColumnError, find_place, make_heads, with_times
from bench.analysis.tables.reading.library_files import arrays_of, load_contents
from bench.analysis.tables.reading.moments import since_first
from bench.analysis.tables.reading.options import OF_ALL, ReadingOptions
from bench.analysis.tables.reading.table import FEWEST_ROWS, ReadColumns
from bench.base import DataError

Array = npt.NDArray[Any]


def read_arrays(
    path: Path,
    names: Sequence[str],
    options: ReadingOptions,
    times: Sequence[str] = (),
    *,
    kind: str,
    table: Mapping[str, Any] | None = None,
) -> ReadColumns:
    """Read columns of a file of named arrays.

    Columns are the vectors, the columns of each matrix `A` as `A(:,1)`, or its rows as `A(1,:)` if they are few, and
    the parts of each structure, table or group `S` as `S.part`; `options.table` chooses one, whose columns then have
    short names. Without it that is the only one, if nothing stands beside it. `table` is read in place of a file.

    Raises DataError if the file cannot be read, a column is missing, columns differ in length, or a value is not
    finite; ConfigurationError if an option does not apply, or a library is not installed.
    """
    options.check_only(path, f"a {kind} file", "table", *OF_ALL)
    contents, remarks = load_contents(path, kind) if table is None else (arrays_of(table), ())
    turned: list[str] = []
    found = _choose(path, contents or {}, options.table, turned)
    if not found:
        raise DataError(f"{path}: has no vector, matrix or table of numbers")
    heads = make_heads(list(found))
    arrays = list(found.values())
    dates = [place for place, array in enumerate(arrays) if array.dtype.kind == "M"]
    names = with_times(names, times, heads, lambda name: find_place(path, heads, len(heads), name), dates)
    try:
        places = [find_place(path, heads, len(heads), name) for name in names]
    except NoColumnError as error:
        raise NoColumnError("; ".join([str(error), *remarks]), error.known) from None
    chosen = [arrays[place] for place in places]
    if len({len(column) for column in chosen}) > 1:
        raise DataError(
            f"{path}: columns differ in length: "
            + ", ".join(f"{name} {len(column)}" for name, column in zip(names, chosen, strict=True))
        )
    for name, column in zip(names, chosen, strict=True):
        for row in np.flatnonzero(~np.isfinite(column)):
            text = f"{column[row]}"
            if column.dtype.kind == "M" or not options.is_missing(text):
                remedy = "" if column.dtype.kind == "M" else options.missing_remedy(text)
                raise DataError(f"{path}: row {row + 1}, column {name}: {text} is not a finite number{remedy}")
    are_moments = [column.dtype.kind == "M" for column in chosen]
    # Differences first: the ns since 1970 have more digits than a float.
    values = [
        (column - column[:1]).astype("timedelta64[ns]").astype(np.float64) * 1e-9 if moment else column
        for column, moment in zip(chosen, are_moments, strict=True)
    ]
    values, units, moments = since_first(values, [heads[place].unit for place in places], names, are_moments)
    named = (f"table {options.table}",) if options.table else ()
    return ReadColumns(names, values, units, (kind, *named, *turned, *remarks, *moments))


def _choose(path: Path, contents: dict[str, Any], table: str | None, turned: list[str]) -> dict[str, Array]:
    if table is not None:
        name = list(contents)[int(table) - 1] if table.isdecimal() and int(table) <= len(contents) else table
        if name not in contents:
            raise DataError(f"{path}: --format table={table}: has no such variable; it has: {_listed(contents)}")
        contents = {name: contents[name]}
    short = len(contents) == 1
    return {
        key: column for name, value in contents.items() for key, column in _columns(name, value, turned, short=short)
    }


def _listed(contents: dict[str, Any]) -> str:
    """Return variables with their rows and columns for people."""
    sizes = {
        name: f"{len(value)} parts" if isinstance(value, dict) else " × ".join(map(str, value.shape))
        for name, value in contents.items()
    }
    return ", ".join(f"{name} ({size})" for name, size in sizes.items())


def _columns(name: str, value: Any, turned: list[str], *, short: bool) -> Iterator[tuple[str, Array]]:  # noqa: ANN401
    if isinstance(value, dict):
        for part, inner in value.items():
            alone = short and len(value) == 1
            yield from _columns(part if short else f"{name}.{part}", inner, turned, short=alone)
    elif value.ndim == 1:
        yield name, value
    elif value.shape[0] < FEWEST_ROWS <= value.shape[1]:
        turned.append(f"{name}: {value.shape[0]} × {value.shape[1]}, its rows read as columns")
        for index, row in enumerate(value, start=1):
            yield f"{name}({index},:)", row
    else:
        for index in range(value.shape[1]):
            yield f"{name}(:,{index + 1})", value[:, index]
