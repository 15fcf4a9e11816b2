"""Errors of a run that reached targets or followed a reference, from its journal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.journal import Record

Floats = npt.NDArray[np.float64]

REACH = "reach"
READING = "reading"
FOLLOW = "follow"
"""Labels of the steps of a protocol that are evaluated."""


@dataclass(frozen=True)
class TargetResults:
    """Targets and the outputs reached.

    Attributes
    ----------
    targets, outputs : ndarray, shape (N,)
        Each target, and the mean of the readings after the controller had finished.
    seconds : ndarray, shape (N,)
        Laboratory time of the controller for each, s.
    """

    targets: Floats
    outputs: Floats
    seconds: Floats

    def summary(self) -> dict[str, float]:
        """Return `max`, `rms`, `median` of the absolute error in output units, and `seconds_per_target`."""
        error = self.outputs - self.targets
        median, seconds = float(np.median(np.abs(error))), float(self.seconds.mean())
        return {**_greatest_and_rms(error), "median": median, "seconds_per_target": seconds}


@dataclass(frozen=True)
class FollowingResult:
    """A moving reference and the output that followed it.

    Attributes
    ----------
    times : ndarray, shape (N,)
        Laboratory time, s, from the first sample.
    reference, output : ndarray, shape (N,)
        Output units.
    """

    times: Floats
    reference: Floats
    output: Floats

    def summary(self) -> dict[str, float]:
        """Return `max` and `rms` of the error, output units."""
        return _greatest_and_rms(self.output - self.reference)


def target_results(record: Record, output: str) -> TargetResults | None:
    """Return the targets of a run and the outputs reached, or None if it had none.

    Parameters
    ----------
    record : Record
        The run; its protocol marks the steps that reach a target and the readings after it.
    output : str
        The controlled signal.
    """
    names = [signal.name for signal in record.signals]
    found: list[tuple[float, float, list[float]]] = []
    for step in record.step_records():
        values = dict(zip(names, step.values, strict=True))
        if step.label == REACH and "reference" in values:
            found.append((values["reference"], step.finished - step.started, []))
        elif step.label == READING and found:
            found[-1][2].append(values[output])
    complete = [(target, float(np.mean(readings)), seconds) for target, seconds, readings in found if readings]
    return TargetResults(*np.array(complete).T.copy()) if complete else None


def following_result(record: Record, output: str) -> FollowingResult | None:
    """Return a moving reference and its output, or None if there was none; arguments as `target_results`."""
    ticks = record.telemetry()
    if "reference" not in ticks.columns:
        return None
    parts = [ticks.ticks_of(step) for step in record.step_records() if step.label == FOLLOW]
    columns = [np.concatenate([part[name] for part in parts]) for name in ("t", "reference", output)] if parts else []
    if not parts or not (rows := np.isfinite(columns[1])).any():
        return None
    times, reference, outputs = (column[rows] for column in columns)
    return FollowingResult(times - times[0], reference, outputs)


def results_json(record: Record, output: str) -> Mapping[str, Any]:
    """Return the summaries of both, as far as the run has them, for programs."""
    results: dict[str, Any] = {}
    if (reached := target_results(record, output)) is not None:
        results["tracking"] = reached.summary()
    if (followed := following_result(record, output)) is not None:
        results["following"] = followed.summary()
    return results


def _greatest_and_rms(error: Floats) -> dict[str, float]:
    return {"max": float(np.abs(error).max()), "rms": float(np.sqrt(np.mean(error**2)))}
