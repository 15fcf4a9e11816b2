"""The hysteresis operator: the base class of every model from one input to one output."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.models.coverage import Coverage
from bench.models.documents import Model
from bench.models.memory import overwritten_from
from bench.models.regressor import Regressor
from bench.models.streams.stream import Stream

if TYPE_CHECKING:
    from bench.models.inverses.inverse import Inverse, Policy

S = TypeVar("S")

# Samples of the operating range by which the defaults look for extrema and for falling parts.
# Derivation: a smooth extremum between two of 1000 parts is met to 1 / (8 · 1000²), 1e-7 of the curvature's scale.
_SAMPLES = 1001


class Shape(NamedTuple):
    """Parameters on which the output does not depend linearly: values and bounds, each of shape (n,)."""

    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()


class Operator(Model, ABC, Generic[S]):
    """A rate-independent model from input to output, immutable apart from a state S that the caller keeps.

    The output is `bias` + regressor @ `coefficients`. A subclass is a frozen dataclass with a `kind` of its own
    and at least the fields below. It must define `coefficients`, `with_coefficients`, `initial_state` and `step`;
    all else has a default that follows from these, and is overridden where something faster or exact is known.
    A state is a NamedTuple or tuple of numbers, or None; one whose present input is not called `input` overrides
    `present_input`, one that is not made of numbers `state_to_json` and `state_from_json`.

    Attributes
    ----------
    bias : float
        The constant part of the output, output units.
    input_range : tuple of float
        The operating range of the input, input units.
    input_unit, output_unit : str
        Units, for labels.
    memoryless : bool
        Whether the output depends on the present input alone; the state then is None.
    inverse_method : str
        How `inverse` finds set-points: numerical, exact, or a table.
    """

    bias: float
    input_range: tuple[float, float]
    input_unit: str
    output_unit: str
    memoryless: ClassVar[bool] = False
    inverse_method: ClassVar[str] = "numerical"

    @property
    @abstractmethod
    def coefficients(self) -> Floats:
        """The coefficients without the bias, shape (K,)."""

    @abstractmethod
    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> Self:
        """Return the same operator with other coefficients, shape (K,), and bias.

        Raises ValueError if their number is wrong or one is not finite or not possible.
        """

    def _coefficients(self, values: ArrayLike) -> Floats:
        """Return coefficients as `_checks.samples` does; ValueError if they are not as many as the present ones."""
        return _checks.counted("coefficients", values, self.coefficients.size)

    def _settle(self, *numbers: str, span: tuple[float, float] | None = None, **checked: Floats | float) -> None:
        """Set `checked` fields, arrays read-only, and finite `numbers`, the bias and the range (default `span`)."""
        values: dict[str, Any] = dict(checked)
        for name in ("bias", *numbers):
            values[name] = _checks.number(name, getattr(self, name))
        given: Any = self.input_range
        given = span if given is None else given
        low, high = _checks.increasing("input_range", given).tolist()
        values["input_range"] = (low, high)
        for name, value in values.items():
            object.__setattr__(self, name, _checks.frozen(value) if isinstance(value, np.ndarray) else value)

    @abstractmethod
    def initial_state(self) -> S:
        """Return the state from which identification starts."""

    @abstractmethod
    def step(self, state: S, value: float) -> tuple[S, float]:
        """Return state and output after the input moved monotonically to `value`.

        Raises ValueError if `value` is not finite.
        """

    def evaluate(self, inputs: ArrayLike, state: S | None = None) -> Floats:
        """Return the outputs of a sequence, shape (N,), from `state` (default: the initial state).

        Raises ValueError if `inputs` is empty, not one-dimensional or not finite.
        """
        outputs = []
        memory = self.initial_state() if state is None else state
        for value in _checks.samples("inputs", inputs).tolist():
            memory, output = self.step(memory, value)
            outputs.append(output)
        return np.array(outputs)

    def advance(self, state: S, inputs: ArrayLike) -> S:
        """Return the state after a sequence of inputs, shape (N,); errors as `evaluate`."""
        for value in _checks.samples("inputs", inputs).tolist():
            state, _ = self.step(state, value)
        return state

    def present_input(self, state: S) -> float:
        """Return the input that a state stands at."""
        return float(state.input)  # type: ignore[attr-defined]

    def value(self, state: S) -> float:
        """Return the output of a state."""
        return self.step(state, self.present_input(state))[1]

    def stream(self, state: S | None = None) -> Stream[S]:
        """Return the operator with a memory of its own, for one sample at a time, from a state (default: initial)."""
        return Stream(self, self.initial_state() if state is None else state)

    def saturated_state(self, direction: int, value: float | None = None) -> S:
        """Return the state at an input that was reached from far beyond the other end of the operating range.

        Parameters
        ----------
        direction : {-1, 1}
            Low (-1) or high (1) end of the operating range.
        value : float or None
            Input of the state; default that end.

        Raises
        ------
        ValueError
            If `direction` is neither -1 nor 1.
        """
        far, end = self._ends(direction)
        return self.advance(self.initial_state(), [far, end, end if value is None else value])

    def _ends(self, direction: int) -> tuple[float, float]:
        """Return the end of the operating range that a saturation comes from, and the one that it is at."""
        if direction not in (-1, 1):
            raise ValueError(f"direction: expected -1 or 1, got {direction!r}")
        low, high = self.input_range
        return (high, low) if direction < 0 else (low, high)

    def regressor(self, inputs: ArrayLike, state: S | None = None) -> Regressor:
        """Return the matrix R with evaluate(inputs, state) = bias + R @ coefficients; errors as `evaluate`."""
        units = np.eye(self.coefficients.size)
        return Regressor.of_columns(
            np.column_stack([self.with_coefficients(unit, 0.0).evaluate(inputs, state) for unit in units])
        )

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return which coefficients must not be negative, shape (K,); by default all.

        Of a model that is fitted falling they must not be positive: `with_coefficients` takes either.
        """
        return np.ones(self.coefficients.size, dtype=bool)

    def shape_parameters(self) -> Shape:
        """Return the parameters that identification varies beside the coefficients; by default none."""
        return Shape()

    def count_beside_coefficients(self) -> int:
        """Return the number of parameters that identification finds beside the coefficients: by default the shape."""
        return len(self.shape_parameters().values)

    def with_shape(self, values: Sequence[float]) -> Self:
        """Return the same operator with other shape parameters, shape (n,)."""
        if len(values):
            raise ValueError(f"values: expected none, as a {self.kind} operator has no shape, got {len(values)}")
        return self

    def shape_starts(self) -> Sequence[Sequence[float]]:
        """Return the shapes from which their fit starts; the best end is taken. By default the present one."""
        return [self.shape_parameters().values]

    def shifted(self, offset: float) -> Self:
        """Return the operator whose output at an input u is that of this one at u + offset, input units.

        Raises ValueError if the offset is not finite, or such an operator cannot be shifted.
        """
        raise ValueError(f"the input of a {self.kind} operator cannot be shifted (by {offset:g} {self.input_unit})")

    def output_range(self) -> tuple[float, float]:
        """Return least and greatest output over all reachable states; by default those of the major loop."""
        low, high = self.input_range
        up = np.linspace(low, high, _SAMPLES)
        outputs = self.evaluate(np.concatenate([up, up[::-1]]), self.saturated_state(-1))
        return float(outputs.min()), float(outputs.max())

    def rises(self) -> bool:
        """Return whether the output never falls while the input rises; by default as sampled from the start."""
        outputs = self.evaluate(np.linspace(*self.input_range, _SAMPLES))
        return not (np.diff(outputs) < -1e-14 * np.abs(outputs).max()).any()

    def inverse(self, policy: Policy = "nearest") -> Inverse[S]:
        """Return the inverse: numerical by default, by bisection over the pieces on which the output is monotone.

        Parameters
        ----------
        policy : {"nearest", "paper"}
            Which answer is taken where there are several; see `Inverse`.
        """
        from bench.models.inverses.inverse import NumericalInverse

        return NumericalInverse(self, policy)

    @property
    def input_units(self) -> tuple[str, ...]:
        """The units of the inputs that the model is for, the usual one first; none if it is for any."""
        return ()

    @property
    def plane(self) -> tuple[float, float] | None:
        """The range beyond which no part of the memory remains, input units; None if there is none."""
        return None

    def unknown_until(self, inputs: ArrayLike) -> int:
        """Return the first sample from which the inputs, shape (N,), have overwritten all memory they ever do."""
        return 0 if self.memoryless else overwritten_from(inputs, self.plane)

    def coverage(self, inputs: ArrayLike, state: S | None = None) -> Coverage | None:  # noqa: ARG002
        """Return which cells of the plane a sequence sweeps; None for an operator without a plane."""
        return None

    def state_to_json(self, state: S) -> Any:  # noqa: ANN401 - any JSON that the operator chooses
        """Return a state as JSON: by default a list of its numbers, or null."""
        return None if state is None else list(state)  # type: ignore[call-overload]

    def state_from_json(self, document: Any) -> S:  # noqa: ANN401
        """Return the state that `state_to_json` wrote.

        Raises ValueError if it is no state of this operator.
        """
        state: Any = self.initial_state()
        if state is None:
            if document is not None:
                raise ValueError(f"memory: expected none, as a {self.kind} operator keeps none, got {document!r}")
        elif not isinstance(document, list):
            raise ValueError(f"memory: expected a list of numbers, got {document!r}")
        elif len(document) != len(state):
            raise ValueError(f"memory: expected {len(state)} numbers, got {len(document)}")
        else:
            values = [_checks.number("memory", value) for value in document]
            state = getattr(type(state), "_make", tuple)(values)
        result: S = state
        return result


def operator_from_json(document: Mapping[str, Any]) -> Operator[Any]:
    """Return the operator that the `to_json` of a registered class wrote.

    Raises ValueError if the type is unknown, no operator, or the object is not what that type expects.
    """
    from bench.models.registered_models import model_from_json

    model = model_from_json(document)
    if not isinstance(model, Operator):
        raise ValueError(f"operator: expected a model of one input and one output, got the type {document['type']!r}")
    return model
