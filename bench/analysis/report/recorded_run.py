"""A run as its report needs it: its record, its telemetry in a size that does not grow with it, and what follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bench.analysis.applied import Applied, apply_to_run, models_of
from bench.analysis.tracking_errors import results_json
from bench.analysis.uncertain_results import RunUncertainty
from bench.base import Floats
from bench.devices import Signal
from bench.identification import ModelFile, models_among
from bench.protocol import TRACES
from bench.record import Event, Record, Table, interlocks_of

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
    uncertainty, output = rows.columns.get(_UNCERTAINTY), rows.columns.get(record.controlled)
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


class Phase(NamedTuple):
    """A phase of a run: its name, when it began and ended (laboratory s), and how many steps it has finished."""

    name: str
    start: float
    end: float
    steps: int


@dataclass(frozen=True)
class RecordedRun:
    """What the record of a run says; `RecordedRun.of` reads it."""

    record: Record
    steps: Table
    events: Sequence[Event]
    summary: TelemetrySummary
    models: Sequence[ModelFile] = ()  # models to try on it, besides those that it has

    @classmethod
    def of(cls, record: Record, models: Sequence[ModelFile] = ()) -> RecordedRun:
        """Read a record, which stays open. Raises DataError if it is damaged."""
        steps, names = record.steps(), {signal.name for signal in record.signals}
        without_priors(record, steps)
        watched = (each for each in interlocks_of(record.meta) if {each.signal, each.minus} <= names)
        summary = summarize(record, [(each.signal, each.minus) for each in watched])
        found = cls(record, steps, record.events(), summary, models)
        # A record that does not say what its limits allow has the range that was seen.
        record.signals = tuple(
            signal if signal.extent else replace(signal, extent=_greatest(found.extremes[signal.name]))
            for signal in record.signals
        )
        return found

    @property
    def meta(self) -> dict[str, Any]:
        """Its metadata."""
        return self.record.meta

    def signal(self, name: str) -> Signal:
        """Return a signal by its name, also one that the record does not have."""
        return next((signal for signal in self.record.signals if signal.name == name), Signal(name, "", name))

    @cached_property
    def extremes(self) -> dict[str, dict[str, Any]]:
        """Least and greatest value of each signal, None where there is none, and its unit."""
        found = {}
        for signal in self.record.signals:
            low, high = wider(self.summary.extremes[signal.name], self.steps[signal.name])
            found[signal.name] = {"low": low, "high": high, "unit": signal.unit}
        return found

    @cached_property
    def phases(self) -> list[Phase]:
        """Its phases in their order; the last of one that has not ended lasts until its last reading."""
        steps, events = self.steps, self.events
        begun = [(event.t, event.text) for event in events if event.kind == "phase"] or [(0.0, "the whole run")]
        last = max([float(steps["finished"].max())] if len(steps) else [0.0])
        end = float(self.meta.get("finished") or max([last, *(event.t for event in events)]))
        ends = [t for t, _ in begun[1:]] + [end]
        return [
            Phase(name, t, until, int(np.count_nonzero((steps["started"] >= t) & (steps["started"] < max(until, t)))))
            for (t, name), until in zip(begun, ends, strict=True)
        ]

    @cached_property
    def applied(self) -> list[Applied]:
        """What models predict of its readings.

        They are those that were identified from it, those that it was given with a prediction band for its signals,
        and `models`.
        """
        if not len(self.steps):
            return []
        names = {signal.name for signal in self.record.signals}
        given = [
            file
            for file in self.given.values()
            if file.band is not None and {file.provenance.get("input"), file.provenance.get("output")} <= names
        ]
        return apply_to_run(self.record, self.steps, [*models_of(self.record), *given, *self.models])

    @cached_property
    def given(self) -> Mapping[str, ModelFile]:
        """The models that it was given, by the parameter that names each."""
        return models_among(self.record.files(), str(self.record.path))

    @cached_property
    def control(self) -> Mapping[str, Mapping[str, float]]:
        """The errors of what it controlled, see `results_json`; empty if it controlled nothing."""
        return results_json(self.record)

    def control_lines(self) -> list[str]:
        """Return these errors for people, a line for each kind of control."""
        lines = []
        for name, errors in self.control.items():
            shown = self.signal(self.record.controlled).display
            parts = [
                f"{value:.1f} s a target"
                if key == "seconds_per_target"
                else f"error {key.replace('_', ' ')} {shown.text(value)}"
                for key, value in errors.items()
            ]
            lines.append(f"{name}: {', '.join(parts)}")
        return lines

    @cached_property
    def uncertainty(self) -> RunUncertainty:
        """What is known of the uncertainty of its signals."""
        return RunUncertainty.of(self.record, self.steps)

    @cached_property
    def result(self) -> dict[str, Any]:
        """What its report says, for programs."""
        return {
            "run": self.meta["run"],
            "status": self.record.status,
            "reason": self.record.reason,
            "steps": len(self.steps),
            "laboratory_seconds": self.meta.get("finished"),
            "safe_state": self.record.safe_state,
            "extremes": self.extremes,
            "models": {
                each.file.name: {
                    **each.errors().to_json(),
                    "unit": each.unit,
                    "skipped": each.first,
                    "beyond": each.beyond.to_json(),
                }
                for each in self.applied
            },
            "lateness": self.meta.get("lateness", {}),
            "uncertainty": self.uncertainty.to_json(),
            **self.control,
        }


def _greatest(extremes: Mapping[str, Any]) -> float | None:
    low, high = extremes["low"], extremes["high"]
    return None if low is None else max(abs(low), abs(high)) or None
