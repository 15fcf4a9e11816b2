"""The models made of elements, as entries of `bench.models`: what the command `identify` starts from."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import numpy as np

from bench.base import Floats
from bench.identification.options import OptionHelp
from bench.identification.plane_models import InputRange, input_span
from bench.models import BoucWen, Duhem, GeneralizedPrandtlIshlinskii, KrasnoselskiiPokrovskii, MaxwellSlip, ModelSpec

_Origin: TypeAlias = Annotated[
    float | None,
    OptionHelp("input of the relaxed state, input units", "0, or the end of the operating range next to it"),
]
_Plane: TypeAlias = Annotated[
    tuple[float, float] | None, OptionHelp("ends of the plane, input units", "the operating range")
]


def _ranges(inputs: Floats, input_range: tuple[float, float] | None) -> tuple[float, float]:
    return input_span(inputs, "input_range") if input_range is None else input_range


def _placed(span: tuple[float, float], origin: float | None, input_unit: str, output_unit: str) -> dict[str, Any]:
    """Return what every operator of elements with an origin takes."""
    rest = min(max(0.0, span[0]), span[1]) if origin is None else origin
    return {"origin": rest, "input_range": span, "input_unit": input_unit, "output_unit": output_unit}


def _count(name: str, value: int) -> int:
    if value < 1:
        raise ValueError(f"{name}: expected at least 1, got {value}")
    return value


def _bouc_wen(
    inputs: Floats,
    *,
    origin: _Origin = None,
    input_range: InputRange = None,
    input_unit: str = "",
    output_unit: str = "",
) -> BoucWen:
    span = _ranges(inputs, input_range)
    return BoucWen(
        scale=0.5 * (span[1] - span[0]),
        **_placed(span, origin, input_unit, output_unit),
    )


def _duhem(
    inputs: Floats,
    *,
    degree: Annotated[int, OptionHelp("of the curve that the output relaxes to")] = 3,
    origin: _Origin = None,
    input_range: InputRange = None,
    input_unit: str = "",
    output_unit: str = "",
) -> Duhem:
    span = _ranges(inputs, input_range)
    zeros = np.zeros(_count("degree", degree))
    return Duhem(
        zeros,
        zeros,
        **_placed(span, origin, input_unit, output_unit),
    )


def _generalized_prandtl_ishlinskii(
    inputs: Floats,
    *,
    plays: Annotated[int, OptionHelp("number of plays; their thresholds are i / plays, i from 0")] = 15,
    origin: _Origin = None,
    input_range: InputRange = None,
    input_unit: str = "",
    output_unit: str = "",
) -> GeneralizedPrandtlIshlinskii:
    span = _ranges(inputs, input_range)
    return GeneralizedPrandtlIshlinskii(
        np.arange(_count("plays", plays)) / plays,
        np.zeros(plays),
        **_placed(span, origin, input_unit, output_unit),
    )


def _krasnoselskii_pokrovskii(
    inputs: Floats,
    *,
    levels: Annotated[int, OptionHelp("number of intervals of the plane; a ramp is one interval wide")] = 15,
    plane: _Plane = None,
    input_range: InputRange = None,
    input_unit: str = "",
    output_unit: str = "",
) -> KrasnoselskiiPokrovskii:
    span = _ranges(inputs, input_range)
    low, high = span if plane is None else plane
    if not low < high:
        raise ValueError(f"plane: expected two increasing inputs, got {low} and {high}")
    width = (high - low) / _count("levels", levels)
    return KrasnoselskiiPokrovskii(
        low + width * np.arange(levels, dtype=np.float64),
        np.zeros(levels * (levels + 1) // 2),
        width,
        input_range=(min(span[0], low), max(span[1], high)),
        input_unit=input_unit,
        output_unit=output_unit,
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
    input_unit: str = "",
    output_unit: str = "",
) -> MaxwellSlip:
    span = _ranges(inputs, input_range)
    reach = 0.5 * (span[1] - span[0]) if maximum is None else maximum
    if reach <= 0.0:
        raise ValueError(f"maximum: expected a positive number, got {maximum}")
    return MaxwellSlip(
        reach * np.arange(1, _count("elements", elements) + 1) / elements,
        np.zeros(elements),
        **_placed(span, origin, input_unit, output_unit),
    )


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
