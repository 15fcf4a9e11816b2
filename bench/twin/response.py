"""What the specimen does beside its model: its dynamics, and what of the model's error repeats.

The response to a drive is the model's, with a lag of the drive before the hysteresis or late parts behind it where
the transients show them (by the Bayesian information criterion), and the output of a second Preisach operator of
either sign on a finer plane: the part of the model's error that cross-validation finds again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.deferred import DeferredModule
from bench.hysteresis import Operator, Preisach, uniform_levels
from bench.hysteresis._checks import Floats
from bench.twin.actuator import LONGEST_PART, at_rows, grid_step, latency
from bench.twin.recording import Recording
from bench.twin.specimen import ActuatorDynamics, ResponseDynamics

if TYPE_CHECKING:
    from bench.twin import _kernels
else:
    _kernels = DeferredModule("bench.twin._kernels")

_INSTANT = 0.03
"""Standard uncertainty of the instant of a reading, s."""
_LATE = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Time constants of late parts that are tried, s."""
_LEVELS = 40
"""Levels of the plane of the second operator."""
_PENALTIES = 10.0 ** np.arange(-6.0, 3.0)
"""Penalties of its densities that cross-validation tries, relative to the mean square of the columns."""
_FOLDS = 5
_BLOCK = 40
"""Folds of the cross-validation, and rows that stay together in it."""


@dataclass(frozen=True)
class IdentifiedResponse:
    """The response of a specimen with the evidence for it.

    Attributes
    ----------
    dynamics : ResponseDynamics
        Lag and late parts.
    correction : Operator or None
        Gives what of the model's error repeats; None if nothing does.
    offsets : tuple of float
        Of the response in each run, output units.
    lag_uncertainty : float
        Standard uncertainty of the lag, s; 0 without one.
    rms_model, rms : float
        Error of the model with its dynamics over the readings of steps, and what is left over with the correction,
        output units.
    unknown : tuple of ndarray
        By run, the error at each reading of a step, of a correction that was made without it, output units.
    """

    dynamics: ResponseDynamics
    correction: Operator[Any] | None
    offsets: tuple[float, ...]
    lag_uncertainty: float
    rms_model: float
    rms: float
    unknown: tuple[Floats, ...]


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


def identify_response(
    recordings: Sequence[Recording], actuator: ActuatorDynamics, model: Operator[Any]
) -> IdentifiedResponse:
    """Identify the response of a specimen, whose model and actuator are known."""
    dynamics, uncertainty = _identify_dynamics(recordings, actuator, model)
    step = grid_step(actuator)
    inputs, errors, offsets, readings = [], [], [], []
    for r in recordings:
        end = float(r.times[-1])
        seen = seen_by_specimen(r, actuator, dynamics, end)
        outputs = model.evaluate(seen)
        whole = dynamics.gain * outputs + np.array(dynamics.shares) @ late_parts(outputs, step, dynamics.times)
        error = r.responded - at_rows(r, whole, whole[0], step, latency(actuator))
        offset = float(np.median(error[r.is_reading]))
        inputs.append(at_rows(r, seen, seen[0], step, latency(actuator)))
        errors.append(error - offset)
        offsets.append(offset)
        readings.append(r.is_reading)
    chosen = np.concatenate(readings)
    left = np.concatenate(errors)
    rms_model = float(np.sqrt(np.mean(left[chosen] ** 2)))
    correction, rms, unknown = _identify_correction(model, inputs, left, chosen)
    ends = np.cumsum([int(each.sum()) for each in readings])[:-1]
    return IdentifiedResponse(
        dynamics, correction, tuple(offsets), uncertainty, rms_model, rms, tuple(np.split(unknown, ends))
    )


def _identify_dynamics(
    recordings: Sequence[Recording], actuator: ActuatorDynamics, model: Operator[Any]
) -> tuple[ResponseDynamics, float]:
    """Return the dynamics, and the standard uncertainty of the lag, s."""
    from scipy.optimize import minimize_scalar

    step = grid_step(actuator)
    ends = [min(LONGEST_PART, float(r.times[-1])) for r in recordings]
    parts = list(zip(recordings, ends, strict=True))
    measured = np.concatenate([r.responded[r.times <= end] for r, end in parts])
    runs = np.concatenate([np.full(int((r.times <= end).sum()), i) for i, (r, end) in enumerate(parts)])
    bases = (runs[:, None] == np.arange(len(parts))).astype(float)
    weights = np.concatenate([_weights(r)[r.times <= end] for r, end in parts])

    def columns_of(response: ResponseDynamics, times: Sequence[float]) -> Floats:
        """Return what comes at once and late at each row, a column each."""
        found = []
        for r, end in parts:
            outputs = model.evaluate(seen_by_specimen(r, actuator, response, end))
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
    for power in (1.0, 2.0):
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


def _identify_correction(
    model: Operator[Any], inputs: Sequence[Floats], errors: Floats, chosen: NDArray[np.bool_]
) -> tuple[Operator[Any] | None, float, Floats]:
    """Return an operator that gives what of the errors repeats, the RMS that is left, and the errors held out.

    There is no operator if nothing repeats. The last are those at each chosen row of an operator made without it.
    """
    low, high = min(each.min() for each in inputs), max(each.max() for each in inputs)
    plane = model.plane or (float(low), float(high))
    template = Preisach(
        uniform_levels(*plane, _LEVELS),
        np.zeros(_LEVELS * (_LEVELS + 1) // 2),
        input_range=(min(plane[0], float(low)), max(plane[1], float(high))),
        input_unit=model.input_unit,
        output_unit=model.output_unit,
    )
    rows = np.concatenate([template.regressor(each).dense() for each in inputs])[chosen]
    target = errors[chosen]
    rows = np.column_stack([rows, np.ones(target.size)])
    scale = float(np.mean(rows[:, :-1] ** 2)) * target.size or 1.0
    folds = (np.arange(target.size) // _BLOCK) % _FOLDS
    unknown = np.zeros((_PENALTIES.size, target.size))
    for fold in range(_FOLDS):
        kept = folds != fold
        gram, right = rows[kept].T @ rows[kept], rows[kept].T @ target[kept]
        values, vectors = np.linalg.eigh(gram)
        turned, tests = vectors.T @ right, rows[~kept] @ vectors
        for i, penalty in enumerate(_PENALTIES):
            unknown[i, ~kept] = target[~kept] - tests @ (turned / (np.maximum(values, 0.0) + penalty * scale))
    losses = np.sum(unknown**2, axis=1)
    if losses.min() >= float(target @ target):
        return None, float(np.sqrt(np.mean(target**2))), target
    penalty = float(_PENALTIES[int(np.argmin(losses))])
    gram = rows.T @ rows + penalty * scale * np.eye(rows.shape[1])
    solution = np.linalg.solve(gram, rows.T @ target)
    left = target - rows @ solution
    correction = template.with_coefficients(solution[:-1], float(solution[-1]))
    return correction, float(np.sqrt(np.mean(left**2))), unknown[int(np.argmin(losses))]
