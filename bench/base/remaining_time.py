"""How long a run still takes: the rehearsal's remaining time, corrected by the pace that was measured."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

_TRUST = 0.02
"""Share of the whole time for which the expectation counts as much as what was measured."""


@dataclass(frozen=True)
class Expectation:
    """When the steps of a run are expected to end.

    Attributes
    ----------
    marks : tuple of (int, float)
        Number of finished steps and laboratory time from the start in s, in order.
    seconds : float
        Laboratory time of the whole run, s.
    at_most : float
        Longest laboratory time of the whole run, s; infinite where no bound is known.
    """

    marks: tuple[tuple[int, float], ...]
    seconds: float
    at_most: float = math.inf

    @property
    def steps(self) -> int:
        """Number of steps of the whole run."""
        return self.marks[-1][0] if self.marks else 0

    def end_of(self, steps: int) -> float:
        """Return when so many steps are expected to have ended, s from the start."""
        after = bisect_right(self.marks, steps, key=lambda mark: mark[0])
        count, seconds = self.marks[after - 1] if after else (0, 0.0)
        if count == steps or after == len(self.marks):
            return seconds
        later, end = self.marks[after]
        return seconds + (end - seconds) * (steps - count) / (later - count)


@dataclass(frozen=True)
class Remaining:
    """What is left of a run.

    Attributes
    ----------
    laboratory, wall : float
        Laboratory and wall-clock time to the end, s.
    at_most : float
        Longest wall-clock time to the end, s; infinite where no bound is known.
    share : float
        Share of the run that is done, 0 to 1.
    """

    laboratory: float
    wall: float
    at_most: float
    share: float


class RemainingTime:
    """Estimates what is left of a run, from its expectation and its course so far.

    Time in which the run was paused, or waited for the operator, does not count as pace.

    Parameters
    ----------
    expectation : Expectation
        When the steps end if all goes as expected.
    factor : float
        Laboratory seconds in a second of the wall clock, at first; infinite where only the computer limits them.
    """

    def __init__(self, expectation: Expectation, factor: float) -> None:
        self._expectation = expectation
        self._factor = factor
        self._steps = 0
        self._since = 0.0
        self._waited = 0.0
        self._paused_at: float | None = None
        self._prompt: tuple[int, float] | None = None

    def step(self, steps: int, t: float) -> None:
        """Note that so many steps are finished, the last one at laboratory time `t` (s from the start)."""
        if self._prompt is not None:
            self._waited += self._waiting(t)
            self._prompt = None
        self._steps, self._since = steps, t

    def pause(self, t: float) -> None:
        """Note that the run is paused at laboratory time `t`, s."""
        self._paused_at = t

    def resume(self, t: float) -> None:
        """Note that the run goes on at laboratory time `t`, s."""
        if self._paused_at is not None:
            waited = t - self._paused_at
            self._waited += waited
            self._since += waited
            self._paused_at = None

    def prompt(self, t: float) -> None:
        """Note that the run waits for the operator from laboratory time `t` on, s."""
        self._prompt = self._steps, t

    def at(self, t: float, wall: float) -> Remaining:
        """Return what is left at laboratory time `t` and after `wall` seconds of the wall clock from the start."""
        expected = self._expectation
        passed = t - self._waited
        since = t - self._since
        if self._paused_at is not None:
            passed, since = passed - (t - self._paused_at), since - (t - self._paused_at)
        if self._prompt is not None:
            waiting = self._waiting(t)
            passed, since = passed - waiting, since - waiting
        begin, end = expected.end_of(self._steps), expected.end_of(self._steps + 1)
        done = min(begin + max(0.0, since), end) if self._steps < expected.steps else begin
        trust = _TRUST * expected.seconds
        pace = (passed + trust) / (done + trust) if done + trust > 0 else 1.0
        left = max(0.0, expected.seconds - done) * pace
        most = max(left, expected.at_most - done)
        # At first as fast as the clock promises, then as fast as it has gone.
        slowness = 1.0 / self._factor
        if t > 0:
            slowness = (wall + trust * slowness) / (t + trust) if math.isfinite(self._factor) else wall / t
        share = min(1.0, done / expected.seconds) if expected.seconds > 0 else 0.0
        return Remaining(left, left * slowness, most * slowness, share)

    def _waiting(self, t: float) -> float:
        """Return how long a prompt waits beyond what its step was expected to take, s."""
        if self._prompt is None:
            return 0.0
        step, asked = self._prompt
        return max(0.0, t - asked - (self._expectation.end_of(step + 1) - self._expectation.end_of(step)))
