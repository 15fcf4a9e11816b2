"""The inverse of an operator whose output falls with its input, by that of the operator with the opposite output."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from numpy.typing import ArrayLike

from bench.base import checks as _checks
from bench.models.inverses.inverse import Following, Inverse, Inversion, S


@dataclass(frozen=True, eq=False)
class FallingInverse(Inverse[S]):
    """The inverse of an operator with coefficients <= 0, exact where that of the opposite operator is.

    The output is bias + regressor @ coefficients. So the operator with the opposite coefficients and bias has the
    opposite output from the same state, and rises: its inverse at the opposite target is the answer.
    """

    @cached_property
    def opposite(self) -> Inverse[S]:
        """The inverse of the operator with the opposite output."""
        operator = self.operator
        return operator.with_coefficients(-operator.coefficients, -operator.bias).inverse(self.policy)

    def invert(self, state: S, target: float) -> Inversion[S]:
        """Return the set-points that bring the output from `state` to `target`; see `Inverse.invert`."""
        found = self.opposite.invert(state, -target)
        return replace(found, outputs=tuple([-output for output in found.outputs]), reach=found.reach.opposite)

    def follow(self, targets: ArrayLike, state: S | None = None) -> Following[S]:
        """Return the set-points that bring the output to one target after another; see `Inverse.follow`."""
        found = self.opposite.follow(-_checks.samples("targets", targets), state)
        return replace(found, outputs=-found.outputs)

    def nearest_input(
        self, state: S, present: float, target: float, bounds: tuple[float, float] | None = None
    ) -> float:
        """Return the input nearest to the present one that meets a target; see `Inverse.nearest_input`."""
        return self.opposite.nearest_input(state, present, -target, bounds)
