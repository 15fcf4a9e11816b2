"""Prediction bands: how far a model's prediction may be from what is measured, calibrated on blocks left out.

Split-conformal prediction by blocks. The samples are cut into blocks of successive ones, at turning points of the
input where there is one near; the input record is never cut, as what is left out of the cost still drives the memory.
Each block is predicted by a fit without it and without a gap on both sides, and gives scores |y - ŷ| / v, where v² is
the variance of the residuals and of the prediction (`PredictionVariance`). The half-width of the band is q v: q is
the ⌈(n + 1) level⌉-th of n scores. n is the number of independent ones, as many as the gap goes into the samples
(Chernozhukov, Wüthrich and Zhu, PMLR 75:732, 2018).

A band holds for inputs like those of its record, and not beyond the validity of the model (`Validity`). Of a model
with time each fit without a block is one of the whole model, its times and shape too, and v is that of the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.base import Floats, checks as _checks, say_share, shares_to
from bench.identification.branches import turns_beyond_noise
from bench.identification.by_name import FitProblem, Identification
from bench.identification.choose.splits import near
from bench.identification.fit.cell_layout import Flags, Indices
from bench.identification.fit.covariance import PredictionVariance, prediction_variance
from bench.identification.fit.least_squares import Fit
from bench.identification.timed.identify_in_time import identify_in_time
from bench.models import Operator, TimedModel

LEVEL = 0.9
"""Nominal coverage of a band, unless another is asked for. Derivation: a quantile of it needs nine independent scores
at least, which a record of a few loops gives."""

# Blocks, and fits without some of them. Derivation: a fit without a tenth of the samples has coefficients about as
# certain (by 5 %) as one of all; in two blocks the tenth is of two places of the record.
_BLOCKS, _FOLDS = 20, 10
# Least rows of a block. Derivation: a branch of fewer has no row between its turning points and a gap on both sides.
_FEWEST_ROWS = 5
# Step for the local slope at an input, as part of the operating range. Derivation: far above rounding, and a tenth of
# the width of a cell of a plane of a hundred levels.
_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Band:
    """A prediction band of one model.

    Parameters
    ----------
    level : float
        Nominal coverage, 0 to 1.
    pointwise : float
        Factor of the half-width at which this share of the samples is covered.
    rows : int
        Samples on which the band was calibrated.
    independent : int
        Number of them that count as independent. Below level / (1 - level) `pointwise` is the greatest score.
    held_out : float
        RMS error of the samples, each predicted by a fit without its block; output units.
    variance : PredictionVariance
        Variance of residuals and predictions.
    """

    level: float
    pointwise: float
    rows: int
    independent: int
    held_out: float
    variance: PredictionVariance

    def half_widths(
        self,
        model: Operator[Any] | TimedModel[Any],
        inputs: Floats,
        state: Any = None,  # noqa: ANN401 - each operator has its own
    ) -> Floats:
        """Return the half-width of the band about each prediction, shape (N,), output units.

        Parameters
        ----------
        model : Operator or TimedModel
            The model to which the band belongs; of one with time the half-width is the same everywhere.
        inputs : ndarray, shape (N,)
            Input units.
        state : object
            State before the first sample; None is the operator's initial one.

        Raises
        ------
        ValueError
            If the inputs are empty or not finite, or the model has fewer coefficients than that of the band.
        """
        if isinstance(model, TimedModel):
            return np.full(inputs.size, self.pointwise * self.variance.residual)
        variance = self.variance.of(model.regressor(inputs, state))
        return np.asarray(self.pointwise * np.sqrt(self.variance.residual**2 + variance))

    def to_json(self) -> dict[str, Any]:
        """Return the band as a JSON object."""
        return {**{name: getattr(self, name) for name in _NUMBERS}, "variance": self.variance.to_json()}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Band:
        """Return the band that `to_json` wrote.

        Raises ValueError if a key is missing or a value cannot be.
        """
        values: dict[str, Any] = {}
        for name, kind in _NUMBERS.items():
            value = _checks.json_field(document, name, "band")
            values[name] = kind(_checks.number(f"band: {name}", value))
            if values[name] < 0:
                raise ValueError(f"band: {name}: expected a number >= 0, got {value!r}")
        _check_level(values["level"])
        variance = _checks.json_field(document, "variance", "band")
        if not isinstance(variance, dict):
            raise ValueError(f"band: variance: expected an object, got {variance!r}")
        return cls(**values, variance=PredictionVariance.from_json(variance))


_NUMBERS: Mapping[str, type[int] | type[float]] = {
    "level": float,
    "pointwise": float,
    "rows": int,
    "independent": int,
    "held_out": float,
}


def calibrate_band(problem: FitProblem, smoothing: float = 0.0, ridge: float = 0.0, *, level: float = LEVEL) -> Band:
    """Return the prediction band of the model that fits a problem.

    It costs ten fits of the coefficients; the shape parameters and the initial memory are those of all samples.
    Samples of a block that moved parts of the model which the fit without the block has not seen move are left out:
    of the outermost loop there is only one, and a fit without it extrapolates as the model itself need not.

    Parameters
    ----------
    problem : FitProblem
        The problem, as `set_up_problem` makes it.
    smoothing, ridge : float
        Weights of the penalties on roughness and size.
    level : float
        Nominal coverage, between 0 and 1.

    Raises
    ------
    ValueError
        If the level is not between 0 and 1, or the samples are too few.
    """
    used = np.flatnonzero(problem.weights > 0.0)
    used = used[used >= problem.skip]
    found = problem.fit(smoothing, ridge=ridge)
    variance = prediction_variance(problem, found, smoothing, ridge)
    spread = np.sqrt(variance.residual**2 + variance.of(problem.regressor))

    def leave_out(left_out: Flags) -> Floats:
        weights = np.where(left_out, 0.0, problem.weights)
        other = problem.fit(smoothing, weights, ridge)
        unknown = _extrapolated(problem, found, other, weights, variance.residual)
        return np.where(unknown, np.nan, _residuals(problem, other))

    return _calibrated(problem.inputs, used, _residuals(problem, found), spread, leave_out, variance, level)


def calibrate_band_in_time(
    found: Identification[Any],
    times: Floats,
    inputs: Floats,
    outputs: Floats,
    *,
    weights: Floats | None = None,
    level: float = LEVEL,
    **options: Any,  # noqa: ANN401 - each model names and types its own
) -> Band:
    """Return the prediction band of a model with time.

    It costs ten fits.

    Parameters
    ----------
    found : Identification
        What `identify_in_time` returned for the same data and options.
    times : ndarray, shape (N,)
        s, strictly increasing.
    inputs, outputs : ndarray, shape (N,)
        The measured sequence, in input and output units.
    weights : ndarray, shape (N,), or None
        Weight of each sample, those of 0 are not used.
    level : float
        Nominal coverage, between 0 and 1.
    **options
        Those of the fit, `skip` among them. What it chose is kept.

    Raises
    ------
    ValueError
        If the level is not between 0 and 1, the samples are too few, or a fit without some of them fails.
    """
    counted = np.ones(inputs.size) if weights is None else weights
    used = np.flatnonzero(counted > 0.0)
    used = used[used >= found.skip]
    freedom = found.certificate.passive + 1.0
    if used.size <= freedom:
        raise ValueError(
            f"band: {used.size} samples on {freedom:.0f} free coefficients leave nothing to judge the fit by; "
            "take fewer of them or more samples"
        )
    deviation = float(np.sqrt(np.sum(found.residuals[used] ** 2) / (used.size - freedom)))
    fixed = options | found.model.structure()
    if found.regularization is not None:
        fixed["smoothing"] = found.regularization.smoothing

    def leave_out(left_out: Flags) -> Floats:
        kept = np.where(left_out, 0.0, counted)
        return identify_in_time(found.model_name, times, inputs, outputs, weights=kept, **fixed).residuals

    nothing = np.empty(0)
    variance = PredictionVariance(deviation, 0.0, freedom, 0.0, nothing.astype(np.int64), nothing, nothing[:, None])
    return _calibrated(inputs, used, found.residuals, np.full(inputs.size, deviation), leave_out, variance, level)


def _calibrated(
    inputs: Floats,
    used: Indices,
    residuals: Floats,
    spread: Floats,
    leave_out: Callable[[Flags], Floats],
    variance: PredictionVariance,
    level: float,
) -> Band:
    """Return the band from the residuals of the fit to the samples used, and what a fit without some of them leaves.

    `leave_out` returns nan where such a fit extrapolates; `spread` is v.
    """
    _check_level(level)
    count = min(_BLOCKS, used.size // _FEWEST_ROWS)
    if count < 2:
        raise ValueError(f"band: {used.size} samples are too few to leave blocks of them out")
    turns = turns_beyond_noise(inputs)[1:-1]
    block = _blocks(inputs.size, used, count, turns)
    lag = _correlation_lag(residuals[used], used.size // count // 2)
    errors = np.full(inputs.size, np.nan)
    for fold in range(min(_FOLDS, count)):
        left_out = (block >= 0) & (block % _FOLDS == fold)
        if not left_out.any():
            continue
        with_gap = _with_gap(left_out, lag, turns)
        if np.count_nonzero(~with_gap[used]) < 2:
            raise ValueError(f"band: {used.size} samples are too few to leave blocks of them out")
        # What one fit says of itself would hide how many there are.
        with shares_to(lambda *_: None):
            errors[left_out] = leave_out(with_gap)[left_out]
        say_share("calibrating the band", (fold + 1) / _FOLDS)
    scored = np.isfinite(errors)
    if not scored.any():
        raise ValueError("band: each block of the samples moves parts of the model that no other moves")
    scores = np.sort((np.abs(errors) / np.maximum(spread, 1e-300))[scored])
    independent = max(1, scores.size // lag)
    share = min(math.ceil((independent + 1) * level) / independent, 1.0)
    return Band(
        level=level,
        pointwise=float(scores[math.ceil(share * scores.size) - 1]),
        rows=scores.size,
        independent=independent,
        held_out=float(np.sqrt(np.mean(errors[scored] ** 2))),
        variance=variance,
    )


def _check_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ValueError(f"band: level: expected a number between 0 and 1, got {level}")


def input_half_widths(operator: Operator[Any], path: Floats, half_widths: Floats, state: Any = None) -> Floats:  # noqa: ANN401
    """Return the half-width about each input of a path within which its output is met, shape (N,), input units.

    That of the output over the local slope in the direction of arrival, which an input that stays keeps; nan where
    that is more than the operating range, as the output hardly moves with the input, and before the input has moved.

    Parameters
    ----------
    operator : Operator
        The model.
    path : ndarray, shape (N,)
        Input units.
    half_widths : ndarray, shape (N,)
        Half-widths about the outputs there, output units.
    state : object
        State before the first input; None is the operator's initial one.
    """
    low, high = operator.input_range
    memory = operator.initial_state() if state is None else state
    before = np.append(path[0] if operator.memoryless else operator.present_input(memory), path[:-1])
    # A little before the input on the way to it, and at most half the way: the branch is that of the arrival.
    steps = np.clip(0.5 * (before - path), -_STEP * (high - low), _STEP * (high - low))
    close, there = operator.evaluate(np.column_stack([path + steps, path]).ravel(), memory).reshape(-1, 2).T
    moved = np.maximum.accumulate(np.where(steps != 0.0, np.arange(path.size), -1))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.where(moved >= 0, ((close - there) / steps)[moved], np.nan)
        widths = half_widths / np.abs(slopes)
    return np.where(widths <= high - low, widths, np.nan)


def _residuals(problem: FitProblem, found: Fit) -> Floats:
    return problem.outputs - found.bias - problem.regressor.product(found.coefficients)


def _blocks(size: int, used: Indices, count: int, turns: Indices) -> Indices:
    """Return the block of each sample, -1 for those that are not used; they begin at turns where there are some."""
    edges = used[np.arange(1, count) * used.size // count]
    reach = used.size // count // 2
    if turns.size:
        nearest = turns[np.abs(turns[:, None] - edges).argmin(axis=0)]
        edges = np.unique(np.where(np.abs(nearest - edges) <= reach, nearest, edges))
    block = np.searchsorted(edges, np.arange(size), side="right")
    result = np.full(size, -1)
    result[used] = block[used]
    return result


def _correlation_lag(residuals: Floats, most: int) -> int:
    """Return the first lag at which the residuals' autocorrelation is below 2 / √N, at least 1 and at most `most`."""
    spectrum = np.fft.rfft(residuals, 2 * residuals.size)
    products = np.fft.irfft(np.abs(spectrum) ** 2)[: max(most, 1)]
    small = np.flatnonzero(np.abs(products) <= 2.0 * products[0] / np.sqrt(residuals.size))
    return max(int(small[0]) if small.size else most, 1)


def _with_gap(left_out: Flags, lag: int, turns: Indices) -> Flags:
    """Return the samples left out with a gap of `lag` rows on both sides, up to the next turns.

    A branch of which a part is left out is left out altogether: what was measured on the rest of it tells it.
    """
    close = near(left_out, lag)
    branch = np.searchsorted(turns, np.arange(left_out.size), side="right")
    touched = np.zeros(turns.size + 1, dtype=bool)
    touched[branch[close]] = True
    whole = touched[branch]
    # Turns may be far apart: most samples must remain.
    return whole if whole.mean() <= 0.5 else close


def _extrapolated(problem: FitProblem, found: Fit, other: Fit, weights: Floats, scale: float) -> Flags:
    """Return the samples at which parts that a fit without a block has not seen move make a difference of `scale`."""
    unseen = found.certificate.swept & ~other.certificate.swept
    if not unseen.any():
        return np.zeros(problem.inputs.size, dtype=bool)
    seen = int(np.flatnonzero(weights[problem.skip :])[0]) + problem.skip
    # Where a column did not move it is a constant, and that is in the bias.
    moved = problem.regressor.product(np.where(unseen, np.abs(found.coefficients), 0.0))
    flags: Flags = np.abs(moved - moved[seen]) > scale
    return flags
