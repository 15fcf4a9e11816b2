"""Held-out errors of Hammerstein models, so that models with time can be compared with those without."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from bench.hysteresis._checks import Floats
from bench.identification.branches import turning_points
from bench.identification.evaluation import Candidate, Evaluation, Measurements
from bench.identification.folds import Fold
from bench.identification.least_squares import one_thread
from bench.identification.orientation import NAMES
from bench.timed.hammerstein_fit import CHOICE, choose_elements, set_up_search

# Rows times coefficients of the operator up to which the choice of what follows it takes seconds.
_MOST = 2_000_000
# Moves from this part of the range on have a speed.
_LEAST_MOVE = 0.02


@dataclass(frozen=True, eq=False)
class HeldOutInTime:
    """Evaluates operators with what may follow them in time; a task that can be sent to a worker process.

    Parameters
    ----------
    measured : Measurements
        All rows: a linear part needs those between.
    times : ndarray, shape (N,)
        s, strictly increasing.
    thinned : int
        Rows by which the models without time are compared.
    """

    measured: Measurements
    times: Floats
    thinned: int

    def is_small(self, coefficients: int) -> bool:
        """Return whether an operator of so many coefficients can be evaluated in seconds."""
        return coefficients * self.times.size <= _MOST

    def has_one_rate(self) -> bool:
        """Return whether most moves from one turning point to the next are alike in speed, to a factor of two."""
        inputs = self.measured.inputs
        turns = turning_points(inputs, _LEAST_MOVE * float(np.ptp(inputs)))
        speeds = np.abs(np.diff(inputs[turns])) / np.diff(self.times[turns])
        slow, fast = np.quantile(speeds, (0.1, 0.9))
        return bool(fast <= 2.0 * slow)

    def evaluate(self, static: Candidate, gap: int) -> list[Evaluation]:
        """Return the errors of a Hammerstein model with a candidate's operator; none if nothing need follow it.

        What follows, and its times, are chosen by all rows, as shape parameters are; the coefficients are fitted
        anew in each fold.

        Parameters
        ----------
        static : Candidate
            The operator.
        gap : int
            Rows next to those tested that are not fitted, of the rows by which the others are compared.
        """
        begin = time.process_time()
        scale = self.times.size / self.thinned
        measured = replace(self.measured, gap=round(gap * scale))
        try:
            with one_thread():
                found = self._evaluate(measured, static)
        # What cannot follow one operator must not end the comparison of the others.
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            found = [Evaluation(replace(static, model="hammerstein"), failure=str(error))]
        return [replace(each, seconds=time.process_time() - begin) for each in found]

    def _evaluate(self, measured: Measurements, static: Candidate) -> list[Evaluation]:
        problem, search = set_up_search(
            self.times,
            measured.inputs,
            measured.outputs,
            measured.fitted.astype(np.float64),
            measured.known if static.initial == "skip" else 0,
            static.initial,
            "auto",
            static=static.model,
            options=static.options,
            smoothing=static.smoothing or 0.0,
        )
        if problem.skip > measured.known:
            raise ValueError(f"its memory is unknown until row {problem.skip}: too few rows are left")
        # At one rate, creep is hysteresis to the record: it would be found in place of a lag.
        slow = {"creep"} if self.has_one_rate() else set()
        search, found = choose_elements(search, [element for element in CHOICE if element not in slow])
        if not found.elements:
            return []
        columns, drifts = search.responses(found.elements, found.values)
        constrained = search.static.template.nonnegative()
        sign = search.sign(found.fit)
        trained = []

        def leave_out(fold: Fold) -> tuple[float, float]:
            weights = fold.trained.astype(np.float64)
            fit = search.fit_columns(columns, drifts, weights, sign)
            count = columns.shape[1]
            fitted = fit.bias + columns @ fit.coefficients[:count] + drifts @ fit.coefficients[count:]
            errors = (measured.outputs - fitted) ** 2
            weights[: problem.skip] = 0.0
            trained.append(float(np.sqrt(weights @ errors / weights.sum())))
            return float(errors[fold.tested].mean()), fit.certificate.passive + found.values.size

        blocks = [leave_out(fold) for fold in measured.blocks()]
        units = [leave_out(fold) for fold in measured.units()]
        options = {"static": static.model, **static.options, "dynamics": ",".join(found.elements)}
        return [
            Evaluation(
                Candidate(
                    "hammerstein",
                    options,
                    NAMES[sign] if constrained.any() else "auto",
                    static.initial,
                    search.smoothing,
                ),
                blocks=tuple(error for error, _ in blocks),
                units=tuple(error for error, _ in units),
                training=float(np.mean(trained[: len(blocks)])),
                free=float(np.mean([free for _, free in blocks])),
            )
        ]
