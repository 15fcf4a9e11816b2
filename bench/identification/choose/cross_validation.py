"""Choice of smoothing and order by cross-validation on contiguous blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats
from bench.identification.by_name import Candidate, Initial, set_up_problem
from bench.identification.choose.splits import FOLDS, SMOOTHING_BLOCKS, Fold, block_folds
from bench.identification.fit.least_squares import Fit, counted_weights
from bench.identification.fit.orientation import Orientation
from bench.identification.fit.regularization import Regularization
from bench.models import Regressor

EQUAL = 1.02
"""Ratio of errors that are no difference: the greatest smoothing, or the fewest degrees of freedom, is taken then.
Derivation: the standard error of the RMS of 1,000 independent errors is 1 / √2,000 of it, 2 %."""

FitOf: TypeAlias = Callable[[float, Floats], Fit]
"""Takes a smoothing weight and the weights of the samples, shape (N,); returns the fit."""


@dataclass(frozen=True)
class CrossValidation:
    """A table of trials, in the order asked for."""

    trials: tuple[Regularization, ...]

    @property
    def best(self) -> Regularization:
        """The trial of the least error on samples left out."""
        return min(self.trials, key=lambda trial: trial.rms)

    @property
    def smoothest(self) -> Regularization:
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
    weights: ArrayLike | None = None,
    skip: int = 0,
    ridge: float = 0.0,
    initial: Initial | None = None,
    orientation: Orientation = "auto",
    **options: Any,  # noqa: ANN401 - those of `identify`
) -> CrossValidation:
    """Return how well a model predicts parts of the sequence that were left out of its fit.

    The samples that count are cut into contiguous blocks, see `block_folds`: single samples left out would be
    predicted by their neighbours, which are nearly the same measurement. Samples left out of the cost still drive the
    memory. The orientation, and an estimated initial memory, are those of the whole sequence.

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

    Raises
    ------
    ValueError
        As `compare_smoothing` and `identify`.
    """
    if levels is not None and not len(levels):
        raise ValueError("levels: expected at least one number, got none")
    trials: list[Regularization] = []
    for order in levels if levels is not None else [None]:
        chosen = options if order is None else {**options, "levels": order}
        settings = Candidate(model_name, chosen, orientation, initial, max(smoothing, default=0.0))
        problem = set_up_problem(settings, inputs, outputs, weights, skip)
        counts = np.where(np.arange(problem.outputs.size) < problem.skip, 0.0, problem.weights)

        fit = partial(problem.fit, ridge=ridge)
        compared = compare_smoothing(fit, problem.regressor, problem.outputs, counts, smoothing)
        trials += [replace(trial, ridge=ridge, levels=order) for trial in compared.trials]
    return CrossValidation(tuple(trials))


def compare_smoothing(
    fit: FitOf,
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    smoothing: Sequence[float],
) -> CrossValidation:
    """Return how well fits of given smoothing predict parts of their own data that were left out of them.

    Parameters
    ----------
    fit : callable
        Takes a smoothing weight and the weights of the samples, shape (N,); returns the fit.
    regressor : Regressor
        That of the coefficients of the fits, shape (N, K + q).
    outputs, weights : ndarray, shape (N,)
        Measured outputs, and the weight of each sample in the fit and in the errors; 0 for those that do not count.
    smoothing : sequence of float
        Weights to try.

    Raises ValueError if there is nothing to try, a weight is wrong, or there are fewer samples than folds.
    """
    if not len(smoothing):
        raise ValueError("smoothing: expected at least one weight, got none")
    usable = counted_weights(regressor.shape[0], weights, 0) > 0.0
    used = int(usable.sum())
    if used < FOLDS:
        raise ValueError(f"weights: expected a positive weight in each of {FOLDS} folds, got {used} in all")
    parts = block_folds(usable, blocks=min(SMOOTHING_BLOCKS, used))
    return CrossValidation(tuple(_trial(each, fit, regressor, outputs, weights, parts) for each in smoothing))


def _trial(
    smoothing: float,
    fit: FitOf,
    regressor: Regressor,
    outputs: Floats,
    weights: Floats,
    parts: Sequence[Fold],
) -> Regularization:
    """Return how well fits predict what was left out of them."""
    squares, counts, training = np.empty((3, len(parts)))
    for k, part in enumerate(parts):
        found = fit(smoothing, np.where(part.tested, 0.0, weights))
        errors = (outputs - found.bias - regressor.product(found.coefficients)) ** 2
        squares[k], counts[k] = weights[part.tested] @ errors[part.tested], weights[part.tested].sum()
        training[k] = np.sqrt(np.average(errors[part.trained], weights=weights[part.trained]))
    return Regularization.of_folds(float(smoothing), 0.0, squares, counts, training)
