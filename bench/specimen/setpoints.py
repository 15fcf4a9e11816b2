"""How exactly an actuator carries out its set-points: in steps, and rarely one that is off by far.

It shows where the readings of a hold are all equal but for outliers. Whether the specimen sees what is read, or what
was set, is seen by which of both its response follows. An actuator that goes by its own readings has their outliers
in its set-points, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bench.analysis import TransientRecording
from bench.base import Floats
from bench.models import ActuatorDynamics, Operator
from bench.specimen.disturbances import Noise, with_outliers

_CHANCE = 3.0
"""Standard deviations by which a count of outliers may differ from what is expected."""


def identify_setpoints(
    recordings: Sequence[TransientRecording], actuator: ActuatorDynamics, noise: Noise, model: Operator[Any]
) -> tuple[Noise, tuple[TransientRecording, ...]]:
    """Return how exactly set-points were carried out, and the recordings with those that were.

    Parameters
    ----------
    recordings : sequence of TransientRecording
        The runs.
    actuator : ActuatorDynamics
        The actuator. Of one that does not follow at once nothing is known, as it is late.
    noise : Noise
        Of the drive. Where it is no smaller than the last digit, nothing is known.
    model : Operator
        The model.
    """
    nothing = Noise(), tuple(recordings)
    if actuator.order or max(noise.reading, noise.quick) >= 0.5 * noise.resolution:
        return nothing
    levels = [_levels(r) for r in recordings]
    expected = [actuator.gain * r.setpoints + actuator.offset for r in recordings]
    if _unexplained(recordings, levels, model) >= _unexplained(recordings, expected, model):
        return nothing
    carried_out = tuple(
        replace(r, setpoints=(level - actuator.offset) / actuator.gain)
        for r, level in zip(recordings, levels, strict=True)
    )
    meant = np.concatenate(expected)
    errors = np.concatenate(levels) - meant
    limit = noise.resolution
    off = np.abs(errors) > limit
    found = with_outliers(Noise(resolution=limit), errors, meant, off, limit)
    if found.outliers and _explains(noise, int(off.sum()), meant, limit):
        # There are many more readings, and they say how often and by how much.
        found = replace(noise, reading=0.0, quick=0.0, resolution=limit)
    return found, carried_out


def _explains(readings: Noise, count: int, levels: Floats, limit: float) -> bool:
    """Return whether a count of values further off than a limit agrees with the outliers of readings."""
    if not readings.outliers:
        return False
    size = float(np.median(np.abs(readings.outliers)))
    sizes = size * np.abs(levels) if readings.relative_outliers else np.full_like(levels, size)
    expected = readings.outlier_share * int((sizes > limit).sum())
    return abs(count - expected) <= _CHANCE * math.sqrt(expected)


def _levels(recording: TransientRecording) -> Floats:
    """Return the drive at each set-point: the median of what was read, or the set-point where nothing was."""
    levels = recording.setpoints.copy()
    last = recording.last_change
    for number in np.unique(last[last >= 0]):
        levels[number] = np.median(recording.driven[last == number])
    return levels


def _unexplained(recordings: Sequence[TransientRecording], levels: Sequence[Floats], model: Operator[Any]) -> float:
    """Return the mean square by which the response goes on otherwise than the model, from hold to hold."""
    found = []
    for recording, level in zip(recordings, levels, strict=True):
        last = recording.last_change
        ends = np.flatnonzero(np.append(np.diff(last) > 0, True) & (last >= 0))
        found.append(np.diff(recording.responded[ends] - model.evaluate(level)[last[ends]]))
    return float(np.mean(np.concatenate(found) ** 2))
