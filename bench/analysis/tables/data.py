"""Columns of measurements, from a file or from the journal of a run."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.reading.heads import SECONDS
from bench.analysis.tables.reading.matlab import HDF5, read_matlab
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.parquet import read_parquet
from bench.analysis.tables.reading.spreadsheet import read_spreadsheet
from bench.analysis.tables.reading.table import ReadColumns
from bench.analysis.tables.reading.text import reading_errors
from bench.analysis.tables.reading.text_table import read_text
from bench.base import ConfigurationError, DataError, header_with_unit
from bench.record import Record

FEWEST_ROWS = 10
"""Fewer samples than this identify nothing."""

_OLD_SPREADSHEET = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"

_STEPS, _TELEMETRY = "steps", "telemetry"

_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
"""What a text begins with that a spreadsheet takes for a formula."""

_LONGEST_PLATEAU = 0.5
"""Share of the samples that may repeat the one before without a word."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Quantity:
    """A column of measurements.

    Attributes
    ----------
    name : str
        As it was asked for; a unit at the end, as in `force [N]`, is that of the quantity.
    unit : str
        Empty if unknown.
    values : ndarray, shape (N,)
        In that unit.
    """

    name: str
    unit: str
    values: Floats

    @property
    def header(self) -> str:
        """The head of the column, with the unit."""
        return header_with_unit(self.title, self.unit)

    @property
    def title(self) -> str:
        """The name without the unit."""
        return self.name.removesuffix(f"[{self.unit}]").rstrip() if self.unit else self.name


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
    assumptions : str
        What was assumed about the layout of a file, such as `tab-separated, decimal comma`; empty for a run.
    time : str or None
        Name of the column of times that was looked for and found.
    """

    source: str
    values: Mapping[str, Floats]
    units: Mapping[str, str]
    assumptions: str = ""
    time: str | None = None

    def quantity(self, name: str) -> Quantity:
        """Return a column."""
        return Quantity(name, self.units[name], self.values[name])


def read_columns(
    path: Path,
    names: Sequence[str],
    *,
    at_least: int = 1,
    options: ReadingOptions | None = None,
    times: Sequence[str] = (),
) -> Columns:
    """Read columns of a file of measurements, or the readings of a run.

    Parameters
    ----------
    path : Path
        A table of text, which may be compressed by gzip, a MATLAB file, a spreadsheet or a Parquet file; or the
        folder or the journal of a run, of which the option `table` takes the readings of its steps (`steps`, the
        default) or what was read while it held and controlled (`telemetry`).
    names : sequence of str
        Columns, as the header has them; a unit at the end, as in `force [N]`, may be left out. Or their numbers,
        from 1.
    at_least : int
        Fewest rows that make sense.
    options : ReadingOptions, optional
        What is known of the layout of a file; the rest is found.
    times : sequence of str
        The first of these columns that is there, can be read, and has a unit of time or none, is read too.

    Raises
    ------
    DataError
        If the file cannot be read or can be read in several ways, a column is missing, a cell is empty, not a number
        or not finite, or rows are too few: names row and column, and the option that may help. Rows count from 1
        below the header.
    ConfigurationError
        If an option does not apply.
    """
    options = options or ReadingOptions()
    if is_run(path):
        options.check_only(path, "a run", "table")
        columns = _from_run(path, names, options.table or _STEPS, at_least, times)
    else:
        try:
            found = _reader(path)(path, names, options, times)
        except DataError:
            if not times:
                raise
            # Of a file that can be read without times their column is at fault.
            read_columns(path, names, at_least=at_least, options=options)
            return read_columns(path, names, at_least=at_least, options=options, times=times[1:])
        values = dict(zip(found.names, found.values, strict=True))
        units = dict(zip(found.names, found.units, strict=True))
        columns = Columns(str(path), values, units, ", ".join(found.notes), (*found.names[len(names) :], None)[0])
    _check_rows(path, len(next(iter(columns.values.values()))), at_least)
    return columns


def seconds_of(source: str, column: Quantity) -> Floats:
    """Return a column of times, shape (N,), in s.

    Raises DataError if its unit is none of time, or the times do not increase: names the row.
    """
    name, unit, values = column.name, column.unit, column.values
    if unit not in SECONDS:
        raise DataError(
            f"{source}: column {name} is in {unit}; expected a time in {', '.join(filter(None, SECONDS))}"
        )
    times = values * SECONDS[unit]
    wrong = np.flatnonzero(np.diff(times) <= 0.0)
    if wrong.size:
        row = int(wrong[0]) + 2
        before, after = values[row - 2 : row]
        raise DataError(
            f"{source}: column {name} does not increase in row {row} ({after:g} after {before:g}); "
            "times must be those of one record, in order"
        )
    return times


def is_run(path: Path) -> bool:
    """Return whether a path is that of a run, its folder or its journal, not of a table."""
    return path.is_dir() or path.suffix == ".sqlite"


def _check_rows(path: Path, rows: int, at_least: int, otherwise: str = "") -> None:
    if rows < at_least:
        raise DataError(f"{path}: has {rows} rows of data; at least {at_least} are needed{otherwise}")


def check_excitation(source: str, column: Quantity) -> list[str]:
    """Check that a column can serve as the input of an identification; return what is odd about it, though usable.

    Raises
    ------
    DataError
        If it is constant.
    """
    check_variation(source, column)
    values = column.values
    repeated = int(np.count_nonzero(np.diff(values) == 0.0))
    if repeated > _LONGEST_PLATEAU * values.size:
        return [
            f"column {column.name}: {repeated} of {values.size} rows repeat the row before; "
            "plateaus add weight but no information"
        ]
    return []


def check_variation(source: str, column: Quantity) -> None:
    """Check that a column varies.

    Raises DataError if it is constant.
    """
    values = column.values
    if np.ptp(values) == 0.0:
        raise DataError(
            f"{source}: column {column.name} is {values[0]:g} in all {values.size} rows, so nothing can be identified"
        )


def write_csv(path: Path, header: Sequence[str], columns: Sequence[Floats | Sequence[object]]) -> None:
    """Write columns of equal length as CSV, numbers with all their digits and formulas as texts; see `write_blocks`.

    Raises DataError if the file cannot be written.
    """
    write_blocks(path, header, [columns])


def write_blocks(
    path: Path,
    header: Sequence[str],
    blocks: Iterable[Sequence[Floats | Sequence[object]]],
    *,
    escape_formulas: bool = True,
) -> None:
    """Write blocks of columns, one below the other, as CSV.

    Parameters
    ----------
    path : Path
        The file.
    header : sequence of str
        Heads of the columns.
    blocks : iterable
        Columns of equal length.
    escape_formulas : bool
        Whether an apostrophe is put before a text that a spreadsheet would take for a formula, which may start
        programs (https://owasp.org/www-community/attacks/CSV_Injection). Numbers stay as they are, also as texts.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    shown = _as_text if escape_formulas else _as_it_is
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(map(shown, header))
            for columns in blocks:
                plain = [
                    column.tolist() if isinstance(column, np.ndarray) else list(map(shown, column))
                    for column in columns
                ]
                writer.writerows(zip(*plain, strict=True))
    except OSError as error:
        raise DataError(f"{path} cannot be written: {error}") from None


def _as_it_is(cell: object) -> object:
    return cell


def _as_text(cell: object) -> object:
    """Return a cell that no spreadsheet takes for a formula."""
    if not isinstance(cell, str) or not cell.startswith(_FORMULAS):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def _reader(path: Path) -> Callable[[Path, Sequence[str], ReadingOptions, Sequence[str]], ReadColumns]:
    """Return what reads a kind of file, by its ending or its first bytes."""
    with reading_errors(path), path.open("rb") as file:
        start = file.read(len(_OLD_SPREADSHEET))
    if path.suffix.lower() == ".mat" or start.startswith((HDF5, b"MATLAB")):
        return read_matlab
    if path.suffix.lower() in (".xlsx", ".xlsm"):
        return read_spreadsheet
    if start.startswith(b"PAR1"):
        return read_parquet
    if start == _OLD_SPREADSHEET or start.startswith(b"PK\x03\x04"):
        raise DataError(f"{path}: this kind of file is not read; save it as .xlsx or CSV")
    return read_text


def _from_run(path: Path, names: Sequence[str], chosen: str, at_least: int, times: Sequence[str]) -> Columns:
    if chosen not in (_STEPS, _TELEMETRY):
        raise ConfigurationError(f"--table {chosen!r}: {path} is a run; expected {_STEPS} or {_TELEMETRY}")
    with Record(path) as record:
        table = record.steps() if chosen == _STEPS else record.telemetry()
        known = [name for name in table.columns if name != "settled"]
        for name in names:
            if name not in known:
                raise DataError(f"{path}: has no column {name!r}; it has: {', '.join(known)}")
        own = [name for name in times if name in known and record.unit(name) in SECONDS]
        own = [name for name in own if np.isfinite(table[name]).all()]
        names = [*names, *own[:1]]
        values = {name: table[name] for name in names}
        units = {name: record.unit(name) for name in names}
        if chosen == _STEPS and len(table) < at_least and (ticks := record.count("telemetry")) >= at_least:
            other = f"; --table {_TELEMETRY} takes the {ticks} readings within its steps"
            _check_rows(path, len(table), at_least, other)
    for name, column in values.items():
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            row = "step" if chosen == _STEPS else "reading"
            raise DataError(f"{path}: {row} {bad[0]}, column {name}: there is no value")
    return Columns(str(path), values, units, time=(*own, None)[0])
