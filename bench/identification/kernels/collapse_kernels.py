"""Compiled loops that collapse long records. Imported on first use only, because numba is slow to load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import Cube, Table, inner, kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Rows = NDArray[np.int32]

# Part by which changes may differ from a line: what products and sums round. Derivation: some 1e5 of them, of 1e-16
# each.
_ROUNDING = 1e-11
# Degree of the polynomials of the travel that a run consists of. Derivation: a cell on the diagonal is a triangle,
# whose area is quadratic.
DEGREE = 2
_NODES = DEGREE + 1
# What becomes of a run: so many nodes, or its own rows. Derivation: no number of nodes is negative.
_KEPT = -1


@kernel
def find_runs(starts: Integers, cells: Rows, changes: Floats) -> tuple[Integers, Floats]:
    """Return the first row of each run, and the travel of the input at each row.

    Within a run all rows change the same cells in proportion to the travel, but for the cell on the diagonal, whose
    change is quadratic. Of each row that cell comes last, with the square of the travel.
    """
    rows = starts.size - 1
    firsts = np.empty(rows + 1, np.int64)
    travel = np.zeros(rows)
    count = 0
    last = -1
    for n in range(rows):
        begin, end = starts[n], starts[n + 1]
        if begin == end:
            if n == 0:
                firsts[count] = n
                count += 1
            continue
        travel[n] = np.sqrt(abs(changes[end - 1]))
        goes_on = False
        if last >= 0 and travel[n] > 0.0 and travel[last] > 0.0:
            before = starts[last]
            size = end - begin
            goes_on = starts[last + 1] - before == size and changes[end - 1] * changes[before + size - 1] > 0.0
            if goes_on:
                odd = cells[end - 1]
                sign = 1.0 if changes[end - 1] > 0.0 else -1.0
                beside = 0
                for k in range(size):
                    if cells[begin + k] != cells[before + k]:
                        goes_on = False
                        break
                    if k == size - 1:
                        break
                    now = changes[begin + k] / travel[n]
                    then = changes[before + k] / travel[last]
                    if cells[begin + k] == odd:
                        beside += 1
                        then += 2.0 * sign * travel[last]
                    if abs(now - then) > _ROUNDING * abs(now):
                        goes_on = False
                        break
                if beside != 1:
                    goes_on = False
        if not goes_on:
            firsts[count] = n
            count += 1
        last = n
    firsts[count] = rows
    return firsts[: count + 1].copy(), travel


@inner
def quadrature(
    s: Floats, w: Floats, values: Floats, points: Floats, weights: Floats, at_nodes: Floats, left: Floats
) -> int:
    """Fill in nodes, their weights and values with the same sums of products of polynomials; return their number.

    Golub and Welsch, Math. Comp. 23, 221, 1969, for the discrete measure of weights `w` at points `s`. Values, shape
    (samples, q), are projected on the polynomials; `left` becomes the weighted squares of what is left of each.
    """
    samples, columns = values.shape
    left[:] = 0.0
    total = w.sum()
    if total <= 0.0:
        return 0
    middle, half = 0.5 * (s[0] + s[-1]), 0.5 * (s[-1] - s[0])
    nodes = _NODES if half > 0.0 else 1
    jacobi = np.zeros((nodes, nodes))
    basis = np.zeros((nodes, samples))
    basis[0] = 1.0 / np.sqrt(total)
    if nodes > 1:
        x = (s - middle) / half
        for j in range(nodes):
            following = x * basis[j]
            # Twice, so that rounding does not add up.
            for _ in range(2):
                for i in range(j, -1, -1):
                    product = np.sum(w * following * basis[i])
                    following -= product * basis[i]
                    if i == j:
                        jacobi[j, j] += product
            if j + 1 < nodes:
                size = np.sqrt(np.sum(w * following * following))
                if size < 1e-6:
                    # Too few points have weight.
                    return _KEPT
                basis[j + 1] = following / size
                jacobi[j, j + 1] = jacobi[j + 1, j] = size
    zeros, vectors = np.linalg.eigh(jacobi)
    for k in range(nodes):
        points[k] = middle + half * zeros[k]
        weights[k] = total * vectors[0, k] ** 2
    for q in range(columns):
        at_nodes[:, q] = 0.0
        rest = values[:, q].copy()
        for j in range(nodes):
            projected = np.sum(w * basis[j] * values[:, q])
            rest -= projected * basis[j]
            for k in range(nodes):
                sign = 1.0 if vectors[0, k] > 0.0 else -1.0
                at_nodes[k, q] += sign * vectors[j, k] / np.sqrt(weights[k]) * projected
        left[q] = np.sum(w * rest * rest)
    return nodes


@kernel
def collapse_runs(
    values: Table, w: Floats, firsts: Integers, travel: Floats, allowed: Floats
) -> tuple[Integers, Floats, Floats, Floats, Floats]:
    """Return for each run the number of its nodes, these, their weights and values, and what is left of all values.

    A run of few rows is kept, as is one where more is left of a value than `allowed` times its samples.
    """
    runs, columns = firsts.size - 1, values.shape[1]
    nodes = np.full(runs, _KEPT)
    points, weights = np.zeros((runs, _NODES)), np.zeros((runs, _NODES))
    at_nodes = np.zeros((runs, _NODES, columns))
    left, rest = np.zeros(columns), np.zeros(columns)
    for g in range(runs):
        first, stop = firsts[g], firsts[g + 1]
        if stop - first <= _NODES + 1:
            continue
        s = np.cumsum(travel[first:stop])
        count = quadrature(s, w[first:stop], values[first:stop], points[g], weights[g], at_nodes[g], rest)
        if (rest <= allowed * (stop - first)).all():
            nodes[g] = count
            if count != _KEPT:
                left += rest
    return nodes, points, weights, at_nodes, left


@kernel
def collapsed_rows(
    starts: Integers,
    cells: Rows,
    changes: Floats,
    values: Table,
    w: Floats,
    firsts: Integers,
    travel: Floats,
    found: tuple[Integers, Table, Table, Cube],
) -> tuple[Integers, Rows, Floats, Floats, Floats]:
    """Return starts, cells, changes, values and weights of the rows: nodes, and one without weight at a run's end."""
    nodes, points, weights, at_nodes = found
    rows, entries = 0, 0
    for g in range(nodes.size):
        first, stop = firsts[g], firsts[g + 1]
        if nodes[g] == _KEPT:
            rows += stop - first
            entries += starts[stop] - starts[first]
        else:
            rows += nodes[g] + 1
            entries += (nodes[g] + 1) * (starts[first + 1] - starts[first])
    new_starts = np.zeros(rows + 1, np.int64)
    new_cells = np.empty(entries, np.int32)
    new_changes = np.empty(entries)
    new_values = np.zeros((rows, values.shape[1]))
    new_weights = np.zeros(rows)
    row, end = 0, 0
    for g in range(nodes.size):
        first, stop = firsts[g], firsts[g + 1]
        if nodes[g] == _KEPT:
            for n in range(first, stop):
                for e in range(starts[n], starts[n + 1]):
                    new_cells[end] = cells[e]
                    new_changes[end] = changes[e]
                    end += 1
                new_values[row] = values[n]
                new_weights[row] = w[n]
                row += 1
                new_starts[row] = end
            continue
        place = 0.0
        for k in range(nodes[g] + 1):
            target = points[g, k] if k < nodes[g] else np.sum(travel[first:stop])
            for e in range(starts[first], starts[first + 1]):
                new_cells[end] = cells[e]
                if e == starts[first + 1] - 1:
                    sign = 1.0 if changes[e] > 0.0 else -1.0
                    new_changes[end] = sign * (target * target - place * place)
                else:
                    new_changes[end] = changes[e] / travel[first] * (target - place)
                end += 1
            new_values[row] = at_nodes[g, k] if k < nodes[g] else values[stop - 1]
            new_weights[row] = weights[g, k] if k < nodes[g] else 0.0
            place = target
            row += 1
            new_starts[row] = end
    return new_starts, new_cells, new_changes, new_values, new_weights
