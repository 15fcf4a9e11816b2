"""How to go on measuring: damped tails where the model is least certain (greedy D-optimal design)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.design.excitation import ramps
from bench.identification.design.information import (
    NOISE,
    Scaling,
    covariance,
    log_determinant,
    mean_variance,
    random_reversals,
)
from bench.models import MemoryCurve, Operator, Preisach, ThermalExpansion, uniform_levels

_FINEST = 30
"""Most intervals of the plane for which tails are chosen: a finer one costs time and moves none of them. Source: a
choice; a plane of 30 has 465 cells."""

# Derivation: a dense matrix of them takes 8 MB, and its factor 3e8 products for each tail.
_MOST_COEFFICIENTS = 1000

_REACHES = (2, 3, 5, 8)
"""How far tails reach from their centres, in steps. Source: a choice; each is about 1.6 times the one before, as
small and large loops count alike."""


@dataclass(frozen=True, eq=False)
class Tail:
    """A damped oscillation about a centre that returns to its first maximum.

    From `center - reach` to `center + reach`, then to and fro, one step less at each reversal on one side and the
    other, down to the centre, and back to the first maximum. Whatever has return-point memory gives the output of
    the first visit there again.
    """

    # Input units; the reach a multiple of the step.
    center: float
    reach: float
    step: float

    def setpoints(self) -> Floats:
        """Return the set-points, shape (N,)."""
        extrema = [self.center - self.reach, self.center + self.reach]
        for left in range(round(self.reach / self.step) - 1, -1, -1):
            extrema += [self.center - left * self.step, self.center + left * self.step]
        # At the centre both sides meet.
        return ramps([*extrema[:-1], extrema[1]], self.step)

    @property
    def first_maximum(self) -> int:
        """The number of the set-point, from 0, at the first maximum; the last is there again."""
        return round(2.0 * self.reach / self.step)


@dataclass(frozen=True, eq=False)
class Continuation:
    """Damped tails that tell most about a model per second, from negative saturation on.

    Attributes
    ----------
    setpoints : ndarray, shape (N,)
        Input units.
    tails : tuple of Tail
        In their order.
    visits : tuple of (int, int)
        Pairs of set-points, counted from 0, that visit one extremum: the return-point test.
    time : float
        Laboratory time at the dwell asked for, s.
    before, after, repeated : float
        log10 det of the information in decades per coefficient: of the data, with the tails, and with the data
        repeated for the same time.
    variance_before, variance_after, variance_repeated : float
        Mean variance of predictions over random reversals, in variances of the noise, likewise.
    """

    setpoints: Floats
    tails: tuple[Tail, ...]
    visits: tuple[tuple[int, int], ...]
    time: float
    before: float
    after: float
    repeated: float
    variance_before: float
    variance_after: float
    variance_repeated: float


def continue_design(
    operator: Operator[Any],
    inputs: ArrayLike,
    *,
    seconds: float,
    dwell: float,
    state: Any = None,  # noqa: ANN401 - the operator's own
    noise: float = NOISE,
) -> Continuation:
    """Return the tails that add most to log det of the information per second, one after another.

    Parameters
    ----------
    operator : Operator
        The model; its coefficients do not matter. A plane of more than 30 intervals is taken with 30.
    inputs : array_like, shape (N,)
        The inputs that were measured.
    seconds, dwell : float
        Laboratory time to be filled, and that at each set-point, s, > 0.
    state : object or None
        Memory before the first input; default the initial state of the operator.
    noise : float
        Noise of the output as a share of its range.

    Raises
    ------
    ValueError
        If a number is not positive, the time is too short for any tail, or there are more than 1000 coefficients.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    for name, value in (("seconds", seconds), ("dwell", dwell)):
        if not _checks.number(name, value) > 0.0:
            raise ValueError(f"{name}: expected a positive number, got {value}")
    measured = _checks.samples("inputs", inputs)
    # Matrices so small gain nothing from more threads, and lose on a busy machine.
    with threadpool_limits(limits=1, user_api="blas"):
        return _continue(operator, measured, state, dwell, math.floor(seconds / dwell * (1.0 + 1e-9)), noise)


def _continue(
    operator: Operator[Any],
    measured: Floats,
    state: Any,  # noqa: ANN401
    dwell: float,
    left: int,
    noise: float,
) -> Continuation:
    """Return the tails for a number of set-points that are left."""
    coarse, step = _coarse(operator)
    if coarse is not operator and not isinstance(state, MemoryCurve):
        state = None
    operator = coarse
    scaling = Scaling.of(operator, noise)
    data = scaling.rows(operator, measured, state)
    spread = covariance(data)
    memory = start = operator.saturated_state(-1)
    # Rounding must not lead beyond the range.
    candidates = [
        (tail, np.clip(tail.setpoints(), *operator.input_range)) for tail in _tails(operator.input_range, step)
    ]
    shortest = min(setpoints.size for _, setpoints in candidates)
    if left < shortest:
        raise ValueError(f"seconds: expected at least {shortest * dwell:g}, the time of the shortest tail")
    chosen: list[tuple[Tail, Floats]] = []
    while affordable := [each for each in candidates if each[1].size <= left]:
        rows = [scaling.rows(operator, setpoints, memory) for _, setpoints in affordable]
        best = int(np.argmax([_gain(each, spread) / each.shape[0] for each in rows]))
        chosen.append(affordable[best])
        spread = _updated(spread, rows[best])
        memory = operator.advance(memory, affordable[best][1])
        left -= rows[best].shape[0]
    setpoints = np.concatenate([each for _, each in chosen])
    firsts = np.cumsum([0, *(each.size for _, each in chosen)]).tolist()
    added = scaling.rows(operator, setpoints, start)
    again = scaling.rows(operator, np.resize(measured, setpoints.size), start)
    judged = scaling.rows(operator, random_reversals(operator.input_range, step), start)
    after, repeated = np.vstack([data, added]), np.vstack([data, again])
    return Continuation(
        setpoints=setpoints,
        tails=tuple(tail for tail, _ in chosen),
        visits=tuple(
            (first + tail.first_maximum, first + each.size - 1)
            for first, (tail, each) in zip(firsts, chosen, strict=False)
        ),
        time=dwell * setpoints.size,
        before=log_determinant(data),
        after=log_determinant(after),
        repeated=log_determinant(repeated),
        variance_before=mean_variance(judged, covariance(data)),
        variance_after=mean_variance(judged, covariance(after)),
        variance_repeated=mean_variance(judged, covariance(repeated)),
    )


def _coarse(operator: Operator[Any]) -> tuple[Operator[Any], float]:
    """Return an operator for which tails are chosen in little time, and their step."""
    low, high = operator.input_range
    intervals = 20
    if densities := operator.densities():
        levels = densities[0].levels
        intervals = min(levels.size - 1, _FINEST)
        if levels.size - 1 > _FINEST:
            ends = float(levels[0]), float(levels[-1])
            operator = Preisach(
                uniform_levels(*ends, _FINEST),
                np.zeros(_FINEST * (_FINEST + 1) // 2),
                # It stands for any reversible part of two coefficients.
                reversible=ThermalExpansion(0.0, 0.0, *ends, low),
                input_range=(low, high),
            )
    count = operator.coefficients.size
    if count > _MOST_COEFFICIENTS:
        raise ValueError(f"operator: expected at most {_MOST_COEFFICIENTS} coefficients, got {count}")
    return operator, (high - low) / max(intervals, 2 * _REACHES[0])


def _tails(operating: tuple[float, float], step: float) -> Iterator[Tail]:
    """Yield the tails whose extrema lie on the grid of the steps within the range."""
    low, high = operating
    count = round((high - low) / step)
    for reach in _REACHES:
        for center in range(reach, count - reach + 1):
            yield Tail(low + center * step, reach * step, step)


def _gain(rows: Floats, spread: Floats) -> float:
    """Return log det(I + A C Aᵀ), what the rows A add to that of the information whose inverse is C."""
    middle = rows @ spread @ rows.T
    middle[np.diag_indices_from(middle)] += 1.0
    return float(np.linalg.slogdet(middle)[1])


def _updated(spread: Floats, rows: Floats) -> Floats:
    """Return the inverse of the information with further rows (Woodbury)."""
    half = rows @ spread
    middle = half @ rows.T
    middle[np.diag_indices_from(middle)] += 1.0
    result = spread - half.T @ np.linalg.solve(middle, half)
    return 0.5 * (result + result.T)
