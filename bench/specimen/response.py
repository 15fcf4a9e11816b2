"""What the specimen does beside its model: its dynamics, and what of the model's error repeats.

The response to a drive is the model's, with a lag of the drive before the hysteresis or late parts behind it where
the transients show them (by the Bayesian information criterion), and the output of a second Preisach operator: the
part of the model's error that cross-validation finds again; see `bench.specimen.correction`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.analysis import SimulatedDrive, TransientRecording, identify_lag, late_parts
from bench.base import Floats
from bench.models import ActuatorDynamics, Operator, ResponseDynamics
from bench.specimen.correction import identify_correction


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
    of_model, left : tuple of ndarray
        By run, the error of the model at each reading of a step, and what of it is left over, output units.
    inputs, errors : tuple of ndarray
        By run, what the specimen saw of the drive at each row, input units; measured less modelled response, without
        a correction, output units.
    """

    dynamics: ResponseDynamics
    correction: Operator[Any] | None
    offsets: tuple[float, ...]
    lag_uncertainty: float
    rms_model: float
    rms: float
    of_model: tuple[Floats, ...]
    left: tuple[Floats, ...]
    inputs: tuple[Floats, ...]
    errors: tuple[Floats, ...]


def identify_response(
    recordings: Sequence[TransientRecording], actuator: ActuatorDynamics, model: Operator[Any]
) -> IdentifiedResponse:
    """Identify the response of a specimen, whose model and actuator are known."""
    dynamics, uncertainty = identify_lag(recordings, actuator, [model.evaluate] * len(recordings))
    inputs, errors = [], []
    for r in recordings:
        drive = SimulatedDrive(r, actuator, float(r.times[-1]))
        seen = drive.behind(dynamics)
        outputs = model.evaluate(seen)
        whole = dynamics.gain * outputs + np.array(dynamics.shares) @ late_parts(outputs, drive.step, dynamics.times)
        inputs.append(drive.at_rows(seen))
        errors.append(r.responded - drive.at_rows(whole))
    readings = [r.is_reading for r in recordings]
    offsets = [float(np.median(error[chosen])) for error, chosen in zip(errors, readings, strict=True)]
    left = np.concatenate([(e - o)[c] for e, o, c in zip(errors, offsets, readings, strict=True)])
    rms_model = float(np.sqrt(np.mean(left**2)))
    uncorrected = IdentifiedResponse(
        dynamics, None, (), uncertainty, rms_model, rms_model, (), (), tuple(inputs), tuple(errors)
    )
    return correct_response(uncorrected, recordings, model, [np.zeros_like(error) for error in errors])


def correct_response(
    response: IdentifiedResponse,
    recordings: Sequence[TransientRecording],
    model: Operator[Any],
    effects: Sequence[Floats],
) -> IdentifiedResponse:
    """Return a response whose correction gives what was measured together with what disturbances add on average.

    Parameters
    ----------
    response : IdentifiedResponse
        The response, with any correction.
    recordings : sequence of TransientRecording
        The runs it was identified from.
    model : Operator
        The model.
    effects : sequence of ndarray
        What disturbances add to the response at each row of each run, on average, output units.
    """
    readings = [r.is_reading for r in recordings]
    errors = [error - effect for error, effect in zip(response.errors, effects, strict=True)]
    offsets = [float(np.median(error[chosen])) for error, chosen in zip(errors, readings, strict=True)]
    left = np.concatenate([error - offset for error, offset in zip(errors, offsets, strict=True)])
    correction = identify_correction(model, response.inputs, left, np.concatenate(readings))
    ends = np.cumsum([int(each.sum()) for each in readings])[:-1]
    return replace(
        response,
        correction=correction.operator,
        offsets=tuple(offsets),
        rms=correction.rms,
        of_model=tuple(np.split(left[np.concatenate(readings)], ends)),
        left=tuple(np.split(correction.left, ends)),
    )
