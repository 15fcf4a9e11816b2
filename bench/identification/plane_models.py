"""The bench's own models of one input and one output, as entries of `bench.models`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.fit.initial_memory import estimate_memory
from bench.identification.fit.least_squares import fit
from bench.identification.fit.levels import Spacing, quantile_levels
from bench.identification.options import OptionHelp
from bench.models import (
    DeadZones,
    Linear,
    ModelSpec,
    PlayState,
    Polynomial,
    PolynomialPlays,
    PolynomialTerm,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    Reversible,
    Summed,
    ThermalExpansion,
    TwoStage,
    uniform_levels,
)

ReversibleKind: TypeAlias = Literal["none", "linear", "quadratic", "polynomial"]

InputRange: TypeAlias = Annotated[
    tuple[float, float] | None, OptionHelp("operating range, input units", "the range of the inputs")
]
_Levels: TypeAlias = Annotated[
    int | tuple[float, ...], OptionHelp("number of intervals of the plane, or the increasing levels, input units")
]
_Spacing: TypeAlias = Annotated[Spacing, OptionHelp("of the levels: uniform, or quantiles of the reversals")]
_Plane: TypeAlias = Annotated[
    tuple[float, float] | None, OptionHelp("ends of the plane, input units", "the range of the inputs")
]

# Least slope of the inverse dead zones, as part of that in the middle: forward it is the greatest. Derivation:
# forward it then is at most 50 times that in the middle, which keeps the inverse of the sums finite.
_LEAST_SLOPE = 0.02


def _lattice(inputs: Floats, levels: int | ArrayLike, plane: tuple[float, float], spacing: Spacing) -> Floats:
    if not isinstance(levels, int | np.integer):
        if spacing != "uniform":
            raise ValueError(f"spacing: {spacing!r} needs a number of levels, not the levels themselves")
        return _checks.increasing("levels", levels)
    if spacing == "quantiles":
        return quantile_levels(inputs, plane, int(levels))
    return uniform_levels(*plane, int(levels))


def _operating(inputs: Floats, plane: tuple[float, float], given: tuple[float, float] | None) -> tuple[float, float]:
    """Return the operating range: what was given, else what the inputs and the plane span."""
    if given is not None:
        return given
    return min(float(inputs.min()), plane[0]), max(float(inputs.max()), plane[1])


def input_span(inputs: Floats, name: str) -> tuple[float, float]:
    """Return the least and the greatest input.

    Raises ValueError if they are the same: names the option that would help.
    """
    low, high = float(inputs.min()), float(inputs.max())
    if low == high:
        raise ValueError(f"inputs: constant at {low}; give {name} or inputs that vary")
    return low, high


def operating_range(inputs: Floats, given: tuple[float, float] | None) -> tuple[float, float]:
    """Return the operating range: what was given, else what the inputs span."""
    return input_span(inputs, "input_range") if given is None else given


def at_least_one(name: str, value: int) -> int:
    """Return a number of parts; raise ValueError if there is none."""
    if value < 1:
        raise ValueError(f"{name}: expected at least 1, got {value}")
    return value


def _preisach(
    inputs: Floats,
    *,
    levels: _Levels = 20,
    plane: _Plane = None,
    spacing: _Spacing = "uniform",
    reversible: Annotated[ReversibleKind, OptionHelp("part without memory, beside the density")] = "none",
    degree: Annotated[int | None, OptionHelp("of the reversible part 'polynomial'", "5")] = None,
    input_range: InputRange = None,
) -> Preisach:
    if plane is None and isinstance(levels, int | np.integer):
        plane = input_span(inputs, "plane")
    lattice = _lattice(inputs, levels, plane or (0.0, 0.0), spacing)
    middle = 0.5 * float(lattice[0] + lattice[-1])
    span = _operating(inputs, (float(lattice[0]), float(lattice[-1])), input_range)
    if degree is not None and reversible != "polynomial":
        raise ValueError(f"degree: belongs to the reversible part 'polynomial', not to {reversible!r}")
    terms: dict[str, Reversible | None] = {
        "none": None,
        "linear": QuadraticTerm(origin=middle),
        "quadratic": QuadraticTerm(quadratic=0.0, origin=middle),
        "polynomial": PolynomialTerm((0.0,) * at_least_one("degree", 5 if degree is None else degree), *span),
    }
    if reversible not in terms:
        raise ValueError(f"reversible: expected one of {', '.join(terms)}, got {reversible!r}")
    cells = lattice.size * (lattice.size - 1) // 2
    return Preisach(lattice, np.zeros(cells), reversible=terms[reversible], input_range=span)


def _nonmonotonic(
    inputs: Floats,
    *,
    levels: _Levels = 20,
    plane: _Plane = None,
    spacing: _Spacing = "uniform",
    reference: Annotated[
        float | None, OptionHelp("input at which the thermal term is zero", "the low end of the operating range")
    ] = None,
    input_range: InputRange = None,
) -> Preisach:
    plain = _preisach(inputs, levels=levels, spacing=spacing, plane=plane, input_range=input_range)
    zero = plain.input_range[0] if reference is None else reference
    return replace(plain, reversible=ThermalExpansion(0.0, 0.0, *plain.plane, zero))


def _polynomial(
    inputs: Floats,
    *,
    degree: Annotated[int, OptionHelp("of the polynomial")] = 12,
    input_range: InputRange = None,
) -> Polynomial:
    return Polynomial(np.zeros(at_least_one("degree", degree)), operating_range(inputs, input_range))


def _polynomial_plays(
    inputs: Floats,
    *,
    degree: Annotated[int, OptionHelp("of the polynomial")] = 3,
    plays: Annotated[int, OptionHelp("number of plays, of thresholds evenly below half the range")] = 3,
    powers: Annotated[int, OptionHelp("degree of the polynomial of each play")] = 1,
    origin: Annotated[
        float | None, OptionHelp("input of the relaxed state, input units", "the first input of the data")
    ] = None,
    input_range: InputRange = None,
) -> PolynomialPlays:
    low, high = operating_range(inputs, input_range)
    thresholds = 0.5 * (high - low) * np.arange(1, at_least_one("plays", plays) + 1) / (plays + 1)
    return PolynomialPlays(
        np.zeros(at_least_one("degree", degree)),
        thresholds,
        np.zeros(plays * at_least_one("powers", powers)),
        (low, high),
        powers=powers,
        origin=float(inputs[0]) if origin is None else origin,
    )


def _prandtl_ishlinskii(
    inputs: Floats,
    *,
    plays: Annotated[int, OptionHelp("number of plays; their thresholds are i maximum / plays, i from 0")] = 15,
    maximum: Annotated[
        float | None, OptionHelp("end of the thresholds, input units", "half the range of the inputs")
    ] = None,
    origin: Annotated[float, OptionHelp("input of the relaxed state, input units")] = 0.0,
    dead_zones: Annotated[int, OptionHelp("thresholds of a rising map after the plays (Kuhnen 2003)")] = 0,
    input_range: InputRange = None,
) -> PrandtlIshlinskii:
    if dead_zones < 0:
        raise ValueError(f"dead_zones: expected an integer >= 0, got {dead_zones!r}")
    low, high = input_span(inputs, "maximum") if maximum is None else (0.0, 2.0 * maximum)
    if high <= low:
        raise ValueError(f"maximum: expected a positive number, got {maximum}")
    return PrandtlIshlinskii(
        0.5 * (high - low) * np.arange(at_least_one("plays", plays)) / plays,
        np.zeros(plays),
        origin=origin,
        # Where they lie is for the outputs to say.
        after=DeadZones(np.arange(float(dead_zones)), np.ones(dead_zones + 1)) if dead_zones else None,
        input_range=_operating(inputs, (np.inf, -np.inf), input_range),
    )


def _fit_dead_zones(
    template: PrandtlIshlinskii, inputs: Floats, outputs: Floats, weights: Floats, skip: int, state: PlayState
) -> PrandtlIshlinskii:
    """Return the operator with play weights, and dead zones whose slopes are still to be fitted, if it has any.

    After Kuhnen 2003: the error is taken between the plays and the dead zones, plays(u) - S⁻¹(y), which is
    linear in the play weights and the slopes of S⁻¹ together. The slope of the interval that holds the median
    output is 1: a factor can be moved from the plays to the dead zones.
    """
    if template.after is None:
        return template
    count = template.after.thresholds.size
    middle = float(np.median(outputs))
    edges = np.linspace(outputs.min(), outputs.max(), count + 2)[1:-1] - middle
    if not (np.diff(edges, prepend=-np.inf) > 0.0).all():
        raise ValueError("outputs: constant; dead zones need outputs that vary")
    shares = DeadZones(edges, np.ones(count + 1)).columns(outputs - middle)
    reference = int(np.searchsorted(edges, 0.0))
    others = np.delete(np.arange(count + 1), reference)
    plain = replace(template, after=None).regressor(inputs, state)
    joint = replace(plain, extra=np.ascontiguousarray(np.column_stack([plain.extra, -shares[:, others]])))
    target = shares[:, reference] + _LEAST_SLOPE * shares[:, others].sum(axis=1)
    found = fit(joint, target, weights=weights, skip=skip)
    slopes = np.ones(count + 1)
    slopes[others] = _LEAST_SLOPE + found.coefficients[plain.shape[1] :]
    to_plays = DeadZones(edges, slopes)
    after = DeadZones(to_plays(edges) - found.bias, 1.0 / slopes)
    return replace(template, weights=found.coefficients[: plain.shape[1]], after=after)


# Source: a choice; each number of levels is twice the one before, up to the 820 cells that some thousand rows
# determine.
_STRUCTURES = {"reversible": ("none", "linear"), "levels": (10, 20, 40)}

PREISACH = ModelSpec(
    "Preisach operator with a nonnegative density",
    Preisach,
    _preisach,
    estimate_state=estimate_memory,
    variants=_STRUCTURES,
)
PREISACH_SIGNED = ModelSpec(
    "Preisach operator with a density of either sign",
    Preisach,
    _preisach,
    constrained=False,
    variants=_STRUCTURES,
    is_compared=False,
)
PREISACH_NONMONOTONIC = ModelSpec(
    "nonnegative Preisach operator and a quadratic thermal term, for non-monotonic hysteresis",
    Preisach,
    _nonmonotonic,
    estimate_state=estimate_memory,
    variants={"levels": (10, 20, 40)},
    is_compared=False,
)
PRANDTL_ISHLINSKII = ModelSpec(
    "Prandtl-Ishlinskii operator with nonnegative weights, and dead zones on request",
    PrandtlIshlinskii,
    _prandtl_ishlinskii,
    refine=_fit_dead_zones,
    variants={"dead_zones": (0, 4), "plays": (5, 15, 30)},
    is_compared=False,
)
POLYNOMIAL = ModelSpec(
    "single-valued polynomial, without memory",
    Polynomial,
    _polynomial,
    constrained=False,
    variants={"degree": (1, 3, 5)},
)
POLYNOMIAL_PLAYS = ModelSpec(
    "polynomial of the input and polynomials of plays, of either sign",
    PolynomialPlays,
    _polynomial_plays,
    constrained=False,
    variants={"degree": (1, 3), "powers": (1, 2, 3), "plays": (3, 6, 10, 20)},
)
TWO_STAGE = ModelSpec("one operator inside another: length = H2[force - H1[voltage]]", TwoStage)
SUMMED = ModelSpec("the difference of two operators: length = H3[force] - H4[voltage]", Summed)
LINEAR = ModelSpec("an operator behind a straight line: length = H5[force - a voltage - F0]", Linear)
