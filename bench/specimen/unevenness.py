"""What the model does not know of the specimen: its error on a history that it was not identified from.

The error of a model changes as the drive moves, and stands while that stands. It is taken as a shift of the drive
with an exponential correlation over the travel: that with which a simulation shows the mean squares that the errors
of held-out readings have, by the number of readings between two and by the slope of the response.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bench.analysis import TransientRecording
from bench.base import Floats
from bench.models import Operator
from bench.specimen.differences import SLOPES, Differences, least_known
from bench.specimen.disturbances import Noise, Part
from bench.specimen.specimen import Dynamics, Unevenness

_GAPS = (1, 3, 10, 30, 100)
"""Readings from one to the other of a pair."""
_SEED = 1000


def identify_unevenness(
    recordings: Sequence[TransientRecording],
    of_model: Sequence[Floats],
    left: Sequence[Floats],
    operators: Sequence[Operator[Any]],
    dynamics: Dynamics,
    effects: Sequence[Floats],
    noise: Noise,
) -> Unevenness:
    """Return the unevenness that the run shows which the model knows least.

    Parameters
    ----------
    recordings : sequence of TransientRecording
        The runs.
    of_model, left : sequence of ndarray
        Errors of the model at the readings of each, and what the correction leaves of them.
    operators, dynamics
        The specimen as far as it is known, with wander and drift.
    effects : sequence of ndarray
        What wander adds to each row of each run on average, which the errors are without.
    noise : Noise
        Of the response.
    """
    from scipy.optimize import minimize

    least = least_known(recordings, of_model)
    if least is None:
        return Unevenness()
    recording = recordings[least]
    part = Part(recording, tuple(operators), dynamics)
    rows = part.readings
    effect = effects[least][rows]
    errors = of_model[least]
    explained = errors - left[least]
    differences = Differences(part.slopes[rows], _GAPS)

    def squares(values: Floats) -> Floats:
        return np.vstack([differences.squares(values), differences.variances(values)])

    # With what is explained, the twin differs from the model as much as the specimen does.
    target = np.maximum(squares(errors) - squares(explained), 0.0)
    used = np.isfinite(target) & (target > 0.0)
    if not used.any():
        return Unevenness()
    # Where the response is steep, errors are great and matter most.
    weights, wanted = np.sqrt(target[used] / target[used].max()), np.log(target[used])
    white = noise.reading**2 * np.array([2.0] * len(_GAPS) + [1.0])[:, None] * np.ones(SLOPES)
    span = float(np.ptp(recording.driven))

    def trial(numbers: Floats) -> Unevenness:
        deviation, length = np.exp(np.clip(numbers, -25.0, 5.0)).tolist()
        return Unevenness(deviation * span, length * span)

    def cost(numbers: Floats) -> float:
        uneven = replace(dynamics, unevenness=trial(numbers))
        found = squares(part.simulate(uneven, _SEED)[rows] - effect) + white
        return float(np.sum(weights * (np.log(found[used]) - wanted) ** 2)) + 10.0 * max(
            float(numbers[1]) - math.log(2.0), 0.0
        )

    start = np.log([2e-3, 0.1])
    solved = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={
            "maxfev": 40,
            "initial_simplex": np.vstack([start, start + np.diag([1.0, 1.0])]),
            "xatol": 0.05,
            "fatol": 0.01,
        },
    )
    return trial(solved.x)
