"""A single-valued polynomial: the model without hysteresis that others are compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike

from bench.hysteresis import _checks
from bench.hysteresis._checks import Floats
from bench.hysteresis.density import Density
from bench.hysteresis.regressor import Regressor


@dataclass(frozen=True, eq=False)
class Polynomial:
    """A polynomial of the input, as Chebyshev series on the range mapped to [-1, 1].

    Parameters
    ----------
    series : array_like, shape (degree,)
        Coefficients of T1 to Tn, output units.
    input_range : tuple of float
        The range mapped to [-1, 1], input units.
    bias : float
        Coefficient of T0, output units.
    input_unit, output_unit : str
        Units, for labels.

    Raises
    ------
    ValueError
        If the series is empty or not finite, or the range not increasing.
    """

    series: Floats
    input_range: tuple[float, float]
    bias: float = 0.0
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        low, high = _checks.increasing("input_range", self.input_range).tolist()
        object.__setattr__(self, "series", _checks.frozen(_checks.samples("series", self.series)))
        object.__setattr__(self, "input_range", (low, high))
        object.__setattr__(self, "bias", _checks.number("bias", self.bias))

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
        values = _checks.samples("coefficients", coefficients)
        if values.size != self.degree:
            raise ValueError(f"coefficients: expected {self.degree} values, got {values.size}")
        return Polynomial(values, self.input_range, bias, self.input_unit, self.output_unit)

    def initial_state(self) -> None:
        """Return None: a polynomial remembers nothing."""

    def _mapped(self, inputs: Floats) -> Floats:
        low, high = self.input_range
        return (2.0 * inputs - (low + high)) / (high - low)

    def evaluate(self, inputs: ArrayLike, state: None = None) -> Floats:  # noqa: ARG002
        """Return the outputs, shape (N,)."""
        mapped = self._mapped(_checks.samples("inputs", inputs))
        return np.asarray(chebyshev.chebval(mapped, np.append(self.bias, self.series)), dtype=np.float64)

    def step(self, state: None, value: float) -> tuple[None, float]:  # noqa: ARG002
        """Return None and the output at `value`."""
        return None, float(self.evaluate([value])[0])

    def regressor(self, inputs: ArrayLike, state: None = None) -> Regressor:  # noqa: ARG002
        """Return the columns T1 to Tn."""
        sequence = _checks.samples("inputs", inputs)
        columns = chebyshev.chebvander(self._mapped(sequence), self.degree)[:, 1:]
        return Regressor(
            base=np.empty(0),
            starts=np.zeros(sequence.size + 1, dtype=np.int64),
            cells=np.empty(0, dtype=np.int32),
            changes=np.empty(0),
            extra=np.ascontiguousarray(columns),
        )

    def output_range(self) -> tuple[float, float]:
        """Return the least and greatest value on the range: ends and stationary points."""
        coefficients = np.append(self.bias, self.series)
        roots = chebyshev.chebroots(chebyshev.chebtrim(chebyshev.chebder(coefficients)))
        # Double roots come out with a small imaginary part; an extra point inside does no harm.
        real = np.real(roots[np.abs(np.imag(roots)) < 1e-6])
        points = np.concatenate([[-1.0, 1.0], np.clip(real, -1.0, 1.0)])
        values = chebyshev.chebval(points, coefficients)
        return float(values.min()), float(values.max())

    def densities(self) -> tuple[Density, ...]:
        """Return nothing: the operator has no density on a Preisach plane."""
        return ()

    def to_json(self) -> dict[str, Any]:
        """Return the polynomial as a JSON object."""
        return {
            "type": "polynomial",
            "series": self.series.tolist(),
            "input_range": list(self.input_range),
            "bias": self.bias,
            "input_unit": self.input_unit,
            "output_unit": self.output_unit,
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Polynomial:
        """Return the polynomial that `to_json` wrote.

        Raises
        ------
        ValueError
            If a key is missing or wrong.
        """
        return cls(
            _checks.json_field(document, "series", "polynomial"),
            _checks.json_field(document, "input_range", "polynomial"),
            _checks.json_field(document, "bias", "polynomial"),
            document.get("input_unit", ""),
            document.get("output_unit", ""),
        )
