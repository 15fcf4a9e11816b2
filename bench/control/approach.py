"""A loop that steps an input until the output meets a target, coming from one side."""

from __future__ import annotations

import math

from bench.control.tracking import Command, Trace


class Approach:
    """Step the input until the output meets a target; or go on doing so for a time: a `Loop`.

    Each step is half of the error over the slope that the step before showed. So the output comes to its target from
    one side, and the memory of a hysteretic specimen sees no reversal that is not asked for, unless the slope doubles
    within one step. Then a target may be passed, by less than the greatest slope makes of `largest_step`.

    Parameters
    ----------
    target : float
        Wanted output, output units.
    slopes : (float, float)
        Least and greatest slope of the output over the input that are believed, output units per input
        unit, positive.
    largest_step : float
        Longest step of the input, input units; also what is taken at a time where the output does not respond.
    tolerance : float
        Error that is accepted, output units.
    period : float
        Time from step to step, s.
    duration : float
        Time for which the target is held, s; with 0 the loop is done when it is met.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    def __init__(
        self,
        target: float,
        *,
        slopes: tuple[float, float],
        largest_step: float,
        tolerance: float,
        period: float = 0.5,
        duration: float = 0.0,
    ) -> None:
        if not math.isfinite(target):
            raise ValueError(f"target: expected a finite number, got {target}")
        if not 0.0 < slopes[0] <= slopes[1]:
            raise ValueError(f"slopes: expected two positive numbers, the lower one first, got {slopes}")
        if not (largest_step > 0 and tolerance > 0 and period > 0 and duration >= 0):
            raise ValueError(
                "largest_step, tolerance, period: expected positive numbers, duration ≥ 0, got "
                f"{largest_step}, {tolerance}, {period}, {duration}"
            )
        self._target = target
        self._slopes = slopes
        self._largest_step = largest_step
        self._tolerance = tolerance
        self._period = period
        self._duration = duration
        self._start = self._setpoint = self._step = 0.0
        self._output = 0.0
        self.trace = Trace(reference=target)

    def begin(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Start from the present input."""
        self._start, self._setpoint, self._step = t, measured_input, 0.0
        return self.update(t, measured_input, output, *others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:  # noqa: ARG002
        """Take the next step."""
        error = self._target - output
        met = abs(error) <= self._tolerance if self._duration == 0 else t - self._start >= self._duration
        if not met:
            least, greatest = self._slopes
            # Without a step before it, the first one is the shortest.
            slope = (output - self._output) / self._step if self._step else greatest
            step = 0.5 * error / min(max(slope, least), greatest)
            self._step = min(max(step, -self._largest_step), self._largest_step)
            self._setpoint += self._step
        self._output = output
        return Command(self._setpoint, self._period, met)
