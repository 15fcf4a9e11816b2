"""How a response follows its drive beside the hysteresis: a lag before it, or late parts behind it.

Where the transients show them, by the Bayesian information criterion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from bench.control.dynamics import ActuatorDynamics, ResponseDynamics
from bench.deferred import DeferredModule
from bench.hysteresis._checks import Floats
from bench.transients.actuator import LONGEST_PART, at_rows, grid_step, latency
from bench.transients.recording import Recording

if TYPE_CHECKING:
    from bench.transients import _kernels
else:
    _kernels = DeferredModule("bench.transients._kernels")

_INSTANT = 0.03
"""Standard uncertainty of the instant of a reading, s."""
POWERS = (1.0, 2.0)
"""Powers of the drive that may lag: of a pressure or position, and of heat."""
_LATE = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Time constants of late parts that are tried, s."""


_ROWS_OF_HOLD = 4
"""A hold of fewer rows says nothing of a lag once it has an offset and a factor of its own."""
_FACTOR = 0.7
"""How far the shape of the transients may move a lag, as a natural logarithm."""

Model = Callable[[Floats], Floats]
"""Gives the output that follows a sequence of inputs at rest, each of shape (N,)."""


def seen_by_specimen(
    recording: Recording, actuator: ActuatorDynamics, response: ResponseDynamics, end: float
) -> Floats:
    """Return the drive behind its lag on the grid of time of the actuator, shape (N,), input units."""
    step = grid_step(actuator)
    initial = (float(recording.driven[0]) - actuator.offset) / actuator.gain
    setpoints = recording.on_grid(step, initial, end)
    out = np.empty((2, setpoints.size))
    lagged = math.copysign(abs(initial) ** response.power, initial)
    _kernels.follow(
        np.array([initial, 0.0, lagged, 0.0, 0.0]), setpoints, np.zeros((2, setpoints.size)), out, step,
        actuator.frequency, actuator.damping, actuator.rate, response.lag, response.power, 0.0, 1.0, 0.0, 1.0,
    )  # fmt: skip
    return np.asarray(actuator.gain * out[1] + actuator.offset)


def late_parts(outputs: Floats, step: float, times: Sequence[float]) -> Floats:
    """Return outputs behind lags of first order, which begin at rest, a column for each."""
    from scipy.signal import lfilter

    columns = []
    for time in times:
        remains = math.exp(-step / time)
        column, _ = lfilter([1.0 - remains], [1.0, -remains], outputs, zi=[remains * outputs[0]])
        columns.append(column)
    return np.array(columns).reshape(len(columns), outputs.size)


def identify_lag(
    recordings: Sequence[Recording],
    actuator: ActuatorDynamics,
    models: Sequence[Model],
    longest: float = LONGEST_PART,
) -> tuple[ResponseDynamics, float]:
    """Return the dynamics of a response, and the standard uncertainty of its lag, s.

    `models` has one for each recording: what comes of the drive at rest, from the first row on. Of each recording as
    long a part is used, s.
    """
    from scipy.optimize import minimize_scalar

    step = grid_step(actuator)
    ends = [min(longest, float(r.times[-1])) for r in recordings]
    parts = list(zip(recordings, ends, strict=True))
    measured = np.concatenate([r.responded[r.times <= end] for r, end in parts])
    runs = np.concatenate([np.full(int((r.times <= end).sum()), i) for i, (r, end) in enumerate(parts)])
    bases = (runs[:, None] == np.arange(len(parts))).astype(float)
    weights = np.concatenate([_weights(r)[r.times <= end] for r, end in parts])

    def columns_of(response: ResponseDynamics, times: Sequence[float]) -> Floats:
        """Return what comes at once and late at each row, a column each."""
        found = []
        for (r, end), model in zip(parts, models, strict=True):
            outputs = model(seen_by_specimen(r, actuator, response, end))
            every = np.vstack([outputs, late_parts(outputs, step, times)])
            found.append([at_rows(r, row, row[0], step, latency(actuator)) for row in every])
        return np.concatenate([np.array(each) for each in found], axis=1).T

    def fitted(columns: Floats, whole: bool) -> tuple[float, Floats]:
        """Return the sum of squares, and the numbers of the columns; as they are if `whole`."""
        target = measured - columns[:, 0] if whole else measured
        design = bases if whole else np.column_stack([columns, bases])
        solution, *_ = np.linalg.lstsq(weights[:, None] * design, weights * target, rcond=None)
        left = weights * (target - design @ solution)
        return float(left @ left), solution

    count = measured.size

    def score(squares: float, numbers: int) -> float:
        return count * math.log(squares) + numbers * math.log(count)

    def squares_of(logarithm: float, power: float) -> float:
        return fitted(columns_of(ResponseDynamics(math.exp(logarithm), power), ()), True)[0]

    candidates = [(score(fitted(columns_of(ResponseDynamics(), ()), True)[0], 0), ResponseDynamics())]
    for power in POWERS:
        best = minimize_scalar(
            squares_of,
            args=(power,),
            bounds=(math.log(2.0 * step), math.log(100.0)),
            method="bounded",
            options={"xatol": 0.01, "maxiter": 30},
        )
        candidates.append((score(float(best.fun), 1), ResponseDynamics(math.exp(float(best.x)), power)))
    lagged = min(candidates, key=lambda each: each[0])[1]
    longest = max(ends) / 2.0
    every = tuple(time for time in _LATE if step < time < longest)
    columns = columns_of(lagged, every)
    for number in (1, 2):
        for chosen in combinations(range(len(every)), number):
            squares, solution = fitted(columns[:, [0, *(1 + i for i in chosen)]], False)
            shares = tuple(float(each) for each in solution[1 : 1 + number])
            if min(shares) <= 0.0 or solution[0] <= 0.0:
                continue
            times = tuple(every[i] for i in chosen)
            found = ResponseDynamics(lagged.lag, lagged.power, float(solution[0]), shares, times)
            candidates.append((score(squares, 1 + 2 * number + (lagged.lag > 0)), found))
    chosen_one = min(candidates, key=lambda each: each[0])[1]
    return chosen_one, _uncertainty(squares_of, lagged, count) if lagged.lag else 0.0


def refine_lag(
    recordings: Sequence[Recording],
    actuator: ActuatorDynamics,
    models: Sequence[Model],
    found: ResponseDynamics,
    longest: float = LONGEST_PART,
    powers: Sequence[float] = POWERS,
) -> tuple[ResponseDynamics, float]:
    """Return dynamics with a lag that goes by the shape of the transients alone, and its standard uncertainty, s.

    Within each hold the model may be off by an offset and a factor of its own, so that its error at rest, which is
    another from hold to hold, is not taken for a lag. Parameters as in `identify_lag`, and the powers that are tried.
    """
    from scipy.optimize import minimize_scalar

    ends = [min(longest, float(r.times[-1])) for r in recordings]
    parts = list(zip(recordings, models, ends, strict=True))
    weights = [_weights(r) for r in recordings]
    rows = 0

    def squares_of(logarithm: float, power: float) -> float:
        nonlocal rows
        total, rows = 0.0, 0
        lagged = ResponseDynamics(math.exp(logarithm), power)
        for (r, model, end), weight in zip(parts, weights, strict=True):
            outputs = model(seen_by_specimen(r, actuator, lagged, end))
            modelled = at_rows(r, outputs, outputs[0], grid_step(actuator), latency(actuator))
            holds = r.last_change[: modelled.size]
            for hold in range(r.changes.size):
                within = np.flatnonzero(holds == hold)
                if within.size < _ROWS_OF_HOLD:
                    continue
                design = weight[within, None] * np.column_stack([np.ones(within.size), modelled[within]])
                target = weight[within] * r.responded[within]
                solution, *_ = np.linalg.lstsq(design, target, rcond=1e-6)
                left = target - design @ solution
                total += float(left @ left)
                rows += within.size
        return total

    middle = math.log(found.lag)
    trials = []
    for power in powers:
        best = minimize_scalar(
            squares_of,
            args=(power,),
            bounds=(middle - _FACTOR, middle + _FACTOR),
            method="bounded",
            options={"xatol": 0.005, "maxiter": 30},
        )
        trials.append((float(best.fun), ResponseDynamics(math.exp(float(best.x)), power)))
    _, better = min(trials, key=lambda each: each[0])
    if rows == 0:
        return found, 0.0
    return replace(found, lag=better.lag, power=better.power), _uncertainty(squares_of, better, rows)


def _uncertainty(squares_of: Callable[[float, float], float], lagged: ResponseDynamics, count: int) -> float:
    """Return the standard uncertainty of a lag from the curvature of the sum of squares about it, s."""
    near = 0.05
    middle, low, high = (squares_of(math.log(lagged.lag) + each, lagged.power) for each in (0.0, -near, near))
    curvature = max((low - 2.0 * middle + high) / near**2, 1e-300)
    return lagged.lag * math.sqrt(2.0 * middle / count / curvature)


def _weights(recording: Recording) -> Floats:
    """Return the weight of each row: less while the response moves, as the instants of readings are uncertain."""
    moves = np.abs(np.diff(recording.responded))
    rates = moves / np.maximum(np.diff(recording.times), 1e-3)
    fastest = np.maximum(np.append(rates, 0.0), np.append(0.0, rates))
    error = 5e-3 * float(np.ptp(recording.responded))
    return np.asarray(1.0 / np.sqrt(error**2 + (_INSTANT * fastest) ** 2))
