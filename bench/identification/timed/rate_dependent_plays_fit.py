"""Fit of rate-dependent plays: weights and time constants at once.

For given time constants the weights are a constrained least-squares problem over plays of each threshold without and
with each time constant. The time constants follow by variable projection (Golub and Pereyra, Inverse Problems 19(2),
R1-R26, 2003), one more as long as it is worth it. Several spread over the rates of the record stand for hysteresis
that widens with the logarithm of the rate, as where thermal activation lets it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, cast

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats
from bench.identification.advice import Advice
from bench.identification.by_name import Candidate, FitProblem, Identification, Initial, set_up_problem
from bench.identification.fit.cell_layout import CellLayout
from bench.identification.fit.least_squares import Fit, fit_cells, one_thread
from bench.identification.fit.orientation import NAMES, Orientation
from bench.identification.fit.variable_projection import Evidence, Separable, Stage, variable_projection
from bench.identification.measures import measure_errors
from bench.identification.options import OptionHelp
from bench.identification.timed.parsimony import check_size, moving, schwarz
from bench.identification.trust import judge_fit
from bench.models import PlaysState, PrandtlIshlinskii, RateDependentPlays, Regressor, check_sequence

# Most time constants that are tried if nobody says how many, and the first values of another one. Derivation: over
# eight decades nine values are less than one apart; a model has four times the plays with three.
_MOST, _GRID = 3, 9
# Shortest time constant, in time steps. Derivation: within one step, ten time constants, all but 5e-5 of a move is
# done.
_SHORTEST = 0.1
# The search. Derivation: a millionth of a time constant is far below what noise leaves unknown; the evaluations are a
# choice.
_SEARCH = Stage(1, 1e-6, 12)
# Part of the sum of squares of the outputs that is left by rounding alone. Derivation: the square of the tolerance of
# a fit, 1e-12.
_ROUNDED = 1e-24
# Standard deviation of the logarithm of a time constant from which on the data do not determine it. Derivation: a
# factor of e.
_UNKNOWN = 1.0


@dataclass(frozen=True, eq=False)
class Found:
    """Time constants with the fit."""

    lags: Floats  # shape (J,); s
    # Weights of the plays without time constant, then of those of each; of the sign of the problem's orientation.
    fit: Fit
    cost: float  # weighted sum of squares
    deviations: Floats  # shape (J,); standard deviations of the logarithms of the time constants


@dataclass(frozen=True, eq=False)
class PlaysSearch:
    """The measured sequence, and the problem of plays that do not depend on the rate."""

    times: Floats  # shape (N,); s
    static: FitProblem  # that of a Prandtl-Ishlinskii operator of the same thresholds

    @classmethod
    def of(
        cls,
        times: Floats,
        inputs: Floats,
        outputs: Floats,
        weights: ArrayLike | None,
        skip: int,
        initial: Initial | None,
        orientation: Orientation,
        **options: object,
    ) -> PlaysSearch:
        """Return the search for a measured sequence; arguments and errors as `identify_rate_dependent_plays`."""
        settings = Candidate("prandtl-ishlinskii", options, orientation, initial)
        static = set_up_problem(settings, inputs, outputs, weights, skip)
        check_size(times.size, (1 + _MOST) * static.template.coefficients.size, "plays")
        return cls(times, static)

    @property
    def template(self) -> PrandtlIshlinskii:
        """The operator that does not depend on the rate."""
        return cast("PrandtlIshlinskii", self.static.template)

    def model(self, lags: Floats, found: Fit | None = None) -> RateDependentPlays:
        """Return the model of given time constants, with the weights of a fit or all 0."""
        template = self.template
        count = template.thresholds.size
        return RateDependentPlays(
            np.tile(template.thresholds, 1 + lags.size),
            np.append(0.0, lags).repeat(count),
            np.zeros((1 + lags.size) * count) if found is None else found.coefficients,
            template.input_range,
            0.0 if found is None else found.bias,
            template.origin,
            template.input_unit,
            template.output_unit,
        )

    def state(self, lags: Floats) -> PlaysState:
        """Return the state before the first sample."""
        return PlaysState(tuple(self.template.origin + play for play in self.static.state) * (1 + lags.size))

    def columns(self, lags: Floats) -> Floats:
        """Return the plays sample by sample, shape (N, (1 + J) n)."""
        return self.model(lags).columns(self.times, self.static.inputs, self.state(lags))

    def fit_columns(self, columns: Floats, weights: Floats | None = None) -> Fit:
        """Return the weights of the plays for the problem's weights of samples, or others."""
        problem = self.static
        w = problem.weights if weights is None else weights
        # Plays stand still most of the time: as cells, without a place in a plane, they are quickly fitted.
        cells = problem.orientation * np.where(moving(columns, w, problem.skip), columns, 0.0)
        count = cells.shape[1]
        regressor = Regressor.of_cells(cells, np.empty((cells.shape[0], 0)))
        layout = CellLayout(0, np.arange(count), np.zeros(count, dtype=np.int64))
        found = fit_cells(layout, regressor, problem.outputs, weights=w, skip=problem.skip)
        return replace(found, coefficients=problem.orientation * found.coefficients)

    def problem(self) -> Separable:
        """Return the residuals by the logarithms of time constants."""
        roots = np.sqrt(self.static.weights)
        roots[: self.static.skip] = 0.0

        def respond(values: Floats, coefficients: Floats) -> Floats:
            model = replace(self.model(np.exp(values)), weights=coefficients)
            return model.evaluate(self.times, self.static.inputs, self.state(values))

        return Separable(
            self.static.outputs, roots, lambda values: self.columns(np.exp(values)), respond, self.fit_columns
        )

    @property
    def bounds(self) -> tuple[float, float]:
        """Logarithms of the shortest and the longest time constant in s."""
        step = float(np.median(np.diff(self.times)))
        return math.log(_SHORTEST * step), math.log(float(np.ptp(self.times)))

    def search(self, starts: Sequence[Floats]) -> Found:
        """Return the end of a search from the best of some time constants."""
        low, high = (np.full(starts[0].size, bound) for bound in self.bounds)
        logarithms = [np.log(start) for start in starts]
        end = variable_projection(self.problem(), logarithms, (low, high), stages=[_SEARCH])[0]
        order = np.argsort(end.values)
        lags = np.exp(end.values[order])
        found = self.fit_columns(self.columns(lags))
        freedom = end.residuals.size - self.static.skip - found.certificate.passive - lags.size - 1
        deviations = Evidence.of(end.jacobian, end.residuals, freedom).deviations[order]
        return Found(lags, found, end.cost, deviations)

    def more(self, before: Found) -> Found:
        """Return the best fit with one time constant more."""
        grid = np.exp(np.linspace(*self.bounds, _GRID + 2)[1:-1])
        return self.search([np.append(before.lags, lag) for lag in grid])

    def choose(self, count: int | None = None) -> Found:
        """Return the fit with as many time constants as are worth it, or a given number of them."""
        found = self.search([np.empty(0)])
        counted = self.static.weights[self.static.skip :]
        used = max(int(np.count_nonzero(counted)), 1)
        exact = _ROUNDED * float(counted @ self.static.outputs[self.static.skip :] ** 2)
        while found.lags.size < (_MOST if count is None else count):
            if count is None and found.cost <= exact:
                break
            more = self.more(found)
            added = 1 + max(more.fit.certificate.passive - found.fit.certificate.passive, 0)
            if count is None and schwarz(more.cost, added, used) >= schwarz(found.cost, 0, used):
                break
            found = more
        return found


def identify_rate_dependent_plays(
    times: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    initial: Initial | None = None,
    orientation: Orientation = "auto",
    plays: Annotated[int, OptionHelp("number of thresholds, i maximum / plays, i from 0")] = 15,
    maximum: Annotated[
        float | None, OptionHelp("end of the thresholds, input units", "half the range of the inputs")
    ] = None,
    origin: Annotated[float, OptionHelp("input of the relaxed state, input units")] = 0.0,
    time_constants: Annotated[
        int | None, OptionHelp("number of time constants, up to 3", "as many as are worth it")
    ] = None,
    input_unit: str = "",
    output_unit: str = "",
) -> Identification[RateDependentPlays]:
    """Return the rate-dependent plays that fit a measured sequence best in the least-squares sense.

    Parameters
    ----------
    times, inputs, outputs, weights, skip, initial, orientation
        As `identify_hammerstein`.
    plays : int
        Number of thresholds; there is a play of each without a time constant and with each.
    maximum : float or None
        End of the thresholds, input units; half the range of the inputs if None.
    origin : float
        Where the plays stand at first, input units.
    time_constants : int or None
        Their number, 0 to 3. None adds one after the other as long as it lowers the criterion of Schwarz.
    input_unit, output_unit : str
        Units, for labels.

    Raises
    ------
    ValueError
        If an option is wrong or the data are unfit.
    """
    moments, sequence, measured = check_sequence(times, inputs=inputs, outputs=outputs)
    if time_constants is not None and time_constants not in range(_MOST + 1):
        raise ValueError(f"time_constants: expected 0 to {_MOST}, got {time_constants!r}")
    options = {"plays": plays, "maximum": maximum, "origin": origin}
    units = {"input_unit": input_unit, "output_unit": output_unit}
    search = PlaysSearch.of(moments, sequence, measured, weights, skip, initial, orientation, **options, **units)
    with one_thread():
        found = search.choose(time_constants)
    advice = list(search.static.advice())
    if not (found.deviations < _UNKNOWN).all():
        remedy = "record faster and slower inputs, or give fewer (-o time_constants=NUMBER)"
        advice.append(Advice("dynamics-unknown", "the data do not determine every time constant", remedy))
    model, state, first = search.model(found.lags, found.fit), search.state(found.lags), search.static.skip
    predicted = model.evaluate(moments, sequence, state)
    residuals = measured - predicted
    advice += judge_fit(search.static, found.fit, residuals, initial=initial, smoothing=0.0)
    return Identification(
        model_name=model.kind,
        model=model,
        residuals=residuals,
        errors=measure_errors(measured[first:], predicted[first:]),
        uncertainties=found.fit.uncertainties,
        certificate=found.fit.certificate,
        skip=first,
        initial_state=state,
        advice=tuple(advice),
        orientation=NAMES[search.static.orientation],
    )
