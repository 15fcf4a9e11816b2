"""Compiled loop of the modes of linear dynamics. Imported on first use only, because numba is slow to load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import kernel

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@kernel
def held_response(factor: complex, entry: complex, inputs: Floats) -> Complexes:
    """Return the response of a mode to inputs that are held for a step each, from rest, before each input has acted.

    `factor` is what remains of the mode after a step, `entry` the response to a unit input after one.
    """
    outputs = np.empty(inputs.size, np.complex128)
    value = 0j
    for k in range(inputs.size):
        outputs[k] = value
        value = entry * inputs[k] + factor * value
    return outputs
