"""Errors of a run that reached targets, or followed a reference or held it in a fast loop, from its journal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.base import Floats
from bench.protocol import LATENESS
from bench.record import Record, Table

REACH = "reach"
READING = "reading"
FOLLOW = "follow"
"""Labels of the steps of a protocol that are evaluated."""
WITNESS = "witness"
"""Slot of a sensor beside the loop, which sees what is controlled as it is."""
_HELD = 0.5
"""Part of its longest rest for which a reference has rested where it counts as held."""


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


@dataclass(frozen=True)
class LoopResult:
    """The reference of a loop at a fixed rate, and the output."""

    # Shape (N,); at each recorded sample, output units.
    reference: Floats
    output: Floats

    def summary(self) -> dict[str, float]:
        """Return greatest and RMS error where the reference is held and where it moves, as far as it does so.

        Held is where it has rested for half of its longest rest, but for the one before it first moves.
        """
        moves = np.append(False, np.diff(self.reference) != 0.0)
        rested = np.arange(moves.size) - np.maximum.accumulate(np.where(moves, np.arange(moves.size), 0))
        if moves.any():
            rested[: int(moves.argmax())] = 0
        held = rested > _HELD * rested.max()
        # A step moves at a single sample.
        moving = moves & np.append(False, moves[:-1])
        error = self.output - self.reference
        return {
            f"{name}_{key}": value
            for name, chosen in (("hold", held), ("move", moving))
            if chosen.any()
            for key, value in _greatest_and_rms(error[chosen]).items()
        }


def target_results(record: Record, output: str) -> TargetResults | None:
    """Return the targets of a run and the outputs reached, or None if it had none.

    Parameters
    ----------
    record : Record
        The run; its protocol marks the steps that reach a target and the readings after it.
    output : str
        The controlled signal.
    """
    column = [signal.name for signal in record.signals].index(output)
    found = targets_visited(record)
    complete = [(target, float(np.mean(readings[:, column])), seconds) for target, seconds, readings in found]
    return TargetResults(*np.array(complete).T.copy()) if complete else None


def targets_visited(record: Record) -> list[tuple[float, float, Floats]]:
    """Return the targets of a run: target, time of the controller in s, and readings, shape (n, signals), of each."""
    names = [signal.name for signal in record.signals]
    found: list[tuple[float, float, list[Sequence[float]]]] = []
    for step in record.step_records():
        if step.label == REACH and "reference" in names:
            found.append((step.values[names.index("reference")], step.finished - step.started, []))
        elif step.label == READING and found:
            found[-1][2].append(step.values)
    return [(target, seconds, np.array(readings)) for target, seconds, readings in found if readings]


def following_result(record: Record, output: str) -> FollowingResult | None:
    """Return a moving reference and its output, or None if there was none; arguments as `target_results`."""
    ticks = ticks_with(record, "reference", ("t", "step", output))
    if ticks is None:
        return None
    parts = [ticks.ticks_of(step) for step in record.step_records() if step.label == FOLLOW]
    columns = [np.concatenate([part[name] for part in parts]) for name in ("t", "reference", output)] if parts else []
    if not parts or not columns[0].size:
        return None
    times, reference, outputs = columns
    return FollowingResult(times - times[0], reference, outputs)


def loop_results(record: Record, output: str) -> dict[str, LoopResult]:
    """Return by signals the results of a loop at a fixed rate: of the controlled one, and of a witness beside it.

    It is empty if the run had no such loop with a reference.
    """
    witness = record.meta.get("slots", {}).get(WITNESS, {}).get("signal", "")
    ticks = ticks_with(record, "reference", (LATENESS.name, output, witness))
    if ticks is None or LATENESS.name not in ticks.columns:
        return {}
    rows = np.isfinite(ticks[LATENESS.name])
    reference = ticks["reference"][rows]
    signals = [name for name in (output, witness) if name in ticks.columns and np.isfinite(ticks[name][rows]).all()]
    return {name: LoopResult(reference, ticks[name][rows]) for name in signals} if rows.any() else {}


def ticks_with(record: Record, signal: str, others: Sequence[str] = ()) -> Table | None:
    """Return the ticks at which a signal has a finite value: the columns of it and of others, those that there are.

    None if the record has no such signal. What is kept of a long run are these columns of these ticks only.
    """
    columns = ("t", "step", *(each.name for each in record.signals))
    names = [name for name in dict.fromkeys((signal, *others)) if name in columns]
    if signal not in columns:
        return None
    parts: dict[str, list[Floats]] = {name: [np.empty(0)] for name in names}
    for ticks in record.ticks():
        if (rows := np.isfinite(ticks[signal])).any():
            for name, several in parts.items():
                several.append(ticks[name][rows])
    units = {name: record.unit(name) for name in names}
    return Table({name: np.concatenate(parts.pop(name)) for name in names}, units)


def results_json(record: Record) -> dict[str, dict[str, float]]:
    """Return the summaries of these, as far as the run has them, for programs; those of a witness by `true_`."""
    output, results = record.controlled, dict[str, dict[str, float]]()
    if not output:
        return results
    if (reached := target_results(record, output)) is not None:
        results["tracking"] = reached.summary()
    if (followed := following_result(record, output)) is not None:
        results["following"] = followed.summary()
    for signal, loop in loop_results(record, output).items():
        prefix = "" if signal == output else "true_"
        results["loop"] = results.get("loop", {}) | {f"{prefix}{key}": v for key, v in loop.summary().items()}
    return results


def _greatest_and_rms(error: Floats) -> dict[str, float]:
    return {"max": float(np.abs(error).max()), "rms": float(np.sqrt(np.mean(error**2)))}
