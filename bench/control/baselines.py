"""Controllers without hysteresis model: the comparisons that show what an inverse is worth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.control.tracking import Reading, Script, Scripted, Trace, check_positive
from bench.hysteresis import Polynomial
from bench.hysteresis.inverse import Reach


class LookUp(Scripted):
    """Sets what the single-valued inverse of a polynomial says: the model without hysteresis, for comparison.

    A polynomial need not be monotone. The table is its running maximum from the lowest point of the range up
    to the highest one (running minimum, if the lowest comes after the highest), which has one input for each
    output. Targets beyond are given the input of the lowest or highest point, and `reach` says so.

    Parameters
    ----------
    polynomial : Polynomial
        The model.
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
        polynomial: Polynomial,
        limits: tuple[float, float] | None = None,
        *,
        wait: float = 8.0,
        points: int = 4001,
    ) -> None:
        if not 0.0 < wait < math.inf:
            raise ValueError(f"wait: expected a positive number of seconds, got {wait}")
        if points < 2:
            raise ValueError(f"points: expected at least 2, got {points}")
        super().__init__(polynomial.input_range, limits)
        self._polynomial = polynomial
        self._wait = wait
        inputs = np.linspace(*self.limits, points)
        outputs = polynomial.evaluate(inputs)
        lowest, highest = int(outputs.argmin()), int(outputs.argmax())
        step = 1 if lowest <= highest else -1
        rising = slice(lowest, highest + step if highest + step >= 0 else None, step)
        envelope = np.maximum.accumulate(outputs[rising])
        # Of a level stretch only the first input: one input for each output.
        rows = np.flatnonzero(np.concatenate([[True], np.diff(envelope) > 0.0]))
        self._outputs, self._inputs, self._rows = envelope[rows], inputs[rising][rows], rows
        self._measured = math.nan

    @property
    def trace(self) -> Trace:
        """What the controller thinks at present."""
        low, high = self._polynomial.input_range
        # Outside its range a polynomial says nothing of the actuator.
        known = low <= self._measured <= high
        predicted = self._polynomial.evaluate([self._measured]).item() if known else math.nan
        return Trace(reference=self._target, predicted=predicted)

    def _observe(self, measured_input: float) -> bool:
        known = super()._observe(measured_input)
        if known:
            self._measured = measured_input
        return known

    def look_up(self, target: float) -> tuple[float, Reach]:
        """Return the input of a target in output units, within the table, and whether the table holds it."""
        reach = Reach.MET
        if target > self._outputs[-1]:
            reach = Reach.TOO_HIGH
        elif target < self._outputs[0]:
            reach = Reach.TOO_LOW
        after = int(np.searchsorted(self._outputs, target))
        if 0 < after < self._rows.size and self._rows[after] > self._rows[after - 1] + 1:
            # Between the ends of a level stretch there is nothing to interpolate.
            return self._inputs[after].item(), reach
        return float(np.interp(target, self._outputs, self._inputs)), reach

    def _run(self, target: float, reading: Reading) -> Script:  # noqa: ARG002
        setpoint, self._reach = self.look_up(target)
        yield self._command(setpoint, self._wait)
        yield from self._hold(self._poll)


@dataclass(frozen=True)
class IntegralParameters:
    """Numbers of the integral controllers.

    Parameters
    ----------
    gain : float
        Input units per second for one output unit of error; negative for an actuator whose output falls.
        On a branch of slope s the closed loop has the time constant 1 / (gain s), which should not be
        shorter than the input takes to follow: the default gives 0.7 s at 280 (1/m)/K, the steepest of a
        VO2 film, and 7 s where it is a tenth of that.
    period : float
        Time between two corrections, s.
    duration : float
        Time for each target, s; not used where the reference moves.
    """

    gain: float = 0.005
    period: float = 0.5
    duration: float = 8.0

    def __post_init__(self) -> None:
        check_positive(self, "period", "duration")
        if not math.isfinite(self.gain) or self.gain == 0.0:
            raise ValueError(f"gain: expected a number other than 0, got {self.gain}")


class IntegralControl(Scripted):
    """Integral action without a model: the comparison for what the inverse is worth.

    The integrator is the set-point itself, so that it stops at the limits and leaves them at once when the
    error turns: it cannot wind up.

    Parameters
    ----------
    limits : tuple of float
        Least and greatest set-point, input units.
    parameters : IntegralParameters
        Gain and times.
    """

    def __init__(self, limits: tuple[float, float], parameters: IntegralParameters | None = None) -> None:
        super().__init__(limits)
        self._parameters = parameters or IntegralParameters()

    @property
    def trace(self) -> Trace:
        """What the controller thinks at present."""
        return Trace(reference=self._target)

    def _run(self, target: float, reading: Reading) -> Script:
        p = self._parameters
        for _ in range(max(1, round(p.duration / p.period))):
            error = target - reading.output
            wished = self._setpoint + p.gain * p.period * error
            self._reach = saturation(wished, self._low, self._high, error)
            reading = yield self._command(wished, p.period)
        yield from self._hold(self._poll)


def saturation(wished: float, low: float, high: float, error: float) -> Reach:
    """Return what a wish beyond the limits says of the target."""
    if low <= wished <= high:
        return Reach.MET
    return Reach.TOO_HIGH if error > 0.0 else Reach.TOO_LOW
