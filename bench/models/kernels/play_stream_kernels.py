"""Compiled step of a stream of plays between two maps, see `stream_kernels`. Imported on first use only."""

from __future__ import annotations

import math

import numpy as np
from numba import carray  # type: ignore[attr-defined]
from numpy.typing import NDArray

from bench.base import inlined, kernel
from bench.models.kernels import memory_kernels as memory
from bench.models.kernels.stream_kernels import pointer

Floats = NDArray[np.float64]
Words = NDArray[np.int64]

# Words: addresses of the arrays, the last two of the maps, then the numbers of plays and of the dead zones of either
# map. Derivation: the count is that of the names.
NUMBERS, PLAYS, THRESHOLDS, WEIGHTS, BEFORE, AFTER, COUNT, BEFORE_COUNT, AFTER_COUNT = range(9)
WORD_COUNT = 9
# Numbers: the present output, the bias and the origin. Derivation: the count is that of the names.
OUTPUT, BIAS, ORIGIN = range(3)
NUMBER_COUNT = 3


@inlined
def _array(words: Words, place: int, size: int) -> Floats:
    return carray(pointer(words[place]), size, np.float64)


@inlined
def _mapped(x: float, words: Words, place: int, count: int) -> float:
    """Return a map of dead zones at x, by its thresholds, intercepts and slopes; without one, of -1, x itself."""
    if count < 0:
        return x
    parts = _array(words, place, 3 * count + 2)
    k = 0
    while k < count and x > parts[k]:
        k += 1
    mapped: float = parts[count + k] + parts[2 * count + 1 + k] * x
    return mapped


@kernel
def step_plays(address: int, value: float) -> float:
    """Move to an input and return the output; nan, without a move, if the input is not finite."""
    if not math.isfinite(value):
        return math.nan
    words = carray(pointer(address), WORD_COUNT, np.int64)
    numbers, count = _array(words, NUMBERS, NUMBER_COUNT), words[COUNT]
    x = np.empty(1)
    x[0] = _mapped(value - numbers[ORIGIN], words, BEFORE, words[BEFORE_COUNT])
    thresholds, weights = _array(words, THRESHOLDS, count), _array(words, WEIGHTS, count)
    total = memory.weighted_plays(x, thresholds, weights, _array(words, PLAYS, count))[0]
    output: float = numbers[BIAS] + _mapped(total, words, AFTER, words[AFTER_COUNT])
    numbers[OUTPUT] = output
    return output
