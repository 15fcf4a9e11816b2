"""What of the model's error repeats: a Preisach density on a plane finer than the model's, smooth along it.

A model of few cells has the mean density of each, and answers a reversal that is shorter than a cell as if hysterons
of every width down to none switched back. How the specimen answers shows in the few readings after each turning point
of a characterization, and what holds at one of them nearly holds at the next. So the density is taken as smooth, more
so along the diagonal, from turning point to turning point, than across it, from short reversals to long ones.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.base import Floats
from bench.identification import one_thread
from bench.models import Operator, Preisach, uniform_levels

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_LEVELS = 80
"""Least levels of the plane."""
_CENTRES = 40
"""Intervals between the nodes of the density along the diagonal."""
_WIDTHS = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 26, 34, 44, 60, 80]) / 80.0
"""Nodes of the density across the diagonal: α - β, as a share of the plane."""
_ALONG = 10.0
"""Weight of the roughness along the diagonal, against that across it."""
_SIZE = 1e-3
"""Weight of the size of the density, against its roughness."""
_PENALTIES = 10.0 ** np.arange(-7.0, 1.0)
"""Penalties that cross-validation tries, relative to the mean square of the columns."""
_EDGES = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""How many levels of either end of the plane may hold no hysterons, as cross-validation tries."""
_FOLDS = 5
_BLOCK = 40
"""Folds of the cross-validation, and rows that stay together in it if there are more than these."""


@dataclass(frozen=True, eq=False)
class Correction:
    """What is added to a model.

    Attributes
    ----------
    operator : Operator or None
        Gives what of the errors repeats; None if nothing does.
    rms : float
        Error that is left, output units.
    left : ndarray
        That error at each reading, output units; of readings that the correction was not identified from, as it
        follows others the closer, the fewer they are.
    """

    operator: Operator[Any] | None
    rms: float
    left: Floats


def identify_correction(
    model: Operator[Any], inputs: Sequence[Floats], errors: Floats, chosen: NDArray[np.bool_]
) -> Correction:
    """Identify what of the errors of a model repeats.

    Where the model is a Preisach operator, the smooth density takes the place of the model's, or is added to it;
    cross-validation decides between both, and how smooth it is.

    Parameters
    ----------
    model : Operator
        The model.
    inputs : sequence of ndarray
        What the specimen saw of the drive at the rows of each run, input units.
    errors : ndarray
        Measured less modelled response at the rows of all runs, output units.
    chosen : ndarray of bool
        Which of the rows count.
    """
    low, high = min(each.min() for each in inputs), max(each.max() for each in inputs)
    plane = model.plane or (float(low), float(high))
    levels, own = _refined(model, plane)
    template = Preisach(
        levels,
        np.zeros(own.size),
        input_range=(min(plane[0], float(low)), max(plane[1], float(high))),
        input_unit=model.input_unit,
        output_unit=model.output_unit,
    )
    rows = np.split(chosen, np.cumsum([each.size for each in inputs])[:-1])
    cells = np.concatenate([template.regressor(each).dense()[kept] for each, kept in zip(inputs, rows, strict=True)])
    target = errors[chosen]
    # Beside the density of the model, and in place of it if it has one.
    replaced = [np.zeros(own.size), *([own] if own.any() else [])]
    targets = np.column_stack([target + cells @ each for each in replaced])
    # Of matrices of this size, threads that wait for each other cost more than they save.
    with one_thread():
        problem = _problem(levels, cells)
        unknown = _held_out(*problem[1:], targets, _PENALTIES)
        best = np.argmin(np.sum(unknown**2, axis=1), axis=0)
        weights = _PENALTIES[best]
        options = [(unknown[best[0], :, 0], problem)]
        if own.any():
            options.append(_saturated(levels, cells, targets[:, [1]], weights[[1]]))
    losses = [float(missed @ missed) for missed, _ in options]
    which = int(np.argmin(losses))
    if losses[which] >= float(target @ target):
        return Correction(None, float(np.sqrt(np.mean(target**2))), target)
    nodes, columns, penalty = options[which][1]
    gram, right = columns.T @ columns + weights[which] * penalty, columns.T @ targets[:, which]
    # What takes the place of a density that is nowhere negative is so too.
    bounded = which == 1 and own.min() >= 0.0
    solution = _not_negative(gram, right) if bounded else np.asarray(np.linalg.solve(gram, right))
    left = options[which][0]
    operator = template.with_coefficients(nodes @ solution[:-1] - replaced[which], float(solution[-1]))
    return Correction(operator, float(np.sqrt(np.mean(left**2))), left)


def _problem(
    levels: Floats, cells: Floats, saturated: tuple[float, float] = (0.0, 0.0)
) -> tuple[csr_array, Floats, Floats]:
    """Return what each node adds to the density of each cell, and to each row, and the penalty of all unknowns.

    The last unknown is a constant. `saturated` is how many levels from the lower and the upper end of the plane hold
    no hysterons.
    """
    nodes, roughness = _smooth_densities(levels, saturated)
    columns = np.column_stack([nodes.T.dot(cells.T).T, np.ones(cells.shape[0])])
    penalty = np.zeros((columns.shape[1],) * 2)
    penalty[:-1, :-1] = roughness * (float(np.mean(columns[:, :-1] ** 2)) * cells.shape[0] or 1.0)
    return nodes, columns, penalty


def _saturated(
    levels: Floats, cells: Floats, target: Floats, weight: Floats
) -> tuple[Floats, tuple[csr_array, Floats, Floats]]:
    """Return the held-out errors and the problem of the ends of the plane without hysterons that predict best.

    There the density ends at once, which no smooth one does.
    """

    def tried(below: float, above: float) -> tuple[float, Floats, tuple[csr_array, Floats, Floats]]:
        problem = _problem(levels, cells, (below, above))
        missed = _held_out(*problem[1:], target, weight)
        return float(np.sum(missed**2)), missed[0, :, 0], problem

    # With equal losses the first, as the smallest.
    lower = [tried(edge, 0.0) for edge in _EDGES]
    below = int(np.argmin([loss for loss, *_ in lower]))
    upper = [lower[below], *(tried(_EDGES[below], edge) for edge in _EDGES[1:])]
    _, missed, problem = upper[int(np.argmin([loss for loss, *_ in upper]))]
    return missed, problem


def _held_out(columns: Floats, penalty: Floats, targets: Floats, weights: Floats) -> Floats:
    """Return the errors of cross-validation, by weight of the penalty, row and target.

    They are infinite where the penalty is too small for the rows to say anything.
    """
    from scipy.linalg import LinAlgError, LinAlgWarning, solve

    gram, right = columns.T @ columns, columns.T @ targets
    count = targets.shape[0]
    # The rows of a single block would all be held out at once.
    block = _BLOCK if count > _BLOCK else -(-count // _FOLDS)
    folds = (np.arange(count) // block) % _FOLDS
    unknown = np.zeros((weights.size, *targets.shape))
    for fold in range(_FOLDS):
        out = folds == fold
        held = columns[out]
        kept, sums = gram - held.T @ held, right - held.T @ targets[out]
        for number, weight in enumerate(weights):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error", LinAlgWarning)
                    found = solve(kept + weight * penalty, sums, assume_a="pos")
            except (LinAlgError, LinAlgWarning):
                unknown[number] = np.inf
            else:
                unknown[number, out] = targets[out] - held @ found
    return unknown


def _not_negative(gram: Floats, right: Floats) -> Floats:
    """Return the solution of normal equations of which only the last unknown, a constant, may be negative."""
    from scipy.linalg import cholesky, solve_triangular
    from scipy.optimize import nnls

    count, sums = gram[-1, -1], gram[:-1, -1]
    root = cholesky(gram[:-1, :-1] - np.outer(sums, sums) / count, lower=True)
    part = right[:-1] - sums * right[-1] / count
    found, _ = nnls(root.T, solve_triangular(root, part, lower=True), maxiter=20 * part.size)
    return np.append(found, (right[-1] - sums @ found) / count)


def _refined(model: Operator[Any], plane: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return levels, fine enough, and the density of the model on them, zeros if it has none."""
    found = model.densities()
    if not found:
        return uniform_levels(*plane, _LEVELS), np.zeros(_LEVELS * (_LEVELS + 1) // 2)
    coarse, whole = found[0].levels, found[0].values
    parts = -(-_LEVELS // whole.shape[0])
    order = parts * whole.shape[0]
    levels = np.interp(np.arange(order + 1) / parts, np.arange(coarse.size), coarse)
    upper, lower = np.tril_indices(order)
    return levels, whole[upper // parts, lower // parts]


def _smooth_densities(levels: Floats, saturated: tuple[float, float]) -> tuple[csr_array, Floats]:
    """Return what each node adds to the density of each cell, and the roughness of the nodes.

    Nodes stand on a lattice of centres and widths, and between them the density is bilinear; beyond where the
    specimen is saturated there is none. Shapes (K, P), (P, P).
    """
    from scipy.sparse import csr_array

    low, span = float(levels[0]), float(levels[-1] - levels[0])
    upper, lower = np.tril_indices(levels.size - 1)
    middles = 0.5 * (levels[1:] + levels[:-1])
    widths = np.where(upper == lower, np.diff(levels)[upper] / 3.0, middles[upper] - middles[lower]) / span
    centres = (0.5 * (middles[upper] + middles[lower]) - low) / span
    nodes = np.linspace(0.0, 1.0, _CENTRES + 1)
    first, second = _shares(centres, nodes), _shares(widths, _WIDTHS)
    cells = np.arange(upper.size)
    below, above = saturated
    inside = np.clip(lower + 1.0 - below, 0.0, 1.0) * np.clip(levels.size - 1.0 - above - upper, 0.0, 1.0)
    entries = [
        (share * other * inside, cells, place * _WIDTHS.size + beside)
        for place, share in first
        for beside, other in second
    ]
    values, rows, columns = (np.concatenate(each) for each in zip(*entries, strict=True))
    size = nodes.size * _WIDTHS.size
    densities = csr_array((values, (rows, columns)), shape=(upper.size, size))
    along, across = _bends(np.arange(nodes.size, dtype=np.float64)), _bends(_CENTRES * 2.0 * _WIDTHS)
    roughness = _ALONG * np.kron(along, np.eye(_WIDTHS.size)) + np.kron(np.eye(nodes.size), across)
    return densities, roughness + _SIZE * np.eye(size)


def _shares(places: Floats, nodes: Floats) -> list[tuple[NDArray[np.int64], Floats]]:
    """Return the two nodes that each place lies between, and the share of each."""
    before = np.clip(np.searchsorted(nodes, places) - 1, 0, nodes.size - 2)
    share = np.clip((places - nodes[before]) / (nodes[before + 1] - nodes[before]), 0.0, 1.0)
    return [(before, 1.0 - share), (before + 1, share)]


def _bends(nodes: Floats) -> Floats:
    """Return the matrix of the sum of the squared bends of a piecewise linear function at its inner nodes."""
    gaps = np.diff(nodes)
    bends = np.zeros((nodes.size - 2, nodes.size))
    inner = np.arange(nodes.size - 2)
    bends[inner, inner], bends[inner, inner + 2] = 1.0 / gaps[:-1], 1.0 / gaps[1:]
    bends[inner, inner + 1] = -1.0 / gaps[:-1] - 1.0 / gaps[1:]
    bends *= np.sqrt(gaps[:-1] * gaps[1:])[:, None]
    return np.asarray(bends.T @ bends)
