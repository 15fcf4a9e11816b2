"""The faults of a sensor: what it sees is not what there is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from sim_devices.faults.fault import Fault, Quantity
from sim_devices.noise import normals
from sim_devices.world import World


class FaultySensor:
    """What a sensor sees of a quantity of the plant, in the unit of that quantity.

    Parameters
    ----------
    quantity : callable
        The quantity itself.
    unit : str
        Its unit.
    scale : float
        Size of a fault where none is chosen: twice that in a drift of an hour, a hundredth of it as noise.
    beyond : float
        Where it stands for a sensor that sees it out of range.
    seed : sequence of int
        Seed of the noise of a noisy sensor.

    Attributes
    ----------
    is_whole : bool
        Whether it sees the quantity as it is.

    Notes
    -----
    Without a fault it draws nothing, so that a run without faults is the same to the last digit.
    """

    def __init__(
        self,
        name: str,
        world: World,
        quantity: Callable[[], float],
        unit: str,
        *,
        scale: float,
        beyond: float,
        seed: Sequence[int],
    ) -> None:
        self._name = name
        self._world = world
        self._quantity = quantity
        self._unit = unit
        self._scale = scale
        self._beyond = beyond
        self._normals = normals(np.random.default_rng(seed))
        self.is_whole = True
        self._stuck = self._elsewhere = math.nan
        self._noise = self._slope = self._since = 0.0

    def __call__(self) -> float:
        """Return what the sensor sees at this instant, without its own noise."""
        return self._quantity() if self.is_whole else self._disturbed()

    def faults(self) -> dict[str, Fault]:
        """Return what can be wrong with it, by `NAME.FAULT`."""
        name, unit, scale = self._name, self._unit, self._scale
        size = 1e6 * abs(scale) + abs(self._beyond)
        noise = Quantity(0.01 * scale, unit, 0.0, size, "standard deviation in a conversion, beside its own noise")
        slope = Quantity(2.0 * scale / 3600.0, f"{unit}/s", -size, size, "drift")
        place = Quantity(self._beyond, unit, -size, size, "what it sees")
        return {
            f"{name}.{kind}": Fault(f"the sensor of {name} {summary}", begin, values, undo, lies=True)
            for kind, summary, begin, values, undo in (
                ("stuck", "stands still", self._stick, {}, self._come_loose),
                ("noisy", "is noisy", self._be_noisy, {"rms": noise}, partial(self._be_noisy, 0.0)),
                ("drifting", "drifts", self._drift, {"slope": slope}, partial(self._drift, 0.0)),
                ("out-of-range", "sees a value out of its range", self._leave, {"value": place}, self._return),
            )
        }

    def _disturbed(self) -> float:
        if not math.isnan(self._elsewhere):
            return self._elsewhere
        value = self._quantity() if math.isnan(self._stuck) else self._stuck
        value += self._slope * (self._world.time - self._since)
        return value + self._noise * next(self._normals) if self._noise else value

    def _look(self) -> None:
        self.is_whole = (
            math.isnan(self._stuck) and math.isnan(self._elsewhere) and not self._noise and not self._slope
        )

    def _stick(self) -> None:
        self._stuck = self()
        self._look()

    def _come_loose(self) -> None:
        self._stuck = math.nan
        self._look()

    def _be_noisy(self, rms: float) -> None:
        self._noise = rms
        self._look()

    def _drift(self, slope: float) -> None:
        self._slope, self._since = slope, self._world.time
        self._look()

    def _leave(self, value: float) -> None:
        self._elsewhere = value
        self._look()

    def _return(self) -> None:
        self._leave(math.nan)
