"""What a measured sequence can tell before anything is fitted: cells swept, and what is odd about the data."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.hysteresis import MemoryCurve, Preisach, Regressor, _checks
from bench.hysteresis._checks import Floats

# Part of the samples that may repeat the one before, and part of the range that one step may take.
_PLATEAU = 0.1
_JUMP = 0.1


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which cells of the Preisach plane an excitation sweeps.

    Parameters
    ----------
    swept : ndarray of bool, shape (K,)
        Whether any part of the cell was switched after the first sample.
    never : ndarray of int64, shape (n,)
        The cells never swept, whose density the data do not tell.
    centres : ndarray, shape (n, 2)
        Their centres (β, α), input units; of a diagonal cell that of its triangle.
    """

    swept: NDArray[np.bool_]
    never: NDArray[np.int64]
    centres: Floats

    @property
    def fraction(self) -> float:
        """Part of the cells that were swept, 0 to 1."""
        return float(self.swept.mean())

    def summary(self) -> str:
        """Return the coverage in a sentence or two."""
        count = self.swept.size
        if not self.never.size:
            return f"all {count} cells swept"
        (beta0, alpha0), (beta1, alpha1) = self.centres.min(axis=0), self.centres.max(axis=0)
        return (
            f"{count - self.never.size} of {count} cells swept ({self.fraction:.0%}); never swept: "
            f"{self.never.size} with centres β from {beta0:g} to {beta1:g}, α from {alpha0:g} to {alpha1:g}"
        )


def measure_coverage(operator: Preisach, inputs: ArrayLike, state: MemoryCurve | None = None) -> Coverage:
    """Return which cells of an operator's plane a sequence of inputs sweeps.

    Parameters
    ----------
    operator : Preisach
        Its levels make the cells; its density does not matter.
    inputs : array_like, shape (N,)
        The sequence. The move to the first input does not count: nothing was measured before it.
    state : MemoryCurve or None
        Memory before the first input; default negative saturation.

    Raises
    ------
    ValueError
        If `inputs` is empty, not one-dimensional or not finite.
    """
    swept = swept_cells(operator.regressor(inputs, state))
    never = np.flatnonzero(~swept)
    levels = operator.levels
    i, j = (index[never] for index in np.tril_indices(operator.order))
    middle, steps = 0.5 * (levels[1:] + levels[:-1]), np.diff(levels)
    shift = np.where(i == j, steps[i] / 6.0, 0.0)
    return Coverage(swept, never, np.column_stack([middle[j] - shift, middle[i] + shift]))


def swept_cells(regressor: Regressor) -> NDArray[np.bool_]:
    """Return which sparse columns change after the first sample, shape (K,)."""
    swept = np.zeros(regressor.base.size, dtype=bool)
    first = regressor.starts[1]
    cells = regressor.cells[first:]
    # A rectangle may end within rounding of a cell's border.
    largest = np.zeros(regressor.base.size)
    np.maximum.at(largest, cells, np.abs(regressor.changes[first:]))
    swept[largest > 1e-12 * largest.max(initial=0.0)] = True
    return swept


def check_data(
    inputs: ArrayLike, outputs: ArrayLike | None = None, *, plane: tuple[float, float] | None = None
) -> list[str]:
    """Return what is odd about a measured sequence, in sentences; none if nothing is.

    Looked for are plateaus (inputs repeated, which add weight but no information), branches in one direction that
    are missing or made in one jump, a plane whose ends the inputs never reach, and outputs that do not change.

    Parameters
    ----------
    inputs : array_like, shape (N,)
        The measured inputs.
    outputs : array_like, shape (N,), or None
        The measured outputs.
    plane : tuple of float or None
        Range in which hysterons are sought, input units.

    Raises
    ------
    ValueError
        If the lengths differ, or a sequence is empty or not finite.
    """
    u = _checks.samples("inputs", inputs)
    y = None if outputs is None else _checks.samples("outputs", outputs)
    if y is not None and y.size != u.size:
        raise ValueError(f"outputs: expected {u.size} values, one for each input, got {y.size}")
    span = float(np.ptp(u))
    if span == 0.0:
        return [f"the input is {u[0]:g} throughout: it excites nothing"]
    found = _plateaus(u, y) + _branches(u, span)
    if plane is not None:
        low, high = _checks.increasing("plane", plane).tolist()
        for end, missed, word in ((low, u.min() > low, "low"), (high, u.max() < high, "high")):
            if missed:
                reached = u.min() if word == "low" else u.max()
                found.append(
                    f"the inputs never reach the {word} end of the plane ({reached:g} instead of {end:g}): "
                    "the cells beyond are not identified"
                )
    if y is not None and np.ptp(y) == 0.0:
        found.append(f"the output is {y[0]:g} throughout")
    return found


def _plateaus(u: Floats, y: Floats | None) -> list[str]:
    same = np.diff(u) == 0.0
    repeated = int(same.sum())
    if repeated <= _PLATEAU * u.size:
        return []
    text = f"{repeated} of {u.size} inputs repeat the one before: plateaus add weight but no information"
    if y is not None:
        text += f" (the output changes by up to {np.abs(np.diff(y))[same].max():g} on them)"
    return [text]


def _branches(u: Floats, span: float) -> list[str]:
    """Tell if the runs in one direction are jumps while the other way is made in steps."""
    steps = np.diff(u[np.append(True, np.diff(u) != 0.0)])
    turns = np.flatnonzero(np.diff(np.sign(steps)) != 0.0) + 1
    edges = np.concatenate([[0], turns, [steps.size]])
    runs: dict[str, list[tuple[float, int]]] = {"ascending": [], "descending": []}
    for start, stop in pairwise(edges.tolist()):
        length = float(steps[start:stop].sum())
        if abs(length) > _JUMP * span:
            runs["ascending" if length > 0.0 else "descending"].append((abs(length), stop - start))
    found = []
    for word, other in (("ascending", "descending"), ("descending", "ascending")):
        jumps = sum(1 for _, count in runs[word] if count == 1)
        stepped = sum(1 for _, count in runs[other] if count > 1)
        if not runs[word]:
            found.append(f"there is no {word} branch")
        elif stepped and jumps > 0.5 * len(runs[word]):
            found.append(
                f"{jumps} of {len(runs[word])} {word} branches are one jump, while the {other} ones are made in "
                f"steps: {word} branches seem to be missing"
            )
    return found
