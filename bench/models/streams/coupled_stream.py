"""Streams of the models from voltage and force to length: a memory of their own, one sample at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from bench.base import checks as _checks

if TYPE_CHECKING:
    from bench.models.operators.two_stage import Coupled, TwoStage

S = TypeVar("S")


class CoupledStream(Generic[S]):
    """A model from voltage and force to length, and its present state, which `step` changes."""

    def __init__(self, model: Coupled[S], state: S) -> None:
        self.model = model
        self._state = state

    def step(self, voltage: float, force: float) -> float:
        """Move both inputs monotonically to new values, force first, and return the length; units of the model.

        Raises ValueError, without a move, if a number is not finite.
        """
        self._state, length = self.model.step(self._state, voltage, force)
        return length

    @property
    def state(self) -> S:
        """Present state, as a value."""
        return self._state

    def __reduce__(self) -> tuple[type[Any], tuple[Any, Any]]:
        # A copy has arrays of its own.
        return type(self), (self.model, self.state)


@dataclass(frozen=True, slots=True)
class TwoStageState:
    """The memories of both stages and where they are now.

    Parameters
    ----------
    voltage, force : float
        Present inputs.
    first, second : object
        States of the two operators.
    blocked : float
        Output of the first stage, the force at resting length, force units.
    argument : float
        Input of the second stage, force - blocked.
    length : float
        Output of the second stage, length units.
    """

    voltage: float
    force: float
    first: Any
    second: Any
    blocked: float
    argument: float
    length: float


class TwoStageStream(CoupledStream[TwoStageState]):
    """The two-stage model and its memories, each a stream; equal to `TwoStage.evaluate` to the last bit.

    Attributes
    ----------
    force, argument, length : float
        Present ones, as in `TwoStageState`.
    """

    model: TwoStage

    def __init__(self, model: TwoStage, state: TwoStageState) -> None:
        self.model = model
        self._first, self._second = model.first.stream(state.first), model.second.stream(state.second)
        self._step_first, self._step_second = self._first.step, self._second.step
        self._voltage, self.force = state.voltage, state.force
        self._blocked, self.argument, self.length = state.blocked, state.argument, state.length

    def step(self, voltage: float, force: float, *, together: bool = False) -> float:
        """Move both inputs to new values and return the length; see `CoupledStream.step`.

        With `together` the argument u moves straight to its new value, otherwise the force comes first.
        """
        # Less than two calls: only of a finite number the difference to itself is zero.
        if not (voltage - voltage == 0.0 and force - force == 0.0):
            _checks.number("voltage", voltage)
            _checks.number("force", force)
        if not together and force != self.force:
            self._step_second(force - self._blocked)
        if voltage != self._voltage:
            self._blocked = self._step_first(voltage)
            self._voltage = float(voltage)
        self.force = force = float(force)
        self.argument = argument = force - self._blocked
        self.length = length = self._step_second(argument)
        return length

    def move(self, voltage: float, argument: float) -> float:
        """Move voltage and argument u to new values, the force follows; return the length; see `TwoStage.move`."""
        if not (voltage - voltage == 0.0 and argument - argument == 0.0):
            _checks.number("voltage", voltage)
            _checks.number("argument", argument)
        self.argument = argument = float(argument)
        if voltage != self._voltage:
            self._blocked = self._step_first(voltage)
            self._voltage = float(voltage)
        self.force = argument + self._blocked
        self.length = length = self._step_second(argument)
        return length

    @property
    def state(self) -> TwoStageState:
        """Present state, as a value."""
        return TwoStageState(
            self._voltage,
            self.force,
            self._first.state,
            self._second.state,
            self._blocked,
            self.argument,
            self.length,
        )
