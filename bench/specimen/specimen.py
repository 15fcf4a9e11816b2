"""What the specimen of a twin does: set-points in, drive and response out, on a grid of time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base import DeferredModule, Floats
from bench.models import ActuatorDynamics, Operator, ResponseDynamics

if TYPE_CHECKING:
    from bench.models import actuator_kernels as _kernels
else:
    _kernels = DeferredModule("bench.models.kernels.actuator_kernels")


@dataclass(frozen=True)
class Wander:
    """A quantity that wanders with an exponential autocorrelation (Ornstein-Uhlenbeck).

    Attributes
    ----------
    deviation : float
        Standard deviation, in the unit of the quantity; 0 for none.
    time : float
        Correlation time, s.
    """

    deviation: float = 0.0
    time: float = 1.0


@dataclass(frozen=True)
class Unevenness:
    """What the model does not know of the specimen: a shift of the drive that changes as the drive moves.

    It is different in each session, as the error of a model is on a new history; it stands while the drive stands.

    Attributes
    ----------
    deviation : float
        Standard deviation, input units; 0 for none.
    length : float
        Travel of the drive after which it is forgotten, input units.
    """

    deviation: float = 0.0
    length: float = 1.0


@dataclass(frozen=True)
class Dynamics:
    """All that a specimen has beside its operators.

    Attributes
    ----------
    step : float
        Step of the time grid, s.
    actuator : ActuatorDynamics
        From the set-point to the drive.
    response : ResponseDynamics
        From the drive to the response.
    wander : Wander
        Of the drive as the specimen sees it, beside what is read of it, input units.
    drift : Wander
        Of the response, output units.
    unevenness : Unevenness
        Of the drive as the specimen sees it.
    """

    step: float
    actuator: ActuatorDynamics = field(default_factory=ActuatorDynamics)
    response: ResponseDynamics = field(default_factory=ResponseDynamics)
    wander: Wander = field(default_factory=Wander)
    drift: Wander = field(default_factory=Wander)
    unevenness: Unevenness = field(default_factory=Unevenness)


class Specimen:
    """A specimen and its actuator, at rest at the beginning.

    Parameters
    ----------
    operators : sequence of Operator
        Their outputs are added: the model, and what of its error repeats.
    dynamics : Dynamics
        The rest of it.
    start : float
        Drive at the beginning, input units.
    rng : numpy.random.Generator or None
        Its wander and drift; without one there is neither.
    """

    def __init__(
        self,
        operators: tuple[Operator[Any], ...],
        dynamics: Dynamics,
        start: float,
        rng: np.random.Generator | None = None,
    ) -> None:
        self._operators = operators
        self.dynamics = dynamics
        self._rng = rng
        actuator, response = dynamics.actuator, dynamics.response
        position = (start - actuator.offset) / actuator.gain
        wander = rng.standard_normal() * dynamics.wander.deviation if rng is not None else 0.0
        self._drift = rng.standard_normal() * dynamics.drift.deviation if rng is not None else 0.0
        place = rng.standard_normal() * dynamics.unevenness.deviation if rng is not None else 0.0
        gain = actuator.gain
        disturbed = position + wander / gain
        lagged = math.copysign(abs(disturbed) ** response.power, disturbed)
        self._state = np.array([position, 0.0, lagged, wander / gain, place / gain])
        seen = start + wander + place
        self._memories = [operator.step(operator.initial_state(), seen)[0] for operator in operators]
        output = sum(operator.value(memory) for operator, memory in zip(operators, self._memories, strict=True))
        self._slow = np.full(len(response.times), output)
        self._shares, self._times = np.array(response.shares), np.array(response.times)
        self.drive = start
        self.response = output * (response.gain + sum(response.shares)) + self._drift

    def advance(self, setpoints: Floats) -> tuple[Floats, Floats]:
        """Take as many steps of the grid as there are set-points, each in force during its step.

        Returns drive and response after each step, shape (N,).
        """
        dynamics, count = self.dynamics, setpoints.size
        actuator, response = dynamics.actuator, dynamics.response
        normals = np.zeros((3, count)) if self._rng is None else self._rng.standard_normal((count, 3)).T.copy()
        scale = 0.0 if self._rng is None else 1.0 / abs(actuator.gain)
        unevenness = dynamics.unevenness
        moved = np.empty((2, count))
        _kernels.follow(
            self._state, setpoints, normals[:2], moved, dynamics.step, actuator.frequency, actuator.damping,
            actuator.rate, response.lag, response.power, scale * dynamics.wander.deviation, dynamics.wander.time,
            scale * unevenness.deviation, unevenness.length / abs(actuator.gain),
        )  # fmt: skip
        moved *= actuator.gain
        moved += actuator.offset
        seen = moved[1]
        outputs = np.zeros((2, count))
        for number, operator in enumerate(self._operators):
            outputs[0] += operator.evaluate(seen, self._memories[number])
            self._memories[number] = operator.advance(self._memories[number], seen)
        outputs[1] = response.gain * outputs[0]
        if self._times.size:
            _kernels.creep(self._slow, outputs, dynamics.step, self._shares, self._times)
        if dynamics.drift.deviation and self._rng is not None:
            outputs[1] += self._drifts(normals[2])
        self.drive, self.response = float(moved[0, -1]), float(outputs[1, -1])
        return moved[0], outputs[1]

    def _drifts(self, normals: Floats) -> Floats:
        from scipy.signal import lfilter

        drift = self.dynamics.drift
        decay = math.exp(-self.dynamics.step / drift.time)
        kicks = drift.deviation * math.sqrt(1.0 - decay**2) * normals
        values, _ = lfilter([1.0], [1.0, -decay], kicks, zi=[decay * self._drift])
        self._drift = float(values[-1])
        return np.asarray(values)
