"""A loop that steps an input until the output meets a target, coming from one side."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

from bench.control.tracking import Command, Trace


@dataclass(eq=False)
class Approach:
    """Step the input until the output meets a target; or go on doing so for a time: a `Loop`.

    Each step is half of the error over the slope that the step before showed. So the output comes to its target from
    one side, and the memory of a hysteretic specimen sees no reversal that is not asked for, unless the slope doubles
    within one step. Then a target may be passed, by less than the greatest slope makes of `largest_step`.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    target: float
    """Wanted output, output units."""
    _: KW_ONLY
    slopes: tuple[float, float]
    """Least and greatest slope of the output over the input that are believed, output per input units, positive."""
    largest_step: float
    """Longest step of the input, input units; also what is taken at a time where the output does not respond."""
    tolerance: float
    """Error that is accepted, output units."""
    period: float = 0.5
    """Time from step to step, s."""
    duration: float = 0.0
    """Time for which the target is held, s; with 0 the loop is done when it is met."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.target):
            raise ValueError(f"target: expected a finite number, got {self.target}")
        if not 0.0 < self.slopes[0] <= self.slopes[1]:
            raise ValueError(f"slopes: expected two positive numbers, the lower one first, got {self.slopes}")
        if not (self.largest_step > 0 and self.tolerance > 0 and self.period > 0 and self.duration >= 0):
            raise ValueError(
                "largest_step, tolerance, period: expected positive numbers, duration ≥ 0, got "
                f"{self.largest_step}, {self.tolerance}, {self.period}, {self.duration}"
            )
        self._start = self._setpoint = self._step = self._output = math.nan
        self.trace = Trace(reference=self.target)

    def begin(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Start from the present input."""
        self._start, self._setpoint, self._step = t, measured_input, 0.0
        return self.update(t, measured_input, output, *others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:  # noqa: ARG002
        """Take the next step."""
        error = self.target - output
        met = abs(error) <= self.tolerance if self.duration == 0 else t - self._start >= self.duration
        if not met:
            least, greatest = self.slopes
            # Without a step before it, the first one is the shortest.
            slope = (output - self._output) / self._step if self._step else greatest
            step = 0.5 * error / min(max(slope, least), greatest)
            self._step = min(max(step, -self.largest_step), self.largest_step)
            self._setpoint += self._step
        self._output = output
        return Command(self._setpoint, self.period, met)
