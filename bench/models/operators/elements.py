"""Operators made of elements that each remember one number, such as a play or a stop."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.operator import Operator
from bench.models.regressor import Regressor

ElementState: TypeAlias = tuple[float, ...]
"""The present input, then what each element remembers."""

# Numbers of a block of columns, so that a long sequence does not need them all at once.
# Derivation: eight MiB of float64, about what the last cache of a processor holds.
_BLOCK = 2**20


class ElementOperator(Operator[ElementState]):
    """An operator of elements: its coefficients multiply columns that the elements give.

    A subclass defines `respond` and `at_rest` beside `coefficients` and `with_coefficients`. The state is a tuple of
    the present input and what each element remembers.
    """

    @abstractmethod
    def respond(self, inputs: Floats, present: float, elements: Floats) -> Floats:
        """Return the columns of a sequence, shape (N, K), from a present input.

        `inputs` has the shape (N,), in input units; `elements`, shape (E,), is changed to what the elements remember
        after the sequence.
        """

    @abstractmethod
    def at_rest(self) -> tuple[float, Floats]:
        """Return the input of the relaxed state, and what the elements remember there, shape (E,)."""

    def initial_state(self) -> ElementState:
        """Return the relaxed state."""
        present, elements = self.at_rest()
        return (present, *elements.tolist())

    def present_input(self, state: ElementState) -> float:
        """Return the input that a state stands at."""
        return state[0]

    def _split(self, state: ElementState | None) -> tuple[float, Floats]:
        """Return the present input and a copy of the elements of a state."""
        present, elements = self.at_rest()
        if state is not None:
            numbers = _checks.counted("state", state, elements.size + 1, "numbers")
            present, elements = float(numbers[0]), numbers[1:]
        return present, elements.copy()

    def evaluate(self, inputs: ArrayLike, state: ElementState | None = None) -> Floats:
        """Return the outputs of a sequence, shape (N,), from `state` (default: relaxed).

        Raises ValueError if `inputs` is empty, not one-dimensional or not finite, or `state` has the wrong length.
        """
        return self._run(inputs, state)[0]

    def advance(self, state: ElementState, inputs: ArrayLike) -> ElementState:
        """Return the state after a sequence of inputs, shape (N,); errors as `evaluate`."""
        return self._run(inputs, state)[1]

    def _run(self, inputs: ArrayLike, state: ElementState | None) -> tuple[Floats, ElementState]:
        sequence = _checks.samples("inputs", inputs)
        present, elements = self._split(state)
        outputs = np.empty(sequence.size)
        rows = max(1, _BLOCK // self._weights.size)
        for first in range(0, sequence.size, rows):
            block = sequence[first : first + rows]
            outputs[first : first + rows] = self.respond(block, present, elements) @ self._weights
            present = float(block[-1])
        return self.bias + outputs, (present, *elements.tolist())

    def step(self, state: ElementState, value: float) -> tuple[ElementState, float]:
        """Return state and output after the input moved monotonically to `value`.

        Raises ValueError if `value` is not finite or the state has the wrong length.
        """
        if not math.isfinite(value):
            raise ValueError(f"value: expected a finite number, got {value}")
        if len(state) != self._size:
            raise ValueError(f"state: expected {self._size} numbers, got {len(state)}")
        elements = np.array(state[1:])
        row = self.respond(np.array([value], dtype=np.float64), state[0], elements)[0]
        return (float(value), *elements.tolist()), self.bias + float(row @ self._weights)

    @cached_property
    def _size(self) -> int:
        return 1 + self.at_rest()[1].size

    @cached_property
    def _weights(self) -> Floats:
        return self.coefficients

    def regressor(self, inputs: ArrayLike, state: ElementState | None = None) -> Regressor:
        """Return the dense columns of the elements; errors as `evaluate`."""
        present, elements = self._split(state)
        return Regressor.of_columns(self.respond(_checks.samples("inputs", inputs), present, elements))

    def _rising(self) -> bool | None:
        """Return the direction of the output, where the columns rise: None if the coefficients differ in sign."""
        values = self.coefficients
        return True if (values >= 0.0).all() else False if (values <= 0.0).all() else None
