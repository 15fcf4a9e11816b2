"""The rule of one standard error, and which of the tries of one model counts.

Source: Breiman, Friedman, Olshen, Stone, Classification and Regression Trees, 1984, section 3.4.3; its limits: Chen
and Yang, Stat 10, e868, 2021 (the standard error is off by a factor of two either way, and a rule for structure often
predicts worse), hence the bounds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.base import Floats
from bench.identification.by_name import Initial
from bench.identification.choose.cross_validation import EQUAL
from bench.identification.choose.evaluation import Evaluation

# Part of the coefficients of another from which a model is clearly simpler.
_FEWER = 2.0 / 3.0

# Differences of Akaike's criterion at which the data support a model considerably less: from, to (Burnham and
# Anderson, Model Selection and Multimodel Inference, 2002, section 2.6).
_LESS_FROM, _LESS_TO = 4.0, 7.0
# What the simplest may err more than the best, however large the standard error.
_WORSE = 1.05


def score(each: Evaluation) -> Floats:
    """Return the mean squared errors that decide, fold by fold: those of blocks, and of units where there are any."""
    return np.array(each.blocks + each.units)


def has_signs(each: Evaluation) -> bool:
    """Return whether signs bound the coefficients of an evaluated model."""
    return each.candidate.orientation != "auto"


def simplest_near_best(judged: Sequence[Evaluation]) -> tuple[Evaluation, Evaluation]:
    """Return the one of the least error, and the simplest within one standard error of it.

    Those of up to half as many coefficients more are about as simple: of these it is the one of the least error.
    Where residuals are uncorrelated, nothing is left to model, and the fits tell more than the folds: another without
    signs, within one standard error, is preferred if the criterion of Akaike supports the simplest considerably less.
    """
    best = min(judged, key=lambda each: score(each).mean())
    within = [each for each in judged if is_within_one_standard_error(each, best)]
    fewest = min(each.free for each in within)
    simplest = min(
        (each for each in within if _FEWER * each.free <= fewest),
        key=lambda each: (score(each).mean(), each.free),
    )
    # Signs choose coefficients, which the criterion would have to count; and it compares fits to the same rows: those
    # with time are to all, others may be to fewer.
    timed = bool(simplest.candidate.static)
    adequate = [
        each for each in within if each.uncorrelated and not has_signs(each) and bool(each.candidate.static) == timed
    ]
    likeliest = min(adequate, key=lambda each: each.akaike, default=simplest)
    supported = simplest.akaike <= likeliest.akaike + _LESS_FROM
    return best, simplest if supported else likeliest


def best_of_one_kind(bounded: Sequence[Evaluation], others: Sequence[Evaluation]) -> tuple[Evaluation, Evaluation]:
    """Return the one of the least error of those that may be chosen from one kind of cycle, and what is chosen.

    Blocks that are left out are like those that are fitted: a little more error tells nothing of other inputs. Chosen
    is the one of the least error of those whose fit leaves no more than noise; if none does, of the bounded. Others
    must not have more coefficients than the simplest of the bounded, which also decides whether time is left out.
    """
    simplest = simplest_near_best(bounded)[1]
    few = [each for each in others if each.free <= simplest.free]
    alike = [each for each in (*bounded, *few) if bool(each.candidate.static) == bool(simplest.candidate.static)]
    adequate = [each for each in alike if each.uncorrelated] or [each for each in alike if each in bounded]
    best, chosen = (min(each, key=lambda one: score(one).mean()) for each in ((*bounded, *few), adequate))
    return best, chosen


def best_of_few_rows(judged: Sequence[Evaluation]) -> Evaluation:
    """Return the one of the least error among those that the fit to all rows supports."""
    least = min(each.akaike for each in judged)
    supported = (each for each in judged if each.akaike <= least + _LESS_TO)
    return min(supported, key=lambda each: score(each).mean())


def is_within_one_standard_error(simple: Evaluation, best: Evaluation) -> bool:
    """Return whether an error is within one standard error of the best, or 2 %, and at most 5 % above it.

    The standard error is that of the differences fold by fold: what is hard to predict is so for both. To leave out
    time the 2 % do not count: at the rates of the record a lag may hardly show, and at others be most of the error.
    """
    first, second = score(simple), score(best)
    if first.size != second.size:
        # Rows between those of the others make other folds of units; blocks are the same.
        first, second = np.array(simple.blocks), np.array(best.blocks)
    difference = first - second
    allowed = float(np.std(difference, ddof=1) / np.sqrt(difference.size))
    if simple.candidate.static or not best.candidate.static:
        allowed = max(allowed, (EQUAL**2 - 1.0) * second.mean())
    allowed = min(allowed, (_WORSE**2 - 1.0) * second.mean())
    return bool(difference.mean() <= allowed)


def best_smoothing(tries: Sequence[Evaluation]) -> Evaluation:
    """Return the try of the least error; of several within 2 % of it the smoothest."""
    least = min(each.rms for each in tries)
    return max(
        (each for each in tries if each.rms <= EQUAL * least),
        key=lambda each: (each.candidate.smoothing or 0.0, -each.rms),
    )


def of_best_memory(
    tries: Sequence[Evaluation], *, prefers_skip: bool = False, skip_gains: float = 1.0
) -> list[Evaluation]:
    """Return the tries from the initial memory of the best of them; see `best_memory`."""
    memories: dict[Initial | None, list[Evaluation]] = {}
    for each in tries:
        memories.setdefault(each.candidate.initial, []).append(each)
    least = [min(each, key=lambda one: one.rms) for each in memories.values()]
    chosen = best_memory(least, prefers_skip=prefers_skip, skip_gains=skip_gains)
    return memories[chosen.candidate.initial]


def best_memory(tries: Sequence[Evaluation], *, prefers_skip: bool = False, skip_gains: float = 1.0) -> Evaluation:
    """Return the try of the least error; of several within 2 % of it that of the least error in the first rows.

    One that leaves out the first rows takes part only if it errs `skip_gains` times less than every other, or at 1 no
    more. With `prefers_skip` it is taken within 2 % of the least, whatever the errors in the first rows: a memory
    that is wrong by less than the noise shows in no error, but bends an equation; a few rows less cost their part of
    what it knows.
    """
    if not prefers_skip:
        limit = min((each.rms for each in tries if each.candidate.initial != "skip"), default=float("inf"))
        tries = [each for each in tries if each.candidate.initial != "skip" or skip_gains * each.rms <= limit]
    least = min(each.rms for each in tries)
    near = [each for each in tries if each.rms <= EQUAL * least]
    skipped = [each for each in near if prefers_skip and each.candidate.initial == "skip"]
    return min(skipped or near, key=lambda each: each.start)
