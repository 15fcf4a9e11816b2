"""The Maxwell-slip operator: springs behind sliders, from deformation to force."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.operators.elements import ElementOperator, ElementState

if TYPE_CHECKING:
    from bench.models.inverses.branch_inverse import Branch
    from bench.models.inverses.inverse import Inverse, Policy


@dataclass(frozen=True, eq=False)
class MaxwellSlip(ElementOperator):
    """Elasto-slide elements beside a spring: force = bias + spring (u - origin) + Σ stiffness_i e_i.

    Each element is a massless block on dry friction behind a spring: its deformation e_i follows the input u until
    its force stiffness_i e_i reaches ± the slip force, and there slips (Lampaert, Al-Bender and Swevers, 2003;
    Goldfarb and Celanovic 1997). It is a Prandtl-Ishlinskii operator with stops in place of
    plays: the output leads the input, and saturates where there is no spring.

    Parameters
    ----------
    slips : array_like, shape (n,)
        Increasing deformations > 0 at which the elements slip, input units.
    stiffnesses : array_like, shape (n,)
        Of the elements, output units per input unit.
    spring : float
        Stiffness of the spring that never slips, output units per input unit.
    origin : float
        Input of the relaxed state, input units.
    input_range : tuple of float or None
        Operating range of the input. Default: origin ± the last slip.
    bias, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If the slips do not increase from above 0, there are not as many stiffnesses, a number is not finite, or the
        range does not increase.
    """

    kind: ClassVar[str] = "maxwell-slip"
    inverse_method: ClassVar[str] = "exact"
    slips: Floats
    stiffnesses: Floats
    spring: float = 0.0
    bias: float = 0.0
    origin: float = 0.0
    input_range: tuple[float, float] = None  # type: ignore[assignment]
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        slips = _checks.increasing("slips", self.slips, least=1)
        if slips[0] <= 0.0:
            raise ValueError(f"slips: expected values > 0, got {slips[0]}")
        stiffnesses = _checks.counted("stiffnesses", self.stiffnesses, slips.size, "values, one for each slip")
        origin = _checks.number("origin", self.origin)
        span = origin - slips[-1], origin + slips[-1]
        self._settle("spring", "origin", span=span, slips=slips, stiffnesses=stiffnesses)

    @property
    def coefficients(self) -> Floats:
        """The stiffnesses of the elements, then that of the spring, shape (n + 1,)."""
        return np.append(self.stiffnesses, self.spring)

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> MaxwellSlip:
        """Return the same operator with other stiffnesses, shape (n + 1,), and bias."""
        values = self._coefficients(coefficients)
        return replace(self, stiffnesses=values[:-1], spring=float(values[-1]), bias=bias)

    def at_rest(self) -> tuple[float, Floats]:
        """Return the origin, and no deformation."""
        return self.origin, np.zeros(self.slips.size)

    def respond(self, inputs: Floats, present: float, elements: Floats) -> Floats:
        """Return the deformations of the elements and of the spring, shape (N, n + 1)."""
        from bench.models.kernels import element_kernels as _element_kernels

        columns = _element_kernels.stops(inputs, present, self.slips, elements)
        return np.column_stack([columns, inputs - self.origin])

    def saturated_state(self, direction: int, value: float | None = None) -> ElementState:
        """Return the state at the low (-1) or high (1) end, or at a value, entered from far beyond the other end.

        Every element then slips. Raises ValueError if `direction` is neither -1 nor 1.
        """
        _, end = self._ends(direction)
        return (end if value is None else value, *(direction * self.slips).tolist())

    def branch(self, state: ElementState, direction: int) -> Branch:
        """Return the branch from a state to an end of the operating range: its corners are where elements slip."""
        from bench.models.inverses.branch_inverse import Branch

        present, elements = self._split(state)
        end = self.input_range[int(direction > 0)]
        way = max(direction * (end - present), 0.0)
        left = self.slips - direction * elements
        moves = np.unique(np.concatenate([[0.0, way], left[(left > 0.0) & (left < way)]]))
        deformations = elements + direction * np.minimum(moves[:, None], left)
        drives = present + direction * moves
        outputs = self.bias + deformations @ self.stiffnesses + self.spring * (drives - self.origin)
        return Branch(drives, outputs)

    def input_of(self, drive: float, direction: int) -> float:  # noqa: ARG002
        """Return the drive, which is the input."""
        return drive

    def rises(self) -> bool:
        """Return whether no stiffness is negative."""
        return self._rising() is True

    def inverse(self, policy: Policy = "nearest") -> Inverse[ElementState]:
        """Return the exact inverse, or the numerical one where stiffnesses of both signs let the force turn."""
        from bench.models.inverses.branch_inverse import BranchInverse
        from bench.models.inverses.inverse import NumericalInverse

        return NumericalInverse(self, policy) if self._rising() is None else BranchInverse(self, policy)
