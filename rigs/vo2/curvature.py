"""The curvature of a cantilever from the deflection of its tip: a derived signal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from bench.base import DeviceError
from bench.devices import Signal
from bench.rig import Derived, DerivedSignal

Floats = npt.NDArray[np.float64]

_LARGEST_ANGLE = 2.331122370414423
"""Where (1 - cos x)/x is largest, in rad: tan(x/2) = x. Beyond it one deflection has two curvatures."""
_LARGEST_RATIO = (1.0 - np.cos(_LARGEST_ANGLE)) / _LARGEST_ANGLE


def curvature_to_deflection(curvature: npt.ArrayLike, length: float, residual_curvature: float = 0.0) -> Floats:
    """Return how far the tip of a bent cantilever moves, m, when its curvature changes; of the shape of `curvature`.

    Parameters
    ----------
    curvature : array_like
        Change of curvature from the residual one, 1/m, any shape.
    length : float
        Length of the beam along its arc, m.
    residual_curvature : float
        Curvature of the beam at rest, 1/m, from which deflection and curvature are counted.

    Notes
    -----
    Δz = z(κ_i + Δκ) - z(κ_i) with z(κ) = 2 sin²(κL/2)/κ, Zhang et al. 2013, eq. (1). The paper applies (1)
    to the change of deflection as if the beam were straight at rest, which is the case κ_i = 0.
    """
    _check_length(length)
    angles = (np.asarray(curvature, dtype=np.float64) + residual_curvature) * length
    ratios = np.array([_ratio(angle) for angle in angles.ravel().tolist()]).reshape(angles.shape)
    return np.asarray(length * (ratios - _ratio(residual_curvature * length)))


def deflection_to_curvature(deflection: npt.ArrayLike, length: float, residual_curvature: float = 0.0) -> Floats:
    """Return the change of curvature that moves the tip of a cantilever by `deflection`.

    Parameters
    ----------
    deflection : array_like
        Movement of the tip from its place at rest, m, any shape.
    length, residual_curvature
        As in `curvature_to_deflection`.

    Returns
    -------
    ndarray
        Change of curvature in 1/m, of the shape of `deflection`; nan where no bending of the beam reaches
        the deflection (more than 0.7246 lengths from straight).

    Notes
    -----
    Newton's method from the small-angle value. (1 - cos x)/x is concave up to its maximum and below x/2,
    so the iteration rises to the root without overshooting it.
    """
    _check_length(length)
    rest = _ratio(residual_curvature * length)
    ratios = np.asarray(deflection, dtype=np.float64) / length + rest
    angles = np.array([_angle(ratio) for ratio in ratios.ravel().tolist()]).reshape(ratios.shape)
    return np.asarray(angles / length - residual_curvature)


class CantileverCurvature(DerivedSignal):
    """Curvature of a cantilever from the deflection of its tip, or from the angle by which the tip turns."""

    source: str = Field(description="signal of the tip's deflection, m, or angle, °")
    length: float = Field(gt=0, le=1, description="length of the beam, m", json_schema_extra={"unit": "m"})
    residual_curvature: float = Field(
        default=0.0,
        ge=-1e5,
        le=1e5,
        description="curvature of the beam at rest, 1/m",
        json_schema_extra={"unit": "1/m"},
    )

    @model_validator(mode="after")
    def _rest_can_be_inverted(self) -> Self:
        largest = _LARGEST_ANGLE / self.length
        if not abs(self.residual_curvature) < largest:
            raise ValueError(
                f"residual_curvature = {self.residual_curvature:g} 1/m bends a beam of {self.length * 1e6:g} µm so "
                f"far that one deflection has two curvatures; allowed is less than {largest:.5g} 1/m either way"
            )
        return self

    @property
    def sources(self) -> tuple[str, ...]:
        """The deflection or angle."""
        return (self.source,)

    def bind(self, name: str, units: Mapping[str, str]) -> Derived:
        """Return the curvature, 1/m; it has no value where no bending of the beam reaches the deflection."""
        source, length, residual_curvature = self.source, self.length, self.residual_curvature
        signal = Signal(name, "1/m", "curvature", 2)
        if units[source] == "°":
            # An arc turns by its curvature times its length.
            scale = math.pi / 180.0 / length
            return Derived(signal, self.sources, lambda values: scale * values[source])
        if units[source] != "m":
            raise ValueError(
                f"source = {source!r}: is in {units[source]}; expected a deflection in m or an angle in °"
            )
        rest = _ratio(residual_curvature * length)

        def compute(values: Mapping[str, float]) -> float:
            # `deflection_to_curvature` of one number, without arrays.
            deflection = values[source]
            curvature = _angle(deflection / length + rest) / length - residual_curvature
            if not math.isfinite(curvature) and math.isfinite(deflection):
                raise DeviceError(
                    name,
                    f"a beam of {length * 1e6:g} µm cannot bend by {deflection * 1e6:.1f} µm; "
                    "check the spot on the detector and the calibration",
                )
            return curvature

        return Derived(signal, self.sources, compute)


# Scalars by `math`: one reading at a time is what a run asks for, and numpy's calls cost it fifty times as much.
def _ratio(angle: float) -> float:
    """Return (1 - cos x)/x without cancellation."""
    half = 0.5 * angle
    return math.sin(half) ** 2 / half if half else 0.0


def _angle(ratio: float) -> float:
    """Return the angle of a ratio; nan where there is none."""
    target = abs(ratio)
    if not target < _LARGEST_RATIO:
        return math.nan
    angle = 2.0 * target
    for _ in range(60):
        if angle == 0.0:
            break
        slope = math.sin(angle) / angle - 2.0 * (math.sin(0.5 * angle) / angle) ** 2
        step = (target - _ratio(angle)) / slope
        angle = min(angle + step, _LARGEST_ANGLE)
        if abs(step) <= 1e-15 * (1.0 + angle):
            break
    return math.copysign(angle, ratio)


def _check_length(length: float) -> None:
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"length: expected a positive number of m, got {length}")
