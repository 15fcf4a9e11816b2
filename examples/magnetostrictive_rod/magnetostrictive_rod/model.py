"""A hysteresis operator for magnetostriction: plays, saturated and squared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.models import ModelSpec, Operator, Regressor, Shape

Floats = NDArray[np.float64]
State = tuple[float, ...]
"""The outputs of the plays; the first has no threshold, so it is the input."""


@dataclass(frozen=True, eq=False)
class QuadraticPlay(Operator[State]):
    """A sum of squares: output = bias + Σ weights[k] tanh²(play_k(input) / width).

    The play is that of Brokate and Sprekels, *Hysteresis and Phase Transitions*, 1996, section 2.3; tanh stands for
    the magnetization, its square for the strain.

    Parameters
    ----------
    thresholds : tuple of float, shape (K,)
        Of the plays, input units; the first is 0, the others rise.
    weights : tuple of float, shape (K,)
        Output units.
    bias : float
        Output of the demagnetized rod, output units.
    width : float
        Input at which the magnetization saturates, > 0, input units.
    input_range : tuple of float
        Operating range, input units.
    """

    kind: ClassVar[str] = "quadratic-play"
    thresholds: tuple[float, ...] = (0.0,)
    weights: tuple[float, ...] = (0.0,)
    bias: float = 0.0
    width: float = 1.0
    input_range: tuple[float, float] = (-1.0, 1.0)
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        for name in ("thresholds", "weights", "input_range"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not (np.isfinite((*self.weights, *self.thresholds, self.bias)).all() and 0.0 < self.width < np.inf):
            raise ValueError(f"{self.kind}: expected finite numbers and a width > 0")
        if self.thresholds[0] != 0.0 or (np.diff(self.thresholds) <= 0.0).any():
            raise ValueError(f"thresholds: expected 0 and rising numbers, got {self.thresholds}")
        if len(self.weights) != len(self.thresholds):
            raise ValueError(f"weights: expected {len(self.thresholds)}, got {len(self.weights)}")

    @property
    def coefficients(self) -> Floats:
        """The weights."""
        return np.array(self.weights)

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> QuadraticPlay:
        """Return the same operator with other weights and bias."""
        return replace(self, weights=tuple(np.asarray(coefficients, dtype=np.float64).tolist()), bias=bias)

    def initial_state(self) -> State:
        """Return the demagnetized state."""
        return (0.0,) * len(self.thresholds)

    def present_input(self, state: State) -> float:
        """Return the input that a state stands at."""
        return state[0]

    def step(self, state: State, value: float) -> tuple[State, float]:
        """Return state and output after a monotone move."""
        plays = self._plays([value], state)
        return tuple(plays[0].tolist()), float(self._outputs(plays)[0])

    def evaluate(self, inputs: ArrayLike, state: State | None = None) -> Floats:
        """Return the outputs of a sequence, shape (N,)."""
        return self._outputs(self._plays(inputs, state))

    def regressor(self, inputs: ArrayLike, state: State | None = None) -> Regressor:
        """Return the squares, shape (N, K): all at once, where the default evaluates one column after another."""
        return Regressor.of_columns(np.tanh(self._plays(inputs, state) / self.width) ** 2)

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return that weights may have either sign, as they correct each other."""
        return np.zeros(len(self.weights), dtype=bool)

    def shape_parameters(self) -> Shape:
        """Return the width and its bounds."""
        reach = self.input_range[1] - self.input_range[0]
        return Shape(("width",), (self.width,), (0.02 * reach,), (2.0 * reach,))

    def with_shape(self, values: Sequence[float]) -> QuadraticPlay:
        """Return the same operator with another width."""
        return replace(self, width=float(values[0]))

    def _outputs(self, plays: Floats) -> Floats:
        return np.asarray(self.bias + np.tanh(plays / self.width) ** 2 @ self.coefficients)

    def _plays(self, inputs: ArrayLike, state: State | None) -> Floats:
        sequence = np.asarray(inputs, dtype=np.float64)
        if sequence.ndim != 1 or not sequence.size or not np.isfinite(sequence).all():
            raise ValueError("inputs: expected finite numbers, shape (N,)")
        thresholds, plays = np.array(self.thresholds), np.array(self.initial_state() if state is None else state)
        result = np.empty((sequence.size, plays.size))
        for i, value in enumerate(sequence):
            plays = np.clip(plays, value - thresholds, value + thresholds)
            result[i] = plays
        return result


def _template(inputs: Floats, *, plays: int = 8, input_unit: str = "", output_unit: str = "") -> QuadraticPlay:
    low, high = float(inputs.min()), float(inputs.max())
    thresholds = tuple((0.25 * (high - low) * np.arange(plays) / plays).tolist())
    return QuadraticPlay(
        thresholds,
        (0.0,) * plays,
        width=0.3 * (high - low),
        input_range=(low, high),
        input_unit=input_unit,
        output_unit=output_unit,
    )


QUADRATIC_PLAY = ModelSpec("squares of saturated plays, for magnetostriction", QuadraticPlay, _template)
