"""The clock of a served laboratory: it follows the wall clock and never runs ahead of what the process has done."""

from __future__ import annotations

import math

from bench.base import Clock, Stopwatch, wall_time

LONGEST_STEP = 0.1
"""Laboratory time (s) by which the clock follows at most at once; a process that was stalled loses the rest."""


class ServedClock(Clock):
    """Laboratory time that the loop of a server moves, `factor` times as fast as the wall clock.

    Within a request it stands still. What takes an instrument time, such as a burst of conversions, moves it ahead;
    the wall clock then catches up, and nothing is served meanwhile.

    Parameters
    ----------
    factor : float
        Laboratory seconds per wall-clock second; positive.
    may_skip : bool
        Whether time may pass at once, without the wall clock.

    Attributes
    ----------
    paced : float
        Laboratory time (s) at which the wall clock stands; `now()` is never behind it.

    Raises
    ------
    ValueError
        If `factor` is not a positive finite number.
    """

    def __init__(self, factor: float, *, may_skip: bool = True) -> None:
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"factor: expected a positive number, got {factor}")
        super().__init__()
        self.epoch = wall_time()
        self.factor = factor
        self.may_skip = may_skip
        self.paced = 0.0
        self._now = 0.0
        self._wall = Stopwatch()
        self._followed = self._skipped = 0.0

    def now(self) -> float:
        """Return laboratory seconds since the clock was made."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Move ahead of the wall clock, which catches up before anything else is served.

        Raises `ValueError` if `seconds` is not finite.
        """
        if not math.isfinite(seconds):
            raise ValueError(f"seconds: expected a finite number, got {seconds}")
        self._now += max(seconds, 0.0)

    @property
    def is_ahead(self) -> bool:
        """Whether the wall clock has to catch up."""
        return self._now > self.paced

    @property
    def factor_reached(self) -> float:
        """Laboratory seconds per wall-clock second since the start, without those that were skipped."""
        seconds = self._wall.seconds()
        return (self.paced - self._skipped) / seconds if seconds else self.factor

    def start(self) -> None:
        """Begin to follow the wall clock from the present laboratory time on."""
        self._wall = Stopwatch()
        self._followed = 0.0
        self._skipped = self.paced

    def follow(self) -> None:
        """Follow the wall clock, by `LONGEST_STEP` at most."""
        wall = self._wall.seconds()
        self.paced += min((wall - self._followed) * self.factor, LONGEST_STEP)
        self._followed = wall
        self._now = max(self._now, self.paced)

    def skip(self, seconds: float) -> None:
        """Move on without the wall clock; `seconds` of laboratory time, zero or positive."""
        self.paced += seconds
        self._skipped += seconds
        self._now = max(self._now, self.paced)


def make_served_clock(name: str) -> ServedClock:
    """Make a clock by its name on the command line: `wall`, or `xN` for N times as fast.

    Raises `ValueError` if the name is neither.
    """
    if name == "wall":
        return ServedClock(1.0, may_skip=False)
    try:
        if not name.startswith("x"):
            raise ValueError
        return ServedClock(float(name[1:]))
    except ValueError:
        raise ValueError(f"clock {name!r} is unknown; a served laboratory has wall, or xN such as x20") from None
