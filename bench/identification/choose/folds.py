"""Parts of a measured sequence that are left out of a fit and predicted: blocks of rows, and units of the excitation.

The input record is never cut: it drives the memory through all rows in every fold. What is left out are residuals.
Rows next to those left out are neither fitted nor tested, as errors of neighbouring rows are alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats
from bench.identification.branches import turning_points

Flags = NDArray[np.bool_]

# Moves below this part of the range are noise, and reversal points closer than the second part are the same.
_LEAST_MOVE = 0.02
_SAME = 0.05
# Branches that span this part of the range form the major loop: what they sweep is swept nowhere else.
_MAJOR = 0.9

REACHED = 0.95
"""Part of a range from which rows reach it."""


@dataclass(frozen=True, eq=False)
class Fold:
    """One division of the rows; rows in neither part are between the two, or were never to be fitted.

    Attributes
    ----------
    tested : ndarray of bool, shape (N,)
        Rows left out of the fit and predicted.
    trained : ndarray of bool, shape (N,)
        Rows of the fit.
    """

    tested: Flags
    trained: Flags


def fold_numbers(rows: int, folds: int, blocks: int) -> NDArray[np.int64]:
    """Return the fold of each row, shape (rows,): rows form successive blocks, and block b is in fold b mod folds."""
    return np.asarray((np.arange(rows) * blocks // rows) % folds, dtype=np.int64)


def near(chosen: Flags, distance: int) -> Flags:
    """Return which rows are chosen, or no further than `distance` rows from one that is, shape (N,)."""
    count = np.concatenate([[0], np.cumsum(chosen)])
    rows = np.arange(chosen.size)
    return np.asarray(
        count[np.minimum(rows + distance + 1, chosen.size)] > count[np.maximum(rows - distance, 0)], dtype=bool
    )


def block_folds(usable: Flags, *, folds: int = 5, blocks: int = 20, gap: int = 0) -> tuple[Fold, ...]:
    """Return folds of contiguous blocks of rows with gaps around them.

    Parameters
    ----------
    usable : ndarray of bool, shape (N,)
        Rows that may be fitted and tested.
    folds : int
        Number of folds, >= 2.
    blocks : int
        Number of blocks, >= folds; block b belongs to fold b modulo `folds`.
    gap : int
        Rows on either side of a block that are left out of the fit as well.
    """
    number = np.full(usable.size, -1)
    number[usable] = fold_numbers(int(usable.sum()), folds, blocks)
    return tuple(_fold(number == k, usable, gap) for k in range(folds))


def with_reach(fold: Fold, inputs: Floats, gap: int = 0) -> Fold:
    """Return a fold whose fit has the rows beyond the inputs that it reaches otherwise; as it is if these lack < 5 %.

    Beyond them an equation is extrapolated, and its memory carries the error on; the fit to all rows knows them. They
    are not tested then, nor are `gap` rows next to them. If that leaves fewer than half, the record hardly says what
    it does there, and the fold is as it was: it tests that.
    """
    if not fold.trained.any():
        return fold
    reached = inputs[fold.trained]
    if np.ptp(reached) >= REACHED * np.ptp(inputs[fold.trained | fold.tested]):
        return fold
    beyond = fold.tested & ((inputs < reached.min()) | (inputs > reached.max()))
    tested = fold.tested & ~near(beyond, gap)
    return Fold(tested, fold.trained | beyond) if 2 * tested.sum() >= fold.tested.sum() else fold


def unit_folds(inputs: Floats, usable: Flags, *, folds: int = 5, gap: int = 0) -> tuple[Fold, ...]:
    """Return folds of whole units of the excitation; none if it has fewer than two kinds beside its major loop.

    A unit is what the input does between the same two turning points, however often and in either direction:
    a cycle that is repeated, all cycles of one amplitude, a first-order reversal curve. Units in order of their
    amplitude are dealt out to the folds, so that each fold lacks some of all sizes. The major loop stays in every
    fit: a plane that is swept nowhere else is not known without it.

    Parameters
    ----------
    inputs : ndarray, shape (N,)
        The inputs.
    usable : ndarray of bool, shape (N,)
        Rows that may be fitted and tested.
    folds : int
        Number of folds, >= 2, or of units if these are fewer.
    gap : int
        Rows next to those left out that are left out of the fit as well.
    """
    unit, amplitudes = excitation_units(inputs)
    present = _minor_units(inputs, usable, unit, amplitudes)
    if present.size < 2:
        return ()
    number = np.full(amplitudes.size, -1)
    count = min(folds, present.size)
    number[present[np.argsort(-amplitudes[present], kind="stable")]] = np.arange(present.size) % count
    made = tuple(_fold((number[unit] == k) & usable, usable, gap) for k in range(count))
    # A fit needs rows: of short branches the gaps may take all.
    return made if all(fold.trained.sum() >= 0.3 * usable.sum() for fold in made) else ()


def has_one_kind(inputs: Floats, usable: Flags) -> bool:
    """Return whether the input has fewer than two kinds of cycles beside its major loop; see `unit_folds`."""
    return _minor_units(inputs, usable, *excitation_units(inputs)).size < 2


def _minor_units(inputs: Floats, usable: Flags, unit: NDArray[np.int64], amplitudes: Floats) -> NDArray[np.intp]:
    counted = np.bincount(unit[usable], minlength=amplitudes.size) > 0
    return np.flatnonzero((amplitudes < _MAJOR * float(np.ptp(inputs))) & counted)


def excitation_units(inputs: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the unit of each row, shape (N,), and the amplitude of each unit, input units; see `unit_folds`."""
    span = float(np.ptp(inputs))
    turns = turning_points(inputs, _LEAST_MOVE * span)
    if turns.size < 2:
        return np.zeros(inputs.size, dtype=np.int64), np.zeros(1)
    ends = np.sort(np.column_stack([inputs[turns[:-1]], inputs[turns[1:]]]), axis=1)
    low = float(inputs.min())
    keys = np.round((ends - low) / (_SAME * span)).astype(np.int64)
    kinds, kind = np.unique(keys, axis=0, return_inverse=True)
    amplitudes = (kinds[:, 1] - kinds[:, 0]) * _SAME * span
    branch = np.clip(np.searchsorted(turns, np.arange(inputs.size), side="left") - 1, 0, turns.size - 2)
    return np.asarray(kind.ravel()[branch], dtype=np.int64), np.asarray(amplitudes, dtype=np.float64)


def correlated_rows(residuals: Floats, most: int) -> int:
    """Return the lag from which residuals are no longer correlated: below 2/√N, at most `most` rows."""
    centred = residuals - residuals.mean()
    power = float(centred @ centred)
    if power <= 0.0:
        return 0
    limit = 2.0 / np.sqrt(centred.size)
    for lag in range(1, most):
        if centred[:-lag] @ centred[lag:] < limit * power:
            return lag
    return most


def _fold(tested: Flags, usable: Flags, gap: int) -> Fold:
    return Fold(tested, usable & ~near(tested, gap))
