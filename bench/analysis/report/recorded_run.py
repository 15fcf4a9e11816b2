"""A run as its report needs it: what its record says, read once, and what follows from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from bench.analysis.applied import Applied, apply_to_run, models_of
from bench.analysis.report.telemetry_summary import TelemetrySummary, summarize, wider, without_priors
from bench.analysis.tracking_errors import results_json
from bench.analysis.uncertain_results import RunUncertainty
from bench.devices import Signal
from bench.identification import ModelFile, models_among
from bench.record import Event, Record, Table
from bench.rig import Interlock


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
        watched = (each for each in interlocks_of(record) if {each.signal, each.minus} <= names)
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

    @property
    def controlled(self) -> str:
        """The signal that it controlled; empty if there was none."""
        return str(self.meta.get("controls", ""))

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
    def control(self) -> Mapping[str, Any]:
        """The errors of what it controlled, see `results_json`; empty if it controlled nothing."""
        return results_json(self.record, self.controlled) if self.controlled else {}

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


def interlocks_of(record: Record) -> list[Interlock]:
    """Return the interlocks that watched a run; none where the record does not say."""
    found = []
    for table in (record.meta.get("rig_content") or {}).get("interlocks", ()):
        with suppress(ValidationError):
            found.append(Interlock.model_validate(table))
    return found


def _greatest(extremes: Mapping[str, Any]) -> float | None:
    low, high = extremes["low"], extremes["high"]
    return None if low is None else max(abs(low), abs(high)) or None
