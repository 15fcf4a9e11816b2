"""Choice of smoothing and order by cross-validation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats
from bench.identification.by_name import Initial, set_up_problem
from bench.identification.choose.splits import fold_numbers
from bench.identification.fit.cell_layout import CellLayout, Indices
from bench.identification.fit.least_squares import Fit, counted_weights, fit_cells
from bench.identification.fit.orientation import Orientation
from bench.models import Regressor

EQUAL = 1.02
"""Ratio of errors that are no difference: of smoothing weights the greatest is taken then."""

Fitted = Callable[[Floats], Fit]
"""Returns a fit with weights of the samples, shape (N,)."""


@dataclass(frozen=True)
class SmoothingTrial:
    """One row of a cross-validation table.

    Parameters
    ----------
    smoothing : float
        Weight of the roughness penalty.
    levels : int or None
        Number of intervals; None if it was not varied.
    rms : float
        RMS error over all samples, each predicted by the model fitted without its fold, output units.
    spread : float
        Standard error of `rms`, from the scatter of the folds.
    training_rms : float
        RMS error over the samples that were fitted, mean over the folds.
    folds : tuple of float
        RMS error of each fold.
    """

    smoothing: float
    levels: int | None
    rms: float
    spread: float
    training_rms: float
    folds: tuple[float, ...]


@dataclass(frozen=True)
class CrossValidation:
    """A table of trials, in the order asked for."""

    trials: tuple[SmoothingTrial, ...]

    @property
    def best(self) -> SmoothingTrial:
        """The trial of the least error on samples left out."""
        return min(self.trials, key=lambda trial: trial.rms)

    @property
    def smoothest(self) -> SmoothingTrial:
        """The trial of the greatest smoothing whose error does not differ from the least."""
        near = EQUAL * self.best.rms
        return max((trial for trial in self.trials if trial.rms <= near), key=lambda trial: trial.smoothing)

    def table(self) -> str:
        """Return the table as text, the best row marked."""
        lines = ["   levels   smoothing         rms   ± spread    training"]
        for trial in self.trials:
            mark = "*" if trial is self.best else " "
            levels = "-" if trial.levels is None else str(trial.levels)
            lines.append(
                f" {mark} {levels:>6}  {trial.smoothing:10.3g}  {trial.rms:10.5g}  {trial.spread:9.3g}"
                f"  {trial.training_rms:10.5g}"
            )
        return "\n".join(lines)


def cross_validate(
    model_name: str,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    smoothing: Sequence[float] = (0.0,),
    levels: Sequence[int] | None = None,
    folds: int = 5,
    blocks: int = 20,
    weights: ArrayLike | None = None,
    skip: int = 0,
    ridge: float = 0.0,
    initial: Initial | None = None,
    orientation: Orientation = "auto",
    **options: Any,  # noqa: ANN401 - those of `identify`
) -> CrossValidation:
    """Return how well a model predicts parts of the sequence that were left out of its fit.

    The sequence is cut into blocks of successive samples, and block b belongs to fold b modulo `folds`: neighbours
    are nearly the same measurement, and samples left out one by one would be predicted by them. What is left out
    of the cost still drives the memory. An estimated initial memory (`initial="estimate"`) is that of the whole
    sequence, and so is the orientation.

    Parameters
    ----------
    model_name, inputs, outputs, weights, skip, initial, orientation, **options
        As `identify`.
    smoothing : sequence of float
        Weights to try.
    ridge : float
        Weight of the penalty on the size of the density.
    levels : sequence of int or None
        Numbers of intervals to try, for Preisach models; None keeps that of the model or the options.
    folds : int
        Number of folds, >= 2.
    blocks : int
        Number of blocks, >= folds.

    Raises
    ------
    ValueError
        If there is nothing to try, folds or blocks are too few or more than the samples, a fold has no weight,
        or as `identify`.
    """
    if not len(smoothing):
        raise ValueError("smoothing: expected at least one weight, got none")
    if levels is not None and not len(levels):
        raise ValueError("levels: expected at least one number, got none")
    if folds < 2:
        raise ValueError(f"folds: expected at least 2, got {folds}")
    if blocks < folds:
        raise ValueError(f"blocks: expected at least {folds}, one for each fold, got {blocks}")
    trials = []
    for order in levels if levels is not None else [None]:
        chosen = options if order is None else {**options, "levels": order}
        problem = set_up_problem(
            model_name, inputs, outputs, weights, skip, max(smoothing), initial, chosen, orientation=orientation
        )
        used = problem.outputs.size - problem.skip
        if used < blocks:
            raise ValueError(f"blocks: expected at most {used}, one for each sample used, got {blocks}")
        fold = np.concatenate([np.full(problem.skip, -1), fold_numbers(used, folds, blocks)])
        for weight in smoothing:
            fitted = partial(problem.fit, weight, ridge=ridge)
            trials.append(
                _trial(float(weight), order, fitted, problem.regressor, problem.outputs, problem.weights, fold)
            )
    return CrossValidation(tuple(trials))


def choose_smoothing(
    layout: CellLayout,
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    smoothing: Sequence[float],
    *,
    folds: int = 5,
    blocks: int = 20,
) -> CrossValidation:
    """Return how well nonnegative fits predict parts of their own data that were left out of them.

    The samples that count are cut into blocks, see `cross_validate`. Each counts once in the errors, however great
    its weight in the fit is.

    Parameters
    ----------
    layout : CellLayout
        Places of the cells.
    regressor : Regressor
        Shape (N, K + q).
    outputs, weights : ndarray, shape (N,)
        Measured outputs, and the weight of each sample in the fit; 0 for those that do not count.
    smoothing : sequence of float
        Weights to try.
    folds, blocks : int
        Number of folds, >= 2, and of blocks, >= folds; with fewer samples than blocks each sample is one.

    Raises
    ------
    ValueError
        If there is nothing to try, a weight is wrong, or a fold has no sample that counts.
    """

    def fitted(weight: float) -> Fitted:
        return partial(fit_cells, layout, regressor, outputs, True, smoothing=weight)

    return compare_smoothing(fitted, regressor, outputs, weights, smoothing, folds=folds, blocks=blocks)


def compare_smoothing(
    fitted: Callable[[float], Fitted],
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    smoothing: Sequence[float],
    *,
    folds: int = 5,
    blocks: int = 20,
) -> CrossValidation:
    """Return how well fits of given smoothing predict parts of their own data that were left out of them.

    As `choose_smoothing`, for fits of any kind.

    Parameters
    ----------
    fitted : callable
        Takes a smoothing weight and returns what returns the fit for weights of the samples, shape (N,).
    regressor, outputs, weights, smoothing, folds, blocks
        As `choose_smoothing`; the regressor is that of the coefficients of the fits.

    Raises
    ------
    ValueError
        As `choose_smoothing`.
    """
    if not len(smoothing):
        raise ValueError("smoothing: expected at least one weight, got none")
    counted = counted_weights(regressor.shape[0], weights, 0) > 0.0
    used = int(counted.sum())
    fold = np.full(weights.size, -1)
    fold[counted] = fold_numbers(used, folds, min(blocks, used))
    counts = np.where(counted, 1.0, 0.0)
    trials = []
    for weight in smoothing:
        trials.append(_trial(weight, None, fitted(weight), regressor, outputs, weights, fold, counts))
    return CrossValidation(tuple(trials))


def _trial(
    smoothing: float,
    levels: int | None,
    fitted: Fitted,
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    fold: Indices,
    counts: Floats | None = None,
) -> SmoothingTrial:
    """Return how well fits predict what was left out; samples of no fold, −1, are in every fit and in no error.

    The errors count with `counts`, or as the fits do.
    """
    counts = weights if counts is None else counts
    numbers = range(int(fold.max()) + 1)
    squares, training = np.zeros(outputs.size), []
    for k in numbers:
        left_out = fold == k
        found = fitted(np.where(left_out, 0.0, weights))
        error = outputs - found.bias - regressor.product(found.coefficients)
        squares[left_out] = error[left_out] ** 2
        training.append(_rms(error**2, np.where(left_out | (fold < 0), 0.0, counts)))
    rms = [_rms(squares, np.where(fold == k, counts, 0.0)) for k in numbers]
    return SmoothingTrial(
        smoothing=smoothing,
        levels=None if levels is None else int(levels),
        rms=_rms(squares, np.where(fold < 0, 0.0, counts)),
        spread=float(np.std(rms, ddof=1) / np.sqrt(len(rms))),
        training_rms=float(np.mean(training)),
        folds=tuple(rms),
    )


def _rms(squares: Floats, weights: Floats) -> float:
    total = float(weights.sum())
    if total <= 0.0:
        raise ValueError("weights: expected a positive weight in each fold")
    return float(np.sqrt(weights @ squares / total))
