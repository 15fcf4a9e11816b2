"""The covariance of identified coefficients, compact, and what it means for predictions.

The prediction of row t is mean + (a_t - ā)ᵀ x with the passive columns a_t and their weighted means ā, so that its
variance is s² c (1/W + (a_t - ā)ᵀ (AᵀWA + λL)⁻¹ (a_t - ā)): s² the residual sum over (N - degrees of freedom), c the
factor of correlated residuals, W the sum of the weights, λL the roughness penalty (with it the posterior covariance).
It is conditional on the passive set: coefficients held at zero have none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.base import Floats, checks as _checks
from bench.identification.by_name import FitProblem
from bench.identification.design.excitation import ramps
from bench.identification.fit.cell_layout import CellLayout, Indices
from bench.identification.fit.least_squares import Fit, _ActiveSet, _cost, one_thread
from bench.identification.fit.scaled_columns import unit_of_penalties
from bench.models import Operator, Regressor

MOST_COLUMNS = 1500
"""Beyond so many free coefficients their covariance is left out: the uncertainty of a prediction then is constant.
Derivation: its matrix takes 18 MB, and its inverse 3e9 products."""

# The directions that are kept carry this part of the variance of the predictions, or take this many numbers.
# Derivation: a part of 0.001 of a variance is 0.05 % of the standard deviation; numbers of 20 characters take 0.3 MB
# of a model file.
_CAPTURED = 0.999
_MOST_NUMBERS = 16000
# An eigenvalue below this part of the greatest is no information: a minimum norm leaves that direction at zero.
# Derivation: the rounding of sums of thousands of products of numbers of 16 digits.
_NO_INFORMATION = 1e-12
# Ramps of the reference sequence, on which directions are compared, and rows of each over the whole range. Source: a
# choice; rows of 24 parts are closer than the levels of the usual plane of 20.
_REFERENCE = (60, 24)


@dataclass(frozen=True, eq=False)
class PredictionVariance:
    """Variance of predictions, from the covariance of the free coefficients in a few directions.

    Kept are the directions of coefficients in which predictions vary most, within 16 000 numbers: all of 120 free
    coefficients, a few of 1000, as K × K numbers would be a file larger than the data. The mean variance of the
    others is a constant. A band does not depend on that: its half-width is calibrated with the variance kept.

    Parameters
    ----------
    residual : float
        Standard deviation s of the residuals, output units.
    correlation : float
        Autocorrelation ρ of successive residuals, -1 to 1. If positive, N samples count as N (1 - ρ) / (1 + ρ).
    freedom : float
        Degrees of freedom of the fit: rank of the free columns and 1, less what smoothing determines.
    constant : float
        Variance of a prediction at the mean of the columns, and the mean of what the directions left out would add;
        squared output units.
    columns : ndarray of int, shape (p,)
        Free columns of the regressor.
    means : ndarray, shape (p,)
        Their weighted means.
    factor : ndarray, shape (p, r)
        F with F Fᵀ ≈ the covariance of these coefficients, the factor of correlated residuals in it.
    """

    residual: float
    correlation: float
    freedom: float
    constant: float
    columns: Indices
    means: Floats
    factor: Floats

    def of(self, regressor: Regressor) -> Floats:
        """Return the variance of the predictions of the rows of a regressor, shape (N,), squared output units.

        That of the mean: a measured output has the variance of the residuals beside it.

        Raises ValueError if the regressor has too few columns.
        """
        count = regressor.shape[1]
        if self.columns.size and self.columns[-1] >= count:
            raise ValueError(f"band: belongs to a model of more than {self.columns[-1]} coefficients, not {count}")
        variance = np.full(regressor.shape[0], self.constant)
        direction = np.zeros(count)
        for column in self.factor.T:
            # Contiguous, so that what was read from a file gives the same to the last bit.
            vector = np.ascontiguousarray(column)
            direction[self.columns] = vector
            variance += (regressor.product(direction) - self.means @ vector) ** 2
        return variance

    def to_json(self) -> dict[str, Any]:
        """Return the content as a JSON object; means, and each column of `factor`, as a text of numbers."""
        return {
            "residual": self.residual,
            "correlation": self.correlation,
            "freedom": self.freedom,
            "constant": self.constant,
            "columns": self.columns.tolist(),
            "means": _text(self.means),
            "factor": [_text(vector) for vector in self.factor.T],
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> PredictionVariance:
        """Return what `to_json` wrote.

        Raises ValueError if a key is missing or a value cannot be.
        """

        def read(name: str) -> Any:  # noqa: ANN401 - any JSON
            return _checks.json_field(document, name, "band: variance")

        numbers = {
            name: _checks.number(name, read(name)) for name in ("residual", "correlation", "freedom", "constant")
        }
        if numbers["residual"] < 0.0 or numbers["constant"] < 0.0:
            raise ValueError("band: variance: expected a residual and a constant >= 0")
        columns = np.array(read("columns"), dtype=np.int64)
        means = np.array(read("means").split(), dtype=np.float64)
        directions = [np.array(text.split(), dtype=np.float64) for text in read("factor")]
        if any(vector.shape != columns.shape or not np.isfinite(vector).all() for vector in (means, *directions)):
            raise ValueError("band: variance: expected as many finite means and factors as columns")
        factor = np.reshape(directions, (len(directions), columns.size)).T
        if columns.size and (columns[0] < 0 or (np.diff(columns) <= 0).any()):
            raise ValueError("band: variance: expected columns that increase from 0 on")
        return cls(**numbers, columns=columns, means=means, factor=factor)


def prediction_variance(problem: FitProblem, found: Fit, smoothing: float, ridge: float = 0.0) -> PredictionVariance:
    """Return the variance of a fitted problem's predictions.

    Parameters
    ----------
    problem : FitProblem
        The problem.
    found : Fit
        What `problem.fit(smoothing, ridge=ridge)` returned.
    smoothing, ridge : float
        Weights of the penalties on roughness and size.

    Raises
    ------
    ValueError
        If there are no degrees of freedom left.
    """
    y, w = _cost(problem.regressor, problem.outputs, problem.weights, problem.skip)
    used = w > 0.0
    residuals = (y - found.bias - problem.regressor.product(found.coefficients))[used]
    # Without signs and penalties the coefficients are those of the least norm.
    definite = problem.spec.constrained or smoothing > 0.0 or ridge > 0.0
    chosen = np.flatnonzero(found.coefficients if definite else found.certificate.swept)
    root = means = np.empty(0)
    with one_thread():
        if 0 < chosen.size <= MOST_COLUMNS:
            chosen, means, root, freedom = _inverse_root(problem, y, w, chosen, (smoothing, ridge), definite)
        else:
            freedom = float(min(found.certificate.passive, chosen.size))
            chosen = np.empty(0, dtype=np.int64)
        factor, rest = _principal(problem.template, chosen, means, root)
    freedom += 1.0
    spare = residuals.size - freedom
    if spare < 1.0:
        raise ValueError(
            f"band: {residuals.size} samples on {freedom:.0f} free coefficients leave nothing to judge the fit by; "
            "take fewer levels or more samples"
        )
    variance = float(w[used] @ residuals**2) / spare
    correlation = _correlation(residuals)
    inflated = variance * (1.0 + max(correlation, 0.0)) / (1.0 - max(correlation, 0.0))
    return PredictionVariance(
        residual=_short(np.sqrt(variance)),
        correlation=_short(correlation),
        freedom=_short(freedom),
        constant=_short(inflated * (1.0 / float(w.sum()) + rest)),
        columns=chosen,
        means=np.vectorize(_short, otypes=[float])(means),
        factor=np.vectorize(_short, otypes=[float])(np.sqrt(inflated) * factor),
    )


def _inverse_root(
    problem: FitProblem, y: Floats, w: Floats, chosen: Indices, penalties: tuple[float, float], definite: bool
) -> tuple[Indices, Floats, Floats, float]:
    """Return columns, their means, B with B Bᵀ = (AᵀWA + λL)⁻¹ of them, and their degrees of freedom."""
    from scipy.linalg import eigh, solve_triangular

    regressor = problem.regressor
    unit = unit_of_penalties(regressor, w) if any(penalties) else 1.0
    state = _ActiveSet(
        regressor,
        y,
        w,
        np.zeros(regressor.shape[1], dtype=bool),
        CellLayout.of(regressor.base.size),
        penalties[0] * unit,
        penalties[1] * unit,
    )
    if definite:
        state.enter(chosen)
        order = np.argsort(state.passive)
        root = solve_triangular(state.factor.dense().T, np.eye(state.factor.size))[order]
        columns = state.passive[order]
        _, freedom = state.variances()
    else:
        values, vectors = eigh(state.gram(chosen, chosen[:0]))
        kept = values > _NO_INFORMATION * values[-1]
        root = vectors[:, kept] / np.sqrt(values[kept])
        columns, freedom = chosen, float(np.count_nonzero(kept))
    return columns, state.means[columns], root / state.norms[columns][:, None], freedom


def _principal(template: Operator[Any], columns: Indices, means: Floats, root: Floats) -> tuple[Floats, float]:
    """Return the part of B, shape (p, r), that carries most of the variance of predictions, and the mean of the rest.

    It is that on a reference sequence: random reversals over the operating range, behind one loop of the whole range.
    """
    if not columns.size:
        return np.zeros((0, 0)), 0.0
    low, high = template.input_range
    count, rows = _REFERENCE
    targets = np.random.default_rng(0).uniform(low, high, count)
    reference = template.regressor(ramps([low, high, low, *targets.tolist()], (high - low) / rows))
    seen = (reference.dense()[:, columns] - means) @ root
    _, singular, directions = np.linalg.svd(seen, full_matrices=False)
    left = np.append((singular**2)[::-1].cumsum()[::-1], 0.0)
    enough = int(np.argmax(left <= (1.0 - _CAPTURED) * left[0]))
    kept = min(enough, max(_MOST_NUMBERS // columns.size, 1))
    return root @ directions[:kept].T, float(left[kept]) / seen.shape[0]


def _correlation(residuals: Floats) -> float:
    """Return the autocorrelation of successive residuals, at most 0.99 for the sake of what is divided by 1 - ρ."""
    total = float(residuals @ residuals)
    return min(float(residuals[1:] @ residuals[:-1]) / total, 0.99) if total > 0.0 else 0.0


def _text(values: Floats) -> str:
    """Return numbers as one text, as JSON would give each a line of its own."""
    return " ".join(map(repr, values.tolist()))


def _short(value: float) -> float:
    """Return a number of five digits: an uncertainty needs no more, and files stay small."""
    return float(f"{value:.5g}")


@dataclass(frozen=True, eq=False)
class CoefficientUncertainties:
    """Standard uncertainties of the coefficients of a model, from a sequence.

    Attributes
    ----------
    sigmas : ndarray, shape (K,), or None
        In the units of the coefficients; nan for one that the sequence does not determine, 0 for one that is held at
        zero. None if they are not computed.
    text : str
        How they were found, or why they were not.
    """

    sigmas: Floats | None
    text: str


_MOST_WORK = 2e9
"""Rows times the square of the free coefficients, up to which uncertainties take a second or so. Source: a core
carries out some 1e9 products in a second."""


def coefficient_uncertainties(
    operator: Operator[Any],
    inputs: Floats,
    residuals: Floats,
    state: Any = None,  # noqa: ANN401 - each operator has its own
    skip: int = 0,
) -> CoefficientUncertainties:
    """Return the standard uncertainties of a model's coefficients, as a sequence without penalties determines them.

    The covariance is s² c (AᵀA)⁻¹ of the centred columns of the coefficients that are not zero; s² and c as above.

    Parameters
    ----------
    operator : Operator
        The model.
    inputs, residuals : ndarray, shape (N,)
        Inputs, and measured less predicted outputs.
    state : object
        State before the first sample; default the initial one.
    skip : int
        First samples that do not count.
    """
    coefficients = operator.coefficients
    free = np.flatnonzero(coefficients)
    counted = residuals[skip:]
    spare = counted.size - free.size - 1
    if not free.size:
        return CoefficientUncertainties(np.zeros(coefficients.size), "no coefficient is free")
    if spare < 1:
        return CoefficientUncertainties(None, f"{counted.size} samples do not determine {free.size} coefficients")
    if counted.size * float(free.size) ** 2 > _MOST_WORK:
        return CoefficientUncertainties(None, f"no σ: {free.size} free coefficients are too many to compute it here")
    columns = operator.regressor(inputs, state).dense()[skip:, free]
    columns -= columns.mean(axis=0)
    norms = np.sqrt((columns**2).sum(axis=0))
    known = norms > 0.0
    with one_thread():
        values, vectors = np.linalg.eigh((columns[:, known] / norms[known]).T @ (columns[:, known] / norms[known]))
    if not known.any() or values[0] <= _NO_INFORMATION * values[-1]:
        return CoefficientUncertainties(
            None, "no σ: the readings determine only sums of these coefficients, not each by itself"
        )
    correlation = max(_correlation(counted), 0.0)
    variance = float(counted @ counted) / spare * (1.0 + correlation) / (1.0 - correlation)
    sigmas = np.zeros(coefficients.size)
    sigmas[free] = np.nan
    sigmas[free[known]] = np.sqrt(variance * ((vectors**2) / values).sum(axis=1)) / norms[known]
    return CoefficientUncertainties(
        sigmas,
        f"σ from the residuals of {counted.size} readings, whose neighbours correlate by {correlation:.2f}; "
        "coefficients at zero count as known",
    )
