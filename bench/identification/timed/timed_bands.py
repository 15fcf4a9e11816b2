"""Prediction bands of models with time, calibrated on blocks left out as those of models without.

Each fit without a block is one of the whole model, its times and shape too. The standard deviation v by which errors
are divided is that of the residuals everywhere. The class of excitation has the rates of the input beside its kind.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base import Floats
from bench.identification.bands import LEVEL, Band, LeftOut
from bench.identification.by_name import Identification
from bench.identification.design.excitation_class import ExcitationClass
from bench.identification.fit.cell_layout import Flags
from bench.identification.fit.covariance import PredictionVariance
from bench.identification.timed.identify_in_time import identify_in_time


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
    blocks = LeftOut(inputs, used, found.residuals, np.full(inputs.size, deviation), leave_out)
    return blocks.calibrate(variance, ExcitationClass.of(inputs[used], times[used]), level)
