"""A loop that brings the tension of a muscle to a target by moving its end."""

from __future__ import annotations

import math

from bench.control.tracking import Command, Trace


class Stretch:
    """Move an end until the muscle pulls with a given force; or go on doing so for a time.

    Input is the position of the end, m, positive when the muscle is longer; output the force, N. Each step is half
    of the lacking force over the stiffness that the step before it showed. So the force comes to its target from
    one side, and the memory of the muscle sees no reversal that is not asked for, unless the stiffness doubles
    within one step. It does where a slack muscle becomes taut: there a small target may be passed, by less than
    what the greatest stiffness makes of `largest_step`.

    Parameters
    ----------
    force : float
        Target, N.
    stiffnesses : (float, float)
        Least and greatest stiffness of muscle and frame together that are believed, N/m.
    largest_step : float
        Longest step of the end, m; also what is taken up of a slack muscle at a time.
    tolerance : float
        Lacking force that is accepted, N.
    period : float
        Time from step to step, s.
    duration : float
        Time for which the force is held, s; with 0 the loop is done when the target is met.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    def __init__(
        self,
        force: float,
        *,
        stiffnesses: tuple[float, float] = (0.8e3, 12e3),
        largest_step: float = 0.2e-3,
        tolerance: float = 0.03,
        period: float = 0.5,
        duration: float = 0.0,
    ) -> None:
        if not math.isfinite(force):
            raise ValueError(f"force: expected a finite number, got {force}")
        if not 0.0 < stiffnesses[0] <= stiffnesses[1]:
            raise ValueError(f"stiffnesses: expected two positive numbers, the lower one first, got {stiffnesses}")
        if not (largest_step > 0 and tolerance > 0 and period > 0 and duration >= 0):
            raise ValueError(
                "largest_step, tolerance, period: expected positive numbers, duration ≥ 0, got "
                f"{largest_step}, {tolerance}, {period}, {duration}"
            )
        self._force = force
        self._stiffnesses = stiffnesses
        self._largest_step = largest_step
        self._tolerance = tolerance
        self._period = period
        self._duration = duration
        self._start = self._setpoint = self._step = 0.0
        self._output = 0.0
        self.trace = Trace(reference=force)

    def begin(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Start from where the end is."""
        self._start, self._setpoint, self._step = t, measured_input, 0.0
        return self.update(t, measured_input, output, *others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:  # noqa: ARG002
        """Take the next step."""
        lacking = self._force - output
        met = abs(lacking) <= self._tolerance if self._duration == 0 else t - self._start >= self._duration
        if not met:
            softest, stiffest = self._stiffnesses
            # The first step has nothing to go by, so it is the shortest.
            seen = (output - self._output) / self._step if self._step else stiffest
            step = 0.5 * lacking / min(max(seen, softest), stiffest)
            self._step = min(max(step, -self._largest_step), self._largest_step)
            self._setpoint += self._step
        self._output = output
        return Command(self._setpoint, self._period, met)
