"""Cells with a date and a time of day, or a time alone: seconds."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from datetime import UTC, datetime

import numpy as np

from bench.base import DataError, Floats

_DAY = 86400.0
"""Seconds of a day."""

_CLOCK = re.compile(r"(?:(\d+):([0-5]\d):([0-5]\d(?:[.,]\d+)?)|([0-5]?\d):([0-5]\d[.,]\d+))")
"""Hours, which may be more than 24, minutes and seconds; or minutes and seconds with a fraction."""

_FORMATS = "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%m/%d/%Y %I:%M:%S %p", "%I:%M:%S %p"
"""Moments not written as in ISO 8601: German, Japanese, of MATLAB, American. A fraction is taken off first."""

_FRACTION = re.compile(r"(?<=:\d\d)[.,]\d+")


def seconds_of(cell: str) -> float | None:
    """Return a date with a time of day or a time alone in s; None if it is neither.

    Dates count from 1970 in universal time; those without a zone are taken as such.
    """
    cell = cell.strip().strip('"')
    if ":" not in cell:
        return None
    if found := _CLOCK.fullmatch(cell):
        hours, minutes, seconds = found.groups()[:3] if found[1] else ("0", *found.groups()[3:])
        return 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
    try:
        moment = datetime.fromisoformat(cell)
    except ValueError:
        return _otherwise(cell)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _otherwise(cell: str) -> float | None:
    """Return a moment that is not written as in ISO 8601, as `seconds_of`."""
    fraction = _FRACTION.search(cell)
    whole = _FRACTION.sub("", cell)
    for form in _FORMATS:
        with suppress(ValueError):
            moment = datetime.strptime(f"{whole} +0000", f"{form} %z")
            seconds = moment.timestamp() if "%d" in form else moment.timestamp() % _DAY
            return seconds + (float(fraction[0].replace(",", ".")) if fraction else 0.0)
    return None


def _past_midnight(times: Floats) -> Floats:
    """Return times of day, s, which go on where they fall back by more than half a day."""
    known = np.isfinite(times)
    falls = np.diff(times[known], prepend=times[known][:1]) < -_DAY / 2.0
    if not falls.any() or times[known].max() >= _DAY:
        return times
    onward = times.copy()
    onward[known] += _DAY * np.cumsum(falls)
    return onward


def moment_in(where: str, cell: str) -> float:
    """Return the seconds in a cell; raises DataError with the place if it has no date and time."""
    found = seconds_of(cell)
    if found is None:
        raise DataError(f"{where}: {cell[:40]!r} is no date and time, as those above are")
    return found


def with_moments(cells: Sequence[str], places: Collection[int]) -> frozenset[int]:
    """Return those of some columns that have a date and time in a row of cells."""
    return frozenset(place for place in places if place < len(cells) and seconds_of(cells[place].strip()) is not None)


def since_first(
    values: Sequence[Floats],
    units: Sequence[str],
    names: Sequence[str],
    are_moments: Sequence[bool],
    *,
    may_be_clocks: bool = False,
) -> tuple[list[Floats], list[str], list[str]]:
    """Return columns, shape (N,) each, with those of dates and times in s since the first row; units, and notes.

    Those that may be times of day, without a date, go on past midnight.
    """
    columns, notes = [*values], list[str]()
    for place, name in enumerate(names):
        if are_moments[place]:
            times = _past_midnight(values[place]) if may_be_clocks else values[place]
            columns[place] = times - times[np.isfinite(times)][:1]
            midnight = ", past midnight" if times is not values[place] else ""
            notes.append(f"{name}: dates and times, in s since the first row{midnight}")
    return columns, ["s" if is_moment else unit for unit, is_moment in zip(units, are_moments, strict=True)], notes
