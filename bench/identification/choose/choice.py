"""Choice of a model by held-out errors: model, order, reversible part, initial memory, orientation and smoothing.

1. Each model in each of its kinds is tried at its coarsest, in both orientations and from each initial memory, on two
   folds. The best orientation and memory of each are kept; what errs many times more than the best is given up.
2. Finer ones are tried as long as they gain, on all folds, then the weights of the roughness penalty.
3. What is near the best is evaluated with whole units of the excitation left out, too.
4. Of the smoothing weights the least error decides; among models, orders and reversible parts one of the simplest
   within one standard error of the best, from the differences fold by fold: always within 2 %, and never above 5 %.
   Of few rows, and where residuals are uncorrelated, the criterion of Akaike has a say.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any, TypedDict

import numpy as np

from bench.identification.branches import turning_points
from bench.identification.by_name import Initial
from bench.identification.choose.cross_validation import EQUAL
from bench.identification.choose.evaluation import (
    Candidate,
    Evaluation,
    Measurements,
    evaluate,
    judge_determined,
    leave_units_out,
    residuals_of,
)
from bench.identification.choose.folds import correlated_rows, has_one_kind
from bench.identification.choose.near_best import (
    best_memory,
    best_of_few_rows,
    best_of_one_kind,
    best_smoothing,
    has_signs,
    of_best_memory,
    score,
    simplest_near_best,
)
from bench.identification.choose.selected import FEW_REVERSALS, Selection, Trend
from bench.identification.choose.time_stage import Carry, InTime, Task, TimeStage, is_smooth_plane, lags
from bench.identification.fit.orientation import Orientation, has_orientation
from bench.models import ModelSpec, Operator, find_model

SMOOTHING = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Weights of the roughness penalty that are tried."""

# That of a fine plane which is compared for the first time.
_SOME = 1e-2

# A candidate that errs so many times more than the best on the first folds is given up.
_HOPELESS = 3.0
# Part of the range of the outputs below which an error is one of rounding.
_ROUNDING = 1e-9
# A kind of no more coefficients than these at its finest costs little: its coarsest says nothing against it.
_FEW_COEFFICIENTS = 60
# Fewer rows say more by the fit to all than by what is left out.
_FEW_ROWS = 100
# Structures for which all smoothing weights are tried, and within which factor of the best error.
_SMOOTHED = 4
_REMEMBERED = 2
_NEAR = 2.0
# A finer order has to lower the error to this part, or no finer one is tried.
_GAIN = 0.98
# Coefficients for each row up to which a finer order is tried.
_MOST_COEFFICIENTS = 5
# What no signs bound, on other inputs without units left out or at other rates, has to be so much better.
_UNBOUNDED = 1.2
# Reversible part beside which signs bound the answer of a plane, and sizes that are tried of such planes.
_NO_REVERSIBLE, _COARSE = "none", 2
# What times that nobody asked for have to gain: at the rates of the record a lag and hysteresis look alike.
_UNASKED = 1.2
# Of one kind of cycle, what the record leaves open of a model is tested by nothing: it has to be so much better.
_UNDETERMINED = 2.0
# Rows of which a trend of the errors can be told from chance.
_FEWEST_OF_TREND = 100
# Part of the range that first rows may leave to the others of a model with a shape, if it then errs so much less.
_NEARLY_COVERED, _SKIP_GAINS = 0.9, 1.1
# Moves by this part of the range are none, and by this part of it or more in both directions show hysteresis.
_LEAST_MOVE, _BOTH_WAYS = 0.02, 0.5


@dataclass(frozen=True)
class Given:
    """What is not to be chosen, as it is given.

    Attributes
    ----------
    options : mapping of str to object
        Options of models; each model takes those that it has.
    initial, orientation, smoothing
        As `Candidate`; None leaves the choice.
    is_time_asked : bool
        Whether models with time take part as the others do. Otherwise one is chosen only if it errs 1.2 times less,
        of 100 rows or more.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    initial: Initial | None = None
    orientation: Orientation | None = None
    smoothing: float | None = None
    is_time_asked: bool = True


def select(
    measured: Measurements,
    models: Sequence[str],
    given: Given | None = None,
    carry: Carry | None = None,
    in_time: InTime | None = None,
) -> Selection:
    """Return the model that predicts best what was left out of its fit, and what else was tried.

    Parameters
    ----------
    measured : Measurements
        The data; `gap` is found from the residuals.
    models : sequence of str
        Names of models of `identifiable_models`.
    given : Given, optional
        Settings that are not to be chosen.
    carry : callable, optional
        Carries tasks out, such as in worker processes; one after another in this process if not given.
    in_time : InTime, optional
        Adds models with time, whose operators are the best of those without.

    Raises
    ------
    ValueError
        If no model can be fitted: names each and why.
    """
    return _Search(measured, models, given or Given(), carry or _one_after_another, in_time).run()


def _one_after_another(tasks: Sequence[tuple[str, Task]]) -> Iterable[list[Evaluation]]:
    return [task() for _, task in tasks]


@dataclass(frozen=True)
class _Kind:
    """A model in one of its kinds: everything but sizes, orientation, memory and smoothing."""

    model: str
    fixed: tuple[tuple[str, Any], ...]
    sizes: tuple[tuple[str, tuple[Any, ...]], ...]

    def options(self, step: int) -> dict[str, Any]:
        """Return the options of the step-th size, 0 the coarsest."""
        return dict(self.fixed) | {name: values[min(step, len(values) - 1)] for name, values in self.sizes}

    @property
    def steps(self) -> int:
        """Number of sizes."""
        return max((len(values) for _, values in self.sizes), default=1)


class _MemoryRules(TypedDict):
    prefers_skip: bool
    skip_gains: float


class _Search:
    def __init__(
        self, measured: Measurements, models: Sequence[str], given: Given, carry: Carry, in_time: InTime | None
    ) -> None:
        self.measured, self.given, self.carry = measured, given, carry
        # Of few rows a lag hardly shows, and hides much.
        self._has_few_rows = int(measured.tested.sum()) < _FEW_ROWS
        self.in_time = None if self._has_few_rows and not given.is_time_asked else in_time
        self.kinds = [kind for model in models for kind in _kinds(model, find_model(model), given)]
        self.done: dict[_Kind, list[Evaluation]] = {kind: [] for kind in self.kinds}
        self.given_up: list[Evaluation] = []
        self._has_plane: dict[_Kind, bool] = {}
        self._with_shape: set[str] = set()
        self._has_one_kind = has_one_kind(measured.inputs, measured.tested)
        turns = turning_points(measured.inputs, _LEAST_MOVE * float(np.ptp(measured.inputs)))
        self._reversals = max(turns.size - 2, 0)
        moves = np.diff(measured.inputs[turns])
        both = min(float(moves.max(initial=0.0)), float(-moves.min(initial=0.0)))
        self._is_swept_once = self._reversals < FEW_REVERSALS and both < _BOTH_WAYS * float(np.ptp(measured.inputs))
        self._memories: dict[_Kind, tuple[Initial | None, ...]] = {}
        self._shapes: dict[str, tuple[float, ...]] = {}

    def run(self) -> Selection:
        screened = self.screen()
        least = self._least(screened.values())
        self.measured = replace(self.measured, gap=self._gap(min(screened.values(), key=lambda each: each.rms)))
        left = {}
        for kind, each in screened.items():
            if each.rms > _HOPELESS * least and self._count(kind, kind.steps - 1) > _FEW_COEFFICIENTS:
                self.given_up.append(each)
            else:
                left[kind] = each.candidate
        self.refine(left, _HOPELESS * least)
        if not any(self._whole(kind) for kind in self.kinds):
            # The first two folds may be much easier than the others.
            self.done = {kind: [] for kind in self.kinds}
            self.refine(left, float("inf"))
        self.smooth()
        self.remember()
        finalists = [each for kind in self.kinds for each in self._of_each_size(kind)]
        if self._is_swept_once:
            finalists += self.smooth_planes([each.candidate for each in finalists], screened)
        judged = self.with_units(finalists)
        return self.choose(judged, self.with_time(judged))

    def _evaluated(
        self, tries: Sequence[Sequence[Candidate]], *, most_folds: int | None = None, hopeless: Sequence[float] = ()
    ) -> list[list[Evaluation]]:
        """Return how candidates do, a task for each sequence of them.

        The search for the shape of an operator takes longest, so it is carried out once for each candidate.
        """
        limits = hopeless or [float("inf")] * len(tries)
        tasks = []
        for each, limit in zip(tries, limits, strict=True):
            settings: dict[str, Any] = {"most_folds": most_folds, "hopeless": limit, "shapes": self._shapes}
            tasks.append((each[0].model, partial(evaluate, self.measured, each, **settings)))
        result = list(self.carry(tasks))
        self._shapes |= {each.candidate.name: each.shape for ones in result for each in ones if each.shape}
        return result

    def screen(self) -> dict[_Kind, Evaluation]:
        """Return each kind at its coarsest, with its best orientation and memory."""
        tried, kinds, failures = [], [], []
        for kind in self.kinds:
            try:
                tries = self._first_tries(kind)
            except (ValueError, TypeError) as error:
                failures.append(Evaluation(Candidate(kind.model, kind.options(0)), failure=str(error)))
            else:
                kinds.append(kind)
                tried.append(tries)
        result = {}
        for kind, found in zip(kinds, self._evaluated(tried, most_folds=2), strict=True):
            usable = [each for each in found if each.blocks]
            if usable:
                result[kind] = best_memory(usable, **self._memory_rules(kind))
            else:
                failures.append(found[0])
        self.given_up += failures
        if not result:
            raise ValueError("; ".join(dict.fromkeys(f"{each.candidate.model}: {each.failure}" for each in failures)))
        return result

    def refine(self, left: Mapping[_Kind, Candidate], hopeless: float) -> None:
        """Evaluate finer and finer orders of each kind, as long as they gain."""
        going = dict(left)
        step = 0
        while going:
            names = list(going.items())
            tried, limits = [], []
            for kind, candidate in names:
                sized = replace(candidate, options=kind.options(step))
                weights: list[float | None] = [sized.smoothing]
                # A fine plane without any smoothing may fail where the same plane with some does not.
                if self._is_smoothed(kind) and step:
                    weights.append(_SOME)
                tried.append([replace(sized, smoothing=weight) for weight in weights])
                limits.append(float("inf") if self._is_told_by_fit(kind) else hopeless)
            step += 1
            for (kind, _), found in zip(names, self._evaluated(tried, hopeless=limits), strict=True):
                before = min((each.rms for each in self.done[kind]), default=float("inf"))
                self.done[kind] += found
                now = min(each.rms for each in found)
                gains = now < _GAIN * before or self._may_gain_in_time(kind) or self._is_told_by_fit(kind)
                if step >= kind.steps or not gains or self._is_too_fine(kind, step):
                    del going[kind]

    def _least(self, tried: Iterable[Evaluation]) -> float:
        """Return the least error; of exact fits one that is none, so that rounding does not tell them apart."""
        least = min((each.rms for each in tried), default=0.0)
        return max(least, _ROUNDING * float(np.ptp(self.measured.outputs)))

    def _may_gain_in_time(self, kind: _Kind) -> bool:
        """Return whether a drift or a lag may hide what a finer order gains; all orders are tried behind it."""
        return self.in_time is not None and kind.model in self._with_shape

    def _is_told_by_fit(self, kind: _Kind) -> bool:
        """Return whether an equation is judged by its fit to few rows, whatever its error on blocks left out.

        One block may be all there is of a part of the range: what is left out there extrapolates.
        """
        return self._has_few_rows and kind.model in self._with_shape

    def _is_too_fine(self, kind: _Kind, step: int) -> bool:
        """Return whether a kind has many more coefficients than there are rows."""
        return self._count(kind, step) > _MOST_COEFFICIENTS * int(self.measured.tested.sum())

    def _count(self, kind: _Kind, step: int) -> int:
        """Return the number of coefficients of a kind at a size."""
        template = find_model(kind.model).template
        assert template is not None
        operator: Operator[Any] = template(self.measured.inputs, **kind.options(step))
        return operator.coefficients.size

    def smooth(self) -> None:
        """Try smaller and greater smoothing weights on the structures near the best, until the error rises."""
        best = {kind: each for kind in self.kinds if (each := self._best(kind)) and self._is_smoothed(kind)}
        least = self._least(best.values())
        near = sorted((each.rms, self.kinds.index(kind)) for kind, each in best.items() if each.rms <= _NEAR * least)
        going = [self.kinds[index] for _, index in near[:_SMOOTHED]]
        while going:
            tries = [(kind, each) for kind in going for each in self._neighbours(kind)]
            limits = [_NEAR * least] * len(tries)
            for (kind, _), found in zip(
                tries, self._evaluated([[each] for _, each in tries], hopeless=limits), strict=True
            ):
                self.done[kind] += found
            going = [kind for kind in going if self._neighbours(kind)]

    def _neighbours(self, kind: _Kind) -> list[Candidate]:
        """Return the best candidate of a kind with the next smaller and greater smoothing, as far as not tried."""
        best = self._best(kind)
        assert best is not None
        tried = {
            each.candidate.smoothing
            for each in self.done[kind]
            if each.candidate.options == best.candidate.options
        }  # fmt: skip
        at = int(np.searchsorted(SMOOTHING, best.candidate.smoothing or 0.0))
        return [
            replace(best.candidate, smoothing=weight)
            for weight in SMOOTHING[max(at - 1, 0) : at + 2]
            if weight not in tried
        ]

    def smooth_planes(self, others: Sequence[Candidate], screened: Mapping[_Kind, Evaluation]) -> list[Evaluation]:
        """Return planes with signs, the greatest smoothing and no reversible part, beside other candidates.

        Of a record that hardly goes both ways signs and smoothness say how the answer goes on.
        """
        tries = [
            replace(screened[kind].candidate, options=kind.options(step), smoothing=SMOOTHING[-1])
            for kind in screened
            if self._is_smoothed(kind) and dict(kind.fixed).get("reversible") == _NO_REVERSIBLE
            for step in range(min(kind.steps, _COARSE))
        ]
        found = self._evaluated([[each] for each in tries if each not in others])
        return [each for ones in found for each in ones if len(each.blocks) == self._folds]

    def remember(self) -> None:
        """Try the other initial memories on the best, which were compared at the coarsest order only.

        Of models with a shape not all were; of these they are tried on all near the best.
        """
        best = sorted((each.rms, self.kinds.index(kind)) for kind in self.kinds if (each := self._best(kind)))
        chosen = [self.kinds[index] for _, index in best[:_REMEMBERED]]
        for rms, index in best[_REMEMBERED:]:
            kind = self.kinds[index]
            if kind.model in self._with_shape and (rms <= _NEAR * best[0][0] or self._is_told_by_fit(kind)):
                chosen.append(kind)
        kinds, tried, limits = [], [], []
        for kind in chosen:
            one = self._best(kind)
            assert one is not None
            others = [memory for memory in self._memories[kind] if memory != one.candidate.initial]
            if others:
                kinds.append(kind)
                tried.append([replace(one.candidate, initial=memory) for memory in others])
                # Two folds may hide a memory that is to be preferred.
                limits.append((EQUAL if find_model(kind.model).saturates else _NEAR) * self._least([one]))
        for kind, found in zip(kinds, self._evaluated(tried, hopeless=limits), strict=True):
            self.done[kind] += found

    def with_units(self, finalists: list[Evaluation]) -> list[Evaluation]:
        """Return the finalists, those near the best with whole units of the excitation left out too.

        So are equations whose fit to few rows leaves only noise, and that follow smaller cycles. Where there is one
        kind of cycle, it is found instead what the fit to all rows says of them.
        """
        least = self._least(finalists)
        if self._has_one_kind:
            near = [each for each in finalists if each.rms <= _UNDETERMINED * least]
            checks = [(each.candidate.model, partial(judge_determined, self.measured, each)) for each in near]
            return [one for (one,) in self.carry(checks)] + [each for each in finalists if each not in near]
        if not self.measured.units():
            return finalists
        near = [each for each in finalists if each.rms <= _NEAR * least]
        others = [each for each in finalists if each not in near]
        told = [each for each in others if self._has_few_rows and each.candidate.model in self._with_shape]
        tasks = [(each.candidate.model, partial(leave_units_out, self.measured, each)) for each in near + told]
        found = [one for (one,) in self.carry(tasks)]
        adequate = [
            one for one in found[len(near) :] if one.uncorrelated and judge_determined(self.measured, one)[0].follows
        ]
        judged = [one.candidate for one in adequate]
        return found[: len(near)] + adequate + [each for each in others if each.candidate not in judged]

    def with_time(self, judged: list[Evaluation]) -> list[Evaluation]:
        """Return models with time with the best operators; none if times are not known."""
        if self.in_time is None:
            return []
        stage = TimeStage(
            self.in_time, self.measured, self.carry, frozenset(self._with_shape), self._may_skip, self._has_one_kind
        )
        # The one that would be chosen without time comes first.
        found, failed = stage.run([self._decide(judged)[1], *sorted(judged, key=lambda one: one.rms)])
        self.given_up += failed
        return found

    def choose(self, judged: list[Evaluation], timed: list[Evaluation]) -> Selection:
        """Return the table with what is chosen of models without time and with."""
        finalists = judged + timed
        best, chosen = self._decide(finalists)
        if chosen in timed and not self.given.is_time_asked:
            without = self._decide(judged)
            if _UNASKED * chosen.rms > without[1].rms and not self._is_drift(chosen, without[1]):
                best, chosen = without
        others = [each for kind in self.kinds for each in self.done[kind] if len(each.blocks) < self._folds]
        table = sorted(finalists, key=lambda each: each.rms) + others + self.given_up
        measured = self.measured
        return Selection(
            tuple(table),
            best,
            chosen,
            measured.gap,
            int(measured.tested.sum()),
            float(np.ptp(measured.outputs[measured.tested])),
            self._has_one_kind,
            self._reversals,
            self._trend(chosen) if chosen.candidate.static is None else None,
            self.in_time is not None,
            self.given.is_time_asked,
            self.in_time is not None and self.in_time.has_one_rate(),
            self._is_swept_once,
        )

    def _decide(self, finalists: list[Evaluation]) -> tuple[Evaluation, Evaluation]:
        """Return the one of the least error, and what is chosen of those that may be: the simplest near it.

        The fit to all rows says more than what is left out of three records. Of one kind of cycle, the rows that are
        left out are like those that are fitted. Of few rows a block is much of what there is: the criterion of Akaike
        says what takes part. At one rate the time constant of a lag is as wrong as the operator is, and no row left
        out shows it: of models with a lag it is the one of the least misfit, whose operator biases the time constant
        least. Of one kind of cycle at one rate neither shows: there the smooth plane with time is chosen where it is
        about as good, as signs and smoothness bound what the record leaves open. So they do where it hardly goes both
        ways.
        """
        finalists = self._with_lag(finalists)
        limit = _UNBOUNDED * min(each.rms for each in finalists)
        one_rate = self.in_time is not None and self.in_time.has_one_rate()
        alone = one_rate and self._has_one_kind
        near = [each for each in finalists if alone and is_smooth_plane(each) and each.rms <= limit]
        if self._is_swept_once:
            limit = _UNDETERMINED * min(each.rms for each in finalists)
            near = [each for each in finalists if self._is_bounding_plane(each) and each.rms <= limit]
        bounded, others = self._of_one_kind(finalists)
        judged = bounded + others or [each for each in finalists if each.units] or self._bounded(finalists)
        best, chosen = best_of_one_kind(bounded, others) if bounded else simplest_near_best(judged)
        if near:
            chosen = min(near, key=lambda each: each.rms)
        elif one_rate and lags(chosen):
            alike = [each for each in judged if lags(each) and has_signs(each) == has_signs(chosen)]
            chosen = min(alike, key=lambda each: each.misfit)
        elif chosen.units and self._has_few_rows:
            chosen = best_of_few_rows(judged)
        return best, chosen

    def _is_bounding_plane(self, each: Evaluation) -> bool:
        """Return whether signs and the greatest smoothing bound an answer, with nothing beside the plane."""
        one = each.candidate
        smoothest = one.smoothing == SMOOTHING[-1]
        return has_signs(each) and smoothest and one.options.get("reversible") == _NO_REVERSIBLE

    def _with_lag(self, finalists: list[Evaluation]) -> list[Evaluation]:
        """Return the finalists; at one rate without those that leave time out, where signs ask for a lag.

        There a model without signs takes a lag for hysteresis. One with signs moves with its input at once: where it
        needs a lag, others must be so much better.
        """
        if self.in_time is None or not self.in_time.has_one_rate():
            return finalists
        lagging = [score(each).mean() for each in finalists if lags(each) and has_signs(each)]
        least = min(lagging, default=float("inf"))
        return [
            each
            for each in finalists
            if each.candidate.static or not lagging or _UNBOUNDED**2 * score(each).mean() < least
        ]

    def _is_drift(self, timed: Evaluation, without: Evaluation) -> bool:
        """Return whether a model with time has a drift, and errors without time have a trend: no lag has one."""
        trend = self._trend(without)
        return "drift" in str(timed.candidate.options.get("dynamics")) and trend is not None and trend.drifts

    def _trend(self, chosen: Evaluation) -> Trend | None:
        """Return the trend of errors over the rows tested; None of fewer rows than tell one from chance."""
        rows = np.flatnonzero(self.measured.tested)
        errors = residuals_of(self.measured, chosen)[rows]
        if rows.size < _FEWEST_OF_TREND or not np.ptp(errors) > 0.0:
            return None
        place = (rows - rows.mean()) / max(int(np.ptp(rows)), 1)
        slope = float(place @ errors / (place @ place))
        return Trend(slope, float(slope**2 * (place @ place) / np.sum((errors - errors.mean()) ** 2)))

    def _of_one_kind(self, finalists: list[Evaluation]) -> tuple[list[Evaluation], list[Evaluation]]:
        """Return what a record of one kind of cycle determines and signs bound, and what else it determines.

        Both err at most twice as much as the best; both are empty of other records. What has no signs must follow
        smaller cycles; beside the bounded only differential equations count.
        """
        least = min(each.rms for each in finalists)
        near = [each for each in finalists if self._has_one_kind and each.rms <= _UNDETERMINED * least]
        determined = [each for each in near if each.determined]
        bounded = [each for each in determined if self._is_bounded(each)]
        others = [each for each in determined if each not in bounded and each.follows]
        if bounded:
            others = [each for each in others if each.candidate.operator in self._with_shape]
        return bounded, others

    def _is_bounded(self, each: Evaluation) -> bool:
        """Return whether signs bound the answer to other inputs, or it has no memory."""
        if has_signs(each):
            return True
        operator = find_model(each.candidate.operator).model
        # Beyond a single rise a polynomial is bounded by nothing, but for a straight line.
        return bool(operator.memoryless and (self._reversals >= FEW_REVERSALS or each.free <= 1.0))

    def _bounded(self, finalists: list[Evaluation]) -> list[Evaluation]:
        """Return the finalists without those of a plane and free signs, unless these are clearly better.

        What is known not to follow smaller cycles is left out as well, unless nothing else is there.
        """
        finalists = [each for each in finalists if each.follows] or finalists
        free = {
            kind.model for kind in self.kinds if self._has_plane.get(kind) and not find_model(kind.model).constrained
        }
        others = [each for each in finalists if each.candidate.model not in free]
        least = min((each.rms for each in others), default=float("inf"))
        return others + [each for each in finalists if each not in others and _UNBOUNDED * each.rms < least]

    @property
    def _may_skip(self) -> bool:
        """Whether `skip` is tried: a model must not extrapolate to what only the first rows reach."""
        return self.given.initial is None and self.measured.covers_its_range()

    @property
    def _folds(self) -> int:
        return len(self.measured.blocks())

    def _whole(self, kind: _Kind) -> list[Evaluation]:
        """Return the candidates of a kind that were not given up."""
        return [each for each in self.done[kind] if len(each.blocks) == self._folds]

    def _of_each_size(self, kind: _Kind) -> list[Evaluation]:
        """Return the best smoothing of each size of a kind."""
        sizes: dict[str, list[Evaluation]] = {}
        for each in self._whole(kind):
            sizes.setdefault(repr(sorted(each.candidate.options.items())), []).append(each)
        rules = self._memory_rules(kind)
        return [best_smoothing(of_best_memory(each, **rules)) for each in sizes.values()]

    def _memory_rules(self, kind: _Kind) -> _MemoryRules:
        """Return how the initial memories of a kind are compared; see `best_memory`.

        Of a model that does not saturate no word says what the memory is. Of others, rows that alone reach an end of
        the range are left out of a shape's fit only if that gains. Of one kind of cycle all words are about as good:
        the loop is closed after a few.
        """
        saturates = find_model(kind.model).saturates or self._has_one_kind
        return {
            "prefers_skip": not saturates and self.measured.known > 0,
            "skip_gains": _SKIP_GAINS if saturates and not self._may_skip else 1.0,
        }

    def _best(self, kind: _Kind) -> Evaluation | None:
        """Return the best candidate of a kind."""
        return min(self._whole(kind), key=lambda each: each.rms, default=None)

    def _is_smoothed(self, kind: _Kind) -> bool:
        """Return whether a smoothing weight is to be chosen: the model has a plane and signs, and none is given."""
        return (
            self.given.smoothing is None and find_model(kind.model).constrained and self._has_plane.get(kind, False)
        )

    def _first_tries(self, kind: _Kind) -> list[Candidate]:
        """Return a kind at its coarsest in each orientation and from each initial memory that it has.

        Raises ValueError if the data do not suit it.
        """
        spec = find_model(kind.model)
        assert spec.template is not None
        template: Operator[Any] = spec.template(self.measured.inputs, **kind.options(0))
        self._has_plane[kind] = bool(template.densities())
        orientations: tuple[Orientation, ...] = ("auto",)
        if has_orientation(spec, template):
            given = self.given.orientation
            orientations = ("rising", "falling") if given in (None, "auto") else (given,)
        memories: tuple[Initial | None, ...] = (None,)
        with_shape = bool(template.shape_parameters().names)
        covers = self._may_skip or (
            with_shape and self.given.initial is None and self.measured.covers_its_range(_NEARLY_COVERED)
        )
        skipping: tuple[Initial, ...] = ("skip",) if covers else ()
        if not template.memoryless:
            estimated: tuple[Initial, ...] = ("estimate",) if spec.estimate_state is not None else ()
            # Plays, springs and differential equations begin relaxed.
            relaxed = template.initial_state() != template.saturated_state(-1)
            negative: tuple[Initial, ...] = ("negative",) if relaxed else ()
            memories = (None, *negative, "positive", *estimated, *skipping)
            memories = memories if self.given.initial is None else (self.given.initial,)
        self._memories[kind] = memories
        if with_shape:
            self._with_shape.add(kind.model)
            if self.given.initial is None:
                # Each set-up is a search for the shape; the others are tried on those near the best only.
                memories = (None, *skipping, *(() if self._may_skip else ("positive",)))
        weight: float | None = 0.0
        if self._has_plane[kind]:
            weight = self.given.smoothing
            if weight is None and spec.constrained:
                is_too_fine = kind.steps == 1 and self._count(kind, 0) > int(self.measured.tested.sum())
                weight = _SOME if is_too_fine else 0.0
        return [
            Candidate(kind.model, kind.options(0), orientation, initial, weight)
            for orientation, initial in product(orientations, memories)
        ]

    def _gap(self, each: Evaluation) -> int:
        """Return over how many rows the errors of a first candidate are alike, at most a quarter of a block."""
        block = int(self.measured.tested.sum()) // self.measured.count_of_blocks
        return correlated_rows(residuals_of(self.measured, each)[self.measured.known :], max(1, block // 4))


def _kinds(model: str, spec: ModelSpec, given: Given) -> list[_Kind]:
    """Return a model in each of its kinds: with the options that are given."""
    assert spec.template is not None
    taken = inspect.signature(spec.template).parameters
    fixed = {name: value for name, value in given.options.items() if name in taken}
    sizes = tuple((name, tuple(values)) for name, values in spec.sizes.items() if name not in fixed)
    varied = {name: values for name, values in spec.variants.items() if name not in fixed}
    return [
        _Kind(model, (*fixed.items(), *zip(varied, choice, strict=True)), sizes)
        for choice in product(*varied.values())
    ]
