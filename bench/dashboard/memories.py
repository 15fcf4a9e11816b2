"""The memory curves on the planes: driven by a signal, or by what only a model knows of the readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

from bench.dashboard.entries import ModelDensity
from bench.devices import Signal
from bench.models import Coupled, MemoryCurve
from bench.rig import SETPOINT


class SignalMemory:
    """The memory curve of a signal, in a column of the values."""

    def __init__(self, column: int) -> None:
        self.columns = [column]
        self.curve: MemoryCurve | None = None
        """None before the first reading."""

    def see(self, x: float) -> None:
        """Let the signal move the memory."""
        if math.isfinite(x):
            self.curve = self.curve.step(x) if self.curve else MemoryCurve.from_negative_saturation(x)


class StageMemory:
    """The memory curve of the second stage of a model, whose input is no signal: the model follows the readings.

    The model, of voltage and force, starts as after a reset.
    """

    def __init__(self, model: Coupled[Any], columns: tuple[int, int]) -> None:
        self._model, self.columns = model, list(columns)
        self._state: Any = model.initial_state()
        self.curve: MemoryCurve | None = None
        """None before the first reading, and for operators without one."""

    def see(self, voltage: float, force: float) -> None:
        """Let the model follow a reading."""
        if math.isfinite(voltage) and math.isfinite(force):
            self._state, _ = self._model.step(self._state, voltage, force)
            second = getattr(self._state, "second", None)
            self.curve = second if isinstance(second, MemoryCurve) else None


def memory_of(model: ModelDensity, signals: Sequence[Signal], drive: int) -> SignalMemory | StageMemory | None:
    """Return what follows the memory on the plane of a density over another input; None if nothing can."""

    def column(unit: str) -> int | None:
        if signals[drive].unit == unit:
            return drive
        return next((i for i, s in enumerate(signals) if s.unit == unit and not s.name.endswith(SETPOINT)), None)

    if model.density.measured:
        found = column(model.density.unit)
        return None if found is None else SignalMemory(found)
    # A model of several stages has a force beside its voltage.
    if getattr(model.model, "force_unit", None) is not None:
        stages = cast("Coupled[Any]", model.model)
        voltage, force = column(stages.voltage_unit), column(stages.force_unit)
        if voltage is not None and force is not None:
            return StageMemory(stages, (voltage, force))
    return None
