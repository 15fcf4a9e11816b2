"""A single-valued polynomial: the model without hysteresis that others are compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.models.inverses.inverse import Policy, TableInverse
from bench.models.operator import Operator
from bench.models.regressor import Regressor


@dataclass(frozen=True, eq=False)
class Polynomial(Operator[None]):
    """A polynomial of the input, as Chebyshev series on the range mapped to [-1, 1].

    Beyond the range it is continued by its tangent at the end.

    Parameters
    ----------
    series : array_like, shape (degree,)
        Coefficients of T1 to Tn, output units.
    input_range : tuple of float
        The range mapped to [-1, 1], input units.
    bias : float
        Coefficient of T0, output units.
    input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If the series is empty or not finite, or the range not increasing.
    """

    kind: ClassVar[str] = "polynomial"
    inverse_method: ClassVar[str] = "table"
    memoryless: ClassVar[bool] = True
    series: Floats
    input_range: tuple[float, float]
    bias: float = 0.0
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        self._settle(series=_checks.samples("series", self.series))

    @property
    def degree(self) -> int:
        """The polynomial's degree."""
        return self.series.size

    @property
    def coefficients(self) -> Floats:
        """Coefficients of T1 to Tn, shape (degree,)."""
        return self.series

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> Polynomial:
        """Return the same polynomial with other coefficients, shape (degree,)."""
        return Polynomial(self._coefficients(coefficients), self.input_range, bias, self.input_unit, self.output_unit)

    def initial_state(self) -> None:
        """Return None: a polynomial remembers nothing."""

    def advance(self, state: None, inputs: ArrayLike) -> None:
        """Return None."""

    def _mapped(self, inputs: Floats) -> Floats:
        low, high = self.input_range
        return (2.0 * inputs - (low + high)) / (high - low)

    def evaluate(self, inputs: ArrayLike, state: None = None) -> Floats:  # noqa: ARG002
        """Return the outputs, shape (N,)."""
        mapped = self._mapped(_checks.samples("inputs", inputs))
        # By Clenshaw's recurrence, input by input: a product of matrices may round the rows of a sequence otherwise.
        inside, coefficients = np.clip(mapped, -1.0, 1.0), np.append(self.bias, self.series)
        slopes = chebyshev.chebval(np.sign(mapped), chebyshev.chebder(coefficients))
        return np.asarray(chebyshev.chebval(inside, coefficients) + slopes * (mapped - inside), dtype=np.float64)

    def step(self, state: None, value: float) -> tuple[None, float]:  # noqa: ARG002
        """Return None and the output at `value`."""
        return None, float(self.evaluate([value])[0])

    def regressor(self, inputs: ArrayLike, state: None = None) -> Regressor:  # noqa: ARG002
        """Return the columns T1 to Tn."""
        sequence = _checks.samples("inputs", inputs)
        return Regressor.of_columns(chebyshev_terms(self._mapped(sequence), self.degree))

    def shifted(self, offset: float) -> Polynomial:
        """Return the operator whose output at an input u is that of this one at u + offset, input units.

        Raises ValueError if the offset is not finite.
        """
        low, high = self.input_range
        return replace(self, input_range=(low - offset, high - offset))

    def output_range(self) -> tuple[float, float]:
        """Return the least and greatest value on the range: ends and stationary points."""
        coefficients = np.append(self.bias, self.series)
        roots = chebyshev.chebroots(chebyshev.chebtrim(chebyshev.chebder(coefficients)))
        # Double roots come out with a small imaginary part; an extra point inside does no harm.
        real = np.real(roots[np.abs(np.imag(roots)) < 1e-6])
        points = np.concatenate([[-1.0, 1.0], np.clip(real, -1.0, 1.0)])
        values = chebyshev.chebval(points, coefficients)
        return float(values.min()), float(values.max())

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return False for each coefficient: their signs are free."""
        return np.zeros(self.degree, dtype=bool)

    def inverse(self, policy: Policy = "nearest") -> TableInverse:  # noqa: ARG002
        """Return the look-up table of the polynomial's single-valued inverse."""
        return TableInverse(self)


def chebyshev_terms(values: Floats, degree: int) -> Floats:
    """Return T1 to Tn, a last axis of `degree`, continued beyond [-1, 1] by their tangents at the ends."""
    inside = np.clip(values, -1.0, 1.0)
    terms = chebyshev.chebvander(inside, degree)[..., 1:]
    if not (inside == values).all():
        # Tn'(1) = n² and Tn'(-1) = (-1)^(n + 1) n².
        orders = np.arange(1, degree + 1)
        slopes = np.where(values[..., None] > 0.0, 1.0, (-1.0) ** (orders + 1)) * orders**2
        terms = terms + slopes * (values - inside)[..., None]
    return np.asarray(terms)
