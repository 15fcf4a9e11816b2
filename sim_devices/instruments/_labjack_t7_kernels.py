"""Compiled conversion of an analog input of a LabJack T7."""

from __future__ import annotations

import numpy as np

from bench.base import inner
from sim_devices.plants.grid import Floats

NOISE, STEP, LOWEST, HIGHEST = range(4)
"""Places of what a reading is made of, V."""


@inner
def converted(volts: float, normal: float, scale: Floats) -> float:
    """Return the reading (V) of a voltage (V), with a number of the standard normal distribution as its noise."""
    # A sum with zero makes zero of minus zero.
    reading = float(np.round((volts + scale[NOISE] * normal) / scale[STEP])) * scale[STEP] + 0.0
    return float(min(max(reading, scale[LOWEST]), scale[HIGHEST]))
