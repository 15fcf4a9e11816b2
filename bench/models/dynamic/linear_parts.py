"""The linear part behind a static operator: delay, a lag or a resonance, and creep.

T(s) = exp(-delay s) [1 / (1 + a1 s + a2 s²) + Σ_j c_j / (1 + τ_j s)]

The first term is the fast dynamics: none (a1 = a2 = 0), a first-order lag (a2 = 0), or two poles. The second is creep
as a chain of Kelvin-Voigt elements with the retardation times τ_j. With equal strengths at evenly spaced log τ the
chain creeps with the logarithm of time (Kuhnen 2003, section 4; Findley, Lai and Onaran 1976, section 5).

Between samples the input is a straight line. For such inputs every response here is exact on uneven times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.documents import Document


class FilterState(NamedTuple):
    """State of the fast dynamics and of each creep element at one moment.

    Attributes
    ----------
    value, rate : float
        Of the fast dynamics, input units and input units / s.
    crept : tuple of float
        Value of each creep element, input units.
    """

    value: float
    rate: float
    crept: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class LinearPart(Document):
    """Delay, fast dynamics and creep, as at the head of this module.

    Parameters
    ----------
    delay : float
        s, >= 0.
    lag : tuple of float
        a1 in s and a2 in s², >= 0; a2 > 0 needs a1 > 0.
    creep_times : array_like, shape (n,)
        Retardation times τ_j, s, > 0.
    creep_strengths : array_like, shape (n,)
        c_j, as part of the gain of the fast dynamics.

    Raises
    ------
    ValueError
        If a number is out of its range.
    """

    kind: ClassVar[str] = "linear-part"

    delay: float = 0.0
    lag: tuple[float, float] = (0.0, 0.0)
    creep_times: Floats = field(default_factory=lambda: np.empty(0))
    creep_strengths: Floats = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        delay = _checks.number("delay", self.delay)
        if len(self.lag) != 2:
            raise ValueError(f"lag: expected a1 and a2, got {len(self.lag)} values")
        first, second = (_checks.number("lag", value) for value in self.lag)
        if delay < 0.0 or first < 0.0 or second < 0.0 or (second > 0.0 and first == 0.0):
            raise ValueError(f"delay and lag: expected values >= 0 of a stable system, got {delay} and {self.lag}")
        sequences = {}
        for name in ("creep_times", "creep_strengths"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            sequences[name] = _checks.frozen(_checks.samples(name, values) if values.size else np.empty(0))
        if sequences["creep_times"].size != sequences["creep_strengths"].size:
            raise ValueError("creep_strengths: expected one for each retardation time")
        if not (sequences["creep_times"] > 0.0).all():
            raise ValueError("creep_times: expected positive times")
        object.__setattr__(self, "delay", delay)
        object.__setattr__(self, "lag", (first, second))
        for name, values in sequences.items():
            object.__setattr__(self, name, values)

    @property
    def creeps_by_logarithm(self) -> bool:
        """Whether the creep elements are a chain of equal strengths."""
        return self.creep_strengths.size > 1 and bool((self.creep_strengths == self.creep_strengths[0]).all())

    def settled(self, value: float) -> FilterState:
        """Return the state after an input has stood for long."""
        return FilterState(value, 0.0, (value,) * self.creep_times.size)

    def respond(
        self, times: ArrayLike, columns: Floats, state: FilterState | None = None
    ) -> tuple[Floats, tuple[Floats, Floats, Floats]]:
        """Return the responses at the samples, and the undelayed states at the last sample.

        Parameters
        ----------
        times : array_like, shape (N,)
            s, strictly increasing.
        columns : ndarray, shape (N, K)
            One column an input; each is a straight line between samples.
        state : FilterState or None
            At the first sample; None is settled at the first row. Before the first sample the response is that
            of the first sample.

        Returns
        -------
        ndarray, shape (N, K), and the tuple of values (K,), rates (K,) and crept values (n, K).
        """
        t = _checks.samples("times", times)
        values = np.ascontiguousarray(columns, dtype=np.float64)
        count = values.shape[1]
        value = values[0].copy() if state is None else np.full(count, state.value)
        rate = np.full(count, 0.0 if state is None else state.rate)
        result = self._filter(t, values, self.lag, value, rate)
        crept = np.empty((self.creep_times.size, count))
        for j, (time, strength) in enumerate(zip(self.creep_times, self.creep_strengths, strict=True)):
            crept[j] = values[0] if state is None else state.crept[j]
            result += strength * self._filter(t, values, (float(time), 0.0), crept[j], np.zeros(count))
        return result, (value, rate, crept)

    def _filter(
        self, times: Floats, columns: Floats, lag: tuple[float, float], value: Floats, rate: Floats
    ) -> Floats:
        """Return delayed responses of 1 / (1 + a1 s + a2 s²), with its last state in `value` and `rate`."""
        from bench.models.kernels import dynamic_kernels as _kernels

        steps = np.diff(times)
        rows, offsets = self._moments(times)
        late = np.ascontiguousarray(free_evolution(*lag, offsets)[:, :2])
        return np.asarray(
            _kernels.filtered(columns, steps, lag[0], free_evolution(*lag, steps), rows, offsets, late, value, rate)
        )

    def _moments(self, times: Floats) -> tuple[np.ndarray[Any, np.dtype[np.int64]], Floats]:
        """Return the last sample before each delayed moment, -1 where there is none, and the time since, s."""
        if self.delay == 0.0:
            return np.arange(times.size), np.zeros(times.size)
        moments = times - self.delay
        rows = np.searchsorted(times, moments, side="right") - 1
        return rows, np.where(rows < 0, 0.0, moments - times[np.maximum(rows, 0)])


def free_evolution(first: float, second: float, durations: Floats) -> Floats:
    """Return how value and rate of 1 / (1 + first s + second s²) evolve freely over durations, s.

    Rows of four: the matrix exponential, row by row; shape (N, 4).
    """
    result = np.zeros((durations.size, 4))
    if second == 0.0:
        if first > 0.0:
            result[:, 0] = np.exp(-durations / first)
        return result
    decay = 0.5 * first / second
    difference = decay**2 - 1.0 / second
    if difference < 0.0:
        turn = math.sqrt(-difference)
        envelope = np.exp(-decay * durations)
        impulse = envelope * np.sin(turn * durations) / turn
        level = envelope * np.cos(turn * durations) + decay * impulse
    else:
        root = math.sqrt(difference)
        slow = -1.0 / second / (decay + root)
        slowly = np.exp(slow * durations)
        impulse = slowly * (-np.expm1(-2.0 * root * durations) / (2.0 * root) if root > 0.0 else durations)
        level = slowly - slow * impulse
    result[:, 0], result[:, 1] = level, impulse
    result[:, 2], result[:, 3] = -impulse / second, level - impulse * first / second
    return result


def logarithmic_creep(strength: float, shortest: float, longest: float) -> tuple[Floats, Floats]:
    """Return retardation times and strengths of creep by `strength` per decade of time, two elements a decade.

    Times from `shortest` to about `longest`, s.
    """
    count = max(2, math.ceil(2.0 * math.log10(longest / shortest)) + 1)
    times = np.geomspace(shortest, longest, count)
    decades = math.log10(longest / shortest) / (count - 1)
    return times, np.full(count, strength * decades)
