"""What the specimen does beside its model: its dynamics, and what of the model's error repeats.

The response to a drive is the model's, with a lag of the drive before the hysteresis or late parts behind it where
the transients show them (by the Bayesian information criterion), and the output of a second Preisach operator of
either sign on a finer plane: the part of the model's error that cross-validation finds again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.control.dynamics import ActuatorDynamics, ResponseDynamics
from bench.hysteresis import Operator, Preisach, uniform_levels
from bench.hysteresis._checks import Floats
from bench.transients.actuator import at_rows, grid_step, latency
from bench.transients.recording import Recording
from bench.transients.response import identify_lag, late_parts, seen_by_specimen

_LEVELS = 40
"""Levels of the plane of the second operator."""
_PENALTIES = 10.0 ** np.arange(-6.0, 3.0)
"""Penalties of its densities that cross-validation tries, relative to the mean square of the columns."""
_FOLDS = 5
_BLOCK = 40
"""Folds of the cross-validation, and rows that stay together in it."""


@dataclass(frozen=True)
class IdentifiedResponse:
    """The response of a specimen with the evidence for it.

    Attributes
    ----------
    dynamics : ResponseDynamics
        Lag and late parts.
    correction : Operator or None
        Gives what of the model's error repeats; None if nothing does.
    offsets : tuple of float
        Of the response in each run, output units.
    lag_uncertainty : float
        Standard uncertainty of the lag, s; 0 without one.
    rms_model, rms : float
        Error of the model with its dynamics over the readings of steps, and what is left over with the correction,
        output units.
    unknown : tuple of ndarray
        By run, the error at each reading of a step, of a correction that was made without it, output units.
    """

    dynamics: ResponseDynamics
    correction: Operator[Any] | None
    offsets: tuple[float, ...]
    lag_uncertainty: float
    rms_model: float
    rms: float
    unknown: tuple[Floats, ...]


def identify_response(
    recordings: Sequence[Recording], actuator: ActuatorDynamics, model: Operator[Any]
) -> IdentifiedResponse:
    """Identify the response of a specimen, whose model and actuator are known."""
    dynamics, uncertainty = identify_lag(recordings, actuator, [model.evaluate] * len(recordings))
    step = grid_step(actuator)
    inputs, errors, offsets, readings = [], [], [], []
    for r in recordings:
        end = float(r.times[-1])
        seen = seen_by_specimen(r, actuator, dynamics, end)
        outputs = model.evaluate(seen)
        whole = dynamics.gain * outputs + np.array(dynamics.shares) @ late_parts(outputs, step, dynamics.times)
        error = r.responded - at_rows(r, whole, whole[0], step, latency(actuator))
        offset = float(np.median(error[r.is_reading]))
        inputs.append(at_rows(r, seen, seen[0], step, latency(actuator)))
        errors.append(error - offset)
        offsets.append(offset)
        readings.append(r.is_reading)
    chosen = np.concatenate(readings)
    left = np.concatenate(errors)
    rms_model = float(np.sqrt(np.mean(left[chosen] ** 2)))
    correction, rms, unknown = _identify_correction(model, inputs, left, chosen)
    ends = np.cumsum([int(each.sum()) for each in readings])[:-1]
    return IdentifiedResponse(
        dynamics, correction, tuple(offsets), uncertainty, rms_model, rms, tuple(np.split(unknown, ends))
    )


def _identify_correction(
    model: Operator[Any], inputs: Sequence[Floats], errors: Floats, chosen: NDArray[np.bool_]
) -> tuple[Operator[Any] | None, float, Floats]:
    """Return an operator that gives what of the errors repeats, the RMS that is left, and the errors held out.

    There is no operator if nothing repeats. The last are those at each chosen row of an operator made without it.
    """
    low, high = min(each.min() for each in inputs), max(each.max() for each in inputs)
    plane = model.plane or (float(low), float(high))
    template = Preisach(
        uniform_levels(*plane, _LEVELS),
        np.zeros(_LEVELS * (_LEVELS + 1) // 2),
        input_range=(min(plane[0], float(low)), max(plane[1], float(high))),
        input_unit=model.input_unit,
        output_unit=model.output_unit,
    )
    rows = np.concatenate([template.regressor(each).dense() for each in inputs])[chosen]
    target = errors[chosen]
    rows = np.column_stack([rows, np.ones(target.size)])
    scale = float(np.mean(rows[:, :-1] ** 2)) * target.size or 1.0
    folds = (np.arange(target.size) // _BLOCK) % _FOLDS
    unknown = np.zeros((_PENALTIES.size, target.size))
    for fold in range(_FOLDS):
        kept = folds != fold
        gram, right = rows[kept].T @ rows[kept], rows[kept].T @ target[kept]
        values, vectors = np.linalg.eigh(gram)
        turned, tests = vectors.T @ right, rows[~kept] @ vectors
        for i, penalty in enumerate(_PENALTIES):
            unknown[i, ~kept] = target[~kept] - tests @ (turned / (np.maximum(values, 0.0) + penalty * scale))
    losses = np.sum(unknown**2, axis=1)
    if losses.min() >= float(target @ target):
        return None, float(np.sqrt(np.mean(target**2))), target
    penalty = float(_PENALTIES[int(np.argmin(losses))])
    gram = rows.T @ rows + penalty * scale * np.eye(rows.shape[1])
    solution = np.linalg.solve(gram, rows.T @ target)
    left = target - rows @ solution
    correction = template.with_coefficients(solution[:-1], float(solution[-1]))
    return correction, float(np.sqrt(np.mean(left**2))), unknown[int(np.argmin(losses))]
