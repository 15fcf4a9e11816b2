"""Quantities that follow expressions of each other and of inputs, each with a lag of first order or at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

_STEPS_A_LAG = 20
_AT_REST = 1e-9
"""Share of its target within which a quantity is at rest."""


@dataclass(frozen=True)
class Lag:
    """One quantity: x' = (target - x) / time_constant, or x = target where the time constant is 0.

    Attributes
    ----------
    sources : tuple of str
        Names of the inputs and quantities from which the target is computed.
    target : callable
        Computes it from the values by name; may raise `bench.base.errors.DeviceError`.
    time_constant : float
        In s, at least 0.
    initial : float or None
        Value at the beginning, None for at rest; without meaning where the time constant is 0.
    """

    sources: tuple[str, ...]
    target: Callable[[Mapping[str, float]], float]
    time_constant: float
    initial: float | None


class LagNetwork:
    """A plant of coupled lags.

    While every source of another quantity is at rest, a lag is exact. While one moves, the network goes in steps of a
    twentieth of its time constant, of second order, that begin where an input has changed: how calls divide the time
    does not matter.

    Parameters
    ----------
    inputs : mapping of str to float
        What is set from outside, by name.
    lags : mapping of str to Lag
        The quantities by name.

    Raises
    ------
    ValueError
        If quantities without a time constant, or those that begin at rest, depend on each other in a circle.
    """

    def __init__(self, inputs: Mapping[str, float], lags: Mapping[str, Lag]) -> None:
        self._inputs = dict(inputs)
        self._lags = dict(lags)
        self._slow = [name for name, lag in lags.items() if lag.time_constant > 0.0]
        self._at_once = _in_order(lags, {*self._slow}, "give one a time_constant")
        self._driving = [name for name in self._slow if self._drives(name)]
        given = {name: lag.initial for name in self._slow if (lag := lags[name]).initial is not None}
        values = {**self._inputs, **given}
        for name in _in_order(lags, {*given}, "give one an initial value"):
            values[name] = lags[name].target(values)
        self._node = {name: values[name] for name in self._slow}
        self._since_node = 0.0
        self._prepare()

    def _drives(self, name: str) -> bool:
        """Return whether a slow quantity is a source of a slow one, directly or by ones without a lag."""
        reached, new = {name}, {name}
        while new:
            users = {user for user, lag in self._lags.items() if new & {*lag.sources}}
            if any(user in self._slow for user in users):
                return True
            new = users - reached
            reached |= new
        return False

    def set(self, name: str, value: float) -> None:
        """Change an input; the quantities follow from now on."""
        if self._inputs[name] != value:
            self._begin_node()
            self._inputs[name] = value
            self._prepare()

    def value(self, name: str) -> float:
        """Return an input or a quantity."""
        return self._complete(self._at(self._since_node))[name]

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        self._since_node += dt
        while self._since_node >= self._step:
            left = self._since_node - self._step
            self._node = self._at(self._step)
            self._since_node = left
            self._prepare()

    def _begin_node(self) -> None:
        self._node = self._at(self._since_node)
        self._since_node = 0.0

    def _prepare(self) -> None:
        """Choose the step from the present node, and the targets that hold during it."""
        self._targets = self._targets_at(self._node)
        moving = [
            self._lags[name].time_constant
            for name in self._driving
            if abs(self._targets[name] - self._node[name]) > _AT_REST * (abs(self._node[name]) + 1e-6)
        ]
        self._step = min(moving) / _STEPS_A_LAG if moving else math.inf
        if moving:
            self._targets = self._targets_at(self._at(0.5 * self._step))

    def _at(self, elapsed: float) -> dict[str, float]:
        """Return the slow quantities a time after the node."""
        values = {}
        for name in self._slow:
            target = self._targets[name]
            decay = math.exp(-elapsed / self._lags[name].time_constant)
            values[name] = target + (self._node[name] - target) * decay
        return values

    def _targets_at(self, slow: Mapping[str, float]) -> dict[str, float]:
        values = self._complete(slow)
        return {name: self._lags[name].target(values) for name in self._slow}

    def _complete(self, slow: Mapping[str, float]) -> dict[str, float]:
        values = {**self._inputs, **slow}
        for name in self._at_once:
            values[name] = self._lags[name].target(values)
        return values


def _in_order(lags: Mapping[str, Lag], known: set[str], advice: str) -> list[str]:
    """Return the quantities that are not known, each after those that it is computed from."""
    left = [name for name in lags if name not in known]
    ordered: list[str] = []
    while left:
        ready = [name for name in left if not {*lags[name].sources} & {*left}]
        if not ready:
            raise ValueError(f"{', '.join(left)} depend on each other in a circle; {advice}")
        ordered += ready
        left = [name for name in left if name not in ready]
    return ordered
