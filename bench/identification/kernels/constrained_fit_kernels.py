"""Compiled loops of the constrained fit. Imported on first use only, because numba is slow to load.

Columns are held as differences (`Columns`: starts, rows, values): `values[e]` is the change of a column at sample
`rows[e]`, for e from `starts[c]` to `starts[c + 1]`. `remaining[n]` is the weight of samples n and later, so that
sums over samples become sums over changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import IntegerTable, Table, kernel, reordered

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Rows = NDArray[np.int32]
Flags = NDArray[np.bool_]
Columns = tuple[Integers, Rows, Floats]

# Known columns whose products `gram_rows` keeps before it hands them out. Derivation: of a thousand columns they take
# 0.25 MB.
_BLOCK = 32


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
def products(sparse: Columns, norms: Floats, extra: Table, weights: Floats, total: float, residual: Floats) -> Floats:
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
        for k in range(extra.shape[1]):
            result[sparse_columns + k] += value * extra[n, k]
    # Four sums that do not wait for each other.
    for c in range(sparse_columns):
        p, q, r, s = 0.0, 0.0, 0.0, 0.0
        stop = starts[c + 1]
        whole = stop - (stop - starts[c]) % 4
        for e in range(starts[c], whole, 4):
            p += values[e] * tail[np.uint64(rows[e])]
            q += values[e + 1] * tail[np.uint64(rows[e + 1])]
            r += values[e + 2] * tail[np.uint64(rows[e + 2])]
            s += values[e + 3] * tail[np.uint64(rows[e + 3])]
        for e in range(whole, stop):
            p += values[e] * tail[np.uint64(rows[e])]
        result[c] = ((p + q) + (r + s)) / norms[c]
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


@reordered
def gram_rows(
    columns: Columns,
    base: Floats,
    means: Floats,
    norms: Floats,
    weights: Floats,
    new: Integers,
    known: Integers,
    tail: Table,
    result: Table,
) -> None:
    """Fill result[k, m] with the product of the scaled, centred columns new[k] and known[m].

    Of the last columns of `known`, which are the new ones, those behind new[k] may be left out. Places from base.size
    on are passed over. `tail`, shape (samples, width), is overwritten: so many new columns are taken at a time.
    """
    starts, rows, values = columns
    samples, width = tail.shape
    sums = np.empty((_BLOCK, width))
    for first in range(0, new.size, width):
        count = min(width, new.size - first)
        for n in range(samples):
            for k in range(width):
                tail[n, k] = 0.0
        for k in range(count):
            b = new[first + k]
            if b >= base.size:
                continue
            scale = 1.0 / norms[b]
            tail[0, k] = scale * (base[b] - means[b])
            for e in range(starts[b], starts[b + 1]):
                tail[rows[e], k] += scale * values[e]
        # Changes become values, and these their weighted sums over the samples behind: whole rows at a time.
        for n in range(1, samples):
            for k in range(width):
                tail[n, k] += tail[n - 1, k]
        for k in range(width):
            tail[samples - 1, k] *= weights[samples - 1]
        for n in range(samples - 2, -1, -1):
            for k in range(width):
                tail[n, k] = weights[n] * tail[n, k] + tail[n + 1, k]
        last = known.size - new.size + first + count
        for begin in range(0, last, _BLOCK):
            end = min(begin + _BLOCK, last)
            for m in range(begin, end):
                a = known[m]
                total = sums[m - begin]
                for k in range(width):
                    total[k] = 0.0
                if a >= base.size:
                    continue
                scale = 1.0 / norms[a]
                stop = starts[a + 1]
                pairs = stop - (stop - starts[a]) % 2
                # Unsigned, so that no index is looked at for its sign. Two at a time halve the stores.
                for e in range(starts[a], pairs, 2):
                    f, g = scale * values[e], scale * values[e + 1]
                    i, j = np.uint64(rows[e]), np.uint64(rows[e + 1])
                    for k in range(width):
                        total[k] += f * tail[i, k] + g * tail[j, k]
                if pairs < stop:
                    f, i = scale * values[pairs], np.uint64(rows[pairs])
                    for k in range(width):
                        total[k] += f * tail[i, k]
            for k in range(count):
                for m in range(begin, end):
                    result[first + k, m] = sums[m - begin, k]


@kernel
def crests(g: Floats, threshold: float, neighbours: IntegerTable) -> Flags:
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
