"""Two runs side by side: what differs in what they were given, and how far their signals are apart."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from bench.analysis.report.page.pages import PagePart, PageTable, PageText
from bench.analysis.run_folder import main_result
from bench.analysis.tracking_errors import results_json, target_results
from bench.base import fitting_prefix, format_duration, html_table, significant
from bench.protocol import PARAMETER
from bench.record import Difference, Record, Table, differences

_OF_THE_WALL_CLOCK = ("clock", "observer", "suspended", "notify", "pause", "resume", "remark", PARAMETER)
"""Kinds of events that say how fast a machine was, and when an operator did something."""


@dataclass(frozen=True)
class SignalDifference:
    """How far a signal of the second run is from that of the first, over the readings of equal steps."""

    # Of the absolute difference, in the unit of the signal.
    rms: float
    maximum: float
    step: int  # step of the greatest difference
    unit: str  # unit of the signal in the first run


@dataclass(frozen=True)
class Outcomes:
    """How a run ended, for a table."""

    # Its name, and how it ended.
    run: str
    status: str
    reason: str
    steps: int  # finished steps
    seconds: float | None  # laboratory time, s; None of a run that has not ended
    result: str  # main result, as its protocol noted it
    # Errors of a run under control, as `bench.analysis.tracking_errors.results_json` gives them.
    errors: Mapping[str, Any]


@dataclass(frozen=True)
class RunComparison:
    """What tells two runs apart.

    Attributes
    ----------
    differences : tuple of Difference
        Parameters, content of the rig, identities, versions and files that are not the same.
    outcomes : (Outcomes, Outcomes)
        How each ended.
    common_steps : int
        Number of steps that both have, by their numbers.
    signals : mapping of str to SignalDifference
        By the signals that both have, over these steps.
    reproducibility : mapping of str to float
        By the signals that both controlled: standard deviation of what two sessions reach at the same targets, in the
        unit of the signal. Empty if they had no targets, or others.
    equal : mapping of str to bool
        Whether `steps`, `telemetry` and `events` are equal to the last bit; events without those of the wall clock.
    """

    differences: tuple[Difference, ...]
    outcomes: tuple[Outcomes, Outcomes]
    common_steps: int
    signals: Mapping[str, SignalDifference]
    reproducibility: Mapping[str, float]
    equal: Mapping[str, bool]

    def to_json(self) -> dict[str, Any]:
        """Return it for programs."""
        return asdict(self)

    def sections(self) -> dict[str, list[PagePart]]:
        """Return the comparison by title, for the terminal, a notebook and a page."""
        differences = [
            (each.key, *("none" if value is None else str(value) for value in (each.first, each.second)))
            for each in self.differences
        ]
        signals = []
        for name, apart in self.signals.items():
            factor, unit = fitting_prefix(apart.unit, apart.maximum)
            numbers = [significant(factor * value, 3) for value in (apart.rms, apart.maximum)]
            signals.append((name, *numbers, "" if unit == "1" else unit, str(apart.step)))
        said = [
            f"reproducibility of {signal}: {significant(deviation, 2)} {self.signals[signal].unit}, standard "
            "deviation of what two sessions reach at the same targets"
            for signal, deviation in self.reproducibility.items()
        ]
        same = [name for name, equal in self.equal.items() if equal]
        title = f"second less first, {self.common_steps} common steps"
        return {
            "Outcome": [PageTable(("", "first", "second"), self._outcome_rows())],
            "What differs": [
                PageTable(("key", "first", "second"), differences)
                if differences
                else PageText("nothing differs in what they were given")
            ],
            "Signals": [
                PageTable(("signal", "RMS", "max", "unit", "at step"), signals, title=title, numbers_from=1),
                *map(PageText, [*said, f"equal to the last bit: {', '.join(same) or 'nothing'}"]),
            ],
        }

    def _outcome_rows(self) -> list[tuple[str, str, str]]:
        rows = [
            (name, *("" if value is None else str(value) for value in map(attrgetter(name), self.outcomes)))
            for name in ("run", "status", "reason", "steps", "result")
        ]
        lasted = ("" if each.seconds is None else format_duration(each.seconds) for each in self.outcomes)
        rows.insert(4, ("duration", *lasted))
        for kind in ("tracking", "following"):
            errors = [each.errors.get(kind, {}) for each in self.outcomes]
            for key in {**errors[0], **errors[1]}:
                rows.append(
                    (f"{kind}, {key}", *(significant(each[key], 4) if key in each else "–" for each in errors))
                )
        return [(name, first, second) for name, first, second in rows if first or second]

    def _repr_html_(self) -> str:
        tables = {title: parts[0] for title, parts in self.sections().items()}
        return "".join(
            html_table(table.heads, table.rows, table.title or title.lower())
            for title, table in tables.items()
            if isinstance(table, PageTable)
        )


def compare_runs(first: Record, second: Record) -> RunComparison:
    """Compare two runs, finished or not.

    Raises DataError if a journal is damaged.
    """
    tables = first.steps(), second.steps()
    common, ours, theirs = np.intersect1d(tables[0]["step"], tables[1]["step"], return_indices=True)
    signals: dict[str, SignalDifference] = {}
    for signal in first.signals:
        if signal.name in tables[1].columns:
            apart = np.abs(tables[1][signal.name][theirs] - tables[0][signal.name][ours])
            if np.any(np.isfinite(apart)):
                worst = int(np.nanargmax(apart))
                rms = float(np.sqrt(np.nanmean(apart**2)))
                signals[signal.name] = SignalDifference(rms, float(apart[worst]), int(common[worst]), signal.unit)
    return RunComparison(
        tuple(differences(first.meta, second.meta)) + _files(first, second),
        (_outcomes(first, len(tables[0])), _outcomes(second, len(tables[1]))),
        len(common),
        signals,
        _reproducibility(first, second),
        {
            "steps": _steps(first) == _steps(second) and _equal(*tables),
            "telemetry": _equal(first.telemetry(), second.telemetry()),
            "events": _events(first) == _events(second),
        },
    )


def _reproducibility(first: Record, second: Record) -> dict[str, float]:
    output = first.controlled
    if not output or second.controlled != output:
        return {}
    ours, theirs = target_results(first, output), target_results(second, output)
    if ours is None or theirs is None or not np.array_equal(ours.targets, theirs.targets):
        return {}
    # The variance of a difference is that of both sessions.
    return {output: float(np.sqrt(np.mean((theirs.outputs - ours.outputs) ** 2) / 2.0))}


def _files(first: Record, second: Record) -> tuple[Difference, ...]:
    sums = [
        {name: f"sha256 {hashlib.sha256(content).hexdigest()[:12]}" for name, content in record.files().items()}
        for record in (first, second)
    ]
    return tuple(
        Difference(f"files.{name}", sums[0].get(name), sums[1].get(name))
        for name in {**sums[0], **sums[1]}
        if sums[0].get(name) != sums[1].get(name)
    )


def _outcomes(record: Record, steps: int) -> Outcomes:
    return Outcomes(
        str(record.meta["run"]),
        record.status,
        record.reason,
        steps,
        record.meta.get("finished"),
        main_result(record),
        results_json(record),
    )


def _steps(record: Record) -> list[tuple[Any, ...]]:
    return [(step.phase, step.label, step.settled, dict(step.setpoints)) for step in record.step_records()]


def _equal(first: Table, second: Table) -> bool:
    return first.columns.keys() == second.columns.keys() and all(
        np.array_equal(column, second[name], equal_nan=True) for name, column in first.columns.items()
    )


def _events(record: Record) -> list[Any]:
    return [event for event in record.events() if event.kind not in _OF_THE_WALL_CLOCK]
