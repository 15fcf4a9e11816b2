"""The Bouc-Wen operator, rate-independent: a spring beside an internal variable that follows the input and yields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.models.operator import Shape
from bench.models.operators.elements import ElementOperator


@dataclass(frozen=True, eq=False)
class BoucWen(ElementOperator):
    """The Bouc-Wen operator: output = bias + stiffness (u - origin) + hysteretic z.

    dz/du = 1 - (beta sgn(z du) + gamma) |z / scale|^exponent (Bouc 1967; Wen 1976; Ikhouane and Rodellar, Systems
    with Hysteresis, 2007, chapter 2). The form z' = A u' - β |u'| |z|^(n-1) z - γ u' |z|^n is its multiple:
    hysteretic = A, β = A beta / (A scale)^n, γ likewise. For an exponent of 1 the solution is exact from one input to
    the next, otherwise it is integrated to about 1e-8 of the scale; |z| is kept below 1e6 of it. The hysteretic part
    leads the input where it is positive, as friction does, and lags where it is negative, as an actuator does.

    Parameters
    ----------
    stiffness, hysteretic : float
        Output units per input unit, of either sign.
    beta : float
        Loss, >= 0.
    gamma : float
        Softening (> 0) or stiffening (< 0) of both branches; with beta + gamma > 0, |z| stays below
        scale (beta + gamma)^(-1 / exponent).
    exponent : float
        Sharpness of the yield, >= 1.
    scale : float
        Unit of z, input units, > 0; half the operating range unless chosen.
    origin : float
        Input of the relaxed state, z = 0, input units.
    bias, input_range, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If a number is not finite, beta < 0, exponent < 1, scale <= 0, or the range does not increase.
    """

    kind: ClassVar[str] = "bouc-wen"
    stiffness: float = 0.0
    hysteretic: float = 0.0
    bias: float = 0.0
    beta: float = 1.0
    gamma: float = 0.0
    exponent: float = 1.0
    scale: float = 1.0
    origin: float = 0.0
    input_range: tuple[float, float] = (-1.0, 1.0)
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        numbers = "stiffness", "hysteretic", "beta", "gamma", "exponent", "origin"
        self._settle(*numbers, scale=_checks.positive("scale", self.scale))
        if self.beta < 0.0:
            raise ValueError(f"beta: expected a number >= 0, got {self.beta}")
        if self.exponent < 1.0:
            raise ValueError(f"exponent: expected a number >= 1, got {self.exponent}")

    @property
    def coefficients(self) -> Floats:
        """Stiffness and hysteretic part, shape (2,)."""
        return np.array([self.stiffness, self.hysteretic])

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> BoucWen:
        """Return the same operator with another stiffness, hysteretic part and bias."""
        stiffness, hysteretic = self._coefficients(coefficients).tolist()
        return replace(self, stiffness=stiffness, hysteretic=hysteretic, bias=bias)

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return that both may have either sign."""
        return np.zeros(2, dtype=bool)

    def at_rest(self) -> tuple[float, Floats]:
        """Return the origin, and z = 0."""
        return self.origin, np.zeros(1)

    def respond(self, inputs: Floats, present: float, elements: Floats) -> Floats:
        """Return u - origin and z, shape (N, 2)."""
        from bench.models.kernels import element_kernels as _element_kernels

        scale = self.scale
        z = scale * _element_kernels.bouc_wen(
            inputs / scale, present / scale, elements[0] / scale, self.beta, self.gamma, self.exponent
        )
        elements[0] = z[-1]
        return np.column_stack([inputs - self.origin, z])

    def shape_parameters(self) -> Shape:
        """Return beta, gamma and exponent with their bounds."""
        return Shape(
            ("beta", "gamma", "exponent"), (self.beta, self.gamma, self.exponent), (0.0, -5.0, 1.0), (1e4, 1e4, 8.0)
        )

    def with_shape(self, values: Sequence[float]) -> BoucWen:
        """Return the same operator with another beta, gamma and exponent."""
        beta, gamma, exponent = values
        return replace(self, beta=beta, gamma=gamma, exponent=exponent)

    def shape_starts(self) -> Sequence[Sequence[float]]:
        """Return soft and sharp yields, early and late."""
        return [
            (total * loss, total * (1.0 - loss), exponent)
            for exponent in (1.0, 2.0)
            for yields in (0.05, 0.2, 0.6, 1.5)
            for loss in (0.5, 1.0)
            if (total := yields**-exponent)
        ]
