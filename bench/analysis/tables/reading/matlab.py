"""Columns of a MATLAB file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.reading.heads import find_place, make_heads, with_times
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.table import NO_ROW_LEFT_OUT, ReadColumns
from bench.analysis.tables.reading.text import reading_errors
from bench.base import DataError

HDF5 = b"\x89HDF"

_HDF5_REMEDY = "is a MATLAB file of version 7.3 (HDF5); save it with save(..., '-v7') or as CSV"


def read_matlab(path: Path, names: Sequence[str], options: ReadingOptions, times: Sequence[str] = ()) -> ReadColumns:
    """Read columns of a MATLAB file of version 4, 6 or 7.

    Columns are the vectors, the columns of each matrix `A` as `A(:,1)`, and the fields of each structure `S` as
    `S.field`; `options.table` chooses one matrix or structure, whose columns then have short names. Without it that
    is the only one, if no vector stands beside it.

    Raises
    ------
    DataError
        If the file cannot be read, a column is missing, columns differ in length, or a value is not finite.
    ConfigurationError
        If an option does not apply.
    """
    options.check_only(path, "a MATLAB file", "table")
    with reading_errors(path):
        if path.read_bytes()[:4] == HDF5:
            raise DataError(f"{path} {_HDF5_REMEDY}")
        # It takes a while to import.
        from scipy.io import loadmat
        from scipy.io.matlab import MatReadError

        try:
            content = loadmat(str(path), squeeze_me=True, struct_as_record=False)
        except NotImplementedError:
            raise DataError(f"{path} {_HDF5_REMEDY}") from None
        except (MatReadError, ValueError, TypeError, KeyError, IndexError) as error:
            raise DataError(f"{path} cannot be read as a MATLAB file: {error}") from None
    variables = {name: value for name, value in content.items() if not name.startswith("__")}
    found = _choose(path, variables, options.table)
    heads = make_heads(list(found))
    arrays = list(found.values())
    names = with_times(names, times, heads, lambda name: find_place(path, heads, len(heads), name))
    chosen = [arrays[find_place(path, heads, len(heads), name)] for name in names]
    lengths = {len(column) for column in chosen}
    if len(lengths) > 1:
        raise DataError(
            f"{path}: columns differ in length: "
            + ", ".join(f"{name} {len(column)}" for name, column in zip(names, chosen, strict=True))
        )
    for name, column in zip(names, chosen, strict=True):
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            raise DataError(
                f"{path}: row {bad[0] + 1}, column {name}: {column[bad[0]]} is not a finite number; "
                f"{NO_ROW_LEFT_OUT}: save the file without it, or with a number there"
            )
    units = [heads[find_place(path, heads, len(heads), name)].unit for name in names]
    notes = ("MATLAB", *((f"table {options.table}",) if options.table else ()))
    return ReadColumns(names, chosen, units, notes)


def _choose(path: Path, variables: dict[str, Any], table: str | None) -> dict[str, npt.NDArray[np.float64]]:
    if table is not None:
        name = list(variables)[int(table) - 1] if table.isdecimal() and int(table) <= len(variables) else table
        if name not in variables:
            raise DataError(f"{path}: --table {table}: has no such variable; it has: {', '.join(variables)}")
        return dict(_columns(name, variables[name], short=True))
    if len(variables) == 1:
        ((name, value),) = variables.items()
        return dict(_columns(name, value, short=True))
    return {key: column for name, value in variables.items() for key, column in _columns(name, value, short=False)}


def _columns(name: str, value: Any, *, short: bool) -> Iterator[tuple[str, npt.NDArray[np.float64]]]:  # noqa: ANN401
    """Yield the columns of a variable; what has no numbers, such as a text, has none."""
    if hasattr(value, "_fieldnames"):
        for field in value._fieldnames:
            yield from _columns(field if short else f"{name}.{field}", getattr(value, field), short=False)
        return
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return
    if array.ndim <= 1:
        yield name, np.atleast_1d(array).astype(np.float64)
    elif array.ndim == 2:
        for index in range(array.shape[1]):
            yield f"{name}(:,{index + 1})", array[:, index].astype(np.float64)
