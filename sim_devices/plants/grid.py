"""Plants on a fixed time grid, whose answers do not depend on how time is cut into calls."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

# A grid point counts as reached this early (s), so that rounding in the caller's clock, even one that counts from
# 1970, does not decide on which side of a call a step falls.
_GRID_TOLERANCE = 5e-7

# Noise is drawn in blocks of this many grid steps.
_NOISE_BLOCK = 4096


class GridPlant(ABC):
    """Counts grid steps and draws their noise; a plant says what one does.

    Parameters
    ----------
    step : float
        Grid step, s.
    rng : numpy.random.Generator
        The session's randomness. A generator of the plant's own is spawned from it, so that nobody else's draws
        change the plant, nor the plant's theirs.
    noise_shape : tuple of int
        Shape of the standard normal numbers that one step takes.
    """

    def __init__(self, step: float, rng: np.random.Generator, noise_shape: tuple[int, ...] = ()) -> None:
        self._step = step
        self._pending = 0.0
        (self._noise,) = rng.spawn(1)
        self._noise_shape = noise_shape
        self._normals = np.empty((0, *noise_shape))
        self._used = 0

    def advance(self, dt: float) -> None:
        """Advance the plant in time.

        Parameters
        ----------
        dt : float
            Time to advance, s, at least 0. Any size: what does not fill a grid step is held for the
            next call. A grid point less than half a microsecond ahead counts as reached.

        Raises
        ------
        ValueError
            If `dt` is negative or not finite.
        """
        if not 0.0 <= dt < math.inf:
            raise ValueError(f"dt must be finite and not negative, not {dt} s")
        pending = self._pending + dt
        due = math.floor((pending + _GRID_TOLERANCE) / self._step)
        self._pending = pending - due * self._step
        while due > 0:
            if self._used == self._normals.shape[0]:
                self._normals = self._noise.standard_normal((_NOISE_BLOCK, *self._noise_shape))
                self._used = 0
            count = min(due, self._normals.shape[0] - self._used)
            self._take_steps(self._normals[self._used : self._used + count])
            self._used += count
            due -= count

    @abstractmethod
    def _take_steps(self, normals: NDArray[np.float64]) -> None:
        """Take as many grid steps as there are rows of noise."""


def check_numbers(parameters: object, positive: Iterable[str], not_negative: Iterable[str]) -> None:
    """Check that a plant's parameters are finite and of the sign that they must have.

    Parameters
    ----------
    parameters : object
        A dataclass of numbers.
    positive, not_negative : iterable of str
        Names of those that must be above zero, and of those that may be zero.

    Raises
    ------
    ValueError
        If one is not.
    """
    for name, value in vars(parameters).items():
        if not math.isfinite(value):
            raise ValueError(f"{name} must be finite, not {value}")
    for name in positive:
        if not getattr(parameters, name) > 0:
            raise ValueError(f"{name} must be positive, not {getattr(parameters, name)}")
    for name in not_negative:
        if not getattr(parameters, name) >= 0:
            raise ValueError(f"{name} must not be negative, not {getattr(parameters, name)}")
