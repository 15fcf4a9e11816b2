"""The models with time in the choice of a model: which operators get what may follow them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeAlias

from bench.identification.choose.evaluation import Candidate, Evaluation, Measurements
from bench.identification.choose.near_best import has_signs
from bench.models import Operator, find_model

Task: TypeAlias = Callable[[], list[Evaluation]]
Carry: TypeAlias = Callable[[Sequence[tuple[str, Task]]], Iterable[list[Evaluation]]]
"""Carries named tasks out and returns their results in order."""

PLAYS = "prandtl-ishlinskii"
"""The operator whose plays may depend on the rate."""

# Operators to which a linear part and a drift are added, and what of it is a lag.
_IN_TIME = 2
_LAGS = {"lag", "resonance", "delay"}
# Others as well, if they take a small part of the time and err up to so many times the least: a drift that they
# cannot follow counts against them, which finer ones take for hysteresis.
_CHEAP, _NEAR = 20, 2.0
# Weight of the roughness penalty of a plane that one kind of cycle does not determine, and its reversible part.
_SMOOTHING, _REVERSIBLE = 1e-2, "linear"


class InTime(Protocol):
    """Evaluates operators with what may follow them in time; see `bench.identification.timed.held_out`."""

    def is_small(self, coefficients: int) -> bool:
        """Return whether an operator of so many coefficients can be evaluated in seconds."""

    def has_one_rate(self) -> bool:
        """Return whether the input moves at one speed only."""

    def evaluate(self, static: Candidate, gap: int) -> list[Evaluation]:
        """Return the errors of a model with time with a candidate's operator; none if time tells nothing."""

    def evaluate_plays(self, static: Candidate, gap: int) -> list[Evaluation]:
        """Return the errors of a candidate's plays with thresholds that grow with their rate; none likewise."""


def lags(each: Evaluation) -> bool:
    """Return whether an operator is followed by a lag."""
    return bool(_LAGS & set(str(each.candidate.options.get("dynamics")).split(",")))


def is_smooth_plane(each: Evaluation) -> bool:
    """Return whether a model with time has a plane with signs, some smoothing and a linear part."""
    one = each.candidate
    smooth = (one.smoothing or 0.0) >= _SMOOTHING and one.options.get("reversible") == _REVERSIBLE
    return one.static is not None and smooth and has_signs(each)


class _Work(NamedTuple):
    """Makes a model with time of an evaluated operator."""

    name: str
    evaluate: Callable[[Candidate, int], list[Evaluation]]
    operator: Evaluation


@dataclass(frozen=True)
class TimeStage:
    """What the choice has found so far, as far as models with time need it.

    Attributes
    ----------
    in_time : InTime
        Evaluates them.
    measured : Measurements
        The rows by which the others were compared.
    carry : callable
        Carries tasks out.
    with_shape : frozenset of str
        Models with shape parameters.
    may_skip : bool
        Whether first rows may be left out.
    has_one_kind : bool
        Whether the input has one kind of cycle only.
    """

    in_time: InTime
    measured: Measurements
    carry: Carry
    with_shape: frozenset[str]
    may_skip: bool
    has_one_kind: bool

    def run(self, operators: Sequence[Evaluation]) -> tuple[list[Evaluation], list[Evaluation]]:
        """Return models with time with some operators, and those that failed.

        Parameters
        ----------
        operators : sequence of Evaluation
            All that were judged without time, the most promising first.
        """
        works = [_Work("hammerstein", self.in_time.evaluate, each) for each in self._tried(operators)]
        plays = [each for each in operators if each.candidate.model == PLAYS and self._is_possible(each.candidate)]
        if plays and not self.in_time.has_one_rate():
            works.append(_Work(PLAYS, self.in_time.evaluate_plays, plays[0]))
        found, failed = self._carry_out(works)
        if self.may_skip:
            # Without time, a lag hides what memory the record begins with.
            more, failed_too = self._carry_out([_from_later(work) for work in self._tried_again(works, found)])
            found, failed = found + more, failed + failed_too
        return [one for _, one in found], failed

    def _tried_again(self, works: Sequence[_Work], found: Sequence[tuple[_Work, Evaluation]]) -> list[_Work]:
        """Return what is tried without first rows too: the best, and at one rate what has signs and needed no lag."""
        again = [min(found, key=lambda one: one[1].rms)[0]] if found else []
        if self.in_time.has_one_rate():
            followed = [work for work, _ in found]
            again += [work for work in works if work not in followed and has_signs(work.operator)]
        return [work for work in again if work.operator.candidate.initial != "skip"]

    def _tried(self, operators: Sequence[Evaluation]) -> list[Evaluation]:
        """Return the operators to which time is added: the first, the best of another model, and those beside."""
        possible = [each for each in operators if self._is_possible(each.candidate)]
        best: dict[str, Evaluation] = {}
        for each in possible:
            best.setdefault(each.candidate.model, each)
        tried = list(best.values())[:_IN_TIME]
        least = min((each.rms for each in possible), default=0.0)
        tried += [each for each in best.values() if each.rms <= _NEAR * least and self._is_cheap(each.candidate)]
        if not any(has_signs(each) for each in tried):
            tried += [each for each in best.values() if has_signs(each)][:1]
        if self.in_time.has_one_rate():
            # A reversible part jumps where the input turns, which a lag undoes: one stands for the other.
            planes = [each for each in possible if each.candidate.options.get("reversible") == "none"]
            tried += [each for each in planes if has_signs(each)][:1]
            if self.has_one_kind:
                # What the record leaves open of a plane, smoothness decides.
                planes = [each for each in possible if each.candidate.options.get("reversible") == _REVERSIBLE]
                tried += [self._smoothed(each) for each in planes if has_signs(each)][:1]
        # Without time, a drift or a lag hides what a finer order gains.
        shaped = self.with_shape & {each.candidate.model for each in tried}
        tried += [each for each in operators if each.candidate.model in shaped]
        tried = [self._without_first_rows(each) for each in tried]
        return [each for n, each in enumerate(tried) if each.candidate not in [one.candidate for one in tried[:n]]]

    def _without_first_rows(self, each: Evaluation) -> Evaluation:
        """Return an operator that no word says the memory of without its first rows, which a lag hides too."""
        no_word = self.may_skip and not self.has_one_kind and not find_model(each.candidate.model).saturates
        return _changed(each, initial="skip") if no_word else each

    def _smoothed(self, plane: Evaluation) -> Evaluation:
        """Return a plane with some smoothing, without first rows: a memory found without time is that of no lag."""
        weight = max(plane.candidate.smoothing or 0.0, _SMOOTHING)
        initial = "skip" if self.may_skip else plane.candidate.initial
        return _changed(plane, smoothing=weight, initial=initial)

    def _carry_out(self, works: Sequence[_Work]) -> tuple[list[tuple[_Work, Evaluation]], list[Evaluation]]:
        """Return what is evaluated with time, each beside the work that did so, and what failed."""
        tasks = [(work.name, partial(work.evaluate, work.operator.candidate, self.measured.gap)) for work in works]
        found = [(work, one) for work, ones in zip(works, self.carry(tasks), strict=True) for one in ones]
        # What is left out of the others decides.
        units = bool(self.measured.units())

        def judged_alike(work: _Work, one: Evaluation) -> Evaluation:
            determined, follows = work.operator.determined, work.operator.follows
            return replace(one, determined=determined, follows=follows, units=one.units if units else ())

        usable = [(work, judged_alike(work, one)) for work, one in found if not one.failure]
        return usable, [one for _, one in found if one.failure]

    def _is_possible(self, candidate: Candidate) -> bool:
        """Return whether a candidate can be the operator of a model with time: a free plane would need penalties."""
        operator = self._operator(candidate)
        bounded = find_model(candidate.model).constrained or not operator.densities()
        return bounded and self.in_time.is_small(operator.coefficients.size)

    def _is_cheap(self, candidate: Candidate) -> bool:
        """Return whether a candidate can be evaluated in a small part of the time that others may take."""
        return self.in_time.is_small(_CHEAP * self._operator(candidate).coefficients.size)

    def _operator(self, candidate: Candidate) -> Operator[Any]:
        template = find_model(candidate.model).template
        assert template is not None
        operator: Operator[Any] = template(self.measured.inputs, **candidate.options)
        return operator


def _from_later(work: _Work) -> _Work:
    """Return a work with an operator that leaves first rows out."""
    return work._replace(operator=_changed(work.operator, initial="skip"))


def _changed(each: Evaluation, **settings: Any) -> Evaluation:  # noqa: ANN401 - those of a candidate
    """Return an evaluated operator with other settings of its candidate."""
    return replace(each, candidate=replace(each.candidate, **settings))
