"""Noise of emulated instruments and sensors."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, repeat

import numpy as np

_BLOCK = 256


def normals(rng: np.random.Generator) -> Iterator[float]:
    """Return numbers of the standard normal distribution, those that `rng` gives one by one, but sooner.

    They are drawn in blocks, so nothing else may draw from `rng`.
    """
    # Without a frame of Python for each number.
    return chain.from_iterable(rng.standard_normal(size).tolist() for size in repeat(_BLOCK))
