"""Streams of inverses: from one target to the next, with a memory that moves along."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from bench.base import checks as _checks
from bench.models.memory import MemoryCurve
from bench.models.reach import Reach
from bench.models.streams.stream import PreisachStream, address_of, compiled_step

if TYPE_CHECKING:
    from bench.models.inverses.inverse import Inverse, PlayInverse, PreisachInverse
    from bench.models.operators.prandtl_ishlinskii import PlayState

S = TypeVar("S")


class InverseStream(Generic[S]):
    """An inverse and the present state of its operator, which `step` and `move` change; made by `Inverse.stream`.

    Parameters
    ----------
    inverse : Inverse
        The inverse.
    state : object
        State of the operator to begin with.
    """

    def __init__(self, inverse: Inverse[S], state: S) -> None:
        self.inverse = inverse
        self._forward = inverse.operator.stream(state)
        self._saturating = self._output = math.nan
        self._reach = Reach.MET

    def find(self, target: float) -> float:
        """Return the input that brings the output to a target (the last one where two are needed), without a move.

        `saturating`, `output` and `reach` then belong to this target. Raises ValueError if the target is not finite.
        """
        found = self.inverse.invert(self._forward.state, _checks.number("target", target))
        self._saturating = found.setpoints[0] if len(found.setpoints) > 1 else math.nan
        self._output, self._reach = found.outputs[-1], found.reach
        return found.setpoints[-1]

    def step(self, target: float) -> float:
        """Return what `find` does, and move there. Raises ValueError if the target is not finite."""
        setpoint = self.find(target)
        if self._saturating == self._saturating:
            self.move(self._saturating)
        self.move(setpoint)
        return setpoint

    def move(self, value: float) -> float:
        """Move the input monotonically to `value`, as a measured one, and return the operator's output.

        Raises ValueError, without a move, if `value` is not finite.
        """
        return self._forward.step(value)

    @property
    def saturating(self) -> float:
        """Input to pass before the one that was found last; nan if none is needed."""
        return self._saturating

    @property
    def output(self) -> float:
        """Output at the input that was found last, output units: the target, or what comes closest."""
        return self._output

    @property
    def reach(self) -> Reach:
        """Whether the last target can be met."""
        return self._reach

    @property
    def value(self) -> float:
        """Output of the operator at present, output units."""
        return self._forward.value

    @property
    def state(self) -> S:
        """Present state, as a value."""
        return self._forward.state

    def __reduce__(self) -> tuple[type[Any], tuple[Any, Any]]:
        # A copy has arrays of its own.
        return type(self), (self.inverse, self.state)


class PreisachInverseStream(InverseStream[MemoryCurve]):
    """The exact inverse of a Preisach operator on arrays; equal to `PreisachInverse.follow` to the last bit."""

    inverse: PreisachInverse
    _forward: PreisachStream

    def __init__(self, inverse: PreisachInverse, state: MemoryCurve) -> None:
        self.inverse = inverse
        self._forward = forward = PreisachStream(inverse.operator, state)
        self._find, self._follow = compiled_step("find"), compiled_step("follow")
        self._address, self._numbers, self._places = forward._address, forward._numbers, forward._kernels
        _, shape, (low, high, tolerance, rising, nearest) = inverse._constants
        places, words = self._places, forward._words
        self._numbers[places.LOW : places.TOLERANCE + 1] = low, high, tolerance
        self._numbers[places.FIRST : places.ERROR + 1] = math.nan
        words[places.RISING], words[places.NEAREST] = rising, nearest
        words[places.GAINS], words[places.BRANCHES] = map(address_of, shape)
        words[places.BRANCH_POINTS] = shape[1].shape[2]
        self._target = math.nan

    def find(self, target: float) -> float:
        """Return the input that brings the output to a target, without a move; see `InverseStream.find`."""
        setpoint = self._find(self._address, target)
        if setpoint != setpoint:
            _checks.number("target", target)
        self._target = target
        return setpoint

    def step(self, target: float) -> float:
        """Return what `find` does, and move there; see `InverseStream.step`."""
        setpoint = self._follow(self._address, target)
        if setpoint != setpoint:
            setpoint = self._forward._again(self._follow, "target", target)
        self._target = target
        return setpoint

    @property
    def saturating(self) -> float:
        """Input to pass before the one that was found last; nan if none is needed."""
        return self._numbers.item(self._places.FIRST)

    @property
    def output(self) -> float:
        """Output at the input that was found last, output units."""
        return self._target + self._numbers.item(self._places.ERROR)

    @property
    def reach(self) -> Reach:
        """Whether the last target can be met."""
        error = self._numbers.item(self._places.ERROR)
        return Reach.of(abs(error) <= 2.0 * self._numbers.item(self._places.TOLERANCE), -error)


class PlayInverseStream(InverseStream["PlayState"]):
    """The exact inverse of a Prandtl-Ishlinskii operator on arrays; equal to `PlayInverse.follow` to the last bit.

    It follows targets beside the operator itself. After a `move` it starts again from the operator's state.
    """

    inverse: PlayInverse

    def __init__(self, inverse: PlayInverse, state: PlayState) -> None:
        super().__init__(inverse, state)
        self._low, self._high = inverse.operator.output_range()
        self._backward = inverse._backward(state)
        self._moved = False

    def step(self, target: float) -> float:
        """Return what `find` does, and move there; see `InverseStream.step`."""
        _checks.number("target", target)
        if self._moved:
            self._backward, self._moved = self.inverse._backward(self._forward.state), False
        within = min(max(target, self._low), self._high)
        setpoint = self._backward.step(within)
        self._output, self._saturating = self._forward.step(setpoint), math.nan
        self._reach = Reach.of(within == target, target - within)
        return setpoint

    def move(self, value: float) -> float:
        """Move the input to `value` and return the operator's output; see `InverseStream.move`."""
        self._moved = True
        return self._forward.step(value)
