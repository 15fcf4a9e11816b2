"""How well a run reached its targets or followed its reference, from its journal."""

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
"""Labels by which a protocol marks the steps that count."""


@dataclass(frozen=True)
class TargetResults:
    """Targets and what came of them.

    Attributes
    ----------
    targets, outputs : ndarray, shape (N,)
        Each target, and the mean of the readings that were taken once the controller was done.
    seconds : ndarray, shape (N,)
        Laboratory time that the controller took for each, s.
    """

    targets: Floats
    outputs: Floats
    seconds: Floats

    def summary(self) -> dict[str, float]:
        """Return `max`, `rms`, `median` of the absolute error in output units, and `seconds_per_target`."""
        error = np.abs(self.outputs - self.targets)
        return {
            "max": float(error.max()),
            "rms": float(np.sqrt(np.mean(error**2))),
            "median": float(np.median(error)),
            "seconds_per_target": float(self.seconds.mean()),
        }


@dataclass(frozen=True)
class FollowingResult:
    """A reference that moved and what followed it.

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
        error = np.abs(self.output - self.reference)
        return {"max": float(error.max()), "rms": float(np.sqrt(np.mean(error**2)))}


def target_results(record: Record, output: str) -> TargetResults | None:
    """Return what came of a run's targets, or None if it had none.

    Parameters
    ----------
    record : Record
        The run; its protocol marks the steps that reach a target and the readings after it.
    output : str
        Signal that was controlled.
    """
    names = [signal.name for signal in record.signals]
    if "reference" not in names:
        return None
    targets: list[float] = []
    seconds: list[float] = []
    readings: list[list[float]] = []
    for step in record.step_records():
        values = dict(zip(names, step.values, strict=True))
        if step.label == REACH:
            targets.append(values["reference"])
            seconds.append(step.finished - step.started)
            readings.append([])
        elif step.label == READING and readings:
            readings[-1].append(values[output])
    complete = [i for i, values in enumerate(readings) if values]
    if not complete:
        return None
    return TargetResults(
        np.array([targets[i] for i in complete]),
        np.array([np.mean(readings[i]) for i in complete]),
        np.array([seconds[i] for i in complete]),
    )


def following_result(record: Record, output: str) -> FollowingResult | None:
    """Return how a run followed a moving reference, or None if it did not; arguments as `target_results`."""
    if "reference" not in [signal.name for signal in record.signals]:
        return None
    steps = [step.step for step in record.step_records() if step.label == FOLLOW]
    ticks = record.telemetry()
    rows = np.isin(ticks["step"], steps) & np.isfinite(ticks["reference"])
    if not rows.any():
        return None
    times = ticks["t"][rows]
    return FollowingResult(times - times[0], ticks["reference"][rows], ticks[output][rows])


def results_json(record: Record, output: str) -> Mapping[str, Any]:
    """Return what there is of both, for programs."""
    results: dict[str, Any] = {}
    if (reached := target_results(record, output)) is not None:
        results["tracking"] = reached.summary()
    if (followed := following_result(record, output)) is not None:
        results["following"] = followed.summary()
    return results
