"""Predictive control of a reference that moves, within the limits of the actuator.

In each period the set-points of a horizon are chosen by least squares of the output's predicted error: the drive
moves as its identified dynamics say (delay, second order, fastest change), the specimen sees it behind its lag, and
the output is that of the operator from a copy of its memory, with the disturbance as it is now. The first set-point
is sent. The search begins with the best of some plans, the inverse of the reference ahead by the dynamics' delay and
what is left of the last plan, and improves it by Gauss-Newton steps within the limits (Rawlings, Mayne, Diehl, *Model
Predictive Control*, 2017, chapter 8), each by bounded linear least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import lsq_linear

from bench.base import Floats, checks as _checks
from bench.control import prediction_kernels as kernels
from bench.control.estimators import DisturbanceEstimator
from bench.control.model_filters import INPUT_ERROR, ModelFilter
from bench.control.tracking import ControllerBase, check_positive
from bench.control.tuning import Spans
from bench.models import IdentifiedDynamics, Inverse, Reach

_PARTS = 4
"""Steps of time in a period. Derivation: straight between them, a bend within a period is known to 1 / 4²."""
_TIMES = 4.0
"""Length of the horizon beyond the delay, in time constants. Derivation: e⁻⁴, 2 % of a move, lies behind it."""
_VARIED = 2.0 * INPUT_ERROR
"""Difference of a set-point for derivatives, in spans of the input.

Derivation: twice what the input differs by unseen; a smaller one sees corners of the memory that the specimen lacks.
"""
_POSITION = 0.6
"""Part α of the error of the predicted position that its correction takes.

Derivation: with the rate's part the noise of the position is halved in variance,
(2 α² + β (2 − 3 α)) / (α (4 − β − 2 α)) = 0.5.
"""
_RATE = _POSITION**2 / (2.0 - _POSITION)
"""The part β of the rate in a period.

Source: Benedict and Bordner, "Synthesis of an optimal set of radar track-while-scan smoothing equations", IRE
Transactions on Automatic Control, 1962.
"""
_LAGS = 1.2 ** np.arange(-6, 7)
"""Lags of the response that are tried beside each other, in identified ones.

Derivation: quick readings show a lag to a factor of three (docs/reference/predictive-control.md); of a move followed
with a lag that is 20 % off, 20 % of the lag's part is left.
"""
_KEPT = 0.98
"""Part of the evidence for a lag that is kept from period to period. Derivation: 1 / (1 − 0.98) periods count, 50."""
_EVIDENCE = 0.9
"""Squares of surprise, in those of the present lag, below which another one takes its place.

Derivation: of two lags that do equally well one is ahead by that in 36 % of cases of 50 periods (F test); the wrong
one of two such costs little, and without a threshold they would take turns.
"""


@dataclass(frozen=True)
class PredictionParameters:
    """Numbers of the predictive follower."""

    # As in `FollowingParameters`, output units squared.
    walk_variance: float
    reading_variance: float
    period: float = 0.5  # time between two set-points, s
    # Weight of the set-points' second difference beside the output's error, in spans of output and input.
    smoothness: float = 0.05
    searches: int = 1  # steps of the search in a period
    # Least and greatest number of periods of the horizon; computing time grows with its square.
    fewest: int = 6
    most: int = 24
    between: float = 0.1  # weight of the output's error between the ends of two periods, where the reference counts
    longest_step: float = 0.25  # longest step of the search, in spans of the input

    def __post_init__(self) -> None:
        check_positive(self)

    @classmethod
    def scaled(cls, spans: Spans, period: float) -> PredictionParameters:
        """Return the defaults for a model, as those of `FollowingParameters`."""
        reading = 5e-4 * spans.output
        return cls(30.0 * reading**2, reading**2, period)


@dataclass(eq=False)
class _Lag:
    """One lag of the response: what remains of a distance after a step of time, its level, memory and evidence."""

    remains: float
    level: float = math.nan
    stream: Any = None
    disturbance: float = math.nan
    surprise: float = 0.0


class PredictiveFollower(ControllerBase):
    """Sets the first of the set-points by which the output is predicted to follow a horizon of the reference.

    It knows the reference ahead: `foresee` is called before each `update`. The memory of the specimen follows the
    predicted drive, corrected by the measured one, between two readings too, and behind the specimen's lag. As quick
    readings of a characterization show a lag poorly, others about the identified one run beside it; that with the
    steadiest disturbance is taken.

    Parameters
    ----------
    inverse : Inverse
        Inverse of the identified model.
    dynamics : IdentifiedDynamics
        Of drive and response. Late parts of the response count as disturbance.
    state, limits
        As in `OpenLoopInverse`.
    parameters : PredictionParameters
        Numbers of the follower.
    adaptation : ModelFilter or None
        What corrects the model by the output in each period.

    Attributes
    ----------
    horizon : int
        Values of the reference that `foresee` expects, one at the end of each coming period.
    """

    def __init__(
        self,
        inverse: Inverse[Any],
        dynamics: IdentifiedDynamics,
        state: Any = None,  # noqa: ANN401 - each operator has its own
        limits: tuple[float, float] | None = None,
        parameters: PredictionParameters | None = None,
        adaptation: ModelFilter | None = None,
    ) -> None:
        super().__init__(inverse.operator.input_range, limits, inverse.operator, state, adaptation)
        self._inverse = inverse
        self._spans = Spans.of(inverse.operator)
        self._parameters = p = parameters or PredictionParameters.scaled(self._spans, 0.5)
        self._estimator: DisturbanceEstimator = DisturbanceEstimator(
            walk_variance=p.walk_variance, reading_variance=p.reading_variance
        )
        actuator, response = dynamics.actuator, dynamics.response
        self._gain, self._offset, self._response = actuator.gain, actuator.offset, response
        step = p.period / _PARTS
        self._order, self._most = actuator.order, actuator.rate * step
        lags = response.lag * _LAGS if response.lag > 0.0 else np.zeros(1)
        self._lags = [_Lag(math.exp(-step / lag) if lag > 0.0 else 0.0) for lag in lags.tolist()]
        self._lag = self._lags[lags.size // 2]
        w = actuator.frequency
        if actuator.order == 2:
            passed = expm(step * np.array([[0.0, 1.0], [-(w**2), -2.0 * actuator.damping * w]]))
        else:
            passed = np.array([[math.exp(-w * step), 0.0], [0.0, 0.0]])
        self._steps = np.vstack([passed, np.full(2, actuator.rate)])
        wanted = math.ceil((actuator.delay + _TIMES * (actuator.time_constant + response.lag)) / p.period)
        self.horizon = min(max(wanted, p.fewest), p.most)
        # Which set-point each step of time heeds: first those that were sent before, then those of the plan.
        ends = (np.arange(self.horizon * _PARTS) + 0.5) / _PARTS - actuator.delay / p.period
        self._before = 1 - math.floor(ends[0])
        self._source = np.floor(ends).astype(np.int64) + self._before
        # What is held for a period stands for its middle, of an actuator that follows at once for its end.
        self._ahead = [dynamics.time_constant + part * p.period for part in (0.5, 1.0)]
        self._take(inverse, self.state)
        self._sent = np.full(self._before, self._through(self._setpoint))
        self._plan: Floats = np.full(self.horizon, self._setpoint)
        self._foreseen: Floats | None = None
        self._place = self._velocity = self._time = math.nan
        steps = np.diff(np.eye(self.horizon + 1), axis=0)
        self._bend = np.diff(steps, axis=0, prepend=np.zeros_like(steps[:1]))
        self._bend *= p.smoothness * self._spans.output / self._spans.input

    def foresee(self, references: Floats) -> None:
        """Take the reference at the end of each coming period, shape (`horizon`,), output units."""
        self._foreseen = references

    def update(self, t: float, measured_input: float, output: float, reference: float) -> float:
        """Take in a reading and return the set-point for the coming period; see `Follower.update`.

        A missing reading is nan. Raises ValueError if the reference is not finite.
        """
        last, self._reference = self._reference, _checks.number("reference", reference)
        low, high = self._plausible_input
        known = math.isfinite(measured_input) and low <= measured_input <= high
        self._pass(t, measured_input if known else math.nan)
        if known:
            if self._is_known(output):
                self._choose(output)
                self._learn(output)
                self._estimator.update(output - self._modelled())
            else:
                self._estimator.update(None)
            foreseen = np.full(self.horizon, reference) if self._foreseen is None else self._foreseen
            begin = reference if math.isnan(last) else last
            self._plan = self._improved(np.concatenate([[begin], foreseen]) - self._estimator.value)
            self._setpoint = float(self._plan[0])
        self._sent = np.append(self._sent[1:], self._through(self._setpoint))
        self._foreseen = None
        return self._setpoint

    def _through(self, setpoint: Any) -> Any:  # noqa: ANN401 - a number or an array of them
        """Return where the drive comes to rest."""
        return self._gain * setpoint + self._offset

    def _take(self, inverse: Inverse[Any], state: Any) -> None:  # noqa: ANN401
        self._inverse = inverse
        for lag in self._lags:
            lag.stream = inverse.operator.stream(state)
            lag.disturbance = math.nan
        self._memory = self._lag.stream

    def _pass(self, t: float, measured: float) -> None:
        """Move drive and memory by the time since the last reading; correct them by the measured input if known."""
        passed, self._time = t - self._time, t
        period = self._parameters.period
        if math.isnan(self._place) or not 0.5 * period < passed < 1.5 * period:
            # At the start, or after a pause: at rest where it is.
            if math.isfinite(measured):
                for lag in self._lags:
                    first = math.isnan(self._place)
                    kept = 0.0 if first else lag.remains ** (max(passed, 0.0) / period * _PARTS)
                    level = self._response.level(measured)
                    lag.level = level + (lag.level - level) * kept if kept else level
                    lag.stream.step(self._response.of_level(lag.level))
                    lag.disturbance = math.nan
                self._place, self._velocity = measured, 0.0
            return
        # What was the first of a plan then is the last that was sent now.
        positions, seen = np.empty((2, 1, _PARTS))
        place, velocity = self._drive(self._sent[None, :], self._source[:_PARTS] - 1, positions, seen)
        path = positions[0]
        if math.isfinite(measured):
            error = measured - place
            part = 1.0 if self._order == 0 else _POSITION
            path = path + part * error * np.arange(1, _PARTS + 1) / _PARTS
            velocity += 0.0 if self._order < 2 else _RATE * error / period
        self._place, self._velocity = float(path[-1]), velocity
        for lag in self._lags:
            for position in path.tolist():
                level = self._response.level(position)
                lag.level = level + (lag.level - level) * lag.remains
                lag.stream.step(self._response.of_level(lag.level))

    def _choose(self, output: float) -> None:
        """Take the lag whose disturbance changes least from reading to reading, if it is clearly another one."""
        for lag in self._lags:
            disturbance = output - lag.stream.value
            if not math.isnan(lag.disturbance):
                lag.surprise = _KEPT * lag.surprise + (disturbance - lag.disturbance) ** 2
            lag.disturbance = disturbance
        best = min(self._lags, key=lambda lag: lag.surprise)
        if best.surprise < _EVIDENCE * self._lag.surprise:
            self._estimator.shift(self._lag.stream.value - best.stream.value)
            self._lag, self._memory = best, best.stream

    def _drive(
        self, setpoints: Floats, source: NDArray[np.int64], positions: Floats, seen: Floats
    ) -> tuple[float, float]:
        """Write what the drive does and what the specimen sees; return its last place and velocity."""
        place, velocity, _ = kernels.drive(
            np.array([self._place, self._velocity, self._lag.level]), setpoints, source, self._steps, self._order,
            self._most, self._lag.remains, self._response.power, positions, seen,
        )  # fmt: skip
        return place, velocity

    def _outputs(self, plans: Floats, state: Any) -> Floats:  # noqa: ANN401
        """Return the outputs of some plans, a row each, without the disturbance."""
        sent = np.broadcast_to(self._sent, (plans.shape[0], self._before))
        setpoints = np.ascontiguousarray(np.hstack([sent, self._through(plans)]))
        positions, seen = np.empty((2, plans.shape[0], self._source.size))
        self._drive(setpoints, self._source, positions, seen)
        assert self._model is not None
        return np.array([self._model.evaluate(row, state) for row in seen])

    def _improved(self, references: Floats) -> Floats:
        """Return the plan for what the model's output shall be now and at the end of each period."""
        state, period = self.state, self._parameters.period
        ends = period * np.arange(self.horizon + 1)
        times = period / _PARTS * np.arange(1, self.horizon * _PARTS + 1)
        wanted = np.interp(times, ends, references)
        weights = np.tile(np.append(np.full(_PARTS - 1, self._parameters.between), 1.0), self.horizon)
        followed = self._inverse.follow(references[1:], state)
        self._reach = Reach.of(followed.met[0], references[1] - float(followed.outputs[0]))
        inverses = [np.interp(ends[:-1] + ahead, ends[1:], followed.setpoints) for ahead in self._ahead]
        plans = np.clip([*inverses, np.append(self._plan[1:], self._plan[-1])], self._low, self._high)

        def residuals(rows: Floats) -> Floats:
            previous = np.full((rows.shape[0], 1), self._setpoint)
            rough = np.hstack([previous, rows]) @ self._bend.T
            return np.hstack([(self._outputs(rows, state) - wanted) * weights, rough])

        left = residuals(plans)
        best = int(np.argmin((left**2).sum(axis=1)))
        plan, error = plans[best], left[best]
        near, varied = self._parameters.longest_step * self._spans.input, _VARIED * self._spans.input
        for _ in range(self._parameters.searches):
            # On the side to which it moves, where the output has no corner; inwards at a limit.
            signs = np.where(np.diff(plan, prepend=self._setpoint) < 0.0, -1.0, 1.0)
            signs = np.where(
                (plan + varied * signs > self._high) | (plan + varied * signs < self._low), -signs, signs
            )
            moved = residuals(plan + np.diag(varied * signs))
            jacobian = ((moved - error) / (varied * signs)[:, None]).T
            low, high = np.maximum(self._low - plan, -near), np.minimum(self._high - plan, near)
            step = lsq_linear(jacobian, -error, (low - 1e-12, high + 1e-12), method="bvls", max_iter=60).x
            tries = np.clip(plan + np.outer([1.0, 0.4, 0.15], step), self._low, self._high)
            left = residuals(tries)
            squares = (left**2).sum(axis=1)
            best = int(np.argmin(squares))
            if not squares[best] < float(error @ error):
                break
            plan, error = tries[best], left[best]
        return np.asarray(plan)
