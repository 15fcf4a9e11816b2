"""The Duhem operator of Coleman and Hodgdon: the output relaxes towards a curve with the path of the input."""

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
class Duhem(ElementOperator):
    """Duhem's operator: dy = rate |dx| (f(x) - y) + g(x) dx, output = bias + y.

    x is the operating range mapped to [-1, 1]; f and g are polynomials, continued beyond it by the tangents of f and
    the end values of g (Coleman and Hodgdon, International Journal of Engineering Science 24, 897-919, 1986, with
    piecewise functions in their place). The output is linear in their coefficients: only the rate is a shape. Minor
    loops drift towards a closed cycle, where those of a Preisach operator close at once.

    Parameters
    ----------
    anhysteretic : array_like, shape (n,)
        Coefficients of T_1 ... T_n in f, output units; its constant is the bias.
    slope : array_like, shape (n,)
        Coefficients of T_0 ... T_(n - 1) in g, output units.
    rate : float
        Of relaxation per half operating range, > 0.
    origin : float
        Input of the relaxed state, y = f(x), input units.
    bias, input_range, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If the polynomials differ in length, a number is not finite, the rate is not positive, or the range does not
        increase.
    """

    kind: ClassVar[str] = "duhem"
    anhysteretic: Floats
    slope: Floats
    rate: float = 1.0
    bias: float = 0.0
    origin: float = 0.0
    input_range: tuple[float, float] = (-1.0, 1.0)
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        anhysteretic = _checks.samples("anhysteretic", self.anhysteretic)
        slope = _checks.counted("slope", self.slope, anhysteretic.size, "values, as of anhysteretic")
        rate = _checks.positive("rate", self.rate)
        self._settle("origin", anhysteretic=anhysteretic, slope=slope, rate=rate)

    @property
    def degree(self) -> int:
        """Degree of f."""
        return self.anhysteretic.size

    @property
    def coefficients(self) -> Floats:
        """Coefficients of f, then of g, shape (2 n,)."""
        return np.concatenate([self.anhysteretic, self.slope])

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> Duhem:
        """Return the same operator with other polynomials, shape (2 n,), and bias."""
        values = self._coefficients(coefficients)
        return replace(self, anhysteretic=values[: self.degree], slope=values[self.degree :], bias=bias)

    def nonnegative(self) -> NDArray[np.bool_]:
        """Return False for each coefficient: their signs are free."""
        return np.zeros(2 * self.degree, dtype=bool)

    def shape_parameters(self) -> Shape:
        """Return the rate with its bounds."""
        return Shape(("rate",), (self.rate,), (0.05,), (20.0,))

    def with_shape(self, values: Sequence[float]) -> Duhem:
        """Return the same operator with another rate."""
        return replace(self, rate=values[0])

    def shape_starts(self) -> Sequence[Sequence[float]]:
        """Return slow to fast relaxation."""
        return [(0.3,), (1.0,), (3.0,), (8.0,)]

    def at_rest(self) -> tuple[float, Floats]:
        """Return the origin, where y = f(x)."""
        x = self._x(np.array([self.origin]))
        relaxed = np.polynomial.chebyshev.chebvander(x, self.degree)[0, 1:]
        return self.origin, np.concatenate([relaxed, np.zeros(self.degree)])

    def _x(self, inputs: Floats) -> Floats:
        low, high = self.input_range
        return (2.0 * inputs - low - high) / (high - low)

    def respond(self, inputs: Floats, present: float, elements: Floats) -> Floats:
        """Return what each term of f and g adds to y, shape (N, 2 n)."""
        from bench.models.kernels import element_kernels as _element_kernels

        x = self._x(np.append(inputs, present))
        return np.asarray(_element_kernels.duhem(x[:-1], float(x[-1]), self.rate, self.degree, elements))
