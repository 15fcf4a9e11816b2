"""Checks of a measured sequence before anything is fitted."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.advice import FEW_REVERSALS, Advice

# Part of the samples that may repeat the one before, and part of the range that one step may take. Source: a choice;
# a sensor that moves all the time repeats a sample only by its resolution.
_PLATEAU = 0.1
# Derivation: a branch of fewer than ten rows shows hardly a curve.
_JUMP = 0.1
# Part of the samples for which a sensor must stand still, while the input goes through this part of its range; and
# part of the others that may repeat the one before: coarse readings often do. Derivation: noise of 1 % of the range,
# which instruments here stay below, moves a reading by less than the first; a fifth of the range is ten times that.
_STILL, _MOVED, _REPEATED = 0.02, 0.2, 0.1


def check_data(inputs: ArrayLike, outputs: ArrayLike | None = None) -> list[Advice]:
    """Return what is odd about a measured sequence; nothing if it is as usual.

    It looks for plateaus (repeated inputs, which add weight but no information), for branches in one direction that
    are missing or made in one jump, and for outputs that do not change or stand still for a while, as of a frozen
    sensor.

    Parameters
    ----------
    inputs : array_like, shape (N,)
        The measured inputs.
    outputs : array_like, shape (N,), or None
        The measured outputs.

    Raises
    ------
    ValueError
        If the lengths differ, or a sequence is empty or not finite.
    """
    u = _checks.samples("inputs", inputs)
    y = None if outputs is None else _checks.counted("outputs", outputs, u.size, "values, one for each input")
    span = float(np.ptp(u))
    if span == 0.0:
        return [Advice("constant-input", f"the input is {u[0]:g} throughout, so nothing can be identified")]
    found = _plateaus(u, y) + _branches(u, span)
    if y is not None and np.ptp(y) == 0.0:
        found.append(Advice("constant-output", f"the output is {y[0]:g} throughout"))
    elif y is not None:
        found += _frozen(u, y, span)
    return found


def _frozen(u: Floats, y: Floats, span: float) -> list[Advice]:
    """Return whether outputs that otherwise change from sample to sample stand still while the input moves."""
    same = np.diff(y) == 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    if not first.size:
        return []
    longest = int(np.argmax(last - first))
    start, stop = int(first[longest]), int(last[longest])
    elsewhere = int(same.sum()) - (stop - start)
    if (
        stop - start < max(_STILL * y.size, 10)
        or np.ptp(u[start : stop + 1]) < _MOVED * span
        or elsewhere > _REPEATED * (y.size - (stop - start))
    ):
        return []
    text = (
        f"the output stands still at {y[start]:g} from row {start} to row {stop}, while the input moves by "
        f"{np.ptp(u[start : stop + 1]):g}, and changes from row to row elsewhere"
    )
    return [Advice("frozen-output", text, "look at the sensor, and fit the other rows with --train")]


def _plateaus(u: Floats, y: Floats | None) -> list[Advice]:
    same = np.diff(u) == 0.0
    repeated = int(same.sum())
    if repeated <= _PLATEAU * u.size:
        return []
    text = f"{repeated} of {u.size} inputs repeat the one before: plateaus add weight but no information"
    if y is not None:
        text += f" (the output changes by up to {np.abs(np.diff(y))[same].max():g} on them)"
    return [Advice("plateaus", text)]


def _branches(u: Floats, span: float) -> list[Advice]:
    """Return whether branches in one direction are jumps while those in the other are made in steps."""
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
            found.append(Advice(FEW_REVERSALS, f"there is no {word} branch"))
        elif stepped and jumps > 0.5 * len(runs[word]):
            text = f"{jumps} of {len(runs[word])} {word} branches are one jump, while the {other} ones are made in "
            found.append(Advice(f"{word}-jumps", f"{text}steps: {word} branches seem to be missing"))
    return found
