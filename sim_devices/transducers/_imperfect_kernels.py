"""Compiled inner loop of sensors with systematic errors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.base import kernel

Floats = NDArray[np.float64]


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
        value = gain * values[i] + offset
        if wave:
            value += wave * math.sin(min(max(scale * (values[i] - middle), -most), most) + phase)
        if resolution:
            value = np.round(value / resolution) * resolution
        values[i] = value
