"""Noise, wander, unevenness and drift: what the errors of a model show, reading by reading.

The error at each settled row is s (w + u) + d + v. The slope s of the response multiplies the wander w of the drive
and the unevenness u, as which the error of the model on a new history appears; d is the drift of the response and v
white noise. w and u are first-order Gauss-Markov processes, of time and of the way of the drive; d is a random walk.
Their parameters are those of the greatest likelihood of the innovations of a Kalman filter (Schweppe, IEEE
Transactions on Information Theory 11, 61, 1965; Harvey, Forecasting, Structural Time Series Models and the Kalman
Filter, 1989, section 3.4). The Bayesian information criterion says which of the three there are (Schwarz, Annals of
Statistics 6, 461, 1978).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.analysis import TransientRecording
from bench.base import DeferredModule, Floats
from bench.models import Operator
from bench.specimen.specimen import Dynamics, Unevenness, Wander

if TYPE_CHECKING:
    from bench.specimen import innovations as _kernels
else:
    _kernels = DeferredModule("bench.specimen.innovations")

SETTLED = 4.0
"""Time constants after which 2 % of a move are left. Source: the settling time of control engineering (Ogata, Modern
Control Engineering, section 5-3)."""
_NEAR = 1e-3
"""Share of the range of the drive over which the slope is taken, as a finite difference. Derivation: by such a step a
smooth curve leaves its tangent by a millionth of its range."""


@dataclass(frozen=True)
class Noise:
    """White noise of a signal, in its unit."""

    # Standard deviation of a reading, and of a quick one.
    reading: float = 0.0
    quick: float = 0.0
    resolution: float = 0.0  # last digit; 0 for none


def noise_of(recordings: Sequence[TransientRecording], signal: str, dynamics: Dynamics) -> Noise | None:
    """Return the noise of a signal that stands still within holds; None if no two rows show it.

    It is the Allan deviation at the shortest time, from neighbouring rows (Allan, Proceedings of the IEEE 54, 221,
    1966). Where one kind of rows has no neighbours, it is that of the other.
    """
    values = np.concatenate([r.columns[signal] for r in recordings])
    digit = _resolution(values[np.isfinite(values)])
    found: dict[bool, float] = {}
    for kind in (True, False):
        differences = []
        for r in recordings:
            rows = np.flatnonzero(settled_rows(r, dynamics) & (r.is_reading == kind) & np.isfinite(r.columns[signal]))
            same = np.diff(r.last_change[rows]) == 0
            differences.append(np.diff(r.columns[signal][rows])[same])
        every = np.concatenate(differences)
        if every.size:
            found[kind] = _unrounded(math.sqrt(0.5 * float(np.mean(every**2))), digit)
    if not found:
        return None
    return Noise(found.get(True, found.get(False, 0.0)), found.get(False, found.get(True, 0.0)), digit)


@dataclass(frozen=True, eq=False)
class _Rows:
    """The settled rows of a run: their errors, the slopes there, and time and way of the drive since the last."""

    errors: Floats
    slopes: Floats
    gaps: Floats
    travels: Floats
    is_reading: NDArray[np.bool_]


def identify_disturbances(
    recordings: Sequence[TransientRecording], errors: Sequence[Floats], model: Operator[Any], dynamics: Dynamics
) -> tuple[Noise, Dynamics] | None:
    """Identify the noise of a response, and its dynamics with what moves it beside; None if no two rows show noise.

    Parameters
    ----------
    recordings : sequence of TransientRecording
        The runs.
    errors : sequence of ndarray, shape (N,)
        Measured less modelled response at the rows of each run, output units.
    model : Operator
        The hysteresis.
    dynamics : Dynamics
        Of the specimen as far as it is known.
    """
    from scipy.optimize import minimize

    white = noise_of(recordings, recordings[0].response, dynamics)
    if white is None:
        return None
    runs = [_rows_of(r, each, model, dynamics) for r, each in zip(recordings, errors, strict=True)]
    runs = [each for each in runs if each.errors.size]
    count = sum(each.errors.size for each in runs)
    every = np.concatenate([each.errors for each in runs])
    rms, smallest = float(np.sqrt(np.mean(every**2))), 1e-6 * float(np.ptp(recordings[0].responded))
    slope = float(np.sqrt(np.mean(np.concatenate([each.slopes for each in runs]) ** 2)))
    gaps = np.concatenate([each.gaps[1:] for each in runs])
    span = float(np.ptp(np.concatenate([r.setpoints for r in recordings])))
    size = max(rms, smallest)
    # Where the search begins: any start does that is within some powers of ten.
    starts = {
        "reading": max(white.reading, 0.1 * size),
        "quick": max(white.quick, 0.1 * size),
        "wander": size / (slope or 1.0),
        "time": 10.0 * float(np.median(gaps)),
        "unevenness": size / (slope or 1.0),
        "length": 0.1 * span,
        "drift": 0.1 * size / math.sqrt(float(np.median(gaps))),
    }
    bounds = {name: (math.log(start) - 9.0, math.log(start) + 5.0) for name, start in starts.items()}
    # What is forgotten only after the whole range is no error of a history.
    bounds["length"] = (math.log(1e-3 * span), math.log(span))

    def deviance(logarithms: Floats, names: Sequence[str]) -> float:
        of = dict(zip(names, np.exp(logarithms).tolist(), strict=True))
        total = 0.0
        for rows in runs:
            total += _kernels.deviance(
                rows.errors, rows.slopes, rows.gaps, rows.travels,
                np.where(rows.is_reading, of["reading"] ** 2, of["quick"] ** 2), size**2,
                of.get("wander", 0.0), of.get("time", 1.0), of.get("unevenness", 0.0), of.get("length", 1.0),
                of.get("drift", 0.0),
            )  # fmt: skip
        return total

    found = []
    for more in product(((), ("wander", "time")), ((), ("unevenness", "length")), ((), ("drift",))):
        names = ("reading", "quick", *(name for each in more for name in each))
        solved = minimize(
            deviance,
            [math.log(starts[name]) for name in names],
            args=(names,),
            method="L-BFGS-B",
            bounds=[bounds[name] for name in names],
        )
        score = float(solved.fun) + len(names) * math.log(count)
        found.append((score, dict(zip(names, np.exp(solved.x).tolist(), strict=True))))
    best, digit = min(found, key=lambda each: each[0])[1], white.resolution
    disturbed = replace(
        dynamics,
        wander=Wander(deviation=best.get("wander", 0.0), time=best.get("time", 1.0)),
        unevenness=Unevenness(deviation=best.get("unevenness", 0.0), length=best.get("length", 1.0)),
        drift=best.get("drift", 0.0),
    )
    return Noise(_unrounded(best["reading"], digit), _unrounded(best["quick"], digit), digit), disturbed


def settled_rows(recording: TransientRecording, dynamics: Dynamics) -> NDArray[np.bool_]:
    """Return at which rows the rest counts as still: so long after a change of the set-point, by its size."""
    actuator, response = dynamics.actuator, dynamics.response
    constant = 0.0 if actuator.order == 0 else max(1.0, 2.0 * actuator.damping) / actuator.frequency
    moves = np.abs(np.diff(recording.setpoints, prepend=recording.driven[0]))[recording.last_change]
    needed = SETTLED * (constant + response.lag) + actuator.delay + moves / actuator.rate
    # A row that is complete as the set-point is sent has not seen it.
    return np.asarray((recording.since_change > needed) & (recording.last_change >= 0))


def _rows_of(recording: TransientRecording, errors: Floats, model: Operator[Any], dynamics: Dynamics) -> _Rows:
    rows = np.flatnonzero(settled_rows(recording, dynamics))
    levels = np.append(recording.driven[0], recording.setpoints)
    way = np.append(0.0, np.cumsum(np.abs(np.diff(levels))))[recording.last_change + 1]
    times = recording.times[rows]
    return _Rows(
        errors[rows],
        _slopes(levels, model)[recording.last_change[rows] + 1],
        np.diff(times, prepend=times[:1]),
        np.diff(way[rows], prepend=way[rows][:1]),
        recording.is_reading[rows],
    )


def _slopes(levels: Floats, model: Operator[Any]) -> Floats:
    """Return by how much the response depends on the drive at each of its levels, on the way on from there."""
    slopes = np.zeros(levels.size)
    near = _NEAR * float(np.ptp(levels))
    state = model.initial_state()
    for number, (level, move) in enumerate(zip(levels.tolist(), np.diff(levels, prepend=levels[0]), strict=True)):
        state, here = model.step(state, level)
        further = math.copysign(near, move)
        slopes[number] = (model.step(state, level + further)[1] - here) / further
    return slopes


def _unrounded(deviation: float, digit: float) -> float:
    """Return a standard deviation without what rounding adds: that of a uniform distribution."""
    return math.sqrt(max(deviation**2 - digit**2 / 12.0, 0.0))


def _resolution(values: Floats) -> float:
    """Return the last digit of readings that are multiples of one, but for outliers; 0 if they are not."""
    distinct, counts = np.unique(values, return_counts=True)
    distinct = distinct[counts > 1]
    # Where few readings are equal, they are no multiples of a digit.
    if distinct.size < 3 or 2 * int(counts[counts > 1].sum()) < values.size:
        return 0.0
    gaps, often = np.unique(np.round(np.diff(distinct) / float(np.ptp(distinct)), 9), return_counts=True)
    digit = float(gaps[gaps > 0.0][np.argmax(often[gaps > 0.0])]) * float(np.ptp(distinct))
    away = np.abs(values / digit - np.round(values / digit))
    return float(np.format_float_positional(digit, 6, fractional=False)) if np.quantile(away, 0.9) < 0.01 else 0.0
