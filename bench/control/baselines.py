"""Controllers without a hysteresis model, for comparison with those that invert one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.control.tracking import Sample, Script, Scripted, Trace, check_positive
from bench.control.tuning import Spans
from bench.models import Operator, Reach, TableInverse


class LookUp(Scripted):
    """Sets what the single-valued inverse of a model without hysteresis says, for comparison.

    Targets beyond its table (see `TableInverse`) are given the input of the lowest or highest point, and `reach`
    says so.

    Parameters
    ----------
    model : Operator
        The model, without memory.
    limits : tuple of float or None
        Least and greatest set-point, input units; default the range of the model. The table spans no more.
    wait : float
        Time for the actuator to settle, s.
    points : int
        Number of points of the table.
    """

    _needs_output = False

    def __init__(
        self,
        model: Operator[None],
        limits: tuple[float, float] | None = None,
        *,
        wait: float,
        points: int = 4001,
    ) -> None:
        if not 0.0 < wait < math.inf:
            raise ValueError(f"wait: expected a positive number of seconds, got {wait}")
        super().__init__(model.input_range, limits)
        self._wait = wait
        self._table = TableInverse(model, self.limits, points)
        self._measured = math.nan

    @property
    def trace(self) -> Trace:
        """Internal values at present."""
        low, high = self._table.operator.input_range
        # Outside its range the model says nothing of the actuator.
        known = low <= self._measured <= high
        predicted = self._table.operator.evaluate([self._measured]).item() if known else math.nan
        return Trace(reference=self._reference, predicted=predicted)

    def _observe(self, t: float, measured_input: float) -> bool:
        known = super()._observe(t, measured_input)
        if known:
            self._measured = measured_input
        return known

    def _run(self, target: float, reading: Sample) -> Script:  # noqa: ARG002
        setpoint, self._reach = self._table.look_up(target)
        yield self._command(setpoint, self._wait)
        yield from self._hold(self._poll)


@dataclass(frozen=True)
class IntegralParameters:
    """Numbers of the integral controllers."""

    # Input units per second for one output unit of error; negative for an actuator whose output falls. On a branch of
    # slope s the closed loop has the time constant 1 / (gain s), which should not be shorter than the input takes to
    # follow.
    gain: float
    period: float  # time between two corrections, s
    duration: float  # time for each target, s; not used where the reference moves

    def __post_init__(self) -> None:
        check_positive(self, "period", "duration")
        if not math.isfinite(self.gain) or self.gain == 0.0:
            raise ValueError(f"gain: expected a number other than 0, got {self.gain}")

    @classmethod
    def scaled(cls, spans: Spans, dwell: float, *, falls: bool = False) -> IntegralParameters:
        """Return the defaults for a model and an actuator that comes to rest within `dwell` (s).

        Where the slope is the mean one the loop has 7/8 of that as its time constant; `falls` turns its sign.
        """
        gain = spans.input / spans.output / (0.875 * dwell)
        return cls(-gain if falls else gain, period=dwell / 16.0, duration=dwell)


class IntegralControl(Scripted):
    """Integral action without a model, for comparison with the inverse.

    The integrator is the set-point itself, so that it stops at the limits and leaves them at once when the
    error turns: it cannot wind up.

    Parameters
    ----------
    limits : tuple of float
        Least and greatest set-point, input units.
    parameters : IntegralParameters
        Gain and times.
    """

    def __init__(self, limits: tuple[float, float], parameters: IntegralParameters) -> None:
        super().__init__(limits)
        self._parameters = parameters

    def _run(self, target: float, reading: Sample) -> Script:
        p = self._parameters
        for _ in range(max(1, round(p.duration / p.period))):
            error = target - reading.output
            wished = self._setpoint + p.gain * p.period * error
            self._reach = saturation(wished, self._low, self._high, error)
            reading = yield self._command(wished, p.period)
        yield from self._hold(self._poll)


def saturation(wished: float, low: float, high: float, error: float) -> Reach:
    """Return what a wish beyond the limits says of the target."""
    return Reach.of(low <= wished <= high, error)
