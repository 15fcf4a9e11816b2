"""What excitations tell about the coefficients of an operator, by the determinant of the information.

With output noise of standard deviation σ and a weak prior on the coefficients, measured rows a_t of the regressor
give the information I + Σ a_t a_tᵀ, in units in which the prior is the identity (Bayesian D-optimality: Chaloner and
Verdinelli, Statistical Science 10(3), 273-304, 1995). The variance of a prediction from a row a is aᵀ C a σ², with C
the inverse. The prior says that each coefficient moves the output by its share of the range, so that a sequence of
deficient rank has a finite determinant too; with more than a few rows a cell it hardly counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.design.excitation import random_validation
from bench.models import Operator

NOISE = 0.01
"""Noise of the output as a share of its range, where it is not known. Source: instruments here stay below it."""

# Derivation: steps of half a percent of the range are finer than the levels of a plane of 100.
_SAMPLES = 201
# Derivation: an average over them is known to 1 / √2000 of the scatter, 2 %.
_REVERSALS = 2000
# Source: a choice; any would do.
_SEED = 0


@dataclass(frozen=True, eq=False)
class Scaling:
    """Units in which the prior of the coefficients and of the bias is the identity, and the noise is 1."""

    factors: Floats  # shape (K + q,); by which columns of the regressor are multiplied
    bias: float  # the column of the bias

    @classmethod
    def of(cls, operator: Operator[Any], noise: float = NOISE) -> Scaling:
        """Return the scaling for an operator, with the noise as a share of its output range.

        Raises ValueError if the noise is not positive.
        """
        if not _checks.number("noise", noise) > 0.0:
            raise ValueError(f"noise: expected a positive number, got {noise}")
        up = np.linspace(*operator.input_range, _SAMPLES)
        swings = np.ptp(operator.regressor(np.concatenate([up, up[::-1]])).dense(), axis=0)
        count = swings.size
        moved = swings > 1e-12 * swings.max(initial=0.0)
        factors = np.where(moved, 1.0 / (noise * math.sqrt(count) * np.where(moved, swings, 1.0)), 0.0)
        return cls(factors, 1.0 / noise)

    def rows(self, operator: Operator[Any], inputs: ArrayLike, state: Any = None) -> Floats:  # noqa: ANN401 - the operator's
        """Return the scaled rows of a sequence, shape (N, K + q + 1); state and errors as `Operator.regressor`."""
        return self.scaled(operator.regressor(inputs, state).dense())

    def scaled(self, matrix: Floats) -> Floats:
        """Return the scaled rows of a regressor, shape (N, K + q), as shape (N, K + q + 1)."""
        return np.column_stack([matrix * self.factors, np.full(matrix.shape[0], self.bias)])


def log_determinant(rows: Floats, factor: float = 1.0) -> float:
    """Return log10 det(I + factor Σ a aᵀ) of scaled rows, shape (N, n), in decades per coefficient."""
    count = rows.shape[1]
    if not math.isfinite(factor):
        return math.inf
    # The smaller of the two Gram matrices has the same determinant.
    gram = rows.T @ rows if rows.shape[0] > count else rows @ rows.T
    gram *= factor
    gram[np.diag_indices_from(gram)] += 1.0
    logarithm = float(np.linalg.slogdet(gram)[1])
    return logarithm / (math.log(10.0) * int(count))


def covariance(rows: Floats) -> Floats:
    """Return C = (I + Σ a aᵀ)⁻¹ of scaled rows, shape (n, n)."""
    gram = rows.T @ rows
    gram[np.diag_indices_from(gram)] += 1.0
    inverse = np.linalg.inv(gram)
    return 0.5 * (inverse + inverse.T)


def mean_variance(rows: Floats, spread: Floats) -> float:
    """Return the mean of aᵀ C a over scaled rows, shape (N, n): variance of the prediction over that of the noise."""
    return float(np.einsum("ij,jk,ik->i", rows, spread, rows, optimize=True).mean())


def random_reversals(operating: tuple[float, float], step: float) -> Floats:
    """Return the inputs by which predictions are judged: ramps between random reversals in a range, always the same.

    Raises ValueError if the range does not increase, or the step is not positive.
    """
    rng = np.random.default_rng(_SEED)
    return random_validation(rng, _REVERSALS, operating=operating, transition=operating, step=step)
