"""Advice on a choice: what the record cannot decide, and what to record or to try instead."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.identification.branches import turns_beyond_noise
from bench.identification.choose.score import Measurements, Score

ONE_RUN = "one-run"
"""Code of the advice that holds for every record of one run."""
PLANE = "preisach"
"""The plane with signs, whose answer to other cycles is bounded."""

# Reversals of one closed minor loop within a major one: fewer show no minor loop.
# Source: two turns of the major loop and two of the minor one.
_FEWEST_REVERSALS = 4
# Ratio of two speeds below which they are one rate. Source: a lag of less than a hundredth of a move shows by less
# than its noise of 1 % if speeds differ by less than twice.
_ONE_RATE = 2.0
# Ratio of the error on other cycles to that on blocks from which the record is said to tell little of other inputs.
# Source: measured, 3.4 % against 0.1 % of the range on a specimen that ratchets.
_UNLIKE = 3.0


@dataclass(frozen=True)
class Advice:
    """What the record cannot decide.

    Attributes
    ----------
    code : str
        For programs: `few-reversals`, `one-kind`, `one-rate`, `one-run` or `other-cycles`.
    text : str
        The unknown, as a sentence without a full stop.
    remedy : str
        What to record instead.
    """

    code: str
    text: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.text}: {self.remedy}"


def advise(measured: Measurements, scores: Sequence[Score], chosen: Score, one_kind: bool) -> Iterator[Advice]:
    """Yield what a record cannot decide of a choice.

    Parameters
    ----------
    measured : Measurements
        The data.
    scores : sequence of Score
        Candidates that could be evaluated.
    chosen : Score
        What the rule chose.
    one_kind : bool
        Whether the record has one kind of cycle.
    """
    turns = turns_beyond_noise(measured.inputs)
    reversals = max(turns.size - 2, 0)
    if reversals < _FEWEST_REVERSALS:
        times = ("never reverses", "reverses once")[reversals] if reversals < 2 else f"reverses {reversals} times"
        yield Advice(
            "few-reversals",
            f"the input {times}, which tells little of hysteresis",
            "record more cycles, of several amplitudes, as `bench design` proposes",
        )
    elif one_kind:
        others = {score.candidate.model for score in scores} - {PLANE}
        preferred = ", and planes with signs were preferred" if others and chosen.candidate.model == PLANE else ""
        yield Advice(
            "one-kind",
            f"the input does not vary its amplitude, so that the error on other cycles is unknown{preferred}",
            "record smaller cycles too, as `bench design` proposes",
        )
    elif chosen.cycles_rms > _UNLIKE * chosen.blocks_rms:
        ratio = chosen.cycles_rms / chosen.blocks_rms
        yield Advice(
            "other-cycles",
            f"the error with whole kinds of cycles left out is {ratio:.1f} times that with blocks left out, and to "
            "be expected on inputs unlike the record",
            "record more kinds of cycles",
        )
    if measured.times is not None and turns.size > 1:
        speeds = np.abs(np.diff(measured.inputs[turns])) / np.diff(measured.times[turns])
        slow, fast = np.quantile(speeds, (0.1, 0.9))
        if fast <= _ONE_RATE * slow:
            yield Advice(
                "one-rate",
                "the input moves at about one speed, at which a lag can hardly be told from hysteresis, so that "
                "errors at other rates are unknown",
                "record slower and faster cycles",
            )
    if measured.runs is None:
        yield Advice(
            ONE_RUN,
            "the rows are of one run, and another run may differ by more than the error on blocks",
            "give several runs, each in a file of its own, and whole runs are left out",
        )
