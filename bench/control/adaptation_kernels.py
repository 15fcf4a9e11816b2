"""Compiled loop of the adaptation of a Preisach operator. Imported on first use only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import Fixed, inner, kernel
from bench.models import memory_kernels as memory

Floats = NDArray[np.float64]

_evaluate = memory.evaluate
_reversible_value = memory.reversible_value
_swept_differences = memory.swept_differences


@inner
def _tabulate(levels: Floats, density: Floats, table: Floats, below: Floats) -> float:
    """Fill in the prefix sums of `Preisach.lattice`; return the mass, the sum of density * area."""
    order = levels.size - 1
    total = 0.0
    below[0] = 0.0
    for i in range(order):
        height = levels[i + 1] - levels[i]
        row = 0.0
        for j in range(order):
            value = density[i * (i + 1) // 2 + j] if j <= i else 0.0
            width = levels[j + 1] - levels[j]
            table[i, j, 1] = row
            table[i, j, 3] = value
            row += value * width
            if i + 1 < order:
                table[i + 1, j, 2] = table[i, j, 2] + value * height
        if i + 1 < order:
            corner = 0.0
            for j in range(order):
                table[i + 1, j, 0] = corner
                corner += table[i + 1, j, 2] * (levels[j + 1] - levels[j])
        half = 0.5 * table[i, i, 3] * height * height
        below[i + 1] = below[i] + half
        total += row * height - half
    return total


@kernel
def adapt(
    axis: memory.Axis,
    old_density: Fixed,
    bias: float,
    terms: memory.Terms,
    start: memory.Start,
    raw: float,
    value: float,
    before: float,
    output: float,
    step: float,
    bias_step: float,
    regularisation: float,
) -> tuple[Floats, Floats, Floats, float, float, float, float, float]:
    """Correct the density by the change of output while the input moved from `raw` to `value`.

    `before` is the output measured at `raw`, NaN if there was none. Returns density, table, below, bias, offset,
    outputs at negative and at positive saturation, and the error of the predicted change (NaN without one).
    """
    density = old_density.copy()
    levels, inverse_step = axis
    order = levels.size - 1
    error = np.nan
    here = np.empty(1)
    here[0] = value
    if not np.isnan(before):
        starts = np.empty(2, np.int64)
        none = np.empty(0, np.int32), np.empty(0)
        count = _swept_differences(here, axis, start, starts, none)
        cells, changes = np.empty(count, np.int32), np.empty(count)
        _swept_differences(here, axis, start, starts, (cells, changes))
        areas = np.empty(count)
        on = np.zeros(density.size)
        predicted = _reversible_value(terms, value) - _reversible_value(terms, raw)
        for e in range(count):
            c = cells[e]
            predicted += density[c] * changes[e]
            i = int((np.sqrt(8.0 * c + 1.0) - 1.0) / 2.0)
            j = c - i * (i + 1) // 2
            area = (levels[i + 1] - levels[i]) * (levels[j + 1] - levels[j])
            areas[e] = 0.5 * area if i == j else area
            on[c] += changes[e] / areas[e]
        error = output - before - predicted
        norm = 0.0
        for e in range(count):
            norm += on[cells[e]] * changes[e] / areas[e]
        if norm > 0.0:
            gain = step * error / (norm + regularisation)
            for e in range(count):
                c = cells[e]
                # A cell may be listed more than once.
                density[c] = max(0.0, density[c] + gain * on[c] / areas[e])
                on[c] = 0.0
    table = np.zeros((order, order, 4))
    below = np.empty(order + 1)
    mass = _tabulate(levels, density, table, below)
    offset = bias - mass
    found = _evaluate(here, (levels, inverse_step, table), below, offset, terms, start)[0]
    if not np.isnan(output):
        bias += bias_step * (output - found)
    offset = bias - mass
    minus = offset + _reversible_value(terms, levels[0])
    plus = offset + 2.0 * mass + _reversible_value(terms, levels[-1])
    return density, table, below, bias, offset, minus, plus, error
