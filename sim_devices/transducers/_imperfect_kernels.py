"""Compiled inner loop of sensors with systematic errors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.base import inner, kernel

Floats = NDArray[np.float64]


@inner
def shown(
    quantity: float,
    gain: float,
    offset: float,
    wave: float,
    scale: float,
    middle: float,
    phase: float,
    most: float,
    resolution: float,
) -> float:
    """Return what `Characteristic.value` makes of a quantity, to the last bit."""
    value = gain * quantity + offset
    if wave:
        value += wave * math.sin(min(max(scale * (quantity - middle), -most), most) + phase)
    if resolution:
        value = np.round(value / resolution) * resolution
    return value


@kernel
def show(
    values: Floats,
    gain: float,
    offset: float,
    wave: float,
    scale: float,
    middle: float,
    phase: float,
    most: float,
    resolution: float,
) -> None:
    """Replace quantities by what `Characteristic.value` makes of them, to the last bit."""
    for i in range(values.size):
        values[i] = shown(values[i], gain, offset, wave, scale, middle, phase, most, resolution)
