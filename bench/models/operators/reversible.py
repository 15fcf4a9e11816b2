"""The single-valued part beside the hysterons: exact quadratics of the input, piece by piece."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.documents import Document


class Reversible(Document, ABC):
    """A term without memory, linear in its coefficients and piecewise quadratic in the input.

    Attributes
    ----------
    input_units : tuple of str
        The units of the inputs that the term is for, the usual one first; none if it is for any.
    nonnegative : bool
        Whether physics demands coefficients >= 0.
    """

    input_units: ClassVar[tuple[str, ...]] = ()
    nonnegative: ClassVar[bool] = False

    @property
    @abstractmethod
    def coefficients(self) -> Floats:
        """The coefficients that identification may change, shape (q,)."""

    def with_coefficients(self, coefficients: Sequence[float]) -> Self:
        """Return the same term with other coefficients, shape (q,).

        Raises ValueError if their number is wrong or one is not finite.
        """
        return self._with(_checks.counted("coefficients", coefficients, self.coefficients.size).tolist())

    @abstractmethod
    def _with(self, values: list[float]) -> Self: ...

    @abstractmethod
    def shifted(self, offset: float) -> Self:
        """Return the term whose value at an input u is that of this one at u + offset."""

    @abstractmethod
    def columns(self, inputs: ArrayLike) -> Floats:
        """Return the regressor's columns, shape (N, q)."""

    @abstractmethod
    def pieces(self) -> tuple[Floats, Floats]:
        """Return breakpoints (n,) and quadratics (n + 1, 3): c0 + c1 u + c2 u² between them."""


@dataclass(frozen=True)
class QuadraticTerm(Reversible):
    """The reversible term linear (u - origin) + quadratic (u - origin)².

    Parameters
    ----------
    linear : float
        Slope at the origin, output units per input unit.
    quadratic : float or None
        Curvature coefficient, output units per input unit squared; None leaves it out altogether.
    origin : float
        Input at which the term is zero.

    Raises
    ------
    ValueError
        If a number is not finite.
    """

    kind: ClassVar[str] = "quadratic"
    linear: float = 0.0
    quadratic: float | None = None
    origin: float = 0.0

    def __post_init__(self) -> None:
        _keep_numbers(self, "linear", "origin")
        if self.quadratic is not None:
            _keep_numbers(self, "quadratic")

    @property
    def coefficients(self) -> Floats:
        """Linear, and quadratic if present, shape (1,) or (2,)."""
        return np.array([self.linear] if self.quadratic is None else [self.linear, self.quadratic])

    def _with(self, values: list[float]) -> QuadraticTerm:
        return QuadraticTerm(values[0], None if self.quadratic is None else values[1], self.origin)

    def shifted(self, offset: float) -> QuadraticTerm:
        """Return the term moved by an offset; see `Reversible.shifted`."""
        return replace(self, origin=self.origin - offset)

    def columns(self, inputs: ArrayLike) -> Floats:
        """Return (u - origin) and, if present, (u - origin)², shape (N, 1) or (N, 2)."""
        shifted = np.asarray(inputs, dtype=np.float64) - self.origin
        return np.column_stack([shifted] if self.quadratic is None else [shifted, shifted**2])

    def pieces(self) -> tuple[Floats, Floats]:
        """Return one quadratic and no breakpoint."""
        a, b, u0 = self.quadratic or 0.0, self.linear, self.origin
        return np.empty(0), np.array([[a * u0 * u0 - b * u0, b - 2.0 * a * u0, a]])


@dataclass(frozen=True)
class PolynomialTerm(Reversible):
    """A reversible term that follows a polynomial of the input, quadratic from knot to knot.

    The term is sum over k of series_k T_k(x), with x the input mapped to [-1, 1] and T_k the Chebyshev polynomials,
    each replaced by its quadratic interpolant on every one of `knots` equal intervals of [low, high]: so the operator
    stays piecewise quadratic, and its range and its inverse stay exact. Beyond [low, high] the last quadratics go on.
    The interpolant of T_k is off by at most k²(k²-1)(k²-4)/15 (2/knots)³/(72√3), 5e-5 of T_5 at 128 knots.

    Parameters
    ----------
    series : tuple of float
        Coefficients of T_1, T_2, ..., output units; at least one.
    low, high : float
        Range of the mapping, input units, low < high.
    knots : int
        Number of intervals, >= 1.

    Raises
    ------
    ValueError
        If a number is not finite, there is no coefficient, low >= high, or knots < 1.
    """

    kind: ClassVar[str] = "polynomial"
    series: tuple[float, ...]
    low: float
    high: float
    knots: int = 128

    def __post_init__(self) -> None:
        object.__setattr__(self, "series", tuple(_checks.samples("series", self.series).tolist()))
        _keep_numbers(self, "low", "high")
        _checks.increasing("low, high", [self.low, self.high])
        if isinstance(self.knots, bool) or not isinstance(self.knots, int) or self.knots < 1:
            raise ValueError(f"knots: expected a whole number >= 1, got {self.knots!r}")

    @property
    def coefficients(self) -> Floats:
        """The series, shape (n,)."""
        return np.array(self.series)

    def _with(self, values: list[float]) -> PolynomialTerm:
        return replace(self, series=tuple(values))

    def shifted(self, offset: float) -> PolynomialTerm:
        """Return the term moved by an offset; see `Reversible.shifted`."""
        return replace(self, low=self.low - offset, high=self.high - offset)

    def columns(self, inputs: ArrayLike) -> Floats:
        """Return the interpolants of T_1, T_2, ... at the inputs, shape (N, n)."""
        values = np.asarray(inputs, dtype=np.float64)
        breaks, _ = self._knots()
        piece = np.searchsorted(breaks, values)
        powers = np.stack([np.ones_like(values), values, values**2])
        return np.column_stack(
            [np.einsum("pn,np->n", powers, self._quadratics(k)[piece]) for k in range(1, len(self.series) + 1)]
        )

    def pieces(self) -> tuple[Floats, Floats]:
        """Return the inner knots and the quadratic of each interval."""
        quadratics = sum(
            (c * self._quadratics(k) for k, c in enumerate(self.series, start=1)), np.zeros((self.knots, 3))
        )
        return self._knots()[0], quadratics

    def _knots(self) -> tuple[Floats, Floats]:
        """Return the inner knots, and all of them."""
        knots = np.linspace(self.low, self.high, self.knots + 1)
        return knots[1:-1], knots

    def _quadratics(self, degree: int) -> Floats:
        """Return c0, c1, c2 of the interpolant of T_degree on each interval, shape (knots, 3)."""
        _, knots = self._knots()
        left, right = knots[:-1], knots[1:]
        middle, half = 0.5 * (left + right), 0.5 * (right - left)
        x = (2.0 * np.stack([left, middle, right]) - self.low - self.high) / (self.high - self.low)
        before, at, after = np.cos(degree * np.arccos(np.clip(x, -1.0, 1.0)))
        slope, bend = (after - before) / (2.0 * half), (after - 2.0 * at + before) / (2.0 * half**2)
        # From powers of (u - middle) to powers of u.
        return np.column_stack([at - slope * middle + bend * middle**2, slope - 2.0 * bend * middle, bend])


@dataclass(frozen=True)
class ThermalExpansion(Reversible):
    """The thermal term of a film whose phase fraction θ is a ramp: -[k0 (1 - θ) + k1 θ] (T - reference).

    θ = clip((T - low) / (high - low), 0, 1): Zhang et al. 2013, eqs. 6, 7 and 11. The input T is a temperature.

    Parameters
    ----------
    k0, k1 : float
        Expansion coefficients of the low- and high-temperature phase, output units per input unit, >= 0.
    low, high : float
        Phase-transition range, input units, low < high.
    reference : float
        Temperature of zero expansion T0, input units.

    Raises
    ------
    ValueError
        If a number is not finite or low >= high.
    """

    kind: ClassVar[str] = "thermal-expansion"
    input_units: ClassVar[tuple[str, ...]] = ("°C", "degC", "C", "℃", "K")
    nonnegative: ClassVar[bool] = True
    k0: float
    k1: float
    low: float
    high: float
    reference: float

    def __post_init__(self) -> None:
        _keep_numbers(self, "k0", "k1", "low", "high", "reference")
        if self.low >= self.high:
            raise ValueError(f"low: expected a value below high = {self.high}, got {self.low}")

    @property
    def coefficients(self) -> Floats:
        """K0 and k1, shape (2,)."""
        return np.array([self.k0, self.k1])

    def _with(self, values: list[float]) -> ThermalExpansion:
        return replace(self, k0=values[0], k1=values[1])

    def shifted(self, offset: float) -> ThermalExpansion:
        """Return the term moved by an offset; see `Reversible.shifted`."""
        low, high, reference = (value - offset for value in (self.low, self.high, self.reference))
        return replace(self, low=low, high=high, reference=reference)

    def columns(self, inputs: ArrayLike) -> Floats:
        """Return -(1 - θ)(T - T0) and -θ (T - T0), shape (N, 2)."""
        temperature = np.asarray(inputs, dtype=np.float64)
        theta = np.clip((temperature - self.low) / (self.high - self.low), 0.0, 1.0)
        rise = temperature - self.reference
        return np.column_stack([-(1.0 - theta) * rise, -theta * rise])

    def pieces(self) -> tuple[Floats, Floats]:
        """Return the ramp's ends and line, quadratic, line (Zhang et al. 2013, eq. 15)."""
        k0, k1, t0 = self.k0, self.k1, self.reference
        q = (k1 - k0) / (self.high - self.low)
        middle = [(k0 - q * self.low) * t0, q * (t0 + self.low) - k0, -q]
        return np.array([self.low, self.high]), np.array([[k0 * t0, -k0, 0.0], middle, [k1 * t0, -k1, 0.0]])


def _keep_numbers(term: object, *names: str) -> None:
    """Make fields of a frozen term floats, as whole numbers of any size are no numbers of numpy."""
    for name in names:
        object.__setattr__(term, name, _checks.number(name, getattr(term, name)))


def reversible_from_json(document: Mapping[str, Any]) -> Reversible:
    """Return the term that `to_json` wrote.

    Raises ValueError if the type is unknown or a key is missing or wrong.
    """
    kind = _checks.json_field(document, "type", "reversible")
    fields = {key: value for key, value in document.items() if key != "type"}
    terms = {term.kind: term for term in (QuadraticTerm, PolynomialTerm, ThermalExpansion)}
    if kind not in terms:
        raise ValueError(f"reversible: expected type {' or '.join(map(repr, terms))}, got {kind!r}")
    try:
        return terms[kind](**fields)
    except TypeError as error:
        raise ValueError(f"reversible: {error}") from None
