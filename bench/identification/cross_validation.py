"""Choice of smoothing and order by cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.identification.by_name import Initial, set_up_problem
from bench.identification.orientation import Orientation


@dataclass(frozen=True)
class Trial:
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

    trials: tuple[Trial, ...]

    @property
    def best(self) -> Trial:
        """The trial of the least error on samples left out."""
        return min(self.trials, key=lambda trial: trial.rms)

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
        fold = (np.arange(used) * blocks // used) % folds
        fold = np.concatenate([np.full(problem.skip, -1), fold])
        for weight in smoothing:
            squares, training = np.zeros(problem.outputs.size), []
            for k in range(folds):
                left_out = fold == k
                found = problem.fit(weight, np.where(left_out, 0.0, problem.weights), ridge)
                error = problem.outputs - found.bias - problem.regressor.product(found.coefficients)
                squares[left_out] = error[left_out] ** 2
                training.append(_rms(error**2, np.where(left_out | (fold < 0), 0.0, problem.weights)))
            rms = [_rms(squares, np.where(fold == k, problem.weights, 0.0)) for k in range(folds)]
            trials.append(
                Trial(
                    smoothing=float(weight),
                    levels=None if order is None else int(order),
                    rms=_rms(squares, np.where(fold < 0, 0.0, problem.weights)),
                    spread=float(np.std(rms, ddof=1) / np.sqrt(folds)),
                    training_rms=float(np.mean(training)),
                    folds=tuple(rms),
                )
            )
    return CrossValidation(tuple(trials))


def _rms(squares: np.ndarray[Any, np.dtype[np.float64]], weights: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    total = float(weights.sum())
    if total <= 0.0:
        raise ValueError("weights: expected a positive weight in each fold")
    return float(np.sqrt(weights @ squares / total))
