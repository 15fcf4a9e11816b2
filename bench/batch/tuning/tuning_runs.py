"""The runs behind the cost of a controller's numbers, on an emulated rig or a twin."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.analysis import TargetResults, target_results
from bench.base import BenchError, ConfigurationError
from bench.batch.campaign.execution import WorkersExecutor, carry_out_tasks
from bench.batch.campaign.tasks import Done, RunTask
from bench.batch.tuning.search import (
    GAIN_HIGH,
    MARGIN,
    TIME_WEIGHT,
    Numbers,
    TuningTrial,
    cost_of,
    get,
    perturbed_models,
    put,
)
from bench.control import controller_spec
from bench.identification import ModelFile
from bench.models import TwoStage
from bench.record import Record
from bench.rig import load_rig

if TYPE_CHECKING:
    from bench.base import Workers

_AS_IDENTIFIED = "as-identified"
_TARGETS = "target"
FORCE = "force"
"""Slot of a rig whose force is controlled."""
_WITHIN_REACH = 1.0 - 0.95 / MARGIN
"""Part of a model's range, of a gain greater by `MARGIN`, that the specimen does not reach, and a twentieth more."""


@dataclass(frozen=True)
class TuningTask:
    """What a controller is tuned for: its protocol, its name there, and the slot of the rig that it controls."""

    protocol: str
    controller: str
    slot: str

    @property
    def kind(self) -> str:
        """The task of the controller in `bench.controllers`."""
        return {"length-control": "coupled-length", "force-control": "coupled-force"}.get(self.protocol, _TARGETS)


def task_of(file: ModelFile, controller: str, protocol: str | None) -> TuningTask:
    """Return what a controller of a model is tuned for; by a protocol, if one is given.

    Raises ConfigurationError if the protocol has no such controllers.
    """
    offered = ("length-control", "force-control") if file.model.kind == TwoStage.kind else ("tracking",)
    chosen = protocol or offered[0]
    if chosen not in offered:
        raise ConfigurationError(f"--protocol {chosen}: a model {file.name} is controlled by {' or '.join(offered)}")
    return TuningTask(chosen, controller, FORCE if chosen == "force-control" else "response")


@dataclass
class TuningRuns:
    """Carries out trials of a controller's numbers."""

    task: TuningTask  # what is tuned
    rig: str  # the emulated rig, or a twin
    file: ModelFile  # the identified model
    folder: Path  # where the runs go
    workers: Workers  # who carries them out
    settings: Mapping[str, str]  # further parameters of the protocol
    seeds: int = 1  # sessions of each run
    first_seed: int = 0  # seed of the first session; the others follow
    # RMS error (output units) and seconds at a target by which the costs of each model are counted; those of the
    # first trial if not given, the greatest of them for all models from which the specimen differs.
    scales: Sequence[tuple[float, float]] = ()
    # Part of the RMS error of the first numbers that costs as much as their time, at least 0.
    time_weight: float = TIME_WEIGHT
    failures: list[str] = field(default_factory=list)
    _count: int = 0

    def __post_init__(self) -> None:
        role = load_rig(self.rig).roles.get(self.task.slot)
        if role is None:
            raise ConfigurationError(f"rig {self.rig} does not bind [roles.{self.task.slot}]")
        self._sessions = range(self.first_seed, self.first_seed + self.seeds)
        self._signal = role.signal or role.reading
        self._opened = controller_spec(self.task.kind, self.task.controller).own_error is not None
        self._models = {}
        others = perturbed_models(self.file, force=self.task.slot == FORCE)
        for name, model in {_AS_IDENTIFIED: self.file, **others}.items():
            self._models[name] = self.folder / f"{name}.json"
            model.save(self._models[name])

    def __call__(self, candidates: Sequence[Numbers]) -> list[TuningTrial]:
        """Return trials of some numbers; their runs go on beside each other.

        Raises BenchError if those of the first trial fail with the model as it is, AbortError if the operator ended a
        run.
        """
        numbered = list(enumerate(candidates, self._count + 1))
        self._count += len(candidates)
        tasks = {task.name: task for number, numbers in numbered for task in self._tasks(number, numbers)}
        done = carry_out_tasks(tasks, {}, WorkersExecutor(self.workers, self.folder))
        if crashed := next((each.reason for each in done.values() if each.status == "crashed"), ""):
            raise RuntimeError(crashed)
        return [self._trial(number, numbers, done) for number, numbers in numbered]

    def _tasks(self, number: int, numbers: Numbers) -> Iterator[RunTask]:
        """Yield the runs of a trial, of each model in each session."""
        tuning = json.dumps({self.task.controller: numbers})
        for seed, (name, path) in itertools.product(self._sessions, self._models.items()):
            settings = {"model": str(path), "controller": self.task.controller, "sequence_seed": str(seed + 1)}
            if name == GAIN_HIGH and self.task.kind != _TARGETS:
                # Targets are drawn from the range of the model.
                settings["margin"] = f"{_WITHIN_REACH:g}"
            if self._opened:
                # It goes on where the model of another specimen does not hold.
                settings["fallback"] = "open-loop"
            yield RunTask(
                name=_run_name(number, name, seed),
                table="",
                protocol=self.task.protocol,
                rig=self.rig,
                # The same noise and the same targets for all candidates.
                seed=2 * seed,
                parameters={**self.settings, **settings, "tuning": tuning},
            )

    def _trial(self, number: int, numbers: Numbers, done: Mapping[str, Done]) -> TuningTrial:
        scores = np.empty((len(self._models), self.seeds, 2))
        for i, seed in enumerate(self._sessions):
            names = [_run_name(number, name, seed) for name in self._models]
            nominal, *others = (self._reached(name, done[name]) for name in names)
            scores[:, i] = [_score(each, nominal) for each in (nominal, *others)]
        means = scores.mean(axis=1)
        rms, seconds = means[0].tolist()
        if not self.scales:
            if not math.isfinite(rms):
                raise BenchError(f"the controller fails with the numbers to begin with: {self.failures[0]}")
            # What fails with these numbers beside the model plays no part.
            good = means[1:][np.isfinite(means[1:, 0])] if np.isfinite(means[1:, 0]).any() else means[:1]
            self.scales = [(rms, seconds), *[tuple(good.max(axis=0).tolist())] * (len(means) - 1)]
        costs = [
            float(np.mean([cost_of(error, time, scale, self.time_weight) for error, time in of_model]))
            for of_model, scale in zip(scores.tolist(), self.scales, strict=True)
        ]
        return TuningTrial(numbers, 0.5 * (costs[0] + max(costs[1:])), rms, seconds, float(means[1:, 0].max()))

    def _reached(self, name: str, done: Done) -> TargetResults | None:
        """Return what a run has reached; None if it was not completed."""
        results = None
        if done.status == "completed":
            with Record(self.folder / name) as record:
                results = target_results(record, self._signal)
        if results is None:
            self.failures.append(f"{name}: {done.reason or 'has no targets'}")
        return results


def _run_name(number: int, model: str, seed: int) -> str:
    return f"{number:03}/{model}-seed={seed}"


def _score(results: TargetResults | None, nominal: TargetResults | None) -> tuple[float, float]:
    """Return RMS error and seconds a target of a run, over the targets within the range of the model as it is."""
    if results is None or nominal is None:
        return math.inf, math.nan
    low, high = float(nominal.targets.min()), float(nominal.targets.max())
    within = (results.targets >= low) & (results.targets <= high)
    rms = float(np.sqrt(np.mean((results.outputs - results.targets)[within] ** 2)))
    return rms, float(results.seconds[within].mean())


def start_of(table: Mapping[str, Any], numbers: Any, tunable: Sequence[str]) -> Numbers:  # noqa: ANN401 - a dataclass
    """Return the numbers from which the search begins: those of the rig file's table over those of the controller."""
    found: Numbers = dict(table)
    for name in (each for together in tunable for each in together.split("+")):
        default = attrgetter(name)(numbers)
        # What a rig file gives without decimals need not be a whole number.
        found = put(found, name, type(default)(get(found, name, default)))
    return found
