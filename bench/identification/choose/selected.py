"""What the choice of a model tried and chose, and what its errors warn of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from bench.identification.choose.evaluation import Evaluation

FEW_REVERSALS = 4
"""Turns of the input that say nothing of its minor loops."""

# Part of the variance of the errors that a trend over the rows must be, to be no chance of neighbouring errors.
_DRIFTS = 0.15
# Ratio of the two held-out errors from which the record is said to tell little of other inputs.
_WARNED = 3.0


class Trend(NamedTuple):
    """A straight line through errors over rows.

    Attributes
    ----------
    change : float
        From the first to the last row, output units.
    share : float
        Part of the variance of the errors, 0 to 1.
    """

    change: float
    share: float

    @property
    def drifts(self) -> bool:
        """Whether it is more than neighbouring errors that are alike by chance: 15 % of the variance."""
        return self.share > _DRIFTS


@dataclass(frozen=True)
class Selection:
    """What was tried, and what was chosen.

    Attributes
    ----------
    evaluations : tuple of Evaluation
        The best of each structure first, by their error; those given up and those that failed last.
    best : Evaluation
        That of the least held-out error.
    chosen : Evaluation
        The simplest within one standard error of it, or by the fit to all rows: where its residuals are uncorrelated,
        of few rows, of one kind of cycle, and of lags at one rate.
    gap : int
        Rows left out next to each block.
    rows : int
        Rows that were fitted and tested.
    span : float
        Range of their outputs, output units.
    has_one_kind : bool
        Whether the input has one kind of cycle only.
    reversals : int or None
        How often the input turns back, by 2 % of its range or more.
    trend : Trend or None
        That of the errors of the chosen model, if it is one without time.
    has_times : bool
        Whether models with time took part.
    is_time_asked : bool
        Whether they did as the others; see `Given`.
    has_one_rate : bool
        Whether times are known and the input moves at one speed only.
    is_swept_once : bool
        Whether the input hardly goes both ways.
    """

    evaluations: tuple[Evaluation, ...]
    best: Evaluation
    chosen: Evaluation
    gap: int
    rows: int
    span: float
    has_one_kind: bool = False
    reversals: int | None = None
    trend: Trend | None = None
    has_times: bool = False
    is_time_asked: bool = True
    has_one_rate: bool = False
    is_swept_once: bool = False

    def warnings(self) -> list[str]:
        """Return what the held-out errors say against the chosen model, in sentences."""
        found = []
        chosen = self.chosen
        if self.reversals is not None and self.reversals < FEW_REVERSALS:
            found.append(
                f"the input {_reverses(self.reversals)}, which tells little of hysteresis: "
                "record more cycles, of several amplitudes, as `bench design` proposes"
            )
        if self.trend is not None and self.trend.drifts:
            part = 100.0 * abs(self.trend.change) / self.span
            remedy = (
                "no model with drift or creep does better on rows left out; --model hammerstein --dynamics drift "
                "has the drift in any case"
                if self.has_times
                else "give --time COLUMN, so that models with drift and creep take part"
            )
            found.append(
                f"the errors drift by {part:.2g} % of the range from the first to the last row "
                f"({self.trend.share:.0%} of their variance): {remedy}"
            )
        if self.has_one_rate:
            found.append(
                "the input always moves at about one speed, at which a lag can hardly be told from hysteresis: "
                "errors at other rates are unknown; record slower and faster cycles"
            )
        if not chosen.units and self.has_one_kind:
            preferred = (
                "planes with the greatest smoothing" if self.is_swept_once else "models that the record determines"
            )
            found.append(
                "the input does not vary its amplitude, so that the error on inputs of other amplitudes is unknown; "
                f"{preferred} were preferred: record smaller cycles too, as `bench design` proposes"
            )
        elif not chosen.units:
            found.append(
                "the record is too short to leave whole cycles out, so that the error on other inputs is unknown: "
                "record more cycles, as `bench design` proposes"
            )
        elif chosen.units_rms > _WARNED * chosen.rms:
            found.append(
                f"the error with whole cycles left out is {chosen.units_rms / chosen.rms:.1f} times that with blocks "
                "left out: expect it on inputs unlike the record, and record more kinds of cycles"
            )
        return found


def _reverses(number: int) -> str:
    if number == 0:
        return "never reverses"
    return "reverses only " + ("once" if number == 1 else f"{number} times")
