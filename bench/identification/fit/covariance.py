"""The standard uncertainties of identified coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.base import Floats
from bench.identification.fit.least_squares import one_thread
from bench.identification.measures import autocorrelation
from bench.models import Operator

# An eigenvalue below this part of the greatest is no information. Derivation: the rounding of sums of thousands of
# products of numbers of 16 digits.
_NO_INFORMATION = 1e-12


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

    The covariance is s² c (AᵀA)⁻¹ of the centred columns A of the coefficients that are not zero. s² is the residual
    sum over the degrees of freedom; c = (1 + ρ) / (1 - ρ) accounts for the autocorrelation ρ of successive residuals.

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
    correlation = autocorrelation(counted)
    variance = float(counted @ counted) / spare * (1.0 + correlation) / (1.0 - correlation)
    sigmas = np.zeros(coefficients.size)
    sigmas[free] = np.nan
    sigmas[free[known]] = np.sqrt(variance * ((vectors**2) / values).sum(axis=1)) / norms[known]
    return CoefficientUncertainties(
        sigmas,
        f"σ from the residuals of {counted.size} readings, whose neighbours correlate by {correlation:.2f}; "
        "coefficients at zero count as known",
    )
