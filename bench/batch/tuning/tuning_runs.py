"""The runs behind the cost of a controller's numbers, on an emulated rig or a twin."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.analysis import TargetResults
from bench.base import AbortError, BenchError, ConfigurationError
from bench.batch.study import RunSeries, reached_targets
from bench.batch.tuning.search import GAIN_HIGH, MARGIN, TIME_WEIGHT, Numbers, TuningTrial, cost_of, perturbed_models
from bench.control import controller_spec
from bench.identification import ModelFile
from bench.models import TwoStage
from bench.rig import load_rig

if TYPE_CHECKING:
    from bench.base import Pending, Workers
    from bench.execution import RunResult

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


class Scale(NamedTuple):
    """RMS error (output units) and seconds at a target by which costs are counted."""

    identified: tuple[float, float]  # with the model as it is
    others: tuple[float, float]  # the greatest with the models from which the specimen differs

    @classmethod
    def of(cls, identified: tuple[float, float], others: Sequence[tuple[float, float]]) -> Scale:
        """Return that of the first numbers; what fails with them beside the model plays no part."""
        good = [each for each in others if math.isfinite(each[0])] or [identified]
        return cls(identified, (max(rms for rms, _ in good), max(seconds for _, seconds in good)))


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
    scale: Scale | None = None  # by what the cost is counted; by the first trial if not given
    # Part of the RMS error of the first numbers that costs as much as their time, at least 0.
    time_weight: float = TIME_WEIGHT
    failures: list[str] = field(default_factory=list)
    _count: int = 0

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        role = load_rig(self.rig).roles.get(self.task.slot)
        if role is None:
            raise ConfigurationError(f"rig {self.rig} does not bind [roles.{self.task.slot}]")
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
        started = [(numbers, self._start(numbers)) for numbers in candidates]
        return [self._trial(numbers, runs) for numbers, runs in started]

    def _start(self, numbers: Numbers) -> dict[tuple[str, int], Pending[RunResult]]:
        self._count += 1
        tuning = json.dumps({self.task.controller: numbers})
        found = {}
        for seed in range(self.first_seed, self.first_seed + self.seeds):
            for name, path in self._models.items():
                # The same noise and the same targets for all candidates.
                campaign = RunSeries(
                    self.rig, self.folder / f"{self._count:03}" / name, seed, live=False, workers=self.workers
                )
                settings = {"model": str(path), "controller": self.task.controller, "sequence_seed": str(seed + 1)}
                if name == GAIN_HIGH and self.task.kind != _TARGETS:
                    # Targets are drawn from the range of the model.
                    settings["margin"] = f"{_WITHIN_REACH:g}"
                if self._opened:
                    # It goes on where the model of another specimen does not hold.
                    settings["fallback"] = "open-loop"
                found[name, seed] = campaign.start(
                    self.task.protocol, {**self.settings, **settings, "tuning": tuning}
                )
        return found

    def _trial(self, numbers: Numbers, runs: Mapping[tuple[str, int], Pending[RunResult]]) -> TuningTrial:
        reached: dict[tuple[str, int], TargetResults | None] = {}
        for key, run in runs.items():
            try:
                reached[key] = reached_targets(run.result(), self._signal)
            except AbortError:
                raise
            except BenchError as error:
                self.failures.append(f"{key[0]}, {dict(numbers)}: {error}")
                reached[key] = None
        scores: dict[str, list[tuple[float, float]]] = {}
        for (name, seed), results in reached.items():
            scores.setdefault(name, []).append(_score(results, reached[_AS_IDENTIFIED, seed]))
        means: dict[str, tuple[float, float]] = {
            name: tuple(np.mean(runs, axis=0).tolist()) for name, runs in scores.items()
        }
        rms, seconds = means.pop(_AS_IDENTIFIED)
        worst = max(each for each, _ in means.values())
        if self.scale is None:
            if not math.isfinite(rms):
                raise BenchError(f"the controller fails with the numbers to begin with: {self.failures[0]}")
            self.scale = Scale.of((rms, seconds), list(means.values()))
        scales = dict.fromkeys(means, self.scale.others) | {_AS_IDENTIFIED: self.scale.identified}
        costs = {
            name: float(np.mean([cost_of(*each, scales[name], self.time_weight) for each in runs]))
            for name, runs in scores.items()
        }
        cost = 0.5 * (costs.pop(_AS_IDENTIFIED) + max(costs.values()))
        return TuningTrial(numbers, cost, rms, seconds, worst)


def _score(results: TargetResults | None, nominal: TargetResults | None) -> tuple[float, float]:
    """Return RMS error and seconds a target of a run, over the targets within the range of the model as it is."""
    if results is None or nominal is None:
        return math.inf, math.nan
    low, high = float(nominal.targets.min()), float(nominal.targets.max())
    within = (results.targets >= low) & (results.targets <= high)
    rms = float(np.sqrt(np.mean((results.outputs - results.targets)[within] ** 2)))
    return rms, float(results.seconds[within].mean())


def start_of(task: TuningTask, rig: str, numbers: Any, tunable: Sequence[str]) -> Numbers:  # noqa: ANN401 - a dataclass
    """Return the numbers from which the search begins: those of the rig file over those of the controller."""
    table = dict((load_rig(rig).protocols.get(task.protocol) or {}).get("tuning", {}).get(task.controller, {}))
    found: dict[str, Any] = dict(table)
    for name in (each for together in tunable for each in together.split("+")):
        outer, _, inner = name.rpartition(".")
        default = getattr(getattr(numbers, outer) if outer else numbers, inner)
        within = dict(found.get(outer, {})) if outer else found
        # What a rig file gives without decimals need not be a whole number.
        within[inner] = type(default)(within.get(inner, default))
        if outer:
            found[outer] = within
    return found
