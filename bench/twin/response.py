"""What the specimen does beside its model: its dynamics, and what of the model's error repeats.

The response to a drive is the model's, with a lag of the drive before the hysteresis or late parts behind it where
the transients show them (by the Bayesian information criterion), and the output of a second Preisach operator: the
part of the model's error that cross-validation finds again; see `bench.twin.correction`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.control.dynamics import ActuatorDynamics, ResponseDynamics
from bench.hysteresis import Operator
from bench.hysteresis._checks import Floats
from bench.transients.recording import Recording
from bench.transients.response import SimulatedDrive, identify_lag, late_parts
from bench.twin.correction import identify_correction


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
    inputs, errors, offsets, readings = [], [], [], []
    for r in recordings:
        drive = SimulatedDrive(r, actuator, float(r.times[-1]))
        seen = drive.behind(dynamics)
        outputs = model.evaluate(seen)
        whole = dynamics.gain * outputs + np.array(dynamics.shares) @ late_parts(outputs, drive.step, dynamics.times)
        error = r.responded - drive.at_rows(whole)
        offset = float(np.median(error[r.is_reading]))
        inputs.append(drive.at_rows(seen))
        errors.append(error - offset)
        offsets.append(offset)
        readings.append(r.is_reading)
    chosen = np.concatenate(readings)
    left = np.concatenate(errors)
    rms_model = float(np.sqrt(np.mean(left[chosen] ** 2)))
    correction = identify_correction(model, inputs, left, chosen)
    ends = np.cumsum([int(each.sum()) for each in readings])[:-1]
    return IdentifiedResponse(
        dynamics,
        correction.operator,
        tuple(offsets),
        uncertainty,
        rms_model,
        correction.rms,
        tuple(np.split(correction.unknown, ends)),
    )
