"""Compiled loops over the memory curve. Imported on first use only, because numba is slow to load.

Arrays are copied element by element: for the message of an assignment that does not fit, numba would compile for 3 s.

The on-region of the plane is a staircase of pieces (left edge, height); see `MemoryCurve.staircase`.
With each diagonal cell completed to a square, the integral of the density over {β < b, α < a} is bilinear
within a cell: G + y row + x col + density x y, with x, y measured from the cell's lower left node. What the
completion adds below the diagonal depends on the input alone and is taken off again (`below`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba.extending import intrinsic
from numpy.typing import NDArray

from bench.base import Cube, Fixed, Table, inlined, inner, kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# What the loops share, as plain tuples: numba passes them at the cost of their members.
Axis = tuple[Floats, float]  # levels and inverse step of a lattice
Plane = tuple[Floats, float, Cube]  # levels, inverse step, table
Terms = tuple[Floats, Table]  # breaks and quadratics of the reversible part
Start = tuple[Floats, Floats, float]  # left edges and heights of the pieces, and the input within the plane
Pieces = tuple[Floats, Floats, Floats, Integers, Integers]  # left, height, mass_left, column, row
Entries = tuple[NDArray[np.int32], Floats]  # cells and changes


def _unowned(typing_context: Any, array: Any) -> Any:  # noqa: ANN401, ARG001
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        view = context.make_array(signature.return_type)(context, builder, arguments[0])
        for owner in ("meminfo", "parent"):
            setattr(view, owner, getattr(view, owner).type(None))
        return view._getvalue()

    return array(array), build


# The same array without ownership: passing it on costs no reference counting, which is atomic and would take
# several times as long as the short functions here. The caller must hold the array: borrow arguments only.
borrowed: Any = intrinsic(_unowned)


@inlined
def locate(levels: Floats, inverse_step: float, value: float) -> int:
    """Return k with levels[k] <= value < levels[k + 1], kept within the lattice."""
    last = levels.size - 2
    if inverse_step > 0.0:
        k = int((value - levels[0]) * inverse_step)
        if k < 0:
            k = 0
        elif k > last:
            k = last
        # Rounding may put a node into the neighbouring cell.
        while k > 0 and value < levels[k]:
            k -= 1
        while k < last and value >= levels[k + 1]:
            k += 1
        return k
    low, high = 0, last
    while low < high:
        middle = (low + high + 1) // 2
        if levels[middle] <= value:
            low = middle
        else:
            high = middle - 1
    return low


@inlined
def locate_near(levels: Floats, inverse_step: float, value: float, guess: int) -> int:
    """Return what `locate` does; at once if it is `guess`."""
    if levels[guess] <= value < levels[guess + 1]:
        return guess
    return locate(levels, inverse_step, value)


@inlined
def bilinear(table: Floats, levels: Floats, b: float, j: int, a: float, i: int) -> float:
    """Return the value of a cell of a table of bilinear functions at (b, a)."""
    x = b - levels[j]
    y = a - levels[i]
    # Indexed one by one: a row view would cost reference counting in the innermost loop.
    value: float = table[i, j, 0] + y * table[i, j, 1] + x * (table[i, j, 2] + y * table[i, j, 3])
    return value


@inlined
def reversible_value(terms: Terms, u: float) -> float:
    """Return the single-valued part at u."""
    breaks, quadratics = terms
    r = 0
    while r < breaks.size and u > breaks[r]:
        r += 1
    value: float = quadratics[r, 0] + u * (quadratics[r, 1] + u * quadratics[r, 2])
    return value


@inlined
def step_extrema(extrema: Floats, count: int, rising: bool, present: float, value: float) -> tuple[int, bool]:
    """Move the stack of extrema, with room for one more, from input `present` to `value`.

    `rising` is the present branch. Returns the new count and branch.
    """
    if value > present:
        if not rising:
            extrema[count] = present
            count += 1
            rising = True
        while count >= 2 and extrema[count - 2] <= value:
            count -= 2
    elif value < present:
        if rising:
            extrema[count] = present
            count += 1
            rising = False
        while count >= 2 and extrema[count - 2] >= value:
            count -= 2
    return count, rising


@kernel
def advance_extrema(inputs: Floats, stack: Floats, count: int, present: float, rising: bool) -> int:
    """Step the stack of extrema through `inputs`; return the new count."""
    stack = borrowed(stack)
    for n in range(inputs.size):
        count, rising = step_extrema(stack, count, rising, present, inputs[n])
        present = inputs[n]
    return count


@inlined
def borrow(plane: Plane, terms: Terms, stack: Floats, indices: Integers) -> tuple[Plane, Terms, Pieces]:
    """Return plane, terms, and the rows of `stack` and `indices` as pieces, all without ownership."""
    pieces = borrowed(stack[0]), borrowed(stack[1]), borrowed(stack[2]), borrowed(indices[0]), borrowed(indices[1])
    return (borrowed(plane[0]), plane[1], borrowed(plane[2])), (borrowed(terms[0]), borrowed(terms[1])), pieces


@inlined
def row_mass(
    levels: Floats,
    table: Floats,
    left: float,
    column: int,
    right: float,
    k: int,
    height: float,
    row: int,
    mass: float,
) -> float:
    """Return a mass plus that of the piece from `left` to `right` below its height; by cells k, column, row."""
    mass += bilinear(table, levels, right, k, height, row)
    mass -= bilinear(table, levels, left, column, height, row)
    return mass


@inner
def load(plane: Plane, pieces: Pieces, n: int, u: float) -> tuple[int, float]:
    """Fill in what belongs to n given pieces; return the input's cell and the mass up to the input.

    mass_left[p] is the integral of the completed density over the pieces to the left of piece p.
    """
    levels, inverse_step, table = plane
    left, height, mass_left, column, row = pieces
    mass = 0.0
    for p in range(n):
        column[p] = locate(levels, inverse_step, left[p])
        row[p] = locate(levels, inverse_step, height[p])
        mass_left[p] = mass
        right = left[p + 1] if p + 1 < n else u
        k = locate(levels, inverse_step, right)
        mass = row_mass(levels, table, left[p], column[p], right, k, height[p], row[p], mass)
    return locate(levels, inverse_step, u), mass


@inlined
def move(
    plane: Plane, pieces: Pieces, n: int, present: float, k: int, mass: float, u: float
) -> tuple[int, int, float]:
    """Move the staircase from input `present` to u; return number of pieces, the input's cell, the mass."""
    levels, inverse_step, table = plane
    left, height, mass_left, column, row = pieces
    if u == present:
        return n, k, mass
    if u > present:
        edge, edge_column, edge_mass = present, k, mass
        while n > 0 and height[n - 1] <= u:
            n -= 1
            edge, edge_column, edge_mass = left[n], column[n], mass_left[n]
        k = locate_near(levels, inverse_step, u, k)
        left[n] = edge
        column[n] = edge_column
        mass_left[n] = edge_mass
        height[n] = u
        row[n] = k
        n += 1
    else:
        k = locate_near(levels, inverse_step, u, k)
        while n > 0 and left[n - 1] >= u:
            n -= 1
    mass = 0.0
    if n > 0:
        p = n - 1
        mass = row_mass(levels, table, left[p], column[p], u, k, height[p], row[p], mass_left[p])
    return n, k, mass


@inlined
def output_at(
    plane: Plane, below: Floats, offset: float, terms: Terms, raw: float, u: float, k: int, mass: float
) -> float:
    """Return the output at input `raw`, which is u within the plane, given the mass up to u."""
    levels, _, table = plane
    x = u - levels[k]
    mass -= below[k] + 0.5 * table[k, k, 3] * x * x
    return offset + 2.0 * mass + reversible_value(terms, raw)


@inner
def _run(
    inputs: Floats,
    plane: Plane,
    below: Floats,
    offset: float,
    terms: Terms,
    start: Start,
    stack: Floats,
    indices: Integers,
    outputs: Floats,
) -> None:
    plane, terms, pieces = borrow(plane, terms, stack, indices)
    below = borrowed(below)
    low, high = plane[0][0], plane[0][-1]
    left0, height0, present = start
    n = left0.size
    for p in range(n):
        pieces[0][p] = left0[p]
        pieces[1][p] = height0[p]
    k, mass = load(plane, pieces, n, present)
    for t in range(inputs.size):
        raw = inputs[t]
        u = min(max(raw, low), high)
        n, k, mass = move(plane, pieces, n, present, k, mass, u)
        present = u
        outputs[t] = output_at(plane, below, offset, terms, raw, u, k, mass)


@kernel
def evaluate(inputs: Floats, plane: Plane, below: Floats, offset: float, terms: Terms, start: Start) -> Floats:
    """Return the outputs of a sequence: a running sum on the staircase, O(1) amortised a sample."""
    room = inputs.size + start[0].size + 1
    outputs = np.empty(inputs.size)
    # In a call of its own: what it borrows must be held here.
    _run(inputs, plane, below, offset, terms, start, np.empty((3, room)), np.empty((2, room), np.int64), outputs)
    return outputs


@inner
def _span(axis: Axis, low: float, high: float) -> tuple[int, int]:
    """Return the first and last cell that [low, high] overlaps by more than a point."""
    levels, inverse_step = axis
    first = locate(levels, inverse_step, low)
    last = locate(levels, inverse_step, high)
    if last > first and high == levels[last]:
        last -= 1
    return first, last


@inner
def _rectangle(
    axis: Axis, b0: float, b1: float, a0: float, a1: float, factor: float, entries: Entries, end: int
) -> int:
    """Append factor * overlap with [b0, b1] x [a0, a1] for each cell touched; without room, only count them."""
    levels, _ = axis
    cells, changes = entries
    if b1 <= b0 or a1 <= a0:
        return end
    j0, j1 = _span(axis, b0, b1)
    i0, i1 = _span(axis, a0, a1)
    if cells.size == 0:
        return end + (i1 - i0 + 1) * (j1 - j0 + 1)
    for i in range(i0, i1 + 1):
        y = factor * (min(a1, levels[i + 1]) - max(a0, levels[i]))
        base = i * (i + 1) // 2
        for j in range(j0, j1 + 1):
            cells[end] = base + j
            changes[end] = y * (min(b1, levels[j + 1]) - max(b0, levels[j]))
            end += 1
    return end


@inner
def _triangle(axis: Axis, low: float, high: float, factor: float, entries: Entries, end: int) -> int:
    """Append factor * overlap with {low <= β <= α <= high} for each cell touched, or count them as `_rectangle`."""
    levels, _ = axis
    cells, changes = entries
    if high <= low:
        return end
    i0, i1 = _span(axis, low, high)
    if cells.size == 0:
        count = i1 - i0 + 1
        return end + count * (count + 1) // 2
    for i in range(i0, i1 + 1):
        y = min(high, levels[i + 1]) - max(low, levels[i])
        base = i * (i + 1) // 2
        for j in range(i0, i):
            cells[end] = base + j
            changes[end] = factor * y * (min(high, levels[j + 1]) - max(low, levels[j]))
            end += 1
        cells[end] = base + i
        changes[end] = 0.5 * factor * y * y
        end += 1
    return end


@kernel
def swept_areas(axis: Axis, start: Start, entries: Entries) -> int:
    """List twice the on-area of each cell that the staircase touches; return the number of entries.

    Without room for any entry they are only counted.
    """
    left, height, u = start
    # Not 0: for a literal numba would compile once more.
    end = _triangle(axis, axis[0][0], u, 2.0, entries, int(0.0))
    for p in range(left.size):
        right = left[p + 1] if p + 1 < left.size else u
        end = _rectangle(axis, left[p], right, u, height[p], 2.0, entries, end)
    return end


@kernel
def swept_differences(inputs: Floats, axis: Axis, start: Start, starts: Integers, entries: Entries) -> int:
    """List, sample by sample, the change of 2 * on-area of the cells that the input swept.

    Without room for any entry they are only counted.
    """
    left0, height0, present = start
    left = np.empty(inputs.size + left0.size + 1)
    height = np.empty(inputs.size + left0.size + 1)
    n = left0.size
    for p in range(n):
        left[p] = left0[p]
        height[p] = height0[p]
    low, high = axis[0][0], axis[0][-1]
    end = int(0.0)
    for t in range(inputs.size):
        starts[t] = end
        u = min(max(inputs[t], low), high)
        if u > present:
            right = present
            edge = present
            while n > 0 and height[n - 1] <= u:
                n -= 1
                edge = left[n]
                end = _rectangle(axis, edge, right, height[n], u, 2.0, entries, end)
                right = edge
            end = _triangle(axis, present, u, 2.0, entries, end)
            left[n] = edge
            height[n] = u
            n += 1
        elif u < present:
            right = present
            p = n - 1
            while p >= 0 and right > u:
                edge = max(left[p], u)
                end = _rectangle(axis, edge, right, present, height[p], -2.0, entries, end)
                right = edge
                p -= 1
            end = _triangle(axis, u, present, -2.0, entries, end)
            while n > 0 and left[n - 1] >= u:
                n -= 1
        present = u
    starts[inputs.size] = end
    return end


@kernel
def difference_product(starts: Integers, cells: NDArray[np.int32], changes: Floats, weights: Floats) -> Floats:
    """Return the running sum of (row differences) @ weights."""
    result = np.empty(starts.size - 1)
    total = 0.0
    for t in range(result.size):
        step = 0.0
        for e in range(starts[t], starts[t + 1]):
            step += changes[e] * weights[cells[e]]
        total += step
        result[t] = total
    return result


@kernel
def dense_rows(starts: Integers, cells: NDArray[np.int32], changes: Floats, base: Floats, result: Table) -> None:
    """Fill result[:, : base.size] with the rows themselves."""
    row = base.copy()
    for t in range(starts.size - 1):
        for e in range(starts[t], starts[t + 1]):
            row[cells[e]] += changes[e]
        for c in range(base.size):
            result[t, c] = row[c]


@kernel
def by_column(
    starts: Integers, cells: NDArray[np.int32], changes: Floats, columns: int
) -> tuple[Integers, NDArray[np.int32], Floats]:
    """Return the row differences column by column, rows increasing, entries of one row added up."""
    samples = starts.size - 1
    offsets = np.zeros(columns + 1, np.int64)
    latest = np.full(columns, -1)
    for t in range(samples):
        for e in range(starts[t], starts[t + 1]):
            c = cells[e]
            if latest[c] != t:
                latest[c] = t
                offsets[c + 1] += 1
    for c in range(columns):
        offsets[c + 1] += offsets[c]
    fill = offsets[:-1].copy()
    rows = np.empty(offsets[columns], np.int32)
    values = np.empty(offsets[columns])
    for t in range(samples):
        for e in range(starts[t], starts[t + 1]):
            c = cells[e]
            at = fill[c]
            if at > offsets[c] and rows[at - 1] == t:
                values[at - 1] += changes[e]
            else:
                rows[at] = t
                values[at] = changes[e]
                fill[c] = at + 1
    return offsets, rows, values


@kernel
def best_staircases(columns: Table, widths: Floats) -> Floats:
    """Return F[j, i]: the greatest mass below a non-increasing staircase over columns < j, heights >= i.

    columns[i, j] is the mass per unit width of column j below level i; -inf marks i <= j.
    """
    size = widths.size
    best = np.full((size + 1, size + 1), -math.inf)
    best[0, :] = 0.0
    for j in range(size):
        running = -math.inf
        for i in range(size, j, -1):
            running = max(running, best[j, i] + widths[j] * columns[i, j])
            best[j + 1, i] = running
    return best


@kernel
def plays(lower: Floats, upper: Floats, thresholds: Fixed, state: Floats) -> Floats:
    """Step plays between two drives; return their states sample by sample. `state` is changed."""
    result = np.empty((lower.size, state.size))
    for t in range(lower.size):
        for i in range(state.size):
            state[i] = max(lower[t] - thresholds[i], min(upper[t] + thresholds[i], state[i]))
            result[t, i] = state[i]
    return result


@kernel
def weighted_plays(drive: Floats, thresholds: Fixed, weights: Fixed, state: Floats) -> Floats:
    """Step the plays through `drive`; return their weighted sum. `state` is changed."""
    result = np.empty(drive.size)
    for t in range(drive.size):
        x = drive[t]
        total = 0.0
        for i in range(state.size):
            state[i] = max(x - thresholds[i], min(x + thresholds[i], state[i]))
            total += weights[i] * state[i]
        result[t] = total
    return result
