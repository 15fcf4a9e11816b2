"""How the response of a specimen follows its drive: hysteresis, and a lag before it or late parts behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.analysis import SimulatedDrive, TransientRecording, identify_lag, late_parts
from bench.base import Floats
from bench.models import ActuatorDynamics, Operator, ResponseDynamics


@dataclass(frozen=True)
class IdentifiedResponse:
    """The response of a specimen with the evidence for it."""

    dynamics: ResponseDynamics  # lag and late parts
    lag_uncertainty: float  # standard uncertainty of the lag, s; 0 without one
    offsets: tuple[float, ...]  # of the response in each run, output units
    # Shape (N,); by run, measured less modelled response at each row, without the offset, output units.
    errors: tuple[Floats, ...]
    rms: float  # of the errors at the readings of steps, output units


def identify_response(
    recordings: Sequence[TransientRecording], actuator: ActuatorDynamics, model: Operator[Any]
) -> IdentifiedResponse:
    """Identify the response of a specimen, whose model and actuator are known; see `bench.analysis.identify_lag`."""
    dynamics, uncertainty = identify_lag(recordings, actuator, [model.evaluate] * len(recordings))
    offsets, errors = [], []
    for r in recordings:
        drive = SimulatedDrive(r, actuator, float(r.times[-1]))
        outputs = model.evaluate(drive.behind(dynamics))
        late = np.array(dynamics.shares) @ late_parts(outputs, drive.step, dynamics.times)
        error = r.responded - drive.at_rows(dynamics.gain * outputs + late)
        offsets.append(float(np.median(error[r.is_reading])))
        errors.append(error - offsets[-1])
    left = np.concatenate([error[r.is_reading] for error, r in zip(errors, recordings, strict=True)])
    return IdentifiedResponse(dynamics, uncertainty, tuple(offsets), tuple(errors), float(np.sqrt(np.mean(left**2))))
