"""Tracking to the sensor's noise: the input turns back at the target, so that the hysteresis holds the output."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from bench.control.estimators import DisturbanceEstimator
from bench.control.tracking import Arrival, Correcting, CorrectionParameters, Move, Sample, Script, check_positive
from bench.control.tuning import Spans
from bench.models import MemoryCurve, Preisach, PreisachInverse

Direction = Literal[-1, 1]

_UNLOCKED = 3
"""Targets in a row at which no lock held, after which it is not to be expected."""


@dataclass(frozen=True)
class LatchParameters:
    """Numbers of the latched controller."""

    approach: float
    """How far before the target, in output units, the approach by the model ends."""
    arrival: Arrival
    """When the actuator has arrived after a move of the approach."""
    creep_least: float
    creep_most: float
    """Slowest and fastest creep, input units per second."""
    creep_gain: float
    """Creep per output unit of the error that is left, input units per second and output unit."""
    creep_offset: float
    """Error at which the creep would be slowest, output units: what stepping back will take away."""
    creep_fast: float
    """Fastest creep towards a target that the model has further ahead, input units per second."""
    creep_until: float
    """Error at which the creep ends, output units: `creep_offset` and what the actuator still moves on."""
    step_back: float
    """Move back from the extreme, input units."""
    nearest: float
    farthest: float
    """Least and greatest distance behind the extreme that the fine loop may go, input units. Nearer, what the input
    wanders unseen would move the extreme; farther, hysterons switch back, the slope of the output changes its sign,
    and the loop would run away."""
    lock_within: float
    """Error after stepping back with which the fine loop can deal, output units."""
    accept: float
    """Error that may be left after the fine loop, output units; with more the lock has been lost."""
    walk_variance: float
    reading_variance: float
    """Variances of the estimate of the locked output, for each reading, output units squared: what the input wanders
    unseen, by the small slope; noise of one reading."""
    end_margin: float
    """Within this distance of the outputs at saturation, in output units, and beyond them, the incremental inverse
    alone is used."""
    creep_horizon: float
    """Time in which the creep reaches a target that the model has further ahead than the creep would come, as after a
    turn, s; `creep_fast` limits it."""
    creep_limit: float
    """Longest creep, s."""
    settle: float
    """Time after stepping back before locking is decided, s."""
    fine_period: float
    """Time between moves of the fine loop, s."""
    approach_done: float = 1.8
    """Multiple of `approach` before the target at which the approach is over."""
    approach_corrections: int = 8
    """Greatest number of corrections of an approach."""
    tries: int = 10
    """Greatest number of approaches, each from the other side, before falling back."""
    fine_moves: int = 5
    """Number of moves of the fine loop."""
    fine_gain: float = 1.0
    """Part of the estimated error that one move takes away, 0 to 2."""

    def __post_init__(self) -> None:
        check_positive(self)
        if not self.nearest <= self.step_back <= self.farthest:
            raise ValueError(
                f"step_back: expected a value within nearest = {self.nearest} and farthest = {self.farthest}, "
                f"got {self.step_back}"
            )
        if self.creep_least > self.creep_most:
            raise ValueError(f"creep_least: expected at most creep_most = {self.creep_most}, got {self.creep_least}")
        if self.fine_gain >= 2.0:
            raise ValueError(f"fine_gain: expected less than 2, where the loop is unstable, got {self.fine_gain}")

    @classmethod
    def scaled(cls, spans: Spans, dwell: float) -> LatchParameters:
        """Return the defaults for a model and an actuator that comes to rest within `dwell` (s)."""
        u, y = spans
        return cls(
            approach=1.3e-2 * y,
            arrival=Arrival(tolerance=1.6e-3 * u, hold=dwell / 40.0, patience=1.875 * dwell),
            creep_least=1.92e-3 * u / dwell,
            creep_most=1.52e-2 * u / dwell,
            creep_gain=0.72 * u / y / dwell,
            creep_offset=9.5e-4 * y,
            creep_fast=3.84e-2 * u / dwell,
            creep_until=1.75e-3 * y,
            step_back=8e-3 * u,
            nearest=1.3e-3 * u,
            farthest=1.75e-2 * u,
            lock_within=2.4e-3 * y,
            accept=8e-4 * y,
            walk_variance=(5e-5 * y) ** 2,
            reading_variance=(2e-4 * y) ** 2,
            end_margin=2.6e-3 * y,
            creep_horizon=0.5 * dwell,
            creep_limit=7.5 * dwell,
            settle=dwell / 8.0,
            fine_period=dwell / 8.0,
        )


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

    Raises
    ------
    ValueError
        If the model has no reversible part.
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
        self._poll = self._parameters.arrival.poll
        self._saturated = sorted(inverse.operator.evaluate(inverse.operator.levels[[0, -1]]).tolist())
        self._operator = inverse.operator
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
        if low + p.end_margin <= target <= high - p.end_margin:
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

        for _ in range(p.approach_corrections):
            if left(reading) <= p.approach_done * p.approach:
                break
            setpoint = self._ahead(target - direction * p.approach - self._estimator.value)
            if setpoint is None:
                return reading
            reading = yield from self._arrive(setpoint, p.arrival)
            self._estimator.update(reading.output - self._modelled())

        for _ in range(round(p.creep_limit / self._poll)):
            if left(reading) <= p.creep_until:
                break
            ahead = self._ahead(self._modelled() + direction * left(reading))
            if ahead is None:
                return reading
            rate = max(p.creep_least + p.creep_gain * (left(reading) - p.creep_offset), p.creep_least)
            long = min(abs(ahead - reading.input) / p.creep_horizon, p.creep_fast)
            rate = max(min(rate, p.creep_most), long)
            reading = yield self._command(self._setpoint + direction * rate * self._poll, self._poll)
        if not -p.lock_within <= left(reading) <= p.creep_until:
            return reading

        self.extreme = reading.input
        return (yield from self._fine_loop(target))

    def _fine_loop(self, target: float) -> Move:
        """Step back and move the locked output to the target."""
        p = self._parameters
        assert self.extreme is not None
        locked = DisturbanceEstimator(walk_variance=p.walk_variance, reading_variance=p.reading_variance)
        origin = setpoint = self._behind(self.extreme - self._direction * p.step_back)
        slope = reversible_slope(self._operator, origin)
        for move in range(p.fine_moves + 1):
            for _ in range(max(1, round((p.fine_period if move else p.settle) / self._poll))):
                reading = yield self._command(setpoint, self._poll)
                # Its output by the slope, had it been at `origin`: no need to wait for the input to settle.
                locked.update(reading.output - slope * (reading.input - origin))
                setpoint = self._behind(setpoint)
            error = target - locked.value - slope * (setpoint - origin)
            if abs(error) > p.lock_within or slope == 0.0:
                return reading
            if move < p.fine_moves:
                setpoint = self._behind(setpoint + p.fine_gain * error / slope)
        self.locked = abs(error) <= p.accept
        return reading

    def _behind(self, setpoint: float) -> float:
        """Return the set-point moved into the stretch behind the extreme where the output is locked."""
        assert self.extreme is not None
        distance = self._direction * (self.extreme - setpoint)
        distance = min(max(distance, self._parameters.nearest), self._parameters.farthest)
        return self._clip(self.extreme - self._direction * distance)

    def _ahead(self, target: float) -> float | None:
        """Return the input of the model's output `target` in the present direction, None beyond the limits."""
        found = walk(self._operator, self.state, self._direction, target)
        return found if found is not None and self._low < found < self._high else None


def reversible_slope(operator: Preisach, value: float) -> float:
    """Return the slope of the output behind a reversal, where no hysteron switches; 0 without reversible part."""
    if operator.reversible is None:
        return 0.0
    breaks, quadratics = operator.reversible.pieces()
    _, linear, quadratic = quadratics[int((breaks < value).sum())].tolist()
    return float(linear + 2.0 * quadratic * value)


def walk(operator: Preisach, state: MemoryCurve, direction: Direction, target: float) -> float | None:
    """Return the first input in one direction (-1 or 1) at which the output has come to the target; None if nowhere.

    Upwards the target is met by any output not below it, downwards by any not above it: perhaps by the present one.
    """
    missing = direction * (target - operator.value(state))
    while missing > 0.0:
        segment = operator.segment(state, direction)
        if segment is None:
            return None
        # The output comes nearer by a d² + b d.
        a, b = direction * segment.quadratic, direction * segment.linear
        square = b * b + 4.0 * a * missing
        # The smaller positive root, in the form that does not cancel; without a positive divisor there is none.
        divisor = b + math.sqrt(square) if square >= 0.0 else 0.0
        if divisor > 0.0 and 2.0 * missing / divisor <= segment.length:
            return state.input + direction * 2.0 * missing / divisor
        missing -= segment.length * (b + segment.length * a)
        following = state.step(state.input + direction * segment.length)
        if following.input == state.input:
            return None
        state = following
    return state.input
