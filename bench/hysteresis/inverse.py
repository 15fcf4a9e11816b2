"""The exact inverse of a Preisach operator, by walking over its quadratic segments."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.hysteresis import MemoryCurve, Preisach, _checks
from bench.hysteresis._checks import Floats

# Part of the output scale within which a target counts as met.
_TOLERANCE = 2e-13


class Reach(Enum):
    """Whether a target could be met."""

    MET = "met"
    TOO_HIGH = "too high"
    TOO_LOW = "too low"


@dataclass(frozen=True)
class Inversion:
    """The set-points that bring the output to a target.

    Parameters
    ----------
    setpoints : tuple of float
        One input, or two if the target can only be met after saturation: the first then is an end of the
        plane, and the actuator travels through its whole range.
    outputs : tuple of float
        The operator's output at each set-point.
    reach : Reach
        `MET`, or that the target was too high or too low; the last output then is the closest one that at
        most two set-points reach.
    iterations : int
        Number of segments walked, over all directions tried.
    state : MemoryCurve
        Memory after the last set-point.
    """

    setpoints: tuple[float, ...]
    outputs: tuple[float, ...]
    reach: Reach
    iterations: int
    state: MemoryCurve


@dataclass(frozen=True, eq=False)
class Following:
    """The set-points that bring the output to one target after another.

    Parameters
    ----------
    setpoints : ndarray, shape (N,)
        The input that meets each target (the last one where there are two).
    saturating : ndarray, shape (N,)
        The set-point to pass before it, NaN where none is needed.
    outputs : ndarray, shape (N,)
        The operator's outputs at `setpoints`.
    met : ndarray of bool, shape (N,)
        Whether the target could be met; if not, the output is the closest one.
    iterations : ndarray of int64, shape (N,)
        Segments walked for each target.
    state : MemoryCurve
        Memory after the last set-point.
    """

    setpoints: Floats
    saturating: Floats
    outputs: Floats
    met: NDArray[np.bool_]
    iterations: NDArray[np.int64]
    state: MemoryCurve


@dataclass(frozen=True, eq=False)
class Inverse:
    """The exact inverse of a Preisach operator, non-monotonic ones included.

    From the present memory the output is followed upwards and downwards, segment by segment (Zhang et al.
    2013, eq. 19), to the first input that meets the target. If neither way does, the two major branches are
    tried through saturation. On a plateau the answer is the point nearest to the present input, which is the
    present input itself if its output is the target already. Beyond the plane and up to the operating
    range the walk goes on with the reversible part alone. A target counts as met within 2e-13
    of the output scale, which is the sum of |density| * area plus |bias|, or an output at saturation if that
    is greater.

    Parameters
    ----------
    operator : Preisach
        The model to invert.
    policy : {"nearest", "paper"}
        Which answer to take if both directions have one: the one nearest to the present input; or, as the
        paper has it, upwards for a target above the present output up to that at positive saturation,
        downwards for one below it down to that at negative saturation, and otherwise the nearest.

    Raises
    ------
    ValueError
        If the policy is unknown.
    """

    operator: Preisach
    policy: Literal["nearest", "paper"] = "nearest"

    def __post_init__(self) -> None:
        if self.policy not in ("nearest", "paper"):
            raise ValueError(f"policy: expected 'nearest' or 'paper', got {self.policy!r}")

    def _retuned(self, operator: Preisach, ends: tuple[float, float, float]) -> Inverse:
        """Return the inverse of an operator with another nonnegative density on the same levels."""
        other = object.__new__(Inverse)
        other.__dict__.update(operator=operator, policy=self.policy, _ends=ends, _monotone=self._monotone)
        return other

    @cached_property
    def _ends(self) -> tuple[float, float, float]:
        """Outputs at negative and positive saturation, and the tolerance."""
        operator = self.operator
        low, high = float(operator.levels[0]), float(operator.levels[-1])
        minus, plus = operator.evaluate([low, high], MemoryCurve.from_negative_saturation(low)).tolist()
        magnitude = float(np.abs(operator.density) @ operator.cell_areas()) + abs(operator.bias)
        return minus, plus, _TOLERANCE * max(magnitude, abs(minus), abs(plus))

    @cached_property
    def _monotone(self) -> bool:
        """Whether the output can only rise with the input."""
        term = self.operator.reversible
        slopes = [0.0]
        if term is not None:
            breaks, quadratics = term.pieces()
            low, high = self.operator.input_range
            bounds = [low, *np.clip(breaks, low, high).tolist(), high]
            for (_, b, a), ends in zip(quadratics, pairwise(bounds), strict=True):
                slopes += [b + 2.0 * a * end for end in ends]
        return bool((self.operator.density >= 0.0).all() and min(slopes) >= 0.0)

    @cached_property
    def _constants(self) -> tuple[Any, ...]:
        t = self.operator.lattice
        minus, plus, _ = self._ends
        return (
            t.levels,
            t.inverse_step,
            t.table,
            t.below,
            t.offset,
            t.breaks,
            t.quadratics,
            *self.operator.input_range,
            minus,
            plus,
        )

    def invert(self, state: MemoryCurve, target: float) -> Inversion:
        """Return the set-points that bring the output from `state` to `target`.

        Parameters
        ----------
        state : MemoryCurve
            Present memory.
        target : float
            Wanted output, output units.

        Raises
        ------
        ValueError
            If the target is not finite.
        """
        from bench.hysteresis import _inverse_kernels as _kernels

        if not math.isfinite(target):
            raise ValueError(f"target: expected a finite number, got {target}")
        levels = self.operator.levels
        left, height, inside = state.staircase(levels.item(0), levels.item(-1))
        minus, plus, tolerance = self._ends
        arguments = (
            *self._constants,
            np.array(left, dtype=np.float64),
            np.array(height, dtype=np.float64),
            inside,
            state.input,
            float(target),
            tolerance,
            self.policy == "nearest",
            self._monotone,
        )
        count, first, last, error, iterations = _kernels.invert_state(*arguments)
        reach = Reach.MET
        if abs(error) > 2.0 * tolerance:
            reach = Reach.TOO_HIGH if error < 0.0 else Reach.TOO_LOW
        if count == 1:
            return Inversion((last,), (target + error,), reach, iterations, state.step(last))
        turned = plus if first > last else minus
        final = state.step(first).step(last)
        return Inversion((first, last), (turned, target + error), reach, iterations, final)

    def follow(self, targets: ArrayLike, state: MemoryCurve | None = None) -> Following:
        """Return the set-points that bring the output to one target after another.

        Parameters
        ----------
        targets : array_like, shape (N,)
            Wanted outputs, output units.
        state : MemoryCurve or None
            Memory before the first target; default negative saturation.

        Raises
        ------
        ValueError
            If `targets` is empty, not one-dimensional or not finite.
        """
        from bench.hysteresis import _inverse_kernels as _kernels

        wanted = _checks.samples("targets", targets)
        before = self.operator.initial_state() if state is None else state
        levels = self.operator.levels
        left, height, inside = before.staircase(levels.item(0), levels.item(-1))
        tolerance = self._ends[2]
        first, last, errors = (np.empty(wanted.size) for _ in range(3))
        room = 2 * wanted.size + len(left) + 2
        iterations = np.empty(wanted.size, dtype=np.int64)
        arguments = (
            *self._constants,
            np.array(left, dtype=np.float64),
            np.array(height, dtype=np.float64),
            inside,
            before.input,
            wanted,
            tolerance,
            self.policy == "nearest",
            self._monotone,
            np.empty((3, room)),
            np.empty((2, room), dtype=np.int64),
            first,
            last,
            errors,
            iterations,
        )
        _kernels.follow(*arguments)
        path = np.column_stack([first, last]).ravel()
        return Following(
            setpoints=last,
            saturating=first,
            outputs=wanted + errors,
            met=np.abs(errors) <= 2.0 * tolerance,
            iterations=iterations,
            state=before.advance(path[~np.isnan(path)]),
        )
