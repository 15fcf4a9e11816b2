"""Inverses of operators: the input that brings the output to a target, from the present memory.

`PreisachInverse` walks over quadratic segments and `PlayInverse` drives the inverse Prandtl-Ishlinskii operator:
both are exact. `NumericalInverse` serves every other operator, and `TableInverse` one without memory.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Generic, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.models.memory import MemoryCurve, trusted_curve
from bench.models.reach import Reach

if TYPE_CHECKING:
    from bench.models.operator import Operator
    from bench.models.operators.prandtl_ishlinskii import PlayState, PrandtlIshlinskii
    from bench.models.operators.preisach import Preisach
    from bench.models.streams.inverse_stream import InverseStream, PlayInverseStream, PreisachInverseStream
    from bench.models.streams.stream import Stream

S = TypeVar("S")
Policy: TypeAlias = Literal["nearest", "paper"]

# As the compiled walks take them, see `inverse_kernels`.
_Operator: TypeAlias = tuple[tuple[Floats, float, Floats], Floats, float, tuple[Floats, Floats]]
_Shape: TypeAlias = tuple[Floats, Floats]
_Ends: TypeAlias = tuple[float, float, float, bool, bool]

_TOLERANCE = 2e-13
"""Part of the output scale within which a target counts as met.

Source: rounding of float64: a sum of 1000 numbers errs by no more than 1000 times 2.2e-16.
"""
_ROUNDING = 1e-14
"""Part of the output scale that a search by bisection takes for rounding.

Source: rounding of float64: a sum of 1000 numbers typically errs by √1000 times 2.2e-16, 7e-15.
"""
_PIECES = 256
"""Pieces into which a numerical inverse divides the way to an end of the range, in search of a crossing.

Derivation: six for each of 40 levels, as many as a plane has; bisection then finds the crossing to the last digit.
"""


@dataclass(frozen=True)
class Inversion(Generic[S]):
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
    state : object
        Memory after the last set-point.
    """

    setpoints: tuple[float, ...]
    outputs: tuple[float, ...]
    reach: Reach
    iterations: int
    state: S


@dataclass(frozen=True, eq=False)
class Following(Generic[S]):
    """The set-points that bring the output to one target after another."""

    setpoints: Floats  # shape (N,); the input that meets each target (the last one where there are two)
    saturating: Floats  # shape (N,); the set-point to pass before it, NaN where none is needed
    outputs: Floats  # shape (N,); the operator's outputs at `setpoints`
    met: NDArray[np.bool_]  # shape (N,); whether the target could be met; if not, the output is the closest one
    iterations: NDArray[np.int64]  # shape (N,); segments walked for each target
    state: S  # memory after the last set-point


@dataclass(frozen=True, eq=False)
class Inverse(ABC, Generic[S]):
    """What every inverse of an operator can do.

    Parameters
    ----------
    operator : Operator
        The model to invert.
    policy : {"nearest", "paper"}
        Which answer to take where there are several: the one nearest to the present input; or, by the rule of
        Zhang et al. 2013, one upwards for a target above the present output, else one downwards.

    Raises
    ------
    ValueError
        If the policy is unknown.
    """

    operator: Operator[S]
    policy: Policy = "nearest"

    def __post_init__(self) -> None:
        if self.policy not in ("nearest", "paper"):
            raise ValueError(f"policy: expected 'nearest' or 'paper', got {self.policy!r}")

    @abstractmethod
    def invert(self, state: S, target: float) -> Inversion[S]:
        """Return the set-points that bring the output from `state` to `target`, output units.

        Raises ValueError if the target is not finite.
        """

    @abstractmethod
    def nearest_input(
        self, state: S, present: float, target: float, bounds: tuple[float, float] | None = None
    ) -> float:
        """Return the input nearest to the present one that meets a target, or else comes closest.

        For operators that rise with their input, or fall. The bounds replace the operating range; a saturated
        operator may disregard them.
        """

    def stream(self, state: S | None = None) -> InverseStream[S]:
        """Return the inverse with a memory of its own, for one target at a time, from a state (default: initial)."""
        from bench.models.streams.inverse_stream import InverseStream

        return InverseStream(self, self.operator.initial_state() if state is None else state)

    def follow(self, targets: ArrayLike, state: S | None = None) -> Following[S]:
        """Return the set-points that bring the output to one target after another.

        Parameters
        ----------
        targets : array_like, shape (N,)
            Wanted outputs, output units.
        state : object or None
            Memory before the first target; default the operator's initial state.

        Raises
        ------
        ValueError
            If `targets` is empty, not one-dimensional or not finite.
        """
        memory = self.operator.initial_state() if state is None else state
        found = []
        for target in _checks.samples("targets", targets).tolist():
            found.append(self.invert(memory, target))
            memory = found[-1].state
        return Following(
            setpoints=np.array([one.setpoints[-1] for one in found]),
            saturating=np.array([one.setpoints[0] if len(one.setpoints) > 1 else math.nan for one in found]),
            outputs=np.array([one.outputs[-1] for one in found]),
            met=np.array([one.reach is Reach.MET for one in found]),
            iterations=np.array([one.iterations for one in found]),
            state=memory,
        )


@dataclass(frozen=True, eq=False)
class NumericalInverse(Inverse[S]):
    """The inverse of any operator, by bisection over the reachable pieces on which the output is monotone.

    From the present input the way to either end of the operating range is divided into 256 pieces, and the first
    that crosses the target is bisected to the last digit. If there is none, each end is visited first and the way
    back searched. A crossing and its return within one piece are missed.
    """

    def invert(self, state: S, target: float) -> Inversion[S]:
        """Return the set-points that bring the output from `state` to `target`; see `Inverse.invert`."""
        wanted, operator = _checks.number("target", target), self.operator
        present, here = operator.present_input(state), operator.value(state)
        low, high = operator.input_range
        up = wanted > here if self.policy == "paper" else high - present < present - low
        ways = [self._search(state, here, present, end, wanted) for end in ((high, low) if up else (low, high))]
        if not any(met for _, met in ways):
            after = [operator.step(state, end) for end in (low, high)]
            ways += [
                ((end, *found[0]), found[1])
                for end, other, (turned, there) in zip((low, high), (high, low), after, strict=True)
                if (found := self._search(turned, there, end, other, wanted))
            ]
        answers = [setpoints for setpoints, met in ways if met]
        if self.policy == "nearest":
            answers.sort(key=lambda setpoints: abs(setpoints[-1] - present))
        outputs = {setpoints: operator.evaluate(setpoints, state) for setpoints, _ in ways}
        best = answers[0] if answers else min(outputs, key=lambda way: abs(outputs[way][-1] - wanted))
        reach = Reach.of(bool(answers), wanted - float(outputs[best][-1]))
        last = operator.advance(state, best)
        return Inversion(best, tuple(outputs[best].tolist()), reach, _PIECES * len(ways), last)

    def _search(
        self, state: S, here: float, start: float, end: float, target: float
    ) -> tuple[tuple[float, ...], bool]:
        """Return the first input towards `end` that meets the target, or the closest one, and whether it does."""
        grid = np.linspace(start, end, _PIECES + 1)
        outputs = np.append(here, self.operator.evaluate(grid[1:], state))
        sign = 1.0 if target > here else -1.0
        tolerance = _ROUNDING * float(np.abs(outputs).max())
        past = sign * (outputs - target) >= -tolerance
        if not past.any():
            return (float(grid[np.argmin(np.abs(outputs - target))]),), False
        k = int(np.argmax(past))
        if not k:
            return (start,), True

        def met(x: float) -> bool:
            return sign * (self.operator.step(state, x)[1] - target) >= -tolerance

        return (first_where(met, float(grid[k - 1]), float(grid[k])),), True

    def nearest_input(
        self, state: S, present: float, target: float, bounds: tuple[float, float] | None = None
    ) -> float:
        """Return the input nearest to the present one that meets a target; see `Inverse.nearest_input`."""
        low, high = around(present, bounds or self.operator.input_range)
        ends = self.operator.step(state, low)[1], self.operator.step(state, high)[1]
        least, greatest = min(ends), max(ends)
        tolerance = _ROUNDING * max(abs(least), abs(greatest))
        wanted = min(max(target, least), greatest)
        here = self.operator.step(state, present)[1]
        if abs(wanted - here) <= tolerance:
            return present
        sign = 1.0 if wanted > here else -1.0
        end = high if (sign > 0.0) == (ends[0] <= ends[1]) else low
        return first_where(lambda x: sign * (self.operator.step(state, x)[1] - wanted) >= -tolerance, present, end)


class TableInverse(NumericalInverse[None]):
    """The single-valued inverse of an operator without memory: a look-up table.

    The operator need not be monotone. The table is its running maximum from the lowest point of the range up to the
    highest one (running minimum, if the lowest comes after the highest), which has one input for each output.
    Targets beyond are given the input of the lowest or highest point.

    Parameters
    ----------
    operator : Operator
        The model, without memory.
    limits : tuple of float or None
        Least and greatest input of the table; default the operating range.
    points : int
        Number of points of the table.
    """

    def __init__(
        self, operator: Operator[None], limits: tuple[float, float] | None = None, points: int = 4001
    ) -> None:
        if points < 2:
            raise ValueError(f"points: expected at least 2, got {points}")
        super().__init__(operator)
        inputs = np.linspace(*(limits or operator.input_range), points)
        outputs = operator.evaluate(inputs)
        lowest, highest = int(outputs.argmin()), int(outputs.argmax())
        step = 1 if lowest <= highest else -1
        rising = slice(lowest, highest + step if highest + step >= 0 else None, step)
        envelope = np.maximum.accumulate(outputs[rising])
        # Of a level stretch only the first input: one input for each output.
        rows = np.flatnonzero(np.concatenate([[True], np.diff(envelope) > 0.0]))
        self.__dict__.update(_outputs=envelope[rows], _inputs=inputs[rising][rows], _rows=rows)

    _outputs: Floats
    _inputs: Floats
    _rows: NDArray[np.int64]

    def look_up(self, target: float) -> tuple[float, Reach]:
        """Return the input of a target in output units, within the table, and whether the table holds it."""
        reach = Reach.of(self._outputs[0] <= target <= self._outputs[-1], target - self._outputs[0])
        after = int(np.searchsorted(self._outputs, target))
        if 0 < after < self._rows.size and self._rows[after] > self._rows[after - 1] + 1:
            # Between the ends of a level stretch there is nothing to interpolate.
            return self._inputs[after].item(), reach
        return float(np.interp(target, self._outputs, self._inputs)), reach

    def invert(self, state: None, target: float) -> Inversion[None]:
        """Return the input of a target by the table; see `Inverse.invert`."""
        setpoint, reach = self.look_up(_checks.number("target", target))
        return Inversion((setpoint,), (self.operator.step(state, setpoint)[1],), reach, 1, None)


class PlayInverse(NumericalInverse["PlayState"]):
    """The exact inverse of a Prandtl-Ishlinskii operator without plateaus: itself such an operator."""

    operator: PrandtlIshlinskii

    @cached_property
    def _inverse(self) -> PrandtlIshlinskii:
        return self.operator.inverse_operator()

    def invert(self, state: PlayState, target: float) -> Inversion[PlayState]:
        """Return the set-point that brings the output to `target`; see `Inverse.invert`."""
        found = self.follow([target], state)
        reach = Reach.of(found.met[0], target - found.outputs[0])
        return Inversion((float(found.setpoints[0]),), (float(found.outputs[0]),), reach, 1, found.state)

    def stream(self, state: PlayState | None = None) -> PlayInverseStream:
        """Return the inverse with a memory of its own, compiled; see `Inverse.stream`."""
        from bench.models.streams.inverse_stream import PlayInverseStream

        return PlayInverseStream(self, self.operator.initial_state() if state is None else state)

    def _backward(self, state: PlayState) -> Stream[PlayState]:
        """Return the stream of the inverse operator that belongs to a state of the operator."""
        return self._inverse.stream(self.operator.inverse_state(state))

    def follow(self, targets: ArrayLike, state: PlayState | None = None) -> Following[PlayState]:
        """Return the set-points that bring the output to one target after another; see `Inverse.follow`."""
        wanted = _checks.samples("targets", targets)
        before = self.operator.initial_state() if state is None else state
        low, high = self.operator.output_range()
        setpoints = self._inverse.evaluate(np.clip(wanted, low, high), self.operator.inverse_state(before))
        return Following(
            setpoints=setpoints,
            saturating=np.full(wanted.size, np.nan),
            outputs=self.operator.evaluate(setpoints, before),
            met=(low <= wanted) & (wanted <= high),
            iterations=np.ones(wanted.size, dtype=np.int64),
            state=self.operator.advance(before, setpoints),
        )

    def nearest_input(
        self, state: PlayState, present: float, target: float, bounds: tuple[float, float] | None = None
    ) -> float:
        """Return the input nearest to the present one that meets a target; see `Inverse.nearest_input`."""
        low, high = around(present, bounds or self.operator.input_range)
        sign = 1.0 if self.operator.rises() else -1.0
        if sign * target >= sign * self.operator.step(state, high)[1]:
            return high
        if sign * target <= sign * self.operator.step(state, low)[1]:
            return low
        found = self._inverse.step(self.operator.inverse_state(state), target)[1]
        return min(max(found, low), high)


@dataclass(frozen=True, eq=False)
class PreisachInverse(Inverse[MemoryCurve]):
    """The exact inverse of a Preisach operator, non-monotonic ones included.

    From the present memory the output is followed upwards and downwards, segment by segment (Zhang et al. 2013, eq.
    19), to the first input that meets the target. Cells that cannot bring the output there are passed over (`gains`);
    of a monotone operator the segment is found by bisection. If neither way meets the target, the two major branches
    are tried through saturation. On a plateau the answer is the point nearest to the present input, which is the
    present input itself if its output is the target already. Beyond the plane and up to the operating
    range the walk goes on with the reversible part alone. A target counts as met within 2e-13
    of the output scale, which is the sum of |density| * area plus |bias|, or an output at saturation if that
    is greater.

    Parameters
    ----------
    operator : Preisach
        The model to invert.
    policy : {"nearest", "paper"}
        Which answer to take if both directions have one: the one nearest to the present input; or, by the
        rule of the paper, upwards for a target above the present output up to that at positive saturation,
        downwards for one below it down to that at negative saturation, and otherwise the nearest.
    """

    operator: Preisach

    @cached_property
    def tolerance(self) -> float:
        """Difference from a target that counts as none, output units."""
        operator = self.operator
        magnitude = float(np.abs(operator.density) @ operator.cell_areas()) + abs(operator.bias)
        return _TOLERANCE * max(magnitude, float(np.abs(self.branches[:, 1, 0]).max()))

    @cached_property
    def branches(self) -> Floats:
        """The major branches, downwards from positive saturation and upwards from negative, shape (2, 4, N).

        By rows: the inputs at the ends of the segments, from the end of the plane (repeated to fill the row) to that
        of the operating range; the outputs there; the least and the greatest output up to there.
        """
        operator = self.operator
        (low, high), (lowest, highest) = operator.input_range, operator.plane
        ends = np.unique(np.clip([*operator.levels, *operator.lattice.breaks, low, high], low, high))
        states = operator.saturated_state(1, highest), operator.saturated_state(-1, lowest)
        found = np.empty((2, 4, ends.size))
        for rows, inputs, state in zip(
            found, (np.minimum(ends, highest)[::-1], np.maximum(ends, lowest)), states, strict=True
        ):
            middles = np.column_stack([0.5 * (inputs[:-1] + inputs[1:]), inputs[1:]]).ravel()
            outputs = operator.evaluate(np.append(inputs[0], middles), state)
            before, middle, after = outputs[:-1:2], outputs[1::2], outputs[2::2]
            # The vertex of the quadratic through three outputs, if it is between them.
            slope, bend = 0.5 * (after - before), 0.5 * (before + after) - middle
            between = np.abs(slope) < 2.0 * np.abs(bend)
            vertex = np.where(between, middle - 0.25 * slope**2 / np.where(between, bend, 1.0), after)
            rows[:2] = inputs, outputs[::2]
            rows[2] = np.minimum.accumulate(np.append(outputs[0], np.minimum(after, vertex)))
            rows[3] = np.maximum.accumulate(np.append(outputs[0], np.maximum(after, vertex)))
        return found

    @cached_property
    def gains(self) -> Floats:
        """Bounds on what a move through a cell adds to the output, whatever the memory, shape (2, 2, M), >= 0.

        The first axis is the direction of the input, falling (0) or rising (1), the second that of the output. In
        output units.
        """
        lattice, order = self.operator.lattice, self.operator.order
        steps, density = np.diff(lattice.levels), lattice.table[:, :, 3]
        # Slopes beside the triangle at the diagonal: a fall takes away the part of the cell's column above the
        # triangle and below an edge; a rise adds the part of its row between an edge and the triangle.
        columns = np.concatenate([lattice.table[1:, :, 2], lattice.table[-1:, :, 2] + density[-1:] * steps[-1]])
        rows, within = lattice.table[:, :, 1], np.tri(order) > 0.0
        parts = (
            np.where(within, np.diag(columns) - columns, 0.0).T,
            np.where(within, np.diag(rows)[:, None] - rows, 0.0),
        )
        slopes = self.operator.reversible_slopes(lattice.levels)
        found = np.empty((2, 2, order))
        for way, up in np.ndindex(2, 2):
            sign, direction = 2 * up - 1, 2 * way - 1
            beside = (sign * parts[way]).max(axis=1) + np.maximum(sign * direction * np.diag(density) * steps, 0.0)
            found[way, up] = 2.0 * beside + (sign * direction * slopes).max(axis=0)
        return np.maximum(found, 0.0) * steps

    @cached_property
    def _constants(self) -> tuple[_Operator, _Shape, _Ends]:
        t = self.operator.lattice
        ends = (*self.operator.input_range, self.tolerance, self.operator.rises(), self.policy == "nearest")
        return (t.plane, t.below, t.offset, t.terms), (self.gains, self.branches), ends

    def invert(self, state: MemoryCurve, target: float) -> Inversion[MemoryCurve]:
        """Return the set-points that bring the output from `state` to `target`; see `Inverse.invert`."""
        from bench.models.kernels import inverse_kernels as _kernels

        if not math.isfinite(target):
            raise ValueError(f"target: expected a finite number, got {target}")
        start = self.operator._pieces(state)
        count, first, last, error, iterations = _kernels.invert_state(
            *self._constants, start, state.input, float(target)
        )
        reach = Reach.of(abs(error) <= 2.0 * self.tolerance, -error)
        if count == 1:
            return Inversion((last,), (target + error,), reach, iterations, state.step(last))
        turned = float(self.branches[0 if first > last else 1, 1, 0])
        final = state.step(first).step(last)
        return Inversion((first, last), (turned, target + error), reach, iterations, final)

    def first_input(self, state: MemoryCurve, target: float, direction: Literal[-1, 1]) -> float | None:
        """Return the first input in one direction at which the output has come to a target; None if there is none.

        Upwards the target is met by any output not below it, downwards by any not above it: perhaps by the present
        one. Raises ValueError if the target is not finite.
        """
        from bench.models.kernels import inverse_kernels as _kernels

        wanted = _checks.number("target", target)
        start = self.operator._pieces(state)
        found, error = _kernels.walk_state(*self._constants, start, state.input, wanted, direction)
        return found if abs(error) <= 2.0 * self.tolerance else None

    def stream(self, state: MemoryCurve | None = None) -> PreisachInverseStream:
        """Return the inverse with a memory of its own, compiled; see `Inverse.stream`."""
        from bench.models.streams.inverse_stream import PreisachInverseStream

        return PreisachInverseStream(self, self.operator.initial_state() if state is None else state)

    def follow(self, targets: ArrayLike, state: MemoryCurve | None = None) -> Following[MemoryCurve]:
        """Return the set-points that bring the output to one target after another; see `Inverse.follow`."""
        from bench.models.kernels import inverse_kernels as _kernels

        wanted = _checks.samples("targets", targets)
        before = self.operator.initial_state() if state is None else state
        start = self.operator._pieces(before)
        count = len(before.extrema)
        room = 2 * wanted.size + max(start[0].size, count) + 2
        # One block, as the allocator gives back to the system several as large, whose pages it then maps each time.
        block = np.empty((6, room))
        extrema = block[5]
        extrema[:count] = before.extrema
        found, met = np.empty((3, wanted.size)), np.empty(wanted.size, dtype=np.bool_)
        iterations = np.empty(wanted.size, dtype=np.int64)
        count = _kernels.follow(
            *self._constants,
            start,
            before.input,
            wanted,
            (block[:3], block[3:5].view(np.int64), extrema),
            count,
            before.rising,
            found,
            met,
            iterations,
        )
        first, last, outputs = found
        return Following(
            setpoints=last,
            saturating=first,
            outputs=outputs,
            met=met,
            iterations=iterations,
            state=trusted_curve(tuple(extrema[:count].tolist()), float(last[-1]), before.saturation),
        )

    def nearest_input(
        self,
        state: MemoryCurve,
        present: float,
        target: float,
        bounds: tuple[float, float] | None = None,  # noqa: ARG002
    ) -> float:
        """Return the input nearest to the present one that meets a target; see `Inverse.nearest_input`."""
        low, high = self.operator.input_range
        least, greatest = self._range
        wanted = min(max(target, least), greatest)
        inside = min(max(present, low), high)
        found = self.invert(state.step(inside), wanted).setpoints[-1]
        # Outside of the operating range nothing moves until the input is back.
        return present if found == inside else found

    @cached_property
    def _range(self) -> tuple[float, float]:
        return self.operator.output_range()


def around(present: float, bounds: tuple[float, float]) -> tuple[float, float]:
    """Return the bounds, widened to hold the present input: staying must always be possible."""
    return min(bounds[0], present), max(bounds[1], present)


def first_where(met: Callable[[float], bool], start: float, end: float) -> float:
    """Return the number nearest to `start`, on the way to `end`, from which on something is met."""
    before, after = start, end
    while True:
        middle = 0.5 * (before + after)
        if middle in (before, after):
            return after
        if met(middle):
            after = middle
        else:
            before = middle
