"""Columns of measurements, from a file or from the journal of a run."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.reading.heads import SECONDS, NoColumnError, split_unit
from bench.analysis.tables.reading.library_files import HDF5
from bench.analysis.tables.reading.named_arrays import read_arrays
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.spreadsheet import read_spreadsheet
from bench.analysis.tables.reading.table import ReadColumns
from bench.analysis.tables.reading.text import reading_errors
from bench.analysis.tables.reading.text_table import read_text
from bench.base import ConfigurationError, DataError, Floats, closest, header_with_unit, result_file
from bench.record import Record

_OVERLOAD = 9.9e37
"""What instruments write for an overload, and more for no number. Source: SCPI 1999, volume 1, section 7.2.1."""

_SPREADSHEETS = b"PK\x03\x04", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"

_JSON = ".json", ".jsonl", ".ndjson"

TIME_LEFT_OUT = "{}: time is left out"
"""What is said of times that nobody asked for and that cannot be used."""

_LIST = re.compile(r",(?![^(\[]*[)\]])")
"""Between names of columns, of which one may be `A(:,1)`."""

Reader: TypeAlias = Callable[[Path, Sequence[str], ReadingOptions, Sequence[str]], ReadColumns]
"""Reads columns of a file, and the column of times if it is asked for."""

_STEPS, _TELEMETRY = "steps", "telemetry"

_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
"""What a text begins with that a spreadsheet takes for a formula."""


@dataclass(frozen=True)
class Quantity:
    """A column of measurements.

    Attributes
    ----------
    name : str
        As it was asked for; a unit at the end, as in `force [N]` or `force (N)`, is that of the quantity.
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
        name, unit = split_unit(self.name)
        return name if unit == self.unit else self.name


@dataclass(frozen=True)
class Columns:
    """Columns that were asked for."""

    source: str  # where they come from
    values: Mapping[str, Floats]  # each of shape (rows,), by the name that was asked for; every value is finite
    units: Mapping[str, str]  # unit by the same names, empty where the source does not say
    # What was assumed about the layout of a file, such as `tab-separated, decimal comma`; empty for a run.
    assumptions: str = ""
    time: str | None = None  # name of the column of times that was looked for and found
    kept: npt.NDArray[np.int64] | None = None  # numbers of the rows, from 0, where rows without a value are left out
    # File and column of those that were asked for as `FILE:COLUMN`.
    elsewhere: Mapping[str, tuple[Path, str]] = field(default_factory=dict)

    def quantity(self, name: str) -> Quantity:
        """Return a column, by the name that was asked for, without a file before it."""
        return Quantity(self.own_name(name), self.units[name], self.values[name])

    def own_name(self, name: str) -> str:
        """Return the name that was asked for without a file before it."""
        return self.elsewhere[name][1] if name in self.elsewhere else name


def read_columns(
    path: Path,
    names: Sequence[str],
    *,
    at_least: int = 1,
    options: ReadingOptions | None = None,
    times: Sequence[str] = (),
    table: Mapping[str, Any] | None = None,
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
        from 1. Several with commas between them are joined in order, one below the other; `FILE:COLUMN` is that of
        another file of as many rows, in the present folder or beside this one.
    at_least : int
        Fewest rows that make sense.
    options : ReadingOptions, optional
        What is known of the layout of a file; the rest is found.
    times : sequence of str
        If there are any, the column of times is read too, where it can be: the first of these that has a unit of time
        or none, or that which its name, its unit, or dates and times in it show.
    table : mapping, optional
        Columns by their heads, such as a data frame, which are read in place of a file; `path` is its name.

    Raises
    ------
    DataError
        If the file cannot be read or can be read in several ways, a column is missing, a cell is empty, not a number,
        not finite or an overload, or rows are too few: names row and column, and the option that may help. Rows count
        from 1 below the header.
    ConfigurationError
        If an option does not apply.
    """
    options = options or ReadingOptions()
    if table is None and is_run(path):
        options.check_only(path, "a run", "table")
        columns = _from_run(path, names, options.table or _STEPS, at_least, times)
    else:
        try:
            columns = _from_files(path, names, options, times, table)
        except DataError as error:
            if not times:
                raise
            # Of a file that can be read without times their column is at fault.
            found = read_columns(path, names, at_least=at_least, options=options, table=table)
            notes = filter(None, [found.assumptions, TIME_LEFT_OUT.format(error)])
            return replace(found, assumptions=", ".join(notes))
    _check_rows(path, len(next(iter(columns.values.values()))), at_least)
    for name, values in columns.values.items():
        beyond = np.flatnonzero(np.abs(values) >= _OVERLOAD)
        if beyond.size:
            raise DataError(
                f"{path}: row {beyond[0] + 1}, column {name}: {values[beyond[0]]:g} is what instruments write for an "
                f"overload or a missing value{options.missing_remedy(f'{values[beyond[0]]:g}')}"
            )
    return columns


def input_and_output(
    path: Path,
    given: tuple[str, str],
    options: ReadingOptions | None = None,
    table: Mapping[str, Any] | None = None,
) -> tuple[str, str]:
    """Return the columns of input and output; those of a run that are not given are of its slots.

    Parameters
    ----------
    path : Path
        A file or a run, as for `read_columns`.
    given : tuple of str
        The columns of input and output; an empty one is not given.
    options, table
        As for `read_columns`.

    Raises
    ------
    ConfigurationError
        If one is not given and no slot says it: names the columns that there are, with units.
    DataError
        If the file cannot be read.
    """
    if all(given):
        return given
    known: Sequence[str]
    if table is None and is_run(path):
        with Record(path) as record:
            slots = record.meta.get("slots", {})
            known = [header_with_unit(signal.name, signal.unit) for signal in record.signals]
        signals = [slots.get(slot, {}).get("signal", "") for slot in ("drive", "response")]
        given = (given[0] or signals[0], given[1] or signals[1])
        if all(given):
            return given
    else:
        try:
            _from_files(path, ["\0"], options or ReadingOptions(), (), table)
        except NoColumnError as error:
            known = error.known
    options_ = zip(("--input", "--output"), given, strict=True)
    missing = " and ".join(f"{name} COLUMN" for name, column in options_ if not column)
    raise ConfigurationError(f"{path}: {missing} must be given; its columns are: {', '.join(known)}")


def is_run(path: Path) -> bool:
    """Return whether a path is that of a run, its folder or its journal, not of a table."""
    return path.is_dir() or path.suffix == ".sqlite"


def _check_rows(path: Path, rows: int, at_least: int, otherwise: str = "") -> None:
    if rows < at_least:
        raise DataError(f"{path}: has {rows} rows of data; at least {at_least} are needed{otherwise}")


def check_variation(source: str, column: Quantity) -> None:
    """Check that a column varies.

    Raises DataError if it is constant, or varies by so little that the square is 0.
    """
    values = column.values
    if 0.0 < np.ptp(values) < 1.0 / _OVERLOAD:
        raise DataError(
            f"{source}: column {column.name} varies by {np.ptp(values):g} only, too little to compute with; "
            f"save it in a smaller unit, so that it varies by {1.0 / _OVERLOAD:.0e} at least"
        )
    if np.ptp(values) == 0.0:
        raise DataError(
            f"{source}: column {column.name} is {values[0]:g} in all {values.size} rows, so nothing can be identified"
        )


def write_csv(path: Path, table: Sequence[tuple[str, Floats | Sequence[object]]]) -> None:
    """Write columns of equal length behind their heads as CSV, numbers with all their digits, formulas as texts.

    Raises DataError if the file cannot be written.
    """
    write_blocks(path, [head for head, _ in table], [[values for _, values in table]])


def write_blocks(
    path: Path,
    header: Sequence[str],
    blocks: Iterable[Sequence[Floats | Sequence[object]]],
    *,
    escape_formulas: bool = True,
) -> None:
    """Write blocks of columns, one below the other, as CSV.

    With `escape_formulas` an apostrophe is put before a text that a spreadsheet would take for a formula, which may
    start programs (https://owasp.org/www-community/attacks/CSV_Injection). Numbers stay as they are, also as texts.

    Raises DataError if the file cannot be written.
    """
    shown = _as_text if escape_formulas else lambda cell: cell
    with result_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(map(shown, header))
        for columns in blocks:
            plain = [
                column.tolist() if isinstance(column, np.ndarray) else list(map(shown, column)) for column in columns
            ]
            writer.writerows(zip(*plain, strict=True))


def _as_text(cell: object) -> object:
    """Return a cell that no spreadsheet takes for a formula."""
    if not isinstance(cell, str) or not cell.startswith(_FORMULAS):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def _reader(path: Path) -> Reader:
    """Return what reads a kind of file, by its first bytes."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path} is a pipe or a device, and a table is read more than once: save it to a file first")
    with reading_errors(path), path.open("rb") as file:
        start = file.read(512)
    # Text may have the ending of a spreadsheet, or of MATLAB, whose version 4 has numbers of four bytes first.
    if start.startswith(b"MATLAB") or (path.suffix.lower() == ".mat" and b"\0" in start):
        return partial(read_arrays, kind="MATLAB")
    if path.suffix.lower() == ".npz":
        return partial(read_arrays, kind="NumPy")
    if path.suffix.lower() in _JSON and start.lstrip()[:1] in (b"[", b"{"):
        return partial(read_arrays, kind="JSON")
    if start.startswith(_SPREADSHEETS):
        return read_spreadsheet
    kinds = {HDF5: "HDF5", b"TDSm": "TDMS", b"PAR1": "Parquet", b"\x93NUM": "NumPy"}
    kind = kinds.get(start[:4])
    return read_text if kind is None else partial(read_arrays, kind=kind)


def _from_files(
    path: Path,
    names: Sequence[str],
    options: ReadingOptions,
    times: Sequence[str],
    table: Mapping[str, Any] | None = None,
) -> Columns:
    """Read columns of a file, and of others those that are asked for as `FILE:COLUMN`."""
    elsewhere = {name: place for name in names if (place := find_elsewhere(path, name)) is not None}
    values: dict[str, Floats] = {}
    units: dict[str, str] = {}
    notes: list[str] = []
    time = None
    for file in dict.fromkeys([path, *(place[0] for place in elsewhere.values())]):
        asked = [name for name in names if elsewhere.get(name, (path,))[0] == file]
        own = [elsewhere[name][1] if name in elsewhere else name for name in asked]
        if not asked:
            continue
        in_memory = None if table is None or file != path else partial(read_arrays, kind="table", table=table)
        found = _joined(in_memory or _reader(file), file, own, options, times if file == path else ())
        for name, column, unit in zip([*asked, *found.names[len(own) :]], found.values, found.units, strict=True):
            values[name], units[name] = column, unit
        time = (*found.names[len(own) :], time)[0]
        notes += [f"{file.name}: "] * (file != path) + [", ".join(found.notes)]
        if len(found.values[0]) != len(next(iter(values.values()))):
            sizes = {len(column): name for name, column in values.items()}
            counts = ", ".join(f"{name} {size}" for size, name in sizes.items())
            raise DataError(f"{path}: columns differ in length: {counts}")
    kept = None
    if options.missing is not None:
        rows = len(next(iter(values.values())))
        kept = np.flatnonzero(~np.any([options.are_missing(column) for column in values.values()], axis=0))
        values = {name: column[kept] for name, column in values.items()}
        notes.append(f"{rows - kept.size} of {rows} rows left out, as a value is missing")
    text = ", ".join(filter(None, notes)).replace(": , ", ": ")
    return Columns(str(path), values, units, text, time, kept, elsewhere)


def find_elsewhere(path: Path, name: str) -> tuple[Path, str] | None:
    """Return file and column of `FILE:COLUMN`; None if there is no such file."""
    file, _, column = name.rpartition(":")
    if not file or not column:
        return None
    return next(((place, column) for place in (Path(file), path.parent / file) if place.is_file()), None)


def _joined(
    reader: Reader, path: Path, names: Sequence[str], options: ReadingOptions, times: Sequence[str]
) -> ReadColumns:
    """Read columns of a file; where it has none of the name of a list, its members are joined in order."""
    try:
        return reader(path, names, options, times)
    except NoColumnError:
        lists = [[part.strip() for part in _LIST.split(name)] for name in names]
        if all(len(parts) == 1 for parts in lists):
            raise
    if len({len(parts) for parts in lists}) > 1:
        counts = ", ".join(f"{name} {len(parts)}" for name, parts in zip(names, lists, strict=True))
        raise ConfigurationError(f"{path}: columns that are joined must be as many of each: {counts}")
    found = reader(path, [part for parts in lists for part in parts], options, ())
    values: list[Floats] = []
    units: list[str] = []
    for parts in lists:
        end = len(parts)
        place = len(values) * end
        if len(set(found.units[place : place + end])) > 1:
            raise DataError(f"{path}: columns {', '.join(parts)} are joined, but in several units")
        values.append(np.concatenate(found.values[place : place + end]))
        units.append(found.units[place])
    notes = [f"{' and '.join(parts)} joined in order" for parts in lists]
    return ReadColumns(list(names), values, units, (*found.notes, *notes))


def _from_run(path: Path, names: Sequence[str], chosen: str, at_least: int, times: Sequence[str]) -> Columns:
    if chosen not in (_STEPS, _TELEMETRY):
        raise ConfigurationError(f"--format table={chosen}: {path} is a run; expected {_STEPS} or {_TELEMETRY}")
    with Record(path) as record:
        table = record.steps() if chosen == _STEPS else record.telemetry()
        known = [name for name in table.columns if name != "settled"]
        for name in names:
            if name not in known:
                raise DataError(f"{path}: has no column {name!r}; {closest(name, known)}")
        own = [name for name in times if name in known and record.unit(name) in SECONDS]
        own = [name for name in own if np.isfinite(table[name]).all()]
        names = [*names, *own[:1]]
        values = {name: table[name] for name in names}
        # The unit of a signal without one is 1.
        units = {name: unit if (unit := record.unit(name)) != "1" else "" for name in names}
        if chosen == _STEPS and len(table) < at_least and (ticks := record.count("telemetry")) >= at_least:
            other = f"; --format table={_TELEMETRY} takes the {ticks} readings within its steps"
            _check_rows(path, len(table), at_least, other)
    for name, column in values.items():
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            row = "step" if chosen == _STEPS else "reading"
            raise DataError(f"{path}: {row} {bad[0]}, column {name}: there is no value")
    return Columns(str(path), values, units, time=(*own, None)[0])
