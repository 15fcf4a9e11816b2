"""How exactly an actuator carries out its set-points: in steps, and rarely one that is off by far.

It shows where the readings of a hold are all equal but for outliers. Whether the specimen sees what is read, or what
was set, is seen by which of both its response follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bench.control.dynamics import ActuatorDynamics
from bench.hysteresis import Operator
from bench.hysteresis._checks import Floats
from bench.transients.recording import Recording
from bench.twin.disturbances import Noise, with_outliers


def identify_setpoints(
    recordings: Sequence[Recording], actuator: ActuatorDynamics, noise: Noise, model: Operator[Any]
) -> tuple[Noise, tuple[Recording, ...]]:
    """Return how exactly set-points were carried out, and the recordings with those that were.

    Parameters
    ----------
    recordings : sequence of Recording
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
    return with_outliers(Noise(resolution=limit), errors, meant, np.abs(errors) > limit, limit), carried_out


def _levels(recording: Recording) -> Floats:
    """Return the drive at each set-point: the median of what was read, or the set-point where nothing was."""
    levels = recording.setpoints.copy()
    last = recording.last_change
    for number in np.unique(last[last >= 0]):
        levels[number] = np.median(recording.driven[last == number])
    return levels


def _unexplained(recordings: Sequence[Recording], levels: Sequence[Floats], model: Operator[Any]) -> float:
    """Return the mean square by which the response goes on otherwise than the model, from hold to hold."""
    found = []
    for recording, level in zip(recordings, levels, strict=True):
        last = recording.last_change
        ends = np.flatnonzero(np.append(np.diff(last) > 0, True) & (last >= 0))
        found.append(np.diff(recording.responded[ends] - model.evaluate(level)[last[ends]]))
    return float(np.mean(np.concatenate(found) ** 2))
