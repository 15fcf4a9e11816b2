"""The Krasnosel'skii-Pokrovskii operator: relays whose switching is a ramp, on a plane of switching inputs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.operators.elements import ElementOperator, ElementState


@dataclass(frozen=True, eq=False)
class KrasnoselskiiPokrovskii(ElementOperator):
    """A weighted sum of kernels with slope: output = bias + Σ weight_k κ_k.

    A kernel is lifted from -1 to 1 along a ramp from α to α + width by a rising input and lowered along the one from
    β + width to β <= α by a falling one: κ = max(ramp(u - α), min(ramp(u - β), κ before)) (Krasnosel'skii and
    Pokrovskii, Systems with Hysteresis, 1989; Galinaitis 1999). In place of a relay's jump it has a slope,
    so that few kernels give a continuous output. The kernels lie on the nodes (β, α), β <= α, of a lattice, the row
    i of α and the column j of β at i (i + 1) / 2 + j; the output never falls where no weight is negative.

    Parameters
    ----------
    nodes : array_like, shape (M,)
        Increasing inputs at which ramps begin, input units.
    weights : array_like, shape (M (M + 1) / 2,)
        Output units.
    width : float
        Of the ramps, input units, > 0.
    input_range : tuple of float or None
        Operating range of the input. Default: from the first node to the end of the last ramp.
    bias, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If the nodes do not increase, the weights have the wrong length, the width is not positive, a number is not
        finite, or the range does not increase.
    """

    kind: ClassVar[str] = "krasnoselskii-pokrovskii"
    nodes: Floats
    weights: Floats
    width: float
    bias: float = 0.0
    input_range: tuple[float, float] = None  # type: ignore[assignment]
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        nodes = _checks.increasing("nodes", self.nodes, least=1)
        kernels = nodes.size * (nodes.size + 1) // 2
        weights = _checks.counted("weights", self.weights, kernels, f"values for {nodes.size} nodes")
        width = _checks.positive("width", self.width)
        self._settle(span=(nodes[0], nodes[-1] + width), nodes=nodes, weights=weights, width=width)

    @property
    def coefficients(self) -> Floats:
        """The weights, shape (M (M + 1) / 2,)."""
        return self.weights

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> KrasnoselskiiPokrovskii:
        """Return the same operator with other weights and bias."""
        return replace(self, weights=self._coefficients(coefficients), bias=bias)

    @cached_property
    def _ramps(self) -> tuple[Floats, Floats]:
        """Beginnings of the ramps up and down of each kernel."""
        rows, columns = np.tril_indices(self.nodes.size)
        return np.ascontiguousarray(self.nodes[rows]), np.ascontiguousarray(self.nodes[columns])

    @property
    def plane(self) -> tuple[float, float]:
        """The range beyond which no part of the memory remains."""
        return float(self.nodes[0]), float(self.nodes[-1]) + self.width

    def at_rest(self) -> tuple[float, Floats]:
        """Return the low end of the operating range in negative saturation."""
        return self.input_range[0], np.full(self.weights.size, -1.0)

    def respond(self, inputs: Floats, present: float, elements: Floats) -> Floats:  # noqa: ARG002
        """Return the kernels, shape (N, M (M + 1) / 2)."""
        from bench.models.kernels import element_kernels as _element_kernels

        return np.asarray(_element_kernels.ramps(inputs, *self._ramps, self.width, elements))

    def saturated_state(self, direction: int, value: float | None = None) -> ElementState:
        """Return the state at the low (-1) or high (1) end, or at a value, entered from beyond the other end.

        Raises ValueError if `direction` is neither -1 nor 1.
        """
        far, end = self._ends(direction)
        elements = np.full(self.weights.size, float(-direction))
        here = end if value is None else value
        self.respond(np.array([here]), far, elements)
        return (here, *elements.tolist())

    def rises(self) -> bool:
        """Return whether no weight is negative."""
        return self._rising() is True
