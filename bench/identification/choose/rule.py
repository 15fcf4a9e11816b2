"""Choice of a model: candidates from coarse to fine, each scored on what is left out of its fit, and one rule.

1. Each family is tried in all its structures, from saturation or at rest, with a medium penalty.
2. The best structure of each family is tried with the other penalties, then from the other initial memories.
3. Where times are known, the best of each family is tried with each dynamic element, one after the other as long as
   the score falls; after each element the better half of the families goes on. Then the best of all is tried once
   more in its other structures, and from its other memories.
   Of a long record all this is done on evenly chosen rows, and the best of two models are then scored on all rows.
4. The rule: the least score wins; among those within 2 % of it, the fewest degrees of freedom. A record of one kind
   of cycle cannot tell models apart on other cycles: there a plane with signs wins unless it errs 1.25 times as much.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from bench.base import say_share, shares_to
from bench.identification.advice import Advice, advise_on_record
from bench.identification.by_name import Candidate, Initial
from bench.identification.choose.cross_validation import EQUAL
from bench.identification.choose.score import SCORING, Measurements, Score, evaluate
from bench.identification.choose.splits import has_one_kind
from bench.identification.fit.orientation import Orientation, has_orientation
from bench.identification.options import UNITS, template_of
from bench.identification.timed.hammerstein_fit import with_element
from bench.models import Operator, find_model, identifiable_models

PLANE = "preisach"
"""The plane with signs, whose answer to other cycles is bounded."""
SMOOTHING = (1e-2, 1e-3, 1e-1)
"""Weights of the roughness penalty that are tried, the medium one first. Source: a choice
of three decades, with which a trial on nine files did well."""
RIDGE = (1e-4, 1e-6, 1e-2)
"""Weights of the penalty on coefficients that are tried, likewise. Source: a choice; of 62
coefficients of plays on one file, 1e-6 leaves 60 degrees of freedom, and 1e-2 leaves 28."""
_UNLIKE = 3.0
"""Ratio of the error on other cycles to that on blocks from which a record is said to tell little of other inputs.
Source: measured, 3.4 % against 0.1 % of the range on a specimen that ratchets."""
OTHERS, AFTER_LAG = ("creep", "drift", "viscous", "friction"), ("resonance", "delay")
"""Dynamic elements that are tried with each operator beside a lag, where times are known; and those that are tried
once a lag has lowered the score: one of second order in its place, and a delay."""
MOST_ROWS = 2000
"""Rows by which models are compared: of more, evenly chosen ones. Source: the RMS of 2000 errors has a relative
standard error of 1.6 %, below the tie of two scores."""
_STEPS = 8
"""Steps of a comparison, for its progress. Derivation: five of `select`, two models on all rows, and the fit of the
chosen one, which follows."""
_MOST_IN_TIME = 300
"""Coefficients of an operator up to which a dynamic stage is tried. Source: a plane of 40 levels has 820, and took
seven seconds for an element and 4000 rows; one of 20 levels has 210."""
BOUNDED = 1.25
"""Ratio up to which a plane with signs wins on a record of one kind of cycle. Source: measured on major loops of
three plants, whose plane errs at most 1.02 times as much as the best, and on two files, 1.09 and 1.12 times."""


@dataclass(frozen=True)
class Given:
    """Settings that are not to be chosen; None leaves the choice.

    Attributes
    ----------
    options : mapping of str to object
        Options of models; each model takes those that it has.
    initial, orientation, smoothing, ridge
        As `Candidate`.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    initial: Initial | None = None
    orientation: Orientation | None = None
    smoothing: float | None = None
    ridge: float | None = None


@dataclass(frozen=True)
class Selection:
    """The candidates that were tried, and the one that was chosen.

    Attributes
    ----------
    scores : tuple of Score
        All candidates, by their score; those that failed last.
    best, chosen : Score
        That of the least score, and that of the rule.
    gap : int
        Rows left out next to each block.
    rows, of : int
        Rows that were compared, and of how many; where these are more, the last two were scored on all of them.
    span : float
        Range of their outputs, output units.
    on_blocks, on_runs : float
        RMS error of the chosen candidate on blocks and on whole runs left out, output units; nan of one run.
    advice : tuple of Advice
        What the record cannot decide, and what to record instead.
    has_times : bool
        Whether models with time took part.
    is_bounded : bool
        Whether planes with signs were preferred, as the record has one kind of cycle.
    """

    scores: tuple[Score, ...]
    best: Score
    chosen: Score
    gap: int
    rows: int
    of: int
    span: float
    on_blocks: float
    on_runs: float
    advice: tuple[Advice, ...] = ()
    has_times: bool = False
    is_bounded: bool = False


def compared_models() -> tuple[str, ...]:
    """Return the models that are compared if none is named: those of each family, and those of other packages."""
    return tuple(name for name, spec in identifiable_models().items() if spec.is_compared)


def select(
    measured: Measurements,
    models: Sequence[str],
    given: Given | None = None,
) -> Selection:
    """Return the model that predicts best what was left out of its fit, and what else was tried.

    The progress goes to `say_share`.

    Parameters
    ----------
    measured : Measurements
        The data.
    models : sequence of str
        Names of models of `identifiable_models`.
    given : Given, optional
        Settings that are not to be chosen.

    Raises
    ------
    ValueError
        If no model can be fitted: names each and why.
    """
    search = _Search(measured.thinned(MOST_ROWS), given or Given(), models)
    steps = search.structures, search.penalties, search.memories, search.dynamics, search.once_more
    for search.step, step in enumerate(steps):
        step()
    usable = _usable(search.scores)
    if not usable:
        failed = (f"{score.candidate.model}: {score.failure}" for score in search.scores)
        raise ValueError("; ".join(dict.fromkeys(failed)))
    thinned = search.measured
    one_kind = has_one_kind(thinned.inputs, thinned.tested)
    chosen = choose(usable, one_kind)
    if thinned is not measured:
        usable = search.all_rows(measured, [chosen, *usable])
        chosen = choose(usable, one_kind)
    one_run = measured.run_count == 1
    say_share("comparing models: fitting the chosen one", (_STEPS - 1) / _STEPS)
    return Selection(
        tuple(sorted(search.scores, key=lambda score: (score.error, bool(score.failure)))),
        usable[0],
        chosen,
        thinned.gap,
        int(thinned.tested.sum()),
        int(measured.tested.sum()),
        float(np.ptp(measured.outputs[measured.tested])),
        chosen.blocks_rms if one_run else evaluate(replace(thinned, runs=None), [chosen.candidate])[0].blocks_rms,
        float("nan") if one_run else chosen.blocks_rms,
        (*advise_on_record(thinned.inputs, thinned.times, thinned.run_count, thinned.tested), *_on_cycles(chosen)),
        measured.times is not None,
        one_kind and chosen.candidate.model == PLANE and len(models) > 1,
    )


def choose(scores: Sequence[Score], one_kind: bool = False) -> Score:
    """Return the score of the rule: the fewest degrees of freedom within 2 % of the least.

    Parameters
    ----------
    scores : sequence of Score
        Candidates that could be evaluated.
    one_kind : bool
        Whether the record has one kind of cycle: planes with signs win if they err at most 1.25 times as much.
    """
    least = min(score.error for score in scores)
    if one_kind:
        planes = [score for score in scores if score.candidate.model == PLANE and score.error <= BOUNDED * least]
        scores = planes or scores
    least = min(score.error for score in scores)
    return min((score for score in scores if score.error <= EQUAL * least), key=lambda score: score.freedom)


def _on_cycles(chosen: Score) -> Iterator[Advice]:
    if chosen.cycles_rms > _UNLIKE * chosen.blocks_rms:
        yield Advice(
            "other-cycles",
            f"the error with whole kinds of cycles left out is {chosen.cycles_rms / chosen.blocks_rms:.1f} times "
            "that with blocks left out, and to be expected on inputs unlike the record",
            "record more kinds of cycles",
        )


def _usable(scores: Sequence[Score]) -> list[Score]:
    """Return the scores of the candidates that could be evaluated, the least first."""
    return sorted((score for score in scores if not score.failure), key=lambda score: score.error)


class _Search:
    """The candidates of the choice, step by step; `scores` are those evaluated so far."""

    def __init__(self, measured: Measurements, given: Given, models: Sequence[str]) -> None:
        self.measured, self.given, self.models = measured, given, models
        self.scores: list[Score] = []
        self.made: dict[str, list[dict[str, Any]]] = {}
        self.step = 0

    def structures(self) -> None:
        """Try all structures of each model, from saturation or at rest, with the medium penalty."""
        batches = []
        for model in self.models:
            self.made[model] = self._structures(model)
            for options in self.made[model]:
                template = self._template(model, options)
                smoothing, ridge = self._penalties(model, template)
                given = self.given.orientation if has_orientation(find_model(model), template) else None
                first = Candidate(model, options, given or "auto", None, smoothing[0], ridge[0])
                batches.append([replace(first, initial=memory) for memory in self._first_memories(template)])
        self._evaluate("structures", batches)

    def penalties(self) -> None:
        """Try the best structure of each model with the other penalties."""
        batches = []
        for best in (score.candidate for score in self._best()):
            smoothing, ridge = self._penalties(best.model, self._template(best.model, best.options))
            others = [replace(best, smoothing=s, ridge=r) for s, r in product(smoothing, ridge)]
            batches.append([one for one in others if one != best])
        self._evaluate("penalties", batches)

    def memories(self) -> None:
        """Try the best of each model from the initial memories that were not tried."""
        batches = [self._other_memories(best.candidate) for best in self._best()]
        scores = self._evaluate("initial memories", batches)
        self._reshape("initial memories", [min(some, key=lambda score: score.error) for some in scores if some])

    def dynamics(self) -> None:
        """Try the best of each model with dynamic elements, one after the other as long as the score falls.

        After each element the better half of the models goes on (successive halving; Karnin, Koren and Somekh, ICML
        2013): an element tells far more of a model than which of the last ones comes first.
        """
        going = self._best(in_time=True) if self.measured.times is not None else []
        while going:
            batches = []
            for best in going:
                before = tuple(name for name in best.candidate.dynamics.split(",") if name)
                is_lagged = not {"lag", "resonance"}.isdisjoint(before)
                among = [name for name in (*OTHERS, *(AFTER_LAG if is_lagged else ("lag",))) if name not in before]
                tried = [with_element(before, element) for element in among]
                batches.append([replace(best.candidate, dynamics=",".join(elements)) for elements in tried])
            better = self._improve("dynamics", going, batches)
            going = sorted(better, key=lambda score: score.error)[: -(-len(going) // 2)]

    def once_more(self) -> None:
        """Try the other structures of the best of all, as its own was found before its memory, then its memories."""
        for others in (self._other_structures, self._other_memories):
            best = min(self._best(), key=lambda score: score.error, default=None)
            if best is not None:
                batches = [[one] for one in others(best.candidate)]
                self._evaluate("the best once more", batches, reshaped=True)

    def all_rows(self, measured: Measurements, order: Sequence[Score]) -> list[Score]:
        """Return the scores on all rows of the first candidates of two models, the least first."""
        self.measured = measured
        found: dict[str, Score] = {}
        for one in (score.candidate for score in order):
            if one.model not in found and len(_usable([*found.values()])) < 2:
                self.step += 1
                ((found[one.model],),) = self._evaluate(f"{one.model} on all {measured.inputs.size} rows", [[one]])
        if not (usable := _usable([*found.values()])):
            raise ValueError("; ".join(score.failure for score in found.values()))
        return usable

    def _other_structures(self, best: Candidate) -> list[Candidate]:
        made = [replace(best, options=options, shape=()) for options in self.made[best.model]]
        return self._untried(one for one in made if not best.dynamics or self._is_small(one))

    def _other_memories(self, best: Candidate) -> list[Candidate]:
        """Return a candidate from the initial memories with which it was not tried yet."""
        if self.given.initial is not None or self._template(best.model, best.options).memoryless:
            return []
        memories: list[Initial | None] = [None, "negative", "positive"]
        memories += ["skip"] if self.measured.may_skip else []
        memories += ["estimate"] if find_model(best.model).estimate_state is not None else []
        return self._untried(replace(best, initial=memory) for memory in memories)

    def _untried(self, made: Iterable[Candidate]) -> list[Candidate]:
        done = {repr(replace(score.candidate, shape=(), parameters={})) for score in self.scores}
        return [one for one in made if repr(replace(one, shape=(), parameters={})) not in done]

    def _improve(self, what: str, before: Sequence[Score], batches: Sequence[Sequence[Candidate]]) -> list[Score]:
        """Return the best score of each batch that is better than the one before."""
        better = []
        for old, scores in zip(before, self._evaluate(what, batches), strict=True):
            best = min(scores, key=lambda score: score.error, default=old)
            if EQUAL * best.error < old.error:
                better.append(best)
        return self._reshape(what, better)

    def _reshape(self, what: str, found: Sequence[Score]) -> list[Score]:
        """Return scores, each with the shape that is best for its own settings where that is better."""
        shaped = [[one.candidate] if one.candidate.shape else [] for one in found]
        again = self._evaluate(what, shaped, reshaped=True)
        return [min([one, *more], key=lambda score: score.error) for one, more in zip(found, again, strict=True)]

    def _evaluate(
        self, what: str, batches: Sequence[Sequence[Candidate]], *, reshaped: bool = False
    ) -> list[list[Score]]:
        """Return the scores of batches of candidates."""
        found: list[list[Score]] = []
        for done, batch in enumerate(batches):
            text = f"comparing models: {what}" + (f" {done + 1} of {len(batches)}" if len(batches) > 1 else "")
            say = partial(self._say, text + self._best_so_far(), done / len(batches), 1.0 / len(batches))
            say(SCORING, 0.0)
            with shares_to(say):
                found.append(evaluate(self.measured, batch, reshaped=reshaped))
            self.scores += found[-1]
        return found

    def _say(self, text: str, done: float, part: float, inner: str, share: float) -> None:
        if inner == SCORING:
            say_share(text, (self.step + done + part * share) / _STEPS)

    def _best_so_far(self) -> str:
        best = next(iter(_usable(self.scores)), None)
        if best is None:
            return ""
        percent = 100.0 * best.error / max(float(np.ptp(self.measured.outputs)), 1e-300)
        name = " with ".join(filter(None, (best.candidate.model, best.candidate.dynamics)))
        return f", best so far {name} {percent:.2g} %"

    def _is_small(self, candidate: Candidate) -> bool:
        """Return whether a candidate has so few coefficients that it is tried with dynamic elements."""
        return self._template(candidate.model, candidate.options).coefficients.size <= _MOST_IN_TIME

    def _best(self, *, in_time: bool = False) -> list[Score]:
        """Return the best candidate of each model that could be evaluated, of small ones only if `in_time`."""
        usable = [one for one in _usable(self.scores) if not in_time or self._is_small(one.candidate)]
        found = [next((one for one in usable if one.candidate.model == model), None) for model in self.models]
        return [one for one in found if one is not None]

    def _structures(self, model: str) -> list[dict[str, Any]]:
        """Return the options of each structure of a model; those of more coefficients than rows only if alone."""
        spec = find_model(model)
        assert spec.template is not None
        taken = {*inspect.signature(spec.template).parameters, *UNITS}
        fixed = {name: value for name, value in self.given.options.items() if name in taken}
        varied = {name: values for name, values in spec.variants.items() if name not in fixed}
        made, counts = [], []
        for choice in product(*varied.values()):
            options = fixed | dict(zip(varied, choice, strict=True))
            try:
                counts.append(self._template(model, options).coefficients.size)
                made.append(options)
            except (ValueError, TypeError) as error:
                self.scores.append(Score(Candidate(model, options), failure=str(error)))
        most = max(int(self.measured.tested.sum()), min(counts, default=0))
        return [options for options, count in zip(made, counts, strict=True) if count <= most]

    def _template(self, model: str, options: Mapping[str, Any]) -> Operator[Any]:
        return template_of(find_model(model), self.measured.inputs[self.measured.fitted], options)

    def _penalties(
        self, model: str, template: Operator[Any]
    ) -> tuple[tuple[float | None, ...], tuple[float | None, ...]]:
        """Return the weights of smoothing and of ridge that are tried."""
        constrained = find_model(model).constrained
        smoothing: tuple[float | None, ...] = (0.0,)
        ridge: tuple[float | None, ...] = (0.0,)
        if template.densities():
            smoothing = SMOOTHING if constrained else (None,)
            ridge = (0.0,) if constrained else (None,)
        elif not constrained and not template.shape_parameters().names:
            ridge = RIDGE
        given = self.given
        if given.smoothing is not None and template.densities():
            smoothing = (given.smoothing,)
        if given.ridge is not None and not constrained:
            ridge = (given.ridge,)
        return smoothing, ridge

    def _first_memories(self, template: Operator[Any]) -> tuple[Initial | None, ...]:
        """Return the memories with which all structures are tried: at rest, and in saturation if it differs."""
        if template.memoryless:
            return (None,)
        if self.given.initial is not None:
            return (self.given.initial,)
        # Each memory of an operator with a shape is a search of its own.
        if template.shape_parameters().names:
            return (None,)
        relaxed = template.initial_state() != template.saturated_state(-1)
        return (None, "negative", "positive") if relaxed else (None, "positive")
