"""Advice on a model: what its record cannot decide, what is odd about it, and what to do instead."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats
from bench.identification.branches import turns_beyond_noise
from bench.identification.choose.splits import has_one_kind

ONE_RUN = "one-run"
"""Code of the advice that holds for every record of one run."""
FEW_REVERSALS = "few-reversals"
"""Code of the advice on a record that tells little of hysteresis."""

# Reversals of one closed minor loop within a major one: fewer show no minor loop.
# Source: two turns of the major loop and two of the minor one.
_FEWEST_REVERSALS = 4
# Ratio of two speeds below which they are one rate. Source: a lag of less than a hundredth of a move shows by less
# than its noise of 1 % if speeds differ by less than twice.
_ONE_RATE = 2.0


@dataclass(frozen=True)
class Advice:
    """What a record cannot decide, or what is odd about it or its fit.

    Attributes
    ----------
    code : str
        For programs, such as `few-reversals`; of the same kind at most one is told.
    text : str
        The unknown, as a sentence without a full stop.
    remedy : str
        What to record or to try instead; empty if nothing is left to try.
    """

    code: str
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.text}: {self.remedy}" if self.remedy else self.text


def advise_on_record(
    inputs: Floats, times: Floats | None, runs: int, fitted: NDArray[np.bool_] | None = None
) -> Iterator[Advice]:
    """Yield what a record cannot decide of any model.

    Parameters
    ----------
    inputs : ndarray, shape (N,)
        Input units.
    times : ndarray, shape (N,), or None
        s; None if they are not known.
    runs : int
        Number of runs that the rows are of.
    fitted : ndarray of bool, shape (N,), or None
        Rows that are fitted; all if None.
    """
    turns = turns_beyond_noise(inputs)
    reversals = max(turns.size - 2, 0)
    if reversals < _FEWEST_REVERSALS:
        times_of = ("never reverses", "reverses once")[reversals] if reversals < 2 else f"reverses {reversals} times"
        yield Advice(
            FEW_REVERSALS,
            f"the input {times_of}, which tells little of hysteresis",
            "record more cycles, of several amplitudes, as `bench model design` proposes",
        )
    elif has_one_kind(inputs, np.ones(inputs.size, dtype=bool) if fitted is None else fitted):
        yield Advice(
            "one-kind",
            "the input does not vary its amplitude, so that the error on other cycles is unknown",
            "record smaller cycles too, as `bench model design` proposes",
        )
    if times is not None and turns.size > 1:
        speeds = np.abs(np.diff(inputs[turns])) / np.diff(times[turns])
        slow, fast = np.quantile(speeds, (0.1, 0.9))
        if fast <= _ONE_RATE * slow:
            yield Advice(
                "one-rate",
                "the input moves at about one speed, at which a lag can hardly be told from hysteresis, so that "
                "errors at other rates are unknown",
                "record slower and faster cycles",
            )
    if runs == 1:
        yield Advice(
            ONE_RUN,
            "the rows are of one run, and on another run the errors may be greater",
            "give several runs, each in a file of its own, and whole runs are left out",
        )


def once(advice: Iterable[Advice]) -> tuple[Advice, ...]:
    """Return advice without what was told before: the first of each code."""
    found: dict[str, Advice] = {}
    for one in advice:
        found.setdefault(one.code, one)
    return tuple(found.values())
