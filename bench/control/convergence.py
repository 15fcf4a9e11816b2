"""Notices a controller that does not converge."""

from __future__ import annotations

import math

SWINGS_OF_A_TARGET = 3
"""Swings that one target asks for at most. Derivation: beyond it, past an end of the transition, and back."""
MOST_SWINGS = 2 * SWINGS_OF_A_TARGET
"""From this swing of the set-point on, with a reference that stands, a controller does not converge.

Derivation: a target may be aimed at twice, by a controller and by the one that takes its place.
"""

_END = 0.25
"""Part of the set-point's range that counts as one of its ends.

Derivation: a swing of half of the range is no correction; the other half lies in equal parts at both ends.
"""


class LimitCycleWatch:
    """Counts how often a set-point swings from one end of its range to the other while the reference stands.

    A controller that was tuned on another specimen can drive the actuator to and fro for ever, with an output that
    stays near its reference on average. A target asks for `SWINGS_OF_A_TARGET` at most.

    Parameters
    ----------
    low, high : float
        Range of the set-point, input units, low < high.
    """

    def __init__(self, low: float, high: float) -> None:
        self._lower = low + _END * (high - low)
        self._upper = high - _END * (high - low)
        self._reference = math.nan
        self._side: int
        self.swings = 0

    def note(self, setpoint: float, reference: float) -> bool:
        """Take the next set-point (input units) and its reference (output units); return whether it cycles.

        A reference of nan is that of a controller without one, which is not judged.
        """
        if reference != self._reference:
            self._reference, self._side, self.swings = reference, 0, 0
            if math.isnan(reference):
                return False
        side = -1 if setpoint < self._lower else 1 if setpoint > self._upper else self._side
        if side * self._side < 0:
            self.swings += 1
        self._side = side
        return self.swings >= MOST_SWINGS
