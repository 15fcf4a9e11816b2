"""Tests of what a Preisach-type model takes for granted: that returns erase loops, and that loops are congruent.

Return-point memory: when a minor loop closes, because the input comes back to the extremum at which it began, the
output is what it was there, as often as it is visited. Congruency: all minor loops between the same two inputs have
the same shape. Operators of Preisach type have both, and no other rate-independent ones do: I. D. Mayergoyz, Phys.
Rev. Lett. 56, 1518, 1986. A specimen that ratchets, creeps or depends on the rate lacks the first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.branches import turns_beyond_noise

# Part of the input range within which extrema are the same. Source: noise of 1 % of the range, a premise.
_SAME = 0.01
# Repetitions that differ by more than this part of the output range, and this many times its noise, violate a test.
# Derivation: twice that noise; and the difference of two readings has √2 times the noise of one.
_LIMIT = 0.02
_NOISE = 2.0
# Part by which the range may grow without the other end being counted again: reversal curves grow it step by step.
# Source: a choice; reversal curves in four steps or more grow a range by no more at a time.
_GROWTH = 0.25
# Points along a branch at which branches are compared, and the shortest common part of the input range. Source: a
# choice; eight intervals of a branch.
_POINTS = 9
# Derivation: five times the distance of extrema that are the same.
_COMMON = 0.05


@dataclass(frozen=True)
class MemoryTest:
    """The verdict of one test.

    Attributes
    ----------
    name : str
        `return-point memory` or `congruency`.
    holds : bool or None
        Whether the data agree with it; None if they do not tell.
    difference : float
        RMS difference of two outputs that should be equal, output units; nan if nothing was compared.
    percent : float
        The same in percent of the range of the output.
    compared : int
        Number of extrema or of branches that were compared.
    text : str
        The verdict as a sentence.
    remedy : str
        What to try if the data do not agree with it.
    """

    name: str
    holds: bool | None
    difference: float
    percent: float
    compared: int
    text: str
    remedy: str = ""

    @property
    def agrees(self) -> bool:
        """Whether the data do not contradict it."""
        return self.holds is not False

    def to_json(self) -> dict[str, Any]:
        """Return the verdict for programs."""
        found: dict[str, Any] = {"holds": self.holds, "compared": self.compared, "text": self.text}
        if self.compared:
            found |= {"difference": self.difference, "percent": self.percent}
        return found


@dataclass
class _Extremum:
    """An extremum that the memory still holds: its input, and the outputs of its visits."""

    value: float
    direction: int
    outputs: list[float] = field(default_factory=list)


def check_return_points(inputs: ArrayLike, outputs: ArrayLike) -> MemoryTest:
    """Return whether the output repeats where the input comes back to an extremum that it has not passed since.

    Parameters
    ----------
    inputs, outputs : array_like, shape (N,)
        The measured sequence.

    Raises
    ------
    ValueError
        If the lengths differ, or a sequence is empty or not finite.
    """
    u, y = _pair(inputs, outputs)
    name = "return-point memory"
    visited = [each for each in _visits(u, y) if len(each.outputs) > 1]
    if not visited:
        return _untested(name, "no extremum is visited twice")
    deviations = np.concatenate([np.array(each.outputs) - np.mean(each.outputs) for each in visited])
    # Of two visits the difference; of many that move on slowly the whole way counts.
    spare = deviations.size - len(visited)
    rms, percent, is_small = _measure(float(np.sqrt(2.0 * (deviations @ deviations) / spare)), y)
    ratchet = _ratchet(visited)
    counts = [len(each.outputs) for each in visited]
    visits = f"{min(counts)} times" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)} times"
    extrema = f"{len(visited)} extrem{'um' if len(visited) == 1 else 'a'} visited {visits}"
    if is_small:
        text = f"{name}: {extrema}, outputs repeat within {percent:.2g} % of the range"
    else:
        how = f"differs by {rms:.3g} from visit to visit" if ratchet is None else f"ratchets by {ratchet:.3g} a visit"
        text = (
            f"no {name}: {extrema}, the output {how} ({percent:.2g} % of the range): a Preisach-type model may not "
            "be used"
        )
    remedy = "look for drift or creep, or fit a model with time"
    return MemoryTest(name, is_small, rms, percent, len(visited), text, remedy)


def check_congruency(inputs: ArrayLike, outputs: ArrayLike) -> MemoryTest:
    """Return whether branches from the same reversal point, reached at different outputs, have the same shape.

    Compared is the rise of the output from the reversal on, as far as both inputs stay within the extremum before.

    Parameters
    ----------
    inputs, outputs : array_like, shape (N,)
        The measured sequence.

    Raises
    ------
    ValueError
        As `check_return_points`.
    """
    u, y = _pair(inputs, outputs)
    name = "congruency"
    differences = [difference for group in _branches(u) for difference in _compare(group, u, y)]
    if not differences:
        return _untested(name, "no two loops of one input range lie at different outputs")
    rms, percent, is_small = _measure(float(np.sqrt(np.mean(np.concatenate(differences) ** 2))), y)
    pairs = f"{len(differences)} pair{'' if len(differences) == 1 else 's'} of branches over the same inputs"
    if is_small:
        text = f"{name}: {pairs} agree within {percent:.2g} % of the range"
    else:
        text = f"no {name}: {pairs} differ by {percent:.2g} % of the range, which no Preisach-type model follows"
    remedy = "compare it with models of other structure by --model all"
    return MemoryTest(name, is_small, rms, percent, len(differences), text, remedy)


def _untested(name: str, reason: str) -> MemoryTest:
    return MemoryTest(name, None, float("nan"), float("nan"), 0, f"{name}: not tested, as {reason}")


def _pair(inputs: ArrayLike, outputs: ArrayLike) -> tuple[Floats, Floats]:
    u = _checks.samples("inputs", inputs)
    return u, _checks.counted("outputs", outputs, u.size, "values, one for each input")


def _ratchet(visited: list[_Extremum]) -> float | None:
    """Return by how much the output moves on from visit to visit, output units, or None if it only scatters."""
    steps = np.concatenate([np.diff(each.outputs) for each in visited])
    mean = float(steps.mean())
    return mean if abs(mean) > 0.5 * float(np.sqrt(np.mean(steps**2))) else None


def _measure(rms: float, y: Floats) -> tuple[float, float, bool]:
    """Return a difference, in percent of the range as well, and whether it is small."""
    span = float(np.ptp(y)) or 1.0
    return rms, 100.0 * rms / span, bool(rms <= np.hypot(_LIMIT * span, _NOISE * _noise(y)))


def _noise(y: Floats) -> float:
    """Return the standard deviation of white noise, from third differences: what is smooth cancels."""
    if y.size < 5:
        return 0.0
    # Of steps that are large the differences are no noise.
    return min(float(1.4826 * np.median(np.abs(np.diff(y, 3))) / np.sqrt(20.0)), _LIMIT * float(np.ptp(y)))


def _moves(u: Floats) -> Iterator[tuple[int, int]]:
    turns = turns_beyond_noise(u).tolist()
    yield from pairwise(turns)


def _crossing(u: Floats, y: Floats, first: int, last: int, value: float) -> float:
    """Return the output where the input, on its way from one sample to another, reaches a value or comes nearest."""
    way = u[first : last + 1]
    direction = 1.0 if u[last] >= u[first] else -1.0
    reached = direction * way >= direction * value
    at = int(np.argmax(reached))
    if not reached[at] or at == 0:
        return float(y[last] if not reached[at] else y[first])
    before, after = first + at - 1, first + at
    part = (value - u[before]) / (u[after] - u[before]) if u[after] != u[before] else 1.0
    return float(y[before] + part * (y[after] - y[before]))


def _visits(u: Floats, y: Floats) -> list[_Extremum]:
    """Return all extrema with the outputs at each visit before the memory lost them.

    The greatest and the least input so far are known to the memory for good; they begin again when the range grows by
    much, as does the first sample, which need not be an extremum.
    """
    near = _SAME * float(np.ptp(u))
    ends = {direction: _Extremum(float(u[0]), direction) for direction in (-1, 1)}
    stack: list[_Extremum] = []
    closed: list[_Extremum] = []
    for first, last in _moves(u):
        direction = 1 if u[last] > u[first] else -1

        def short_of(extremum: _Extremum, direction: int = direction, last: int = last) -> float:
            return direction * (extremum.value - float(u[last]))

        reached = False
        # The last on the stack is where this move began, the one before it the next extremum on its way.
        while len(stack) > 1 and short_of(stack[-2]) <= near and not reached:
            target = stack[-2]
            target.outputs.append(_crossing(u, y, first, last, target.value))
            closed.append(stack.pop())
            reached = short_of(target) >= -near
            if not reached:
                closed.append(stack.pop())
        end = ends[direction]
        if short_of(end) < -near:
            closed.append(end)
            # What it held of the time before is lost only now.
            if -short_of(end) > _GROWTH * (ends[1].value - ends[-1].value):
                closed.append(ends[-direction])
                ends[-direction] = _Extremum(ends[-direction].value, -direction)
            ends[direction] = _Extremum(float(u[last]), direction, [float(y[last])])
            stack = [ends[direction]]
        elif reached:
            pass
        elif short_of(end) <= near:
            end.outputs.append(_crossing(u, y, first, last, end.value))
            closed += stack
            stack = [end]
        else:
            stack.append(_Extremum(float(u[last]), direction, [float(y[last])]))
    found = {id(each): each for each in [*closed, *stack, *ends.values()]}
    return list(found.values())


@dataclass(frozen=True)
class _Branch:
    first: int
    last: int
    reach: float
    """How far the input goes within the extremum before."""


def _branches(u: Floats) -> list[list[_Branch]]:
    """Return branches that begin at the same input and go in the same direction, by groups."""
    span = float(np.ptp(u))
    found: dict[int, list[_Branch]] = {-1: [], 1: []}
    stack: list[float] = []
    for first, last in _moves(u):
        direction = 1 if u[last] > u[first] else -1
        if not stack:
            stack.append(float(u[first]))
        bounded = len(stack) > 1
        bound = stack[-2] if bounded else float(u[last])
        reach = direction * min(direction * float(u[last]), direction * bound)
        if bounded:
            found[direction].append(_Branch(first, last, reach))
        while len(stack) > 1 and direction * (u[last] - stack[-2]) >= 0.0:
            del stack[-2:]
        stack.append(float(u[last]))
    groups: list[list[_Branch]] = []
    for branches in found.values():
        begin = -np.inf
        for each in sorted(branches, key=lambda one: float(u[one.first])):
            if u[each.first] - begin > _SAME * span:
                groups.append([])
                begin = float(u[each.first])
            groups[-1].append(each)
    return [sorted(group, key=lambda one: one.first) for group in groups if len(group) > 1]


def _compare(group: list[_Branch], u: Floats, y: Floats) -> Iterator[Floats]:
    """Yield the differences of each branch of a group from its first one, if both begin at different outputs."""
    one = group[0]
    apart = max(_LIMIT * float(np.ptp(y)), _NOISE * _noise(y))
    for other in group[1:]:
        direction = 1.0 if u[one.last] > u[one.first] else -1.0
        end = direction * min(direction * one.reach, direction * other.reach)
        begin = direction * max(direction * float(u[one.first]), direction * float(u[other.first]))
        if direction * (end - begin) < _COMMON * float(np.ptp(u)) or abs(y[one.first] - y[other.first]) <= apart:
            continue
        points = np.linspace(begin, end, _POINTS)
        rises = [
            np.array([_crossing(u, y, each.first, each.last, point) for point in points.tolist()])
            for each in (one, other)
        ]
        yield (rises[0] - rises[0][0]) - (rises[1] - rises[1][0])
