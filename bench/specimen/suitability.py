"""Whether runs say what a twin has to know, and what to record instead if they do not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.analysis import TransientRecording
from bench.base import DataError
from bench.specimen.hysteresis import LEVELS, UNKNOWNS
from bench.specimen.response import IdentifiedResponse

_ENOUGH = 37
"""So many numbers say enough. Derivation: a plane of eight intervals has as many. With fewer, no loop is known that
is smaller than an eighth of the range."""
_POOR = 0.05
"""Share of the range of the response from which on the error of a model is great. Source: a choice; those of the
packaged rigs are 0.003 to 0.02, and a constant is off by 0.2 to 0.3."""
_SWEEP = "a run that sweeps the drive up and down in small increments, such as damped-oscillation"
_MODEL = "or give a model by --model FILE"


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
    if response.rms < deviation:
        return
    by_run = [float(np.sqrt(np.mean(e[r.is_reading] ** 2))) for e, r in zip(response.errors, recordings, strict=True)]
    worst = int(np.argmax(by_run))
    raise DataError(
        f"{recordings[worst].path}: model {model} is off by {by_run[worst]:.4g} {unit} RMS, where the response has a "
        f"range of {np.ptp(still[worst]):.4g} {unit}; over all runs it is off by {response.rms:.4g} {unit}, and a "
        f"response that never changes would be by {deviation:.4g} {unit}. Take runs of one specimen, with {_SWEEP}, "
        f"{_MODEL}"
    )


def doubts_of_model(
    recordings: Sequence[TransientRecording], response: IdentifiedResponse, unit: str
) -> Iterator[str]:
    """Yield in a sentence that the error of a model is great, if it is; parameters as of `raise_if_wrong`."""
    height = float(np.ptp(np.concatenate([r.responded[r.is_reading] for r in recordings])))
    if response.rms > _POOR * height:
        yield (
            f"the model is off by {response.rms:.4g} {unit} RMS, {100.0 * response.rms / height:.2g} % of the range "
            f"of the response, {height:.4g} {unit}; add {_SWEEP}, {_MODEL}"
        )


def doubts_of_sweep(recording: TransientRecording, count: int) -> Iterator[str]:
    """Yield in a sentence that a run determines few numbers of a model, if it does; see `run_of_model`."""
    if count < _ENOUGH:
        yield (
            f"the model is from {recording.path.name}, whose readings determine only {count} of the {UNKNOWNS} "
            f"numbers of a Preisach plane of {LEVELS} levels, so that other set-points and loops are a guess; add "
            f"{_SWEEP}, {_MODEL}"
        )


def doubts_of_histories(*, other: bool) -> Iterator[str]:
    """Yield in a sentence that the error of the model on a new history is not known, if there is no other run."""
    if not other:
        yield (
            "the model is from the only run, where it errs less than on another history, so that the twin promises "
            "too small errors; add a run of random-validation"
        )


def doubts_of_disturbances(*, drive: bool, response: bool) -> Iterator[str]:
    """Yield in a sentence which disturbances the twin has none of, if no readings at rest show those of a signal."""
    unknown = [] if drive else ["noise of the drive"]
    unknown += [] if response else ["noise of the response", "wander", "drift"]
    if unknown:
        yield (
            f"{', '.join(unknown)}: not known, and taken as 0, as the runs have no two readings at rest one after "
            "the other; add a run of creep"
        )
