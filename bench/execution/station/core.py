"""What a station decides: when it looks at the interlocks, whether the bench is late, and what ends the run.

One class without thread, socket, device or clock of its own: the caller says what time it is. So the same decisions
are taken on a virtual clock and in the process that guards hardware.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from bench.base import BenchError, GuardianError, InterlockError
from bench.rig import InterlockFinding, InterlockWatch, Level

_FIRST_PROMISE = 10.0
"""What counts before the bench has promised anything, s."""


class StationCore:
    """The state of a station.

    Parameters
    ----------
    watch : InterlockWatch
        The interlocks.
    interval : float
        Time between two looks at the interlocks, s; infinity if they are looked at with the readings only.

    Attributes
    ----------
    over : bool
        Whether it is in its safe state for good.
    cause : BenchError or None
        Error that tripped the station; None before that, or if the bench asked for the end.
    late : bool
        Whether that was a promise of the bench.
    holding : bool
        Whether an interlock has the bench hold its set-points and wait.
    pause : str
        Why an interlock has the bench pause; empty if none does. The caller clears it.
    """

    def __init__(self, watch: InterlockWatch, interval: float) -> None:
        self._watch = watch
        self._interval = interval
        self._next_look = math.inf
        self._lease_end = math.inf
        self._promised = _FIRST_PROMISE
        self._why = "it has promised nothing yet"
        self._asked = False
        self._is_bound = False
        self._seen: float | None = None
        self.over = False
        self.cause: BenchError | None = None
        self.late = False
        self.holding = False
        self.pause = ""
        self._acts_at = math.inf

    def begin(self, now: float) -> None:
        """Begin to look at the interlocks, every interval from `now` on."""
        self._next_look = now + self._interval

    def promise(self, seconds: float, why: str) -> None:
        """Take the promise that each request is followed by the next one within so many seconds.

        It binds the bench from the first one on, also while nothing is on yet: the rig is not free meanwhile.

        Raises ValueError if that is no time.
        """
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f"a promise of {seconds} s; expected a time, s")
        self._promised, self._why, self._is_bound = seconds, why, True

    def arm(self) -> None:
        """Note that an output may be on from now on."""
        if not self.over:
            self._is_bound = True

    def request(self, now: float) -> None:
        """Begin with a request of the bench.

        Raises what tripped the station, or a promise that was broken before the request came.
        """
        self.advance(now)
        self.raise_if_over()
        self._asked = True

    def raise_if_over(self) -> None:
        """Raise what tripped the station, or that the run has ended."""
        if self.over:
            raise self.cause or GuardianError("the run has ended already")

    def reply(self, now: float) -> None:
        """End a request of the bench: its promise counts from here."""
        self._asked = False
        self._lease_end = now + self._promised

    def due(self) -> float:
        """Return when there is something to do next: a look, or the end of the promise."""
        if self.over:
            return math.inf
        # Plain comparisons: this is asked with each sample of a fast loop.
        due = self._next_look if self._next_look < self._acts_at else self._acts_at
        if self._is_bound and not self._asked and self._lease_end < due:
            due = self._lease_end
        return due

    def look_due(self, now: float) -> bool:
        """Return whether the interlocks have to be looked at; the next look is an interval later then."""
        if self.over or now < min(self._next_look, self._acts_at):
            return False
        self._acts_at = math.inf
        if now < self._next_look:
            return True
        # Looks that were missed are not made up for.
        missed = math.floor((now - self._next_look) / self._interval)
        self._next_look += self._interval * (1 + missed)
        return True

    def advance(self, now: float) -> None:
        """Trip if the bench has broken its promise."""
        if not self.over and self.is_late(now):
            self.late = True
            self.trip(GuardianError(self.lateness))

    def is_late(self, now: float) -> bool:
        """Return whether the bench owes a request that it has promised, also after the station has tripped."""
        # While a request is carried out the bench waits, and cannot be late.
        return self._is_bound and not self._asked and self._lease_end <= now

    @property
    def lateness(self) -> str:
        """What is said of a bench that is late."""
        return f"the bench hung: it has not come back within the {self._promised:g} s that it promised ({self._why})"

    def judge(
        self,
        t: float,
        values: Mapping[str, float],
        setpoints: Mapping[str, float] | None = None,
        *,
        now: float | None = None,
        factor: float = 1.0,
    ) -> tuple[InterlockFinding, ...]:
        """Judge readings by the interlocks; trip if one acts.

        Parameters
        ----------
        t : float
            Laboratory time, s.
        values : mapping of str to float
            Readings by signal name.
        setpoints : mapping of str to float, optional
            Set-points by device, nan for an output that is off; without them those among the values count.
        now : float, optional
            The caller's own time, s, if that is not the laboratory's.
        factor : float
            Laboratory seconds in a second of the caller's time.

        Returns
        -------
        tuple of InterlockFinding
            What begins and what is over, below the level `safe`.
        """
        # The samples of a block are judged after it, when a look may have come in between.
        t = t if self._seen is None else max(t, self._seen)
        self._seen = t
        if self.over:
            return ()
        try:
            findings = self._watch.check(t, values, setpoints)
        except InterlockError as error:
            self.trip(error)
            return ()
        if (due := self._watch.due) == math.inf:
            self._acts_at = math.inf
        else:
            acts_at = (t if now is None else now) + (self._watch.due_after(t) - t) / factor
            # One in the past waits for a signal that this look has not seen, and whose own may still have to begin.
            self._acts_at = acts_at if due > t else min(self._acts_at, acts_at)
        if findings:
            self.holding = any(each.level is Level.HOLD for each in self._watch.active)
            for each in findings:
                if each.level is Level.PAUSE and not each.over:
                    self.pause = each.text
        return findings

    def trip(self, cause: BenchError) -> None:
        """End the run in the safe state; the first cause counts."""
        if not self.over:
            self.over, self.cause = True, cause

    def end(self) -> None:
        """End the run in the safe state, as the bench asks for it."""
        self.over = True
        # It need not come back.
        self._is_bound = False
