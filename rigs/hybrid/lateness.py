"""How late a sensor answers an actuator, from a square wave while the reference rests."""

from __future__ import annotations

import math

import numpy as np

from bench.control import Reference

BEGIN = 1.0
"""Time from the start at which the wave begins, s."""
_HALF = 0.1
"""Length of each half wave, s."""
_WAVES = 2
_LONGEST = 0.08
"""Longest lateness that is looked for, s."""
END = BEGIN + 2 * _WAVES * _HALF + _LONGEST
"""Time from the start at which the last answer has come, s."""
_PARTS = 4
"""Latenesses that are tried in a period."""
_AT_REST = 0.5
"""Part of the height by which a reference that rests may move until the end."""
_ANSWERS = 0.2, 5.0
"""Least and greatest answer to the wave that counts as one, as a part of it."""


class LatenessProbe:
    """A square wave on a set-point, and how late the reading follows it.

    A pure delay within a period of the samples cannot be told from none.

    Parameters
    ----------
    height : float
        Of the wave, either sign, output units.
    period : float
        Time between two samples, s.
    """

    def __init__(self, height: float, period: float) -> None:
        self._height = height
        self._period = period
        self._sent: list[float] = []
        self._errors: list[float] = []

    def fits(self, reference: Reference) -> bool:
        """Return whether a reference rests while the wave is on, and the samples are fast enough for it."""
        times = np.linspace(BEGIN, END, 9).tolist()
        places = [reference(t) for t in times]
        return max(places) - min(places) < _AT_REST * self._height and self._period < 0.25 * _HALF

    def wave(self, t: float) -> float:
        """Return what is added at a time from the start, s; output units."""
        half = math.floor((t - BEGIN) / _HALF)
        if not 0 <= half < 2 * _WAVES:
            return 0.0
        return -self._height if half % 2 else self._height

    def note(self, sent: float, error: float) -> None:
        """Take what was added to the set-point of a sample, and the reading before it less its reference."""
        self._sent.append(sent)
        self._errors.append(error)

    def lateness(self) -> float:
        """Return by how much the readings are late, s; nan if they do not follow the wave."""
        errors = np.array(self._errors)
        count = errors.size
        places = np.arange(count, dtype=np.float64)
        trend = np.vander(places / count, 3)
        best, found = math.inf, math.nan
        for tried in range(round(_LONGEST / self._period) * _PARTS + 1):
            # A reading follows what was sent a sample before it.
            shifted = np.interp(places - 1.0 - tried / _PARTS, places, self._sent, left=0.0)
            design = np.column_stack([trend, shifted])
            fitted = np.linalg.lstsq(design, errors, rcond=None)[0]
            left = float(np.sum((errors - design @ fitted) ** 2))
            if left < best:
                best = left
                found = tried / _PARTS * self._period if _ANSWERS[0] < fitted[-1] < _ANSWERS[1] else math.nan
        return found
