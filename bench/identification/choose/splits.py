"""Parts of a measured sequence that are left out of a fit and predicted: blocks, whole cycles, and whole runs.

The input record is never cut: it drives the memory through all rows in every fold. What is left out are residuals.
Rows next to those left out are neither fitted nor tested, as errors of neighbouring rows are alike (Racine, Journal
of Econometrics 99, 39, 2000).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats
from bench.identification.branches import turns_beyond_noise

Flags = NDArray[np.bool_]

FOLDS, BLOCKS = 5, 10
"""Folds, and contiguous blocks that are dealt out to them. Source: 5 to 10 folds are usual (Hastie, Tibshirani and
Friedman 2009, section 7.10); two blocks in each test two parts of the record."""
SMOOTHING_BLOCKS = 20
"""The same where the weight of a penalty is chosen. Derivation: four in each fold test four parts of the record."""
GAP = 0.01
"""Part of the rows on either side of a block that is neither fitted nor tested. Source: a choice,
with which a trial on nine files did well."""

# Turning points that are closer than this part of the range are the same. Source: a choice, above `NOISE`.
_SAME = 0.05
MAJOR = 1.0 - 2.0 * _SAME
"""Branches that span this part of the range form the major loop: what they sweep is swept nowhere else. Source: by
`_SAME`, two turning points at the ends of the range."""
# Part of the rows that must be left to fit. Source: a choice.
_LEAST_FITTED = 0.3


@dataclass(frozen=True, eq=False)
class Fold:
    """One division of the rows; rows in neither part are between the two, or were never to be fitted."""

    tested: Flags  # shape (N,); rows left out of the fit and predicted
    trained: Flags  # shape (N,); rows of the fit


def record_of(fitted: ArrayLike) -> slice:
    """Return the rows up to the last of those that are fitted, shape (N,): later ones tell nothing of them."""
    return slice(int(np.flatnonzero(fitted)[-1]) + 1)


def near(chosen: Flags, distance: int) -> Flags:
    """Return which rows are chosen, or no further than `distance` rows from one that is, shape (N,)."""
    count = np.concatenate([[0], np.cumsum(chosen)])
    rows = np.arange(chosen.size)
    return np.asarray(
        count[np.minimum(rows + distance + 1, chosen.size)] > count[np.maximum(rows - distance, 0)], dtype=bool
    )


def block_folds(usable: Flags, *, folds: int = FOLDS, blocks: int = BLOCKS, gap: int = 0) -> tuple[Fold, ...]:
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
    rows = int(usable.sum())
    number[usable] = np.arange(rows) * blocks // rows % folds
    return tuple(_fold(number == k, usable, gap) for k in range(folds))


def run_folds(runs: NDArray[np.int64], usable: Flags) -> tuple[Fold, ...]:
    """Return folds of whole runs; `runs`, shape (N,), is the number of the run of each row."""
    return tuple(_fold((runs == run) & usable, usable, 0) for run in np.unique(runs[usable]))


def cycle_folds(inputs: Floats, usable: Flags, *, gap: int = 0) -> tuple[Fold, ...]:
    """Return folds of whole kinds of cycles; none if there are fewer than two kinds beside the major loop.

    A kind is what the input does between the same two turning points, however often and in either direction: a cycle
    that is repeated, all cycles of one amplitude, a first-order reversal curve. Kinds in order of their amplitude are
    dealt out to the folds, so that each fold lacks some of all sizes. The major loop stays in every fit: a plane that
    is swept nowhere else is not known without it.

    Parameters
    ----------
    inputs : ndarray, shape (N,)
        The inputs.
    usable : ndarray of bool, shape (N,)
        Rows that may be fitted and tested.
    gap : int
        Rows next to those left out that are left out of the fit as well.
    """
    kind, amplitudes = _kinds(inputs)
    present = _minor(inputs, usable, kind, amplitudes)
    if present.size < 2:
        return ()
    number = np.full(amplitudes.size, -1)
    count = min(FOLDS, present.size)
    number[present[np.argsort(-amplitudes[present], kind="stable")]] = np.arange(present.size) % count
    made = tuple(_fold((number[kind] == k) & usable, usable, gap) for k in range(count))
    # Of short branches the gaps may take all.
    return made if all(fold.trained.sum() >= _LEAST_FITTED * usable.sum() for fold in made) else ()


def has_one_kind(inputs: Floats, usable: Flags) -> bool:
    """Return whether the input has no cycle beside its major loop, its first and its last move left out."""
    turns = turns_beyond_noise(inputs)
    rows = np.arange(inputs.size)
    between = (rows > turns[1]) & (rows <= turns[-2]) if turns.size > 3 else np.ones(rows.size, dtype=bool)
    return not _minor(inputs, usable & between, *_kinds(inputs)).size


def _minor(inputs: Floats, usable: Flags, kind: NDArray[np.int64], amplitudes: Floats) -> NDArray[np.intp]:
    counted = np.bincount(kind[usable], minlength=amplitudes.size) > 0
    return np.flatnonzero((amplitudes < MAJOR * float(np.ptp(inputs))) & counted)


def _kinds(inputs: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the kind of cycle of each row, shape (N,), and the amplitude of each kind, input units."""
    span = float(np.ptp(inputs))
    turns = turns_beyond_noise(inputs)
    if turns.size < 2:
        return np.zeros(inputs.size, dtype=np.int64), np.zeros(1)
    ends = np.sort(np.column_stack([inputs[turns[:-1]], inputs[turns[1:]]]), axis=1)
    low = float(inputs.min())
    keys = np.round((ends - low) / (_SAME * span)).astype(np.int64)
    kinds, kind = np.unique(keys, axis=0, return_inverse=True)
    amplitudes = (kinds[:, 1] - kinds[:, 0]) * _SAME * span
    branch = np.clip(np.searchsorted(turns, np.arange(inputs.size), side="left") - 1, 0, turns.size - 2)
    return np.asarray(kind.ravel()[branch], dtype=np.int64), np.asarray(amplitudes, dtype=np.float64)


def _fold(tested: Flags, usable: Flags, gap: int) -> Fold:
    return Fold(tested, usable & ~near(tested, gap))
