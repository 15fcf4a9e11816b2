"""The dynamics of the actuator, identified from what the drive did after each change of its set-point.

Candidates are an actuator that follows at once, of first and of second order, each with a delay and with or without a
fastest change. The Bayesian information criterion chooses (Schwarz, "Estimating the dimension of a model", Annals of
Statistics 6, 1978).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from bench.analysis.transients.recorded_transients import TransientRecording
from bench.base import DeferredModule, Floats
from bench.identification import Evidence, Stage, variable_projection
from bench.models import ActuatorDynamics

if TYPE_CHECKING:
    from bench.models import actuator_kernels as _kernels
else:
    _kernels = DeferredModule("bench.models.kernels.actuator_kernels")

GRID = 0.02
"""Step of time with which drives are simulated, s; shorter for one of a shorter time constant."""
LONGEST_PART = 2000.0
"""Part of a run that is used for dynamics, s."""
MEDIAN_OF_DIFFERENCES = 0.954
"""Median of the magnitude of the difference of two normal numbers, in standard deviations."""
_INSTANT = 0.03
"""Standard uncertainty of the instant at which a reading saw the drive, s."""
_ON_TIME = 1e-9
"""Difference of times that are equal, s."""
_OVERDAMPED = 3.0
"""Greatest damping of a second-order actuator; its poles are a factor of 34 apart, and one of first order fits."""
_SEARCH, _STEP = Stage(1, 1e-8, 40), 1e-3
"""Effort of a search, and its relative differences: rows at which a drive starts to move make the residuals rough."""
_EARLY = 0.1
"""Time by which a change of the set-point may come before its record says so, s."""


@dataclass(frozen=True)
class IdentifiedActuator:
    """The dynamics of an actuator with the evidence for it.

    Attributes
    ----------
    dynamics : ActuatorDynamics
        What was identified.
    uncertainties : mapping of str to float
        Standard uncertainty of its numbers, in their units.
    rms : float
        Of what it leaves over, input units.
    """

    dynamics: ActuatorDynamics
    uncertainties: dict[str, float]
    rms: float


def at_rows(times: Floats, values: Floats, first: float, step: float, delay: float) -> Floats:
    """Return what a quantity had at each row of a recording.

    Parameters
    ----------
    times : ndarray, shape (M,)
        Of the rows, s.
    values : ndarray, shape (N,)
        After each step of a grid of time.
    first : float
        At the beginning.
    step : float
        Of the grid, s.
    delay : float
        Time by which the rows see it late, s.
    """
    grid = step * np.arange(values.size + 1)
    return np.asarray(np.interp(times - delay, grid, np.concatenate([[first], values])))


class _Part:
    """The first part of a recording, up to `end` s, with what its simulations have in common."""

    def __init__(self, recording: TransientRecording, end: float) -> None:
        rows = recording.times <= end
        self.driven, self.weights = recording.driven[rows], _weights(recording)[rows]
        self._recording, self._end, self._times = recording, end, recording.times[rows]
        # Of the simulation before: most are on the same grid.
        self._grid, self._holds = (GRID, 0.0), recording.holds(GRID, 0.0, end)

    def positions(self, dynamics: ActuatorDynamics) -> Floats:
        """Return the position (before gain and offset) that the drive has at each row."""
        initial = start_position(self._recording, dynamics)
        times = self._times - dynamics.delay
        if dynamics.order == 0:
            levels = np.append(initial, self._recording.setpoints)
            # A reading that is complete as a set-point is sent has not seen it.
            return np.asarray(levels[np.searchsorted(self._recording.changes, times - _ON_TIME)])
        step = grid_step(dynamics)
        if self._grid != (step, initial):
            self._grid, self._holds = (step, initial), self._recording.holds(step, initial, self._end)
        positions = np.empty(times.size)
        _kernels.move_to_rows(
            initial, *self._holds, times, positions, step, dynamics.frequency, dynamics.damping, dynamics.rate
        )
        return positions


def identify_actuator(recordings: Sequence[TransientRecording], longest: float = LONGEST_PART) -> IdentifiedActuator:
    """Identify the dynamics of the drive of some runs, of each by as long a part, s."""
    parts = [_Part(each, min(longest, float(each.times[-1]))) for each in recordings]
    slow = _time_scale(recordings)
    weights = np.concatenate([part.weights for part in parts])

    def at_rest(positions: Sequence[Floats], of: Sequence[_Part]) -> tuple[Floats, float, float]:
        """Return what is left over, weighted, with gain and offset."""
        weights = np.concatenate([part.weights for part in of])
        placed = np.concatenate(positions)
        columns = weights[:, None] * np.column_stack([placed, np.ones(placed.size)])
        measured = weights * np.concatenate([part.driven for part in of])
        (gain, offset), *_ = np.linalg.lstsq(columns, measured, rcond=None)
        return measured - columns @ (gain, offset), float(gain), float(offset)

    def fitted(dynamics: ActuatorDynamics) -> tuple[Floats, float, float]:
        """Return what is left over, weighted, with gain and offset over all runs.

        What a sensor reads wrongly from run to run is no dynamics: each of several runs has a gain and an offset of
        its own, from which follows, too, where its drive began.
        """
        positions = [part.positions(dynamics) for part in parts]
        left, gain, offset = at_rest(positions, parts)
        if len(parts) > 1:
            own = [at_rest([each], [part])[1:] for each, part in zip(positions, parts, strict=True)]
            begun = [replace(dynamics, gain=each[0], offset=each[1]) for each in own]
            positions = [part.positions(each) for part, each in zip(parts, begun, strict=True)]
            left = np.concatenate([at_rest([each], [part])[0] for each, part in zip(positions, parts, strict=True)])
        return left, gain, offset

    def dynamics_of(names: Sequence[str], values: Floats) -> ActuatorDynamics:
        numbers = {
            name: value * slow if name == "delay" else math.exp(value)
            for name, value in zip(names, values.tolist(), strict=True)
        }
        return ActuatorDynamics(**numbers)

    def left_over(names: Sequence[str], values: Floats) -> Floats:
        return fitted(dynamics_of(names, values))[0]

    found: list[tuple[float, ActuatorDynamics, dict[str, float]]] = []
    for start in _candidates(slow, recordings):
        names, values = [*start], np.array([v / slow if n == "delay" else math.log(v) for n, v in start.items()])
        low = [-_EARLY / slow if name == "delay" else value - 3.0 for name, value in zip(names, values, strict=True)]
        highest = {"delay": 10.0, "damping": math.log(_OVERDAMPED)}
        high = [highest.get(name, value + 3.0) for name, value in zip(names, values, strict=True)]
        bounds = np.array(low), np.array(high)
        end = variable_projection(partial(left_over, names), [values], bounds, stages=[_SEARCH], step=_STEP)[0]
        values = end.values
        dynamics = dynamics_of(names, values)
        left, gain, offset = fitted(dynamics)
        score = left.size * math.log(float(left @ left) / left.size) + len(names) * math.log(left.size)
        spread = Evidence.of(end.jacobian, left, left.size).deviations
        scales = {name: slow if name == "delay" else float(getattr(dynamics, name)) for name in names}
        known = {name: s * scales[name] for name, s in zip(names, spread.tolist(), strict=True)}
        found.append((score, replace(dynamics, gain=gain, offset=offset), known))
    score, dynamics, uncertainties = min(found, key=lambda each: each[0])
    left = fitted(dynamics)[0] / weights
    # What is sent is a little late on the record, and no actuator moves before it is.
    causal = replace(dynamics, delay=max(dynamics.delay, 0.0))
    return IdentifiedActuator(causal, uncertainties, float(np.sqrt(np.mean(left**2))))


def start_position(recording: TransientRecording, dynamics: ActuatorDynamics) -> float:
    """Return the position (before gain and offset) of the drive at the beginning of a recording, input units."""
    return (float(recording.driven[0]) - dynamics.offset) / dynamics.gain


def grid_step(dynamics: ActuatorDynamics) -> float:
    """Return the step of the grid of time for an actuator, s."""
    return GRID if dynamics.frequency == 0.0 else float(np.clip(0.25 / dynamics.frequency, 0.005, GRID))


def latency(dynamics: ActuatorDynamics) -> float:
    """Return the time by which a reading sees what the grid of an actuator shows late, s.

    An actuator that follows at once has moved at the end of a step of the grid: what is read within the step has not
    seen it.
    """
    return dynamics.delay + (grid_step(dynamics) if dynamics.order == 0 else 0.0)


def _candidates(slow: float, recordings: Sequence[TransientRecording]) -> list[dict[str, float]]:
    """Return the numbers of each candidate with their first guesses."""
    rate = {"rate": _fastest(recordings)}
    lags = [{"frequency": frequency / slow, "delay": 0.0} for frequency in (1.0, 3.0)]
    pairs = [{**lag, "damping": damping} for lag in lags for damping in (0.5, 1.0)]
    plain: list[dict[str, float]] = [{}, {"delay": 0.0}, *lags, *pairs]
    return [*plain, *(each | rate for each in (*lags, *pairs))]


def _weights(recording: TransientRecording) -> Floats:
    moves, span = np.abs(np.diff(recording.driven)), float(np.ptp(recording.driven))
    noise = max(float(np.median(moves)) / MEDIAN_OF_DIFFERENCES, 1e-6 * span)
    return row_weights(recording.times, recording.driven, noise)


def row_weights(times: Floats, values: Floats, error: float) -> Floats:
    """Return the weight of each row: less while values move, as the instants of readings are uncertain."""
    rates = np.abs(np.diff(values)) / np.maximum(np.diff(times), 1e-3)
    fastest = np.maximum(np.append(rates, 0.0), np.append(0.0, rates))
    return np.asarray(1.0 / np.sqrt(error**2 + (_INSTANT * fastest) ** 2))


def _time_scale(recordings: Sequence[TransientRecording]) -> float:
    """Return a first guess of the time constant, s: how long the drive is away from its set-point after a change."""
    areas, sizes = 0.0, 0.0
    for r in recordings:
        last = r.last_change
        target = np.where(last < 0, r.driven, r.setpoints[np.maximum(last, 0)])
        steps = np.abs(np.diff(np.append(r.driven[0], r.setpoints)))
        spacing = np.diff(r.times, prepend=0.0)
        areas += float((np.abs(target - r.driven) * np.minimum(spacing, 2.0)).sum())
        sizes += float(steps.sum())
    return float(np.clip(areas / max(sizes, 1e-300), 0.02, 100.0))


def _fastest(recordings: Sequence[TransientRecording]) -> float:
    """Return the fastest change that was seen over a time that is long beside the uncertainty of instants."""
    found = []
    for r in recordings:
        spacing = np.diff(r.times)
        long = spacing > 5.0 * _INSTANT
        found.append(np.abs(np.diff(r.driven))[long] / spacing[long])
    rates = np.concatenate(found)
    return float(rates.max()) if rates.size and rates.max() > 0.0 else 1.0
