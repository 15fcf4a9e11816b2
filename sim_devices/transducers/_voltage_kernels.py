"""Compiled output voltages of transducers, for those that an instrument converts in one call."""

from __future__ import annotations

import math

import numpy as np

from bench.base import kernel

_KELVIN = 273.15


@kernel
def displacement_volts(metres: float, resolution: float, reach: float, volts_per_metre: float) -> float:
    """Return the output (V) of a displacement sensor with steps (m) that stays where it is beyond its reach (m)."""
    shown = float(np.round(metres / resolution)) * resolution
    return volts_per_metre * min(max(shown, -reach), reach)


@kernel
def divider_volts(
    celsius: float, excitation_volts: float, reference_ohms: float, a: float, c: float, cube: float
) -> float:
    """Return the voltage (V) over a thermistor in a divider.

    Its resistance is the one real root of 1/T = a + b ln R + c (ln R)³, a cubic equation in ln R; `cube` is
    (b / 3c)³.
    """
    half = (a - 1.0 / (celsius + _KELVIN)) / (2.0 * c)
    root = math.sqrt(cube + half * half)
    ohms = math.exp(np.cbrt(root - half) - np.cbrt(root + half))
    return excitation_volts * ohms / (ohms + reference_ohms)
