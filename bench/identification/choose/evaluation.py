"""Held-out errors of one candidate: how well a model with its settings predicts what was left out of its fit."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from bench.base import Floats
from bench.identification.branches import turning_points
from bench.identification.by_name import FitProblem, Initial, set_up_problem
from bench.identification.choose.folds import (
    REACHED,
    Flags,
    Fold,
    block_folds,
    correlated_rows,
    unit_folds,
    with_reach,
)
from bench.identification.fit.least_squares import Fit
from bench.identification.fit.orientation import Orientation
from bench.identification.fit.resolution import resolve
from bench.models import PolynomialPlays

# Turns smaller than this part of the range need not be kept when rows are left out.
_LEAST_MOVE = 0.005
# Moves from this part of the range on make cycles.
_LEAST_CYCLE = 0.02
# Rows that are enough to test models by, even if they are less than half of all.
_MANY_ROWS = 300
# Rank of the regressor by coefficients, from which the data determine a model.
_DETERMINED = 0.9
# Part of the travel of an output on smaller cycles that may be against the input's beyond what the record's is.
_RETREAT = 0.01
# Part of the output's range that smaller cycles may go beyond it: those of a stable equation hardly do.
_BEYOND = 0.25


@dataclass(frozen=True)
class Candidate:
    """A model and the settings of its identification.

    Attributes
    ----------
    model : str
        Name in `bench.models`.
    options : mapping of str to object
        Options of the model, as `identify` takes them.
    orientation : str
        Whether the output rises or falls with the input; `auto` of a model without signs.
    initial : str or None
        Memory before the first sample, as `identify` takes it.
    smoothing : float or None
        Weight of the roughness penalty; None leaves it, and that of the size, to the fit of a density of either sign.
    static : str or None
        Of a model with time, the name of the operator that it is without time.
    """

    model: str
    options: Mapping[str, Any] = field(default_factory=dict)
    orientation: Orientation = "rising"
    initial: Initial | None = None
    smoothing: float | None = 0.0
    static: str | None = None

    @property
    def operator(self) -> str:
        """Name of the operator, also of a model with time."""
        return self.static or self.model

    @property
    def name(self) -> str:
        """The same text of all candidates that are equal."""
        return repr(replace(self, options=dict(sorted(self.options.items()))))


@dataclass(frozen=True, eq=False)
class Measurements:
    """What candidates are fitted to.

    Attributes
    ----------
    inputs, outputs : ndarray, shape (N,)
        The measured sequence; all of it drives the memory.
    fitted : ndarray of bool, shape (N,)
        Rows that may be fitted and tested.
    known : int
        First row that is tested: before it, outputs may depend on what came before the sequence.
    gap : int
        Rows next to those tested that are not fitted.
    """

    inputs: Floats
    outputs: Floats
    fitted: Flags
    known: int = 0
    gap: int = 0

    @classmethod
    def of(cls, inputs: Floats, outputs: Floats, fitted: Flags | None = None) -> Measurements:
        """Return measurements of which rows are tested from where the inputs have overwritten all memory they do.

        If that takes more than half of the rows, or of many rows more than three quarters, all are tested.
        """
        span = float(inputs.min()), float(inputs.max())
        until = PolynomialPlays(np.zeros(1), np.ones(1), np.zeros(1), span).unknown_until(inputs)
        rows = np.ones(inputs.size, dtype=bool) if fitted is None else fitted
        left = inputs.size - until
        is_enough = left >= inputs.size // 2 or (left >= inputs.size // 4 and left >= _MANY_ROWS)
        return cls(inputs, outputs, rows, until if is_enough else 0)

    def thinned(self, most: int) -> Measurements:
        """Return about `most` rows, evenly chosen; turning points stay as rows that are not fitted.

        The memory of an operator that does not depend on the rate is the same with and without the rows between.
        """
        if self.inputs.size <= most:
            return self
        chosen = np.zeros(self.inputs.size, dtype=bool)
        chosen[:: -(-self.inputs.size // most)] = True
        kept = chosen.copy()
        kept[turning_points(self.inputs, _LEAST_MOVE * float(np.ptp(self.inputs)))] = True
        known = int(np.count_nonzero(kept[: self.known]))
        return Measurements(self.inputs[kept], self.outputs[kept], (self.fitted & chosen)[kept], known, self.gap)

    @property
    def tested(self) -> Flags:
        """Rows that may be tested, shape (N,)."""
        return np.asarray(self.fitted & (np.arange(self.inputs.size) >= self.known), dtype=bool)

    def covers_its_range(self, part: float = REACHED) -> bool:
        """Return whether the rows that are tested reach the inputs that all fitted ones do, to 5 % of the range."""
        tested = self.inputs[self.tested]
        return bool(tested.size and np.ptp(tested) >= part * np.ptp(self.inputs[self.fitted]))

    def blocks(self) -> tuple[Fold, ...]:
        """Return the folds of contiguous blocks of a cycle or more; rows before `known` are in every fit.

        So are inputs that one fold alone reaches; see `with_reach`.
        """
        folds = block_folds(self.tested, blocks=self.count_of_blocks, gap=self.gap)
        return self._with_first_rows(tuple(with_reach(fold, self.inputs, self.gap) for fold in folds))

    @property
    def count_of_blocks(self) -> int:
        """Number of blocks, 5 to 20: of a part of a cycle the rest of it would tell too much."""
        moves = turning_points(self.inputs, _LEAST_CYCLE * float(np.ptp(self.inputs))).size - 1
        return min(max(moves // 2, 5), 20, max(int(self.tested.sum()), 5))

    def units(self) -> tuple[Fold, ...]:
        """Return the folds of whole excitation units; none if there is one kind only."""
        return self._with_first_rows(unit_folds(self.inputs, self.tested, gap=self.gap))

    def _with_first_rows(self, folds: tuple[Fold, ...]) -> tuple[Fold, ...]:
        first = self.fitted & ~self.tested
        return tuple(Fold(fold.tested, fold.trained | first) for fold in folds)


@dataclass(frozen=True)
class Evaluation:
    """How a candidate did.

    Attributes
    ----------
    candidate : Candidate
        What was evaluated.
    blocks : tuple of float
        Mean squared error of each block fold, output units squared; fewer than there are if it was stopped early.
    units : tuple of float
        That of each fold of excitation units.
    training : float
        RMS error of the rows fitted, mean over the folds, output units.
    start : float
        RMS error of the rows before the first that is tested, output units; 0 if there are none.
    free : float
        Coefficients that the data determine, mean over the folds: the rank of the passive set, less with smoothing.
    seconds : float
        CPU time, s.
    failure : str
        Why it could not be evaluated.
    determined : bool
        Whether the rows determine all coefficients; known only where there is one kind of cycle.
    follows : bool
        Whether the output follows the input on smaller cycles as on the record; known only there.
    misfit : float
        RMS error of a fit to all rows, corrected for its free coefficients, output units; see `corrected`. Known
        only where units were left out, of models with time, and near the best where there is one kind of cycle.
    akaike : float
        The corrected criterion of Akaike of that fit; see `akaike`.
    uncorrelated : bool
        Whether the residuals of that fit are uncorrelated from row to row; False where it is not known.
    shape : tuple of float
        Shape parameters of the operator that the fit to all rows found; empty if it has none, or if it has times.
    """

    candidate: Candidate
    blocks: tuple[float, ...] = ()
    units: tuple[float, ...] = ()
    training: float = float("nan")
    start: float = 0.0
    free: float = float("nan")
    seconds: float = 0.0
    failure: str = ""
    determined: bool = True
    follows: bool = True
    misfit: float = float("nan")
    akaike: float = float("nan")
    uncorrelated: bool = False
    shape: tuple[float, ...] = ()

    @property
    def rms(self) -> float:
        """RMS error over blocks left out, output units; infinite if none was."""
        return float(np.sqrt(np.mean(self.blocks))) if self.blocks else float("inf")

    @property
    def spread(self) -> float:
        """Standard error of `rms` from the scatter of the folds, output units."""
        if len(self.blocks) < 2 or not self.rms > 0.0:
            return float("nan")
        return float(np.std(self.blocks, ddof=1) / np.sqrt(len(self.blocks)) / (2.0 * self.rms))

    @property
    def units_rms(self) -> float:
        """RMS error over excitation units left out, output units; nan if they were not."""
        return float(np.sqrt(np.mean(self.units))) if self.units else float("nan")


def evaluate(
    measured: Measurements,
    candidates: Sequence[Candidate],
    *,
    most_folds: int | None = None,
    hopeless: float = float("inf"),
    shapes: Mapping[str, tuple[float, ...]] | None = None,
) -> list[Evaluation]:
    """Return how candidates do; a task that can be sent to a worker process.

    Parameters
    ----------
    measured : Measurements
        The data.
    candidates : sequence of Candidate
        What is evaluated, one after another.
    most_folds : int or None
        Number of block folds; all if None.
    hopeless : float
        RMS error, output units, above which a candidate is given up after two folds.
    shapes : mapping of str to tuple of float, optional
        Shape parameters of candidates that were fitted to the same rows before, by their `name`.
    """
    blocks = measured.blocks()[:most_folds]
    known = shapes or {}
    return [_evaluate(measured, each, blocks, hopeless, known.get(each.name, ())) for each in candidates]


def _evaluate(
    measured: Measurements, candidate: Candidate, blocks: Sequence[Fold], hopeless: float, shape: tuple[float, ...]
) -> Evaluation:
    begin = time.process_time()
    try:
        trial = _Trial(measured, candidate, shape)
        done = [trial.leave_out(fold) for fold in blocks[:2]]
        if np.sqrt(np.mean([each.tested for each in done])) <= hopeless:
            done += [trial.leave_out(fold) for fold in blocks[2:]]
    # A model of another package must not end the comparison of the others.
    except Exception as error:
        return _failed(candidate, error, begin)
    return Evaluation(
        candidate,
        blocks=tuple(each.tested for each in done),
        training=float(np.mean([each.training for each in done])),
        start=float(np.mean([each.start for each in done])),
        free=float(np.mean([each.free for each in done])),
        seconds=time.process_time() - begin,
        shape=trial.shape,
    )


def leave_units_out(measured: Measurements, evaluated: Evaluation) -> list[Evaluation]:
    """Return an evaluation with excitation units left out, and with the criteria of a fit to all rows."""
    begin = time.process_time()
    try:
        trial = _Trial(measured, evaluated.candidate, evaluated.shape)
        by_unit = tuple(trial.leave_out(fold).tested for fold in measured.units())
        judged = with_fit(replace(evaluated, units=by_unit), trial.residuals()[measured.tested])
    except Exception as error:
        return [_failed(evaluated.candidate, error, begin)]
    return [replace(judged, seconds=evaluated.seconds + time.process_time() - begin)]


def _failed(candidate: Candidate, error: Exception, begin: float) -> Evaluation:
    text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
    return Evaluation(candidate, failure=text, seconds=time.process_time() - begin)


def judge_determined(measured: Measurements, evaluated: Evaluation) -> list[Evaluation]:
    """Return an evaluation with what the fit to all rows says, for a record of one kind of cycle.

    That is its misfit, whether the rows determine its coefficients, and whether its output follows smaller cycles.
    The rank must be nine tenths of the coefficients or more; signs and penalties, which choose among what fits alike,
    are left out of account. A model without signs must follow the input on smaller cycles as it does on the record:
    the output moves the other way by no more of its travel, and does not run far beyond its range.
    """
    trial = _Trial(measured, evaluated.candidate, evaluated.shape)
    problem = trial.problem
    found = resolve(problem.regressor, measured.tested.astype(np.float64), problem.skip)
    count = problem.regressor.shape[1]
    determined = found is None or found.rank >= _DETERMINED * count
    follows = True
    if evaluated.candidate.orientation == "auto" and not problem.template.memoryless:
        fit = trial.fit(problem)
        model = problem.template.with_coefficients(fit.coefficients, fit.bias)
        fitted = model.evaluate(measured.inputs, problem.state)[measured.tested]
        cycles = _smaller_cycles(measured.inputs)
        after = model.evaluate(cycles, model.advance(problem.state, measured.inputs))
        beyond = max(float(after.max() - fitted.max()), float(fitted.min() - after.min()))
        follows = beyond <= _BEYOND * float(np.ptp(fitted))
        follows &= _retreat(cycles, after) <= _retreat(measured.inputs[measured.tested], fitted) + _RETREAT
    judged = replace(evaluated, determined=determined, follows=follows)
    return [with_fit(judged, trial.residuals()[measured.tested])]


def with_fit(evaluated: Evaluation, residuals: Floats) -> Evaluation:
    """Return an evaluation with the criteria of the residuals of a fit to all rows."""
    return replace(
        evaluated,
        misfit=corrected(residuals, evaluated.free),
        akaike=akaike(residuals, evaluated.free),
        uncorrelated=correlated_rows(residuals, 2) <= 1,
    )


def _smaller_cycles(inputs: Floats) -> Floats:
    """Return cycles of a half, a quarter and an eighth of the range about several inputs, on either branch."""
    low, high = float(inputs.min()), float(inputs.max())
    ends = []
    for part in (0.5, 0.25, 0.125):
        for middle in np.linspace(low, high, 5)[1:-1]:
            reach = 0.5 * part * (high - low)
            for beyond in (low, high):
                ends += [beyond, *[max(middle - reach, low), min(middle + reach, high)] * 2]
    steps = [np.linspace(a, b, 21)[1:] for a, b in pairwise([float(inputs[-1]), *ends])]
    return np.concatenate(steps)


def _retreat(inputs: Floats, outputs: Floats) -> float:
    """Return how far the output moves against the input, or with it if that is less, as a part of all its travel."""
    moves = np.diff(outputs) * np.sign(np.diff(inputs))
    against, along = float(-moves[moves < 0.0].sum()), float(moves[moves > 0.0].sum())
    return min(against, along) / max(against + along, 1e-300)


def residuals_of(measured: Measurements, evaluated: Evaluation) -> Floats:
    """Return measured less fitted outputs of an evaluated candidate that is fitted to all rows, shape (N,)."""
    return _Trial(measured, evaluated.candidate, evaluated.shape).residuals()


def corrected(residuals: Floats, free: float) -> float:
    """Return the RMS of residuals as others would be if errors are uncorrelated.

    Generalized cross-validation: Golub, Heath and Wahba, Technometrics 21(2), 215-223, 1979. A bias is counted beside
    the coefficients.
    """
    rows = residuals.size
    return float(np.sqrt(np.mean(residuals**2))) / max(1.0 - (free + 1.0) / rows, 1.0 / rows)


def akaike(residuals: Floats, free: float) -> float:
    """Return N log(mean square) + 2 N (k + 1) / (N − k − 2) of N residuals and k coefficients with the bias.

    Akaike's criterion, corrected for few rows; for uncorrelated errors. Infinite of too many coefficients. Source:
    Hurvich and Tsai, Biometrika 76(2), 297-307, 1989.
    """
    rows, count = residuals.size, free + 1.0
    if rows <= count + 2.0:
        return float("inf")
    square = max(float(np.mean(residuals**2)), 1e-300)
    return float(rows * np.log(square) + 2.0 * rows * (count + 1.0) / (rows - count - 2.0))


@dataclass(frozen=True)
class _LeftOut:
    tested: float
    training: float
    start: float
    free: float


class _Trial:
    """A candidate's problem, which is set up once unless the outputs decide on more than the coefficients."""

    def __init__(self, measured: Measurements, candidate: Candidate, shape: tuple[float, ...]) -> None:
        self.measured, self.candidate = measured, candidate
        self.problem = self._set_up(measured.fitted, shape)
        self.shape = tuple(self.problem.template.shape_parameters().values)
        spec = self.problem.spec
        # Two penalties of all rows: to choose them anew in each fold would take longer than all the rest.
        ridge = None if candidate.smoothing is None else 0.0
        self.penalties = self.problem.regularization(candidate.smoothing, ridge)
        # The few shape parameters are those of all rows too.
        self.again = spec.refine is not None or candidate.initial == "estimate"
        if self.problem.skip > measured.known:
            raise ValueError(f"its memory is unknown until row {self.problem.skip}: too few rows are left")

    def _set_up(self, trained: Flags, shape: tuple[float, ...] = ()) -> FitProblem:
        each = self.candidate
        return set_up_problem(
            each.model,
            self.measured.inputs,
            self.measured.outputs,
            trained.astype(np.float64),
            # A specimen need not be saturated where its plane ends: what came before is unknown to any model.
            self.measured.known if each.initial == "skip" else 0,
            each.smoothing or 0.0,
            each.initial,
            dict(each.options),
            orientation=each.orientation,
            shape=shape,
        )

    def fit(self, problem: FitProblem, weights: Floats | None = None) -> Fit:
        """Return the coefficients for the problem's weights or others, with the penalties of the candidate."""
        return problem.fit(self.penalties.smoothing, weights, ridge=self.penalties.ridge)

    def residuals(self) -> Floats:
        """Return measured less fitted outputs of the fit to all rows, shape (N,)."""
        found = self.fit(self.problem)
        return self.measured.outputs - found.bias - self.problem.regressor.product(found.coefficients)

    def leave_out(self, fold: Fold) -> _LeftOut:
        """Fit without a fold; return the errors."""
        problem = self._set_up(fold.trained) if self.again else self.problem
        found = self.fit(problem, fold.trained.astype(np.float64))
        errors = (self.measured.outputs - found.bias - problem.regressor.product(found.coefficients)) ** 2
        first = self.measured.fitted & ~self.measured.tested
        trained = fold.trained.copy()
        trained[: problem.skip] = False
        return _LeftOut(
            tested=float(errors[fold.tested].mean()),
            training=float(np.sqrt(errors[trained].mean())),
            start=float(np.sqrt(errors[first].mean())) if first.any() else 0.0,
            free=problem.template.count_beside_coefficients() + found.certificate.determined,
        )
