"""Least squares with sign constraints on a sparse regressor, with a certificate of optimality."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.hysteresis import Regressor, _checks
from bench.hysteresis._checks import Floats

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

# A column whose squared distance from the span of the passive ones falls below this part of its squared norm
# counts as dependent on them: Cholesky pivots carry rounding errors of about 1e-13. Only if such columns are
# all that is left to enter, the threshold is lowered step by step.
_DEPENDENT = (1e-12, 1e-13, 1e-14)
_TOLERANCE = 1e-12
# Columns enter together if their gradient is at least this part of the greatest.
_ENTRY = 0.5


@dataclass(frozen=True, eq=False)
class Certificate:
    """Evidence about a fit.

    Parameters
    ----------
    kkt_residual : float
        Violation of the optimality (Karush-Kuhn-Tucker) conditions. With each column and the outputs centred
        by their weighted means, columns scaled to unit weighted norm, and g the negative gradient of half the
        cost in those units: max(|g| over passive and free columns, max(g, 0) over active ones), divided by
        the weighted norm of the centred outputs. 0 is exact optimality; for a minimum-norm solution |g| over
        all columns.
    passive, active : int
        Number of coefficients that are free to move, and held at zero.
    condition : float
        Estimated condition number of the scaled passive columns (for a minimum-norm fit: of the range kept).
    swept : ndarray of bool, shape (K + q,)
        Columns that changed within the samples used. A column never swept cannot be identified; it is left at
        zero unless smoothing determines it.
    iterations : int
        Number of factorisations.
    converged : bool
        Whether the conditions hold to the solver's tolerance. False if only columns too dependent on the
        passive ones were left to enter.
    """

    kkt_residual: float
    passive: int
    active: int
    condition: float
    swept: Flags
    iterations: int
    converged: bool

    @property
    def coverage(self) -> float:
        """Part of the columns that the excitation swept, 0 to 1."""
        return float(self.swept.mean())


@dataclass(frozen=True, eq=False)
class Fit:
    """Coefficients of a linear model, and how good they are.

    Parameters
    ----------
    coefficients : ndarray, shape (K + q,)
        In the units of the model.
    bias : float
        Output units.
    uncertainties : ndarray, shape (K + q,)
        Standard uncertainties from the residual variance with the passive set taken as known; 0 for
        coefficients held at zero, NaN where there are no degrees of freedom or smoothing or a minimum norm
        makes the estimate biased.
    certificate : Certificate
        Evidence of optimality, conditioning and coverage.
    """

    coefficients: Floats
    bias: float
    uncertainties: Floats
    certificate: Certificate


def fit(
    regressor: Regressor,
    outputs: ArrayLike,
    *,
    nonnegative: ArrayLike = True,
    weights: ArrayLike | None = None,
    skip: int = 0,
    smoothing: float = 0.0,
) -> Fit:
    """Return bias b and coefficients x that minimise the sum of weight * (outputs - b - R x)².

    A block active-set method after Lawson and Hanson: several columns enter at a time, the passive set is
    solved by Cholesky on its Gram matrix, whose entries are formed from the row differences, so that the
    number of samples stays out of the dense work. BLAS runs in one thread.

    Parameters
    ----------
    regressor : Regressor
        R, shape (N, K + q).
    outputs : array_like, shape (N,)
        Measured outputs.
    nonnegative : bool or array_like of bool, shape (K + q,)
        Which coefficients must not be negative; the others are free.
    weights : array_like, shape (N,), or None
        Weight per sample, >= 0 (inverse variance, say); default 1.
    skip : int
        Number of first samples left out of the cost; they still drive the memory.
    smoothing : float
        Weight >= 0 of a roughness penalty: smoothing * (mean squared column norm) * |discrete Laplacian of
        the density on the plane|². Every cell then counts, so keep to M of some tens.

    Returns
    -------
    Fit
        Solution with certificate.

    Raises
    ------
    ValueError
        If a length does not fit, a number is not finite, a weight is negative, or nothing is left to fit.
    """
    y, w = _cost(regressor, outputs, weights, skip)
    constrained = np.broadcast_to(np.asarray(nonnegative, dtype=bool), (regressor.shape[1],))
    if not smoothing >= 0.0 or not np.isfinite(smoothing):
        raise ValueError(f"smoothing: expected a finite number >= 0, got {smoothing}")
    with _one_thread():
        return _ActiveSet(regressor, y, w, constrained, smoothing).solve()


def fit_minimum_norm(
    regressor: Regressor, outputs: ArrayLike, *, weights: ArrayLike | None = None, skip: int = 0
) -> Fit:
    """Return bias b and the least-norm x that minimise the sum of weight * (outputs - b - R x)².

    No sign constraint. The regressor is formed densely: 8 N (K + q) bytes.

    Parameters
    ----------
    regressor : Regressor
        R, shape (N, K + q).
    outputs : array_like, shape (N,)
        Measured outputs.
    weights : array_like, shape (N,), or None
        Weight per sample, >= 0; default 1.
    skip : int
        Number of first samples left out of the cost; they still drive the memory.

    Returns
    -------
    Fit
        Solution with certificate.

    Raises
    ------
    ValueError
        As `fit`.
    """
    from scipy.linalg import lstsq

    y, w = _cost(regressor, outputs, weights, skip)
    matrix = regressor.dense()[skip:]
    root = np.sqrt(w[skip:])
    means = w[skip:] @ matrix / w.sum()
    swept = np.ptp(matrix, axis=0) > 1e-12 * np.maximum(np.abs(matrix).max(axis=0), 1e-300)
    matrix -= means
    matrix *= root[:, None]
    mean = float(w @ y / w.sum())
    target = root * (y[skip:] - mean)
    with _one_thread():
        # Sums of row differences carry rounding errors that must not count as rank.
        cutoff = max(matrix.shape) * np.finfo(np.float64).eps
        x, _, rank, singular = lstsq(matrix, target, cond=cutoff, lapack_driver="gelsd")
        residual = target - matrix @ x
        slope = matrix.T @ residual
    norms = np.linalg.norm(matrix, axis=0)
    scale = np.maximum(norms, 1e-12 * norms.max(initial=1e-300)) * max(float(np.linalg.norm(target)), 1e-300)
    kkt = float(np.abs(slope / scale)[swept].max(initial=0.0))
    certificate = Certificate(
        kkt_residual=kkt,
        passive=int(rank),
        active=x.size - int(rank),
        condition=float(singular[0] / singular[rank - 1]) if rank else 1.0,
        swept=swept,
        iterations=1,
        converged=kkt <= 1e-8,
    )
    return Fit(x, mean - float(means @ x), np.full(x.size, np.nan), certificate)


def _cost(regressor: Regressor, outputs: ArrayLike, weights: ArrayLike | None, skip: int) -> tuple[Floats, Floats]:
    """Return checked outputs and weights, zero for the samples to skip."""
    count = regressor.shape[0]
    y = _checks.samples("outputs", outputs)
    if y.size != count:
        raise ValueError(f"outputs: expected {count} values, one for each input, got {y.size}")
    w = np.ones(count) if weights is None else _checks.samples("weights", weights).copy()
    if w.size != count:
        raise ValueError(f"weights: expected {count} values, one for each input, got {w.size}")
    if (w < 0.0).any():
        raise ValueError("weights: expected values >= 0")
    if not 0 <= skip < count:
        raise ValueError(f"skip: expected 0 <= skip < {count}, got {skip}")
    w[:skip] = 0.0
    if w.sum() <= 0.0:
        raise ValueError("weights: expected at least one positive weight after the skipped samples")
    return y, w


@cache
def _blas() -> Any:  # noqa: ANN401
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

    return ThreadpoolController()


def _one_thread() -> Any:  # noqa: ANN401
    """Return a context in which BLAS uses one thread: its short vectors gain nothing from more."""
    import scipy.linalg  # noqa: F401 - the controller sees only libraries already loaded

    return _blas().limit(limits=1, user_api="blas")


class _Factor:
    """The Cholesky factor of the passive Gram block, redone only from the first changed column."""

    def __init__(self) -> None:
        self.lower = np.zeros((0, 0), order="F")
        self.threshold = _DEPENDENT[0]

    def refresh(self, tail: Floats, keep: int) -> int | None:
        """Factor anew from row `keep` on, given these rows of the Gram block, shape (size - keep, size).

        Return None, or the first column that depends on those before it.
        """
        from scipy.linalg.blas import dsyrk, dtrsm
        from scipy.linalg.lapack import dpotrf

        size = tail.shape[1]
        lower = np.zeros((size, size), order="F")
        lower[:keep, :keep] = self.lower[:keep, :keep]
        rest = np.asfortranarray(tail[:, keep:])
        if keep and keep < size:
            side = dtrsm(1.0, self.lower[:keep, :keep], tail[:, :keep], side=1, lower=1, trans_a=1)
            rest = dsyrk(-1.0, side, beta=1.0, c=rest, lower=1)
            lower[keep:, :keep] = side
        bad: int | None = None
        if keep < size:
            block, info = dpotrf(rest, lower=1, clean=1)
            good = size - keep if info == 0 else info - 1
            # Pivots below the threshold would pass as rounding noise.
            small = np.flatnonzero(np.diag(block)[:good] ** 2 < self.threshold * np.diag(tail, keep)[:good])
            if small.size:
                good = int(small[0])
            lower[keep : keep + good, keep : keep + good] = block[:good, :good]
            if good < size - keep:
                bad = keep + good
        self.lower = lower
        return bad

    def solve(self, right: Floats) -> Floats:
        from scipy.linalg.lapack import dpotrs

        solution, _ = dpotrs(self.lower, right, lower=1)
        return np.asarray(solution)

    def length(self, step: Floats) -> float:
        """Return the norm of a step in the outputs it causes."""
        from scipy.linalg.blas import dtrmv

        return float(np.linalg.norm(dtrmv(self.lower, step, lower=1, trans=1))) if step.size else 0.0

    def inverse_diagonal(self) -> Floats:
        from scipy.linalg.lapack import dtrtri

        inverse, _ = dtrtri(self.lower, lower=1)
        return np.asarray((inverse**2).sum(axis=0))

    def condition(self, gram: Floats) -> float:
        from scipy.linalg.lapack import dpocon

        if not gram.size:
            return 1.0
        reciprocal, _ = dpocon(self.lower, np.abs(gram).sum(axis=0).max(), uplo="L")
        return float(np.sqrt(1.0 / max(reciprocal, 1e-300)))


class _ActiveSet:
    """The working state of one constrained fit, in centred and scaled columns."""

    def __init__(self, regressor: Regressor, y: Floats, w: Floats, constrained: Flags, smoothing: float) -> None:
        from bench.hysteresis import _kernels as lists
        from bench.identification import _kernels

        self.regressor, self.y, self.w, self.constrained = regressor, y, w, constrained
        self.cells = regressor.base.size
        count = regressor.shape[1]
        self.columns = lists.by_column(regressor.starts, regressor.cells, regressor.changes, self.cells)
        remaining = w[::-1].cumsum()[::-1].copy()
        self.total = float(remaining[0])
        self.cell_means, cell_norms = _kernels.moments(*self.columns, regressor.base, remaining)
        extra = regressor.extra
        self.means = np.concatenate([self.cell_means, w @ extra / self.total])
        centred = extra - self.means[self.cells :]
        norms = np.concatenate([cell_norms, np.sqrt(w @ centred**2)])
        scale = np.concatenate([np.abs(regressor.base), np.abs(extra).max(axis=0, initial=0.0)])
        # Below this a column's variation is the rounding of its mean.
        self.swept: Flags = norms > 1e-11 * np.sqrt(self.total) * np.maximum(scale, 1e-300)
        swept_norms = cell_norms[self.swept[: self.cells]]
        mean_square = float((swept_norms**2).mean()) if swept_norms.size else 1.0
        self.norms = np.where(self.swept, norms, np.sqrt(mean_square))
        self.extra = np.ascontiguousarray(centred / self.norms[self.cells :])
        self.usable = self.swept.copy()
        self.penalty: csr_array | None = None
        if smoothing > 0.0 and self.cells:
            self.penalty = _roughness(self.cells, self.norms[: self.cells], smoothing * mean_square)
            self.usable[: self.cells] = True

        self.mean = float(w @ y / self.total)
        self.centred = y - self.mean
        self.size = float(np.sqrt(w @ self.centred**2))
        self.right = self.products(self.centred)
        self.x = np.zeros(count)
        self.known = np.empty(0, dtype=np.int64)
        self.place = np.full(count, -1, dtype=np.int64)
        self.gram = np.zeros((0, 0))
        self.factor = _Factor()
        self.factored = np.empty(0, dtype=np.int64)
        self.iterations = 0

    def products(self, residual: Floats) -> Floats:
        """Return the scaled columns' products with the weighted residual."""
        from bench.identification import _kernels

        v = self.w * residual
        v -= self.w * (v.sum() / self.total)
        result = np.empty(self.regressor.shape[1])
        result[: self.cells] = _kernels.gradient(*self.columns, v[::-1].cumsum()[::-1].copy())
        result[: self.cells] /= self.norms[: self.cells]
        result[self.cells :] = self.extra.T @ v
        result[~self.usable] = 0.0
        return result

    def residual(self) -> Floats:
        from bench.identification import _kernels

        chosen = np.flatnonzero(self.x[: self.cells])
        factors = self.x[chosen] / self.norms[chosen]
        model = _kernels.combination(
            *self.columns, self.regressor.base, self.cell_means, chosen, factors, self.y.size
        )
        return np.asarray(self.centred - model - self.extra @ self.x[self.cells :])

    def slope(self) -> Floats:
        """Return the negative gradient of half the cost."""
        g = self.products(self.residual())
        if self.penalty is not None:
            g[: self.cells] -= self.penalty @ self.x[: self.cells]
        return g

    def learn(self, columns: Indices) -> None:
        """Form the Gram entries of columns not seen before."""
        from bench.identification import _kernels

        new = columns[self.place[columns] < 0]
        if not new.size:
            return
        old = self.known.size
        self.known = np.concatenate([self.known, new])
        size = self.known.size
        self.place[new] = np.arange(old, size)
        if size > self.gram.shape[0]:
            grown = np.zeros((2 * size, 2 * size))
            grown[:old, :old] = self.gram[:old, :old]
            self.gram = grown
        rows = np.empty((new.size, size))
        _kernels.gram_rows(
            *self.columns,
            self.regressor.base,
            self.cell_means,
            self.norms[: self.cells],
            self.w,
            self.extra,
            new,
            self.known,
            rows,
        )
        if self.penalty is not None:
            r, c = np.flatnonzero(new < self.cells), np.flatnonzero(self.known < self.cells)
            rows[np.ix_(r, c)] += self.penalty[new[r]][:, self.known[c]].toarray()
        self.gram[old:size, :size] = rows
        self.gram[:size, old:size] = rows.T

    def block(self, passive: Indices, start: int = 0) -> Floats:
        """Return the passive Gram block from row `start` on."""
        at = self.place[passive]
        return np.asarray(self.gram[at[start:, None], at])

    def factorise(self, passive: Indices) -> tuple[Indices, Indices]:
        """Factor the passive block; return the set kept and the dependent columns."""
        dropped: list[int] = []
        while True:
            self.iterations += 1
            shared = min(passive.size, self.factored.size)
            differ = np.flatnonzero(passive[:shared] != self.factored[:shared])
            keep = int(differ[0]) if differ.size else shared
            bad = self.factor.refresh(self.block(passive, keep), keep)
            if bad is None:
                self.factored = passive
                return passive, np.array(dropped, dtype=np.int64)
            self.factored = passive[:bad]
            dropped.append(int(passive[bad]))
            self.x[passive[bad]] = 0.0
            passive = np.delete(passive, bad)

    def settle(self, passive: Indices) -> tuple[Indices, Indices]:
        """Minimise over the passive set, shrinking it until the signs hold; return it and what depends."""
        barred = [np.empty(0, dtype=np.int64)]
        while True:
            passive, dropped = self.factorise(passive)
            barred.append(dropped)
            old = self.x[passive]
            signed = self.constrained[passive]
            new = self.factor.solve(self.right[passive])
            negative = signed & (new <= 0.0)
            if not negative.any():
                self.x[passive] = new
                return passive, np.concatenate(barred)
            # Cutting off all negative parts at once is allowed if that lowers the cost ...
            cut = np.where(negative, 0.0, new)
            if self.factor.length(cut - new) < self.factor.length(old - new):
                moved, leave = cut, negative
            else:
                # ... otherwise go as far as the first one allows.
                reach = np.where(negative, old / np.maximum(old - new, 1e-300), np.inf)
                step = float(reach.min())
                moved = old + step * (new - old)
                leave = negative & (reach <= step * (1.0 + 1e-12))
                moved[leave] = 0.0
            self.x[passive] = moved
            passive = passive[~leave]

    def solve(self) -> Fit:
        free = np.flatnonzero(~self.constrained & self.usable)
        passive = np.concatenate([free[free >= self.cells], free[free < self.cells]])
        if self.penalty is not None:
            passive = np.concatenate([passive, np.flatnonzero(self.constrained & self.usable)])
        barred = np.zeros(self.x.size, dtype=bool)
        crests = _crests(self.cells)
        tolerance = _TOLERANCE * self.size
        if passive.size:
            self.learn(passive)
            passive, dependent = self.settle(passive)
            barred[dependent] = True
        stricter = iter(_DEPENDENT[1:])
        for _ in range(100 + 3 * self.x.size):
            g = self.refine(passive)
            g[passive] = 0.0
            g[~self.constrained] = 0.0
            if g.max(initial=0.0) <= tolerance:
                break
            if g[~barred].max(initial=0.0) <= tolerance:
                threshold = next(stricter, None)
                if threshold is None:
                    break
                self.factor.threshold = threshold
                barred[:] = False
            g[barred] = 0.0
            top = float(g.max())
            entering = crests(g, max(_ENTRY * top, tolerance))
            room = max(10, passive.size // 3)
            if entering.size > room:
                entering = entering[np.argpartition(-g[entering], room)[:room]]
            self.learn(entering)
            before = passive.size
            passive, dependent = self.settle(np.concatenate([passive, entering]))
            # A column depends on a certain passive set only.
            if passive.size + dependent.size < before + entering.size:
                barred[:] = False
            barred[dependent] = True
        return self.result(passive)

    def refine(self, passive: Indices) -> Floats:
        """Correct the passive coefficients by the true residual; return the slope."""
        g = self.slope()
        for _ in range(3):
            worst = np.abs(g[passive]).max(initial=0.0)
            if worst <= 0.1 * _TOLERANCE * self.size:
                break
            old = self.x[passive]
            corrected = old + self.factor.solve(g[passive])
            if (corrected[self.constrained[passive]] <= 0.0).any():
                break
            self.x[passive] = corrected
            better = self.slope()
            if np.abs(better[passive]).max() >= worst:
                self.x[passive] = old
                break
            g = better
        return g

    def result(self, passive: Indices) -> Fit:
        g = self.slope()
        held = self.constrained.copy()
        held[passive] = False
        violation = np.where(held, np.maximum(g, 0.0), np.abs(g))
        kkt = float(violation.max(initial=0.0)) / (self.size or 1.0)
        coefficients = self.x / self.norms
        weighted = self.w > 0.0
        spare = int(weighted.sum()) - passive.size - 1
        uncertainties = np.full(self.x.size, np.nan)
        if self.penalty is None and spare > 0:
            variance = float(self.w @ self.residual() ** 2) / spare
            uncertainties[:] = 0.0
            if passive.size:
                uncertainties[passive] = np.sqrt(variance * self.factor.inverse_diagonal())
                uncertainties[passive] /= self.norms[passive]
        certificate = Certificate(
            kkt_residual=kkt,
            passive=passive.size,
            active=self.x.size - passive.size,
            condition=self.factor.condition(self.block(passive)),
            swept=self.swept,
            iterations=self.iterations,
            converged=kkt <= 1e-10,
        )
        return Fit(coefficients, self.mean - float(self.means @ coefficients), uncertainties, certificate)


def _crests(cells: int) -> Callable[[Floats, float], Indices]:
    """Return a function that finds the columns above a threshold, of neighbouring cells only the best.

    Neighbours are nearly collinear: entering together they would only push each other out again.
    """
    order = (round((8 * cells + 1) ** 0.5) - 1) // 2
    return partial(_find_crests, order, cells, np.tril_indices(order))


def _find_crests(order: int, cells: int, lower: tuple[Indices, Indices], g: Floats, threshold: float) -> Indices:
    plane = np.full((order + 2, order + 2), -np.inf)
    rows, columns = lower
    plane[rows + 1, columns + 1] = g[:cells]
    inner = plane[1:-1, 1:-1]
    crest = inner >= threshold
    for neighbour in (plane[:-2, 1:-1], plane[2:, 1:-1], plane[1:-1, :-2], plane[1:-1, 2:]):
        crest &= inner >= neighbour
    found = np.flatnonzero(crest[rows, columns])
    return np.concatenate([np.flatnonzero(g[cells:] >= threshold) + cells, found])


def _roughness(cells: int, norms: Floats, weight: float) -> csr_array:
    """Return weight * LᵀL of the discrete Laplacian L on the triangle of cells, in scaled columns."""
    from scipy.sparse import coo_array, csr_array, diags_array

    order = (round((8 * cells + 1) ** 0.5) - 1) // 2
    rows, columns = np.tril_indices(order)
    index = np.full((order + 1, order + 1), -1, dtype=np.int64)
    index[rows, columns] = np.arange(cells)
    here: list[Indices] = []
    there: list[Indices] = []
    for i, j in ((rows + 1, columns), (rows - 1, columns), (rows, columns + 1), (rows, columns - 1)):
        other = index[i, j]
        inside = np.flatnonzero((other >= 0) & (i >= 0) & (j >= 0))
        here.append(inside)
        there.append(other[inside])
    a, b = np.concatenate(here), np.concatenate(there)
    data = np.concatenate([np.ones(a.size), -np.ones(a.size)])
    laplacian = coo_array((data, (np.concatenate([a, a]), np.concatenate([b, a]))), shape=(cells, cells))
    scaled = csr_array(laplacian) @ diags_array(1.0 / norms)
    return csr_array(weight * (scaled.T @ scaled))
