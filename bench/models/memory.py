"""The memory of a rate-independent hysteresis operator: the reversals that still matter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks

_MINUS_INFINITY = -math.inf
# Part of the range of inputs at its ends whose memory is as good as known.
# Derivation: of a plane of evenly many hysterons a corner of 1 % holds 1e-4, less than a reading shows.
_OUTERMOST = 0.01


@dataclass(frozen=True, slots=True)
class MemoryCurve:
    """The past of an input, reduced to the extrema that hysterons can still remember.

    The curve is a staircase a(β) in the plane of down-thresholds β and up-thresholds α: a hysteron is on
    if and only if β <= input and α <= a(β). Its corners are the alternating extrema of the input, outermost
    first; inner ones are wiped out when the input passes them (Zhang et al. 2013, section III-A). The curve
    belongs to the input alone: an operator clips it to its own plane. Driving an actuator to `saturation`,
    then through `extrema` in order, then to `input` restores the memory.

    Parameters
    ----------
    extrema : tuple of float
        Alternating extrema, outermost first, in input units. After negative saturation the first is a
        maximum, after positive saturation a minimum.
    input : float
        Present input.
    saturation : {-1, 1}
        The state before the first extremum: every hysteron off (-1) or on (+1).

    Raises
    ------
    ValueError
        If a number is not finite, or if the extrema and the input are not nested.
    """

    extrema: tuple[float, ...]
    input: float
    saturation: Literal[-1, 1] = -1

    def __post_init__(self) -> None:
        if self.saturation not in (-1, 1):
            raise ValueError(f"saturation: expected -1 or 1, got {self.saturation!r}")
        extrema = tuple(_checks.number("extrema", value) for value in self.extrema)
        present = _checks.number("input", self.input)
        object.__setattr__(self, "extrema", extrema)
        object.__setattr__(self, "input", present)
        low, high, rising = -math.inf, math.inf, self.saturation < 0
        for value in extrema:
            if not low < value < high:
                raise ValueError(
                    f"extrema: expected alternating values, each within the pair before it, got {extrema}"
                )
            low, high = (low, value) if rising else (value, high)
            rising = not rising
        # At the wiping-out value itself the pair would already be gone.
        if not (low <= present < high if rising else low < present <= high):
            raise ValueError(f"input: expected a value within the last extrema ({low}, {high}), got {present}")

    @classmethod
    def from_negative_saturation(cls, value: float) -> MemoryCurve:
        """Return the memory after raising the input from far below to `value` (the ascending branch)."""
        return cls((), value, -1)

    @classmethod
    def from_positive_saturation(cls, value: float) -> MemoryCurve:
        """Return the memory after lowering the input from far above to `value` (the descending branch)."""
        return cls((), value, 1)

    @property
    def rising(self) -> bool:
        """Whether the present branch was entered upwards."""
        return (self.saturation < 0) == (len(self.extrema) % 2 == 0)

    def step(self, value: float) -> MemoryCurve:
        """Return the memory after the input moved monotonically to `value`.

        The number of comparisons is O(1) amortised over a sequence: each extremum is added once and wiped out at most
        once. Raises ValueError if `value` is not finite.
        """
        present = self.input
        if value == present:
            return self
        if not math.isfinite(value):
            raise ValueError(f"value: expected a finite number, got {value}")
        extrema = self.extrema
        if (value > present) != self.rising:
            extrema = (*extrema, present)
        end = len(extrema)
        if value > present:
            while end >= 2 and extrema[end - 2] <= value:
                end -= 2
        else:
            while end >= 2 and extrema[end - 2] >= value:
                end -= 2
        return trusted_curve(extrema[:end] if end < len(extrema) else extrema, float(value), self.saturation)

    def advance(self, inputs: ArrayLike) -> MemoryCurve:
        """Return the memory after a whole sequence of inputs, shape (N,).

        Raises ValueError if `inputs` is empty, not one-dimensional or not finite.
        """
        from bench.models.kernels import memory_kernels as _kernels

        sequence = _checks.samples("inputs", inputs)
        stack = np.empty(len(self.extrema) + sequence.size + 2)
        stack[: len(self.extrema)] = self.extrema
        count = _kernels.advance_extrema(sequence, stack, len(self.extrema), self.input, self.rising)
        return trusted_curve(tuple(stack[:count].tolist()), float(sequence[-1]), self.saturation)

    def staircase(self, low: float, high: float) -> tuple[list[float], list[float], float]:
        """Return the curve clipped to the plane [low, high]: left edges, heights, clipped input.

        Piece p covers left[p] <= β < left[p + 1] (the last one ends at the input) with height a = height[p].
        Left edges increase, heights decrease; both lists are empty if every hysteron is off.
        """
        extrema, present = self.extrema, self.input
        clipped = min(max(present, low), high)
        if clipped <= low:
            return [], [], low
        if clipped >= high:
            return [low], [high], high
        if self.saturation < 0:
            maxima, minima = extrema[0::2], (_MINUS_INFINITY, *extrema[1::2])
        else:
            maxima, minima = (math.inf, *extrema[1::2]), (_MINUS_INFINITY, *extrema[0::2])
        if len(maxima) < len(minima):
            maxima = (*maxima, present)
        lefts: list[float] = []
        heights: list[float] = []
        for left, height in zip(minima, maxima, strict=False):
            edge = left if left > low else low
            top = height if height < high else high
            if lefts:
                if top >= heights[-1]:
                    continue
                if edge <= lefts[-1]:
                    heights[-1] = top
                    continue
            if edge < clipped:
                lefts.append(edge)
                heights.append(top)
        return lefts, heights, clipped

    def corners(self, low: float, high: float) -> Floats:
        """Return the staircase as a polyline for drawing, shape (n, 2).

        Vertices (β, α) lead from the left border (β = low) to the diagonal (β = α = input).

        Parameters
        ----------
        low, high : float
            The plane's range, input units, low < high.
        """
        lefts, heights, present = self.staircase(low, high)
        vertices: list[tuple[float, float]] = []
        for index, (left, height) in enumerate(zip(lefts, heights, strict=True)):
            right = lefts[index + 1] if index + 1 < len(lefts) else present
            vertices += [(left, height), (right, height)]
        vertices.append((present, present))
        # A rising branch ends on the diagonal anyway.
        distinct = [vertex for n, vertex in enumerate(vertices) if n == 0 or vertex != vertices[n - 1]]
        return np.array(distinct, dtype=np.float64)

    def to_json(self) -> dict[str, Any]:
        """Return the memory as a JSON object."""
        return {"saturation": int(self.saturation), "extrema": list(self.extrema), "input": self.input}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> MemoryCurve:
        """Return the memory that `to_json` wrote.

        Raises ValueError if a key is missing or the extrema are not nested.
        """
        return cls(
            tuple(_checks.json_field(document, "extrema", "memory curve")),
            _checks.json_field(document, "input", "memory curve"),
            _checks.json_field(document, "saturation", "memory curve"),
        )


def trusted_curve(extrema: tuple[float, ...], present: float, saturation: Literal[-1, 1]) -> MemoryCurve:
    """Return a curve known to be nested: stepping must not pay for the check."""
    curve = object.__new__(MemoryCurve)
    object.__setattr__(curve, "extrema", extrema)
    object.__setattr__(curve, "input", present)
    object.__setattr__(curve, "saturation", saturation)
    return curve


def overwritten_from(inputs: ArrayLike, plane: tuple[float, float] | None = None) -> int:
    """Return the first sample from which inputs, shape (N,), have overwritten all memory of a plane they ever do.

    What only the outermost hundredth of their range overwrites does not count: sampled turning points that are meant
    to be equal are not. Without a plane the memory has no ends.
    """
    sequence = _checks.samples("inputs", inputs)
    top, bottom = np.maximum.accumulate(sequence), np.minimum.accumulate(sequence)
    low, high = plane or (-np.inf, np.inf)
    margin = _OUTERMOST * (top[-1] - bottom[-1])
    # A relay is known once α <= top or β >= bottom: none that will be switched may be left.
    rising = (top >= min(top[-1] - margin, high)) | (bottom <= low)
    falling = (bottom <= max(bottom[-1] + margin, low)) | (top >= high)
    return int(np.argmax(rising & falling))
