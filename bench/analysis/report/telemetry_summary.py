"""What a report needs of the telemetry of a run, read once: a long run has more ticks than fit into memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.base import Floats
from bench.protocol import TRACES
from bench.record import Record, Table

Extremes = tuple[float | None, float | None]

_MOST_WHOLE = 20_000
"""Ticks up to which all of them are kept."""
_UNCERTAINTY = TRACES[3].name
_STRETCHES = 700
"""Stretches of a longer telemetry, about as many as a figure has columns of points."""


@dataclass(frozen=True)
class TelemetrySummary:
    """The telemetry of a run in a size that does not grow with it."""

    count: int  # ticks of the run
    # Ticks for figures, columns as of `Record.telemetry`: all of them, or of a long run those of each of 700
    # stretches that have the least and the greatest value of a signal, and its first and last one.
    shown: Table
    extremes: Mapping[str, Extremes]  # least and greatest value of each signal; None where there is no finite one
    differences: Mapping[tuple[str, str], Extremes]  # the same of the differences of signals that were asked for

    @property
    def remark(self) -> str:
        """What a figure of `shown` has to say; empty if it has every tick."""
        if len(self.shown) == self.count:
            return ""
        return (
            f"Of {self.count} ticks {len(self.shown)} are drawn: the least and the greatest value of every signal in "
            f"each of {_STRETCHES} stretches."
        )


def summarize(record: Record, pairs: Sequence[tuple[str, str]] = ()) -> TelemetrySummary:
    """Read the telemetry of a run once; `pairs` are signals whose differences count.

    Raises DataError if the record is damaged.
    """
    count = record.count("telemetry")
    stretch = 1 if count <= _MOST_WHOLE else -(-count // _STRETCHES)
    names = [signal.name for signal in record.signals]
    extremes: dict[str, Extremes] = dict.fromkeys(names, (None, None))
    differences: dict[tuple[str, str], Extremes] = dict.fromkeys(pairs, (None, None))
    parts: list[Floats] = []
    columns = ["t", "step", *names]
    pending, position = np.empty((0, len(columns))), 0
    for ticks in record.ticks():
        without_priors(record, ticks)
        for name in names:
            extremes[name] = wider(extremes[name], ticks[name])
        for signal, minus in pairs:
            differences[signal, minus] = wider(differences[signal, minus], ticks[signal] - ticks[minus])
        rows = np.column_stack([ticks[name] for name in columns])
        if stretch == 1:
            parts.append(rows)
            continue
        while len(rows):
            left = stretch - position % stretch
            pending = _outline(np.concatenate([pending, rows[:left]]))
            position += min(left, len(rows))
            rows = rows[left:]
            if position % stretch == 0:
                parts.append(pending)
                pending = pending[:0]
    shown = np.concatenate([*parts, pending])
    table = Table({name: shown[:, i].copy() for i, name in enumerate(columns)}, {n: record.unit(n) for n in columns})
    return TelemetrySummary(count, table, extremes, differences)


def _outline(rows: Floats) -> Floats:
    """Return the first and the last row, and those with the least and the greatest value of a column."""
    values = rows[:, 2:]
    least = np.where(np.isfinite(values), values, np.inf).argmin(axis=0)
    greatest = np.where(np.isfinite(values), values, -np.inf).argmax(axis=0)
    chosen = np.unique(np.concatenate([[0, len(rows) - 1], least, greatest]))
    return np.asarray(rows[chosen])


def without_priors(record: Record, rows: Table) -> None:
    """Leave out the uncertainty of a controller's filter before its first estimate: it only says that it is unknown.

    It is beyond all that the output has been.
    """
    uncertainty, output = rows.columns.get(_UNCERTAINTY), rows.columns.get(str(record.meta.get("controls", "")))
    if uncertainty is not None and output is not None and np.isfinite(output).any():
        uncertainty[uncertainty > np.nanmax(output) - np.nanmin(output)] = np.nan


def wider(before: Extremes, values: Floats) -> Extremes:
    """Return extremes with those of further values."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return before
    ends = [float(finite.min()), float(finite.max())]
    low, high = before
    return min(ends[0], ends[0] if low is None else low), max(ends[1], ends[1] if high is None else high)
