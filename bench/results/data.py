"""Columns of measurements, from a CSV file or from the journal of a run."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bench.errors import DataError
from bench.journal import Record

FEWEST_ROWS = 10
"""Fewer samples than this identify nothing."""

_LONGEST_PLATEAU = 0.5
"""Share of the samples that may repeat the one before without a word."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Columns:
    """Columns that were asked for.

    Attributes
    ----------
    source : str
        Where they come from.
    values : mapping of str to ndarray
        Each of shape (rows,), by the name that was asked for; every value is finite.
    units : mapping of str to str
        Unit by the same names, empty where the source does not say.
    """

    source: str
    values: Mapping[str, Floats]
    units: Mapping[str, str]


def read_columns(path: Path, names: Sequence[str], *, at_least: int = 1) -> Columns:
    """Read columns of a CSV file, or the readings of a run.

    Parameters
    ----------
    path : Path
        A CSV file with a header line, or the folder or the journal of a run.
    names : sequence of str
        Columns, as the header has them; a unit in brackets at the end, as in `force [N]`, may be left out.
    at_least : int
        Fewest rows that make sense.

    Raises
    ------
    DataError
        If the file cannot be read, a column is missing, a cell is empty, not a number or not finite, or rows
        are too few: names row and column. Rows count from 1 below the header.
    """
    columns = _from_run(path, names) if _is_run(path) else _from_csv(path, names)
    rows = len(next(iter(columns.values.values())))
    if rows < at_least:
        raise DataError(f"{path}: has {rows} rows of data; at least {at_least} are needed")
    return columns


def check_excitation(columns: Columns, name: str) -> list[str]:
    """Check that a column can serve as the input of an identification; return what is odd about it, though usable.

    Raises
    ------
    DataError
        If it is constant.
    """
    values = columns.values[name]
    if np.ptp(values) == 0.0:
        raise DataError(
            f"{columns.source}: column {name} is {values[0]:g} in all {values.size} rows, so "
            "nothing can be identified"
        )
    repeated = int(np.count_nonzero(np.diff(values) == 0.0))
    if repeated > _LONGEST_PLATEAU * values.size:
        return [
            f"column {name}: {repeated} of {values.size} rows repeat the row before; "
            "plateaus add weight but no information"
        ]
    return []


def write_csv(path: Path, header: Sequence[str], columns: Sequence[Floats | Sequence[object]]) -> None:
    """Write columns of equal length as CSV, numbers with all their digits.

    Raises DataError if the file cannot be written.
    """
    plain = [column.tolist() if isinstance(column, np.ndarray) else column for column in columns]
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(zip(*plain, strict=True))
    except OSError as error:
        raise DataError(f"{path} cannot be written: {error}") from None


def split_unit(header: str) -> tuple[str, str]:
    """Return name and unit of a column header such as `force [N]`; the unit is empty when there is none."""
    name, bracket, rest = header.strip().rpartition(" [")
    if bracket and rest.endswith("]"):
        return name, rest[:-1]
    return header.strip(), ""


def _is_run(path: Path) -> bool:
    return path.is_dir() or path.suffix == ".sqlite"


def _from_run(path: Path, names: Sequence[str]) -> Columns:
    with Record(path) as record:
        table = record.steps()
        known = ("step", "started", "finished", *(signal.name for signal in record.signals))
        for name in names:
            if name not in known:
                raise DataError(f"{path}: has no column {name!r}; it has: {', '.join(known)}")
        values = {name: table[name] for name in names}
        units = {name: record.unit(name) for name in names}
    for name, column in values.items():
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            raise DataError(f"{path}: step {bad[0]}, column {name}: there is no value")
    return Columns(str(path), values, units)


def _from_csv(path: Path, names: Sequence[str]) -> Columns:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file, strict=True)
            header = next(rows, None)
            if not header or not any(cell.strip() for cell in header):
                raise DataError(f"{path}: is empty; expected a header line with column names")
            places = {name: _place(path, header, name) for name in names}
            values: dict[str, list[float]] = {name: [] for name in names}
            for number, row in enumerate(rows, start=1):
                if not row:
                    continue
                for name, place in places.items():
                    values[name].append(_cell(path, row, number, name, place))
    except FileNotFoundError:
        raise DataError(f"{path} does not exist") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path} cannot be read as CSV: {error}") from None
    return Columns(
        str(path),
        {name: np.array(column, dtype=np.float64) for name, column in values.items()},
        {name: split_unit(header[place])[1] for name, place in places.items()},
    )


def _place(path: Path, header: Sequence[str], name: str) -> int:
    exact = [i for i, cell in enumerate(header) if cell.strip() == name]
    places = exact or [i for i, cell in enumerate(header) if split_unit(cell)[0] == name]
    if not places:
        known = ", ".join(cell.strip() for cell in header)
        raise DataError(f"{path}: has no column {name!r}; it has: {known}")
    if len(places) > 1:
        raise DataError(f"{path}: has {len(places)} columns {name!r}; name one with its unit, as in the header")
    return places[0]


def _cell(path: Path, row: Sequence[str], number: int, name: str, place: int) -> float:
    where = f"{path}: row {number}, column {name}"
    if place >= len(row) or not row[place].strip():
        raise DataError(f"{where}: is empty; expected a number")
    try:
        # Python reads 1_000 as a number; no measuring program writes one so.
        value = float(row[place].replace("_", "?"))
    except ValueError:
        raise DataError(f"{where}: {row[place].strip()!r} is not a number") from None
    if not np.isfinite(value):
        raise DataError(f"{where}: {row[place].strip()} is not a finite number")
    return value
