"""Compiled step of a stream of plays between two maps, see `element_stream_kernels`. Imported on first use only."""

from __future__ import annotations

import math

from bench.base import inlined, kernel
from bench.models.kernels import element_stream_kernels as elements, memory_kernels as memory


@inlined
def _mapped(x: float, words: elements.Words, place: int, count: int) -> float:
    """Return a map of dead zones at x, by its thresholds, intercepts and slopes; without one, of -1, x itself."""
    if count < 0:
        return x
    parts = elements.array(words, place, 3 * count + 2)
    k = 0
    while k < count and x > parts[k]:
        k += 1
    mapped: float = parts[count + k] + parts[2 * count + 1 + k] * x
    return mapped


@kernel
def step_plays(address: int, value: float) -> float:
    """Step plays between two maps; thresholds, weights and lines of the maps; the origin, and sizes of the maps."""
    if not math.isfinite(value):
        return math.nan
    words, numbers, states = elements.opened(address)
    x = elements.one(_mapped(value - numbers[elements.OWN], words, elements.THIRD, int(numbers[elements.OWN + 1])))
    thresholds = elements.array(words, elements.FIRST, states.size)
    weights = elements.array(words, elements.SECOND, states.size)
    total = memory.weighted_plays(x, thresholds, weights, states)[0]
    return elements.moved(numbers, value, _mapped(total, words, elements.FOURTH, int(numbers[elements.OWN + 2])))
