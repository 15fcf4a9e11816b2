"""Compiled steps of streams of elements, one sample a call, see `_stream_kernels`. Imported on first use only."""

from __future__ import annotations

import math

import numpy as np
from numba import carray  # type: ignore[attr-defined]
from numpy.typing import NDArray

from bench.base import inlined, kernel
from bench.models.kernels import element_kernels as sequences, memory_kernels as memory
from bench.models.kernels.stream_kernels import pointer

Floats = NDArray[np.float64]
Words = NDArray[np.int64]

# Words: addresses of the arrays, the last four of the operator's own, and the number of elements.
# Derivation: the count is that of the names.
NUMBERS, ELEMENTS, WEIGHTS, FIRST, SECOND, THIRD, FOURTH, COUNT = range(8)
WORD_COUNT = 8
# Numbers: the present input, the output there, the bias, and those of the operator.
# Derivation: the count is that of the names, and eleven of the largest operator.
PRESENT, OUTPUT, BIAS, OWN = range(4)
NUMBER_COUNT = 14


@inlined
def opened(address: int) -> tuple[Words, Floats, Floats]:
    """Return words, numbers and elements."""
    words = carray(pointer(address), WORD_COUNT, np.int64)
    numbers = carray(pointer(words[NUMBERS]), NUMBER_COUNT, np.float64)
    return words, numbers, carray(pointer(words[ELEMENTS]), words[COUNT], np.float64)


@inlined
def array(words: Words, place: int, size: int) -> Floats:
    """Return an array by its word."""
    return carray(pointer(words[place]), size, np.float64)


@inlined
def one(value: float) -> Floats:
    """Return a sequence of one value."""
    sequence = np.empty(1)
    sequence[0] = value
    return sequence


@inlined
def _sum(words: Words, row: Floats) -> float:
    weights = array(words, WEIGHTS, row.size)
    total = 0.0
    for i in range(row.size):
        total += row[i] * weights[i]
    return total


@inlined
def moved(numbers: Floats, value: float, total: float) -> float:
    """Keep the input and return the output, of which the bias is added to a sum."""
    output: float = numbers[BIAS] + total
    numbers[PRESENT] = value
    numbers[OUTPUT] = output
    return output


@inlined
def _within(numbers: Floats, value: float) -> float:
    """Return an input as a part of the operating range, whose ends are the first numbers of an operator."""
    low, high = numbers[OWN], numbers[OWN + 1]
    x: float = (2.0 * value - low - high) / (high - low)
    return x


@kernel
def stops(address: int, value: float) -> float:
    """Step stops beside a spring; their limits, and the origin of the spring."""
    if not math.isfinite(value):
        return math.nan
    words, numbers, elements = opened(address)
    count = elements.size
    row = sequences.stops(one(value), numbers[PRESENT], array(words, FIRST, count), elements)[0]
    spring = array(words, WEIGHTS, count + 1)[count] * (value - numbers[OWN])
    return moved(numbers, value, _sum(words, row) + spring)


@kernel
def ramps(address: int, value: float) -> float:
    """Step kernels between ramps; where these begin upwards and downwards, and their width."""
    if not math.isfinite(value):
        return math.nan
    words, numbers, elements = opened(address)
    rising, falling = array(words, FIRST, elements.size), array(words, SECOND, elements.size)
    row = sequences.ramps(one(value), rising, falling, numbers[OWN], elements)[0]
    return moved(numbers, value, _sum(words, row))


@inlined
def _envelope(numbers: Floats, place: int, x: float) -> float:
    steepness, offset, low, high = numbers[place], numbers[place + 1], numbers[place + 2], numbers[place + 3]
    drive: float = (2.0 * math.tanh(steepness * x - offset) - low - high) / (high - low)
    return drive


@kernel
def plays(address: int, value: float) -> float:
    """Step plays between envelopes; their thresholds, the range, and of each envelope its numbers and ends."""
    if not math.isfinite(value):
        return math.nan
    words, numbers, elements = opened(address)
    x = _within(numbers, value)
    lower, upper = one(_envelope(numbers, OWN + 2, x)), one(_envelope(numbers, OWN + 6, x))
    row = memory.plays(lower, upper, array(words, FIRST, elements.size), elements)[0]
    return moved(numbers, value, _sum(words, row))


@kernel
def duhem(address: int, value: float) -> float:
    """Step the terms of a Duhem operator; the range, and the rate."""
    if not math.isfinite(value):
        return math.nan
    words, numbers, elements = opened(address)
    x, present = one(_within(numbers, value)), _within(numbers, numbers[PRESENT])
    row = sequences.duhem(x, present, numbers[OWN + 2], elements.size // 2, elements)[0]
    return moved(numbers, value, _sum(words, row))


@kernel
def bouc_wen(address: int, value: float) -> float:
    """Step a Bouc-Wen operator; scale, beta, gamma, exponent and origin."""
    if not math.isfinite(value):
        return math.nan
    words, numbers, elements = opened(address)
    scale = numbers[OWN]
    z = sequences.bouc_wen(
        one(value / scale),
        numbers[PRESENT] / scale,
        elements[0] / scale,
        numbers[OWN + 1],
        numbers[OWN + 2],
        numbers[OWN + 3],
    )
    elements[0] = scale * z[0]
    weights = array(words, WEIGHTS, 2)
    total = weights[0] * (value - numbers[OWN + 4]) + weights[1] * elements[0]
    return moved(numbers, value, total)
