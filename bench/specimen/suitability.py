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
    """Raise DataError if a model says less of the response than a constant in each run would."""
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


def doubts(
    recordings: Sequence[TransientRecording],
    response: IdentifiedResponse,
    unit: str,
    swept: tuple[TransientRecording, int] | None,
    *,
    other: bool,
    unknown: Sequence[str],
) -> Iterator[str]:
    """Yield what the runs do not say, in a sentence each.

    Parameters
    ----------
    recordings, response, unit
        As of `raise_if_wrong`.
    swept : tuple or None
        The run that the model is from, and how many numbers it determines, see `run_of_model`; None of a given model.
    other : bool
        Whether there is another run, which shows the error of the model on a new history.
    unknown : sequence of str
        Disturbances that no readings at rest show.
    """
    if swept is not None and swept[1] < _ENOUGH:
        yield (
            f"the model is from {swept[0].path.name}, whose readings determine only {swept[1]} of the {UNKNOWNS} "
            f"numbers of a Preisach plane of {LEVELS} levels, so that other set-points and loops are a guess; add "
            f"{_SWEEP}, {_MODEL}"
        )
    height = float(np.ptp(np.concatenate([r.responded[r.is_reading] for r in recordings])))
    if response.rms > _POOR * height:
        yield (
            f"the model is off by {response.rms:.4g} {unit} RMS, {100.0 * response.rms / height:.2g} % of the range "
            f"of the response, {height:.4g} {unit}; add {_SWEEP}, {_MODEL}"
        )
    if not other:
        yield (
            "the model is from the only run, where it errs less than on another history, so that the twin promises "
            "too small errors; add a run of random-validation"
        )
    if unknown:
        yield (
            f"{', '.join(unknown)}: not known, and taken as 0, as the runs have no two readings at rest one after "
            "the other; add a run of creep"
        )
