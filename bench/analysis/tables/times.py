"""Times of rows: their unit, what they count from, and stamps that repeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.data import Quantity
from bench.analysis.tables.reading.heads import SECONDS, spelled
from bench.base import ConfigurationError, DataError, Floats, counted

Flags = npt.NDArray[np.bool_]

_DAYS = {"Excel": (20_000.0, 80_000.0), "MATLAB": (700_000.0, 800_000.0)}
"""Days that Excel counts from 1900 and MATLAB from the year 0. Derivation: years 1954 to 2119, 1916 to 2190."""

_EPOCHS = 1e9, 2.2e9
"""Seconds since 1970. Derivation: those of 2001 to 2039."""

_LONGEST_STEP = 1e-3
"""Mean step of numbers that are days, not seconds. Derivation: 86 s; of seconds it were a rate beyond 1 kHz."""

_LONG_BEFORE = 100.0
"""Factor of the span of a record by which its first stamp shows that times count from before it."""


_EVEN = "where rows are evenly sampled, leave the column out and say --format interval=TIME, such as 0.1s"
"""Remedy for times that cannot be those of a record."""


def rows_in_time(
    source: str, column: Quantity, others: Sequence[Floats], unit: str | None = None
) -> tuple[Flags, Floats, tuple[str, ...]]:
    """Return which rows of a record are kept, their times in s, and what was assumed.

    A row with the time and the values of the row before was written twice, and is left out. If any row with the
    time of the row before has values of its own, the clock is coarser than the sampling: `seconds_of` spreads them.

    Parameters
    ----------
    source, column, unit
        As `seconds_of`, which says what is raised.
    others : sequence of ndarray, shape (N,) each
        The other columns.
    """
    values = column.values
    repeated = np.zeros(values.size, dtype=bool)
    repeated[1:] = np.diff(values) == 0.0
    same = [np.diff(other)[repeated[1:]] == 0.0 for other in others]
    count = int(repeated.sum())
    if count and values.size - count > 1 and all(map(np.all, same)):
        kept = ~repeated
        seconds, notes = seconds_of(source, replace(column, values=values[kept]), unit)
        return kept, seconds, (*notes, f"{counted(count, 'row')} equal to the row before in time and values left out")
    return np.ones(values.size, dtype=bool), *seconds_of(source, column, unit)


def seconds_of(source: str, column: Quantity, unit: str | None = None) -> tuple[Floats, tuple[str, ...]]:
    """Return a column of times, shape (N,), in s, and what was assumed.

    Times that count from long before the record are given since its first row. Rows of equal stamps are spread evenly
    up to the next stamp.

    Parameters
    ----------
    source : str
        Where it comes from, for messages.
    column : Quantity
        The times.
    unit : str, optional
        Their unit where the column does not say it.

    Raises
    ------
    DataError
        If the unit is none of time, or may be s or days; or the times decrease, or are all equal: names the row.
    ConfigurationError
        If the column has another unit than the one given.
    """
    name, own, values = column.name, column.unit, column.values
    if own and own not in SECONDS:
        raise DataError(f"{source}: column {name} is in {own}; expected a time in {', '.join(SECONDS)}")
    given = spelled(unit) if unit else ""
    if given and own and given != own:
        raise ConfigurationError(f"--format time-unit={unit}: column {name} of {source} is in {own} by its head")
    decreasing = np.flatnonzero(np.diff(values) < 0.0)
    if decreasing.size:
        row = int(decreasing[0]) + 2
        before, after = values[row - 2 : row]
        raise DataError(
            f"{source}: column {name} does not increase in row {row} ({after:g} after {before:g}); "
            f"times must be those of one record, in order; {_EVEN}"
        )
    notes: list[str] = []
    found = given or own
    if not found and values.size:
        found, note = _by_magnitude(source, name, values)
        notes.append(note)
    scale = SECONDS[found or "s"]
    if values.size > 1 and values[0] > _LONG_BEFORE * (values[-1] - values[0]) > 0.0:
        values = values - values[0]
        notes.append("times since the first row")
    times, repeated = _spread(source, name, values * scale)
    if repeated:
        notes.append(
            f"{counted(repeated, 'row')} with the stamp of the row before spread evenly up to the next stamp"
        )
    return times, tuple(notes)


def _by_magnitude(source: str, name: str, values: Floats) -> tuple[str, str]:
    """Return the unit of increasing numbers without one, and a note."""
    low, high = float(values[0]), float(values[-1])
    for program, (begin, end) in _DAYS.items():
        if begin <= low and high <= end:
            if high - low < _LONGEST_STEP * max(values.size - 1, 1):
                return "d", f"times in days of {program} by their magnitude"
            raise DataError(
                f"{source}: column {name}: numbers from {low:g} to {high:g} without a unit may be days of {program} "
                "or seconds: say --format time-unit=d or --format time-unit=s"
            )
    for unit in ("s", "ms", "µs", "ns"):
        if _EPOCHS[0] <= low * SECONDS[unit] and high * SECONDS[unit] <= _EPOCHS[1]:
            return unit, f"times in {unit} since 1970 by their magnitude"
    return "s", "times taken as s"


def _spread(source: str, name: str, times: Floats) -> tuple[Floats, int]:
    """Return times of which each is later than the one before, and how many rows were moved."""
    starts = np.flatnonzero(np.r_[True, np.diff(times) > 0.0])
    repeated = times.size - starts.size
    if times.size < 2 or not repeated:
        return times, 0
    if starts.size == 1:
        raise DataError(
            f"{source}: column {name} does not increase: it is {times[0]:g} in all {times.size} rows; {_EVEN}"
        )
    step = (times[-1] - times[starts[-2]]) / (starts[-1] - starts[-2])
    end = times[-1] + step * (times.size - starts[-1])
    rows = np.arange(times.size)
    return np.interp(rows, np.r_[starts, times.size], np.r_[times[starts], end]), repeated
