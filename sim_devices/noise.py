"""Noise of emulated instruments and sensors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

_BLOCK = 256


def normals(rng: np.random.Generator) -> Iterator[float]:
    """Yield numbers of the standard normal distribution, those that `rng` gives one by one, but sooner.

    They are drawn in blocks, so nothing else may draw from `rng`.
    """
    while True:
        yield from rng.standard_normal(_BLOCK).tolist()
