"""The measurements of a command: read and checked once, and handed through from their files to the report."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.data import TIME_LEFT_OUT, Quantity, check_variation, is_run, read_columns
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.reading.table import FEWEST_ROWS
from bench.analysis.tables.times import rows_in_time, seconds_of
from bench.base import ConfigurationError, DataError, Floats
from bench.identification import Advice, ModelFile
from bench.models import TimedModel, overwritten_from
from bench.record import Record

Flags = npt.NDArray[np.bool_]

_ROWS = re.compile(r"(\d*):(\d*)")

_FEWEST_SORTED, _TRAVELS, _MEAN_JUMP = 30, 5.0, 0.03
"""Rows, whole travels of the output over its range, and share of the range from row to row of sorted rows.

Derivation: one sweep travels once, and noise of 2 % adds 2 % a row; branches are some 10 % apart.
"""

NO_TIMES = "none"
"""Stands for a column of times where a file's own is to be left out."""

TIME_COLUMN = "time_column"
"""Parameter of an imported run: the column of times of its file."""


@dataclass(frozen=True)
class ColumnNames:
    """Which columns are read, by name or by number from 1.

    Attributes
    ----------
    input : str
        The input of a model, or the targets of its inverse.
    output, time, weights : str or None
        The measured output, when each row was taken, and the weight of each row in a fit, >= 0.
    times : tuple of str
        Columns of times of which the first that there is serves, where `time` is not given.
    others : tuple of str
        Further columns.
    """

    input: str
    output: str | None = None
    time: str | None = None
    weights: str | None = None
    times: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Dataset:
    """Measurements from one file or several, one after another.

    Attributes
    ----------
    paths : tuple of Path
        The files, or folders of runs; none of a table in memory.
    source : str
        The same for messages.
    input : Quantity
        Inputs, shape (N,), finite as the others.
    output, time : Quantity or None
        Measured outputs and times, shape (N,) each, as far as they were read.
    weights : ndarray, shape (N,), or None
        Weight of each row in a fit; 1 if None.
    starts : tuple of int
        First row of each file.
    assumptions : str
        What was assumed about the layout of the files; empty for a run.
    others : tuple of Quantity
        The further columns, shape (N,) each.
    """

    paths: tuple[Path, ...]
    source: str
    input: Quantity
    output: Quantity | None = None
    time: Quantity | None = None
    weights: Floats | None = None
    starts: tuple[int, ...] = (0,)
    assumptions: str = ""
    others: tuple[Quantity, ...] = ()

    @property
    def name(self) -> str:
        """The names of the files, or of the table."""
        return ", ".join(path.name for path in self.paths) or self.source

    @property
    def inputs(self) -> Floats:
        """The inputs, shape (N,)."""
        return self.input.values

    @property
    def outputs(self) -> Floats:
        """The measured outputs, shape (N,). They must have been read."""
        assert self.output is not None
        return self.output.values

    @cached_property
    def times(self) -> Floats | None:
        """When each row was taken, shape (N,) in s; None if that was not read.

        Raises DataError if the unit is none of time, or the times do not increase: names the row.
        """
        return None if self.time is None else seconds_of(self.source, self.time)[0]

    def without_time(self, reason: str = "") -> Dataset:
        """Return the same rows without their times; the assumptions say why, if a reason is given."""
        return replace(self, time=None, assumptions=", ".join(filter(None, [self.assumptions, reason])))

    def with_usable_times(self) -> Dataset:
        """Return the same rows, without times that nobody asked for and that cannot be used."""
        if self.time is None or self.time.name in (self.input.name, self.output and self.output.name):
            return self.without_time()
        try:
            _ = self.times
        except DataError as error:
            return self.without_time(TIME_LEFT_OUT.format(error))
        return self

    def check_units(self, model: ModelFile) -> None:
        """Check that input and output are in the units of a model; an unknown unit passes.

        Raises DataError if both are known and differ.
        """
        check_unit(model.response.input_unit, self.input)
        if self.output is not None:
            check_unit(model.response.output_unit, self.output)

    def fitted_rows(self, rows: slice | None = None, skip: int = 0) -> tuple[Flags, tuple[Advice, ...]]:
        """Return which rows are fitted, shape (N,), and what is odd about the measurements, though usable.

        Each further file starts with a memory of its own, which nobody knows: its rows are fitted from where its
        inputs have overwritten what they do at all.

        Parameters
        ----------
        rows : slice or None
            Rows that may be fitted; all if None.
        skip : int
            Number of first rows that drive the memory but do not count.

        Raises
        ------
        DataError
            If the input is constant, or too few rows are left.
        ConfigurationError
            If no row may be fitted, or there are not so many rows.
        """
        inputs = self.inputs
        if skip < 0:
            raise ConfigurationError(f"--skip {skip}: expected a number of rows ≥ 0")
        if inputs.size - skip < FEWEST_ROWS:
            left = max(inputs.size - skip, 0)
            raise DataError(f"{self.source}: --skip {skip} leaves {left} of {inputs.size} rows; too few")
        check_rows("--train", rows, inputs.size)
        chosen = np.zeros(inputs.size, dtype=bool)
        chosen[slice(None) if rows is None else rows] = True
        advice = []
        for start, stop in pairwise((*self.starts[1:], inputs.size)):
            until = overwritten_from(inputs[start:stop])
            if until > (stop - start) // 2:
                text = (
                    f"the file of rows {start} to {stop - 1} overwrites its unknown memory only at row "
                    f"{start + until}: its start is taken as if it followed the file before"
                )
                advice.append(Advice("file-memory", text))
            else:
                chosen[start : start + until] = False
        if not chosen.any():
            raise ConfigurationError(f"--train leaves none of {inputs.size} rows")
        check_variation(self.source, self.input)
        return chosen, tuple(advice)


def read_dataset(
    paths: Sequence[Path],
    names: ColumnNames,
    reading: ReadingOptions | None = None,
    *,
    at_least: int = 1,
    table: Mapping[str, Any] | None = None,
) -> Dataset:
    """Read measurements from files that `read_columns` reads, each of them once; errors as there.

    A `table` in memory has one path, which is its name.

    Raises DataError too if the unit of a column differs from file to file, ConfigurationError if several files have
    times.
    """
    if names.time is not None and len(paths) > 1:
        raise ConfigurationError(f"--time: expected one file, as times are those of one record; got {len(paths)}")
    reading = reading or ReadingOptions()
    interval = reading.seconds_between_rows
    if interval is not None and (names.time is not None or len(paths) > 1):
        raise ConfigurationError("--format interval=TIME: expected one file, without --time")
    wanted = [name for name in (names.input, names.output, names.weights, names.time, *names.others) if name]
    sought = () if names.time or interval else names.times
    found = [
        read_columns(path, wanted, at_least=at_least, options=reading, times=sought, table=table) for path in paths
    ]
    first, of_run = found[0], table is None and is_run(paths[0])
    for path, each in zip(paths, found, strict=True):
        for name in wanted:
            if each.units[name] != first.units[name]:
                raise DataError(
                    f"{path}: column {name} is in {each.units[name] or 'no unit'}; in {paths[0]} it is in "
                    f"{first.units[name] or 'no unit'}"
                )

    columns = {
        name: Quantity(first.own_name(name), first.units[name], np.concatenate([each.values[name] for each in found]))
        for name in (*wanted, *([first.time] if first.time else []))
    }
    time, remarks = columns.get(names.time or first.time or ""), list[str]()
    if interval is not None:
        rows = np.arange(columns[names.input].values.size) if first.kept is None else first.kept
        time = Quantity("time", "s", interval * rows.astype(np.float64))
        remarks.append(f"rows {interval:g} s apart")
    elif time is not None and not of_run:
        try:
            values = [column.values for column in columns.values()]
            kept, seconds, said = rows_in_time(first.source, time, values, reading.time_unit)
            time, remarks = Quantity(time.name, "s", seconds), [*said]
            columns = {name: replace(column, values=column.values[kept]) for name, column in columns.items()}
        except DataError:
            # Those that nobody asked for are at fault where they are used.
            if names.time is not None:
                raise
    driven, measured, weights = (columns.get(name or "") for name in (names.input, names.output, names.weights))
    assert driven is not None
    if not of_run and measured is not None and _is_sorted(driven.values, measured.values):
        remarks.append("sorted by its input: the order of measurement is lost")
    starts = np.cumsum([0, *(each.values[names.input].size for each in found[:-1])])
    notes = [f"{path.name}: {each.assumptions}" for path, each in zip(paths, found, strict=True) if each.assumptions]
    several = len(paths) > 1
    return Dataset(
        tuple(paths) if table is None else (),
        ", ".join(path.name for path in paths) if several else first.source,
        driven,
        measured,
        time,
        None if weights is None else weights.values,
        tuple(starts.tolist()),
        ", ".join(filter(None, ["; ".join(notes) if several else first.assumptions, *remarks])),
        tuple(columns[name] for name in names.others),
    )


def _is_sorted(inputs: Floats, outputs: Floats) -> bool:
    """Return whether rows are in the order of their inputs, though their outputs jump between branches."""
    steps = np.diff(inputs)
    span = float(np.ptp(outputs))
    if inputs.size < _FEWEST_SORTED or span == 0.0 or not ((steps >= 0.0).all() or (steps <= 0.0).all()):
        return False
    jumps = np.abs(np.diff(outputs)) / span
    return float(jumps.sum()) > _TRAVELS and float(jumps.mean()) > _MEAN_JUMP


def read_for(
    models: Sequence[ModelFile], path: Path, names: ColumnNames, reading: ReadingOptions | None = None
) -> Dataset:
    """Read measurements for models; errors as `read_dataset`.

    An empty name of input or output is that of the data of the first model. Times that nobody named are looked for if
    a model takes them.
    """
    own = models[0].provenance
    output = str(own.get("output", "")) if names.output == "" else names.output
    timed = next((file for file in models if isinstance(file.model, TimedModel)), None)
    times = () if timed is None else time_names(path, timed)
    names = replace(names, input=names.input or str(own.get("input", "")), output=output, times=times)
    return read_dataset([path], names, reading)


def time_names(path: Path, model: ModelFile | None = None) -> tuple[str, ...]:
    """Return the columns that may hold the times of a file; that of the data of a model first.

    Of a run these are the times of its telemetry, and of rows that were imported with times: its own steps are
    quasi-static.
    """
    own = None if model is None else model.provenance.get("time")
    names: tuple[str, ...] = ("time",)
    if is_run(path):
        with Record(path) as record:
            names = ("t", "finished") if TIME_COLUMN in record.meta["parameters"] else ("t",)
    return (*([str(own)] if own else []), *names)


def check_unit(expected: str, column: Quantity) -> None:
    """Check that a column's unit is that of the model; an unknown unit passes.

    Raises DataError if both are known and differ.
    """
    if column.unit and expected and column.unit != expected:
        raise DataError(f"column {column.name} is in {column.unit}; the model has it in {expected}")


def is_rows(text: str) -> bool:
    """Return whether a text has the form of a range of rows, `START:STOP`."""
    return _ROWS.fullmatch(text) is not None


def parse_rows(option: str, text: str) -> slice:
    """Return the rows of `START:STOP`, counted from 0 without STOP; either may be left out.

    Raises ConfigurationError if it is none.
    """
    match = _ROWS.fullmatch(text)
    if match is None:
        raise ConfigurationError(f"{option} {text}: expected rows as START:STOP, such as 0:3000 or 3000:")
    start, stop = (int(part) if part else None for part in match.groups())
    return slice(start, stop)


def check_rows(option: str, rows: slice | None, count: int) -> None:
    """Check that rows that are asked for are there.

    Raises ConfigurationError if there are fewer.
    """
    if rows is not None and max(rows.stop or 0, rows.start or 0) > count:
        text = f"{'' if rows.start is None else rows.start}:{'' if rows.stop is None else rows.stop}"
        raise ConfigurationError(f"{option} {text} goes beyond the last row: there are {count}")


def digest(inputs: Floats) -> str:
    """Return by what the inputs of a model's own data, shape (N,), are known again."""
    return hashlib.sha256(np.ascontiguousarray(inputs, dtype="<f8").tobytes()).hexdigest()
