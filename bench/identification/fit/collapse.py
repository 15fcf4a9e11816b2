"""Long records collapsed to as many rows as they have information, without a change of the fit.

While the input moves on within one interval of the levels, the rows of a Preisach regressor are polynomials of its
travel, of degree 2. All that least squares takes from the samples of such a run are sums of products of polynomials:
three nodes of a Gauss quadrature with the samples as its measure give the same sums, and so the same solution but for
rounding. A plateau becomes one sample with the sum of the weights. A run with a column beside the cells that is not
such a polynomial is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.base import Floats
from bench.models import Regressor

LONG = 20_000
"""Samples from which a record is collapsed, if that makes it shorter by a factor of two. Source: a choice; it decides
time only, as a collapsed record has the same solution."""

# Part of its greatest square that may be left of a column beside the cells: rounding. Derivation: the square of some
# fifty roundings of a number, 2e-16 each.
_LEFT = 1e-28


@dataclass(frozen=True, eq=False)
class Collapsed:
    """A least-squares problem with the normal equations of a longer one."""

    regressor: Regressor  # shape (n, K + q)
    # Shape (n,); outputs and weights of its rows.
    outputs: Floats
    weights: Floats
    left: float  # weighted sum of squares of the outputs that no coefficient can reach: what its residual sum lacks


def collapse(regressor: Regressor, outputs: Floats, weights: Floats) -> Collapsed | None:
    """Return the shorter problem, or None if the record has no long runs."""
    from bench.identification.kernels import collapse_kernels as kernels

    r = regressor
    firsts, travel = kernels.find_runs(r.starts, r.cells, r.changes)
    runs = firsts.size - 1
    if 2 * runs > r.shape[0]:
        return None
    values = np.column_stack([r.extra, outputs])
    # Of the outputs all may be left.
    allowed = np.append(_LEFT * (r.extra**2).max(axis=0, initial=0.0) * weights.max(), np.inf)
    nodes, *rest, left = kernels.collapse_runs(values, weights, firsts, travel, allowed)
    kept = np.diff(firsts)[nodes < 0].sum()
    if 2 * (kept + (kernels.DEGREE + 2) * np.count_nonzero(nodes >= 0)) > r.shape[0]:
        return None
    starts, cells, changes, values, w = kernels.collapsed_rows(
        r.starts, r.cells, r.changes, values, weights, firsts, travel, (nodes, rest[0], rest[1], rest[2])
    )
    extra = np.ascontiguousarray(values[:, :-1])
    return Collapsed(
        Regressor(base=r.base, starts=starts, cells=cells, changes=changes, extra=extra),
        np.ascontiguousarray(values[:, -1]),
        w,
        float(left[-1]),
    )
