"""The hysteresis of a specimen: the run that says most of it, and the model that cross-validation chooses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bench.analysis import TransientRecording
from bench.base import DataError, Floats
from bench.identification import cross_validate, identify
from bench.models import Operator, Preisach
from bench.rig import RigFile

LEVELS = 20
"""Intervals of a Preisach plane. Source: those of a model that is given no other number. On it the numbers that a run
determines are counted, too: set-points are rounded to its levels, so that the last small moves of a controller are no
new histories."""
UNKNOWNS = LEVELS * (LEVELS + 1) // 2 + 1
"""Numbers of a plane. Derivation: the density of each of its cells, and a constant."""
_MODELS: Mapping[str, Mapping[str, Any]] = {"preisach": {"reversible": "linear"}, "preisach-nonmonotonic": {}}
"""Models that are tried, with their options. The density of both is nowhere negative: one of either sign answers
short reversals at once, and the last moves of a controller are such."""
_FINE = 4 * LEVELS
"""Levels of the plane of a twin, four to one of the usual number of a controller. Derivation: a twin that was as
coarse as that model would do what it says, and no controller would miss on it."""
_SMOOTHING = tuple((10.0 ** np.arange(-3.0, 0.0)).tolist())
"""Weights of the roughness of a nonnegative density that are tried; see `cross_validate`."""


def run_of_model(recordings: Sequence[TransientRecording]) -> tuple[TransientRecording, int]:
    """Return the run whose readings determine most of a model of hysteresis, and how many numbers they determine.

    These are counted by the rank of the least-squares problem of a Preisach operator on the range of all runs. A
    hold adds one, however many readings it has, and so does each further history of the drive, until every cell of
    the plane is known. Of runs that determine as much, it is the one of the most steps.
    """
    drives = [_drive_at_readings(each) for each in recordings]
    every = np.concatenate(drives)
    counts = [_determined(each, float(every.min()), float(every.max())) for each in drives]
    best = max(range(len(recordings)), key=lambda i: (counts[i], len(recordings[i].steps)))
    return recordings[best], counts[best]


def identify_hysteresis(recording: TransientRecording, file: RigFile) -> tuple[str, Operator[Any]]:
    """Return the model of the readings of a run that predicts best what is left out, with its name.

    It is a Preisach operator on a fine plane; which one, and how smooth its density is, cross-validation says (Stone,
    Journal of the Royal Statistical Society B 36, 111, 1974).

    Parameters
    ----------
    recording : TransientRecording
        The run.
    file : RigFile
        Its rig, whose dashboard may name the ends of the plane.

    Raises
    ------
    DataError
        If no model can be identified from the run.
    """
    units = {signal.name: signal.unit for signal in recording.signals}
    inputs, outputs = recording.driven[recording.is_reading], recording.responded[recording.is_reading]
    layout = file.dashboard
    common: dict[str, Any] = {
        "input_unit": units[recording.drive],
        "output_unit": units[recording.response],
        "plane": layout.plane if layout is not None and layout.input == recording.drive else None,
    }
    # Finer than there are readings, a plane takes its time and says no more.
    levels = min(_FINE, inputs.size)
    trials = []
    for name, own in _MODELS.items():
        options = {**common, **own}
        try:
            found = cross_validate(name, inputs, outputs, smoothing=_SMOOTHING, levels=(levels,), **options)
        except ValueError as error:
            raise DataError(
                f"{recording.path}: no model can be identified from its readings ({error}); give one by --model FILE"
            ) from None
        trials.append((found.smoothest, name, options))
    best, name, options = min(trials, key=lambda each: each[0].rms)
    return name, identify(name, inputs, outputs, levels=levels, smoothing=best.smoothing, **options).model


def _drive_at_readings(recording: TransientRecording) -> Floats:
    """Return the set-points at which the readings of steps were taken, from the first that is known on."""
    last = recording.last_change[recording.is_reading]
    return recording.setpoints[last[last >= 0]]


def _determined(drive: Floats, low: float, high: float) -> int:
    """Return how many numbers of a Preisach operator on a range a sequence of the drive determines."""
    if not drive.size or low == high:
        return drive.size and 1
    nodes = np.rint((drive - low) / (high - low) * LEVELS)
    nodes = nodes[np.append(True, np.diff(nodes) != 0.0)]
    plane = Preisach(np.arange(LEVELS + 1.0), np.zeros(UNKNOWNS - 1))
    rows = plane.regressor(nodes).dense()
    return int(np.linalg.matrix_rank(np.column_stack([rows, np.ones(len(rows))])))
