"""What every hysteresis operator can do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, Self, TypeVar

from numpy.typing import ArrayLike

from bench.hysteresis import _checks
from bench.hysteresis._checks import Floats
from bench.hysteresis.density import Density
from bench.hysteresis.regressor import Regressor

S = TypeVar("S")


class Operator(Protocol[S]):
    """A model from input to output, immutable apart from a state S that the caller carries along.

    The output is `bias` + regressor @ `coefficients`.
    """

    @property
    def coefficients(self) -> Floats:
        """The coefficients without the bias, shape (K,)."""
        ...

    @property
    def bias(self) -> float:
        """The constant part of the output, output units."""
        ...

    @property
    def input_range(self) -> tuple[float, float]:
        """The operating range of the input, input units."""
        ...

    @property
    def input_unit(self) -> str:
        """Unit of the input."""
        ...

    @property
    def output_unit(self) -> str:
        """Unit of the output."""
        ...

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> Self:
        """Return the same operator with other coefficients, shape (K,)."""
        ...

    def initial_state(self) -> S:
        """Return the state from which identification starts."""
        ...

    def evaluate(self, inputs: ArrayLike, state: S | None = None) -> Floats:
        """Return the outputs of a sequence, shape (N,), from `state` (default: the initial state)."""
        ...

    def step(self, state: S, value: float) -> tuple[S, float]:
        """Return state and output after the input moved monotonically to `value`."""
        ...

    def regressor(self, inputs: ArrayLike, state: S | None = None) -> Regressor:
        """Return the regressor of a sequence."""
        ...

    def output_range(self) -> tuple[float, float]:
        """Return least and greatest output over all reachable states."""
        ...

    def densities(self) -> tuple[Density, ...]:
        """Return the operator's Preisach density, for drawing; nothing if it has none."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Return the operator as a JSON object with a `type`."""
        ...

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Return the operator that `to_json` wrote."""
        ...


def operator_from_json(document: Mapping[str, Any]) -> Operator[Any]:
    """Return the operator that some operator's `to_json` wrote.

    Raises
    ------
    ValueError
        If the type is unknown or the object is not what that type expects.
    """
    from bench.hysteresis.polynomial import Polynomial
    from bench.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
    from bench.hysteresis.preisach import Preisach

    kinds: dict[str, type[Preisach] | type[Polynomial] | type[PrandtlIshlinskii]] = {
        "preisach": Preisach,
        "polynomial": Polynomial,
        "prandtl-ishlinskii": PrandtlIshlinskii,
    }
    kind = _checks.json_field(document, "type", "operator")
    if kind not in kinds:
        raise ValueError(f"operator: expected type {' or '.join(map(repr, kinds))}, got {kind!r}")
    return kinds[kind].from_json(document)
