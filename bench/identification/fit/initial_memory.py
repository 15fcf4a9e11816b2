"""Estimation of the memory before the first sample, for Preisach models with a nonnegative density.

Each cell that is swept later on but whose start is unknown gets two nonnegative coefficients instead of one: the
density of the relays that were on and that of those that were off. The on-fraction then is free between 0 and 1 and
the problem stays linear. The staircase that agrees best with these fractions is the initial memory.
"""

from __future__ import annotations

import numpy as np

from bench.base import Floats
from bench.identification.fit.cell_layout import CellLayout, Indices
from bench.identification.fit.least_squares import fit_cells
from bench.models import MemoryCurve, Preisach, Regressor, swept_cells


def estimate_memory(
    template: Preisach, inputs: Floats, outputs: Floats, weights: Floats, skip: int, smoothing: float
) -> MemoryCurve:
    """Return the initial memory that the outputs suggest."""
    low, high = template.input_range
    off = template.regressor(inputs, MemoryCurve((), low, -1))
    on = template.regressor(inputs, MemoryCurve((), high, 1))
    count = off.base.size
    # The first input tells all relays but those around it: α above and β below.
    rows_of, columns_of = np.tril_indices(template.order)
    around = (template.levels[rows_of + 1] > inputs[0]) & (template.levels[columns_of] < inputs[0])
    unknown = np.flatnonzero(around & (swept_cells(off) | swept_cells(on)))
    place = np.full(count, -1)
    place[unknown] = count + np.arange(unknown.size)
    rows = np.concatenate([_rows(off), _rows(on)])
    cells = np.concatenate([off.cells, place[on.cells]])
    changes = np.concatenate([off.changes, on.changes])
    kept = cells >= 0
    order = np.argsort(rows[kept], kind="stable")
    both = Regressor(
        base=np.concatenate([off.base, on.base[unknown]]),
        starts=np.searchsorted(rows[kept][order], np.arange(inputs.size + 1)),
        cells=cells[kept][order].astype(np.int32),
        changes=changes[kept][order],
        extra=off.extra,
    )
    layout = CellLayout(
        template.order,
        np.concatenate([np.arange(count), unknown]),
        np.repeat([0, 1], [count, unknown.size]),
    )
    signs = np.ones(both.shape[1], dtype=bool)
    signs[both.base.size :] = template.nonnegative()[count:]
    x = fit_cells(layout, both, outputs, signs, weights, skip, smoothing).coefficients
    # How much more mass was on than off: the staircase should take in what is positive.
    balance = np.zeros(count)
    balance[unknown] = (x[count : count + unknown.size] - x[unknown]) * template.cell_areas()[unknown]
    return _staircase(template, balance, float(inputs[0]))


def _rows(regressor: Regressor) -> Indices:
    """Return the row of each sparse entry."""
    return np.repeat(np.arange(regressor.shape[0]), np.diff(regressor.starts))


def _staircase(template: Preisach, balance: Floats, present: float) -> MemoryCurve:
    """Return the memory at input `present` whose on-region has the greatest sum of `balance`, to whole cells."""
    levels, order = template.levels, template.order
    low = template.input_range[0]
    memory = MemoryCurve((), min(low, present), -1)
    k = int(np.searchsorted(levels, present, side="right")) - 1
    if not 0 <= k < order:
        return memory.step(present)
    plane = np.zeros((order, order))
    plane[np.tril_indices(order)] = balance
    # worth[j, h]: column j on up to level k + h; the staircase must not rise from one column to the next.
    worth = np.zeros((k + 1, order - k + 1))
    np.cumsum(plane[k:, : k + 1].T, axis=1, out=worth[:, 1:])
    best = np.empty_like(worth)
    best[0] = worth[0]
    for j in range(1, k + 1):
        best[j] = worth[j] + np.maximum.accumulate(best[j - 1][::-1])[::-1]
    heights = [int(np.argmax(best[k]))]
    for j in range(k - 1, -1, -1):
        heights.append(heights[-1] + int(np.argmax(best[j, heights[-1] :])))
    heights.reverse()
    for j, height in enumerate(heights):
        if j and height < heights[j - 1]:
            memory = memory.step(float(levels[j]))
        if height and (not j or height < heights[j - 1]):
            memory = memory.step(float(levels[k + height]))
    return memory.step(present)
