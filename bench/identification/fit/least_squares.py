"""Least squares with sign constraints on a sparse regressor, with a certificate of optimality."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import DeferredModule, Floats, checks as _checks
from bench.identification.fit.cell_layout import CellLayout, Flags, Indices
from bench.identification.fit.cholesky_factor import DEPENDENT, CholeskyFactor, estimated_norm
from bench.identification.fit.collapse import LONG, collapse
from bench.identification.fit.fit_progress import say_fit_progress
from bench.identification.fit.scaled_columns import ScaledColumns, changing, mean_square, unit_of_penalties
from bench.models import Regressor

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from bench.identification.kernels import constrained_fit_kernels as _kernels
    from bench.models import memory_kernels as lists
else:
    lists = DeferredModule("bench.models.kernels.memory_kernels")
    _kernels = DeferredModule("bench.identification.kernels.constrained_fit_kernels")

# Part of the norm of the outputs up to which a gradient counts as 0. Derivation: the rounding of a sum of thousands
# of products of numbers of 16 digits.
_TOLERANCE = 1e-12
# The same, up to which a fit has converged. Derivation: its square times that of the condition is left to gain at
# most, with a condition of 1e4 a part of 1e-8 of the outputs' square.
_CONVERGED = 1e-8
# A part of the cost that is no gain but for rounding. Derivation: that of a sum of thousands of squares.
_ROUNDED = 1e-12
# A gradient that is zero but for rounding. Derivation: ten times the tolerance, so that what a solution leaves is no
# reason to go on.
_LEVEL = 1e-11
# Columns enter together if their gradient is at least this part of the greatest. Derivation: of independent columns
# one lowers the cost by the square of its gradient, here a sixteenth of what the best does.
_ENTRY = 0.25
# ... and with a penalty, which tells neighbours apart, at least this part of that. Derivation: a twenty-fifth.
_KEEN = 0.2
# A smooth fit of at least this order starts from one of half the order. Source: a choice; it decides time only, as
# the optimum does not depend on the start.
_COARSEST = 24
# More columns than these start from so many rounds of so many steps of conjugate gradients. Source: a choice; they
# decide time only.
_MANY, _ROUNDS, _STEPS = 1000, 4, 50


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
        Number of coefficients that are free to move, and held at zero. For a minimum-norm solution the dimensions
        of the range and of the null space.
    exchangeable : int
        Number of coefficients held at zero that could replace others without changing the fit: the minimiser is
        not unique if there are any. For a minimum-norm solution the swept columns above the rank.
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
    effective : float
        Number of coefficients that the data determine, without the bias: the rank of the passive columns, less what
        smoothness determines of them; nan if it is not known.
    """

    kkt_residual: float
    passive: int
    active: int
    exchangeable: int
    condition: float
    swept: Flags
    iterations: int
    converged: bool
    effective: float = float("nan")

    @property
    def determined(self) -> float:
        """Number of coefficients that the data determine; of those that are free to move where it is not known."""
        return self.effective if np.isfinite(self.effective) else float(self.passive)

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
        coefficients held at zero, NaN where there are no degrees of freedom or many solutions of which one is taken.
        With smoothing they are the square roots of the diagonal of variance * (RᵀWR + penalty)⁻¹ on the passive
        set: what is left of the uncertainty if the penalty is taken as prior knowledge (Bayesian posterior), so
        they contain the smoothing's bias as far as the density is as smooth as the weight says. The variance
        is the residual sum over (samples - effective coefficients - 1).
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
    ridge: float = 0.0,
    start: Floats | None = None,
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
        the density on the plane|². Cells never swept then follow their neighbours. The fit starts from that on
        a plane of half the order. See `cross_validate` for a choice of the weight.
    ridge : float
        Weight >= 0 of a penalty on the size: ridge * (mean squared column norm) * |density|².
    start : ndarray, shape (K,), or None
        Coefficients of the sparse columns to start from where there is a penalty, such as those for other weights.
        They decide the time only.

    Raises
    ------
    ValueError
        If a length does not fit, a number is not finite, a weight is negative, or nothing is left to fit.
    """
    layout = CellLayout.of(regressor.base.size)
    return fit_cells(layout, regressor, outputs, nonnegative, weights, skip, smoothing, ridge, start)


def fit_cells(
    layout: CellLayout,
    regressor: Regressor,
    outputs: ArrayLike,
    nonnegative: ArrayLike = True,
    weights: ArrayLike | None = None,
    skip: int = 0,
    smoothing: float = 0.0,
    ridge: float = 0.0,
    start: Floats | None = None,
) -> Fit:
    """Return what `fit` does, for sparse columns whose places in the plane `layout` gives."""
    y, w = _cost(regressor, outputs, weights, skip)
    constrained = np.broadcast_to(np.asarray(nonnegative, dtype=bool), (regressor.shape[1],))
    check_penalties(smoothing, ridge)
    samples, left = int(np.count_nonzero(w)), 0.0
    if y.size >= LONG and (short := collapse(regressor, y, w)) is not None:
        regressor, y, w, left = short.regressor, short.outputs, short.weights, short.left
    unit = unit_of_penalties(regressor, w) if smoothing or ridge else 1.0
    with one_thread():
        state = _ActiveSet(regressor, y, w, constrained, layout, smoothing * unit, ridge * unit, start=start)
        state.minimise()
        return state.result(samples, left)


def fit_minimum_norm(
    regressor: Regressor, outputs: ArrayLike, *, weights: ArrayLike | None = None, skip: int = 0
) -> Fit:
    """Return bias b and the least-norm x that minimise the sum of weight * (outputs - b - R x)².

    No sign constraint. The regressor is formed densely: 8 N (K + q) bytes.

    Parameters
    ----------
    regressor, outputs, weights, skip
        As in `fit`.

    Raises
    ------
    ValueError
        As `fit`.
    """
    from scipy.linalg import lstsq, qr, solve_triangular

    y, w = _cost(regressor, outputs, weights, skip)
    matrix = regressor.dense()[skip:]
    root = np.sqrt(w[skip:])
    means = w[skip:] @ matrix / w.sum()
    swept = np.ptp(matrix, axis=0) > 1e-12 * np.maximum(np.abs(matrix).max(axis=0), 1e-300)
    matrix -= means
    matrix *= root[:, None]
    mean = float(w @ y / w.sum())
    target = root * (y[skip:] - mean)
    with one_thread():
        # Sums of row differences carry rounding errors that must not count as rank.
        cutoff = max(matrix.shape) * np.finfo(np.float64).eps
        x, _, rank, singular = lstsq(matrix, target, cond=cutoff, lapack_driver="gelsd")
        residual = target - matrix @ x
        slope = matrix.T @ residual
        uncertainties = np.full(x.size, np.nan)
        spare = np.count_nonzero(w) - 1.0 - rank
        # Of a lower rank there are other coefficients that fit as well.
        if spare > 0.5 and rank == np.count_nonzero(swept):
            (corner,) = qr(matrix[:, swept], mode="r")
            inverse = solve_triangular(corner[:rank], np.eye(rank))
            uncertainties[swept] = np.linalg.norm(residual) / np.sqrt(spare) * np.linalg.norm(inverse, axis=1)
    norms = np.linalg.norm(matrix, axis=0)
    scale = np.maximum(norms, 1e-12 * norms.max(initial=1e-300)) * max(float(np.linalg.norm(target)), 1e-300)
    kkt = float(np.abs(slope / scale)[swept].max(initial=0.0))
    certificate = Certificate(
        kkt_residual=kkt,
        passive=int(rank),
        active=x.size - int(rank),
        exchangeable=max(int(swept.sum()) - int(rank), 0),
        condition=float(singular[0] / singular[rank - 1]) if rank else 1.0,
        swept=swept,
        iterations=1,
        converged=kkt <= _CONVERGED,
        effective=float(rank),
    )
    return Fit(x, mean - float(means @ x), uncertainties, certificate)


def check_penalties(smoothing: float, ridge: float) -> None:
    """Raise ValueError if a weight is negative or not finite."""
    for name, weight in (("smoothing", smoothing), ("ridge", ridge)):
        if not weight >= 0.0 or not np.isfinite(weight):
            raise ValueError(f"{name}: expected a finite number >= 0, got {weight}")


def _cost(regressor: Regressor, outputs: ArrayLike, weights: ArrayLike | None, skip: int) -> tuple[Floats, Floats]:
    """Return checked outputs and weights, zero for the samples to skip."""
    count = regressor.shape[0]
    y = _checks.samples("outputs", outputs)
    if y.size != count:
        raise ValueError(f"outputs: expected {count} values, one for each input, got {y.size}")
    return y, counted_weights(count, weights, skip)


def counted_weights(count: int, weights: ArrayLike | None, skip: int) -> Floats:
    """Return the checked weights, shape (count,), zero for the samples to skip; errors as `fit`."""
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
    return w


@cache
def _blas() -> Any:  # noqa: ANN401
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

    return ThreadpoolController()


def one_thread() -> Any:  # noqa: ANN401
    """Return a context in which BLAS uses one thread: its short vectors gain nothing from more."""
    import scipy.linalg  # noqa: F401 - the controller sees only libraries already loaded

    return _blas().limit(limits=1, user_api="blas")


class _ActiveSet:
    """The working state of one constrained fit, in centred and scaled columns.

    With A the centred, weighted columns scaled to unit norm, t the centred outputs and λL the roughness penalty, the
    cost is |A x - t|² + λ x'Lx, x >= 0 where constrained. Its negative half-gradient is g = A'(t - A x) - λ L x, and
    optimality (Karush-Kuhn-Tucker) means g = 0 on the passive columns P, g <= 0 on those held at zero.

    1. Start with P = the free columns; with a penalty also the `promising` ones: those of a plane of half the order,
       of many of them those that some steps of conjugate gradients leave positive (`approach`).
    2. `refine` the passive coefficients by the true residual and compute g; stop if g is within the tolerance.
    3. Choose the `candidates`: columns with g > 0 near the greatest, of neighbours in the plane only the `crests`.
       If only columns are left that were found dependent on P (`barred`), lower the threshold of dependence.
    4. Let the candidates `enter` the Cholesky factor LL' = G[P, P] of the Gram matrix G = A'A + λL; a column whose
       pivot falls below the threshold is dependent and is barred.
    5. `settle`: solve LL' x = (A't)[P]. While constrained coefficients come out negative, they `leave` P, all at
       once while that raises the `gain` (`bold`), otherwise as far as the step to the first zero allows.
    6. Go to 2. The factor is updated by appended columns and by rotations. Gram entries are formed where they are
       needed: to keep and gather them would take as long, and more memory than the factor.
    """

    def __init__(
        self,
        regressor: Regressor,
        y: Floats,
        w: Floats,
        constrained: Flags,
        layout: CellLayout,
        smoothing: float,
        ridge: float,
        parents: Indices | None = None,
        start: Floats | None = None,
    ) -> None:
        self.regressor, self.y, self.w, self.constrained, self.layout = regressor, y, w, constrained, layout
        self.smoothing, self.ridge, self.parents = smoothing, ridge, parents
        # Before the columns, which then take its place: the memory of both would count.
        coarser = smoothing + ridge > 0.0 and constrained.any() and layout.order >= _COARSEST
        self.start = start if start is not None else self.coarse_densities() if coarser else None
        if parents is not None:
            regressor = regressor.merged(parents, layout.cells.size)
        self.cells = regressor.base.size
        count = regressor.shape[1]
        changes = lists.by_column(regressor.starts, regressor.cells, regressor.changes, self.cells)
        remaining = w[::-1].cumsum()[::-1].copy()
        total = float(remaining[0])
        cell_means, cell_norms = _kernels.moments(changes, regressor.base, remaining)
        extra = regressor.extra
        self.means = np.concatenate([cell_means, w @ extra / total])
        centred = extra - self.means[self.cells :]
        norms = np.concatenate([cell_norms, np.sqrt(w @ centred**2)])
        scale = np.concatenate([np.abs(regressor.base), np.abs(extra).max(axis=0, initial=0.0)])
        self.swept: Flags = changing(norms, scale, total)
        unit = mean_square(cell_norms[self.swept[: self.cells]])
        self.norms = np.where(self.swept, norms, np.sqrt(unit))
        self.usable = self.swept.copy()
        penalty: csr_array | None = None
        rough = smoothing > 0.0 and layout.order > 0
        if rough or (ridge > 0.0 and self.cells):
            from scipy.sparse import csr_array, eye_array

            penalty = smoothing * layout.roughness if rough else csr_array((self.cells, self.cells))
            if rough:
                self.usable[: self.cells] |= layout.layers == 0
            if self.ridge > 0.0:
                penalty = csr_array(penalty + ridge * eye_array(self.cells))
            scale = 1.0 / self.norms[: self.cells]
            # In place: copies of it would count in the memory of a large fit.
            penalty.data *= np.repeat(scale, np.diff(penalty.indptr))
            penalty.data *= scale[penalty.indices]
        self.columns = ScaledColumns(
            changes=changes,
            base=regressor.base,
            means=cell_means,
            norms=self.norms,
            extra=np.ascontiguousarray(centred / self.norms[self.cells :]),
            weights=w,
            total=total,
            penalty=penalty,
        )

        self.mean = float(w @ y / total)
        self.centred = y - self.mean
        self.size = float(np.sqrt(w @ self.centred**2))
        self.right = self.products(self.centred)
        # What the products of a column with the outputs are, they are with another column.
        self.extra_gram = np.array([self.products(each) for each in np.ascontiguousarray(self.columns.extra.T)])
        self.x = np.zeros(count)
        self.factor = CholeskyFactor()
        # The cache holds that of few samples.
        self.tails = np.zeros(y.size * (32 if y.size <= LONG else 8))
        self.passive = np.empty(0, dtype=np.int64)
        self.iterations = 0

    def products(self, residual: Floats) -> Floats:
        """Return the scaled columns' products with the weighted residual."""
        result = self.columns.products(residual)
        result[~self.usable] = 0.0
        return result

    def residual(self) -> Floats:
        return self.centred - self.columns.model(self.x)

    def slope(self) -> Floats:
        """Return the negative gradient of half the cost."""
        g = self.products(self.residual())
        if self.columns.penalty is not None:
            g[: self.cells] -= self.columns.penalty @ self.x[: self.cells]
        return g

    def gram(self, new: Indices, before: Indices) -> Floats:
        """Return the Gram entries of columns with those before them, and the lower half of those with each other.

        Shape (new, before + new).
        """
        known = np.concatenate([before, new])
        result = np.zeros((new.size, known.size))
        width = min(-(-new.size // 8) * 8, self.tails.size // self.w.size)
        _kernels.gram_rows(
            self.columns.changes,
            self.columns.base,
            self.columns.means,
            self.norms[: self.cells],
            self.w,
            new,
            known,
            self.tails[: self.w.size * width].reshape(self.w.size, width),
            result,
        )
        if self.extra_gram.size:
            for one, other, part in ((new, known, result), (known, new, result.T)):
                dense = np.flatnonzero(one >= self.cells)
                part[dense] = self.extra_gram[one[dense] - self.cells][:, other]
        if self.columns.penalty is not None:
            inside = np.flatnonzero(new < self.cells)
            rough = self.columns.penalty[new[inside]].tocoo()
            place = np.full(self.x.size, -1)
            place[known] = np.arange(known.size)
            places = place[rough.col]
            seen = places >= 0
            result[inside[rough.row[seen]], places[seen]] += rough.data[seen]
        return result

    def enter(self, columns: Indices) -> Indices:
        """Add columns to the passive set; return those left out because they depend on it."""
        if not columns.size:
            return columns
        self.iterations += 1
        self.factor.reserve(self.passive.size + columns.size)
        barred = [np.empty(0, dtype=np.int64)]
        while columns.size:
            room = self.factor.room
            some, columns = columns[:room], columns[room:]
            rows = self.gram(some, self.passive)
            good = self.factor.append(rows, self.right[some])
            self.passive = np.concatenate([self.passive, some[good]])
            barred.append(some[~good])
        left = np.concatenate(barred)
        self.x[left] = 0.0
        return left

    def leave(self, gone: Flags) -> Indices:
        """Take columns out of the passive set; return those that turn out dependent on the way."""
        places = np.flatnonzero(gone)
        size, first = self.passive.size, int(places[0])
        self.iterations += 1
        # In ns: of a rotated row element, of a product of two changes, and of an operation of the factorisation.
        rotations = 0.6 * float(((size - places) ** 2).sum())
        rest, starts, cells = size - places.size, self.columns.changes[0], self.passive[self.passive < self.cells]
        changes = float((starts[cells + 1] - starts[cells]).sum()) / size
        if rotations <= 0.17 * changes * (rest**2 - first**2) + 0.01 * (rest**3 - first**3):
            self.factor.delete(places)
            self.passive = self.passive[~gone]
            return np.empty(0, dtype=np.int64)
        if first < size // 8:
            first = 0
        again = self.passive[first:][~gone[first:]]
        if self.columns.penalty is not None:
            # What is small is at an edge, and the next to leave: cheaply, if it is among the last.
            again = again[np.argsort(-self.x[again], kind="stable")]
        self.passive = self.passive[:first]
        self.factor.truncate(first)
        return self.enter(again)

    def settle(self, bold: bool) -> Indices:
        """Minimise over the passive set, shrinking it until the signs hold; return what turned out dependent.

        If bold, all that turns negative leaves at once, whether or not that lowers the cost.
        """
        barred = [np.empty(0, dtype=np.int64)]
        # What the passive coefficients lower the cost by: at first they are the best of those that are not zero.
        lowered = self.gain()
        while True:
            passive = self.passive
            old = self.x[passive]
            signed = self.constrained[passive]
            new = self.factor.solution()
            negative = signed & (new <= 0.0)
            if not negative.any():
                self.x[passive] = new
                return np.concatenate(barred)
            # Cutting off all negative parts at once is allowed if that lowers the cost ...
            moved, leave = np.where(negative, 0.0, new), negative
            if not bold:
                most = float(self.right[passive] @ new)
                places = np.flatnonzero(negative)
                after = most - self.factor.length(places, new[places]) ** 2
                if after <= lowered + _ROUNDED * most:
                    # ... otherwise go as far as the first one allows.
                    reach = np.where(negative, old / np.maximum(old - new, 1e-300), np.inf)
                    step = float(reach.min())
                    moved = old + step * (new - old)
                    leave = negative & (reach <= step * (1.0 + 1e-12))
                    moved[leave] = 0.0
                    after = most - (1.0 - step) ** 2 * (most - lowered)
                lowered = after
            self.x[passive] = moved
            barred.append(self.leave(leave))

    def minimise(self) -> None:
        """Find the passive set and the coefficients."""
        free = np.flatnonzero(~self.constrained & self.usable)
        first = np.concatenate([free[free >= self.cells], free[free < self.cells]])
        if self.columns.penalty is not None:
            first = np.concatenate([first, self.promising()])
        barred = np.zeros(self.x.size, dtype=bool)
        tolerance = _TOLERANCE * self.size
        if first.size:
            barred[self.enter(first)] = True
            barred[self.settle(bold=True)] = True
        bold, gain = True, self.gain()
        stricter = iter(DEPENDENT[1:])
        for _ in range(100 + 3 * self.x.size):
            g = self.refine()
            g[self.passive] = 0.0
            g[~self.constrained] = 0.0
            if g.max(initial=0.0) <= tolerance:
                break
            say_fit_progress(float(g.max()) / self.size)
            if g[~barred].max(initial=0.0) <= tolerance:
                threshold = next(stricter, None)
                if threshold is None:
                    break
                self.factor.threshold = threshold
                barred[:] = False
            g[barred] = 0.0
            top = float(g.max())
            entering = self.candidates(g, max(_ENTRY * top, tolerance))
            room = max(10, self.passive.size // 3)
            if entering.size > room:
                entering = entering[np.argpartition(-g[entering], room)[:room]]
            dependent = self.enter(entering)
            entered = self.passive.size
            dependent = np.concatenate([dependent, self.settle(bold)])
            bold, gain = bold and self.gain() > gain, self.gain()
            # A column depends on a certain passive set only.
            if self.passive.size < entered:
                barred[:] = False
            barred[dependent] = True

    def gain(self) -> float:
        """Return by how much the settled passive set lowers the cost, doubled."""
        return float(self.right[self.passive] @ self.x[self.passive])

    def candidates(self, g: Floats, threshold: float) -> Indices:
        """Return the columns to enter next."""
        dense = np.flatnonzero(g[self.cells :] >= threshold) + self.cells
        if self.columns.penalty is not None:
            return np.concatenate([dense, np.flatnonzero(g[: self.cells] >= _KEEN * threshold)])
        return np.concatenate([dense, self.layout.crests(g[: self.cells], threshold)])

    def promising(self) -> Indices:
        """Return the constrained columns that are likely to be passive in a smooth solution, and set their values."""
        chosen = self.constrained & self.usable
        if self.start is None:
            return np.flatnonzero(chosen)
        chosen[: self.cells] &= self.start > 0.0
        self.x[: self.cells] = np.where(chosen[: self.cells], np.maximum(self.start, 0.0), 0.0)
        self.x *= self.norms
        found = np.flatnonzero(chosen)
        if found.size > _MANY:
            for _ in range(_ROUNDS):
                self.approach()
            found = np.flatnonzero(self.constrained & self.usable & (self.x > 0.0))
            # What is small is the next to leave: cheaply, if it is among the last.
            found = found[np.argsort(-self.x[found], kind="stable")]
        return found

    def coarse_densities(self) -> Floats:
        """Return the density in each cell by the solution on a plane of half the order, whose cost is that of it."""
        layout, merged = self.layout.coarser()
        count = layout.cells.size
        constrained = np.append(np.ones(count, dtype=bool), self.constrained[merged.size :])
        constrained[merged[~self.constrained[: merged.size]]] = False
        # A Laplacian of twice the step is four times as great, on a quarter of the cells.
        weights = 0.25 * self.smoothing, 4.0 * self.ridge
        # Of the columns as they were: those between would stay in memory.
        parents = merged if self.parents is None else merged[self.parents]
        coarse = _ActiveSet(self.regressor, self.y, self.w, constrained, layout, *weights, parents)
        coarse.minimise()
        return np.asarray((coarse.x / coarse.norms)[merged])

    def approach(self) -> None:
        """Lower the cost by conjugate gradients over the columns likely to be passive; cut what turns negative."""
        g = self.slope()
        least = _ENTRY * _KEEN * g.max(initial=0.0)
        chosen = np.flatnonzero(self.usable & (~self.constrained | (self.x > 0.0) | (g > least)))
        part = self.columns.chosen(chosen)
        x, r = self.x[chosen], g[chosen]
        direction, square = r, float(r @ r)
        for _ in range(_STEPS):
            change = part.gram_product(direction)
            curvature = float(direction @ change)
            if curvature <= 0.0:
                break
            length = square / curvature
            x += length * direction
            r = r - length * change
            before, square = square, float(r @ r)
            direction = r + (square / before) * direction
        self.x[chosen] = np.where(self.constrained[chosen], np.maximum(x, 0.0), x)

    def refine(self) -> Floats:
        """Correct the passive coefficients by the true residual; return the slope."""
        passive = self.passive
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

    def variances(self) -> tuple[Floats, float]:
        """Return the inverse Gram block's diagonal and the effective number of columns; this uses up the factor."""
        passive, penalty = self.passive, self.columns.penalty
        self.factor.invert()
        diagonal = self.factor.inverse_diagonal()
        if penalty is None or not passive.size:
            return diagonal, float(passive.size)
        inside = np.flatnonzero(passive < self.cells)
        block = penalty[passive[inside]][:, passive[inside]].tocoo()
        below = block.col < block.row
        inverse = self.factor.inverse_entries(inside[block.col[below]], inside[block.row[below]])
        # What smoothness determines the data do not.
        smooth = float(block.diagonal() @ diagonal[inside]) + 2.0 * float(block.data[below] @ inverse)
        return diagonal, passive.size - smooth

    def gram_product(self, values: Floats) -> Floats:
        """Return the product of the passive Gram block with values."""
        x = np.zeros(self.x.size)
        x[self.passive] = values
        return self.columns.gram_product(x)[self.passive]

    def result(self, samples: int, left: float) -> Fit:
        """Return the solution, of so many samples, with so much left of the outputs beside the residual sum."""
        passive = self.passive
        g = self.slope()
        held = np.ones(self.x.size, dtype=bool)
        held[passive] = False
        violation = np.where(held & self.constrained, np.maximum(g, 0.0), np.abs(g))
        kkt = float(violation.max(initial=0.0)) / (self.size or 1.0)
        coefficients = self.x / self.norms
        uncertainties = np.full(self.x.size, np.nan)
        condition = self.factor.condition(estimated_norm(self.gram_product, passive.size))
        variances, effective = self.variances()
        spare = samples - 1.0 - effective
        if spare > 0.5:
            variance = (float(self.w @ self.residual() ** 2) + left) / spare
            uncertainties[:] = 0.0
            uncertainties[passive] = np.sqrt(variance * variances) / self.norms[passive]
        certificate = Certificate(
            kkt_residual=kkt,
            passive=passive.size,
            active=self.x.size - passive.size,
            # A column that could enter without a gain depends on the passive ones, all of which can give way.
            exchangeable=int(np.count_nonzero(held & self.usable & (np.abs(g) <= _LEVEL * self.size))),
            condition=condition,
            swept=self.swept,
            iterations=self.iterations,
            converged=kkt <= _CONVERGED,
            effective=effective,
        )
        return Fit(coefficients, self.mean - float(self.means @ coefficients), uncertainties, certificate)
