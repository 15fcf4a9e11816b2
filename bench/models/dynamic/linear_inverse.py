"""The inverse of a linear part without delay: from wanted responses to the input at each sample.

The input is a straight line between samples, so that the response at a sample is a + b (z - z0), where z is the input
there, z0 that before, and a follows from the state before. With first-order lag and creep this recursion is stable
for every step. That of a resonance is not for steps short beside its period: the sampled system then has zeros
outside of the unit circle (Åström, Hagander and Sternby, "Zeros of sampled systems", Automatica 20, 31-38, 1984).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bench.base import Floats
from bench.models.dynamic.linear_parts import FilterState, LinearPart, durations, passages

_LEAST_EFFECT = 1e-4
"""Least part of the stationary gain that acts within one step. With less, rounding decides the input.

Derivation: an output that is known to 1e-9 of its range gives the input to 1e-5 of its own.
"""
_ROUNDING = 1e-6
"""By how much a mode may grow in one step, for rounding.

Source: rounding of float64: an eigenvalue of a defective matrix of order two errs by √ε, 1.5e-8.
"""


class _Steps(NamedTuple):
    """How the fast dynamics and each creep element pass steps, one row a step, shape (N, J); see `passages`."""

    leave: Floats
    turn: Floats
    behind: Floats
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
    strengths, gain = linear.strengths, linear.gain
    steps = durations(times)
    found = _Steps(*np.stack([passages(lag, steps, steps) for lag in linear.lags], axis=1).transpose(2, 0, 1))
    effects = gain - found.behind @ strengths
    _check(steps, found, effects, strengths)
    wanted = responses.tolist()
    if before is None:
        if abs(gain) < _LEAST_EFFECT:
            raise ValueError("the linear part has no stationary gain")
        value = bring(wanted.pop(0) / gain)
        state = linear.settled(value)
    else:
        value, state = before
    offs, rates = np.array([state.value, *state.crept]) - value, np.zeros(strengths.size)
    rates[0], lost = state.rate, np.zeros(strengths.size)
    for response, effect, leave, turn, behind, slope, pull, hold in zip(
        wanted, effects.tolist(), *found, strict=True
    ):
        turned = turn * rates - leave * offs - lost
        still = gain * value + float(strengths @ (offs + turned))
        rise = bring(value + (response - still) / effect) - value
        rates = slope * rise + pull * offs + hold * rates
        turned -= behind * rise
        lost = (offs + turned - offs) - turned
        offs, value = offs + turned, value + rise


def _check(times: Floats, steps: _Steps, effects: Floats, strengths: Floats) -> None:
    """Raise ValueError if an input has hardly an effect in its step, or the recursion grows at the median step."""
    if times.size == 0:
        return
    least = int(np.abs(effects).argmin())
    if abs(effects[least]) < _LEAST_EFFECT * abs(strengths).sum():
        raise ValueError(
            f"a step of {times[least]:.4g} s is too short for the inverse: an input has hardly any "
            "effect within it; take longer steps"
        )
    median = int(np.argsort(times)[times.size // 2])
    growth = _growth(_Steps(*(each[median] for each in steps)), float(effects[median]), strengths)
    if growth > 1.0 + _ROUNDING:
        raise ValueError(
            f"at steps of {times[median]:.4g} s the inverse is unstable: set-points would grow {growth:.3g}-fold "
            "from row to row; take longer steps"
        )


def _growth(step: _Steps, effect: float, strengths: Floats) -> float:
    """Return the greatest factor of a mode of (input, offs, rates) in one step that holds the response at zero."""
    keep = 1.0 - step.leave
    rise = -np.concatenate([[strengths.sum()], strengths * keep, strengths * step.turn]) / effect
    none = np.zeros((strengths.size, 1))
    offs = np.hstack([none, np.diag(keep), np.diag(step.turn)]) - np.outer(step.behind, rise)
    rates = np.hstack([none, np.diag(step.pull), np.diag(step.hold)]) + np.outer(step.slope, rise)
    value = rise + np.eye(1, rise.size)
    return float(np.abs(np.linalg.eigvals(np.vstack([value, offs, rates]))).max())
