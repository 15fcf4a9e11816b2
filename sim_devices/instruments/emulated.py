"""The common base of the emulated instruments: a role without a wire, and what holds for all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from functools import cache
from typing import Any, ClassVar

import numpy as np

from bench.base import DeviceConnectionError
from bench.devices import Device, Identity
from sim_devices.noise import normals
from sim_devices.world import World


class RequestRefusedError(Exception):
    """An instrument refuses a request.

    Parameters
    ----------
    reason : IntEnum
        The error number of the instrument's protocol.
    """

    def __init__(self, reason: IntEnum) -> None:
        super().__init__(reason.name)
        self.reason = reason


class EmulatedDevice(Device):
    """A role that an emulated instrument plays when it is called directly, without a wire.

    Parameters
    ----------
    rng : numpy.random.Generator, optional
        Noise of the readings, from a stream that nothing else draws from; without it they are free of noise.
    """

    _identity: Identity

    def __init__(self, name: str, world: World, rng: np.random.Generator | None = None) -> None:
        super().__init__(name, world.clock)
        self.world = world
        self._normals = None if rng is None else normals(rng)
        self._setpoint = math.nan

    @property
    def identity(self) -> Identity:
        """Maker, model, serial number and firmware."""
        return self._identity

    @property
    def setpoint(self) -> float:
        """The set-point that was last sent, in the unit of the role's limits; nan before the first."""
        return self._setpoint

    def close(self) -> None:
        """Do nothing: there is no line."""

    def _draw(self, deviation: float) -> float:
        """Draw from a normal distribution of a standard deviation."""
        return 0.0 if self._normals is None else deviation * next(self._normals)


class Pluggable:
    """An emulated instrument that can be unplugged from its line."""

    world: World

    plugged_in = True

    @property
    def answering(self) -> bool:
        """Whether the instrument answers requests at the clock's present time."""
        return self.plugged_in

    def attend(self) -> None:
        """Bring the instrument to the clock's present time: a request has arrived."""
        self.world.advance()

    def unplug(self) -> None:
        """Block requests and answers; the instrument keeps working, and its watchdog expires."""
        with self.world.at_present():
            self.plugged_in = False

    def plug_in(self) -> None:
        """Undo `unplug`."""
        with self.world.at_present():
            self.plugged_in = True


class FreezingReadings:
    """An instrument whose measured values can stand still, while it answers and obeys as ever.

    Attributes
    ----------
    MEASURED : tuple of int
        Those of its readings that it measures.
    """

    MEASURED: ClassVar[tuple[int, ...]]
    world: World

    _readings: dict[int, Callable[..., Any]]
    _thawed: dict[int, Callable[..., Any]] | None = None

    def freeze(self) -> None:
        """Let measured values stand at what they are when they are next read."""
        with self.world.at_present():
            if self._thawed is None:
                self._thawed = {number: self._readings[number] for number in self.MEASURED}
                self._readings.update({number: cache(reading) for number, reading in self._thawed.items()})
                self._readings_changed()

    def thaw(self) -> None:
        """Undo `freeze`."""
        with self.world.at_present():
            if self._thawed is not None:
                self._readings.update(self._thawed)
                self._thawed = None
                self._readings_changed()

    def _readings_changed(self) -> None:
        """Forget what was kept of the readings; an instrument that keeps some overrides it."""


class EmulatedInstrument(Pluggable, EmulatedDevice):
    """An emulated instrument with a line of its own."""

    @contextmanager
    def _request(self) -> Iterator[None]:
        """Serve a request of the role: hold the lock, at the clock's present time."""
        with self.world.lock:
            if not self.answering:
                raise DeviceConnectionError(self.name, "does not answer: it is unplugged or restarting")
            self.attend()
            yield
