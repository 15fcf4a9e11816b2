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

from bench.analysis.transients.actuator import LONGEST_PART, at_rows, grid_step, latency, row_weights, start_position
from bench.analysis.transients.recorded_transients import TransientRecording
from bench.base import DeferredModule, Floats
from bench.models import ActuatorDynamics, ResponseDynamics

if TYPE_CHECKING:
    from bench.models import actuator_kernels as _kernels
else:
    _kernels = DeferredModule("bench.models.kernels.actuator_kernels")

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


class SimulatedDrive:
    """The drive of a recording on the grid of time of its actuator, up to some instant.

    Parameters
    ----------
    recording : TransientRecording
        The run.
    actuator : ActuatorDynamics
        Its actuator.
    end : float
        The instant, s.

    Attributes
    ----------
    step : float
        Of the grid, s.
    """

    def __init__(self, recording: TransientRecording, actuator: ActuatorDynamics, end: float) -> None:
        self.step = grid_step(actuator)
        self._actuator = actuator
        self._times, self._late = recording.times[recording.times <= end], latency(actuator)
        self._initial = start_position(recording, actuator)
        setpoints = recording.on_grid(self.step, self._initial, end)
        self._positions = np.empty(setpoints.size)
        _kernels.move(
            self._initial, 0.0, setpoints, self._positions, self.step,
            actuator.frequency, actuator.damping, actuator.rate,
        )  # fmt: skip

    def behind(self, response: ResponseDynamics) -> Floats:
        """Return what the specimen sees of it behind the lag of its response, shape (N,), input units."""
        lagged = math.copysign(abs(self._initial) ** response.power, self._initial)
        seen = np.empty(self._positions.size)
        _kernels.hold_back(lagged, self._positions, seen, self.step, response.lag, response.power)
        return np.asarray(self._actuator.gain * seen + self._actuator.offset)

    def at_rows(self, values: Floats) -> Floats:
        """Return what a quantity with these values on the grid, shape (N,), had at each row of the recording."""
        return at_rows(self._times, values, float(values[0]), self.step, self._late)


def late_parts(outputs: Floats, step: float, times: Sequence[float]) -> Floats:
    """Return outputs, shape (N,), behind lags of first order, which begin at rest: shape (M, N) for M times, s."""
    late = np.empty((len(times), outputs.size))
    _kernels.lag_behind(outputs, step, np.array(times, dtype=np.float64), late)
    return late


def identify_lag(
    recordings: Sequence[TransientRecording],
    actuator: ActuatorDynamics,
    models: Sequence[Model],
    longest: float = LONGEST_PART,
) -> tuple[ResponseDynamics, float]:
    """Return the dynamics of a response, and the standard uncertainty of its lag, s.

    `models` has one for each recording: what comes of the drive at rest, from the first row on. Of each recording as
    long a part is used, s.
    """
    ends = [min(longest, float(r.times[-1])) for r in recordings]
    parts = list(zip(recordings, ends, strict=True))
    drives = [SimulatedDrive(r, actuator, end) for r, end in parts]
    step = grid_step(actuator)
    measured = np.concatenate([r.responded[r.times <= end] for r, end in parts])
    runs = np.concatenate([np.full(int((r.times <= end).sum()), i) for i, (r, end) in enumerate(parts)])
    bases = (runs[:, None] == np.arange(len(parts))).astype(float)
    weights = np.concatenate([_weights(r)[r.times <= end] for r, end in parts])

    def columns_of(response: ResponseDynamics, times: Sequence[float]) -> Floats:
        """Return what comes at once and late at each row, a column each."""
        found = []
        for drive, model in zip(drives, models, strict=True):
            outputs = model(drive.behind(response))
            every = np.vstack([outputs, late_parts(outputs, step, times)])
            found.append([drive.at_rows(row) for row in every])
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
        squares, response = _best_lag(squares_of, power, (math.log(2.0 * step), math.log(100.0)), 0.01)
        candidates.append((score(squares, 1), response))
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
    recordings: Sequence[TransientRecording],
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
    parts = []
    for r, model in zip(recordings, models, strict=True):
        end = min(longest, float(r.times[-1]))
        parts.append((SimulatedDrive(r, actuator, end), model, _shapes_of_holds(r, end)))
    rows = sum(target.size for _, _, holds in parts for _, _, target in holds)

    def squares_of(logarithm: float, power: float) -> float:
        total = 0.0
        lagged = ResponseDynamics(math.exp(logarithm), power)
        for drive, model, holds in parts:
            modelled = drive.at_rows(model(drive.behind(lagged)))
            for within, weight, target in holds:
                design = np.column_stack([weight, weight * modelled[within]])
                solution, *_ = np.linalg.lstsq(design, target, rcond=1e-6)
                left = target - design @ solution
                total += float(left @ left)
        return total

    middle = math.log(found.lag)
    trials = [_best_lag(squares_of, power, (middle - _FACTOR, middle + _FACTOR), 0.005) for power in powers]
    _, better = min(trials, key=lambda each: each[0])
    if rows == 0:
        return found, 0.0
    return replace(found, lag=better.lag, power=better.power), _uncertainty(squares_of, better, rows)


def _best_lag(
    squares_of: Callable[[float, float], float], power: float, logarithms: tuple[float, float], tolerance: float
) -> tuple[float, ResponseDynamics]:
    """Return the least sum of squares between two logarithms of a lag, to a tolerance, and that lag."""
    from scipy.optimize import minimize_scalar

    best = minimize_scalar(
        squares_of, args=(power,), bounds=logarithms, method="bounded", options={"xatol": tolerance, "maxiter": 30}
    )
    return float(best.fun), ResponseDynamics(math.exp(float(best.x)), power)


def _shapes_of_holds(recording: TransientRecording, end: float) -> list[tuple[slice, Floats, Floats]]:
    """Return the rows of each hold that has enough of them up to an instant, their weights and weighted response."""
    last = recording.last_change[recording.times <= end]
    weights = _weights(recording)
    found = []
    for within in (
        slice(*edges) for edges in np.searchsorted(last, [(k, k + 1) for k in np.unique(last[last >= 0])])
    ):
        if within.stop - within.start >= _ROWS_OF_HOLD:
            found.append((within, weights[within], weights[within] * recording.responded[within]))
    return found


def _uncertainty(squares_of: Callable[[float, float], float], lagged: ResponseDynamics, count: int) -> float:
    """Return the standard uncertainty of a lag from the curvature of the sum of squares about it, s."""
    near = 0.05
    middle, low, high = (squares_of(math.log(lagged.lag) + each, lagged.power) for each in (0.0, -near, near))
    curvature = max((low - 2.0 * middle + high) / near**2, 1e-300)
    return lagged.lag * math.sqrt(2.0 * middle / count / curvature)


def _weights(recording: TransientRecording) -> Floats:
    return row_weights(recording.times, recording.responded, 5e-3 * float(np.ptp(recording.responded)))
