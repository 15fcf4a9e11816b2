"""Held-out errors of models with time, so that they can be compared with those without."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats
from bench.identification.branches import turning_points
from bench.identification.by_name import FitProblem
from bench.identification.choose.evaluation import Candidate, Evaluation, Measurements, with_fit
from bench.identification.choose.folds import Fold
from bench.identification.fit.least_squares import Fit, one_thread
from bench.identification.fit.orientation import NAMES
from bench.identification.timed.hammerstein_fit import CHOICE, WORTH_OF_DRIFT, choose_elements, set_up_search
from bench.identification.timed.rate_dependent_plays_fit import PlaysSearch

# Rows times coefficients of the operator up to which the choice of what follows it takes seconds.
_MOST = 2_000_000
# Rows times plays up to which the choice of their time constants does.
_MOST_OF_PLAYS = 250_000
# Moves from this part of the range on have a speed.
_LEAST_MOVE = 0.02
# Part by which a drift must lower the RMS error of such a record, about 15 % of the variance: no rates look like one.
_WORTH_AT_ONE_RATE = 0.08
# Longest period of a resonance by the time of a move, at one rate.
_RINGING = 0.2


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
        turns = self._turns()
        speeds = np.abs(np.diff(self.measured.inputs[turns])) / np.diff(self.times[turns])
        slow, fast = np.quantile(speeds, (0.1, 0.9))
        return bool(fast <= 2.0 * slow)

    def _turns(self) -> NDArray[np.int64]:
        inputs = self.measured.inputs
        return turning_points(inputs, _LEAST_MOVE * float(np.ptp(inputs)))

    def _median_move(self) -> float:
        """Return the median time from one turning point to the next, s."""
        return float(np.median(np.diff(self.times[self._turns()])))

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
        return self._carry_out("hammerstein", static, gap, self._behind)

    def evaluate_plays(self, static: Candidate, gap: int) -> list[Evaluation]:
        """Return the errors of a Prandtl-Ishlinskii candidate's plays, with thresholds that grow with their rate.

        None if no time constant is worth it. Arguments as `evaluate`.
        """
        return self._carry_out("rate-dependent-plays", static, gap, self._at_rates)

    def _carry_out(
        self,
        model: str,
        static: Candidate,
        gap: int,
        work: Callable[[Measurements, Candidate], Evaluation | None],
    ) -> list[Evaluation]:
        begin = time.process_time()
        scale = self.times.size / self.thinned
        measured = replace(self.measured, gap=round(gap * scale))
        try:
            with one_thread():
                found = work(measured, static)
        # What cannot follow one operator must not end the comparison of the others.
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            found = Evaluation(replace(static, model=model, static=static.model), failure=str(error))
        return [] if found is None else [replace(found, seconds=time.process_time() - begin)]

    def _behind(self, measured: Measurements, static: Candidate) -> Evaluation | None:
        problem, search = set_up_search(
            self.times,
            measured.inputs,
            measured.outputs,
            *self._fitted(measured, static),
            static.initial,
            "auto",
            static=static.model,
            options=static.options,
            smoothing=static.smoothing or 0.0,
        )
        _check_skipped(measured, problem)
        among, worth = list(CHOICE), WORTH_OF_DRIFT
        if self.has_one_rate():
            # To such a record creep is hysteresis, and would be found in place of a lag. So is a resonance that does
            # not ring out within a move.
            among.remove("creep")
            worth = _WORTH_AT_ONE_RATE
            search = replace(search, longest_period=_RINGING * self._median_move())
        search, found = choose_elements(search, among, worth)
        if not found.elements:
            return None
        columns, drifts = search.responses(found.elements, found.values)
        sign = search.sign(found.fit)
        candidate = Candidate(
            "hammerstein",
            {"static": static.model, **static.options, "dynamics": ",".join(found.elements)},
            NAMES[sign] if search.static.template.nonnegative().any() else "auto",
            static.initial,
            search.smoothing,
            static.model,
        )
        return _left_out(
            measured,
            candidate,
            np.column_stack([columns, drifts]),
            lambda weights: search.fit_columns(columns, drifts, weights, sign),
            problem.skip,
            found.values.size + search.static.template.count_beside_coefficients(),
        )

    def _at_rates(self, measured: Measurements, static: Candidate) -> Evaluation | None:
        options = {name: value for name, value in static.options.items() if name != "dead_zones"}
        if options["plays"] * self.times.size > _MOST_OF_PLAYS:
            return None
        fitted = self._fitted(measured, static)
        search = PlaysSearch.of(
            self.times, measured.inputs, measured.outputs, *fitted, static.initial, "auto", **options
        )
        _check_skipped(measured, search.static)
        found = search.choose()
        if not found.lags.size:
            return None
        columns = search.columns(found.lags)
        candidate = Candidate(
            "rate-dependent-plays",
            {**options, "time_constants": found.lags.size},
            NAMES[search.static.orientation],
            static.initial,
            static=static.model,
        )
        return _left_out(
            measured,
            candidate,
            columns,
            lambda weights: search.fit_columns(columns, weights),
            search.static.skip,
            found.lags.size,
        )

    def _fitted(self, measured: Measurements, static: Candidate) -> tuple[Floats, int]:
        """Return the weights of the rows, and how many first ones are left out."""
        return measured.fitted.astype(np.float64), measured.known if static.initial == "skip" else 0


def _check_skipped(measured: Measurements, problem: FitProblem) -> None:
    """Raise ValueError if rows that are tested depend on what came before the record."""
    if problem.skip > measured.known:
        raise ValueError(f"its memory is unknown until row {problem.skip}: too few rows are left")


def _left_out(
    measured: Measurements,
    candidate: Candidate,
    columns: Floats,
    fit: Callable[[Floats], Fit],
    skip: int,
    parameters: int,
) -> Evaluation:
    """Return the errors over what is left out of fits of columns, shape (N, K), given by weights of the rows."""
    trained = []

    def leave_out(fold: Fold) -> tuple[float, float]:
        weights = fold.trained.astype(np.float64)
        found = fit(weights)
        errors = (measured.outputs - found.bias - columns @ found.coefficients) ** 2
        weights[:skip] = 0.0
        trained.append(float(np.sqrt(weights @ errors / weights.sum())))
        return float(errors[fold.tested].mean()), found.certificate.effective + parameters

    blocks = [leave_out(fold) for fold in measured.blocks()]
    units = [leave_out(fold) for fold in measured.units()]
    found = fit(measured.fitted.astype(np.float64))
    # The same rows of all candidates, whether they begin with them or not.
    residuals = (measured.outputs - found.bias - columns @ found.coefficients)[measured.tested]
    evaluated = Evaluation(
        candidate,
        blocks=tuple(error for error, _ in blocks),
        units=tuple(error for error, _ in units),
        training=float(np.mean(trained[: len(blocks)])),
        free=float(np.mean([free for _, free in blocks])),
    )
    return with_fit(evaluated, residuals)
