"""Records on which the model that `bench identify` chooses is compared with the best of all candidates it tried.

Each is of one kind, from a plant of its own structure, with noise of 1 % of the range. Errors are those on five
other sequences of random reversals, without noise, in % of the range: one sequence suits some models by chance, and
the best would be one of these. Somebody could choose that best who knew the errors: no choice from the record alone
can always reach it.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.identification import Candidate, Measurements, compared_models, identify, identify_in_time, select

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))

from hysteretic_plants import PLANTS, butterfly, damped, random_reversals, settled, through

Floats = NDArray[np.float64]

KINDS = (
    "damped", "mixed", "falling", "virgin", "positive start", "minor loops", "drift", "missing", "60 samples",
    "20 and 100 Hz", "100 Hz after 20 Hz", "major loop",
)  # fmt: skip
CASES = [*product(PLANTS, KINDS), *product(("butterfly",), ("mixed", "drift"))]
ROWS, SEQUENCES = 1500, 5
MEASURED = (
    "another session", "another session, not re-zeroed", "negated", "first 60 rows", "another session, without time"
)  # fmt: skip
"""Kinds of cases of measured sessions; re-zeroed but for one, as the zero of a sensor moves between sessions."""


@dataclass(frozen=True)
class Case:
    """A record, and other sequences with their true outputs, shape (S, M)."""

    inputs: Floats
    outputs: Floats
    others: Floats
    truth: Floats
    continues: bool = False
    rezeroed: bool = False
    times: Floats | None = None
    """Of the rows, s, for models with time."""
    other_times: Floats | None = None
    """Of the rows of each other sequence, s."""

    def error(self, one: Candidate) -> float:
        """Return the error of a candidate on the other sequences, % of the range."""
        name, options = one.fitted
        settings: dict[str, Any] = {"initial": one.initial, "smoothing": one.smoothing, "ridge": one.ridge, **options}
        if one.orientation != "auto":
            settings["orientation"] = one.orientation
        if one.dynamics:
            assert self.times is not None
            assert self.other_times is not None
            settings = {key: value for key, value in settings.items() if value}
            timed = identify_in_time(name, self.times, self.inputs, self.outputs, **settings).model
            return self._error([timed.evaluate(self.other_times, each) for each in self.others])
        found = identify(name, self.inputs, self.outputs, **settings)
        state = found.model.advance(found.initial_state, self.inputs) if self.continues else None
        return self._error([found.model.evaluate(each, state) for each in self.others])

    def _error(self, predicted: list[Floats]) -> float:
        found = []
        for inputs, outputs, expected in zip(self.others, self.truth, predicted, strict=True):
            # What came before another sequence is unknown, until it has overwritten it.
            known = 0 if self.continues else Measurements.of(inputs, outputs).known
            errors = (outputs - expected)[known:]
            found.append(np.mean((errors - errors.mean() if self.rezeroed else errors) ** 2))
        return float(100.0 * np.sqrt(np.mean(found)) / np.ptp(self.truth))


def case(kind: str, plant_name: str, seed: int) -> Case:
    """Return a record of one kind from one plant."""
    rng = np.random.default_rng(seed)
    raw = butterfly if plant_name == "butterfly" else PLANTS[plant_name]
    plant = partial(settled, raw)
    more = [np.random.default_rng([seed, each]) for each in range(1, SEQUENCES)]
    others = np.array([random_reversals(each, ROWS, 60) for each in (rng, *more)])
    mixed = random_reversals(rng, ROWS, 40)

    def respond(sequences: Floats) -> Floats:
        return np.array([plant(each) for each in sequences])

    def noisy(outputs: Floats) -> Floats:
        return outputs + 0.01 * np.ptp(outputs) * rng.standard_normal(outputs.size)

    usual = Case(mixed, noisy(plant(mixed)), others, respond(others))
    if kind == "damped":
        return replace(usual, inputs=damped(ROWS, 30), outputs=noisy(plant(damped(ROWS, 30))))
    if kind == "falling":
        return replace(usual, outputs=-usual.outputs, truth=-usual.truth)
    if kind == "virgin":
        return replace(usual, outputs=noisy(raw(mixed)))
    if kind == "positive start":
        return replace(usual, inputs=-mixed, outputs=noisy(plant(np.append(1.0, -mixed))[1:]))
    if kind == "minor loops":
        first, *loops = (through([0.0, *each.uniform(-0.5, 0.5, 50)], ROWS) for each in (rng, rng, *more))
        whole = respond(np.array([[1.0, *first, *each] for each in loops]))[:, 1:]
        return Case(first, noisy(whole[0, :ROWS]), np.array(loops), whole[:, ROWS:], continues=True)
    rows = np.arange(ROWS, dtype=np.float64)
    if kind == "drift":
        drift = 0.05 * np.ptp(usual.truth) * np.linspace(0.0, 1.0, ROWS)
        truth = usual.truth + drift
        times = 0.01 * rows
        return replace(
            usual, outputs=usual.outputs + drift, truth=truth, rezeroed=True, times=times, other_times=times
        )
    if "100 Hz" in kind:
        # 40 moves take 1 s at 20 Hz. Of both rates, the second half of the rows is the faster one.
        slow, fast = rows / ROWS, rows / (5.0 * ROWS)
        both = np.append(slow[: ROWS // 2], slow[ROWS // 2] + fast[: ROWS - ROWS // 2])
        times, other_times = (both, both) if kind == "20 and 100 Hz" else (slow, fast)
        outputs = lagged(times, plant(mixed))
        truth = np.array([lagged(other_times, each) for each in respond(others)])
        return Case(mixed, noisy(outputs), others, truth, times=times, other_times=other_times)
    if kind == "major loop":
        ends = through([0.0, *[1.0, -1.0] * 10], ROWS)
        return replace(usual, inputs=ends, outputs=noisy(plant(ends)))
    if kind == "missing":
        kept = np.sort(rng.permutation(ROWS)[: ROWS * 4 // 5])
        return replace(usual, inputs=mixed[kept], outputs=usual.outputs[kept])
    if kind == "60 samples":
        few = random_reversals(rng, 60, 8)
        return replace(usual, inputs=few, outputs=noisy(plant(few)))
    return usual


def measured_case(folder: Path, kind: str) -> Case:
    """Return a case of two measured sessions: identification.csv and validation.csv with time, input and output."""
    first, second = (
        np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("identification", "validation")
    )
    usual = Case(
        first[:, 1], first[:, 2], second[None, :, 1], second[None, :, 2], rezeroed="not re-zeroed" not in kind
    )
    if "first 60 rows" in kind:
        # Of so few rows no times are taken.
        return replace(usual, inputs=usual.inputs[:60], outputs=usual.outputs[:60])
    if "without time" not in kind:
        usual = replace(usual, times=first[:, 0], other_times=second[:, 0])
    return replace(usual, outputs=-usual.outputs, truth=-usual.truth) if "negated" in kind else usual


def lagged(times: Floats, outputs: Floats, time_constant: float = 1e-3) -> Floats:
    """Return the response of a first-order lag that is settled at first, to straight lines between the samples."""
    steps, found = np.diff(times), outputs.copy()
    slopes = np.diff(outputs) / steps
    for n, (step, slope) in enumerate(zip(steps, slopes, strict=True)):
        # The lag follows a ramp at a distance of its slope times the time constant.
        behind = slope * time_constant
        found[n + 1] = outputs[n + 1] - behind + (found[n] - outputs[n] + behind) * np.exp(-step / time_constant)
    return found


@dataclass(frozen=True)
class Outcome:
    """What was chosen for a case, beside the best of what was tried; errors in % of the range."""

    chosen: str
    error: float
    best: str
    least: float
    simple: float
    """Error of a cubic with three plays."""
    advice: tuple[str, ...]
    """Codes of the advice."""
    seconds: float
    """CPU time of the choice."""

    @property
    def ratio(self) -> float:
        """Error of the choice by that of the best."""
        return self.error / self.least


def choose(one: Case) -> Outcome:
    """Choose a model for a case, and find the best of all candidates that were tried."""
    measured = Measurements.of(one.inputs, one.outputs, times=one.times)
    begin = time.process_time()
    found = select(measured, compared_models())
    seconds = time.process_time() - begin
    tried = [found.chosen.candidate, *(score.candidate for score in found.scores if not score.failure)]
    errors = [one.error(candidate) for candidate in tried]
    least = int(np.argmin(errors))
    simple = one.error(Candidate("polynomial-plays", {"degree": 3, "plays": 3}))
    codes = tuple(advice.code for advice in found.advice)
    return Outcome(describe(tried[0]), errors[0], describe(tried[least]), errors[least], simple, codes, seconds)


def describe(one: Candidate) -> str:
    """Return a model with its settings in a line."""
    settings = [f"{name} {value}" for name, value in one.options.items()]
    settings += [f"with {one.dynamics}"] if one.dynamics else []
    settings += [f"start {one.initial}"] if one.initial else []
    settings += [f"smooth {one.smoothing:g}"] if one.smoothing else []
    settings += [f"ridge {one.ridge:g}"] if one.ridge else []
    return ", ".join([one.model, *settings])
