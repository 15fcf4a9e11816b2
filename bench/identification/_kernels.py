"""Compiled loops of the constrained fit. Imported on first use only: numba takes its time to load.

Columns are held as differences: `values[e]` is the change of a column at sample `rows[e]`, for e from
`starts[c]` to `starts[c + 1]`. `remaining[n]` is the weight of samples n and later, so that sums over samples
become sums over changes.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Rows = NDArray[np.int32]


@njit(cache=True)
def moments(starts: Integers, rows: Rows, values: Floats, base: Floats, remaining: Floats) -> tuple[Floats, Floats]:
    """Return weighted mean and norm about the mean of each column."""
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


@njit(cache=True)
def gradient(starts: Integers, rows: Rows, values: Floats, tail: Floats) -> Floats:
    """Return the product of each column with the vector whose reverse running sum is `tail`.

    That vector must add up to zero: the columns' starting values then drop out.
    """
    result = np.empty(starts.size - 1)
    for c in range(result.size):
        total = 0.0
        for e in range(starts[c], starts[c + 1]):
            total += values[e] * tail[rows[e]]
        result[c] = total
    return result


@njit(cache=True)
def combination(
    starts: Integers,
    rows: Rows,
    values: Floats,
    base: Floats,
    means: Floats,
    chosen: Integers,
    factors: Floats,
    samples: int,
) -> Floats:
    """Return the sum of factor * (column - mean) over the chosen columns, shape (samples,)."""
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


@njit(cache=True)
def gram_rows(
    starts: Integers,
    rows: Rows,
    values: Floats,
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
    sparse = base.size
    samples = weights.size
    dense = np.empty(samples)
    tail = np.empty(samples)
    for k in range(new.size):
        b = new[k]
        if b >= sparse:
            for n in range(samples):
                dense[n] = weights[n] * extra[n, b - sparse]
        else:
            level = (base[b] - means[b]) / norms[b]
            scale = 1.0 / norms[b]
            n = 0
            for e in range(starts[b], starts[b + 1]):
                while n < rows[e]:
                    dense[n] = weights[n] * level
                    n += 1
                level += values[e] * scale
            while n < samples:
                dense[n] = weights[n] * level
                n += 1
        total = 0.0
        for n in range(samples - 1, -1, -1):
            total += dense[n]
            tail[n] = total
        for m in range(known.size):
            a = known[m]
            product = 0.0
            if a >= sparse:
                for n in range(samples):
                    product += dense[n] * extra[n, a - sparse]
            else:
                for e in range(starts[a], starts[a + 1]):
                    product += values[e] * tail[rows[e]]
                product /= norms[a]
            result[k, m] = product
