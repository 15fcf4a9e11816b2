"""What the specimen of a twin does: set-points in, drive and response out, on a grid of time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from bench.base import CheckedTable, DeferredModule, Floats
from bench.models import ActuatorDynamics, Operator, ResponseDynamics

if TYPE_CHECKING:
    from bench.models import actuator_kernels as _kernels
else:
    _kernels = DeferredModule("bench.models.kernels.actuator_kernels")


class Wander(CheckedTable):
    """Drive that wanders: a Gauss-Markov process of time (IEEE Std 952-1997, annex C). `[emulation.wander]`."""

    deviation: float = Field(default=0.0, ge=0, description="standard deviation, input units")
    time: float = Field(default=1.0, gt=0, description="correlation time, s")


class Unevenness(CheckedTable):
    """Error of the model on a new history, as a shift of the drive: a Gauss-Markov process of the way of the drive.

    It is other in each session, and stands while the drive stands. `[emulation.unevenness]`.
    """

    deviation: float = Field(default=0.0, ge=0, description="standard deviation, input units")
    length: float = Field(default=1.0, gt=0, description="way of the drive after which it is forgotten, input units")


@dataclass(frozen=True)
class Dynamics:
    """All that a specimen has beside its hysteresis."""

    step: float  # step of the time grid, s
    actuator: ActuatorDynamics = field(default_factory=ActuatorDynamics)  # from the set-point to the drive
    response: ResponseDynamics = field(default_factory=ResponseDynamics)  # from the drive to the response
    # Of the drive as the specimen sees it, beside what is read of it, input units.
    wander: Wander = field(default_factory=Wander)
    unevenness: Unevenness = field(default_factory=Unevenness)  # of the drive as the specimen sees it
    # Random walk of the response (rate random walk of IEEE Std 952-1997), output units per root of a second.
    drift: float = 0.0


class Specimen:
    """A specimen and its actuator, at rest at the beginning.

    Parameters
    ----------
    model : Operator
        Its hysteresis.
    dynamics : Dynamics
        The rest of it.
    start : float
        Drive at the beginning, input units.
    rng : numpy.random.Generator
        Its wander and drift.
    """

    def __init__(self, model: Operator[Any], dynamics: Dynamics, start: float, rng: np.random.Generator) -> None:
        self.dynamics = dynamics
        self._model, self._rng = model, rng
        actuator, response = dynamics.actuator, dynamics.response
        wander, place = (rng.standard_normal(2) * (dynamics.wander.deviation, dynamics.unevenness.deviation)).tolist()
        gain = actuator.gain
        position = (start - actuator.offset) / gain
        disturbed = position + wander / gain
        lagged = math.copysign(abs(disturbed) ** response.power, disturbed)
        self._state = np.array([position, 0.0, lagged, wander / gain, place / gain])
        self._memory, output = model.step(model.initial_state(), start + wander + place)
        self._slow = np.full(len(response.times), output)
        self._shares, self._times = np.array(response.shares), np.array(response.times)
        self._drift = 0.0
        self.drive = start
        self.response = output * (response.gain + sum(response.shares))

    def advance(self, setpoints: Floats) -> tuple[Floats, Floats]:
        """Take as many steps of the grid as there are set-points, each in force during its step.

        Returns drive and response after each step, shape (N,), in input and output units.
        """
        dynamics, count = self.dynamics, setpoints.size
        actuator, response, wander, uneven = (
            dynamics.actuator, dynamics.response, dynamics.wander, dynamics.unevenness
        )  # fmt: skip
        normals, gain = self._rng.standard_normal((count, 3)).T.copy(), abs(actuator.gain)
        moved = np.empty((2, count))
        _kernels.follow(
            self._state, setpoints, normals[:2], moved, dynamics.step, actuator.frequency, actuator.damping,
            actuator.rate, response.lag, response.power, wander.deviation / gain, wander.time,
            uneven.deviation / gain, uneven.length / gain,
        )  # fmt: skip
        moved *= actuator.gain
        moved += actuator.offset
        outputs = np.empty((2, count))
        outputs[0] = self._model.evaluate(moved[1], self._memory)
        self._memory = self._model.advance(self._memory, moved[1])
        outputs[1] = response.gain * outputs[0]
        if self._times.size:
            _kernels.creep(self._slow, outputs, dynamics.step, self._shares, self._times)
        drift = self._drift + dynamics.drift * math.sqrt(dynamics.step) * np.cumsum(normals[2])
        outputs[1] += drift
        self._drift = float(drift[-1])
        self.drive, self.response = float(moved[0, -1]), float(outputs[1, -1])
        return moved[0], outputs[1]
