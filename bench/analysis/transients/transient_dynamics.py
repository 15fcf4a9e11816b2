"""What a model file keeps of the transients from which its model was identified."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.analysis.transients.actuator import IdentifiedActuator, identify_actuator
from bench.analysis.transients.recorded_transients import TransientRecording, recording_of
from bench.analysis.transients.response import POWERS, Model, identify_lag, refine_lag
from bench.base import DataError, Floats
from bench.models import ActuatorDynamics, IdentifiedDynamics, ResponseDynamics
from bench.record import Record

_FEWEST = 10
"""Fewer changes of the set-point, or rows between them, show no dynamics."""
_LONGEST = 800.0
"""Part of a run that is used, s."""
_LEAST = 5e-3
"""Part of a step that counts as none."""
_MOMENT = 0.3
"""Time after a change of a set-point about which no quick reading says much, s."""
_QUIET = 25.0
"""Percentile of the holds by their noise: on steep branches the response moves with what the drive wanders."""


def read_transients(path: Path, drive: str, response: str) -> TransientRecording | None:
    """Return what a run recorded of a drive and a response; None if it shows no transient.

    Parameters
    ----------
    path : Path
        Of the run.
    drive, response : str
        Their signals.

    Raises
    ------
    DataError
        If it is no run, or its record is damaged.
    """
    with Record(path) as record:
        slot: Mapping[str, str] = record.meta.get("slots", {}).get("drive", {})
        if slot.get("signal") != drive or not slot.get("device"):
            return None
        try:
            found = recording_of(path, record, slot["device"], drive, response)
        except DataError:
            return None
    between = int((~found.is_reading).sum())
    return found if found.changes.size >= _FEWEST and between >= _FEWEST else None


@dataclass(frozen=True, eq=False)
class Transients:
    """What runs show of a drive and its response independently of the model of the specimen."""

    recordings: tuple[TransientRecording, ...]
    actuator: IdentifiedActuator  # the dynamics of the drive
    # Standard deviation of one reading of the drive, input units, and of the response, output units.
    noise: tuple[float, float]
    first_look: float  # median time from a change of the set-point to the next reading, s


def identify_transients(recordings: Sequence[TransientRecording]) -> Transients:
    """Identify what the transients of runs show without a model of the specimen."""
    noise = (
        max(noise_of(each, each.driven) for each in recordings),
        max(noise_of(each, each.responded) for each in recordings),
    )
    if all(_follows_at_once(each) for each in recordings):
        actuator = IdentifiedActuator(ActuatorDynamics(), {}, noise[0])
    else:
        actuator = identify_actuator(recordings, _LONGEST)
    firsts = np.concatenate([_first_looks(each) for each in recordings])
    return Transients(tuple(recordings), actuator, noise, float(np.median(firsts)))


def identify_dynamics(
    transients: Transients,
    models: Sequence[Model],
    names: tuple[str, str] = ("input", "output"),
    swings: Sequence[TransientRecording] = (),
) -> IdentifiedDynamics:
    """Identify the dynamics of a response beside those of its drive.

    Parameters
    ----------
    transients : Transients
        What the runs show of the drive.
    models : sequence of callable
        For each of the runs what comes of the drive at rest.
    names : (str, str)
        What drive and response are called.
    swings : sequence of TransientRecording
        Moves over the whole range of the drive, a recording for each model, if there are any. They tell the power of
        the drive that lags: small steps are nearly the same by either.
    """
    recordings, actuator = transients.recordings, transients.actuator
    response, uncertainty = identify_lag(recordings, actuator.dynamics, models, _LONGEST)
    uncertainties = dict(actuator.uncertainties)
    # Late parts are in part what the model errs by at rest, and a controller learns of that by measuring.
    if response.lag:
        response = ResponseDynamics(response.lag, response.power)
        powers: Sequence[float] = POWERS
        if swings:
            powers = (refine_lag(swings, actuator.dynamics, models, response, _LONGEST)[0].power,)
        response, uncertainty = refine_lag(recordings, actuator.dynamics, models, response, _LONGEST, powers)
        uncertainties["lag"] = uncertainty
    else:
        response = ResponseDynamics()
    return IdentifiedDynamics(
        actuator.dynamics,
        response,
        dict(zip(names, transients.noise, strict=True)),
        uncertainties,
        transients.first_look / 3.0,
        ", ".join(each.path.name for each in recordings),
    )


def _follows_at_once(recording: TransientRecording) -> bool:
    """Return whether the first look after a change of the set-point shows nothing of the change any more."""
    rows = np.searchsorted(recording.times, recording.changes + _MOMENT)
    steps = np.diff(np.append(recording.driven[0], recording.setpoints))
    known = (rows < recording.times.size) & (steps != 0.0)
    away, steps = recording.setpoints[known] - recording.driven[rows[known]], steps[known]
    if steps.size < _FEWEST:
        return False
    squares = float(steps @ steps)
    share = float(away @ steps) / squares
    left = away - share * steps
    return abs(share) <= max(3.0 * float(np.sqrt(left @ left / (steps.size - 1) / squares)), _LEAST)


def noise_of(recording: TransientRecording, values: Floats) -> float:
    """Return the noise of readings: of neighbouring rows late in a hold, in the quiet ones of the holds.

    At least what rounding leaves: the last digit over √12.
    """
    last = recording.last_change
    late = recording.since_change > 0.5 * _hold_times(recording)
    same = (np.diff(last) == 0) & late[1:] & late[:-1]
    differences, holds = np.abs(np.diff(values))[same], last[1:][same]
    if differences.size == 0:
        return 0.0
    by_hold = np.split(differences, np.flatnonzero(np.diff(holds)) + 1)
    found = [float(np.sqrt(np.mean(each**2) / 2.0)) for each in by_hold]
    steps = np.diff(np.unique(values))
    digit = float(np.min(steps)) if steps.size and np.unique(values).size < 0.5 * values.size else 0.0
    return max(float(np.percentile(found, _QUIET)), digit / math.sqrt(12.0))


def _hold_times(recording: TransientRecording) -> Floats:
    """Return the length of the hold of each row, s; infinite before the first."""
    ends = np.append(recording.changes[1:], recording.times[-1])
    lengths = np.append(np.inf, ends - recording.changes)
    return np.asarray(lengths[recording.last_change + 1])


def _first_looks(recording: TransientRecording) -> Floats:
    """Return how long after each change of the set-point the next row was taken, s."""
    rows = np.searchsorted(recording.times, recording.changes + 1e-6)
    known = rows < recording.times.size
    return np.asarray(recording.times[rows[known]] - recording.changes[known])
