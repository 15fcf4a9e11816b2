"""A polynomial of the input and polynomials of plays, with coefficients of either sign.

A sum of functions of plays is an operator of Prandtl-Ishlinskii type whose density depends on the output of each play
(Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989). Beyond the range of the inputs each polynomial is
continued by its tangent at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.models.operators.elements import ElementOperator, ElementState
from bench.models.operators.polynomial import chebyshev_terms


@dataclass(frozen=True, eq=False)
class PolynomialPlays(ElementOperator):
    """A Chebyshev series of the input, and one of each play. The state is the input and the plays.

    Parameters
    ----------
    series : array_like, shape (degree,)
        Coefficients of T1 to Tn on the range mapped to [-1, 1], output units.
    thresholds : array_like, shape (n,)
        Half-widths of the plays, > 0, increasing, input units.
    weights : array_like, shape (powers n,)
        Weights of the plays, output units per input unit; then those of T2 of each play, T3 and so on, output units.
        A play of threshold r is mapped from the range less r at both ends to [-1, 1].
    input_range : tuple of float
        The range mapped to [-1, 1], input units; half of it exceeds the thresholds of plays with powers.
    powers : int
        Degree of the series of each play, >= 1.
    origin : float or None
        Input of the relaxed state, in which all plays stand at the input; None for the state of negative saturation.
    bias, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If series or plays are empty or not finite, lengths differ, or thresholds or the range do not increase or do
        not suit each other.
    """

    kind: ClassVar[str] = "polynomial-plays"
    added: ClassVar[tuple[str, ...]] = ("powers", "origin")
    series: Floats
    thresholds: Floats
    weights: Floats
    input_range: tuple[float, float]
    bias: float = 0.0
    input_unit: str = ""
    output_unit: str = ""
    powers: int = 1
    origin: float | None = None

    def __post_init__(self) -> None:
        thresholds = _checks.increasing("thresholds", self.thresholds, least=1)
        if thresholds[0] <= 0.0:
            raise ValueError(f"thresholds: expected positive values, got {thresholds[0]}")
        if self.powers < 1:
            raise ValueError(f"powers: expected at least 1, got {self.powers}")
        count = self.powers * thresholds.size
        weights = _checks.counted("weights", self.weights, count, f"values, {self.powers} for each play")
        series = _checks.samples("series", self.series)
        origin = () if self.origin is None else ("origin",)
        self._settle(*origin, series=series, thresholds=thresholds, weights=weights)
        low, high = self.input_range
        if self.powers > 1 and not thresholds[-1] < 0.5 * (high - low):
            raise ValueError(
                f"thresholds: expected values below half the input range, {0.5 * (high - low):g}, for powers of "
                f"plays; got {thresholds[-1]:g}"
            )

    @property
    def coefficients(self) -> Floats:
        """Weights of the plays, then coefficients of T1 to Tn, shape (powers n + degree,)."""
        return np.concatenate([self.weights, self.series])

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> PolynomialPlays:
        """Return the same operator with other coefficients, shape (powers n + degree,), and bias."""
        weights, series = np.split(self._coefficients(coefficients), [self.weights.size])
        return replace(self, weights=weights, series=series, bias=bias)

    def at_rest(self) -> tuple[float, Floats]:
        """Return the origin, at which all plays stand; without one the low end in negative saturation."""
        if self.origin is not None:
            return self.origin, np.full(self.thresholds.size, self.origin)
        low = self.input_range[0]
        return low, low + self.thresholds

    def saturated_state(self, direction: int, value: float | None = None) -> ElementState:
        """Return the state at the low (-1) or high (1) end, or at a value, entered from far beyond the other end.

        Raises ValueError if `direction` is neither -1 nor 1.
        """
        _, end = self._ends(direction)
        at = end if value is None else value
        return (at, *(at - direction * self.thresholds).tolist())

    def respond(self, inputs: Floats, present: float, elements: Floats) -> Floats:  # noqa: ARG002
        """Return the columns of the plays, of T2 and so on of the plays, and of T1 to Tn of the input."""
        from bench.models.kernels import memory_kernels as _kernels

        low, high = self.input_range
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        plays = np.asarray(_kernels.plays(inputs, inputs, self.thresholds, elements))
        columns = [plays]
        if self.powers > 1:
            series = chebyshev_terms((plays - middle) / (half - self.thresholds), self.powers)
            columns += [series[..., power] for power in range(1, self.powers)]
        columns.append(chebyshev_terms((inputs - middle) / half, self.series.size))
        return np.column_stack(columns)

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return False for each coefficient: their signs are free."""
        return np.zeros(self.coefficients.size, dtype=bool)
