"""Compiled walks over the exact segments of a Preisach operator. Imported on first use only."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.base import Cube, IntegerTable, Table, inlined, inner, kernel
from bench.models.kernels import memory_kernels as memory

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Plane, `below` and offset, and terms, as `memory.output_at` takes them.
Operator = tuple[memory.Plane, Floats, float, memory.Terms]
# Greatest rises by cell and major branches, see `PreisachInverse.gains` and `branches`.
Shape = tuple[Cube, Cube]
# Ends of the operating range, tolerance, whether the output rises with the input whatever the memory, and whether the
# nearest answer is wanted.
Ends = tuple[float, float, float, bool, bool]
# Left edges, heights and masses to the left of the pieces, how many count, the mass up to the input, and the input
# within the plane.
Curve = tuple[Floats, Floats, Floats, int, float, float]


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
def _reached(operator: Operator, curve: Curve, n: int, u: float, cell: int, rises: bool) -> float:
    """Return the output after a move in one direction to u within a cell, which leaves n pieces as they are."""
    plane, below, offset, terms = operator
    levels, inverse_step, table = plane
    left, height, masses, count, total, present = curve
    mass = 0.0
    if rises:
        edge, mass = (left[n], masses[n]) if n < count else (present, total)
        mass = memory.row_mass(levels, table, edge, memory.locate(levels, inverse_step, edge), u, cell, u, cell, mass)
    elif n > 0:
        column = memory.locate(levels, inverse_step, left[n - 1])
        row = memory.locate(levels, inverse_step, height[n - 1])
        mass = memory.row_mass(levels, table, left[n - 1], column, u, cell, height[n - 1], row, masses[n - 1])
    return memory.output_at(plane, below, offset, terms, u, u, cell, mass)


@inlined
def walk(
    operator: Operator,
    gains: Cube,
    tolerance: float,
    end: float,
    curve: Curve,
    u: float,
    value: float,
    target: float,
    closest: float,
    direction: int,
) -> tuple[float, float, int]:
    """Walk from input u in one direction to `end`, until the output meets the target.

    Returns the input where the output met the target, or else came closest to it, the error there (output - target),
    and the number of segments; the start if the output came no closer than the error `closest` < 0. The pieces are
    only read: what a monotone move wipes out is passed over.

    While the input and the edge of what the move changes stay within their cells, and within one quadratic of the
    reversible part, the slope rises by twice `halved` with the input, and falls by `steep` with the edge, which a
    corner of the memory curve moves. Cells that cannot bring the output closer, by their greatest gains, are passed
    over.
    """
    (levels, inverse_step, table), _, _, (breaks, quadratics) = operator
    left, height, _, n, _, present = curve
    count, rises, above = n, direction > 0, value < target
    # The error is below 0 until the target is met; `most` is the greatest that it can be.
    sign = 1.0 if above else -1.0
    error = sign * (value - target)
    best, off, steps = u, value - target, 0
    if error >= -tolerance:
        return best, off, steps
    closest = max(closest, error)
    most = error
    low, high, final = levels[0], levels[-1], levels.size - 2
    way, last, field, r = (1, final, 1, 0) if rises else (0, 0, 2, breaks.size)
    upward = 1 if above else 0
    cell = memory.locate(levels, inverse_step, u)
    if not rises and u <= levels[cell] and cell > 0:
        cell -= 1
    inside = low <= u < high if rises else low < u <= high
    edge, other, known, placed = u, 0, True, False
    while (end - u) * direction > 0.0:
        while inside and most + gains[way, upward, cell] <= closest:
            most += gains[way, upward, cell]
            u = levels[cell + way]
            known = placed = False
            if cell == last:
                inside = False
            else:
                cell += direction
        if not placed:
            # Corners that were passed over, and the edge and its cell.
            if rises:
                while n > 0 and height[n - 1] <= u:
                    n -= 1
                edge = left[n] if n < count else present
            else:
                while n > 0 and left[n - 1] >= u:
                    n -= 1
                edge = height[n - 1] if n > 0 else u
            other = memory.locate(levels, inverse_step, edge)
            placed = True
        if not known:
            error = sign * (_reached(operator, curve, n, u, cell, rises) - target)
            most, known = error, True
            if error > closest:
                best, off, closest = u, sign * error, error
                if error >= -tolerance:
                    break
            continue
        # To the end of the cell, of the quadratic, or of the way.
        if rises:
            while r < breaks.size and u >= breaks[r]:
                r += 1
            stop = min(end, breaks[r]) if r < breaks.size else end
            border = levels[cell + 1] if inside else low if u < low else end
        else:
            while r > 0 and u <= breaks[r - 1]:
                r -= 1
            stop = max(end, breaks[r - 1]) if r > 0 else end
            border = levels[cell] if inside else high if u > high else end
        crosses = (border - stop) * direction <= 0.0
        if crosses:
            stop = border
        slope = halved = steep = 0.0
        entered, met = True, False
        while True:
            if entered:
                slope = sign * direction * (quadratics[r, 1] + 2.0 * quadratics[r, 2] * u)
                halved = sign * direction * quadratics[r, 2]
                if inside:
                    row, column = (cell, other) if rises else (other, cell)
                    own = table[cell, cell, 3]
                    halved += sign * own
                    steep = 2.0 * sign * table[row, column, 3]
                    beside = table[cell, cell, field] - table[row, column, field]
                    slope += 2.0 * sign * (beside + own * (u - levels[cell]))
                    slope -= steep * (edge - levels[other])
                entered = False
            corner, more = stop, False
            if inside and n > 0:
                nearest = height[n - 1] if rises else left[n - 1]
                more = (stop - nearest) * direction > 0.0
                if more:
                    corner = nearest
            move = corner - u
            half = halved * move
            middle = slope + half
            after = error + direction * move * middle
            steps += 1
            turns = slope > 0.0 and middle + half < 0.0
            if after > closest or turns:
                length = direction * move
                if after > closest:
                    best, off, closest = corner, sign * after, after
                if turns:
                    # The output comes closest inside the segment.
                    vertex = -0.5 * slope * length / half
                    peak = error + 0.5 * slope * vertex
                    if peak > closest:
                        best, off, closest = u + direction * vertex, sign * peak, peak
                if closest > -tolerance:
                    a = half / length
                    d = _first_root(a, slope, -error, length, tolerance)
                    if d >= 0.0:
                        best, off = u + direction * d, sign * (error + d * (slope + a * d))
                    met = True
                    break
            u, error = corner, after
            if not more:
                break
            n -= 1
            before = edge
            if rises:
                edge = left[n]
                while edge < levels[other]:
                    other -= 1
                    entered = True
            else:
                edge = height[n - 1] if n > 0 else u
                while other < final and edge > levels[other + 1]:
                    other += 1
                    entered = True
            slope = middle + half - steep * (edge - before)
        if met:
            break
        most = error
        if crosses:
            if not inside:
                inside = low <= u < high if rises else low < u <= high
            elif cell == last:
                inside = False
            else:
                cell += direction
    return best, off, steps


@inlined
def _on_branch(
    operator: Operator, shape: Shape, tolerance: float, end: float, which: int, target: float
) -> tuple[float, float, int]:
    """Return what `walk` does, from saturation along a major branch: downwards (0) or upwards (1)."""
    levels = operator[0][0]
    gains, branches = shape
    first, last = 0, branches.shape[2] - 1
    wanted = min(max(target, branches[which, 2, last]), branches[which, 3, last])
    while first < last:
        middle = (first + last) // 2
        if branches[which, 2, middle] <= wanted <= branches[which, 3, middle]:
            last = middle
        else:
            first = middle + 1
    before = max(first - 1, 0)
    u, value = branches[which, 0, before], branches[which, 1, before]
    # The first number of `below` is the mass to the left of the only piece, 0.
    curve = levels, levels if which else levels[-1:], operator[1], 1, 0.0, levels[0]
    x, e, steps = walk(operator, gains, tolerance, end, curve, u, value, wanted, -tolerance, 1 if which else -1)
    return x, e + (wanted - target), steps


@inlined
def _approach(
    operator: Operator, curve: Curve, tolerance: float, u: float, value: float, target: float, way: int
) -> tuple[Curve, float, float]:
    """Return the memory, the input and the output of a monotone operator at the last corner or level before a target.

    A search by strides that double, and then by halves, finds the last corner before the target, and the last level
    between it and the next corner.
    """
    levels, inverse_step, _ = operator[0]
    left, height, masses, count, total, present = curve
    rises, near, far, stride = way > 0, count, 0, 1
    while far < near:
        p = (far + near) // 2 if stride == 0 else max(near - stride, far)
        corner = height[p] if rises else left[p]
        reached = _reached(operator, curve, p, corner, memory.locate(levels, inverse_step, corner), rises)
        if (target - reached) * way > tolerance:
            near, u, value, stride = p, corner, reached, 2 * stride
        else:
            far, stride = p + 1, 0
    cell = memory.locate(levels, inverse_step, u)
    if not rises and u <= levels[cell] and cell > 0:
        cell -= 1
    corner = levels[-1] if rises else levels[0]
    if near > 0:
        corner = height[near - 1] if rises else left[near - 1]
    end = memory.locate(levels, inverse_step, corner)
    passed, far, stride = 0, (end - cell) * way, 1
    while passed < far:
        most = (passed + far + 1) // 2 if stride == 0 else min(passed + stride, far)
        level = levels[cell + most] if rises else levels[cell + 1 - most]
        reached = _reached(operator, curve, near, level, cell + way * most, rises)
        if (target - reached) * way > tolerance:
            passed, u, value, stride = most, level, reached, 2 * stride
        else:
            far, stride = most - 1, 0
    if near < count:
        count = near + 1 if rises else near
    return (left, height, masses, count, total, present), u, value


@inner
def _elsewhere(
    operator: Operator,
    shape: Shape,
    ends: Ends,
    curve: Curve,
    u: float,
    value: float,
    target: float,
    worth: float,
    ahead: tuple[float, float],
) -> tuple[int, float, float, float, int]:
    """Return what `invert` does, after the walk towards the target: its input and error are `ahead`."""
    low, high, tolerance, _, _ = ends
    x1, e1 = ahead
    met, distance = abs(e1) <= tolerance, abs(x1 - u)
    # No further than the input at which the target is met already.
    if target > value:
        direction, end = -1, max(low, u - distance) if met else low
    else:
        direction, end = 1, min(high, u + distance) if met else high
    x2, e2, steps = walk(operator, shape[0], tolerance, end, curve, u, value, target, worth, direction)
    if abs(e2) <= tolerance and not (met and abs(x2 - u) >= distance):
        return 1, x2, x2, e2, steps
    if met:
        return 1, x1, x1, e1, steps
    count, s1, s2, error = 1, x1, x1, e1
    if abs(e2) < abs(e1):
        s1, s2, error = x2, x2, e2
    # The two major branches, through saturation.
    levels = operator[0][0]
    travel = math.inf
    for which in range(2):
        turn, end = (levels[0], high) if which else (levels[-1], low)
        x, e, k = _on_branch(operator, shape, tolerance, end, which, target)
        steps += k
        way = abs(turn - u) + abs(x - turn)
        better = abs(e) < abs(error) - tolerance
        equal = count == 2 and abs(e) <= abs(error) + tolerance and way < travel
        if better or equal:
            count, s1, s2, error, travel = 2, turn, x, e, way
    return count, s1, s2, error, steps


@inlined
def invert(
    operator: Operator,
    shape: Shape,
    ends: Ends,
    curve: Curve,
    u: float,
    value: float,
    target: float,
) -> tuple[int, float, float, float, int]:
    """Return number of set-points, the first, the last, the error at the last, and the segments walked.

    If the output rises with the input, whatever the memory, one walk finds all solutions.
    """
    low, high, tolerance, rising, nearest = ends
    levels = operator[0][0]
    gains, branches = shape
    last = branches.shape[2] - 1
    least = min(branches[0, 2, last], branches[1, 2, last])
    greatest = max(branches[0, 3, last], branches[1, 3, last])
    # The greatest error of a place that may be an answer: the major branches come as close.
    worth = -tolerance - max(target - greatest, least - target, 0.0)
    direction = 1 if target > value else -1
    end = high if direction > 0 else low
    if rising and levels[0] <= u <= levels[-1]:
        curve, u, value = _approach(operator, curve, tolerance, u, value, target, direction)
    x, e, steps = walk(operator, gains, tolerance, end, curve, u, value, target, worth, direction)
    preferred = not nearest and (target <= branches[0, 1, 0] if direction > 0 else target >= branches[1, 1, 0])
    if rising or (abs(e) <= tolerance and (x == u or preferred)):
        return 1, x, x, e, steps
    count, first, final, e, more = _elsewhere(operator, shape, ends, curve, u, value, target, worth, (x, e))
    return count, first, final, e, steps + more


@inlined
def _loaded(operator: Operator, start: memory.Start, u: float) -> tuple[Curve, float]:
    """Return the curve of a state, and its output."""
    plane, below, offset, terms = operator
    left, height, present = start
    n = left.size
    pieces = left, height, np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64)
    k, mass = memory.load(plane, pieces, n, present)
    value = memory.output_at(plane, below, offset, terms, u, present, k, mass)
    return (left, height, pieces[2], n, mass, present), value


@kernel
def invert_state(
    operator: Operator,
    shape: Shape,
    ends: Ends,
    start: memory.Start,
    u: float,
    target: float,
) -> tuple[int, float, float, float, int]:
    """Return what `invert` does, from a state whose output is not known yet."""
    curve, value = _loaded(operator, start, u)
    return invert(operator, shape, ends, curve, u, value, target)


@kernel
def walk_state(
    operator: Operator,
    shape: Shape,
    ends: Ends,
    start: memory.Start,
    u: float,
    target: float,
    direction: int,
) -> tuple[float, float]:
    """Return where the output has come to a target in one direction, or comes closest, and the error there."""
    curve, value = _loaded(operator, start, u)
    if direction * (target - value) <= 0.0:
        return u, 0.0
    end = ends[1] if direction > 0 else ends[0]
    found, error, _ = walk(operator, shape[0], ends[2], end, curve, u, value, target, -math.inf, direction)
    return found, error


@kernel
def follow(
    operator: Operator,
    shape: Shape,
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
    plane, terms, pieces = memory.borrow(operator[0], operator[3], rooms[0], rooms[1])
    below, offset, extrema = memory.borrowed(operator[1]), operator[2], memory.borrowed(rooms[2])
    gains, branches = memory.borrowed(shape[0]), memory.borrowed(shape[1])
    left0, height0, present = start
    n = left0.size
    for p in range(n):
        pieces[0][p] = left0[p]
        pieces[1][p] = height0[p]
    k, mass = memory.load(plane, pieces, n, present)
    for t in range(targets.size):
        target = targets[t]
        value = memory.output_at(plane, below, offset, terms, raw, present, k, mass)
        curve = pieces[0], pieces[1], pieces[2], n, mass, present
        setpoints, s1, s2, error, steps[t] = invert(
            (plane, below, offset, terms), (gains, branches), ends, curve, raw, value, target
        )
        found[0, t] = s1 if setpoints == 2 else np.nan
        found[1, t] = s2
        found[2, t] = target + error
        met[t] = abs(error) <= 2.0 * ends[2]
        for stage in range(2 - setpoints, 2):
            before, raw = raw, s1 if stage == 0 else s2
            count, rising = memory.step_extrema(extrema, count, rising, before, raw)
            u = min(max(raw, plane[0][0]), plane[0][-1])
            n, k, mass = memory.move(plane, pieces, n, present, k, mass, u)
            present = u
    return count
