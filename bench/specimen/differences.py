"""The errors of a model in one run: their differences from reading to reading, by the slope of the response."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from bench.analysis import TransientRecording
from bench.base import Floats

SLOPES = 3
"""Classes of readings by slope, of equal numbers."""
_FEWEST_HOLDS = 30
"""Set-points of a run whose error says something of other histories."""
_FEWEST = 12
"""Fewest numbers whose mean square counts."""


def least_known(recordings: Sequence[TransientRecording], of_model: Sequence[Floats]) -> int | None:
    """Return the run that the model knows least, of those that say something of other histories; None if none does.

    Parameters
    ----------
    recordings : sequence of TransientRecording
        The runs.
    of_model : sequence of ndarray
        Errors of the model at the readings of each, output units.
    """
    long = [i for i, each in enumerate(recordings) if np.unique(each.setpoints).size >= _FEWEST_HOLDS]
    return max(long, key=lambda i: float(np.std(of_model[i])), default=None)


class Differences:
    """Mean squares of the differences of numbers at two readings of a run, by gap and slope; nan of too few.

    Parameters
    ----------
    slopes : ndarray, shape (readings,)
        By how much the response depends on the drive at each reading.
    gaps : sequence of int
        Readings from one to the other of a pair.
    """

    def __init__(self, slopes: Floats, gaps: Sequence[int]) -> None:
        self._classes = np.searchsorted(np.quantile(slopes, np.arange(1, SLOPES) / SLOPES), slopes)
        self._gaps = gaps

    def counts(self) -> Floats:
        """Return the number of pairs, shape (gaps, slopes)."""
        counts = np.zeros((len(self._gaps), SLOPES))
        for number, slope, first in self._pairs():
            counts[number, slope] = first.size
        return counts

    def squares(self, values: Floats) -> Floats:
        """Return the mean squares of differences of numbers, one a reading; shape (gaps, slopes)."""
        squares = np.full((len(self._gaps), SLOPES), np.nan)
        for number, slope, first in self._pairs():
            if first.size >= _FEWEST:
                squares[number, slope] = float(np.mean((values[first + self._gaps[number]] - values[first]) ** 2))
        return squares

    def variances(self, values: Floats) -> Floats:
        """Return the variances of numbers, one a reading; shape (slopes,)."""
        members = (values[self._classes == slope] for slope in range(SLOPES))
        return np.array([float(np.var(each)) if each.size >= _FEWEST else np.nan for each in members])

    def _pairs(self) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
        """Yield number of the gap, class of the slope, and the first readings of the pairs."""
        for number, gap in enumerate(self._gaps):
            for slope in range(SLOPES):
                yield number, slope, np.flatnonzero(self._classes[:-gap] == slope)
