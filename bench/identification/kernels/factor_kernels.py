"""Compiled loops over the packed factor of `cholesky_factor`. Imported on first use only: numba is slow to load.

The rows of the lower triangular factor L stand one after the other in a flat array, in blocks of `BLOCK` rows of one
width: what ends there stays where it is as rows are appended, a third of a square is saved, and BLAS takes a block.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import Table, inlined, inner, kernel, reordered
from bench.models import borrowed

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

BLOCK = 128
"""Rows of a block. Derivation: a square of them takes 0.13 MB."""


def row_start(row: int) -> int:
    """Return the place of the first element of a row."""
    block = row // BLOCK
    return BLOCK * (BLOCK * (block * (block + 1) // 2) + (row - BLOCK * block) * (block + 1))


_start = inlined(row_start)


@inlined
def _four_rows(factor: Floats, c: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return rows c to c + 3 up to the diagonal of the last: they are of one block if 4 divides c."""
    start = _start(c)
    width = _start(c + 1) - start
    return (
        factor[start : start + c + 4],
        factor[start + width : start + width + c + 4],
        factor[start + 2 * width : start + 2 * width + c + 4],
        factor[start + 3 * width : start + 3 * width + c + 4],
    )


@reordered
def solve_lower(factor: Floats, size: int, right: Table) -> None:
    """Replace each of a few right sides, the first `size` of a row, by the x with L x = right.

    Rows that are contiguous as a whole take a third of the time of those of a slice.
    """
    factor, right = borrowed(factor), borrowed(right)
    whole = size - size % 4
    # Four rows at a time: one look at a right side then serves them all.
    for c in range(0, whole, 4):
        one, two, three, four = _four_rows(factor, c)
        for k in range(right.shape[0]):
            x = right[k]
            p, q, r, s = 0.0, 0.0, 0.0, 0.0
            for j in range(c):
                p += one[j] * x[j]
                q += two[j] * x[j]
                r += three[j] * x[j]
                s += four[j] * x[j]
            p = (x[c] - p) / one[c]
            q = (x[c + 1] - q - p * two[c]) / two[c + 1]
            r = (x[c + 2] - r - p * three[c] - q * three[c + 1]) / three[c + 2]
            s = (x[c + 3] - s - p * four[c] - q * four[c + 1] - r * four[c + 2]) / four[c + 3]
            x[c], x[c + 1], x[c + 2], x[c + 3] = p, q, r, s
    for c in range(whole, size):
        start = _start(c)
        for k in range(right.shape[0]):
            x = right[k]
            p = 0.0
            for j in range(c):
                p += factor[start + j] * x[j]
            x[c] = (x[c] - p) / factor[start + c]


@reordered
def solve_upper(factor: Floats, size: int, right: Floats) -> Floats:
    """Return the solution of Lᵀ x = right."""
    x = right[:size].copy()
    factor = borrowed(factor)
    whole = size - size % 4
    for c in range(size - 1, whole - 1, -1):
        start = _start(c)
        x[c] /= factor[start + c]
        for j in range(c):
            x[j] -= x[c] * factor[start + j]
    # Four rows at a time: one look at the solution then serves them all.
    for c in range(whole - 4, -1, -4):
        one, two, three, four = _four_rows(factor, c)
        d = x[c + 3] / four[c + 3]
        e = (x[c + 2] - d * four[c + 2]) / three[c + 2]
        f = (x[c + 1] - d * four[c + 1] - e * three[c + 1]) / two[c + 1]
        g = (x[c] - d * four[c] - e * three[c] - f * two[c]) / one[c]
        x[c], x[c + 1], x[c + 2], x[c + 3] = g, f, e, d
        for j in range(c):
            x[j] -= g * one[j] + f * two[j] + e * three[j] + d * four[j]
    return x


@inner
def _rotate(factor: Floats, half: Floats, cosines: Floats, sines: Floats, c: int, j: int, a: float) -> None:
    """Finish row c of `delete_row` from rotation j on, with what it carries, and find its own rotation."""
    start, target = _start(c), _start(c - 1)
    while j < c - 1:
        b = factor[start + j + 1]
        factor[target + j] = cosines[j] * a + sines[j] * b
        a = cosines[j] * b - sines[j] * a
        j += 1
    b = factor[start + c]
    radius = np.hypot(a, b)
    cosine, sine = a / radius, b / radius
    cosines[j], sines[j] = cosine, sine
    factor[target + j] = radius
    a, b = half[j], half[j + 1]
    half[j] = cosine * a + sine * b
    half[j + 1] = cosine * b - sine * a


@reordered
def delete_row(factor: Floats, size: int, k: int, half: Floats) -> None:
    """Remove row k of the factor, by rotations of its columns; the right side `half` turns with it."""
    cosines, sines = np.empty(size), np.empty(size)
    c = k + 1
    while c < size:
        count = 4 if c + 4 <= size else 1
        for m in range(c, c + count):
            start, target = _start(m), _start(m - 1)
            row, above = factor[start : start + k], factor[target : target + k]
            for j in range(k):
                above[j] = row[j]
        if count == 1:
            _rotate(factor, half, cosines, sines, c, k, factor[_start(c) + k])
            c += 1
            continue
        # Four rows at a time: each waits for itself.
        to = factor[_start(c - 1) : _start(c - 1) + c]
        one = factor[_start(c) : _start(c) + c]
        two = factor[_start(c + 1) : _start(c + 1) + c]
        three = factor[_start(c + 2) : _start(c + 2) + c]
        four = factor[_start(c + 3) : _start(c + 3) + c]
        p, q, r, s = one[k], two[k], three[k], four[k]
        for j in range(k, c - 1):
            cosine, sine = cosines[j], sines[j]
            a, b, d, e = one[j + 1], two[j + 1], three[j + 1], four[j + 1]
            to[j] = cosine * p + sine * a
            one[j] = cosine * q + sine * b
            two[j] = cosine * r + sine * d
            three[j] = cosine * s + sine * e
            p, q = cosine * a - sine * p, cosine * b - sine * q
            r, s = cosine * d - sine * r, cosine * e - sine * s
        _rotate(factor, half, cosines, sines, c, c - 1, p)
        _rotate(factor, half, cosines, sines, c + 1, c - 1, q)
        _rotate(factor, half, cosines, sines, c + 2, c - 1, r)
        _rotate(factor, half, cosines, sines, c + 3, c - 1, s)
        c += 4


@kernel
def combined_rows(factor: Floats, places: Integers, values: Floats) -> Floats:
    """Return the sum of value * row over increasing places."""
    total = np.zeros(places[-1] + 1)
    for k in range(places.size):
        start = _start(places[k])
        for j in range(places[k] + 1):
            total[j] += values[k] * factor[start + j]
    return total


@kernel
def products_of_columns(factor: Floats, size: int, first: Integers, second: Integers) -> Floats:
    """Return the products of columns first[k] <= second[k] of a lower triangular matrix; `second` does not fall."""
    factor, result = borrowed(factor), np.zeros(first.size)
    reached = 0
    for c in range(size):
        while reached < second.size and second[reached] <= c:
            reached += 1
        row = factor[_start(c) :]
        for k in range(reached):
            result[k] += row[np.uint64(first[k])] * row[np.uint64(second[k])]
    return result


@kernel
def factor_independent(lower: Table, least: Floats, good: Flags) -> None:
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
