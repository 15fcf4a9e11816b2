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
        from bench.models.kernels import dynamic_kernels as _kernels

        t = _checks.samples("times", times)
        values = np.ascontiguousarray(columns, dtype=np.float64)
        count = values.shape[1]
        first = np.zeros(count) if state is None else state.value - values[0]
        rate = np.full(count, 0.0 if state is None else state.rate)
        steps = durations(t)
        rows, elapsed = self._moments(t, steps)
        steps_after = np.append(steps, steps[-1:] if steps.size else 1.0)[rows]
        shares = elapsed / steps_after
        result = np.asarray(_kernels.delayed(values, rows, shares, self.gain))
        offs = np.empty((1 + self.creep_times.size, count))
        for j, (lag, strength) in enumerate(zip(self.lags, self.strengths.tolist(), strict=True)):
            offs[j] = first if state is None or j == 0 else state.crept[j - 1] - values[0]
            passed, late = passages(lag, steps, steps), passages(lag, elapsed, steps_after)
            rates = rate if j == 0 else np.zeros(count)
            _kernels.respond(values, passed, rows, late, strength, offs[j], rates, result)
        return result, (values[-1] + offs[0], rate, values[-1] + offs[1:])

    @property
    def lags(self) -> list[tuple[float, float]]:
        """Coefficients a1, a2 of the fast dynamics, then of each creep element."""
        return [self.lag, *((time, 0.0) for time in self.creep_times.tolist())]

    @property
    def strengths(self) -> Floats:
        """Gain of the fast dynamics, 1, then of each creep element; shape (n + 1,)."""
        return np.concatenate([[1.0], self.creep_strengths])

    @property
    def gain(self) -> float:
        """Response to an input that has stood for long, as part of it."""
        return float(self.strengths.sum())

    def _moments(self, times: Floats, steps: Floats) -> tuple[np.ndarray[Any, np.dtype[np.int64]], Floats]:
        """Return the last sample before each delayed moment, -1 where there is none, and the time since, s."""
        samples = np.arange(times.size)
        if self.delay == 0.0:
            return samples, np.zeros(times.size)
        if steps.size and (steps == steps[0]).all():
            whole, part = split_delay(self.delay, float(steps[0]))
            rows = samples - whole - (part < 1.0)
            return np.maximum(rows, -1), np.where(rows < 0, 0.0, part % 1.0 * steps[0])
        moments = times - self.delay
        rows = np.searchsorted(times, moments, side="right") - 1
        return rows, np.where(rows < 0, 0.0, moments - times[np.maximum(rows, 0)])


def durations(times: Floats) -> Floats:
    """Return the steps between times, s; equal ones where they differ by no more than the rounding of the times."""
    steps = np.diff(times)
    if steps.size == 0:
        return steps
    mean = (times[-1] - times[0]) / steps.size
    even = np.abs(steps - mean).max() <= 2.0 * np.spacing(np.abs(times).max())
    return np.full(steps.size, mean) if even else steps


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Return the whole periods of a delay, and the part of a period, in (0, 1], after which the output is taken.

    The output at a sample is that of the input this part of a period after the sample before, whole periods ago.
    """
    periods = delay / period
    whole = math.floor(periods + 1e-9)
    return whole, 1.0 - max(periods - whole, 0.0)


def passages(lag: tuple[float, float], elapsed: Floats, steps: Floats) -> Floats:
    """Return how 1 / (1 + a1 s + a2 s²) passes times in steps during which its input rises evenly, shape (N, 6).

    From `off`, the value less the input, and the rate at the begin of a step: off += turn rate - leave off -
    behind rise, with `rise` that of the input within the step, and rate = slope rise + pull off + hold rate. In this
    order: leave, turn, behind, slope, pull, hold. No small difference of great numbers is taken, however short the
    steps are beside the lag.

    Parameters
    ----------
    lag : tuple of float
        a1 in s and a2 in s².
    elapsed, steps : ndarray, shape (N,)
        Time since the begin of a step, and the whole step, s.
    """
    if elapsed.size > 1 and (elapsed == elapsed[0]).all() and (steps == steps[0]).all():
        return np.repeat(passages(lag, elapsed[:1], steps[:1]), elapsed.size, axis=0)
    first, second = lag
    result = np.zeros((elapsed.size, 6))
    leave, turn, _, slope, pull, hold = result.T
    if second == 0.0:
        leave[:] = -np.expm1(-elapsed / first) if first > 0.0 else 1.0
    else:
        decay = 0.5 * first / second
        difference = decay**2 - 1.0 / second
        if difference < 0.0:
            frequency = math.sqrt(-difference)
            envelope = np.exp(-decay * elapsed)
            turn[:] = envelope * np.sin(frequency * elapsed) / frequency
            level = envelope * np.cos(frequency * elapsed) + decay * turn
        else:
            root = math.sqrt(difference)
            slow = -1.0 / second / (decay + root)
            slowly = np.exp(slow * elapsed)
            turn[:] = slowly * (-np.expm1(-2.0 * root * elapsed) / (2.0 * root) if root > 0.0 else elapsed)
            level = slowly - slow * turn
        leave[:] = 1.0 - level
        pull[:], hold[:] = -turn / second, level - turn * first / second
    result[:, 2] = (first * leave + turn) / steps
    slope[:] = leave / steps
    return result


def logarithmic_creep(strength: float, shortest: float, longest: float) -> tuple[Floats, Floats]:
    """Return retardation times and strengths of creep by `strength` per decade of time, two elements a decade.

    Times from `shortest` to about `longest`, s.
    """
    count = max(2, math.ceil(2.0 * math.log10(longest / shortest)) + 1)
    times = np.geomspace(shortest, longest, count)
    decades = math.log10(longest / shortest) / (count - 1)
    return times, np.full(count, strength * decades)
