"""The Bouc-Wen operator as a model of a package outside of the bench: this file and an entry point are all.

Source: Ikhouane and Rodellar, Systems with Hysteresis, Wiley, 2007, chapter 3 (normalised form).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from bench.models import ModelSpec, Operator, Shape

# Greatest change of z within one step of integration.
_STEP = 0.02


class State(NamedTuple):
    """Present input, and the internal variable z."""

    input: float
    z: float


@dataclass(frozen=True, eq=False)
class BoucWen(Operator[State]):
    """The normalised Bouc-Wen operator: output = bias + stiffness * input + amplitude * z.

    dz/du = rho (1 - (sigma sgn(z du) + 1 - sigma) |z|^n), so that |z| stays below 1.

    Parameters
    ----------
    stiffness, amplitude : float
        Output units per input unit, and output units.
    bias : float
        Output units.
    rho : float
        Slope of z at zero, per input unit, > 0.
    sigma : float
        Shape of the loop, >= 0.5.
    n : float
        Sharpness of the transition, >= 1.
    input_range : tuple of float
        Operating range, input units.
    """

    kind: ClassVar[str] = "normalised-bouc-wen"
    stiffness: float = 0.0
    amplitude: float = 0.0
    bias: float = 0.0
    rho: float = 1.0
    sigma: float = 1.0
    n: float = 1.0
    input_range: tuple[float, float] = (-1.0, 1.0)
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        numbers = (self.stiffness, self.amplitude, self.bias, self.rho, self.sigma, self.n, *self.input_range)
        if not all(isinstance(value, int | float) and math.isfinite(value) for value in numbers):
            raise ValueError(f"bouc-wen: expected finite numbers, got {numbers}")
        if not (self.rho > 0.0 and self.sigma >= 0.5 and self.n >= 1.0):
            raise ValueError(f"bouc-wen: expected rho > 0, sigma >= 0.5 and n >= 1, got {numbers[3:6]}")
        object.__setattr__(self, "input_range", tuple(self.input_range))

    @property
    def coefficients(self) -> NDArray[np.float64]:
        """Stiffness and amplitude."""
        return np.array([self.stiffness, self.amplitude])

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> BoucWen:
        """Return the same operator with another stiffness, amplitude and bias."""
        stiffness, amplitude = np.asarray(coefficients, dtype=np.float64).tolist()
        return replace(self, stiffness=stiffness, amplitude=amplitude, bias=bias)

    def initial_state(self) -> State:
        """Return the relaxed state at zero input."""
        return State(0.0, 0.0)

    def step(self, state: State, value: float) -> tuple[State, float]:
        """Return state and output after a monotone move."""
        if not math.isfinite(value):
            raise ValueError(f"value: expected a finite number, got {value}")
        z = float(_drive(np.array([value]), state.input, state.z, self.rho, self.sigma, self.n)[0])
        return State(float(value), z), self.bias + self.stiffness * value + self.amplitude * z

    def evaluate(self, inputs: ArrayLike, state: State | None = None) -> NDArray[np.float64]:
        """Return the outputs of a sequence: as the default would, in one compiled loop."""
        sequence = np.asarray(inputs, dtype=np.float64)
        start = state or self.initial_state()
        z = _drive(sequence, start.input, start.z, self.rho, self.sigma, self.n)
        return np.asarray(self.bias + self.stiffness * sequence + self.amplitude * z)

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return that both may have either sign: the amplitude is negative where the output lags behind the input."""
        return np.array([False, False])

    def shape_parameters(self) -> Shape:
        """Return rho, sigma and n with their bounds."""
        reach = self.input_range[1] - self.input_range[0]
        return Shape(
            ("rho", "sigma", "n"),
            (self.rho, self.sigma, self.n),
            (0.05 / reach, 0.5, 1.0),
            (500.0 / reach, 20.0, 10.0),
        )

    def with_shape(self, values: Sequence[float]) -> BoucWen:
        """Return the same operator with other rho, sigma and n."""
        rho, sigma, n = values
        return replace(self, rho=rho, sigma=sigma, n=n)

    def shape_starts(self) -> Sequence[Sequence[float]]:
        """Return a soft and a sharp transition."""
        reach = self.input_range[1] - self.input_range[0]
        return [(4.0 / reach, 1.0, 1.5), (20.0 / reach, 1.0, 1.5), (20.0 / reach, 2.0, 3.0)]


@njit
def _slope(z: float, sign: float, rho: float, sigma: float, n: float) -> float:
    factor = 1.0 if z * sign > 0.0 else 1.0 - 2.0 * sigma
    return sign * rho * (1.0 - factor * abs(z) ** n)


@njit
def _drive(inputs, present, z, rho, sigma, n):  # type: ignore[no-untyped-def]
    result = np.empty(inputs.size)
    for i in range(inputs.size):
        move = inputs[i] - present
        sign = 1.0 if move > 0.0 else -1.0
        count = int(min(np.ceil(abs(move) * rho * max(1.0, 2.0 * sigma) / _STEP), 1e5)) + 1
        h = abs(move) / count
        for _ in range(count):
            k1 = _slope(z, sign, rho, sigma, n)
            k2 = _slope(z + 0.5 * h * k1, sign, rho, sigma, n)
            k3 = _slope(z + 0.5 * h * k2, sign, rho, sigma, n)
            k4 = _slope(z + h * k3, sign, rho, sigma, n)
            z += h * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
        present = inputs[i]
        result[i] = z
    return result


def _template(inputs: NDArray[np.float64], *, input_unit: str = "", output_unit: str = "") -> BoucWen:
    low, high = float(inputs.min()), float(inputs.max())
    return BoucWen(input_range=(low, high), input_unit=input_unit, output_unit=output_unit)


BOUC_WEN = ModelSpec("Bouc-Wen operator with stiffness, normalised", BoucWen, _template)
