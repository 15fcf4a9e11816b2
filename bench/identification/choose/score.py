"""The score of a candidate: how well a model with its settings predicts rows that were left out of its fit."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np
from numpy.typing import NDArray

from bench.base import BenchError, Floats, say_share
from bench.identification.branches import turning_points
from bench.identification.by_name import Candidate, FitProblem, set_up_problem
from bench.identification.choose.splits import (
    BLOCKS,
    GAP,
    MAJOR,
    Flags,
    Fold,
    block_folds,
    cycle_folds,
    record_of,
    run_folds,
)
from bench.identification.fit.least_squares import Fit, one_thread
from bench.identification.fit.orientation import NAMES, Sign, has_orientation
from bench.identification.timed.hammerstein_fit import reshape, set_up_search
from bench.identification.timed.hammerstein_search import COMPARING, Search, find_best
from bench.models import Regressor, overwritten_from

# Turns smaller than this part of the range need not be kept when rows are left out.
# Source: half of the noise of 1 % that turning points are told from, see `splits`.
_LEAST_MOVE = 0.005
# Part of the rows that a memory may take to be known, or all rows are tested. Source: a choice; each
# block of ten then holds a fortieth of the rows at least.
_KNOWN = 0.25
# Part of the rows that may be left out of a fit for their memory. Source: most rows then remain.
_SKIPPED = 0.5
# Relative tolerance of shape parameters of a candidate. Source: far below the tie of two scores, 2 %.
_SHAPE = 1e-3


FAILURES = (BenchError, ValueError, ArithmeticError)
"""Errors by which a fit says that it is not possible; `numpy.linalg.LinAlgError` is a ValueError. Any other is a
mistake in the program."""

SCORING = "scoring"
"""Stage of which `evaluate` says the share that is done."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """What candidates are fitted to.

    Attributes
    ----------
    inputs, outputs : ndarray, shape (N,)
        The measured sequence; all of it drives the memory.
    fitted : ndarray of bool, shape (N,)
        Rows that may be fitted and tested.
    times : ndarray, shape (N,), or None
        s, strictly increasing; None if they are not known.
    runs : ndarray of int, shape (N,), or None
        Number of the run of each row; None of one run.
    known : int
        First row that is tested: before it, outputs may depend on what came before the sequence.
    """

    inputs: Floats
    outputs: Floats
    fitted: Flags
    times: Floats | None = None
    runs: NDArray[np.int64] | None = None
    known: int = 0

    @classmethod
    def of(
        cls,
        inputs: Floats,
        outputs: Floats,
        fitted: Flags | None = None,
        times: Floats | None = None,
        runs: NDArray[np.int64] | None = None,
    ) -> Measurements:
        """Return measurements of which rows are tested from where the inputs have overwritten all memory they do.

        All are tested if that leaves less than a quarter of those that may be fitted, or none that go through the
        range once more: errors on a part of a loop tell nothing of the others. What follows the last of these is left
        away.
        """
        rows = np.ones(inputs.size, dtype=bool) if fitted is None else fitted
        to = record_of(rows)
        inputs, outputs, rows = inputs[to], outputs[to], rows[to]
        until = overwritten_from(inputs)
        later = inputs[until:][rows[until:]]
        is_enough = later.size >= _KNOWN * rows.sum() and np.ptp(later) >= MAJOR * np.ptp(inputs)
        times, runs = None if times is None else times[to], None if runs is None else runs[to]
        return cls(inputs, outputs, rows, times, runs, until if is_enough else 0)

    def thinned(self, most: int) -> Measurements:
        """Return about `most` rows, evenly chosen, and the ends of the range that is fitted.

        Turning points stay as rows that are not fitted: the memory of an operator that does not depend on the rate is
        the same with and without the rows between.
        """
        rows = np.flatnonzero(self.fitted)
        if rows.size <= most:
            return self
        chosen = np.zeros(self.inputs.size, dtype=bool)
        chosen[rows[:: -(-rows.size // most)]] = True
        chosen[rows[[self.inputs[rows].argmin(), self.inputs[rows].argmax()]]] = True
        kept = chosen.copy()
        kept[turning_points(self.inputs, _LEAST_MOVE * float(np.ptp(self.inputs)))] = True
        return Measurements(
            self.inputs[kept],
            self.outputs[kept],
            chosen[kept],
            None if self.times is None else self.times[kept],
            None if self.runs is None else self.runs[kept],
            int(np.count_nonzero(kept[: self.known])),
        )

    @property
    def run_count(self) -> int:
        """Number of runs."""
        return 1 if self.runs is None else np.unique(self.runs).size

    @property
    def tested(self) -> Flags:
        """Rows that may be tested, shape (N,)."""
        return np.asarray(self.fitted & (np.arange(self.inputs.size) >= self.known), dtype=bool)

    @property
    def may_skip(self) -> bool:
        """Whether first rows of unknown memory may be left out of a fit: half of the rows at most."""
        return 0 < int(self.fitted[: self.known].sum()) <= _SKIPPED * int(self.fitted.sum())

    @property
    def gap(self) -> int:
        """Rows next to those tested that are not fitted."""
        return round(GAP * int(self.tested.sum()))

    @cached_property
    def blocks(self) -> tuple[Fold, ...]:
        """The folds of contiguous blocks, or of whole runs if several; first rows are in all fits."""
        tested = self.tested
        if self.runs is not None and np.unique(self.runs[tested]).size > 1:
            return self._with_first_rows(run_folds(self.runs, tested))
        blocks = max(min(BLOCKS, int(tested.sum()) // 2), 2)
        return self._with_first_rows(block_folds(tested, folds=min(5, blocks), blocks=blocks, gap=self.gap))

    @cached_property
    def cycles(self) -> tuple[Fold, ...]:
        """The folds of whole kinds of cycles; none if there is one kind only."""
        return self._with_first_rows(cycle_folds(self.inputs, self.tested, gap=self.gap))

    def _with_first_rows(self, folds: tuple[Fold, ...]) -> tuple[Fold, ...]:
        first = self.fitted & ~self.tested
        return tuple(Fold(fold.tested, fold.trained | first) for fold in folds)


@dataclass(frozen=True)
class Score:
    """How a candidate did.

    Attributes
    ----------
    candidate : Candidate
        What was evaluated, with the orientation and the shape that the fit found.
    blocks, cycles : tuple of float
        Mean squared error of each fold of blocks or runs, and of each fold of kinds of cycles, output units squared.
    training : float
        RMS error of the rows fitted, mean over the folds, output units.
    freedom : float
        Degrees of freedom of the fit, mean over the folds: effective coefficients and nonlinear parameters.
    rows : int
        Rows that were tested.
    seconds : float
        CPU time, s.
    failure : str
        Why it could not be evaluated.
    """

    candidate: Candidate
    blocks: tuple[float, ...] = ()
    cycles: tuple[float, ...] = ()
    training: float = float("nan")
    freedom: float = float("nan")
    rows: int = 0
    seconds: float = 0.0
    failure: str = ""

    @cached_property
    def error(self) -> float:
        """The score, output units: RMS error over what was left out, cycles counting as much as blocks."""
        parts = [float(np.mean(part)) for part in (self.blocks, self.cycles) if part]
        return float(np.sqrt(np.mean(parts))) if parts else float("inf")

    @property
    def blocks_rms(self) -> float:
        """RMS error over blocks or runs left out, output units; infinite if it failed."""
        return float(np.sqrt(np.mean(self.blocks))) if self.blocks else float("inf")

    @property
    def cycles_rms(self) -> float:
        """RMS error over kinds of cycles left out, output units; nan if there is one kind only."""
        return float(np.sqrt(np.mean(self.cycles))) if self.cycles else float("nan")

    @property
    def spread(self) -> float:
        """Standard error of `blocks_rms` from the scatter of the folds, output units."""
        if len(self.blocks) < 2 or not self.blocks_rms > 0.0:
            return float("nan")
        return float(np.std(self.blocks, ddof=1) / np.sqrt(len(self.blocks)) / (2.0 * self.blocks_rms))


def evaluate(measured: Measurements, candidates: Sequence[Candidate], *, reshaped: bool = False) -> list[Score]:
    """Return the scores of candidates.

    Candidates that differ in their penalties alone are set up once, and so is an operator with several dynamics.
    Shape parameters, time constants, the orientation and an estimated memory are found from all rows; coefficients
    are fitted without each fold. If `reshaped`, the shape of a candidate is where the search for a better one starts.
    """
    scores: list[Score] = []
    problems: dict[str, _Problem] = {}
    searches: dict[str, Search] = {}
    for place, candidate in enumerate(candidates):
        begin = time.process_time()
        # The search for what follows an operator depends on its penalties.
        key = repr(candidate if candidate.dynamics else replace(candidate, smoothing=None, ridge=None))
        try:
            with one_thread():
                if key not in problems:
                    problems[key] = (
                        _set_up_in_time(measured, candidate, searches, reshaped=reshaped)
                        if candidate.dynamics
                        else _set_up(measured, candidate, reshaped=reshaped)
                    )
                say = partial(_say, place, len(candidates))
                score = _score(measured, candidate, problems[key], say)
        except FAILURES as error:
            score = Score(candidate, failure=str(error))
        scores.append(replace(score, seconds=time.process_time() - begin))
    return scores


def _say(place: int, count: int, share: float) -> None:
    say_share(SCORING, (place + share) / count)


@dataclass(frozen=True, eq=False)
class _Problem:
    """A candidate set up for fits to some of the rows."""

    found: Candidate  # with the orientation, shape and parameters that all rows suggest
    regressor: Regressor
    # Takes weights, shape (N,), a candidate with the penalties, and a fit to start from.
    fit: Callable[[Floats, Candidate, Fit | None], Fit]
    skip: int
    parameters: int  # number of nonlinear parameters
    first: Fit | None = None  # fit to all rows, if there is one


def _score(measured: Measurements, candidate: Candidate, problem: _Problem, say: Callable[[float], None]) -> Score:
    folds = [*measured.blocks, *measured.cycles]
    errors, training, freedom = [], [], []
    fit = problem.first
    for number, fold in enumerate(folds, start=1):
        weights = fold.trained.astype(np.float64)
        fit = problem.fit(weights, candidate, fit)
        squares = (measured.outputs - fit.bias - problem.regressor.product(fit.coefficients)) ** 2
        errors.append(float(squares[fold.tested].mean()))
        weights[: problem.skip] = 0.0
        training.append(float(np.sqrt(weights @ squares / weights.sum())))
        freedom.append(fit.certificate.effective + problem.parameters)
        say(number / len(folds))
    blocks = len(measured.blocks)
    return Score(
        replace(problem.found, smoothing=candidate.smoothing, ridge=candidate.ridge),
        tuple(errors[:blocks]),
        tuple(errors[blocks:]),
        float(np.mean(training)),
        float(np.mean(freedom)),
        int(measured.tested.sum()),
    )


def _set_up(measured: Measurements, candidate: Candidate, *, reshaped: bool) -> _Problem:
    problem = set_up_problem(candidate, measured.inputs, measured.outputs, measured.fitted.astype(np.float64))
    _check_skipped(measured, problem)
    if reshaped and candidate.shape:
        problem = problem.with_best_shape(candidate.smoothing or 0.0, [candidate.shape])
    # Those that are not given are found from all rows.
    chosen = cache(problem.regularization)

    def fit(weights: Floats, one: Candidate, start: Fit | None) -> Fit:
        penalties = chosen(one.smoothing, one.ridge)
        return problem.fit(penalties.smoothing, weights, penalties.ridge, start)

    found = _found(candidate, problem, problem.orientation)
    count, first = problem.template.count_beside_coefficients(), problem.known[1] if problem.known else None
    return _Problem(found, problem.regressor, fit, problem.skip, count, first)


def _set_up_in_time(
    measured: Measurements, candidate: Candidate, searches: dict[str, Search], *, reshaped: bool
) -> _Problem:
    assert measured.times is not None
    static = repr(replace(candidate, dynamics="", parameters={}))
    if static not in searches:
        weights = measured.fitted.astype(np.float64)
        searches[static] = set_up_search(candidate, measured.times, measured.inputs, measured.outputs, weights)
    search = searches[static]
    _check_skipped(measured, search.static)
    elements = tuple(candidate.dynamics.split(","))
    found = find_best(search, elements, candidate.parameters, rounds=1, stage=COMPARING)
    if reshaped or not candidate.shape:
        search, found = reshape(search, found, _SHAPE)
    responses, sign = search.responses(found.elements, found.values), search.sign(found.fit)

    def fit(weights: Floats, one: Candidate, start: Fit | None) -> Fit:
        return search.fit(responses, sign, weights, one.smoothing, start)

    best = replace(_found(candidate, search.static, sign), parameters=search.named(found))
    count = found.values.size + search.static.template.count_beside_coefficients()
    return _Problem(best, responses.regressor, fit, search.static.skip, count, found.fit)


def _found(candidate: Candidate, problem: FitProblem, sign: Sign) -> Candidate:
    """Return a candidate with the orientation and the shape that were found."""
    orientation = NAMES[sign] if has_orientation(problem.spec, problem.template) else "auto"
    return replace(candidate, orientation=orientation, shape=tuple(problem.template.shape_parameters().values))


def _check_skipped(measured: Measurements, problem: FitProblem) -> None:
    """Raise ValueError if rows that are tested depend on what came before the record."""
    if problem.skip > measured.known:
        raise ValueError(f"its memory is unknown until row {problem.skip}: too few rows are left")
