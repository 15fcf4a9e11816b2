"""The model with time: the base class of models whose output depends on when their input was applied."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.documents import Model
from bench.models.inverses.inverse import Policy
from bench.models.operator import Operator

S = TypeVar("S")


class TimedModel(Model, ABC, Generic[S]):
    """A model from an input over time to an output, immutable apart from a state S that the caller keeps.

    A subclass is a frozen dataclass with a `kind` of its own and at least the fields below. A state knows at what
    time it is. A sequence that begins later follows after that gap; one whose times begin earlier is a record with a
    clock of its own, and follows after a gap as long as its own first step.

    Attributes
    ----------
    input_range : tuple of float
        The range of the inputs from which the model was identified, input units.
    input_unit, output_unit : str
        Units, for labels.
    starts : tuple of str
        The words by which `start` knows states before a first sample; "skip" is the initial state where the first
        samples do not count.
    inverse_method : str
        How `follow` finds inputs: none, or exact.
    """

    starts: ClassVar[tuple[str, ...]] = ()
    inverse_method: ClassVar[str] = "none"

    input_range: tuple[float, float]
    input_unit: str
    output_unit: str

    @property
    def delay(self) -> float:
        """Time before which no input has an effect, s; 0 by default."""
        return 0.0

    def ahead(self, state: S) -> tuple[TimedModel[S], S]:
        """Return the model whose output is that of this one a delay later, with its state; by default this one."""
        return self, state

    @abstractmethod
    def run(self, times: ArrayLike, inputs: ArrayLike, state: S | None = None) -> tuple[Floats, S]:
        """Return the outputs of a sequence, shape (N,), and the state after it.

        Parameters
        ----------
        times : array_like, shape (N,)
            s, strictly increasing; the steps need not be even.
        inputs : array_like, shape (N,)
            Input units.
        state : S or None
            The state before the first sample; default the initial state.

        Raises
        ------
        ValueError
            If a sequence is empty, not finite, not of equal length, or the times do not increase.
        """

    def follow(
        self,
        times: ArrayLike,  # noqa: ARG002
        targets: ArrayLike,  # noqa: ARG002
        state: S | None = None,  # noqa: ARG002
        policy: Policy = "nearest",  # noqa: ARG002
    ) -> Floats:
        """Return the inputs that bring the output to one target after another, shape (N,).

        A target out of reach is given the input that comes closest. Times and state as for `run`.

        Parameters
        ----------
        targets : array_like, shape (N,)
            Output units.
        policy : {"nearest", "paper"}
            Which answer is taken where there are several; see `Inverse`.

        Raises
        ------
        ValueError
            If the model has no inverse, or none at these times, or a sequence is unfit.
        """
        raise ValueError(f"a model of the kind {self.kind} has no inverse")

    @abstractmethod
    def initial_state(self) -> S:
        """Return the state from which identification starts."""

    @abstractmethod
    def start(self, word: str) -> S:
        """Return the state before a first sample that one of `starts` names."""

    def at_rest(self, state: S) -> tuple[Operator[Any], Any] | None:  # noqa: ARG002
        """Return the operator that the output settles to while the input stands still, with its state.

        None, which is the default, if there is none. A drift goes on, and is left out.
        """
        return None

    def unknown_until(self, inputs: ArrayLike) -> int:  # noqa: ARG002
        """Return the first sample from which inputs, shape (N,), have overwritten all memory they ever do."""
        return 0

    @abstractmethod
    def parameters(self) -> Mapping[str, tuple[float, str]]:
        """Return what a person should know of the model: number and unit by name."""

    def structure(self) -> Mapping[str, Any]:
        """Return the options of a fit that leave no part of this model to be chosen; by default none."""
        return {}

    @abstractmethod
    def state_to_json(self, state: S) -> Any:  # noqa: ANN401 - any JSON that the model chooses
        """Return a state as JSON."""

    @abstractmethod
    def state_from_json(self, document: Any) -> S:  # noqa: ANN401
        """Return the state that `state_to_json` wrote.

        Raises ValueError if it is no state of this model.
        """

    def evaluate(self, times: ArrayLike, inputs: ArrayLike, state: S | None = None) -> Floats:
        """Return the outputs of a sequence, shape (N,); arguments and errors as `run`."""
        return self.run(times, inputs, state)[0]

    def at(self, times: ArrayLike) -> TimedSequence:
        """Return the model at given times, s: what takes inputs alone, as an operator does."""
        return TimedSequence(self, check_times(times))


@dataclass(frozen=True, eq=False)
class TimedSequence:
    """A model with time for inputs at known times.

    Attributes
    ----------
    model : TimedModel
        The model.
    times : ndarray, shape (N,)
        s, strictly increasing.
    """

    model: TimedModel[Any]
    times: Floats

    def evaluate(self, inputs: ArrayLike, state: Any = None) -> Floats:  # noqa: ANN401 - the model's own
        """Return the outputs to inputs, shape (N,); as `TimedModel.evaluate`."""
        return self.model.evaluate(self.times, inputs, state)

    def first(self, rows: int) -> TimedSequence:
        """Return the model at the first of its times."""
        return TimedSequence(self.model, self.times[:rows])

    @property
    def input_range(self) -> tuple[float, float]:
        """That of the model, input units."""
        return self.model.input_range

    @property
    def input_unit(self) -> str:
        """That of the model."""
        return self.model.input_unit


def check_times(times: ArrayLike) -> Floats:
    """Return times as an array, s, or raise ValueError if they are not finite and strictly increasing."""
    return _checks.increasing("times", times)


def check_sequence(times: ArrayLike, **columns: ArrayLike) -> tuple[Floats, ...]:
    """Return times and columns of the same length as arrays, or raise ValueError."""
    clock = check_times(times)
    each = "values, one for each time"
    return clock, *(_checks.counted(name, values, clock.size, each) for name, values in columns.items())
