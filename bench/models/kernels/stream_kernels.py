"""Compiled steps of the streams, one sample a call. Imported on first use only.

Arrays as arguments cost a call from Python more time than the step itself takes. Hence a stream passes one number:
the address of its words, which hold its counters and the addresses of its arrays. The stream keeps all of these
alive, and replaces no array without its address.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from bench.base import inlined, kernel
from bench.models.kernels import inverse_kernels as inverse, memory_kernels as memory

Floats = NDArray[np.float64]
Words = NDArray[np.int64]

# Words of a stream of a Preisach operator: addresses of its arrays, their sizes, and its counters.
# Derivation: the count is that of the names.
NUMBERS, LEVELS, TABLE, BELOW, BREAKS, QUADRATICS, EXTREMA, PIECES, INDICES = range(9)
LEVEL_COUNT, BREAK_COUNT, ROOM, EXTREMUM_COUNT, PIECE_COUNT, CELL, SATURATION = range(9, 16)
RISING, NEAREST, WALKED, GAINS, BRANCHES, BRANCH_POINTS = range(16, 22)
WORD_COUNT = 22
# Its numbers. The input as it is and within the plane, the mass up to it, and the output; then of the inverse, see
# `_inverse_kernels.Ends`, and what it found: set-points (the first is nan where one is enough) and error.
# Derivation: the count is that of the names.
INVERSE_STEP, OFFSET, INPUT, PRESENT, MASS, OUTPUT = range(6)
LOW, HIGH, TOLERANCE, FIRST, LAST, ERROR = range(6, 12)
NUMBER_COUNT = 12

Step = Callable[[int, float], float]


def _pointer_type(typing_context: Any, address: Any) -> Any:  # noqa: ANN401, ARG001
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401, ARG001
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), build


pointer: Any = intrinsic(_pointer_type)


@inlined
def _words(address: int) -> Words:
    return carray(pointer(address), WORD_COUNT, np.int64)


@inlined
def _numbers(words: Words) -> Floats:
    return carray(pointer(words[NUMBERS]), NUMBER_COUNT, np.float64)


@inlined
def _plane(words: Words, numbers: Floats) -> memory.Plane:
    size = words[LEVEL_COUNT]
    levels = carray(pointer(words[LEVELS]), size, np.float64)
    return levels, numbers[INVERSE_STEP], carray(pointer(words[TABLE]), (size - 1, size - 1, 4), np.float64)


@inlined
def _terms(words: Words) -> memory.Terms:
    size = words[BREAK_COUNT]
    breaks = carray(pointer(words[BREAKS]), size, np.float64)
    return breaks, carray(pointer(words[QUADRATICS]), (size + 1, 3), np.float64)


@inlined
def _pieces(words: Words) -> memory.Pieces:
    room = words[ROOM]
    stack = carray(pointer(words[PIECES]), (3, room), np.float64)
    indices = carray(pointer(words[INDICES]), (2, room), np.int64)
    return stack[0], stack[1], stack[2], indices[0], indices[1]


@inlined
def _below(words: Words) -> Floats:
    return carray(pointer(words[BELOW]), words[LEVEL_COUNT], np.float64)


@inlined
def _output(words: Words, numbers: Floats, plane: memory.Plane) -> float:
    return memory.output_at(
        plane,
        _below(words),
        numbers[OFFSET],
        _terms(words),
        numbers[INPUT],
        numbers[PRESENT],
        words[CELL],
        numbers[MASS],
    )


@kernel
def begin(address: int, value: float) -> float:
    """Fill in what belongs to given pieces at the input `value`; return the output."""
    words = _words(address)
    numbers = _numbers(words)
    plane = _plane(words, numbers)
    numbers[INPUT] = value
    present = min(max(value, plane[0][0]), plane[0][-1])
    numbers[PRESENT] = present
    words[CELL], numbers[MASS] = memory.load(plane, _pieces(words), words[PIECE_COUNT], present)
    output = _output(words, numbers, plane)
    numbers[OUTPUT] = output
    return output


@inlined
def _move(words: Words, numbers: Floats, plane: memory.Plane, value: float) -> float:
    """Move to an input; there is room for one more extremum and piece."""
    present = numbers[INPUT]
    if value == present:
        return float(numbers[OUTPUT])
    extrema = carray(pointer(words[EXTREMA]), words[ROOM], np.float64)
    count = words[EXTREMUM_COUNT]
    rising = (words[SATURATION] < 0) == (count % 2 == 0)
    words[EXTREMUM_COUNT], _ = memory.step_extrema(extrema, count, rising, present, value)
    numbers[INPUT] = value
    u = min(max(value, plane[0][0]), plane[0][-1])
    words[PIECE_COUNT], words[CELL], numbers[MASS] = memory.move(
        plane, _pieces(words), words[PIECE_COUNT], numbers[PRESENT], words[CELL], numbers[MASS], u
    )
    numbers[PRESENT] = u
    output = _output(words, numbers, plane)
    numbers[OUTPUT] = output
    return output


@inlined
def _has_room(words: Words) -> bool:
    """Return whether two moves have room, as an inversion may take."""
    used: int = max(words[EXTREMUM_COUNT], words[PIECE_COUNT])
    room: int = words[ROOM]
    return used + 2 < room


@kernel
def step(address: int, value: float) -> float:
    """Move to an input and return the output; nan, without a move, if there is no room or the input is not finite."""
    words = _words(address)
    if not math.isfinite(value) or not _has_room(words):
        return math.nan
    numbers = _numbers(words)
    return _move(words, numbers, _plane(words, numbers), value)


@inlined
def _find(words: Words, numbers: Floats, plane: memory.Plane, target: float) -> tuple[int, float, float]:
    operator = plane, _below(words), numbers[OFFSET], _terms(words)
    gains = carray(pointer(words[GAINS]), (2, 2, words[LEVEL_COUNT] - 1), np.float64)
    branches = carray(pointer(words[BRANCHES]), (2, 4, words[BRANCH_POINTS]), np.float64)
    ends = numbers[LOW], numbers[HIGH], numbers[TOLERANCE], words[RISING] != 0, words[NEAREST] != 0
    pieces = _pieces(words)
    curve = pieces[0], pieces[1], pieces[2], words[PIECE_COUNT], numbers[MASS], numbers[PRESENT]
    count, first, last, error, walked = inverse.invert(
        operator, (gains, branches), ends, curve, numbers[INPUT], numbers[OUTPUT], target
    )
    numbers[FIRST] = first if count == 2 else math.nan
    numbers[LAST] = last
    numbers[ERROR] = error
    words[WALKED] = walked
    return count, first, last


@kernel
def find(address: int, target: float) -> float:
    """Return the last set-point that meets the target, and keep the rest of the answer; nan if it is not finite."""
    if not math.isfinite(target):
        return math.nan
    words = _words(address)
    numbers = _numbers(words)
    return _find(words, numbers, _plane(words, numbers), target)[2]


@kernel
def follow(address: int, target: float) -> float:
    """Find and move there; nan, without a move, if there is no room or the target is not finite."""
    words = _words(address)
    if not math.isfinite(target) or not _has_room(words):
        return math.nan
    numbers = _numbers(words)
    plane = _plane(words, numbers)
    count, first, last = _find(words, numbers, plane, target)
    if count == 2:
        _move(words, numbers, plane, first)
    _move(words, numbers, plane, last)
    return last
