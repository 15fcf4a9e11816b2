"""The search for the numbers of a controller: one by one and all together, by the cost of runs on an emulated rig.

The cost of numbers is `error + time_weight * time`: the RMS error and the seconds at each target, each as a multiple
of that of the numbers to begin with, so that neither hides the other. It is the mean of that with the model as it is,
and of the worst of that with models by which the specimen has another gain, by the factor `MARGIN` to either side,
and another time constant of its response; there as a multiple of the worst of the numbers to begin with. So numbers
that are best on the specimen as identified but fail beside it, by too little margin of stability, are not chosen. A
run of a controller that does not converge, or reaches no target in its time, costs `FAILED`: a search can begin with
numbers that fail, but does not end with them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.identification import ModelFile
from bench.models import Operator, TwoStage

MARGIN = 1.25
"""Factor of the gain, and of the time constant, by which the specimen may differ from its model."""
GAIN_HIGH = "gain-high"
"""Name of the model of a greater gain than the specimen has."""
TIME_WEIGHT = 0.25
"""Part of the RMS error of the first numbers that costs as much as their time, unless another is given."""
FAILED = 1000.0
"""Cost of a run that failed, beyond that of any that did not."""
WORST = 1.25
"""Factor by which the greatest RMS error of the sessions may grow with better numbers."""
ERRORS = 2.0
"""Standard errors of the mean by which better numbers cost less in the same sessions."""
FACTOR = 1.7
"""By how much a number is raised and lowered at first."""
FINALISTS = 3
"""How many sets of numbers of a search run in further sessions."""
_FARTHEST = 4
"""How often a number is changed in the same direction in one round, as long as that is better."""
_TOGETHER = 6
"""How many sets of numbers are drawn at random about the best ones, all numbers changed, in each round; and as many
again if one is better."""
_ENOUGH = 0.99
"""Part of the cost below which a change is taken, as two runs of one controller differ a little."""

Numbers = Mapping[str, Any]


@dataclass(frozen=True)
class TuningTrial:
    """What runs of a controller with some numbers gave."""

    numbers: Numbers  # the numbers, as in a tuning file
    cost: float  # see the module
    rms: float  # with the model as it is, output units; infinite if a run failed
    seconds: float  # at each target, s
    worst: float  # RMS with the worst of the other models, output units; infinite if a run failed

    @property
    def failed(self) -> bool:
        """Whether a run failed."""
        return not (math.isfinite(self.rms) and math.isfinite(self.worst))


Evaluate = Callable[[Sequence[Numbers]], list[TuningTrial]]
"""Carries out the runs of several candidates beside each other."""


def perturbed_models(file: ModelFile, *, force: bool = False) -> dict[str, ModelFile]:
    """Return models from which the specimen differs, by name: in its gain, and in its lag if it has one.

    The gain of an operator turns about the middle of its output; that of a two-stage model is that of its lengths, or
    of its force.
    """
    found = {}
    for name, gain in ((GAIN_HIGH, MARGIN), ("gain-low", 1.0 / MARGIN)):
        found[name] = replace(file, model=_scaled(file.model, gain, force), memory=None, initial=None, band=None)
    known = file.dynamics
    if known is not None and known.response.lag > 0.0:
        for name, factor in (("lag-high", MARGIN), ("lag-low", 1.0 / MARGIN)):
            response = replace(known.response, lag=factor * known.response.lag)
            found[name] = replace(file, dynamics=replace(known, response=response))
    return found


def _scaled(model: Any, gain: float, force: bool) -> Any:  # noqa: ANN401 - a model of the kind of the first
    if model.kind == TwoStage.kind:
        stage = "first" if force else "second"
        return replace(model, **{stage: _scaled(getattr(model, stage), gain, force)})
    assert isinstance(model, Operator)
    low, high = model.output_range()
    middle = 0.0 if low <= 0.0 <= high and min(-low, high) < 0.1 * (high - low) else 0.5 * (low + high)
    return model.with_coefficients(gain * model.coefficients, gain * (model.bias - middle) + middle)


def cost_of(rms: float, seconds: float, scale: tuple[float, float], time_weight: float = TIME_WEIGHT) -> float:
    """Return the cost of one run, by RMS error and seconds at each target, and those of the numbers to begin with."""
    return rms / scale[0] + time_weight * seconds / scale[1] if math.isfinite(rms) else FAILED


def search(
    start: Numbers, names: Sequence[str], evaluate: Evaluate, tell: Callable[[TuningTrial], None], rounds: int = 2
) -> TuningTrial:
    """Return the best numbers that are found by changing one after another, and then all together at random.

    What two numbers gain only together, as shorter waits with more corrections do, no change of one shows.

    Parameters
    ----------
    start : mapping
        Numbers to begin with, tables within as mappings.
    names : sequence of str
        Those that may change; one in a table by `TABLE.NAME`, those that change together by `NAME+NAME`. All are
        positive.
    evaluate : callable
        Carries out trials.
    tell : callable
        Is told of each.
    rounds : int
        How often each number is changed, by a smaller factor each time; on in the direction that is better.
    """
    (best,) = evaluate([start])
    tell(best)
    rng = np.random.default_rng(0)
    for number in range(rounds):
        factor = FACTOR ** (1.0 / (number + 1))
        for name in names:
            steps: Sequence[float] = (factor, 1.0 / factor)
            for _ in range(_FARTHEST):
                trials = evaluate([multiplied(best.numbers, name, each) for each in steps])
                for trial in trials:
                    tell(trial)
                cost, step = min((trial.cost, step) for trial, step in zip(trials, steps, strict=True))
                if not cost < _ENOUGH * best.cost:
                    break
                best = trials[steps.index(step)]
                # On in the direction that was better.
                steps = (step,)
        for _ in range(2 if len(names) > 1 else 0):
            drawn = []
            for factors in factor ** rng.uniform(-1.0, 1.0, (_TOGETHER, len(names))):
                numbers = best.numbers
                for name, each in zip(names, factors.tolist(), strict=True):
                    numbers = multiplied(numbers, name, each)
                drawn.append(numbers)
            trials = evaluate(drawn)
            for trial in trials:
                tell(trial)
            found = min(trials, key=lambda trial: trial.cost)
            if not found.cost < _ENOUGH * best.cost:
                break
            best = found
    return best


def confirm(trials: Sequence[TuningTrial], sessions: Sequence[Evaluate]) -> tuple[TuningTrial, TuningTrial]:
    """Return trials of the first numbers of a search and of its best, means over sessions that it has not seen.

    The best `FINALISTS` of the others take part, even if none was better in the search: a session may flatter the
    first numbers as well. Others are better if their cost, session by session, is less by more than `ERRORS` standard
    errors of the mean, and their greatest RMS error is at most `WORST` times that of the first ones; if none are, the
    first ones are the best. Where the first numbers fail in a session, others need only cost no more in the rest, by
    `ERRORS` standard errors. Of trials of the same cost the first takes part: a number between them plays no part for
    this specimen.
    """
    start, *others = trials
    by_cost = {each.cost: each for each in reversed(others) if not each.failed}
    numbers = [start.numbers, *(by_cost[cost].numbers for cost in sorted(by_cost)[:FINALISTS])]
    first, *found = zip(*(evaluate(numbers) for evaluate in sessions), strict=True)
    before, *after = map(_mean, [first, *(each for each in found if _better(each, first))])
    return before, min(after, key=lambda each: each.cost, default=before)


def _better(trials: Sequence[TuningTrial], first: Sequence[TuningTrial]) -> bool:
    if any(each.failed for each in trials):
        return False
    both = [(a, b) for a, b in zip(trials, first, strict=True) if not b.failed]
    if len(both) < 2:
        return len(both) < len(first)
    differences = np.array([a.cost - b.cost for a, b in both])
    error = ERRORS * float(differences.std(ddof=1)) / math.sqrt(len(differences))
    # That the first ones fail somewhere decides between numbers that cost the same elsewhere.
    most = -error if len(both) == len(first) else error
    return float(differences.mean()) < most and max(a.rms for a, _ in both) <= WORST * max(b.rms for _, b in both)


def _mean(trials: Sequence[TuningTrial]) -> TuningTrial:
    values = [(each.cost, each.rms, each.seconds, each.worst) for each in trials]
    return TuningTrial(trials[0].numbers, *(sum(each) / len(trials) for each in zip(*values, strict=True)))


def multiplied(numbers: Numbers, name: str, factor: float) -> Numbers:
    """Return numbers with one of them, or those of `NAME+NAME`, multiplied by a factor.

    It is rounded to four digits. A whole number stays one, and changes by 1 at least, but not to 0.
    """
    for each in name.split("+"):
        number = get(numbers, each)
        value = factor * number
        if isinstance(number, int):
            value = max(1, math.ceil(value) if factor > 1.0 else math.floor(value))
        elif math.isfinite(value):
            value = float(f"{value:.4g}")
        numbers = put(numbers, each, value)
    return numbers


def get(numbers: Numbers, name: str, default: float = math.nan) -> float:
    """Return a number by its name, `TABLE.NAME` for one in a table."""
    table, _, last = name.rpartition(".")
    value: float = (numbers.get(table, {}) if table else numbers).get(last, default)
    return value


def put(numbers: Numbers, name: str, value: float) -> Numbers:
    """Return numbers with one of them replaced."""
    table, _, last = name.rpartition(".")
    return {**numbers, table: {**numbers.get(table, {}), last: value}} if table else {**numbers, last: value}
