"""Prediction bands: how far a model's prediction may be from what is measured, calibrated on blocks left out.

Split-conformal prediction by blocks. The samples are cut into blocks of successive ones, at turning points of the
input where there is one near; the input record is never cut, as what is left out of the cost still drives the memory.
Each block is predicted by a fit without it and without a gap on both sides, and gives scores |y - ŷ| / v, where v² is
the variance of the residuals and of the prediction (`PredictionVariance`). The half-width of the band is q v: q is
the ⌈(n + 1) level⌉-th of n scores. n is the number of independent ones, as many as the gap goes into the samples
(Chernozhukov, Wüthrich and Zhu, PMLR 75:732, 2018). A simultaneous band takes the greatest score of each block.

It holds for inputs of the class on which it was calibrated (`ExcitationClass`); elsewhere it may cover far less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.base import Floats, checks as _checks, say_share, shares_to
from bench.identification.branches import turning_points
from bench.identification.by_name import FitProblem
from bench.identification.choose.splits import near
from bench.identification.design.excitation_class import LEAST_SWING, ExcitationClass
from bench.identification.fit.cell_layout import Flags, Indices
from bench.identification.fit.covariance import PredictionVariance, prediction_variance
from bench.identification.fit.least_squares import Fit
from bench.models import Operator, TimedModel

LEVEL = 0.9
"""Nominal coverage of a band, unless another is asked for."""

_BLOCKS = 20
_FOLDS = 10
_FEWEST_ROWS = 5  # in a block
# Share of the samples that may be worse determined than any of the calibration.
_OUTSIDE = 0.1
# Step for the local slope at an input, as part of the operating range.
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
    simultaneous : float or None
        Factor at which all samples of a stretch of `stretch` rows are covered with that probability; None if the
        blocks are too few for it, level / (1 - level) of them at least.
    stretch : int
        Rows of a block, mean.
    rows : int
        Samples on which the band was calibrated.
    independent : int
        Number of them that count as independent. Below level / (1 - level) `pointwise` is the greatest score.
    blocks : int
        Number of blocks.
    held_out : float
        RMS error of the samples, each predicted by a fit without its block; output units.
    greatest : float
        Greatest standard deviation v of the samples, output units.
    variance : PredictionVariance
        Variance of residuals and predictions.
    calibrated_on : ExcitationClass
        The class of excitation for which the band holds.
    """

    level: float
    pointwise: float
    simultaneous: float | None
    stretch: int
    rows: int
    independent: int
    blocks: int
    held_out: float
    greatest: float
    variance: PredictionVariance
    calibrated_on: ExcitationClass

    def spread(
        self,
        operator: Operator[Any] | TimedModel[Any],
        inputs: Floats,
        state: Any = None,  # noqa: ANN401 - each operator has its own
    ) -> Floats:
        """Return v, the standard deviation by which scores are divided, for a sequence of inputs, shape (N,).

        Parameters
        ----------
        operator : Operator or TimedModel
            The model to which the band belongs; of one with time v is the same everywhere.
        inputs : ndarray, shape (N,)
            Input units.
        state : object
            State before the first sample; None is the operator's initial one.

        Raises
        ------
        ValueError
            If the inputs are empty or not finite, or the model has fewer coefficients than that of the band.
        """
        if isinstance(operator, TimedModel):
            return np.full(inputs.size, self.greatest)
        variance = self.variance.of(operator.regressor(inputs, state))
        return np.asarray(np.sqrt(self.variance.residual**2 + variance))

    def half_widths(
        self,
        operator: Operator[Any],
        inputs: Floats,
        state: Any = None,  # noqa: ANN401 - each operator has its own
        *,
        simultaneous: bool = False,
    ) -> Floats:
        """Return the half-width of the band about each prediction, shape (N,), output units.

        Parameters
        ----------
        operator, inputs, state
            As `spread`.
        simultaneous : bool
            Whether the band covers all samples of a stretch at once, rather than each.

        Raises
        ------
        ValueError
            As `spread`, or if there is no simultaneous band.
        """
        factor = self.simultaneous if simultaneous else self.pointwise
        if factor is None:
            raise ValueError(
                f"band: {self.blocks} blocks are too few for a simultaneous band of {100 * self.level:g} %"
            )
        return factor * self.spread(operator, inputs, state)

    def departures(self, inputs: Floats, spread: Floats, times: Floats | None = None) -> tuple[str, ...]:
        """Return in which ways a sequence is not of the class of the calibration; none if the band holds for it.

        Beside those of `ExcitationClass.departures`: more than 10 % of the samples are worse determined by the data
        of the fit than all samples of the calibration.

        Parameters
        ----------
        inputs : ndarray, shape (N,)
            Input units.
        spread : ndarray, shape (N,)
            What `spread` returns for them.
        times : ndarray, shape (N,), or None
            s, for a model with time.

        Raises
        ------
        ValueError
            If the inputs are empty or not finite.
        """
        found = list(self.calibrated_on.departures(inputs, times))
        worse = float((spread > 1.001 * self.greatest).mean())
        if worse > _OUTSIDE:
            found.append(f"{100 * worse:.0f} % of its rows rest on parts of the model that the data hardly determine")
        return tuple(found)

    def to_json(self) -> dict[str, Any]:
        """Return the band as a JSON object."""
        return {
            **{name: getattr(self, name) for name in _NUMBERS},
            "variance": self.variance.to_json(),
            "calibrated_on": self.calibrated_on.to_json(),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Band:
        """Return the band that `to_json` wrote.

        Raises ValueError if a key is missing or a value cannot be.
        """
        values: dict[str, Any] = {}
        for name, kind in _NUMBERS.items():
            value = _checks.json_field(document, name, "band")
            if value is None and name == "simultaneous":
                values[name] = None
                continue
            values[name] = kind(_checks.number(f"band: {name}", value))
            if values[name] < 0:
                raise ValueError(f"band: {name}: expected a number >= 0, got {value!r}")
        if not 0.0 < values["level"] < 1.0:
            raise ValueError(f"band: level: expected a number between 0 and 1, got {values['level']}")
        parts = {name: _checks.json_field(document, name, "band") for name in ("variance", "calibrated_on")}
        for name, part in parts.items():
            if not isinstance(part, dict):
                raise ValueError(f"band: {name}: expected an object, got {part!r}")
        return cls(
            **values,
            variance=PredictionVariance.from_json(parts["variance"]),
            calibrated_on=ExcitationClass.from_json(parts["calibrated_on"]),
        )


_NUMBERS: Mapping[str, type[int] | type[float]] = {
    "level": float,
    "pointwise": float,
    "simultaneous": float,
    "stretch": int,
    "rows": int,
    "independent": int,
    "blocks": int,
    "held_out": float,
    "greatest": float,
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

    calibrated_on = ExcitationClass.of(problem.inputs[used])
    blocks = LeftOut(problem.inputs, used, _residuals(problem, found), spread, leave_out)
    return blocks.calibrate(variance, calibrated_on, level)


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Blocks of a sequence that are left out of fits, whose errors calibrate a band.

    Parameters
    ----------
    inputs : ndarray, shape (N,)
        Input units.
    used : ndarray of int, shape (n,)
        The rows that count.
    residuals : ndarray, shape (N,)
        Those of the fit to all of them, output units.
    spread : ndarray, shape (N,)
        The standard deviation v of each, output units.
    leave_out : callable
        Takes which rows are left out, shape (N,), and returns the errors of all by a fit without them, shape (N,),
        output units; nan where that fit extrapolates.
    """

    inputs: Floats
    used: Indices
    residuals: Floats
    spread: Floats
    leave_out: Callable[[Flags], Floats]

    def calibrate(self, variance: PredictionVariance, calibrated_on: ExcitationClass, level: float) -> Band:
        """Return the band; arguments and errors as `Band` and `calibrate_band`."""
        if not 0.0 < level < 1.0:
            raise ValueError(f"level: expected a number between 0 and 1, got {level}")
        used, spread = self.used, self.spread
        count = min(_BLOCKS, used.size // _FEWEST_ROWS)
        if count < 2:
            raise ValueError(f"band: {used.size} samples are too few to leave blocks of them out")
        turns = turning_points(self.inputs, LEAST_SWING * float(np.ptp(self.inputs)))[1:-1]
        block = _blocks(self.inputs.size, used, count, turns)
        lag = _correlation_lag(self.residuals[used], used.size // count // 2)
        errors = np.full(self.inputs.size, np.nan)
        for fold in range(min(_FOLDS, count)):
            left_out = (block >= 0) & (block % _FOLDS == fold)
            if not left_out.any():
                continue
            with_gap = _with_gap(left_out, lag, turns)
            if np.count_nonzero(~with_gap[used]) < 2:
                raise ValueError(f"band: {used.size} samples are too few to leave blocks of them out")
            # What one fit says of itself would hide how many there are.
            with shares_to(lambda *_: None):
                errors[left_out] = self.leave_out(with_gap)[left_out]
            say_share("calibrating the band", (fold + 1) / _FOLDS)
        scored = np.isfinite(errors)
        if not scored.any():
            raise ValueError("band: each block of the samples moves parts of the model that no other moves")
        scores = np.abs(errors) / np.maximum(spread, 1e-300)
        independent = max(1, int(np.count_nonzero(scored)) // lag)
        highest = [float(scores[(block == each) & scored].max()) for each in np.unique(block[scored])]
        rank = math.ceil((len(highest) + 1) * level)
        return Band(
            level=level,
            pointwise=_quantile(scores[scored], math.ceil((independent + 1) * level) / independent),
            simultaneous=sorted(highest)[rank - 1] if rank <= len(highest) else None,
            stretch=used.size // count,
            rows=int(np.count_nonzero(scored)),
            independent=independent,
            blocks=len(highest),
            held_out=float(np.sqrt(np.mean(errors[scored] ** 2))),
            greatest=float(spread[used].max()),
            variance=variance,
            calibrated_on=calibrated_on,
        )


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


def _quantile(scores: Floats, share: float) -> float:
    """Return the least score that a share of them does not exceed; the greatest if it is above 1."""
    ordered = np.sort(scores)
    return float(ordered[min(math.ceil(min(share, 1.0) * ordered.size), ordered.size) - 1])


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
