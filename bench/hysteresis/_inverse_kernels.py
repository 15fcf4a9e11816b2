"""Compiled walks over the exact segments of a Preisach operator. Imported on first use only."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bench.hysteresis import _kernels as memory

Floats = NDArray[np.float64]

_segment_up = memory.segment_up
_segment_down = memory.segment_down
_rising_piece = memory.rising_piece
_move = memory.move
_output_at = memory.output_at
_load = memory.load
_evaluate = memory.evaluate
_borrowed = memory.borrowed
_reversible_value = memory.reversible_value


@njit(cache=True, forceinline=True)
def _first_root(a: float, b: float, r: float, length: float, tolerance: float) -> float:
    """Return the least d in [0, length] with A d² + B d = r, or -1.

    A maximum that touches r within the tolerance counts.
    """
    if abs(a) * length * length <= 1e-3 * tolerance:
        if b == 0.0:
            return -1.0
        d: float = r / b
        return d if 0.0 <= d <= length else -1.0
    square = b * b + 4.0 * a * r
    if square < 0.0:
        vertex: float = -0.5 * b / a
        if 0.0 <= vertex <= length and abs(0.5 * b * vertex - r) <= tolerance:
            return vertex
        return -1.0
    q = -0.5 * (b + np.copysign(np.sqrt(square), b))
    first: float = q / a
    second: float = -r / q if q != 0.0 else first
    if first > second:
        first, second = second, first
    if 0.0 <= first <= length:
        return first
    return second if 0.0 <= second <= length else -1.0


@njit(cache=True, forceinline=True)
def walk(
    levels: Floats,
    inverse_step: float,
    table: Floats,
    breaks: Floats,
    quadratics: Floats,
    end: float,
    left: Floats,
    height: Floats,
    n: int,
    u: float,
    value: float,
    target: float,
    tolerance: float,
    direction: int,
    reach: float,
) -> tuple[float, float, int]:
    """Walk from input u in one direction until the output meets the target.

    The pieces are only read: what a monotone move wipes out is passed over. Returns the input where the
    output met the target, or else came closest to it, the error there (output - target), and the number
    of segments. Gives up beyond the distance `reach`.
    """
    start = u
    best, error = u, value - target
    edge, border = u, 0.0
    if direction > 0:
        n, edge, border = _rising_piece(levels, left, height, n, u)
    steps = 0
    while abs(error) > tolerance and (u - start) * direction <= reach:
        if direction > 0:
            stop, a, b = _segment_up(levels, inverse_step, table, breaks, quadratics, end, edge, border, u)
            length = stop - u
        else:
            while n > 0 and left[n - 1] >= u:
                n -= 1
            edge, border = (left[n - 1], height[n - 1]) if n > 0 else (u, u)
            stop, a, b = _segment_down(levels, inverse_step, table, breaks, quadratics, end, edge, border, u)
            length = u - stop
        if length <= 0.0:
            break
        steps += 1
        d = _first_root(a, b, target - value, length, tolerance)
        if d >= 0.0:
            return u + direction * d, value + d * (b + a * d) - target, steps
        if a != 0.0:
            # The output may come closest inside the segment.
            vertex = -0.5 * b / a
            if 0.0 < vertex < length and abs(value + 0.5 * b * vertex - target) < abs(error):
                best, error = u + direction * vertex, value + 0.5 * b * vertex - target
        value += length * (b + a * length)
        u = stop
        if abs(value - target) < abs(error):
            best, error = u, value - target
        if direction > 0:
            while n > 0 and height[n - 1] <= u:
                n -= 1
                edge = left[n]
            border = height[n - 1] if n > 0 else np.inf
    return best, error, steps


@njit(cache=True, forceinline=True)
def invert(
    levels: Floats,
    inverse_step: float,
    table: Floats,
    breaks: Floats,
    quadratics: Floats,
    low: float,
    high: float,
    minus: float,
    plus: float,
    left: Floats,
    height: Floats,
    n: int,
    u: float,
    value: float,
    target: float,
    tolerance: float,
    nearest: bool,
    monotone: bool,
) -> tuple[int, float, float, float, int]:
    """Return number of set-points, the first, the last, the error at the last, and the segments walked.

    `minus` and `plus` are the outputs at negative and positive saturation, at the ends of the plane. Of a
    `monotone` operator the output rises with the input for every memory: one walk finds all solutions.
    """
    # A monotone operator finds the target this way; the other way then is walked no further than that.
    first = 1 if target > value else -1
    x1, e1, k1 = walk(
        levels,
        inverse_step,
        table,
        breaks,
        quadratics,
        high if first > 0 else low,
        left,
        height,
        n,
        u,
        value,
        target,
        tolerance,
        first,
        np.inf,
    )
    steps = k1
    met = abs(e1) <= tolerance
    preferred = not nearest and ((first > 0 and target <= plus) or (first < 0 and target >= minus))
    if monotone or (met and (x1 == u or preferred)):
        return 1, x1, x1, e1, steps
    x2, e2, k2 = walk(
        levels,
        inverse_step,
        table,
        breaks,
        quadratics,
        low if first > 0 else high,
        left,
        height,
        n,
        u,
        value,
        target,
        tolerance,
        -first,
        abs(x1 - u) if met else np.inf,
    )
    steps += k2
    met2 = abs(e2) <= tolerance
    if met and met2:
        if abs(x2 - u) < abs(x1 - u):
            return 1, x2, x2, e2, steps
        return 1, x1, x1, e1, steps
    if met:
        return 1, x1, x1, e1, steps
    if met2:
        return 1, x2, x2, e2, steps
    count, s1, s2, error = 1, x1, x1, e1
    if abs(e2) < abs(e1):
        s1, s2, error = x2, x2, e2
    # The two major branches, through saturation.
    travel = np.inf
    full = np.empty(1)
    full[0] = levels[0]
    crest = np.empty(1)
    crest[0] = levels[-1]
    for direction in (-1, 1):
        turn = levels[-1] if direction < 0 else levels[0]
        x, e, k = walk(
            levels,
            inverse_step,
            table,
            breaks,
            quadratics,
            low if direction < 0 else high,
            full,
            crest,
            1 if direction < 0 else 0,
            turn,
            plus if direction < 0 else minus,
            target,
            tolerance,
            direction,
            np.inf,
        )
        steps += k
        distance = abs(turn - u) + abs(x - turn)
        better = abs(e) < abs(error) - tolerance
        equal = count == 2 and abs(e) <= abs(error) + tolerance and distance < travel
        if better or equal:
            count, s1, s2, error, travel = 2, turn, x, e, distance
    return count, s1, s2, error, steps


@njit(cache=True)
def invert_state(
    levels: Floats,
    inverse_step: float,
    table: Floats,
    below: Floats,
    offset: float,
    breaks: Floats,
    quadratics: Floats,
    low: float,
    high: float,
    minus: float,
    plus: float,
    left: Floats,
    height: Floats,
    inside: float,
    u: float,
    target: float,
    tolerance: float,
    nearest: bool,
    monotone: bool,
) -> tuple[int, float, float, float, int]:
    """Return what `invert` does, from a state whose output is not known yet."""
    here = np.empty(1)
    here[0] = u
    value = _evaluate(here, levels, inverse_step, table, below, offset, breaks, quadratics, left, height, inside)[0]
    return invert(
        levels,
        inverse_step,
        table,
        breaks,
        quadratics,
        low,
        high,
        minus,
        plus,
        left,
        height,
        left.size,
        u,
        value,
        target,
        tolerance,
        nearest,
        monotone,
    )


@njit(cache=True)
def follow(
    levels: Floats,
    inverse_step: float,
    table: Floats,
    below: Floats,
    offset: float,
    breaks: Floats,
    quadratics: Floats,
    low: float,
    high: float,
    minus: float,
    plus: float,
    left0: Floats,
    height0: Floats,
    inside: float,
    raw: float,
    targets: Floats,
    tolerance: float,
    nearest: bool,
    monotone: bool,
    stack: Floats,
    indices: NDArray[np.int64],
    first: Floats,
    last: Floats,
    errors: Floats,
    steps: NDArray[np.int64],
) -> None:
    """Invert target after target, moving the memory along; `first` is NaN where one set-point is enough.

    `stack` and `indices` are room for the pieces, shapes (3, size) and (2, size).
    """
    levels, table, below = _borrowed(levels), _borrowed(table), _borrowed(below)
    breaks, quadratics = _borrowed(breaks), _borrowed(quadratics)
    left, height, mass_left = _borrowed(stack[0]), _borrowed(stack[1]), _borrowed(stack[2])
    column, row = _borrowed(indices[0]), _borrowed(indices[1])
    n = left0.size
    for p in range(n):
        left[p] = left0[p]
        height[p] = height0[p]
    k, mass = _load(levels, inverse_step, table, left, height, column, row, mass_left, n, inside)
    present = inside
    for t in range(targets.size):
        value = _output_at(levels, table, below, offset, breaks, quadratics, raw, present, k, mass)
        count, s1, s2, error, walked = invert(
            levels,
            inverse_step,
            table,
            breaks,
            quadratics,
            low,
            high,
            minus,
            plus,
            left,
            height,
            n,
            raw,
            value,
            targets[t],
            tolerance,
            nearest,
            monotone,
        )
        first[t] = s1 if count == 2 else np.nan
        last[t] = s2
        errors[t] = error
        steps[t] = walked
        for stage in range(2 - count, 2):
            raw = s1 if stage == 0 else s2
            u = min(max(raw, levels[0]), levels[-1])
            n, k, mass = _move(
                levels, inverse_step, table, left, height, column, row, mass_left, n, present, k, mass, u
            )
            present = u
