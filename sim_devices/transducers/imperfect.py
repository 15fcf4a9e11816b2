"""Sensors that are not ideal: gain, offset, nonlinearity, lag, latency and steps between a quantity and its reading.

Noise belongs to the transducer; what is here is systematic, and a calibration can find it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from bench.base import CheckedTable
from sim_devices.world import World

Floats = NDArray[np.float64]

_WAVE = 4.493409457909064
"""Root of tan k = k: sin(k u) is orthogonal to straight lines on [-1, 1], so that it is all nonlinearity."""
_PIECES = 8
"""Samples of the quantity in a lag or latency."""
_MEMORY = 10
"""Lags after which a sensor has forgotten what was before."""
_SHORTEST = 20e-6
"""Least time between two samples, s."""
_ITERATIONS = 24
"""Steps to the quantity behind a reading; each leaves the part of the error that the nonlinearity's slope is."""


class SensorErrors(CheckedTable):
    """Systematic errors of a sensor, a table in `[emulation]`; all 0 for an ideal sensor.

    Lengths are in m, temperatures in K, forces in N: "unit" is that of the quantity.
    """

    gain_error: float = Field(default=0.0, ge=-0.5, le=0.5, description="error of the gain, as a share")
    offset: float = Field(default=0.0, ge=-100, le=100, description="error at zero, in the unit of the quantity")
    nonlinearity: float = Field(
        default=0.0,
        ge=0,
        le=0.1,
        description="largest deviation from the best line, as a share of the range",
    )
    phase: float = Field(
        default=0.0, ge=-10, le=10, description="phase of the nonlinearity's wave at the middle of the range, rad"
    )
    lag: float = Field(default=0.0, ge=0, le=60, description="time constant of the first order, s")
    latency: float = Field(default=0.0, ge=0, le=10, description="time by which the reading is late, s")
    resolution: float = Field(
        default=0.0, ge=0, le=1, description="steps in which it gives the quantity, in its unit; 0 for none"
    )


class _Late:
    """A quantity that is seen with a lag and a latency; `Timed`, as it looks between two readings by itself.

    It looks as far back as it remembers: what changed before has no effect on a reading.
    """

    def __init__(self, quantity: Callable[[], float], lag: float, latency: float, world: World) -> None:
        self._quantity = quantity
        self._world = world
        self._lag, self._latency = lag, latency
        self._step = max(_SHORTEST, min(each for each in (lag, latency) if each) / _PIECES)
        self._memory = _MEMORY * lag + latency + self._step
        value = quantity()
        self._last = world.time, value
        self._lagged = value
        # Times and lagged values, from before what is shown now.
        self._course = deque([(world.time, value)])
        world.add(self)

    def deadline(self) -> float:
        """Return when it looks next, laboratory seconds."""
        return max(self._last[0] + self._step, self._world.clock.now() - self._memory)

    def expire(self) -> None:
        """Look."""
        if self._world.time - self._last[0] > self._memory:
            value = self._quantity()
            self._last, self._lagged = (self._world.time, value), value
            self._course.clear()
        self()

    def __call__(self) -> float:
        """Look, and return what is seen at this instant."""
        value, self._lagged = self._look()
        now = self._world.time
        self._last = now, value
        course = self._course
        if not course or now > course[-1][0]:
            course.append((now, self._lagged))
        shown = now - self._latency
        while len(course) > 1 and course[1][0] <= shown:
            course.popleft()
        return self._at(shown, self._lagged)

    def peek(self) -> float:
        """Return what is seen at this instant, and change nothing."""
        return self._at(self._world.time - self._latency, self._look()[1])

    def _look(self) -> tuple[float, float]:
        """Return the quantity, and what the lag leaves of it."""
        now, (before, previous) = self._world.time, self._last
        value = self._quantity()
        if not self._lag:
            return value, value
        if now <= before:
            return value, self._lagged
        # Exact for a quantity that goes straight between two looks.
        behind = (value - previous) / (now - before) * self._lag
        left = math.exp(-(now - before) / self._lag)
        return value, value - behind + (self._lagged - previous + behind) * left

    def _at(self, shown: float, present: float) -> float:
        """Return the lagged value at an instant, s; at present it is given."""
        if not self._latency:
            return present
        first, low = self._course[0]
        for second, high in [*islice(self._course, 1, None), (self._world.time, present)]:
            if shown < second:
                share = (shown - first) / (second - first) if second > first else 1.0
                return low + (high - low) * min(max(share, 0.0), 1.0)
            first, low = second, high
        return low


class Characteristic:
    """What a sensor with systematic errors makes of a quantity that has stood for long.

    Parameters
    ----------
    errors : SensorErrors
        Its errors.
    low, high : float
        Range of the sensor, unit of the quantity: that of the nonlinearity, one and a half waves over it.
    """

    def __init__(self, errors: SensorErrors, low: float, high: float) -> None:
        self._gain = 1.0 + errors.gain_error
        self._offset = errors.offset
        self._wave = errors.nonlinearity * (high - low)
        self._middle, self._scale = 0.5 * (low + high), 2.0 * _WAVE / (high - low)
        self._phase = errors.phase
        self._resolution = errors.resolution
        # Compiled when a laboratory opens.
        self.show(np.empty(0))

    def value(self, quantity: float) -> float:
        """Return what it makes of a value, in its unit and without noise."""
        value = self._gain * quantity + self._offset
        if self._wave:
            angle = self._scale * (quantity - self._middle)
            angle = -_WAVE if angle < -_WAVE else _WAVE if angle > _WAVE else angle
            value += self._wave * math.sin(angle + self._phase)
        return round(value / self._resolution) * self._resolution if self._resolution else value

    def course(self, quantities: Floats) -> Floats:
        """Return `value` of each of the values of a course, shape (N,)."""
        values = np.array(quantities, dtype=np.float64)
        self.show(values)
        return values

    def show(self, quantities: Floats) -> None:
        """Replace quantities, shape (N,), by the `value` of each."""
        self._replace(quantities, self._resolution)

    def quantities(self, values: Floats) -> Floats:
        """Return of what it makes each of some values, but for its steps: the quantities themselves."""
        found = np.array(values, dtype=np.float64)
        # A sensor of a few percent is met to the last bit.
        for _ in range(_ITERATIONS):
            smooth = found.copy()
            self._replace(smooth, 0.0)
            found += (values - smooth) / self._gain
        return found

    @property
    def numbers(self) -> tuple[float, float, float, float, float, float, float, float]:
        """What `_imperfect_kernels.shown` takes besides the quantity."""
        return (
            self._gain, self._offset, self._wave, self._scale, self._middle, self._phase, _WAVE, self._resolution
        )  # fmt: skip

    def _replace(self, quantities: Floats, resolution: float) -> None:
        from sim_devices.transducers import _imperfect_kernels as kernels

        kernels.show(quantities, *self.numbers[:-1], resolution)


class ImperfectSensor:
    """What a sensor with systematic errors makes of a quantity.

    Parameters
    ----------
    quantity : callable
        The quantity itself, in its unit.
    errors : SensorErrors
        Its errors.
    low, high : float
        Range of the sensor, unit of the quantity; see `Characteristic`.
    world : World
        The laboratory's time, for lag and latency.

    Attributes
    ----------
    characteristic : Characteristic
        What it makes of a value that has stood for long.
    """

    def __init__(
        self, quantity: Callable[[], float], errors: SensorErrors, low: float, high: float, world: World
    ) -> None:
        self._late = _Late(quantity, errors.lag, errors.latency, world) if errors.lag or errors.latency else None
        self._quantity = quantity
        self.characteristic = Characteristic(errors, low, high)
        self._value = self.characteristic.value

    def __call__(self) -> float:
        """Return what the sensor makes of the quantity at this instant, in its unit and without noise."""
        return self._value(self._quantity() if self._late is None else self._late())

    def peek(self) -> float:
        """Return the same, and change nothing."""
        return self._value(self._quantity() if self._late is None else self._late.peek())

    @property
    def is_static(self) -> bool:
        """Whether it has neither lag nor latency."""
        return self._late is None


def imperfect(
    quantity: Callable[[], float], errors: SensorErrors, low: float, high: float, world: World
) -> Callable[[], float]:
    """Return what a sensor makes of a quantity; see `ImperfectSensor`. An ideal one makes nothing of it."""
    return quantity if errors == SensorErrors() else ImperfectSensor(quantity, errors, low, high, world)


def characteristic_of(sensor: Callable[[], float]) -> Characteristic | None:
    """Return what a sensor without lag and latency makes of its quantity; None if it has either."""
    if not isinstance(sensor, ImperfectSensor):
        return Characteristic(SensorErrors(), -1.0, 1.0)
    return sensor.characteristic if sensor.is_static else None


def shown(sensor: Callable[[], float]) -> float:
    """Return what a sensor shows at this instant, and change nothing, for the truth beside it."""
    return sensor.peek() if isinstance(sensor, ImperfectSensor) else sensor()
