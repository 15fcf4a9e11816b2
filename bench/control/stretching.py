"""A loop that brings the tension of a muscle to a target by moving its end."""

from __future__ import annotations

from bench.control.tracking import Command, Trace


class Stretch:
    """Move an end until the muscle pulls with a given force, without overshoot; or go on doing so for a time.

    Input is the position of the end, m, positive when the muscle is longer; output the force, N. Each step is the
    lacking force over a stiffness that the muscle never exceeds. So the force comes to its target from one side,
    and the memory of the muscle sees no reversal that is not asked for.

    Parameters
    ----------
    force : float
        Target, N.
    stiffness : float
        Greatest stiffness of muscle and frame together, N/m.
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
        stiffness: float = 12e3,
        largest_step: float = 0.2e-3,
        tolerance: float = 0.03,
        period: float = 0.5,
        duration: float = 0.0,
    ) -> None:
        if not (stiffness > 0 and largest_step > 0 and tolerance > 0 and period > 0 and duration >= 0):
            raise ValueError(
                "stiffness, largest_step, tolerance, period: expected positive numbers, duration ≥ 0, got "
                f"{stiffness}, {largest_step}, {tolerance}, {period}, {duration}"
            )
        self._force = force
        self._stiffness = stiffness
        self._largest_step = largest_step
        self._tolerance = tolerance
        self._period = period
        self._duration = duration
        self._start = self._setpoint = 0.0
        self.trace = Trace(reference=force)

    def begin(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Start from where the end is."""
        self._start, self._setpoint = t, measured_input
        return self.update(t, measured_input, output, *others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:  # noqa: ARG002
        """Take the next step."""
        lacking = self._force - output
        met = abs(lacking) <= self._tolerance if self._duration == 0 else t - self._start >= self._duration
        if not met:
            step = lacking / self._stiffness
            self._setpoint += min(max(step, -self._largest_step), self._largest_step)
        return Command(self._setpoint, self._period, met)
