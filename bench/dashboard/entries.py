"""Entries of the dashboard: ticks, steps, events, densities and the end of a run, in their order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from bench.hysteresis import Density
from bench.hysteresis.documents import Model
from bench.journal import Event, StepRecord
from bench.model_file import ModelFile


class Tick(NamedTuple):
    """One tick of a hold: laboratory time in s, step number, one value a signal."""

    t: float
    step: int
    values: Sequence[float]


@dataclass(frozen=True)
class ModelDensity:
    """A density to draw, the name of its model, and the model."""

    name: str
    density: Density
    model: Model


def densities_of(models: Iterable[ModelFile]) -> list[ModelDensity]:
    """Return the densities of models, in their order; a model without a plane has none."""
    return [ModelDensity(file.name, density, file.model) for file in models for density in file.model.densities()]


@dataclass(frozen=True)
class End:
    """How a run ended: `completed`, `aborted` or `failed`, and why; how late its loops were (`bench.lateness`)."""

    status: str
    reason: str
    lateness: Mapping[str, Any] = field(default_factory=dict)


Entry: TypeAlias = Tick | StepRecord | Event | ModelDensity | End
