"""Tracking to the sensor's noise: the input turns back at the target, so that the hysteresis holds the output."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from bench.control.estimators import DisturbanceEstimator
from bench.control.model_filters import INPUT_ERROR
from bench.control.tracking import (
    TO_REST,
    Arrival,
    Correcting,
    CorrectionParameters,
    Move,
    Sample,
    Script,
    check_positive,
)
from bench.control.tuning import Spans
from bench.models import MemoryCurve, Preisach, PreisachInverse

Direction = Literal[-1, 1]

_UNLOCKED = 3
"""Targets in a row at which no lock held, after which it is not to be expected.

Derivation: each of them was approached `tries` times from either side; one may lie where no lock holds.
"""
_RARE = 3.0
"""Standard deviations beyond which an error of the input is not expected: one in 370, if it is normal.

Source: the three-sigma rule (ISO 7870-2, control charts).
"""


@dataclass(frozen=True)
class LatchParameters:
    """The numbers of actuator, specimen and sensor from which all others of the latched controller follow.

    Each of these can stand in the rig file; what is not there comes from the model.
    """

    wander: float
    """Standard deviation by which the specimen's input differs unseen from the measured one, input units."""
    noise: float
    """Standard deviation of one reading of the output, output units."""
    steepest: float
    """Greatest slope of the output on a branch, output units per input unit."""
    locked_slope: float
    """Mean slope of the output behind a reversal, output units per input unit; not 0."""
    farthest: float
    """Greatest distance behind the extreme that the fine loop may go, input units: farther, hysterons switch back,
    the slope of the output changes its sign, and the loop would run away. By the model half of the width of a cell:
    so a quarter of the hysterons of one switch back, and of narrower ones the plane says nothing. On a plane of many
    levels it is twice the least distance, which leaves a stretch to the loop."""
    rest: float
    """Time in which actuator and specimen come to rest, s."""
    tries: int = 10
    """Greatest number of approaches, each from the other side, before falling back."""
    fine_moves: int = 5
    """Number of moves of the fine loop."""

    def __post_init__(self) -> None:
        check_positive(self, "wander", "noise", "steepest", "farthest", "rest", "tries", "fine_moves")
        if not math.isfinite(self.locked_slope) or self.locked_slope == 0.0:
            raise ValueError(f"locked_slope: expected a number other than 0, got {self.locked_slope}")
        if not self.nearest < self.farthest:
            raise ValueError(
                f"farthest: expected more than {_RARE:g} times wander, {self.nearest:g}, got {self.farthest}"
            )

    @classmethod
    def of(cls, operator: Preisach, rest: float, noise: float | None = None) -> LatchParameters:
        """Return those of a model and an actuator that comes to rest within `rest` (s).

        Without a known `noise` (output units) it is that of the closed loop (`CorrectionParameters`).
        """
        spans = Spans.of(operator)
        if noise is None:
            noise = math.sqrt(CorrectionParameters.scaled(spans).reading_variance)
        low, high = operator.input_range
        values = np.linspace(low, high, 50 * operator.order)
        branch = operator.evaluate(np.concatenate([values, values[::-1]]), operator.saturated_state(-1, low))
        steepest = float(np.abs(np.diff(branch)).max() / (values[1] - values[0]))
        locked = float(np.mean([reversible_slope(operator, value) for value in values.tolist()]))
        cell = float(np.diff(operator.levels).min())
        wander = INPUT_ERROR * spans.input
        return cls(wander, noise, steepest, locked, max(0.5 * cell, 2.0 * _RARE * wander), rest)

    @property
    def lag(self) -> float:
        """Time constant of actuator and specimen, s; also the time between two moves of the fine loop."""
        return self.rest / TO_REST

    @property
    def nearest(self) -> float:
        """Least distance behind the extreme, input units: nearer, a wander of three σ would move the extreme."""
        return _RARE * self.wander

    @property
    def step_back(self) -> float:
        """Move back from the extreme, input units: into the middle of where the lock holds."""
        return 0.5 * (self.nearest + self.farthest)

    @property
    def approach(self) -> float:
        """How far before the target the approach by the model ends, output units: what three σ of wander make of it.

        An approach that is as far off again, at twice that, is over too.
        """
        return self.steepest * self.nearest

    @property
    def creep_gain(self) -> float:
        """Creep per output unit of the error that is left, input units per second and output unit.

        The creep is an integrator behind a lag τ: with a gain of 1 / (2 τ slope) it is damped by 1/√2.
        """
        return 0.5 / (self.lag * self.steepest)

    @property
    def reserve(self) -> float:
        """What the fine loop can bring back from the middle of where the lock holds, output units."""
        return abs(self.locked_slope) * (self.farthest - self.step_back)

    @property
    def creep_offset(self) -> float:
        """Error at which the creep is slowest, output units: what stepping back takes away."""
        return -self.locked_slope * self.step_back

    @property
    def creep_until(self) -> float:
        """Error at which the creep ends, output units: in the middle of what is left once the actuator stands."""
        return self.creep_offset + 0.5 * self.reserve

    @property
    def creep_least(self) -> float:
        """Slowest creep, input units per second: at the steepest slope it moves on by the reserve, one lag long."""
        return self.reserve / (self.steepest * self.lag)

    @property
    def creep_most(self) -> float:
        """Fastest creep, input units per second: it moves on by an approach, one lag long."""
        return self.approach / (self.steepest * self.lag)


class Latched(Correcting):
    """The closed-loop inverse, and then a lock: accurate to the sensor's noise where others wander.

    On a branch where hysterons switch, an unseen wander of the input moves the output by the branch's steep
    slope (280 (1/m)/K for the film of Zhang et al. 2013). Just behind a reversal nothing switches: the output has
    the small slope of the reversible part alone, and holds. So the controller

    1. approaches the target from one side, by the model, to a little before it;
    2. creeps on until little is left;
    3. steps back. If the error is small it is locked, otherwise it approaches from the other side;
    4. corrects by the small slope, never leaving the stretch behind the extreme where that holds.

    After too many tries, and near saturation, it is the incremental inverse of `ClosedLoopInverse`.

    Parameters
    ----------
    inverse : Inverse
        Exact inverse of the identified model, which must have a reversible part: its slope is what a
        locked actuator answers with.
    parameters : LatchParameters
        Numbers of the lock.
    state, limits
        As in `OpenLoopInverse`.
    correction : CorrectionParameters
        Numbers of the incremental inverse, where that is used.

    Raises ValueError if the model has no reversible part.
    """

    @staticmethod
    def correction(spans: Spans) -> CorrectionParameters:
        """Return the default numbers of the incremental inverse: more corrections, and closer, than alone."""
        return replace(CorrectionParameters.scaled(spans), corrections=9, close_enough=1e-3 * spans.output)

    def __init__(
        self,
        inverse: PreisachInverse,
        parameters: LatchParameters,
        state: MemoryCurve | None = None,
        limits: tuple[float, float] | None = None,
        correction: CorrectionParameters | None = None,
    ) -> None:
        if inverse.operator.reversible is None:
            raise ValueError("inverse: expected a model with a reversible part, by which a locked output is moved")
        super().__init__(inverse, state, limits, correction or Latched.correction(Spans.of(inverse.operator)))
        self._parameters = parameters
        # As near to the set-point as the wander lets it come, for two readings, or as long as it takes to rest twice.
        self._arrival = Arrival(
            parameters.nearest, hold=2.0 * self._poll, poll=self._poll, patience=2.0 * parameters.rest
        )
        self._saturated = sorted(inverse.operator.evaluate(inverse.operator.levels[[0, -1]]).tolist())
        self._preisach = inverse
        self.extreme: float | None = None
        """The input behind which the output is locked, input units; None while it is not."""
        self._direction: Direction
        self.tries = 0
        """Number of approaches to the present target."""
        self._unlocked = 0
        self.locked = False
        """Whether the present target is held by the lock."""

    @property
    def doubt(self) -> str:
        """Why it does not do what it should on this specimen; empty if it does."""
        if self._unlocked < _UNLOCKED:
            return ""
        return (
            f"its lock held at none of the last {self._unlocked} targets after {self._parameters.tries} approaches "
            "each, as behind a reversal the specimen does not move as its model says"
        )

    def _observe(self, t: float, measured_input: float) -> bool:
        known = super()._observe(t, measured_input)
        if known and self.extreme is not None:
            # A plate that runs on takes the extreme with it.
            self.extreme = max(self._direction * self.extreme, self._direction * measured_input) * self._direction
        return known

    def _run(self, target: float, reading: Sample) -> Script:
        p = self._parameters
        self.extreme, self.locked, self.tries = None, False, 0
        low, high = self._saturated
        margin = abs(p.creep_offset) + p.reserve
        if low + margin <= target <= high - margin:
            self._direction = 1 if target > reading.output else -1
            while self.tries < p.tries:
                self.tries += 1
                reading = yield from self._latch(target, reading)
                if self.locked:
                    break
                self.extreme = None
                self._direction = 1 if self._direction < 0 else -1
            self._unlocked = 0 if self.locked else self._unlocked + 1
        if not self.locked:
            yield from self._correct(target)
        yield from self._hold(self._poll)

    def _latch(self, target: float, reading: Sample) -> Move:
        """Try to lock from one side."""
        p = self._parameters
        direction = self._direction

        def left(reading: Sample) -> float:
            """Return the part of the way that is left, output units; negative beyond the target."""
            return direction * (target - reading.output)

        for _ in range(self._correction.corrections):
            if left(reading) <= 2.0 * p.approach:
                break
            setpoint = self._ahead(target - direction * p.approach - self._estimator.value)
            if setpoint is None:
                break
            reading = yield from self._arrive(setpoint, self._arrival)
            self._estimator.update(reading.output - self._modelled())

        # So long the slowest creep takes for what is left of an approach.
        for _ in range(round(p.approach / (p.steepest * p.creep_least) / self._poll)):
            if left(reading) <= p.creep_until:
                break
            rate = min(max(p.creep_gain * (left(reading) - p.creep_offset), p.creep_least), p.creep_most)
            # The model may have the target further ahead, as after a turn: it is half way there in half of the rest.
            # Or nowhere, as near saturation, where the output is more than the model's: the readings lead there.
            ahead = self._ahead(self._modelled() + direction * left(reading))
            if ahead is not None:
                rate = max(rate, 2.0 * abs(ahead - reading.input) / p.rest)
            reading = yield self._command(self._setpoint + direction * rate * self._poll, self._poll)
        if abs(left(reading) - p.creep_offset) > 2.0 * p.reserve:
            return reading

        self.extreme = reading.input
        return (yield from self._fine_loop(target))

    def _fine_loop(self, target: float) -> Move:
        """Step back and move the locked output to the target."""
        p = self._parameters
        assert self.extreme is not None
        # Between two readings the locked output moves by what the input wanders unseen.
        locked = DisturbanceEstimator(walk_variance=(p.locked_slope * p.wander) ** 2, reading_variance=p.noise**2)
        origin = setpoint = self._behind(self.extreme - self._direction * p.step_back)
        slope = reversible_slope(self._preisach.operator, origin)
        for move in range(p.fine_moves + 1):
            for _ in range(max(1, round(p.lag / self._poll))):
                reading = yield self._command(setpoint, self._poll)
                # Its output by the slope, had it been at `origin`: no need to wait for the input to settle.
                locked.update(reading.output - slope * (reading.input - origin))
                setpoint = self._behind(setpoint)
            error = target - locked.value - slope * (setpoint - origin)
            if abs(error) > 2.0 * p.reserve or slope == 0.0:
                return reading
            if move < p.fine_moves:
                setpoint = self._behind(setpoint + error / slope)
        # The lock is lost when the error exceeds the uncertainty of the estimate.
        self.locked = abs(error) <= _RARE * locked.uncertainty
        return reading

    def _behind(self, setpoint: float) -> float:
        """Return the set-point moved into the stretch behind the extreme where the output is locked."""
        assert self.extreme is not None
        distance = self._direction * (self.extreme - setpoint)
        distance = min(max(distance, self._parameters.nearest), self._parameters.farthest)
        return self._clip(self.extreme - self._direction * distance)

    def _ahead(self, target: float) -> float | None:
        """Return the input of the model's output `target` in the present direction, None beyond the limits."""
        found = self._preisach.first_input(self.state, target, self._direction)
        return found if found is not None and self._low < found < self._high else None


def reversible_slope(operator: Preisach, value: float) -> float:
    """Return the slope of the output behind a reversal, where no hysteron switches; 0 without reversible part."""
    if operator.reversible is None:
        return 0.0
    breaks, quadratics = operator.reversible.pieces()
    _, linear, quadratic = quadratics[int((breaks < value).sum())].tolist()
    return float(linear + 2.0 * quadratic * value)
