"""The generalized Prandtl-Ishlinskii operator: plays between two envelopes, which saturate each in its own way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.operator import Shape
from bench.models.operators.elements import ElementOperator, ElementState

if TYPE_CHECKING:
    from bench.models.inverses.branch_inverse import Branch
    from bench.models.inverses.inverse import Inverse, Policy

# Points at which the order of the envelopes is looked at.
# Derivation: two envelopes that change their order between two points do so over less than 1/400 of the range.
_SAMPLES = 401


class Envelope(NamedTuple):
    """A rising map of [-1, 1] onto itself: tanh(steepness x - offset), shifted and scaled.

    Attributes
    ----------
    steepness : float
        > 0; small for a straight line.
    offset : float
        0 for a symmetrical map; > 0 for one that is steepest at the high end, < 0 at the low end.
    """

    steepness: float
    offset: float

    def ends(self) -> tuple[float, float]:
        """Return the hyperbolic tangents at -1 and 1."""
        return math.tanh(-self.steepness - self.offset), math.tanh(self.steepness - self.offset)

    def __call__(self, x: Floats) -> Floats:
        """Return the map of each value."""
        from bench.models.kernels import element_kernels as _kernels

        low, high = self.ends()
        values = _kernels.tanh(self.steepness * x - self.offset)
        return np.asarray((2.0 * values - low - high) / (high - low))

    def inverse(self, drive: float) -> float:
        """Return the value that is mapped to a drive, kept within what the map can reach."""
        low, high = self.ends()
        value = 0.5 * (drive * (high - low) + low + high)
        edge = 1.0 - 1e-16
        return (math.atanh(min(max(value, -edge), edge)) + self.offset) / self.steepness


@dataclass(frozen=True, eq=False)
class GeneralizedPrandtlIshlinskii(ElementOperator):
    """Weighted plays between envelopes: output = bias + Σ weight_i w_i, of saturating or asymmetric loops.

    With x the operating range mapped to [-1, 1] and the envelopes γ_r, γ_l, each play keeps
    w = max(γ_r(x) - r, min(γ_l(x) + r, w before): it is lifted along γ_r - r by a rising input and lowered along
    γ_l + r by a falling one (Al Janaideh, Rakheja and Su, IEEE/ASME Transactions on Mechatronics 16(4), 734-744,
    2011). Both envelopes are tanh, the authors' own choice, normalised to end at ±1, as the scale and the shift of
    an envelope are those of thresholds and weights. The state is the input and the plays.

    Parameters
    ----------
    thresholds : array_like, shape (n,)
        Increasing, from 0 on, as parts of half the envelopes' span.
    weights : array_like, shape (n,)
        Output per unit of the envelopes, output units.
    rising_steepness, rising_offset : float
        Of γ_r, in x: steepness > 0.
    falling_steepness, falling_offset : float
        Of γ_l.
    origin : float
        Input of the relaxed state, in which every play stands between the envelopes, input units.
    input_range : tuple of float
        Operating range of the input, mapped to [-1, 1].
    bias, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If the thresholds do not increase from 0, there are not as many weights, a steepness is not positive, a number
        is not finite, or the range does not increase.
    """

    kind: ClassVar[str] = "generalized-prandtl-ishlinskii"
    inverse_method: ClassVar[str] = "exact"
    thresholds: Floats
    weights: Floats
    rising_steepness: float = 1.0
    rising_offset: float = 0.0
    falling_steepness: float = 1.0
    falling_offset: float = 0.0
    bias: float = 0.0
    origin: float = 0.0
    input_range: tuple[float, float] = (-1.0, 1.0)
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        thresholds, weights = _checks.plays(self.thresholds, self.weights)
        self._settle(
            "rising_offset",
            "falling_offset",
            "origin",
            thresholds=thresholds,
            weights=weights,
            rising_steepness=_checks.positive("rising_steepness", self.rising_steepness),
            falling_steepness=_checks.positive("falling_steepness", self.falling_steepness),
        )

    @cached_property
    def rising(self) -> Envelope:
        """The envelope γ_r."""
        return Envelope(self.rising_steepness, self.rising_offset)

    @cached_property
    def falling(self) -> Envelope:
        """The envelope γ_l."""
        return Envelope(self.falling_steepness, self.falling_offset)

    @cached_property
    def ordered(self) -> bool:
        """Whether γ_l is nowhere below γ_r in the operating range: else a play may have no room to move in."""
        x = np.linspace(-1.0, 1.0, _SAMPLES)
        return bool((self.falling(x) - self.rising(x) >= -1e-12).all())

    @property
    def coefficients(self) -> Floats:
        """The weights, shape (n,)."""
        return self.weights

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> GeneralizedPrandtlIshlinskii:
        """Return the same operator with other weights, shape (n,), and bias."""
        return replace(self, weights=self._coefficients(coefficients), bias=bias)

    def shape_parameters(self) -> Shape:
        """Return the four parameters of the envelopes."""
        return Shape(
            ("rising_steepness", "rising_offset", "falling_steepness", "falling_offset"),
            (self.rising_steepness, self.rising_offset, self.falling_steepness, self.falling_offset),
            (0.1, -3.0, 0.1, -3.0),
            (6.0, 3.0, 6.0, 3.0),
        )

    def with_shape(self, values: Sequence[float]) -> GeneralizedPrandtlIshlinskii:
        """Return the same operator with other envelopes."""
        rising_steepness, rising_offset, falling_steepness, falling_offset = values
        return replace(
            self,
            rising_steepness=rising_steepness,
            rising_offset=rising_offset,
            falling_steepness=falling_steepness,
            falling_offset=falling_offset,
        )

    def shape_starts(self) -> Sequence[Sequence[float]]:
        """Return soft and steep envelopes, together and apart."""
        return [(0.5, 0.0, 0.5, 0.0), (2.0, 0.0, 2.0, 0.0), (2.0, 0.6, 2.0, -0.6)]

    def _x(self, inputs: Floats) -> Floats:
        low, high = self.input_range
        return (2.0 * inputs - low - high) / (high - low)

    def at_rest(self) -> tuple[float, Floats]:
        """Return the origin, and the plays halfway between the envelopes there."""
        x = self._x(np.array([self.origin]))
        return self.origin, np.full(self.thresholds.size, 0.5 * float((self.rising(x) + self.falling(x))[0]))

    def respond(self, inputs: Floats, present: float, elements: Floats) -> Floats:  # noqa: ARG002
        """Return the plays, shape (N, n)."""
        from bench.models.kernels import memory_kernels as _kernels

        x = self._x(inputs)
        return np.asarray(_kernels.plays(self.rising(x), self.falling(x), self.thresholds, elements))

    def saturated_state(self, direction: int, value: float | None = None) -> ElementState:
        """Return the state at the low (-1) or high (1) end, or at a value, entered from far beyond the other end.

        Every play then is dragged. Raises ValueError if `direction` is neither -1 nor 1.
        """
        _, end = self._ends(direction)
        here = end if value is None else value
        x = self._x(np.array([here]))
        lower, upper = float(self.rising(x)[0]), float(self.falling(x)[0])
        plays = lower - self.thresholds if direction > 0 else upper + self.thresholds
        return (here, *np.maximum(lower - self.thresholds, plays).tolist())

    def branch(self, state: ElementState, direction: int) -> Branch:
        """Return the branch from a state to an end of the operating range; its corners are where plays are caught.

        Raises ValueError as `step`.
        """
        from bench.models.inverses.branch_inverse import Branch

        present, plays = self._split(state)
        envelope = self.rising if direction > 0 else self.falling
        end = self.input_range[int(direction > 0)]
        end = end if direction * (end - present) > 0.0 else present
        first, last = envelope(self._x(np.array([present, end]))).tolist()
        caught = plays + direction * self.thresholds
        inner = caught[(direction * (caught - first) > 0.0) & (direction * (caught - last) < 0.0)]
        drives = direction * np.unique(direction * np.concatenate([[first, last], inner]))
        moved = np.maximum(direction * drives[:, None] - self.thresholds, direction * plays)
        return Branch(drives, self.bias + direction * (moved @ self.weights))

    def input_of(self, drive: float, direction: int) -> float:
        """Return the input of a drive on a rising or falling branch."""
        low, high = self.input_range
        x = (self.rising if direction > 0 else self.falling).inverse(drive)
        return min(max(0.5 * (low + high + x * (high - low)), low), high)

    def rises(self) -> bool:
        """Return whether no weight is negative."""
        return self._rising() is True

    def inverse(self, policy: Policy = "nearest") -> Inverse[ElementState]:
        """Return the exact inverse, or the numerical one where the envelopes cross or the weights differ in sign."""
        from bench.models.inverses.branch_inverse import BranchInverse
        from bench.models.inverses.inverse import NumericalInverse

        exact = self.ordered and self._rising() is not None
        return BranchInverse(self, policy) if exact else NumericalInverse(self, policy)
