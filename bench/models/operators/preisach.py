"""The Preisach operator with piecewise constant density, exact to the partially covered cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.models.coverage import Coverage
from bench.models.density import Density
from bench.models.documents import Parts
from bench.models.memory import MemoryCurve
from bench.models.operator import Operator
from bench.models.operators.reversible import Reversible, reversible_from_json
from bench.models.regressor import Regressor
from bench.models.streams.stream import PreisachStream

if TYPE_CHECKING:
    from bench.models.inverses.inverse import Inverse, Policy


@dataclass(frozen=True)
class Lattice:
    """What the compiled loops need of an operator, computed once.

    `table[i, j]` holds, at the lower left node of cell (row i of α, column j of β), the integral of the
    density to the lower left, along the row, along the column, and the cell's density, with diagonal cells
    completed to squares; `below[k]` is what the completion added up to level k.
    """

    levels: Floats
    inverse_step: float
    table: Floats
    below: Floats
    offset: float
    breaks: Floats
    quadratics: Floats

    @property
    def plane(self) -> tuple[Floats, float, Floats]:
        """Levels, inverse step and table."""
        return self.levels, self.inverse_step, self.table

    @property
    def terms(self) -> tuple[Floats, Floats]:
        """Breaks and quadratics of the reversible part."""
        return self.breaks, self.quadratics


@dataclass(frozen=True, eq=False)
class Preisach(Operator[MemoryCurve]):
    """A weighted superposition of hysterons, plus a bias and an optional reversible part.

    output = bias + sum over cells of density * (2 on-area - area) + reversible(input): Zhang et al. 2013,
    eqs. 2, 10 and 12. The levels l_0 < ... < l_M divide the plane {l_0 <= β <= α <= l_M} into K = M(M+1)/2
    cells of constant density; diagonal cells are triangles. Beyond the plane every hysteron is saturated and
    the reversible part goes on. The non-monotonic model of Zhang et al. 2013 is the
    case `reversible=ThermalExpansion(...)`.

    Parameters
    ----------
    levels : array_like, shape (M + 1,)
        Increasing discretization levels, input units.
    density : array_like, shape (K,)
        Density per cell, output units per input unit squared, of either sign. Cell (row i of α, column j of
        β, j <= i) is at i (i + 1) / 2 + j.
    reversible : Reversible or None
        The part without memory.
    input_range : tuple of float or None
        Operating range of the input; contains the plane. Default: the plane's range.
    bias, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If levels do not increase, the density has the wrong length, a number is not finite, or the
        operating range does not contain the plane.
    """

    kind: ClassVar[str] = "preisach"
    inverse_method: ClassVar[str] = "exact"
    parts: ClassVar[Parts] = {"reversible": reversible_from_json}
    levels: Floats
    density: Floats
    bias: float = 0.0
    reversible: Reversible | None = None
    input_range: tuple[float, float] = None  # type: ignore[assignment]
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        levels = _checks.increasing("levels", self.levels)
        order = levels.size - 1
        cells = order * (order + 1) // 2
        density = _checks.counted("density", self.density, cells, f"values for {order} intervals")
        self._settle(span=(levels[0], levels[-1]), levels=levels, density=density)
        low, high = self.input_range
        if low > levels[0] or high < levels[-1]:
            raise ValueError(
                f"input_range: expected it to contain the plane [{levels[0]}, {levels[-1]}], got [{low}, {high}]"
            )

    @property
    def order(self) -> int:
        """Number of intervals M."""
        return self.levels.size - 1

    @property
    def coefficients(self) -> Floats:
        """Density, then the reversible part's coefficients, shape (K + q,)."""
        if self.reversible is None:
            return self.density
        return np.concatenate([self.density, self.reversible.coefficients])

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> Preisach:
        """Return the same operator with other coefficients, shape (K + q,), and bias.

        Raises ValueError if there are not K + q coefficients or one is not finite.
        """
        values, cells = self._coefficients(coefficients), self.density.size
        term = self.reversible
        if term is not None:
            term = term.with_coefficients(values[cells:].tolist())
        return replace(self, density=values[:cells], bias=bias, reversible=term)

    def cell_areas(self) -> Floats:
        """Return the area of each cell, shape (K,); a diagonal cell has half a square."""
        steps = np.diff(self.levels)
        areas = np.outer(steps, steps)
        areas[np.diag_indices(self.order)] *= 0.5
        return np.asarray(areas[np.tril_indices(self.order)])

    def density_matrix(self) -> Floats:
        """Return the density as matrix [row of α, column of β], shape (M, M), NaN below the diagonal."""
        matrix = np.full((self.order, self.order), np.nan)
        matrix[np.tril_indices(self.order)] = self.density
        return matrix

    @cached_property
    def lattice(self) -> Lattice:
        """The tables of prefix sums that the compiled loops read."""
        order, steps = self.order, np.diff(self.levels)
        density = np.zeros((order, order))
        density[np.tril_indices(order)] = self.density
        along_row = np.zeros((order, order + 1))
        np.cumsum(density * steps, axis=1, out=along_row[:, 1:])
        along_column = np.zeros((order + 1, order))
        np.cumsum(density * steps[:, None], axis=0, out=along_column[1:])
        corner = np.zeros((order + 1, order + 1))
        np.cumsum(along_column * steps, axis=1, out=corner[:, 1:])
        table = np.stack([corner[:order, :order], along_row[:, :order], along_column[:order], density], axis=2)
        below = np.concatenate([[0.0], np.cumsum(0.5 * np.diag(density) * steps**2)])
        if self.reversible is None:
            breaks, quadratics = np.empty(0), np.zeros((1, 3))
        else:
            breaks, quadratics = self.reversible.pieces()
        mean = (self.levels[-1] - self.levels[0]) / order
        uniform = bool(np.abs(steps - mean).max() <= 1e-9 * mean)
        return Lattice(
            levels=self.levels.copy(),
            inverse_step=1.0 / mean if uniform else 0.0,
            table=np.ascontiguousarray(table),
            below=below,
            offset=self.bias - float(self.density @ self.cell_areas()),
            breaks=breaks,
            quadratics=np.ascontiguousarray(quadratics),
        )

    def initial_state(self) -> MemoryCurve:
        """Return negative saturation: every hysteron off, the input at the low end of the operating range."""
        return MemoryCurve.from_negative_saturation(self.input_range[0])

    def saturated_state(self, direction: int, value: float | None = None) -> MemoryCurve:
        """Return the memory after saturation at the low (-1) or high (1) end; see `Operator.saturated_state`."""
        _, end = self._ends(direction)
        return MemoryCurve((), end if value is None else value, -1 if direction < 0 else 1)

    def advance(self, state: MemoryCurve, inputs: ArrayLike) -> MemoryCurve:
        """Return the memory after a sequence of inputs, shape (N,)."""
        return state.advance(inputs)

    def _pieces(self, state: MemoryCurve | None) -> tuple[Floats, Floats, float]:
        memory = self.initial_state() if state is None else state
        left, height, present = memory.staircase(float(self.levels[0]), float(self.levels[-1]))
        return np.array(left, dtype=np.float64), np.array(height, dtype=np.float64), present

    def evaluate(self, inputs: ArrayLike, state: MemoryCurve | None = None) -> Floats:
        """Return the outputs of a sequence of inputs, shape (N,), output units; see `Operator.evaluate`.

        The memory before the first sample defaults to negative saturation; `state.advance(inputs)` is that after the
        last.
        """
        return self._outputs(_checks.samples("inputs", inputs), state)

    def value(self, state: MemoryCurve) -> float:
        """Return the output of a state, in a time proportional to its corners."""
        return float(self._outputs(np.array([state.input]), state)[0])

    def _outputs(self, inputs: Floats, state: MemoryCurve | None) -> Floats:
        from bench.models.kernels import memory_kernels as _kernels

        t = self.lattice
        if not inputs.flags.writeable:
            # For arrays that are read-only, as the columns of a record, numba would compile once more.
            inputs = inputs.copy()
        return np.asarray(_kernels.evaluate(inputs, t.plane, t.below, t.offset, t.terms, self._pieces(state)))

    def step(self, state: MemoryCurve, value: float) -> tuple[MemoryCurve, float]:
        """Return memory and output after the input moved monotonically to `value`.

        Raises ValueError if `value` is not finite.
        """
        after = state.step(value)
        return after, self.value(after)

    def stream(self, state: MemoryCurve | None = None) -> PreisachStream:
        """Return the operator with a memory of its own, compiled; see `Operator.stream`."""
        return PreisachStream(self, self.initial_state() if state is None else state)

    def regressor(self, inputs: ArrayLike, state: MemoryCurve | None = None) -> Regressor:
        """Return the matrix of s = 2 on-area - area per cell, then the reversible part's columns.

        evaluate(inputs) = bias + regressor @ coefficients (Zhang et al. 2013, eqs. 10 and 12). Arguments and errors
        as `evaluate`.
        """
        from bench.models.kernels import memory_kernels as _kernels

        sequence = _checks.samples("inputs", inputs)
        t = self.lattice
        axis, start = (t.levels, t.inverse_step), self._pieces(state)

        def listed(sweep: Callable[..., int], *arguments: object) -> tuple[NDArray[np.int32], Floats]:
            count = sweep(*arguments, (np.empty(0, dtype=np.int32), np.empty(0)))
            entries = np.empty(count, dtype=np.int32), np.empty(count)
            sweep(*arguments, entries)
            return entries

        base = np.bincount(*listed(_kernels.swept_areas, axis, start), minlength=self.density.size)
        starts = np.empty(sequence.size + 1, dtype=np.int64)
        cells, changes = listed(_kernels.swept_differences, sequence, axis, start, starts)
        if self.reversible is None:
            extra = np.empty((sequence.size, 0))
        else:
            extra = np.ascontiguousarray(self.reversible.columns(sequence))
        return Regressor(base=base - self.cell_areas(), starts=starts, cells=cells, changes=changes, extra=extra)

    def output_range(self) -> tuple[float, float]:
        """Return the least and greatest output over every memory the operating range can produce.

        With a nonnegative density both are on the two major branches (Zhang et al. 2013, proposition 1).
        For a signed density the best memory curve over each input is found by dynamic programming over the
        columns. Either way each quadratic piece is tested at its ends and at its vertex.
        """
        return self._extremes

    @cached_property
    def _extremes(self) -> tuple[float, float]:
        return -self._greatest(-1.0), self._greatest(1.0)

    def _greatest(self, sign: float) -> float:
        """Return the greatest value of sign * output."""
        from bench.models.kernels import memory_kernels as _kernels

        t, order = self.lattice, self.order
        low, high = self.input_range
        steps = np.diff(self.levels)
        quadratics = sign * t.quadratics
        density = sign * t.table[:, :, 3]
        row = sign * t.table[:, :, 1]
        column = np.zeros((order + 1, order))
        np.cumsum(density * steps[:, None], axis=0, out=column[1:])
        corner = np.zeros((order + 1, order + 1))
        np.cumsum(column * steps, axis=1, out=corner[:, 1:])
        below = sign * t.below
        best = _kernels.best_staircases(np.where(np.tri(order + 1, order, -1) > 0, column, -np.inf), steps)
        full = 2.0 * (corner[order, order] - below[order])
        offset = sign * t.offset
        # (from, to, origin, constant, linear, quadratic): constant + linear x + quadratic x², x = u - origin.
        pieces: list[tuple[float, float, float, Floats, Floats, float]] = []
        nothing = np.zeros(1)
        pieces.append((low, self.levels[0], low, nothing, nothing, 0.0))
        pieces.append((self.levels[-1], high, high, np.array([full]), nothing, 0.0))
        for k in range(order):
            h, m = steps[k], density[k, k]
            settled = 2.0 * (corner[k, k] - below[k])
            # The staircase reaches above this row over the first j columns, j <= k ...
            j = np.arange(k + 1)
            gain = 2.0 * (best[j, k + 1] - corner[k + 1, j])
            constants = [settled + gain + 2.0 * h * row[k, j]]
            linears = [2.0 * (row[k, k] - row[k, j])]
            pieces.append((self.levels[k], self.levels[k + 1], self.levels[k], constants[0], linears[0], float(m)))
            # ... or over the partial column too, there up to level i > k.
            i = np.arange(k + 1, order + 1)
            constant = settled + 2.0 * (best[k, i] - corner[k + 1, k]) + 2.0 * h * row[k, k]
            linear = 2.0 * (h * m + column[i, k] - column[k + 1, k])
            pieces.append((self.levels[k], self.levels[k + 1], self.levels[k], constant, linear, float(-m)))
        greatest = -np.inf
        for start, stop, origin, constant, linear, quadratic in pieces:
            cuts = [start, *t.breaks[(t.breaks > start) & (t.breaks < stop)].tolist(), stop]
            for p, q in pairwise(cuts):
                r = int(np.searchsorted(t.breaks, 0.5 * (p + q)))
                c0, c1, c2 = quadratics[r]
                a = quadratic + c2
                b = linear + c1 + 2.0 * c2 * origin
                c = constant + c0 + origin * (c1 + origin * c2)
                points = [np.full_like(b, p - origin), np.full_like(b, q - origin)]
                if a < 0.0:
                    points.append(np.clip(-b / (2.0 * a), p - origin, q - origin))
                for x in points:
                    greatest = max(greatest, float((c + x * (b + x * a)).max()))
        return greatest + offset

    def rises(self) -> bool:
        """Return whether the output can only rise with the input, with every memory."""
        least, _ = self.reversible_slopes(np.array(self.input_range))
        return bool((self.density >= 0.0).all() and least.min() >= 0.0)

    def reversible_slopes(self, bounds: Floats) -> Floats:
        """Return the least and the greatest slope of the reversible part between increasing bounds, shape (2, N - 1).

        Bounds in input units, shape (N,); slopes in output units by input unit.
        """
        breaks, quadratics = self.lattice.breaks, self.lattice.quadratics
        points = np.unique(np.clip([*bounds, *breaks], bounds[0], bounds[-1]))
        ends = np.column_stack([points[:-1], points[1:]])
        _, linear, quadratic = quadratics[np.searchsorted(breaks, ends.mean(axis=1))].T
        slopes = linear[:, None] + 2.0 * quadratic[:, None] * ends
        first = np.searchsorted(points, bounds[:-1])
        return np.array(
            [np.minimum.reduceat(slopes.min(axis=1), first), np.maximum.reduceat(slopes.max(axis=1), first)]
        )

    def inverse(self, policy: Policy = "nearest") -> Inverse[MemoryCurve]:
        """Return the exact inverse."""
        from bench.models.inverses.falling_inverse import FallingInverse
        from bench.models.inverses.inverse import PreisachInverse

        falling = (self.density <= 0.0).all() and (self.density < 0.0).any()
        return FallingInverse(self, policy) if falling else PreisachInverse(self, policy)

    @property
    def input_units(self) -> tuple[str, ...]:
        """Those of the reversible part."""
        return () if self.reversible is None else self.reversible.input_units

    @property
    def plane(self) -> tuple[float, float]:
        """The range of the levels."""
        return float(self.levels[0]), float(self.levels[-1])

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return True for the density, and for the reversible part what it says, shape (K + q,)."""
        signs = np.ones(self.coefficients.size, dtype=bool)
        signs[self.density.size :] = self.reversible is not None and self.reversible.nonnegative
        return signs

    def shifted(self, offset: float) -> Preisach:
        """Return the operator whose output at an input u is that of this one at u + offset, input units.

        Raises ValueError if the offset is not finite.
        """
        moved = _checks.number("offset", offset)
        low, high = self.input_range
        return replace(
            self,
            levels=self.levels - moved,
            reversible=None if self.reversible is None else self.reversible.shifted(moved),
            # Not less than the plane by rounding.
            input_range=(min(low - moved, self.levels[0] - moved), max(high - moved, self.levels[-1] - moved)),
        )

    def densities(self) -> tuple[Density, ...]:
        """Return the density on its plane."""
        return (Density("", self.levels, self.density_matrix(), self.input_unit, self.output_unit),)

    def coverage(self, inputs: ArrayLike, state: MemoryCurve | None = None) -> Coverage:
        """Return which cells of the plane a sequence of inputs sweeps.

        The move to the first input does not count: nothing was measured before it. Arguments and errors as
        `evaluate`.
        """
        return Coverage.of(self.regressor(inputs, state), self.levels)

    def state_to_json(self, state: MemoryCurve) -> dict[str, Any]:
        """Return the memory curve as a JSON object."""
        return state.to_json()

    def state_from_json(self, document: Any) -> MemoryCurve:  # noqa: ANN401
        """Return the memory curve that `state_to_json` wrote; see `MemoryCurve.from_json`."""
        return MemoryCurve.from_json(document)


def uniform_levels(low: float, high: float, intervals: int) -> Floats:
    """Return `intervals` + 1 equally spaced discretization levels from low to high.

    Raises ValueError if low >= high or there is no interval.
    """
    first, last = _checks.increasing("low, high", [low, high]).tolist()
    if intervals < 1:
        raise ValueError(f"intervals: expected at least 1, got {intervals}")
    return np.linspace(first, last, intervals + 1)
