"""Compiled walks over the exact segments of a Preisach operator. Imported on first use only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import IntegerTable, Table, inlined, inner, kernel
from bench.models.kernels import memory_kernels as memory

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

Corners = tuple[Floats, Floats, int]  # left edges and heights of the pieces, and how many count
# Ends of the operating range, outputs at negative and positive saturation (at the ends of the plane), tolerance,
# steepest fall of the output with a rising input, whether the nearest answer is wanted.
Ends = tuple[float, float, float, float, float, float, bool]
Place = tuple[int, float, int, float]  # number of pieces, input within the plane, its cell, and the mass up to it

# More segments than there are. Derivation: a quarter of the range of int64, so that sums do not overflow.
_ALL = 2**62
# Segments that are walked before a leap, and levels that a target is away for one at once.
# Derivation: a leap is a search of some log₂ 200 segments; a smooth reference needs one or two steps.
_NEAR = 8
# Tries from which every other one halves the way.
# Derivation: halves alone find one of 200 levels in eight tries; six that were in vain cost less than that again.
_INTERPOLATED = 6


@inlined
def _first_root(a: float, b: float, r: float, length: float, tolerance: float) -> float:
    """Return the least d in [0, length] with A d² + B d = r, or -1; a maximum that touches r counts."""
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
    if b * r > 0.0:
        # The other root, if it is ahead too, lies beyond the vertex.
        nearer: float = -r / q
        return nearer if nearer <= length else -1.0
    first: float = q / a
    second: float = -r / q if q != 0.0 else first
    if first > second:
        first, second = second, first
    if 0.0 <= first <= length:
        return first
    return second if 0.0 <= second <= length else -1.0


@inlined
def walk(
    plane: memory.Plane,
    terms: memory.Terms,
    end: float,
    corners: Corners,
    u: float,
    value: float,
    target: float,
    tolerance: float,
    direction: int,
    reach: float,
    most: int,
    edge: float,
) -> tuple[float, float, int]:
    """Walk from input u in one direction until the output meets the target.

    The pieces are only read: what a monotone move wipes out is passed over. Upwards, `edge` is the left edge of what
    rises, and the pieces are those to the left of it. Returns the input where the output met the target, or else
    came closest to it, the error there (output - target), and the number of segments. Gives up beyond the distance
    `reach`, and after the number of segments `most`.
    """
    left, height, n = corners
    start = u
    best, error = u, value - target
    border = height[n - 1] if n > 0 else np.inf
    steps = 0
    while abs(error) > tolerance and steps < most and (u - start) * direction <= reach:
        if direction > 0:
            stop, a, b = memory.segment_up(plane, terms, end, edge, border, u)
            length = stop - u
        else:
            while n > 0 and left[n - 1] >= u:
                n -= 1
            edge, border = (left[n - 1], height[n - 1]) if n > 0 else (u, u)
            stop, a, b = memory.segment_down(plane, terms, end, edge, border, u)
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


@inlined
def _walk_on(
    plane: memory.Plane,
    terms: memory.Terms,
    end: float,
    corners: Corners,
    u: float,
    value: float,
    target: float,
    tolerance: float,
    direction: int,
    reach: float,
    most: int,
) -> tuple[float, float, int]:
    """Walk from a state; see `walk`."""
    left, height, n = corners
    edge = u
    if direction > 0:
        n, edge, _ = memory.rising_piece(plane[0], left, height, n, u)
    return walk(plane, terms, end, (left, height, n), u, value, target, tolerance, direction, reach, most, edge)


@inlined
def _risen(
    plane: memory.Plane,
    below: Floats,
    offset: float,
    terms: memory.Terms,
    piece: tuple[float, int, float],
    x: float,
) -> float:
    """Return the output after a rise to x within the plane; by left edge of what rises, its column and mass left."""
    levels, inverse_step, table = plane
    edge, column, mass = piece
    k = memory.locate(levels, inverse_step, x)
    mass = memory.row_mass(levels, table, edge, column, x, k, x, k, mass)
    return memory.output_at(plane, below, offset, terms, x, x, k, mass)


@inlined
def _fallen(
    plane: memory.Plane,
    below: Floats,
    offset: float,
    terms: memory.Terms,
    pieces: memory.Pieces,
    p: int,
    x: float,
) -> float:
    """Return the output after a fall to x within the plane, into piece p; -1 for below all pieces."""
    levels, inverse_step, table = plane
    left, height, mass_left, column, row = pieces
    k = memory.locate(levels, inverse_step, x)
    mass = 0.0
    if p >= 0:
        mass = memory.row_mass(levels, table, left[p], column[p], x, k, height[p], row[p], mass_left[p])
    return memory.output_at(plane, below, offset, terms, x, x, k, mass)


@inner
def _leap(
    plane: memory.Plane,
    below: Floats,
    offset: float,
    terms: memory.Terms,
    ends: Ends,
    pieces: memory.Pieces,
    place: Place,
    value: float,
    target: float,
) -> tuple[float, float, int]:
    """Return what `walk` does, of a monotone operator, from within the plane.

    By bisection over the corners of the memory curve, and then by interpolation over the levels between two of them:
    the output at each follows from the mass to the left of one piece.
    """
    levels, inverse_step, _ = plane
    left, height, mass_left, column, _ = pieces
    n, near, k, mass = place
    low, high, minus, plus, tolerance, _, _ = ends
    rises = target > value
    edge = near
    moved = near, k, mass
    # The target lies between `near` and `far`. Of the pieces from `last` on, each is wiped out before it.
    far, far_value = (levels[-1], plus) if rises else (levels[0], minus)
    first, last = 0, n
    while first < last:
        p = (first + last) // 2
        corner = height[p] if rises else left[p]
        piece = left[p], column[p], mass_left[p]
        if rises:
            reached = _risen(plane, below, offset, terms, piece, corner)
        else:
            reached = memory.output_at(plane, below, offset, terms, corner, corner, column[p], mass_left[p])
        if reached != target and (reached < target) == rises:
            last, near, value = p, corner, reached
            edge, moved = left[p], piece
        else:
            first, far, far_value = p + 1, corner, reached
    if far_value != target and (far_value < target) == rises:
        # Not within the plane.
        near = far
    tries = 0
    while near != far:
        share = 0.5
        # Interpolation alone may creep.
        if tries < _INTERPOLATED or tries % 2 == 0:
            share = (target - value) / (far_value - value)
        tries += 1
        k = memory.locate(levels, inverse_step, near + share * (far - near))
        level = levels[k] if rises else levels[k + 1]
        if level == near or (level < near) == rises:
            break
        if rises:
            reached = _risen(plane, below, offset, terms, moved, level)
        else:
            reached = _fallen(plane, below, offset, terms, pieces, last - 1, level)
        if reached != target and (reached < target) == rises:
            near, value = level, reached
        else:
            far, far_value = level, reached
    if near == far:
        value = far_value
    direction, end = (1, high) if rises else (-1, low)
    corners = left, height, last
    return walk(plane, terms, end, corners, near, value, target, tolerance, direction, np.inf, _ALL, edge)


@inlined
def invert(
    plane: memory.Plane,
    below: Floats,
    offset: float,
    terms: memory.Terms,
    ends: Ends,
    pieces: memory.Pieces,
    place: Place,
    u: float,
    value: float,
    target: float,
) -> tuple[int, float, float, float, int]:
    """Return number of set-points, the first, the last, the error at the last, and the segments walked.

    If the output never falls with a rising input, whatever the memory, one walk finds all solutions.
    """
    low, high, minus, plus, tolerance, fall, nearest = ends
    corners = pieces[0], pieces[1], place[0]
    if fall == 0.0:
        direction = 1 if target > value else -1
        end = high if direction > 0 else low
        levels = plane[0]
        within = levels[0] <= u <= levels[-1]
        if within and abs(target - value) * levels.size > _NEAR * (plus - minus):
            x, e, steps = _leap(plane, below, offset, terms, ends, pieces, place, value, target)
            return 1, x, x, e, steps
        most = _NEAR if within else _ALL
        x, e, steps = _walk_on(plane, terms, end, corners, u, value, target, tolerance, direction, np.inf, most)
        if abs(e) > tolerance and steps == most:
            x, e, further = _leap(plane, below, offset, terms, ends, pieces, place, value, target)
            steps += further
        return 1, x, x, e, steps
    # The other way is walked no further than the way on which the target is met first.
    first = 1 if target > value else -1
    ahead, behind = (high, low) if first > 0 else (low, high)
    x1, e1, steps = _walk_on(plane, terms, ahead, corners, u, value, target, tolerance, first, np.inf, _ALL)
    met = abs(e1) <= tolerance
    preferred = not nearest and ((first > 0 and target <= plus) or (first < 0 and target >= minus))
    reach = abs(x1 - u) if met else np.inf
    # The other way, no nearer target is met where the output cannot come that far.
    alone = low <= u <= high and fall * reach < abs(target - value) - tolerance
    if met and (x1 == u or preferred or alone):
        return 1, x1, x1, e1, steps
    x2, e2, k2 = _walk_on(plane, terms, behind, corners, u, value, target, tolerance, -first, reach, _ALL)
    steps += k2
    met2 = abs(e2) <= tolerance
    if met2 and not (met and abs(x2 - u) >= abs(x1 - u)):
        return 1, x2, x2, e2, steps
    if met:
        return 1, x1, x1, e1, steps
    count, s1, s2, error = 1, x1, x1, e1
    if abs(e2) < abs(e1):
        s1, s2, error = x2, x2, e2
    # The two major branches, through saturation.
    travel = np.inf
    levels = plane[0]
    full = levels[:1].copy()
    crest = levels[-1:].copy()
    for direction in (-1, 1):
        turn, end, output = (levels[-1], low, plus) if direction < 0 else (levels[0], high, minus)
        branch = full, crest, (1 if direction < 0 else 0)
        x, e, k = _walk_on(plane, terms, end, branch, turn, output, target, tolerance, direction, np.inf, _ALL)
        steps += k
        distance = abs(turn - u) + abs(x - turn)
        better = abs(e) < abs(error) - tolerance
        equal = count == 2 and abs(e) <= abs(error) + tolerance and distance < travel
        if better or equal:
            count, s1, s2, error, travel = 2, turn, x, e, distance
    return count, s1, s2, error, steps


@kernel
def invert_state(
    plane: memory.Plane,
    below: Floats,
    offset: float,
    terms: memory.Terms,
    ends: Ends,
    start: memory.Start,
    u: float,
    target: float,
) -> tuple[int, float, float, float, int]:
    """Return what `invert` does, from a state whose output is not known yet."""
    left, height, present = start
    n = left.size
    pieces = left, height, np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64)
    k, mass = memory.load(plane, pieces, n, present)
    value = memory.output_at(plane, below, offset, terms, u, present, k, mass)
    return invert(plane, below, offset, terms, ends, pieces, (n, present, k, mass), u, value, target)


@kernel
def follow(
    plane: memory.Plane,
    below: Floats,
    offset: float,
    terms: memory.Terms,
    ends: Ends,
    start: memory.Start,
    raw: float,
    targets: Floats,
    rooms: tuple[Table, IntegerTable, Floats],
    count: int,
    rising: bool,
    found: Table,
    met: Flags,
    steps: memory.Integers,
) -> int:
    """Invert target after target, moving the memory along; return the new number of extrema.

    `rooms` are for the pieces, shapes (3, size) and (2, size), and for extrema, of which there are `count` already.
    `found`, shape (3, N), is given the first set-points (NaN where one is enough), the last ones and the outputs.
    """
    plane, terms, pieces = memory.borrow(plane, terms, rooms[0], rooms[1])
    below, extrema = memory.borrowed(below), memory.borrowed(rooms[2])
    left0, height0, present = start
    n = left0.size
    for p in range(n):
        pieces[0][p] = left0[p]
        pieces[1][p] = height0[p]
    k, mass = memory.load(plane, pieces, n, present)
    for t in range(targets.size):
        target = targets[t]
        value = memory.output_at(plane, below, offset, terms, raw, present, k, mass)
        place = n, present, k, mass
        setpoints, s1, s2, error, steps[t] = invert(
            plane, below, offset, terms, ends, pieces, place, raw, value, target
        )
        found[0, t] = s1 if setpoints == 2 else np.nan
        found[1, t] = s2
        found[2, t] = target + error
        met[t] = abs(error) <= 2.0 * ends[4]
        for stage in range(2 - setpoints, 2):
            before, raw = raw, s1 if stage == 0 else s2
            count, rising = memory.step_extrema(extrema, count, rising, before, raw)
            u = min(max(raw, plane[0][0]), plane[0][-1])
            n, k, mass = memory.move(plane, pieces, n, present, k, mass, u)
            present = u
    return count
