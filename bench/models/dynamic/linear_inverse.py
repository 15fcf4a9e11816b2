"""The inverse of a linear part without delay: from wanted responses to the input at each sample.

The input is a straight line between samples, so that the response at a sample is a + b z, where z is the input there
and a follows from the state before. With first-order lag and creep this recursion is stable for every step. That of a
resonance is not for steps short beside its period: the sampled system then has zeros outside of the unit circle
(Åström, Hagander and Sternby, "Zeros of sampled systems", Automatica 20, 31-38, 1984).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bench.base import Floats
from bench.models.dynamic.linear_parts import FilterState, LinearPart, free_evolution

_LEAST_EFFECT = 1e-4
"""Least part of the stationary gain that acts within one step. With less, rounding decides the input.

Derivation: an output that is known to 1e-9 of its range gives the input to 1e-5 of its own.
"""
_ROUNDING = 1e-6
"""By how much a mode may grow in one step, for rounding.

Source: rounding of float64: an eigenvalue of a defective matrix of order two errs by √ε, 1.5e-8.
"""


class _Steps(NamedTuple):
    """How the fast dynamics and each creep element pass a step from input z0 to z1; one row a step, shape (N, J).

    Value: stay z0 + keep value + turn rate + follow z1. Rate: slope (z1 - z0) + pull (value - z0) + hold rate.
    """

    stay: Floats
    keep: Floats
    turn: Floats
    follow: Floats
    slope: Floats
    pull: Floats
    hold: Floats


def bring_responses(
    linear: LinearPart,
    times: Floats,
    responses: Floats,
    before: tuple[float, FilterState] | None,
    bring: Callable[[float], float],
) -> None:
    """Bring the response at each sample to a wanted value, by the input there.

    Parameters
    ----------
    linear : LinearPart
        Without delay.
    times : ndarray, shape (N,), or (N + 1,) with `before`
        s; with `before` its time comes first.
    responses : ndarray, shape (N,)
        Wanted responses, input units.
    before : tuple of float and FilterState, or None
        Input and state at the sample before the first; None is settled at the first.
    bring : callable
        Takes the input that is needed and returns the one that is reached, from which the next response follows.

    Raises
    ------
    ValueError
        If there is a delay, the steps are too short, or the recursion is unstable.
    """
    if linear.delay > 0.0:
        raise ValueError(f"a delay ({linear.delay:.4g} s) has no inverse from sample to sample")
    strengths = np.concatenate([[1.0], linear.creep_strengths])
    durations = np.diff(times)
    steps = _steps(linear, durations)
    effects = steps.follow @ strengths
    _check(durations, steps, effects, strengths)
    wanted = responses.tolist()
    if before is None:
        gain = float(strengths.sum())
        if abs(gain) < _LEAST_EFFECT:
            raise ValueError("the linear part has no stationary gain")
        value = bring(wanted.pop(0) / gain)
        state = linear.settled(value)
    else:
        value, state = before
    values, rates = np.array([state.value, *state.crept]), np.zeros(strengths.size)
    rates[0] = state.rate
    for response, effect, stay, keep, turn, follow, slope, pull, hold in zip(
        wanted, effects.tolist(), *steps, strict=True
    ):
        free = stay * value + keep * values + turn * rates
        reached = bring((response - float(strengths @ free)) / effect)
        rates = slope * (reached - value) + pull * (values - value) + hold * rates
        values = free + follow * reached
        value = reached


def _steps(linear: LinearPart, durations: Floats) -> _Steps:
    lags = [linear.lag, *((time, 0.0) for time in linear.creep_times.tolist())]
    free = np.stack([free_evolution(*lag, durations) for lag in lags], axis=1)
    keep, turn, pull, hold = np.moveaxis(free, 2, 0)
    first, inverse = np.array([lag[0] for lag in lags]), 1.0 / durations[:, None]
    lagging = (first * (1.0 - keep) + turn) * inverse
    return _Steps(lagging - keep, keep, turn, 1.0 - lagging, (1.0 + pull * first - hold) * inverse, pull, hold)


def _check(durations: Floats, steps: _Steps, effects: Floats, strengths: Floats) -> None:
    """Raise ValueError if an input has hardly an effect in its step, or the recursion grows at the median step."""
    if durations.size == 0:
        return
    least = int(np.abs(effects).argmin())
    if abs(effects[least]) < _LEAST_EFFECT * abs(strengths).sum():
        raise ValueError(
            f"a step of {durations[least]:.4g} s is too short for the inverse: hardly anything of an input has an "
            "effect within it; take longer steps"
        )
    median = int(np.argsort(durations)[durations.size // 2])
    growth = _growth(_Steps(*(each[median] for each in steps)), float(effects[median]), strengths)
    if growth > 1.0 + _ROUNDING:
        raise ValueError(
            f"at steps of {durations[median]:.4g} s the inverse is unstable: set-points would grow {growth:.3g}-fold "
            "from row to row; take longer steps"
        )


def _growth(step: _Steps, effect: float, strengths: Floats) -> float:
    """Return the greatest factor of a mode of (input, values, rates) in one step that holds the response at zero."""
    free = np.hstack([step.stay[:, None], np.diag(step.keep), np.diag(step.turn)])
    needed = -(strengths @ free) / effect
    rates = np.hstack([-(step.slope + step.pull)[:, None], np.diag(step.pull), np.diag(step.hold)])
    modes = np.vstack([needed, free + np.outer(step.follow, needed), rates + np.outer(step.slope, needed)])
    return float(np.abs(np.linalg.eigvals(modes)).max())
