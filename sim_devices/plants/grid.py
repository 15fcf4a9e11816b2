"""Plants on a fixed time grid, whose results do not depend on how calls divide the time."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Generic, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from bench.base import ConfigurationError

# A grid point counts as reached this early (s), so that rounding in the caller's clock, even one that counts from
# 1970, does not decide on which side of a call a step falls.
GRID_TOLERANCE = 5e-7

# Noise is drawn in blocks of this many grid steps.
_NOISE_BLOCK = 4096


ABSOLUTE_ZERO = -273.15
"""Absolute zero, °C."""


NotNegative = Annotated[float, "zero or positive"]
"""A parameter that may be zero."""

Signed = Annotated[float, "signed"]
"""A parameter of either sign."""

Seed = Annotated[int, "zero or positive"]
"""A seed of a specimen."""

Floats = NDArray[np.float64]

Record = Any
"""A record of named numbers of a structured dtype, or an array of one."""


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """Numbers that are finite, and positive unless their type says otherwise.

    Raises `ValueError` if a number is not allowed.
    """

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            value = getattr(self, name)
            sign = getattr(hint, "__metadata__", ("positive",))[0]
            if isinstance(value, float | int):
                if not math.isfinite(value):
                    raise ValueError(f"{name} must be finite, not {value}")
                if (sign == "zero or positive" and value < 0) or (sign == "positive" and value <= 0):
                    raise ValueError(f"{name} must be {sign}, not {value}")


N = TypeVar("N", bound=Numbers)


def changed(numbers: N, changes: Mapping[str, float]) -> N:
    """Return numbers with some of them replaced by their names, such as those of a perturbed plant.

    Raises ConfigurationError if there is no such number, or a value is not allowed.
    """
    known = [field.name for field in fields(numbers)]
    for name in changes:
        if name not in known:
            raise ConfigurationError(f"plant.{name}: there is no such number; there are: {', '.join(known)}")
    kinds = {field.name: type(getattr(numbers, field.name)) for field in fields(numbers)}
    try:
        return replace(numbers, **{name: kinds[name](value) for name, value in changes.items()})
    except ValueError as error:
        raise ConfigurationError(f"plant: {error}") from None


@dataclass(frozen=True, kw_only=True)
class PlantParameters(Numbers):
    """Numbers of a plant."""

    step: float
    """Step of the time grid, s."""


P = TypeVar("P", bound=PlantParameters)


class GridPlant(ABC, Generic[P]):
    """Counts grid steps and draws their noise; subclasses define the step.

    Parameters
    ----------
    rng : numpy.random.Generator
        The session's randomness. The plant spawns its own generator from it and never draws from `rng` itself, so
        that other users of `rng` do not disturb the trajectory.
    noise_shape : tuple of int
        Shape of the standard normal numbers that one step takes.
    """

    def __init__(self, parameters: P, rng: np.random.Generator, noise_shape: tuple[int, ...] = ()) -> None:
        self._parameters = parameters
        self._step = parameters.step
        self._pending = 0.0
        (self._noise,) = rng.spawn(1)
        self._noise_shape = noise_shape
        self._normals = np.empty((0, *noise_shape))
        self._used = 0

    @property
    def parameters(self) -> P:
        """The numbers of this plant."""
        return self._parameters

    def since_point(self) -> float:
        """Return the time for which it has stood at the last grid point, s."""
        return self._pending

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
        pending = self._pending + dt
        if dt >= 0.0 and pending + GRID_TOLERANCE < self._step:
            # As a rule: an instrument is asked more often than the plant takes a step.
            self._pending = pending
            return
        if not 0.0 <= dt < math.inf:
            raise ValueError(f"dt must be finite and not negative, not {dt} s")
        due = math.floor((pending + GRID_TOLERANCE) / self._step)
        self._pending = pending - due * self._step
        while due > 0:
            if self._used == len(self._normals):
                self._normals = self._noise.standard_normal((_NOISE_BLOCK, *self._noise_shape))
                self._used = 0
            normals = self._normals[self._used : self._used + due]
            count = len(normals)
            self._used += count
            due -= count
            self._take_steps(normals)

    @abstractmethod
    def _take_steps(self, normals: NDArray[np.float64]) -> None:
        """Take as many grid steps as there are rows of noise."""


def record_type(names: str) -> np.dtype[np.void]:
    """Return the dtype of a record of floats with these names, which blanks separate."""
    return np.dtype([(name, np.float64) for name in names.split()])


def record(kind: np.dtype[np.void], **values: float) -> Record:
    """Return numbers as an array of one record: a compiled loop takes it faster than the record, and by name."""
    assert values.keys() == set(kind.names or ())
    return np.array([tuple(values[name] for name in kind.names or ())], kind)


def fluctuation(deviation: float, time: float, step: float) -> tuple[float, float]:
    """Prepare a fluctuation with an exponential autocorrelation (Ornstein-Uhlenbeck) for a time grid.

    Parameters
    ----------
    deviation : float
        Standard deviation.
    time, step : float
        Correlation time and grid step, s.

    Returns
    -------
    tuple of float
        Share that remains after a step, and the factor of the standard normal number that is added.
    """
    decay = math.exp(-step / time)
    return decay, deviation * math.sqrt(1.0 - decay**2)


def check_temperature(name: str, celsius: float) -> None:
    """Raise `ValueError` unless a number is a temperature, °C."""
    if not ABSOLUTE_ZERO < celsius < math.inf:
        raise ValueError(f"{name} must be a temperature above absolute zero, not {celsius} °C")
