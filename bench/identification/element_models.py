"""The models made of elements, as entries of `bench.models`: what the command `identify` starts from."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import numpy as np

from bench.base import Floats
from bench.identification.options import OptionHelp
from bench.identification.plane_models import InputRange, at_least_one, operating_range
from bench.models import BoucWen, Duhem, GeneralizedPrandtlIshlinskii, KrasnoselskiiPokrovskii, MaxwellSlip, ModelSpec

_Origin: TypeAlias = Annotated[
    float | None,
    OptionHelp("input of the relaxed state, input units", "0, or the end of the operating range next to it"),
]
_Plane: TypeAlias = Annotated[
    tuple[float, float] | None, OptionHelp("ends of the plane, input units", "the operating range")
]


def _placed(span: tuple[float, float], origin: float | None) -> dict[str, Any]:
    """Return what every operator of elements with an origin takes."""
    rest = min(max(0.0, span[0]), span[1]) if origin is None else origin
    return {"origin": rest, "input_range": span}


def _bouc_wen(
    inputs: Floats,
    *,
    origin: _Origin = None,
    input_range: InputRange = None,
) -> BoucWen:
    span = operating_range(inputs, input_range)
    return BoucWen(scale=0.5 * (span[1] - span[0]), **_placed(span, origin))


def _duhem(
    inputs: Floats,
    *,
    degree: Annotated[int, OptionHelp("of the curve that the output relaxes to")] = 3,
    origin: _Origin = None,
    input_range: InputRange = None,
) -> Duhem:
    span = operating_range(inputs, input_range)
    zeros = np.zeros(at_least_one("degree", degree))
    return Duhem(zeros, zeros, **_placed(span, origin))


def _generalized_prandtl_ishlinskii(
    inputs: Floats,
    *,
    plays: Annotated[int, OptionHelp("number of plays; their thresholds are i / plays, i from 0")] = 15,
    origin: _Origin = None,
    input_range: InputRange = None,
) -> GeneralizedPrandtlIshlinskii:
    span = operating_range(inputs, input_range)
    return GeneralizedPrandtlIshlinskii(
        np.arange(at_least_one("plays", plays)) / plays, np.zeros(plays), **_placed(span, origin)
    )


def _krasnoselskii_pokrovskii(
    inputs: Floats,
    *,
    levels: Annotated[int, OptionHelp("number of intervals of the plane; a ramp is one interval wide")] = 15,
    plane: _Plane = None,
    input_range: InputRange = None,
) -> KrasnoselskiiPokrovskii:
    span = operating_range(inputs, input_range)
    low, high = span if plane is None else plane
    if not low < high:
        raise ValueError(f"plane: expected two increasing inputs, got {low} and {high}")
    width = (high - low) / at_least_one("levels", levels)
    return KrasnoselskiiPokrovskii(
        low + width * np.arange(levels, dtype=np.float64),
        np.zeros(levels * (levels + 1) // 2),
        width,
        input_range=(min(span[0], low), max(span[1], high)),
    )


def _maxwell_slip(
    inputs: Floats,
    *,
    elements: Annotated[int, OptionHelp("number of elements; they slip at i maximum / elements, i from 1")] = 15,
    maximum: Annotated[
        float | None,
        OptionHelp("end of the slip deformations, input units", "half the operating range"),
    ] = None,
    origin: _Origin = None,
    input_range: InputRange = None,
) -> MaxwellSlip:
    span = operating_range(inputs, input_range)
    reach = 0.5 * (span[1] - span[0]) if maximum is None else maximum
    if reach <= 0.0:
        raise ValueError(f"maximum: expected a positive number, got {maximum}")
    slips = reach * np.arange(1, at_least_one("elements", elements) + 1) / elements
    return MaxwellSlip(slips, np.zeros(elements), **_placed(span, origin))


BOUC_WEN = ModelSpec("Bouc-Wen operator, rate-independent, with a spring", BoucWen, _bouc_wen)
DUHEM = ModelSpec("Duhem operator of Coleman and Hodgdon", Duhem, _duhem, variants={"degree": (3, 5, 7)})
GENERALIZED_PRANDTL_ISHLINSKII = ModelSpec(
    "Prandtl-Ishlinskii operator between two tanh envelopes, for loops that saturate or are asymmetric",
    GeneralizedPrandtlIshlinskii,
    _generalized_prandtl_ishlinskii,
    is_compared=False,
)
KRASNOSELSKII_POKROVSKII = ModelSpec(
    "Krasnosel'skii-Pokrovskii operator: relays with slope, on a plane",
    KrasnoselskiiPokrovskii,
    _krasnoselskii_pokrovskii,
    variants={"levels": (10, 20)},
    is_compared=False,
)
MAXWELL_SLIP = ModelSpec(
    "Maxwell-slip operator: springs that slip under a force",
    MaxwellSlip,
    _maxwell_slip,
    variants={"elements": (5, 15)},
    is_compared=False,
)
