"""Prediction bands: how far a model's prediction may be from what is measured, calibrated on blocks left out.

The method is split-conformal prediction by blocks. The samples are cut into blocks of successive ones, at turning
points of the input where there is one near. The input record is never cut, as samples left out of the cost still
drive the memory. A fit without a block, and without a gap on both sides of it, predicts the block. The half-width of
the band is the ⌈(n + 1) level⌉-th of n such errors |y - ŷ|. n counts independent errors: the number of gaps that go
into the samples (Chernozhukov, Wüthrich and Zhu, PMLR 75:732, 2018).

A band holds for inputs like those of its record, and not beyond the validity of the model (`Validity`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from bench.base import Floats, checks as _checks, say_share, shares_to
from bench.identification.branches import turns_beyond_noise
from bench.identification.by_name import FitProblem, Identification
from bench.identification.choose.splits import near
from bench.identification.fit.cell_layout import Flags, Indices
from bench.identification.fit.least_squares import Fit
from bench.identification.timed.identify_in_time import identify_in_time
from bench.models import Operator

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


@dataclass(frozen=True)
class Band:
    """A prediction band of one model.

    Parameters
    ----------
    level : float
        Nominal coverage, 0 to 1.
    half_width : float
        Half-width of the band about each prediction, output units.
    rows : int
        Samples on which the band was calibrated.
    independent : int
        Number of them that count as independent. Below level / (1 - level) the half-width is the greatest error.
    held_out : float
        RMS error of the samples, each predicted by a fit without its block; output units.
    """

    level: float
    half_width: float
    rows: int
    independent: int
    held_out: float

    def to_json(self) -> dict[str, Any]:
        """Return the band as a JSON object."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Band:
        """Return the band that `to_json` wrote.

        Raises ValueError if a key is missing or a value cannot be.
        """
        values = {
            field.name: _checks.number(f"band: {field.name}", _checks.json_field(document, field.name, "band"))
            for field in fields(cls)
        }
        for name, value in values.items():
            if value < 0.0:
                raise ValueError(f"band: {name}: expected a number >= 0, got {value!r}")
        _check_level(values["level"])
        return cls(**values | {name: int(values[name]) for name in ("rows", "independent")})  # type: ignore[arg-type]


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
    residuals = _residuals(problem, found)
    scale = float(np.sqrt(np.mean(residuals[used] ** 2)))

    def leave_out(left_out: Flags) -> Floats:
        weights = np.where(left_out, 0.0, problem.weights)
        other = problem.fit(smoothing, weights, ridge)
        unknown = _extrapolated(problem, found, other, weights, scale)
        return np.where(unknown, np.nan, _residuals(problem, other))

    return _calibrated(problem.inputs, used, residuals, leave_out, level)


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
    fixed = options | found.model.structure()
    if found.regularization is not None:
        fixed["smoothing"] = found.regularization.smoothing

    def leave_out(left_out: Flags) -> Floats:
        kept = np.where(left_out, 0.0, counted)
        return identify_in_time(found.model_name, times, inputs, outputs, weights=kept, **fixed).residuals

    return _calibrated(inputs, used, found.residuals, leave_out, level)


def _calibrated(
    inputs: Floats, used: Indices, residuals: Floats, leave_out: Callable[[Flags], Floats], level: float
) -> Band:
    """Return the band; `leave_out` returns the residuals of a fit without some samples, nan where it extrapolates."""
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
    sizes = np.sort(np.abs(errors[scored]))
    independent = max(1, sizes.size // lag)
    share = min(math.ceil((independent + 1) * level) / independent, 1.0)
    half_width = float(sizes[math.ceil(share * sizes.size) - 1])
    return Band(level, half_width, sizes.size, independent, float(np.sqrt(np.mean(sizes**2))))


def _check_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ValueError(f"band: level: expected a number between 0 and 1, got {level}")


def input_half_widths(
    operator: Operator[Any],
    path: Floats,
    half_widths: Floats | float,
    state: Any = None,  # noqa: ANN401 - each operator has its own
) -> Floats:
    """Return the half-width about each input of a path within which its output is met, shape (N,), input units.

    That of the output over the local slope in the direction of arrival, which an input that stays keeps; nan where
    that is more than the operating range, as the output hardly moves with the input, and before the input has moved.

    Parameters
    ----------
    operator : Operator
        The model.
    path : ndarray, shape (N,)
        Input units.
    half_widths : ndarray, shape (N,), or float
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
