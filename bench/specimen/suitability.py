"""Whether runs say what a twin has to know, and which of them says most of the hysteresis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.analysis import TransientRecording
from bench.base import DataError, Floats
from bench.models import Preisach
from bench.specimen.disturbances import Noise, settled_rows
from bench.specimen.response import IdentifiedResponse
from bench.specimen.specimen import Dynamics, Wander

_LEVELS = 20
"""Intervals of the Preisach plane whose unknowns are counted. Set-points are rounded to its levels, so that the last
small moves of a controller are no new ones."""
_UNKNOWNS = _LEVELS * (_LEVELS + 1) // 2 + 1
"""The density of each of its cells, and a constant."""
_ENOUGH = 37
"""So many of them say enough: a plane of eight intervals has as many. With fewer, no loop is known that is smaller
than an eighth of the range."""
_POOR = 0.05
"""Share of the range of the response from which on the error of a model is great; that of good ones is up to 0.03."""
_PAIRS = 36
"""So many neighbouring readings at rest say what noise is: 12 by each class of slopes."""
_SWEEP = "a run that sweeps the drive up and down in small increments, such as damped-oscillation"
_MODEL = "or give a model by --model FILE"


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


def raise_if_wrong(
    recordings: Sequence[TransientRecording], response: IdentifiedResponse, model: str, unit: str
) -> None:
    """Raise DataError if a model says less of the response than a constant in each run would.

    Parameters
    ----------
    recordings : sequence of TransientRecording
        The runs.
    response : IdentifiedResponse
        With the errors of the model.
    model : str
        Its name.
    unit : str
        Of differences of the response.
    """
    still = [r.responded[r.is_reading] for r in recordings]
    deviation = float(np.sqrt(np.mean(np.concatenate([each - each.mean() for each in still]) ** 2)))
    if response.rms_model < deviation:
        return
    worst = max(range(len(recordings)), key=lambda i: float(np.mean(response.of_model[i] ** 2)))
    rms, height = float(np.sqrt(np.mean(response.of_model[worst] ** 2))), float(np.ptp(still[worst]))
    raise DataError(
        f"{recordings[worst].path}: model {model} is off by {rms:.4g} {unit} RMS, where the response has a range of "
        f"{height:.4g} {unit}; over all runs it is off by {response.rms_model:.4g} {unit}, and a response that never "
        f"changes would be by {deviation:.4g} {unit}. Take runs of one specimen, with {_SWEEP}, {_MODEL}"
    )


def doubts_of_model(
    recordings: Sequence[TransientRecording], response: IdentifiedResponse, unit: str
) -> Iterator[str]:
    """Yield in a sentence that the error of a model is great, if it is; parameters as of `raise_if_wrong`."""
    height = float(np.ptp(np.concatenate([r.responded[r.is_reading] for r in recordings])))
    if response.rms_model > _POOR * height:
        yield (
            f"the model is off by {response.rms_model:.4g} {unit} RMS, {100.0 * response.rms_model / height:.2g} % "
            f"of the range of the response, {height:.4g} {unit}; add {_SWEEP}, {_MODEL}"
        )


def doubts_of_sweep(recording: TransientRecording, count: int) -> Iterator[str]:
    """Yield in a sentence that a run determines few numbers of a model, if it does; see `run_of_model`."""
    if count < _ENOUGH:
        yield (
            f"the model is from {recording.path.name}, whose readings determine only {count} of the {_UNKNOWNS} "
            f"numbers of a Preisach plane of {_LEVELS} levels, so that other set-points and loops are a guess; add "
            f"{_SWEEP}, {_MODEL}"
        )


def doubts_of_disturbances(
    recordings: Sequence[TransientRecording],
    dynamics: Dynamics,
    drive: Noise,
    response: Noise,
    wander: Wander,
    drift: Wander,
) -> Iterator[str]:
    """Yield in a sentence which disturbances the twin has none of, as no reading could tell them, if there are any.

    Parameters
    ----------
    recordings : sequence of TransientRecording
        The runs.
    dynamics : Dynamics
        Of the specimen: what is at rest when.
    drive, response : Noise
        Of these.
    wander, drift : Wander
        Of the drive, of the response.
    """
    pairs = sum(_pairs_at_rest(each, dynamics) for each in recordings)
    unknown = []
    # Many readings that are all equal say that there is no noise.
    if pairs < _PAIRS:
        noises = (("the drive", drive), ("the response", response))
        unknown += [f"noise of {name}" for name, noise in noises if not noise.reading and not noise.quick]
    # Those that were identified are never 0.
    unknown += [name for name, each in (("wander", wander), ("drift", drift)) if not each.deviation]
    if unknown:
        yield (
            f"{', '.join(unknown)}: not known, and taken as 0, as the runs have only {pairs} pairs of readings at "
            "rest one after the other; add a run of creep"
        )


def _drive_at_readings(recording: TransientRecording) -> Floats:
    """Return the set-points at which the readings of steps were taken, from the first that is known on."""
    last = recording.last_change[recording.is_reading]
    return recording.setpoints[last[last >= 0]]


def _determined(drive: Floats, low: float, high: float) -> int:
    """Return how many numbers of a Preisach operator on a range a sequence of the drive determines."""
    if not drive.size or low == high:
        return drive.size and 1
    nodes = np.rint((drive - low) / (high - low) * _LEVELS)
    nodes = nodes[np.append(True, np.diff(nodes) != 0.0)]
    plane = Preisach(np.arange(_LEVELS + 1.0), np.zeros(_UNKNOWNS - 1))
    rows = plane.regressor(nodes).dense()
    return int(np.linalg.matrix_rank(np.column_stack([rows, np.ones(len(rows))])))


def _pairs_at_rest(recording: TransientRecording, dynamics: Dynamics) -> int:
    """Return how many neighbouring rows of a kind, of one hold, are both at rest."""
    count = 0
    for kind in (False, True):
        rows = np.flatnonzero((recording.is_reading == kind) & settled_rows(recording, dynamics))
        count += int(np.sum(np.diff(recording.last_change[rows]) == 0))
    return count
