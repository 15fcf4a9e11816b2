"""Compiled loops of the constrained fit. Imported on first use only, because numba is slow to load.

Columns are held as differences (`Columns`: starts, rows, values): `values[e]` is the change of a column at sample
`rows[e]`, for e from `starts[c]` to `starts[c + 1]`. `remaining[n]` is the weight of samples n and later, so that
sums over samples become sums over changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.compiled import kernel, reordered

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Rows = NDArray[np.int32]
Flags = NDArray[np.bool_]
Columns = tuple[Integers, Rows, Floats]

# Columns that `gram_rows` forms at a time.
_BLOCK = 8


@kernel
def moments(sparse: Columns, base: Floats, remaining: Floats) -> tuple[Floats, Floats]:
    """Return weighted mean and norm about the mean of each column."""
    starts, rows, values = sparse
    columns = base.size
    means = np.empty(columns)
    norms = np.empty(columns)
    total = remaining[0]
    for c in range(columns):
        mean = base[c]
        for e in range(starts[c], starts[c + 1]):
            mean += values[e] * remaining[rows[e]] / total
        means[c] = mean
        square = 0.0
        level = base[c] - mean
        before = total
        for e in range(starts[c], starts[c + 1]):
            now = remaining[rows[e]]
            square += level * level * (before - now)
            level += values[e]
            before = now
        square += level * level * before
        norms[c] = np.sqrt(square)
    return means, norms


@kernel
def products(
    sparse: Columns, norms: Floats, extra: Floats, weights: Floats, total: float, residual: Floats
) -> Floats:
    """Return the product of each scaled, centred column with the weighted residual.

    `total` is the sum of the weights. The residual is taken about its mean, so that the columns' starting values drop
    out.
    """
    starts, rows, values = sparse
    samples, sparse_columns = weights.size, starts.size - 1
    mean = 0.0
    for n in range(samples):
        mean += weights[n] * residual[n]
    mean /= total
    result = np.zeros(norms.size)
    tail = np.empty(samples)
    running = 0.0
    for n in range(samples - 1, -1, -1):
        value = weights[n] * (residual[n] - mean)
        running += value
        tail[n] = running
        for q in range(extra.shape[1]):
            result[sparse_columns + q] += value * extra[n, q]
    for c in range(sparse_columns):
        product = 0.0
        for e in range(starts[c], starts[c + 1]):
            product += values[e] * tail[rows[e]]
        result[c] = product / norms[c]
    return result


@kernel
def combination(
    sparse: Columns, base: Floats, means: Floats, chosen: Integers, factors: Floats, samples: int
) -> Floats:
    """Return the sum of factor * (column - mean) over the chosen columns, shape (samples,)."""
    starts, rows, values = sparse
    result = np.zeros(samples)
    start = 0.0
    for k in range(chosen.size):
        c = chosen[k]
        start += factors[k] * (base[c] - means[c])
        for e in range(starts[c], starts[c + 1]):
            result[rows[e]] += factors[k] * values[e]
    total = start
    for n in range(samples):
        total += result[n]
        result[n] = total
    return result


@kernel
def gram_rows(
    columns: Columns,
    base: Floats,
    means: Floats,
    norms: Floats,
    weights: Floats,
    extra: Floats,
    new: Integers,
    known: Integers,
    result: Floats,
) -> None:
    """Fill result[k, m] with the product of the scaled, centred columns new[k] and known[m].

    Columns from base.size on are those of `extra`, already centred and scaled.
    """
    starts, rows, values = columns
    sparse = base.size
    samples = weights.size
    # Several new columns at a time: one look-up of a row then serves them all.
    dense = np.zeros((samples, _BLOCK))
    tail = np.zeros((samples, _BLOCK))
    products = np.empty(_BLOCK)
    for first in range(0, new.size, _BLOCK):
        count = min(_BLOCK, new.size - first)
        for k in range(count):
            b = new[first + k]
            if b >= sparse:
                for n in range(samples):
                    dense[n, k] = weights[n] * extra[n, b - sparse]
            else:
                level = (base[b] - means[b]) / norms[b]
                scale = 1.0 / norms[b]
                n = 0
                for e in range(starts[b], starts[b + 1]):
                    while n < rows[e]:
                        dense[n, k] = weights[n] * level
                        n += 1
                    level += values[e] * scale
                while n < samples:
                    dense[n, k] = weights[n] * level
                    n += 1
        products[:] = 0.0
        for n in range(samples - 1, -1, -1):
            for k in range(_BLOCK):
                products[k] += dense[n, k]
                tail[n, k] = products[k]
        for m in range(known.size):
            a = known[m]
            products[:] = 0.0
            if a >= sparse:
                for n in range(samples):
                    factor = extra[n, a - sparse]
                    for k in range(_BLOCK):
                        products[k] += dense[n, k] * factor
            else:
                for e in range(starts[a], starts[a + 1]):
                    change, n = values[e], rows[e]
                    for k in range(_BLOCK):
                        products[k] += change * tail[n, k]
                for k in range(_BLOCK):
                    products[k] /= norms[a]
            for k in range(count):
                result[first + k, m] = products[k]


@kernel
def factor_independent(lower: Floats, least: Floats, good: Flags) -> None:
    """Replace the lower half of a symmetric matrix by its Cholesky factor, without columns of too small a pivot.

    `good` becomes False for columns whose pivot is below `least`; rows and columns of these mean nothing.
    """
    for k in range(least.size):
        row = lower[k]
        for j in range(k):
            if good[j]:
                other = lower[j]
                total = row[j]
                for i in range(j):
                    if good[i]:
                        total -= row[i] * other[i]
                row[j] = total / other[j]
        pivot = row[k]
        for i in range(k):
            if good[i]:
                pivot -= row[i] * row[i]
        # Not a number counts as too small.
        good[k] = pivot > 0.0 and pivot >= least[k]
        row[k] = np.sqrt(pivot) if good[k] else 0.0


@kernel
def crests(g: Floats, threshold: float, neighbours: Integers) -> Flags:
    """Return which values are at least a threshold and not below any of their neighbours.

    Row c of `neighbours`, shape (columns, 4), lists those of column c; -1 stands for none.
    """
    result = np.zeros(g.size, np.bool_)
    for c in range(g.size):
        value = g[c]
        if value >= threshold:
            found = True
            for k in range(4):
                n = neighbours[c, k]
                if n >= 0 and g[n] > value:
                    found = False
            result[c] = found
    return result


@kernel
def gather(matrix: Floats, rows: Integers, columns: Integers, result: Floats) -> None:
    """Fill the upper left of `result` with matrix[rows][:, columns]; several times as fast, and without a copy."""
    for i in range(rows.size):
        row = matrix[rows[i]]
        for j in range(columns.size):
            result[i, j] = row[columns[j]]


@kernel
def delete_column(upper: Floats, size: int, k: int, half: Floats) -> None:
    """Remove column k of the triangular factor U = upper[:size, :size] of a Gram matrix UᵀU, by rotations.

    The factor of what remains is upper[: size - 1, : size - 1]; the right side `half` turns with it.
    """
    for i in range(k):
        row = upper[i]
        for c in range(k + 1, size):
            row[c - 1] = row[c]
    for j in range(k, size - 1):
        this, following = upper[j], upper[j + 1]
        a, b = this[j + 1], following[j + 1]
        radius = np.hypot(a, b)
        cosine, sine = a / radius, b / radius
        this[j] = radius
        a, b = half[j], half[j + 1]
        half[j] = cosine * a + sine * b
        half[j + 1] = cosine * b - sine * a
        for c in range(j + 2, size):
            a, b = this[c], following[c]
            this[c - 1] = cosine * a + sine * b
            following[c] = cosine * b - sine * a


@reordered
def products_of_rows(upper: Floats, first: Integers, second: Integers) -> Floats:
    """Return the products of rows first[k] and second[k] of an upper triangular matrix."""
    result = np.empty(first.size)
    for k in range(first.size):
        one, two = upper[first[k]], upper[second[k]]
        total = 0.0
        for c in range(max(first[k], second[k]), upper.shape[0]):
            total += one[c] * two[c]
        result[k] = total
    return result


@reordered
def largest_row(gram: Floats, places: Integers) -> float:
    """Return the greatest sum of magnitudes of a row of the block of a matrix at rows and columns `places`."""
    result = 0.0
    for i in places:
        row = gram[i]
        total = 0.0
        for j in places:
            total += abs(row[j])
        result = max(result, total)
    return result


@reordered
def solve_lower(upper: Floats, size: int, right: Floats) -> None:
    """Replace each of a few right sides, shape (p, size), by the x with Uᵀx = right and U = upper[:size, :size]."""
    whole = size - size % 4
    # Four rows at a time: one look at a right side then serves them all.
    for j in range(0, whole, 4):
        one, two, three, four = upper[j], upper[j + 1], upper[j + 2], upper[j + 3]
        for k in range(right.shape[0]):
            x = right[k]
            a = x[j] / one[j]
            b = (x[j + 1] - a * one[j + 1]) / two[j + 1]
            c = (x[j + 2] - a * one[j + 2] - b * two[j + 2]) / three[j + 2]
            d = (x[j + 3] - a * one[j + 3] - b * two[j + 3] - c * three[j + 3]) / four[j + 3]
            x[j], x[j + 1], x[j + 2], x[j + 3] = a, b, c, d
            for n in range(j + 4, size):
                x[n] -= a * one[n] + b * two[n] + c * three[n] + d * four[n]
    for j in range(whole, size):
        for k in range(right.shape[0]):
            x = right[k]
            x[j] /= upper[j, j]
            for n in range(j + 1, size):
                x[n] -= x[j] * upper[j, n]


@reordered
def solve_upper(upper: Floats, size: int, right: Floats) -> Floats:
    """Return the solution of U x = right with U = upper[:size, :size]."""
    x = right[:size].copy()
    for j in range(size - 1, -1, -1):
        row = upper[j]
        total = 0.0
        for c in range(j + 1, size):
            total += row[c] * x[c]
        x[j] = (x[j] - total) / row[j]
    return x


@kernel
def factored_length(upper: Floats, size: int, places: Integers, values: Floats) -> float:
    """Return the norm of U @ vector with U = upper[:size, :size]; the vector is zero but at increasing places."""
    total = 0.0
    first = 0
    for j in range(size):
        row = upper[j]
        while first < places.size and places[first] < j:
            first += 1
        product = 0.0
        for k in range(first, places.size):
            product += row[places[k]] * values[k]
        total += product * product
    return float(np.sqrt(total))
