"""Streams: operators with a memory of their own, for one sample at a time.

An operator is a value, and its state another: each step makes a new one, which costs microseconds and grows with the
memory. A stream changes its memory in place instead, in a fraction of a microsecond, and gives the state as a value
where it is asked for, as for a record.
"""

from __future__ import annotations

import math
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import numpy as np

from bench.models.memory import MemoryCurve, trusted_curve

if TYPE_CHECKING:
    from bench.models.kernels.stream_kernels import Step
    from bench.models.operator import Operator
    from bench.models.operators.prandtl_ishlinskii import PlayState, PrandtlIshlinskii
    from bench.models.operators.preisach import Preisach

S = TypeVar("S")

_FIRST_ROOM = 64
"""Extrema that a stream has room for at first; the room grows. Derivation: those of an oscillation of 32 cycles."""


class Stream(Generic[S]):
    """An operator and its present state, which `step` changes; made by `Operator.stream`.

    Parameters
    ----------
    operator : Operator
        The operator.
    state : object
        State to begin with.
    """

    operator: Operator[S]

    def __init__(self, operator: Operator[S], state: S) -> None:
        self.operator = operator
        self._state = state
        self._output = math.nan if operator.memoryless else operator.value(state)

    def step(self, value: float) -> float:
        """Move the input monotonically to `value` and return the output, output units.

        Raises ValueError, without a move, if `value` is not finite.
        """
        self._state, self._output = self.operator.step(self._state, value)
        return self._output

    @property
    def value(self) -> float:
        """Present output, output units; nan before the first step of an operator without memory."""
        return self._output

    @property
    def state(self) -> S:
        """Present state, as a value."""
        return self._state

    def __reduce__(self) -> tuple[type[Any], tuple[Any, Any]]:
        # A copy has arrays of its own.
        return type(self), (self.operator, self.state)


class PreisachStream(Stream[MemoryCurve]):
    """A Preisach operator and its memory on arrays; equal to `Preisach.evaluate` to the last bit."""

    operator: Preisach

    def __init__(self, operator: Preisach, state: MemoryCurve) -> None:
        from bench.models.kernels import stream_kernels as kernels

        self.operator = operator
        self._kernels = kernels
        self._step = compiled_step("step")
        lattice = operator.lattice
        self._words = words = np.zeros(kernels.WORD_COUNT, dtype=np.int64)
        self._numbers = numbers = np.zeros(kernels.NUMBER_COUNT)
        # Kept for their addresses.
        self._tables = {
            kernels.NUMBERS: numbers,
            kernels.LEVELS: lattice.levels,
            kernels.TABLE: lattice.table,
            kernels.BELOW: lattice.below,
            kernels.BREAKS: lattice.breaks,
            kernels.QUADRATICS: lattice.quadratics,
        }
        for place, table in self._tables.items():
            words[place] = address_of(table)
        words[kernels.LEVEL_COUNT] = lattice.levels.size
        words[kernels.BREAK_COUNT] = lattice.breaks.size
        words[kernels.SATURATION] = state.saturation
        numbers[kernels.INVERSE_STEP] = lattice.inverse_step
        numbers[kernels.OFFSET] = lattice.offset
        self._address = address_of(words)
        extrema = np.array(state.extrema, dtype=np.float64)
        left, height, _ = state.staircase(*operator.plane)
        self._make_room(max(_FIRST_ROOM, 2 * max(extrema.size, len(left))))
        self._extrema[: extrema.size] = extrema
        self._pieces[0, : len(left)] = left
        self._pieces[1, : len(left)] = height
        words[kernels.EXTREMUM_COUNT], words[kernels.PIECE_COUNT] = extrema.size, len(left)
        compiled_step("begin")(self._address, state.input)

    def _make_room(self, room: int) -> None:
        self._extrema = np.zeros(room)
        self._pieces = np.zeros((3, room))
        self._indices = np.zeros((2, room), dtype=np.int64)
        kernels, words = self._kernels, self._words
        for place, array in (
            (kernels.EXTREMA, self._extrema),
            (kernels.PIECES, self._pieces),
            (kernels.INDICES, self._indices),
        ):
            words[place] = address_of(array)
        words[kernels.ROOM] = room

    def _double_room(self) -> None:
        """Double the room if a step might lack it."""
        kernels, words = self._kernels, self._words
        if max(words[kernels.EXTREMUM_COUNT], words[kernels.PIECE_COUNT]) + 2 < words[kernels.ROOM]:
            return
        extrema, pieces, indices = self._extrema, self._pieces, self._indices
        room = extrema.size
        self._make_room(2 * room)
        self._extrema[:room] = extrema
        self._pieces[:, :room] = pieces
        self._indices[:, :room] = indices

    def step(self, value: float) -> float:
        """Move the input monotonically to `value` and return the output; see `Stream.step`."""
        output = self._step(self._address, value)
        return output if output == output else self._again(self._step, "value", value)

    def _again(self, step: Step, name: str, value: float) -> float:
        """Repeat a step that gave nan with room enough, or say what is wrong with its argument."""
        if not math.isfinite(value):
            raise ValueError(f"{name}: expected a finite number, got {value}")
        self._double_room()
        return step(self._address, value)

    @property
    def value(self) -> float:
        """Present output, output units."""
        return self._numbers.item(self._kernels.OUTPUT)

    @property
    def state(self) -> MemoryCurve:
        """Present memory, as a value."""
        kernels = self._kernels
        saturation: Literal[-1, 1] = -1 if self._words[kernels.SATURATION] < 0 else 1
        extrema = self._extrema[: self._words[kernels.EXTREMUM_COUNT]]
        return trusted_curve(tuple(extrema.tolist()), self._numbers.item(kernels.INPUT), saturation)


class PlayStream(Stream["PlayState"]):
    """A Prandtl-Ishlinskii operator and its plays on arrays; equal to its `evaluate` to the last bit."""

    operator: PrandtlIshlinskii

    def __init__(self, operator: PrandtlIshlinskii, state: PlayState) -> None:
        self.operator = operator
        self._step = compiled_step("step_plays", "play_stream_kernels")
        maps = operator.before, operator.after
        lines = [np.empty(0) if zones is None else np.concatenate(zones.lines) for zones in maps]
        self._numbers = np.array([operator.value(state), operator.bias, operator.origin])
        self._plays = np.array(state)
        # Kept for their addresses.
        self._arrays = self._numbers, self._plays, operator.thresholds, operator.weights, *lines
        sizes = [self._plays.size, *(-1 if zones is None else zones.thresholds.size for zones in maps)]
        self._words = np.array([*map(address_of, self._arrays), *sizes], dtype=np.int64)
        self._address = address_of(self._words)

    def step(self, value: float) -> float:
        """Move the input monotonically to `value` and return the output; see `Stream.step`."""
        output = self._step(self._address, value)
        if output != output and not math.isfinite(value):
            raise ValueError(f"value: expected a finite number, got {value}")
        return output

    @property
    def value(self) -> float:
        """Present output, output units."""
        return float(self._numbers[0])

    @property
    def state(self) -> PlayState:
        """Present play states, as a value."""
        return tuple(self._plays.tolist())


@cache
def compiled_step(name: str, module: str = "stream_kernels") -> Step:
    """Return a compiled step of a module of kernels as a plain function of address and number."""
    step: Step = getattr(import_module(f"bench.models.kernels.{module}"), name).prepare()
    return step


def address_of(array: np.ndarray[Any, Any]) -> int:
    """Return where the numbers of a contiguous array lie."""
    if not array.flags.c_contiguous:
        raise ValueError("array: expected a contiguous one")
    return array.ctypes.data
