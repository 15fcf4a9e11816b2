"""Followers: controllers for a reference that moves, called at a fixed rate."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from bench.base import checks as _checks
from bench.control.baselines import IntegralParameters, saturation
from bench.control.estimators import DisturbanceEstimator
from bench.control.model_filters import ModelFilter
from bench.control.tracking import ControllerBase, check_positive
from bench.control.tuning import Spans
from bench.models import Inverse, Reach


@dataclass(frozen=True)
class FollowingParameters:
    """Numbers of the followers with an inverse.

    Parameters
    ----------
    lead : float
        Time by which the reference is extrapolated beyond the end of the coming period, in periods: the
        input's lag behind its set-point, less the half period that a held set-point stands for. The default
        is for an input that follows within half a period.
    walk_variance : float
        Variance by which the model's error changes within one period, output units squared. Large against
        the reading's, as model error and not sensor noise dominates: the gain then is near 1.
    reading_variance : float
        Variance of one reading, and of what the input wanders unseen, output units squared.
    """

    walk_variance: float
    reading_variance: float
    lead: float = 0.0

    def __post_init__(self) -> None:
        check_positive(self, "walk_variance", "reading_variance")
        if not 0.0 <= self.lead < math.inf:
            raise ValueError(f"lead: expected a number of periods, at least 0, got {self.lead}")

    @classmethod
    def scaled(cls, spans: Spans) -> FollowingParameters:
        """Return the defaults for a model: 0.05 % of the output range is read, the model errs by 30 times that."""
        reading = 5e-4 * spans.output
        return cls(30.0 * reading**2, reading**2)


class _Follower(ControllerBase, ABC):
    """What the followers share: one step at a fixed rate."""

    def update(self, t: float, measured_input: float, output: float, reference: float) -> float:
        """Return the set-point for the coming period; see `Follower.update`."""
        before, self._reference = self._reference, _checks.number("reference", reference)
        step = 0.0 if math.isnan(before) else reference - before
        if self._observe(t, measured_input):
            self._setpoint = self._clip(self._answer_to(step, output))
        return self._setpoint

    @abstractmethod
    def _answer_to(self, step: float, output: float) -> float:
        """Return the wanted set-point; `step` is what the reference has moved in one period."""


class OpenLoopFollower(_Follower):
    """Sets the inverse of the reference, ahead by the input's lag.

    Parameters
    ----------
    inverse : Inverse
        Inverse of the identified model. Of an answer with two elements the first is set; the next
        period is asked again, so that the second follows when the actuator has come there.
    state, limits
        As in `OpenLoopInverse`.
    parameters : FollowingParameters
        Numbers of the follower; only `lead` is used.
    adaptation : ModelFilter or None
        What corrects the model by the output in each period.
    """

    _corrects = False

    def __init__(
        self,
        inverse: Inverse[Any],
        state: Any = None,  # noqa: ANN401 - each operator has its own
        limits: tuple[float, float] | None = None,
        parameters: FollowingParameters | None = None,
        adaptation: ModelFilter | None = None,
    ) -> None:
        super().__init__(inverse.operator.input_range, limits, inverse.operator, state, adaptation)
        self._take(inverse, self.state)
        self._parameters = p = parameters or FollowingParameters.scaled(Spans.of(inverse.operator))
        if self._corrects:
            self._estimator = DisturbanceEstimator(walk_variance=p.walk_variance, reading_variance=p.reading_variance)

    def _take(self, inverse: Inverse[Any], state: Any) -> None:  # noqa: ANN401
        self._inverse = inverse
        self._answers = inverse.stream(state)
        self._memory, self._move = self._answers, self._answers.move

    def _answer_to(self, step: float, output: float) -> float:
        self._learn(output)
        return self._inverted(step, 0.0)

    def _inverted(self, step: float, disturbance: float) -> float:
        target = self._reference - disturbance
        wished = target + self._parameters.lead * step
        answers = self._answers
        setpoint = answers.find(wished)
        if answers.reach is not Reach.MET or not math.isnan(answers.saturating):
            # Not for the sake of an extrapolation: a passage through saturation is far, and may be needless.
            wished = target
            setpoint = answers.find(wished)
        passing = answers.saturating
        setpoints = (setpoint,) if math.isnan(passing) else (passing, setpoint)
        return self._within(setpoints, answers.reach, wished)[0]


class ClosedLoopFollower(OpenLoopFollower):
    """The exact inverse of the reference less the disturbance that was measured.

    The disturbance z = y - Ω(ψ), measured output less that of the model, goes into a Kalman filter of a random
    walk in every period, a missing output as a missing value. As the memory ψ is that of the measured input,
    the lag of the input is no part of it.

    Parameters
    ----------
    inverse : Inverse
        Exact inverse of the identified model; see `OpenLoopFollower` for answers with two elements.
    state, limits
        As in `OpenLoopInverse`.
    parameters : FollowingParameters
        Numbers of the follower.
    adaptation : ModelFilter or None
        As in `OpenLoopFollower`.
    """

    _corrects = True

    def _answer_to(self, step: float, output: float) -> float:
        assert self._estimator is not None
        self._learn(output)
        self._estimator.update(output - self._modelled() if self._is_known(output) else None)
        return self._inverted(step, self._estimator.value)


class IntegralFollower(_Follower):
    """Integral action without a model, as `IntegralControl`.

    Parameters
    ----------
    limits : tuple of float
        Least and greatest set-point, input units.
    parameters : IntegralParameters
        Gain and period; the error is that against the reference which was for now.
    """

    def __init__(self, limits: tuple[float, float], parameters: IntegralParameters) -> None:
        super().__init__(limits)
        self._parameters = parameters

    def _answer_to(self, step: float, output: float) -> float:
        if not self._is_known(output):
            return self._setpoint
        error = self._reference - step - output
        wished = self._setpoint + self._parameters.gain * self._parameters.period * error
        self._reach = saturation(wished, *self.limits, error)
        return wished
